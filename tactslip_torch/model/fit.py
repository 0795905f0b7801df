"""Fitting the machine to training bins by the cheaper route (REFERENCE.md section 5).

On targets of +-1 the kernel extreme learning machine (paper section IV-E) is kernel ridge
regression with ``alpha = 1 / C``. Two routes to the same machine: dual, one unknown per training
bin, and primal, one unknown per monomial of the features.

What each training bin would score had its whole group been left out, without refitting.

The weights of the machine are redone; features, scaling and bin weights stay. A group is a bin, a
cycle, a material: whatever must not stand on both sides of a validation. With ``G = K +
diag(1 / (C w))`` and ``beta = G^-1 t`` the residuals of a group under the machine without it are
``e_g = ((G^-1)_gg)^-1 beta_g``; in the primal ``e_g = (I - H_gg)^-1 (t - Phi v)_g`` with the hat
matrix ``H = Phi A^-1 Phi' W``. Either way one Cholesky factor serves all groups.

Reference:
    Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2, and An, Liu and
    Venkatesh (2007), Pattern Recognition 40(8), 2154-2162, for blocks.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Head,
    Polynomial,
    QuadraticForm,
    collapse,
    gram_matrix,
    machine_of,
    solved_machine,
)
from tactslip_torch.model.moments import ProductSums
from tactslip_torch.model.solve import check_weights, solve_symmetric

log = logging.getLogger(__name__)

Route = Literal["auto", "primal", "dual"]

_CHUNK_BINS = 2048  # whose monomials are held at a time
_MOST_CONDITION = 1e12  # of a fit that is differentiated
_MOST_DUAL = 16_384  # bins whose Gram matrix (2 GiB) is worth keeping the light ones
_LARGEST_LOSS = 1e-3  # of what the lightest bin says, in a sum with the heaviest


@dataclass(frozen=True)
class TrainingBins:
    """Scaled training bins of the machine, in float64 or to be promoted to it exactly.

    Args:
        features: ``[N, K]`` in [-1, 1].
        is_slip: ``[N]``, bool.
        weights: ``[N]``, positive, or ``None`` for 1 each.

    Raises:
        ValueError: if shapes disagree or a weight is not positive and finite.
    """

    features: Tensor
    is_slip: Tensor
    weights: Tensor | None = None

    def __post_init__(self) -> None:
        shapes = [tuple(self.features.shape), tuple(self.is_slip.shape)]
        if self.weights is not None:
            shapes.append(tuple(self.weights.shape))
        if len(shapes[0]) != 2 or any(shape != shapes[0][:1] for shape in shapes[1:]):
            raise ValueError(
                "expected features [N, K], is_slip [N] and weights [N] with one N, got "
                f"{', '.join(map(str, shapes))}"
            )
        if self.weights is not None:
            check_weights(self.weights)

    @property
    def targets(self) -> Tensor:
        """+1 for slip, -1 for non-slip, ``[N]``."""
        return torch.where(self.is_slip, 1.0, -1.0).to(self.features)

    @property
    def sample_weight(self) -> Tensor:
        """Weights, 1 each if there are none, ``[N]``, float64."""
        if self.weights is None:
            return torch.ones_like(self.is_slip, dtype=torch.float64)
        return self.weights.double()

    def double(self) -> TrainingBins:
        """The same bins in float64."""
        weights = None if self.weights is None else self.weights.double()
        return TrainingBins(self.features.double(), self.is_slip, weights)


def fit_machine(
    bins: TrainingBins, penalty: float, kernel: Polynomial = PAPER_KERNEL, route: Route = "auto"
) -> Head:
    """Solve the kernel machine, and fold it into its quadratic form unless that is larger.

    Through the primal or the dual, whichever ``takes_dual`` finds cheaper; both give the same
    machine. The primal takes two matrices of monomials by monomials (7381 for 120 features)
    whatever the number of bins; the dual takes two of bins by bins. In float64, and however close
    to singular (``solve``); ``solved`` of the machine says how it went. Weights so far apart that
    sums of the primal would lose the lightest bin take the dual up to 16384 bins.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        penalty: the paper's ``C``; ``inf`` for the pseudo-inverse.
        kernel: of the machine.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if a number is not finite, or the primal would lose the lightest bin to
            rounding.
    """
    if len(bins.features) == 0:
        raise ValueError("a machine needs training bins, got none; add bins of both classes")
    bins = bins.double()
    if not _goes_dual(bins, penalty, kernel, route):
        normal = _normal_matrix(kernel, bins.features, bins.sample_weight)
        moment = kernel.sum_of_monomials(bins.features, bins.sample_weight * bins.targets)
        return kernel.solve(normal, moment, penalty, bins.features.shape[1])[0]
    gram = gram_matrix(kernel, bins.features)
    solution = solve_symmetric(gram, bins.targets, penalty, bins.weights, name="gram")
    num_features = bins.features.shape[1]
    most_rank = kernel.num_monomials(num_features)
    make = functools.partial(machine_of, bins.features, kernel=kernel)
    machine = solved_machine(solution, make, most_rank)
    if not isinstance(machine, QuadraticForm):
        log.info(
            "%s of more features than bins: all %d training bins are kept, %s",
            kernel,
            len(bins.features),
            machine.cost,
        )
    return machine


def _normal_matrix(kernel: Polynomial, z: Tensor, weights: Tensor) -> Tensor:
    """``X' W X`` of the monomials of bins ``[N, K]``, by way of the sums that are distinct."""
    layout = ProductSums(z.shape[1], kernel.degree)
    total = z.new_zeros(layout.num_held)
    layout.add_(total, z, weights)
    return layout.normal_matrix(total, kernel.offset)


