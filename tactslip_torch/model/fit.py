"""Fitting the machine to training bins by the cheaper route (REFERENCE.md section 5).

On targets of +-1 the kernel extreme learning machine (paper section IV-E) is kernel ridge
regression with ``alpha = 1 / C``. Two routes to the same machine: dual, one unknown per training
bin, and primal, one unknown per monomial of the features.
"""

from __future__ import annotations

import functools
import logging
import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Head,
    Kernel,
    Polynomial,
    QuadraticForm,
    collapse,
    gram_matrix,
    machine_of,
    stated,
)
from tactslip_torch.model.moments import ProductSums
from tactslip_torch.model.solve import check_weights, solve_by_autograd, solve_symmetric

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
    bins: TrainingBins, penalty: float, kernel: Kernel = PAPER_KERNEL, route: Route = "auto"
) -> Head:
    """Solve the kernel machine, and fold it into its quadratic form where the kernel folds.

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
        ValueError: if a number is not finite, the primal is asked of a kernel that does not fold,
            or it would lose the lightest bin to rounding.
    """
    if len(bins.features) == 0:
        raise ValueError("a machine needs training bins, got none; add bins of both classes")
    bins = bins.double()
    if not _goes_dual(bins, penalty, kernel, route):
        assert isinstance(kernel, Polynomial)
        layout = ProductSums(bins.features.shape[1], kernel.degree)
        total = bins.features.new_zeros(layout.num_held)
        layout.add_(total, bins.features, bins.sample_weight)
        normal = layout.normal_matrix(total, kernel.offset)
        moment = kernel.sum_of_monomials(bins.features, bins.sample_weight * bins.targets)
        return kernel.solve(normal, moment, penalty, bins.features.shape[1])[0]
    gram = gram_matrix(kernel, bins.features)
    solution = solve_symmetric(gram, bins.targets, penalty, bins.weights, name="gram")
    make = functools.partial(machine_of, bins.features, kernel=kernel)
    machine = make(solution.x)
    if isinstance(kernel, Polynomial) and isinstance(machine, QuadraticForm):
        num_monomials = kernel.num_monomials(bins.features.shape[1])
        machine.solved = stated(machine, solution, make, num_monomials)
    else:
        machine.solved = solution.report
        log.info(
            "%s does not fold into a quadratic form: all %d training bins are kept, %s",
            kernel,
            len(bins.features),
            machine.cost,
        )
    return machine


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
    solved = solve_by_autograd(system + ridge.diag(), right)
    machine = collapse(z, solved, kernel) if is_dual else kernel.head(solved, z.shape[1])
    machine.solved = report
    return machine


def takes_dual(kernel: Kernel, num_bins: int, num_features: int) -> bool:
    """Whether the dual is the cheaper route, by the multiply-adds of both; the only one for some.

    At degree 2 a Cholesky factorisation in as many unknowns as bins stands against one in as many
    as monomials and the sums it is made of: for 120 features up to 9800 bins, not just 7381.
    """
    if not isinstance(kernel, Polynomial) or not kernel.collapses:
        return True
    num_monomials = kernel.num_monomials(num_features)
    if kernel.degree == 1:
        return num_bins <= num_monomials
    sums = math.comb(num_features + 4, 4) * num_bins
    return num_bins**3 <= num_monomials**3 + 6 * sums


def check_route(route: str, kernel: Kernel) -> None:
    """Refuse an unknown route, and the primal of a kernel that does not fold.

    Raises:
        ValueError: if it is one.
    """
    if route not in ("auto", "primal", "dual"):
        raise ValueError(f"route must be 'auto', 'primal' or 'dual', got {route!r}")
    if route == "primal" and not kernel.collapses:
        raise ValueError(f"{kernel} has no primal of fixed size; take route='dual' or 'auto'")


def _goes_dual(bins: TrainingBins, penalty: float, kernel: Kernel, route: Route) -> bool:
    """Whether the dual is asked for, cheaper, or needed: sums would lose the lightest bin."""
    check_route(route, kernel)
    num_bins, num_features = bins.features.shape
    if route == "dual" or (route == "auto" and takes_dual(kernel, num_bins, num_features)):
        return True
    assert isinstance(kernel, Polynomial)
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
