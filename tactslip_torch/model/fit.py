"""The kernel machine fitted to training bins in closed form, and held-out scores without refitting.

On targets of +-1 the kernel extreme learning machine (paper section IV-E) is kernel ridge
regression with ``alpha = 1 / C``. Two routes to the same machine: *dual*, one unknown per training
bin, and *primal*, one unknown per monomial of the features. Either is solved by Cholesky or, close
to singular, by the pseudo-inverse.

Reference:
    Huang, Zhou, Ding and Zhang (2012), IEEE Trans. SMC-B 42(2), 513-529, kernel form; Higham
    (2002), Accuracy and Stability of Numerical Algorithms, 2nd ed., sections 10.1 (what counts is
    the condition of the matrix scaled to a diagonal of ones) and 15.3 (its estimate, LAPACK's
    ``dpocon``); Golub and Van Loan, Matrix Computations, 4th ed., section 5.5 (rank).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Polynomial,
    QuadraticForm,
    SolveReport,
    collapse,
)

log = logging.getLogger(__name__)

Route = Literal["auto", "primal", "dual"]
MOST_CONDITION = 1e10
"""Of all bins; above it scores of a group left out lose their digits."""
_MOST_CHOLESKY = 1e12  # condition of what Cholesky may solve
_LARGEST_ERROR = 1e-2  # of a solution that is handed out
_UNREPORTED_ERROR = 1e-3  # of a least-squares solution; a larger one is logged
_EPS, _TINY = torch.finfo(torch.float64).eps, torch.finfo(torch.float64).tiny
_GRAM_ROWS = 512
_LEAST_EIGENVALUE = 1e-6  # of I - H_gg; below, the rounding of the factor shows in the scores
_CHUNK = 256  # bins in whole groups that are treated together, unless one group is larger

# Solve -------------------------------------------------------------------------------------------


class _Solution(NamedTuple):
    """Of a system.

    Attributes:
        x: ``[n]``, float64.
        report: on the solve.
        factor: ``[n, n]``, float64, the lower Cholesky factor of ``A + diag(1 / (C w))``; ``None``
            if the method was another.
    """

    x: Tensor
    report: SolveReport
    factor: Tensor | None


def _solve_symmetric(
    matrix: Tensor,
    right: Tensor,
    penalty: float,
    weights: Tensor | None = None,
    *,
    name: str = "matrix",
    in_span: bool = False,
    most_condition: float | None = None,
) -> _Solution:
    """``(matrix + diag(1 / (penalty weights)))^-1 right`` in float64, and a report.

    By Cholesky where the condition allows it. Closer to singular, eigenvalues of
    ``sqrt(w) matrix sqrt(w)`` up to ``n eps`` of the largest count as null, which is
    ``torch.linalg.pinv(hermitian=True)`` with a ridge: an infinite C gives the minimum-norm
    (weighted) least-squares solution. Not differentiable.

    Args:
        matrix: symmetric, positive semi-definite; kept.
        right: kept.
        penalty: the paper's ``C``, positive; ``inf`` for minimum-norm (weighted) least squares.
        weights: positive weight of each unknown; default 1.
        name: of the matrix, for errors.
        in_span: the right-hand side lies in the span of the matrix, as that of normal equations.
        most_condition: raise an error instead of leaving Cholesky, or above this condition.

    Shape:
        - matrix: ``[n, n]``, float64; right, weights: ``[n]``

    Raises:
        ValueError: for another dtype, if a number is not finite, the matrix is not positive
            semi-definite, its rounding drowns the solution, or the pseudo-inverse is needed and not
            allowed.

    Example:
        >>> twice = torch.ones(2, 2, dtype=torch.float64)  # one bin, twice
        >>> x, report, _ = _solve_symmetric(twice, twice[0], penalty=1e30)
        >>> x, report.method, report.rank
        (tensor([0.5000, 0.5000], dtype=torch.float64), 'pinv', 1)
    """
    if matrix.dtype != torch.float64:
        raise ValueError(f"expected {name} in float64, got {matrix.dtype}; promote it first")
    matrix, right = matrix.detach(), right.detach().double()
    weights = torch.ones_like(right) if weights is None else weights.detach().double()
    ridge = 1 / (penalty * weights)
    if not (penalty > 0 and bool(ridge.isfinite().all())):
        raise ValueError(
            f"penalty (the paper's C) must be positive, and so large that 1 / (C w) is finite, "
            f"got {penalty}"
        )
    system = matrix.clone()
    system.diagonal().add_(ridge)
    diagonal = system.diagonal().clone()
    scale = torch.where(diagonal > 0, diagonal, 1.0).sqrt()
    system.div_(scale).div_(scale[:, None])
    norm = float(torch.linalg.matrix_norm(system, 1))
    if not (math.isfinite(norm) and bool(right.isfinite().all())):
        _check_finite(matrix, right, name)
        raise ValueError(f"{name} overflows float64; scale the features")
    size, factor = len(right), system.mT  # column-major, so that LAPACK works within the copy
    info = torch.empty((), dtype=torch.int32, device=matrix.device)
    torch.linalg.cholesky_ex(factor, out=(factor, info))
    condition = math.inf if info else _condition(factor, norm)
    most = min(_MOST_CHOLESKY, 1 / (size * _EPS), most_condition or math.inf)
    if condition <= most:
        factor.mul_(scale[:, None])
        x = torch.cholesky_solve(right[:, None], factor)[:, 0]
        error = math.sqrt(size) * _EPS * condition
        report = SolveReport("cholesky", size, penalty, condition, size, error)
        return _Solution(_finite(x, name), report, factor)
    reason = f"{name} + I/C at penalty={penalty:g} has condition {condition:.1e}"
    if most_condition is not None:
        raise ValueError(f"{reason}, wanted up to {most_condition:.0e}; lower the penalty")
    del system, factor
    x, report = _pseudo_inverse(matrix, right, penalty, weights.sqrt(), in_span, name)
    if not math.isinf(penalty) or report.error > _UNREPORTED_ERROR:
        log.warning("%s, too much for Cholesky: solved by %s", reason, report)
    return _Solution(_finite(x, name), report, None)


def _pseudo_inverse(
    matrix: Tensor, right: Tensor, penalty: float, roots: Tensor, in_span: bool, name: str
) -> tuple[Tensor, SolveReport]:
    """The solution on what is above rounding; ``roots`` are of the weights.

    Raises:
        ValueError: if the matrix is not positive semi-definite, or its rounding drowns what is
            kept.
    """
    values, vectors = torch.linalg.eigh(roots * matrix * roots[:, None])
    top, low, num, ridge = float(values[-1]), float(values[0]), len(values), 1 / penalty
    cutoff = num * _EPS * top
    if low < -max(10 * cutoff, 0.0):
        raise ValueError(
            f"{name} is not positive semi-definite: it has the eigenvalue {low:.3g} beside "
            f"{top:.3g}; it must be a sum of squares"
        )
    kept = values > cutoff
    along = vectors.mT @ (roots * right)
    solved = torch.where(kept, along / (values + ridge), 0.0)
    least = float(values[kept][0]) + ridge if bool(kept.any()) else math.inf
    condition = (top + ridge) / least
    error = math.sqrt(num) * _EPS * max(top, -low) / least
    if error > _LARGEST_ERROR:
        raise ValueError(
            f"{name} at penalty={penalty:g} has rank {int(kept.sum())} of {num} and a condition of "
            f"{condition:.1e}, too much for its rounding ({error:.0e} of the scores); lower the "
            "penalty, or leave out what is nearly duplicate"
        )
    lost = float(torch.linalg.vector_norm(along[~kept]))
    scores = values.clamp(min=0).sqrt() * solved if in_span else along
    most = 2 * math.sqrt(ridge) if in_span else 1.0  # sqrt(v) / (v + ridge) is largest at the ridge
    if lost > 0:  # a v up to the cutoff adds v / (v + ridge) of what lies along it
        left_out = lost / max(most * float(torch.linalg.vector_norm(scores)), _TINY)
        error = max(error, min(left_out, 1.0))
    report = SolveReport("pinv", num, penalty, condition, int(kept.sum()), error)
    return roots * (vectors @ solved), report


def _condition(factor: Tensor, norm: float) -> float:
    """Estimate from a lower Cholesky factor, column-major, and the 1-norm of the matrix."""
    from scipy.linalg.lapack import dpocon  # as long to import as a fifth of torch

    reciprocal, _ = dpocon(factor.cpu().numpy(), norm, uplo="L")
    return 1 / reciprocal if reciprocal > 0 else math.inf


def _check_finite(matrix: Tensor, right: Tensor, name: str) -> None:
    """Name the first number that is not."""
    for what, values in ((name, matrix), (f"right-hand side of {name}", right)):
        if not bool(values.isfinite().all()):
            place = (~values.isfinite()).nonzero()[0].tolist()
            raise ValueError(
                f"{what} must be finite, got {float(values[tuple(place)])} at {place}; leave out "
                "or mask the bin it comes from"
            )


def _finite(x: Tensor, name: str) -> Tensor:
    """A solution as it is handed out: refused where it overflows float64."""
    if not bool(x.isfinite().all()):
        worst = float(x[~x.isfinite()][0])
        raise ValueError(
            f"the solution for {name} leaves float64: an entry is {worst:.3g}; scale the features "
            "or the penalty"
        )
    return x


def check_weights(weights: Tensor) -> None:
    """Refuse weights of bins that are not positive and finite.

    Raises:
        ValueError: if there is one.
    """
    if len(wrong := (~((weights > 0) & weights.isfinite())).nonzero()):
        place = int(wrong[0])
        raise ValueError(
            f"weights must be positive and finite, got {float(weights[place]):g} at bin {place}"
        )


def solve_normal_equations(
    normal: Tensor,
    moment: Tensor,
    penalty: float,
    kernel: Polynomial,
    num_features: int,
    most_condition: float | None = None,
) -> tuple[QuadraticForm, Tensor | None]:
    """The machine of normal equations in the monomials, and their Cholesky factor.

    Args:
        normal: ``X' W X``.
        moment: ``X' W t``.
        penalty: the paper's ``C``.
        kernel: of the machine.
        num_features: ``K``.
        most_condition: as ``_solve_symmetric``, like the errors and the factor.

    Shape:
        - normal: ``[P, P]``; moment: ``[P]``
    """
    x, report, factor = _solve_symmetric(
        normal, moment, penalty, name="X'WX", in_span=True, most_condition=most_condition
    )
    head = kernel.head(x, num_features)
    head.solved = report
    return head, factor


# Fit ---------------------------------------------------------------------------------------------


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
) -> QuadraticForm:
    """Solve the kernel machine, and fold it into its quadratic form.

    The primal takes two matrices of monomials by monomials (7381 for 120 features) whatever the
    number of bins; the dual takes two of bins by bins. ``solved`` of the machine says how it went.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        penalty: the paper's ``C``; ``inf`` for the pseudo-inverse.
        kernel: of the machine.
        route: ``"auto"`` for the cheaper, or the one to take.

    Raises:
        ValueError: if there is no bin, a number is not finite, or as ``_solve_symmetric``.
    """
    if len(bins.features) == 0:
        raise ValueError("a machine needs training bins, got none; add bins of both classes")
    bins = bins.double()
    z, num_features = bins.features, bins.features.shape[1]
    if not _is_dual(route, kernel, *z.shape):
        normal = kernel.sums(z, bins.sample_weight)
        moment = kernel.sum_of_monomials(z, bins.sample_weight * bins.targets)
        return solve_normal_equations(normal, moment, penalty, kernel, num_features)[0]
    gram = _gram_matrix(kernel, z)
    beta, report, _ = _solve_symmetric(gram, bins.targets, penalty, bins.weights, name="gram")
    head = collapse(z, beta, kernel)
    head.solved = report
    return head


def _is_dual(route: Route, kernel: Polynomial, num_bins: int, num_features: int) -> bool:
    """Whether the dual is asked for, or the cheaper route by the multiply-adds of both.

    At degree 2 a Cholesky factorisation in as many unknowns as bins stands against one in as many
    as monomials and the sums it is made of: for 120 features up to 9800 bins, not just 7381.

    Raises:
        ValueError: for an unknown route.
    """
    if route not in ("auto", "primal", "dual"):
        raise ValueError(f"route must be 'auto', 'primal' or 'dual', got {route!r}")
    num_monomials = kernel.num_monomials(num_features)
    sums = math.comb(num_features + 4, 4) * num_bins if kernel.degree == 2 else 0
    return route == "dual" or (route == "auto" and num_bins**3 <= num_monomials**3 + 6 * sums)


def _gram_matrix(kernel: Polynomial, z: Tensor) -> Tensor:
    """``kernel(z, z)``, not differentiable, in the memory of the result: ``[N, K] -> [N, N]``."""
    gram = z.new_empty(len(z), len(z))
    with torch.no_grad():
        for rows, some in zip(gram.split(_GRAM_ROWS), z.split(_GRAM_ROWS), strict=True):
            rows.copy_(kernel(some, z))
    return gram


# Held out ----------------------------------------------------------------------------------------
#
# What each training bin would score had its whole group been left out, without refitting. With
# G = K + diag(1 / (C w)) and beta = G^-1 t the residuals of a group under the machine without it
# are e_g = ((G^-1)_gg)^-1 beta_g; in the primal e_g = (I - H_gg)^-1 (t - Phi v)_g with the hat
# matrix H = Phi A^-1 Phi' W. One Cholesky factor serves all groups. Rasmussen and Williams,
# Gaussian Processes for Machine Learning, section 5.4.2; for blocks An, Liu and Venkatesh (2007),
# Pattern Recognition 40(8), 2154-2162.


class HeldOut:
    """Exact leave-one-group-out scores for any number of values of C.

    The matrix that does not depend on C is kept, ``[P, P]`` or ``[N, N]``, and ``at`` takes another
    one of that size. Beyond the fit it costs about one and a half factorisations in the dual. In
    the primal a bin costs ``P^2 / 2`` multiply-adds, and a group a factorisation in as many
    unknowns as it has bins, at most ``P``.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        groups: ``[N]``, whole numbers; bins of one group need not stand together.
        kernel: of the machine.
        route: as ``fit_machine``.

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
        bins = bins.double()
        self._order, self._groups = _in_groups(groups, bins.is_slip)
        self._kernel, self._z = kernel, bins.features[self._order]
        self._targets, self._weights = bins.targets[self._order], bins.sample_weight[self._order]
        self._is_dual = _is_dual(route, kernel, *self._z.shape)
        if self._is_dual:
            self._system = _gram_matrix(kernel, self._z)
        else:
            self._system = kernel.sums(self._z, self._weights)

    def at(self, penalty: float) -> Tensor:
        """The held-out scores for one value of C.

        They are right to 100 eps times the condition of the system of all bins.

        Args:
            penalty: the paper's ``C``, positive and finite.

        Shape:
            - output: ``[N]``, each from the machine without the bin's group

        Raises:
            ValueError: if the penalty is not that, the condition is above ``MOST_CONDITION``, or
                the machine without a group (named) cannot be told in float64.
        """
        _check_penalty(penalty)
        residuals = self._dual(penalty) if self._is_dual else self._primal(penalty)
        scores = torch.empty_like(residuals)
        scores[self._order] = self._targets - residuals
        return scores

    def _dual(self, penalty: float) -> Tensor:
        beta, _, factor = _solve_symmetric(
            self._system, self._targets, penalty, self._weights, name="gram",
            most_condition=MOST_CONDITION,
        )  # fmt: skip
        assert factor is not None  # as most_condition is given
        residuals = torch.empty_like(beta)
        for groups, part in _chunks(self._groups):
            unit = factor.new_zeros(len(beta) - part.start, part.stop - part.start)
            unit.fill_diagonal_(1.0)
            # columns of L^-1 are 0 above their diagonal: the later a group, the cheaper
            columns = torch.linalg.solve_triangular(
                factor[part.start :, part.start :], unit, upper=False
            )
            inverse = columns.mT @ columns
            for _, own in groups:
                within = slice(own.start - part.start, own.stop - part.start)
                lower = torch.linalg.cholesky(inverse[within, within])
                residuals[own] = torch.cholesky_solve(beta[own, None], lower)[:, 0]
        return residuals

    def _primal(self, penalty: float) -> Tensor:
        kernel, z, roots = self._kernel, self._z, self._weights.sqrt()
        moment = kernel.sum_of_monomials(z, self._weights * self._targets)
        head, factor = solve_normal_equations(
            self._system, moment, penalty, kernel, z.shape[1], MOST_CONDITION
        )
        assert factor is not None  # as most_condition is given
        errors = self._targets - head(z)
        residuals = torch.empty_like(errors)
        for groups, part in _chunks(self._groups):
            scaled = kernel.monomials(z[part]) * roots[part, None]
            columns = torch.linalg.solve_triangular(factor, scaled.mT, upper=False)
            for name, own in groups:
                # (I - b'b)^-1 right = right + b' (I - b b')^-1 b right: the smaller matrix of both
                b = columns[:, own.start - part.start : own.stop - part.start]
                is_long = b.shape[1] > b.shape[0]
                hat = b @ b.mT if is_long else b.mT @ b
                lower, info = torch.linalg.cholesky_ex(torch.eye(len(hat)).to(hat) - hat)
                if info or bool((lower.diagonal().square() < _LEAST_EIGENVALUE).any()):
                    raise ValueError(
                        f"the machine without group {name} is too far from the machine of all bins "
                        "to be told from it in float64; lower the penalty, or refit without the "
                        "group"
                    )
                right = (roots * errors)[own, None]
                if is_long:
                    right = right + b.mT @ torch.cholesky_solve(b @ right, lower)
                else:
                    right = torch.cholesky_solve(right, lower)
                residuals[own] = right[:, 0] / roots[own]
        return residuals