def fit_quadratic(
    z: Tensor,
    targets: Tensor,
    penalty: Tensor | float,
    offset: Tensor | float = 0.5,
    weights: Tensor | None = None,
    route: Route = "auto",
) -> QuadraticForm:
    """The machine of ``fit_machine`` with ``Polynomial(2, offset)``, differentiable.

    Its numbers, and so its scores, know where they come from: any number of times differentiable
    in ``z``, real ``targets``, ``penalty``, ``offset`` and ``weights``.

    Args:
        z: scaled features of the bins; promoted to float64.
        targets: +1 for slip and -1 for non-slip, or any numbers; bool is taken as ``is_slip``.
        penalty: the paper's ``C``, positive and finite; a number or a tensor of one.
        offset: the kernel's ``c``, at least 0; likewise; positive if the primal is to
            have a derivative by it.
        weights: positive weight of each bin; default 1.
        route: ``"auto"``, which is that of ``fit_machine``, or the one to take.

    Shape:
        - z: ``[N, K]``; targets, weights: ``[N]``

    Raises:
        ValueError: if shapes disagree, a value is outside its range or not finite, or the
            condition is above 1e12.

    Example:
        >>> z = torch.tensor([[0.9], [0.2], [-0.7]]).double()
        >>> penalty = torch.tensor(1.0, requires_grad=True)
        >>> machine = fit_quadratic(z, torch.tensor([True, True, False]), penalty)
        >>> (slope,) = torch.autograd.grad(machine(z).square().sum(), penalty)
        >>> bool(slope > 0)  # a larger C follows the targets more closely
        True
    """
    z = z.double()
    if targets.dtype == torch.bool:
        targets = torch.where(targets, 1.0, -1.0)
    targets = targets.to(z)
    c, offset = (torch.as_tensor(x, dtype=z.dtype, device=z.device) for x in (penalty, offset))
    bins = TrainingBins(z.detach(), targets.detach() > 0, weights).double()
    if len(z) == 0 or not 0 < c.item() < math.inf:
        raise ValueError(
            f"a fit to be differentiated needs bins and a positive and finite penalty (the paper's "
            f"C), got {len(z)} bins and C={c.item()}; fit_machine takes an infinite one"
        )
    weights = bins.sample_weight
    is_dual = _goes_dual(bins, c.item(), Polynomial(2, offset.item()), route)
    kernel = Polynomial(2, offset)  # type: ignore[arg-type]  # a tensor, to be derived by
    if is_dual:
        system, right, ridge = kernel(z, z), targets, 1 / (c * weights)
    else:
        if offset.requires_grad and not offset.item() > 0:
            raise ValueError(
                f"through the primal the machine has no derivative by an offset (the paper's c) of "
                f"{offset.item():g}; take a positive one, or route='dual'"
            )

        def normal(z: Tensor, weights: Tensor, offset: Tensor) -> Tensor:
            monomials = Polynomial(2, offset).monomials(z)  # type: ignore[arg-type]
            return monomials.mT @ (monomials * weights[:, None])

        chunks = zip(z.split(_CHUNK_BINS), weights.split(_CHUNK_BINS), strict=True)
        system = torch.stack(
            [checkpoint(normal, *chunk, offset, use_reentrant=False) for chunk in chunks]
        ).sum(0)
        right, ridge = kernel.sum_of_monomials(z, weights * targets), (1 / c).expand(len(system))
    _, report, *_ = solve_symmetric(
        system,
        right,
        c.item(),
        weights if is_dual else None,
        name="gram" if is_dual else "X'WX",
        most_condition=_MOST_CONDITION,
    )
    lower = torch.linalg.cholesky(system + ridge.diag())
    solved = torch.cholesky_solve(right[:, None], lower)[:, 0]
    machine = collapse(z, solved, kernel) if is_dual else kernel.head(solved, z.shape[1])
    machine.solved = report
    return machine


def takes_dual(kernel: Polynomial, num_bins: int, num_features: int) -> bool:
    """Whether the dual is the cheaper route, by the multiply-adds of both.

    At degree 2 a Cholesky factorisation in as many unknowns as bins stands against one in as many
    as monomials and the sums it is made of: for 120 features up to 9800 bins, not just 7381.
    """
    num_monomials = kernel.num_monomials(num_features)
    if kernel.degree == 1:
        return num_bins <= num_monomials
    sums = math.comb(num_features + 4, 4) * num_bins
    return num_bins**3 <= num_monomials**3 + 6 * sums


def check_route(route: str) -> None:
    """Refuse an unknown route.

    Raises:
        ValueError: if it is one.
    """
    if route not in ("auto", "primal", "dual"):
        raise ValueError(f"route must be 'auto', 'primal' or 'dual', got {route!r}")


def _goes_dual(bins: TrainingBins, penalty: float, kernel: Polynomial, route: Route) -> bool:
    """Whether the dual is asked for, cheaper, or needed: sums would lose the lightest bin."""
    check_route(route)
    num_bins, num_features = bins.features.shape
    if route == "dual" or (route == "auto" and takes_dual(kernel, num_bins, num_features)):
        return True
    longest = float(bins.features.square().sum(-1).max()) + kernel.offset
    lightest, heaviest = (float(x) for x in bins.sample_weight.detach().aminmax())
    light, heavy = (weight * longest**kernel.degree for weight in (lightest, heaviest))
    lost = torch.finfo(torch.float64).eps * heavy / (light + 1 / penalty) if penalty > 0 else 0.0
    if not lost > _LARGEST_LOSS:
        return False
    if route == "auto" and num_bins <= _MOST_DUAL:
        return True
    raise ValueError(
        f"weights from {lightest:.1e} to {heaviest:.1e} are too far apart for X'WX: it "
        f"loses {lost:.0e} of the lightest bin to rounding, wanted up to {_LARGEST_LOSS:.0e}; "
        "take the dual, or lower the penalty"
    )


MOST_CONDITION = 1e10  # of all bins; above, the scores of a group left out lose their digits
_LEAST_EIGENVALUE = 1e-6  # of I - H_gg; below, the rounding of the factor shows in the scores
_CHUNK = 256  # bins in whole groups that are treated together, unless one group is larger


class HeldOutFit(NamedTuple):
    """A machine, and what its training bins would score without their groups.

    Attributes:
        head: the machine of all bins.
        scores: ``[N]``, each from the machine without the bin's group.
    """

    head: Head
    scores: Tensor