_Group = tuple[int, slice]  # its name, and its rows among ordered bins


def _in_groups(groups: Tensor, is_slip: Tensor) -> tuple[Tensor, list[_Group]]:
    """Which bin comes where when large groups come last, ``[N]``, and the groups in that order.

    Raises:
        ValueError: if there is one group, or without one of them a class has no bin.
    """
    if groups.shape != is_slip.shape or groups.is_floating_point():
        raise ValueError(
            f"expected a whole number for the group of each of {len(is_slip)} bins, got "
            f"{tuple(groups.shape)} {groups.dtype}"
        )
    names, member, counts = torch.unique(groups, return_inverse=True, return_counts=True)
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
    rank = counts.argsort(stable=True)
    order = rank.argsort()[member].argsort(stable=True)
    ends = counts[rank].cumsum(0).tolist()
    rows = map(slice, [0, *ends[:-1]], ends)
    return order, list(zip(names[rank].tolist(), rows, strict=True))


def _chunks(groups: Sequence[_Group]) -> Iterator[tuple[list[_Group], slice]]:
    """Whole groups and their bins: as many as fit a chunk, at least one."""
    some: list[_Group] = []
    for name, rows in groups:
        if some and rows.stop - some[0][1].start > _CHUNK:
            yield some, slice(some[0][1].start, some[-1][1].stop)
            some = []
        some.append((name, rows))
    yield some, slice(some[0][1].start, some[-1][1].stop)


def _check_penalty(penalty: float) -> None:
    """That it is one for which groups can be left out in closed form."""
    if not 0 < penalty < math.inf:
        raise ValueError(
            f"a closed form needs a positive and finite penalty (the paper's C), got {penalty}; "
            "fit_machine takes an infinite one"
        )


# Derivatives -------------------------------------------------------------------------------------


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
    order, members = _in_groups(groups, is_slip)
    c, offset = (
        torch.as_tensor(x, dtype=torch.float64, device=z.device) for x in (penalty, offset)
    )
    _check_penalty(c.item())
    Polynomial(2, offset.item())  # checks it
    z, targets, sample_weight = bins.features[order], bins.targets[order], bins.sample_weight[order]
    gram = (z @ z.mT + offset).square()
    _solve_symmetric(
        gram, targets, c.item(), sample_weight, name="gram", most_condition=MOST_CONDITION
    )
    inverse = torch.linalg.inv(gram + (1 / (c * sample_weight)).diag())
    beta = inverse @ targets
    residuals = [torch.linalg.solve(inverse[own, own], beta[own]) for _, own in members]
    return (targets - torch.cat(residuals))[order.argsort()]