class HeldOut:
    """Exact leave-one-group-out scores for any number of values of C.

    Through the primal or the dual as ``fit_machine``. The matrix that does not depend on C is kept,
    ``[P, P]`` or ``[N, N]``, and ``at`` takes another one of that size. Beyond the fit it costs
    about one and a half factorisations in the dual. In the primal a bin costs ``P^2 / 2``
    multiply-adds, and a group a factorisation in as many unknowns as it has bins, at most ``P``.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        groups: ``[N]``, whole numbers; bins of one group need not stand together.
        kernel: of the machine.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if shapes disagree, all bins are one group, leaving a group (named)
            out leaves one class.
    """

    def __init__(
        self,
        bins: TrainingBins,
        groups: Tensor,
        kernel: Polynomial = PAPER_KERNEL,
        route: Route = "auto",
    ) -> None:
        check_route(route)
        bins = bins.double()
        _check_groups(groups, bins.is_slip)
        self._order, self._groups = ordered_groups(groups)
        self._kernel, self._z = kernel, bins.features[self._order]
        self._targets, self._weights = bins.targets[self._order], bins.sample_weight[self._order]
        num_bins, num_features = self._z.shape
        self._is_dual = route == "dual"
        if route == "auto":
            self._is_dual = takes_dual(kernel, num_bins, num_features)
        if self._is_dual:
            self._system = gram_matrix(kernel, self._z)
        else:
            self._system = _normal_matrix(kernel, self._z, self._weights)

    def at(self, penalty: float) -> HeldOutFit:
        """The machine and the held-out scores for one value of C.

        The scores are right to 100 eps times the condition of the system of all bins.

        Args:
            penalty: the paper's ``C``, positive and finite.

        Raises:
            ValueError: if the penalty is not that, the condition is above ``MOST_CONDITION``, or
                the machine without a group (named) cannot be told in float64.
        """
        _check_penalty(penalty)
        head, residuals = self._dual(penalty) if self._is_dual else self._primal(penalty)
        scores = torch.empty_like(residuals)
        scores[self._order] = self._targets - residuals
        return HeldOutFit(head, scores)

    def _dual(self, penalty: float) -> tuple[Head, Tensor]:
        beta, report, factor, _ = solve_symmetric(
            self._system,
            self._targets,
            penalty,
            self._weights,
            name="gram",
            most_condition=MOST_CONDITION,
        )
        assert factor is not None  # as most_condition is given
        residuals = torch.empty_like(beta)
        for groups, part in _chunks(self._groups):
            unit = factor.new_zeros(len(beta) - part.start, part.stop - part.start)
            unit.fill_diagonal_(1.0)
            # columns of L^-1 are 0 above their diagonal: the later a group, the cheaper
            columns = torch.linalg.solve_triangular(
                factor[part.start :, part.start :], unit, upper=False
            )
            products = columns.mT @ columns
            for own in groups:
                block = own.within(products, part)
                lower = torch.linalg.cholesky(block)
                residuals[own.rows] = torch.cholesky_solve(beta[own.rows, None], lower)[:, 0]
        head = machine_of(self._z, beta, self._kernel)
        head.solved = report
        return head, residuals

    def _primal(self, penalty: float) -> tuple[Head, Tensor]:
        kernel, weights = self._kernel, self._weights
        moment = kernel.sum_of_monomials(self._z, weights * self._targets)
        num_features = self._z.shape[1]
        head, factor = kernel.solve(self._system, moment, penalty, num_features, MOST_CONDITION)
        assert factor is not None  # as most_condition is given
        residuals = self._targets - head(self._z)
        return head, residuals_without(
            self._groups, kernel, factor, self._z, weights.sqrt(), residuals
        )


def held_out_scores(
    z: Tensor,
    is_slip: Tensor,
    groups: Tensor,
    penalty: Tensor | float,
    offset: Tensor | float = 0.5,
    weights: Tensor | None = None,
) -> Tensor:
    """What each bin scores under the machine of degree 2 without its group, differentiable.

    The scores of ``HeldOut(bins, groups, Polynomial(2, offset), route="dual").at(penalty)``, any
    number of times differentiable in ``z``, ``penalty``, ``offset`` and ``weights``.

    Args:
        z: scaled features of the bins; promoted to float64.
        is_slip: what each bin is.
        groups: whole numbers; bins of one group need not stand together.
        penalty: the paper's ``C``, positive and finite; a number or a tensor of one.
        offset: the kernel's ``c``, at least 0; likewise.
        weights: positive weight of each bin; default 1.

    Shape:
        - z: ``[N, K]``; is_slip, groups, weights, output: ``[N]``

    Raises:
        ValueError: if shapes disagree, a value is outside its range, all bins are one group,
            leaving a group (named) out leaves one class, or the condition of all bins is above
            ``MOST_CONDITION``.

    Example:
        >>> z = torch.tensor([[0.9], [0.8], [-0.7], [-0.6]]).double().requires_grad_()
        >>> is_slip = torch.tensor([True, False, True, False])
        >>> scores = held_out_scores(z, is_slip, torch.tensor([0, 0, 1, 1]), penalty=1.0)
        >>> scores.sum().backward()
        >>> z.grad.shape
        torch.Size([4, 1])
    """
    bins = TrainingBins(z, is_slip, weights).double()
    _check_groups(groups, is_slip)
    order, members = ordered_groups(groups)
    c, offset = (
        torch.as_tensor(x, dtype=torch.float64, device=z.device) for x in (penalty, offset)
    )
    _check_penalty(c.item())
    Polynomial(2, offset.item())  # checks it
    z, targets, sample_weight = bins.features[order], bins.targets[order], bins.sample_weight[order]
    gram = (z @ z.mT + offset).square()
    solve_symmetric(
        gram, targets, c.item(), sample_weight, name="gram", most_condition=MOST_CONDITION
    )
    inverse = torch.linalg.inv(gram + (1 / (c * sample_weight)).diag())
    beta = inverse @ targets
    residuals = [torch.linalg.solve(inverse[own.rows, own.rows], beta[own.rows]) for own in members]
    return (targets - torch.cat(residuals))[order.argsort()]


def residuals_without(
    groups: Sequence[Group],
    kernel: Polynomial,
    factor: Tensor,
    z: Tensor,
    roots: Tensor,
    residuals: Tensor,
) -> Tensor:
    """Residuals of each bin under the machine without its group; a group's monomials are in memory.

    Args:
        groups: ``ordered_groups`` of the bins.
        kernel: of degree 1 or 2.
        factor: the lower Cholesky factor of the normal equations of all bins.
        z: scaled features.
        roots: of the weights.
        residuals: of the machine of all bins.

    Shape:
        - factor: ``[P, P]``; z: ``[N, K]``; roots, residuals, output: ``[N]``

    Raises:
        ValueError: if a group leaves too little.
    """
    found = torch.empty_like(residuals)
    for some, part in _chunks(groups):
        scaled = kernel.monomials(z[part]) * roots[part, None]
        columns = torch.linalg.solve_triangular(factor, scaled.mT, upper=False)
        for own in some:
            # (I - b'b)^-1 right = right + b' (I - b b')^-1 b right: whichever matrix is smaller
            b = columns[:, own.rows.start - part.start : own.rows.stop - part.start]
            is_long = b.shape[1] > b.shape[0]
            hat = b @ b.mT if is_long else b.mT @ b
            lower, info = torch.linalg.cholesky_ex(torch.eye(len(hat)).to(hat) - hat)
            if info or bool((lower.diagonal().square() < _LEAST_EIGENVALUE).any()):
                raise ValueError(
                    f"the machine without group {own.name} is too far from the machine of all bins "
                    "to be told from it in float64; lower the penalty, or refit without the group"
                )
            right = (roots * residuals)[own.rows, None]
            if is_long:
                right = right + b.mT @ torch.cholesky_solve(b @ right, lower)
            else:
                right = torch.cholesky_solve(right, lower)
            found[own.rows] = right[:, 0] / roots[own.rows]
    return found


class Group(NamedTuple):
    """A group, and its rows among ordered bins."""

    name: int
    rows: slice

    def within(self, products: Tensor, part: slice) -> Tensor:
        """Its own block of a matrix over the bins of a part."""
        own = slice(self.rows.start - part.start, self.rows.stop - part.start)
        return products[own, own]


def ordered_groups(groups: Tensor) -> tuple[Tensor, list[Group]]:
    """Which bin comes where when large groups come last, and the groups in that order.

    Shape:
        - groups, order: ``[N]``, whole numbers
    """
    names, member, counts = torch.unique(groups, return_inverse=True, return_counts=True)
    rank = counts.argsort(stable=True)
    order = rank.argsort()[member].argsort(stable=True)
    ends = counts[rank].cumsum(0).tolist()
    slices = map(slice, [0, *ends[:-1]], ends)
    return order, list(map(Group, names[rank].tolist(), slices))


def _chunks(groups: Sequence[Group]) -> Iterator[tuple[list[Group], slice]]:
    """Whole groups and their bins: as many as fit a chunk, at least one."""
    some: list[Group] = []
    for own in groups:
        if some and own.rows.stop - some[0].rows.start > _CHUNK:
            yield some, slice(some[0].rows.start, some[-1].rows.stop)
            some = []
        some.append(own)
    if some:
        yield some, slice(some[0].rows.start, some[-1].rows.stop)


def _check_penalty(penalty: float) -> None:
    """That it is one for which groups can be left out in closed form."""
    if not 0 < penalty < math.inf:
        raise ValueError(
            f"held-out scores in closed form need a positive and finite penalty (the paper's "
            f"C), got {penalty}; refit without each group for another"
        )


def _check_groups(groups: Tensor, is_slip: Tensor) -> None:
    if groups.shape != is_slip.shape or groups.is_floating_point():
        raise ValueError(
            f"expected a whole number for the group of each of {len(is_slip)} bins, got "
            f"{tuple(groups.shape)} {groups.dtype}"
        )
    names = groups.unique()
    if len(names) < 2:
        raise ValueError(
            f"held-out scores need at least two groups, all {len(is_slip)} bins are in "
            f"{names.tolist()}"
        )
    for kind, own in (("slip", is_slip), ("non-slip", ~is_slip)):
        having = groups[own].unique()
        if len(having) < 2:
            name = int(having[0] if len(having) else names[0])
            raise ValueError(
                f"without group {name} no {kind} bin is left to train on; take smaller groups, or "
                "other bins"
            )
