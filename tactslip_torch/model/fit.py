"""Fitting the machine to training bins by the cheaper route (REFERENCE.md section 5)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import from_above
from tactslip_torch.model.fourth_moments import ProductSums, add_products_, normal_matrix
from tactslip_torch.model.kernel_elm import (
    check_weights,
    solve_kernel_elm_,
    solve_normal_equations_,
)
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, lower_gram
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    collapse,
    from_primal,
    num_quadratic_features,
    sum_of_quadratic_features,
)
from tactslip_torch.model.truncation import LARGEST_LOSS, lost_in_sums

log = logging.getLogger(__name__)

Route = Literal["auto", "primal", "dual"]
Progress = Callable[[Iterable[int], str], Iterable[int]]
"""Wraps a range so that its progress shows; gets the range and what is being done."""

CHUNK_BINS = 2048
MOST_QUADRATIC = 1000
_MOST_DUAL = 16_384  # bins whose Gram matrix (2 GiB) is worth keeping the light ones


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

    def double(self) -> TrainingBins:
        """The same bins in float64."""
        weights = None if self.weights is None else self.weights.double()
        return TrainingBins(self.features.double(), self.is_slip, weights)


def fit_machine(
    bins: TrainingBins,
    penalty: float,
    kernel: Kernel = PAPER_KERNEL,
    progress: Progress | None = None,
    route: Route = "auto",
) -> QuadraticForm | KernelSum:
    """Solve the kernel machine, and fold it into its quadratic form where the kernel folds.

    Through the primal or the dual, whichever ``takes_dual`` finds cheaper; both give the same
    machine. The primal takes one matrix of monomials by monomials (7381 for 120 features) whatever
    the number of bins; the dual takes one of bins by bins. In float64, and however close to
    singular (``symmetric_solve``); ``solved`` of the machine says how it went. Weights so far apart
    that sums of the primal would lose the lightest bin take the dual up to 16384 bins.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        penalty: the paper's ``C``; ``inf`` for the pseudo-inverse.
        kernel: of the machine.
        progress: shows the progress of the primal's accumulation.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if a number is not finite, the primal is asked of a kernel that does not fold,
            or it would lose the lightest bin to rounding.
    """
    if route not in ("auto", "primal", "dual"):
        raise ValueError(f"route must be 'auto', 'primal' or 'dual', got {route!r}")
    if len(bins.features) == 0:
        raise ValueError("a machine needs training bins, got none; add bins of both classes")
    bins = bins.double()
    if isinstance(kernel, Polynomial) and kernel.collapses:
        if not goes_dual(bins, penalty, kernel, route):
            solve = _solve_linear_primal if kernel.degree == 1 else _solve_quadratic_primal
            return solve(bins, penalty, kernel.offset, progress)
    elif route == "primal":
        raise ValueError(f"{kernel} has no primal of fixed size; take route='dual' or 'auto'")
    gram = lower_gram(kernel, bins.features)
    beta, report = solve_kernel_elm_(
        gram,
        bins.targets,
        penalty,
        bins.weights,
        restore=lambda spoilt: lower_gram(kernel, bins.features, spoilt),
    )
    machine = machine_of(bins.features, beta, kernel)
    if isinstance(machine, KernelSum):
        log.info(machine.cost_note)
    machine.solved = report
    return machine


def machine_of(support: Tensor, beta: Tensor, kernel: Kernel) -> QuadraticForm | KernelSum:
    """A kernel sum, folded where its kernel folds and that makes it smaller.

    A quadratic form has a number for each pair of features: of more than ``MOST_QUADRATIC``
    features and fewer bins than that, the sum over bins is the smaller one.

    Shape:
        - support: ``[N, K]``; beta: ``[N]``
    """
    is_wide = support.shape[1] > max(MOST_QUADRATIC, len(support))
    is_quadratic = isinstance(kernel, Polynomial) and kernel.degree == 2
    if kernel.collapses and not (is_wide and is_quadratic):
        return collapse(support, beta, kernel)
    return KernelSum(support, beta, kernel)


def takes_dual(kernel: Kernel, num_bins: int, num_features: int) -> bool:
    """Whether the dual is the cheaper route, by the multiply-adds of both; the only one for some.

    At degree 2 a Cholesky factorisation in as many unknowns as bins stands against one in as many
    as monomials and the sums it is made of: for 120 features up to 9800 bins, not just 7381.
    """
    if not isinstance(kernel, Polynomial) or not kernel.collapses:
        return True
    if kernel.degree == 1:
        return num_bins <= num_features + 1
    sums = math.comb(num_features + 4, 4) * num_bins
    return num_bins**3 <= num_quadratic_features(num_features) ** 3 + 6 * sums


def goes_dual(bins: TrainingBins, penalty: float, kernel: Polynomial, route: Route) -> bool:
    """Whether the dual is asked for, cheaper, or needed: sums would lose the lightest bin."""
    num_bins, num_features = bins.features.shape
    if route == "dual" or (route == "auto" and takes_dual(kernel, num_bins, num_features)):
        return True
    if bins.weights is None or not penalty > 0:
        return False
    longest = float(bins.features.square().sum(-1).max())
    spread = bins.weights, penalty, (longest + kernel.offset) ** kernel.degree
    if route == "auto" and num_bins <= _MOST_DUAL and lost_in_sums(*spread) > LARGEST_LOSS:
        return True
    _check_spread(*spread)
    return False


def _check_spread(weights: Tensor, penalty: float, square: float) -> None:
    """Refuse weights of which more than ``LARGEST_LOSS`` is lost."""
    lost = lost_in_sums(weights, penalty, square)
    if lost > LARGEST_LOSS:
        raise ValueError(
            f"weights from {float(weights.min()):.1e} to {float(weights.max()):.1e} are too far "
            f"apart for X'WX: it loses {lost:.0e} of the lightest bin to rounding, wanted up to "
            f"{LARGEST_LOSS:.0e}; take the dual, or lower the penalty"
        )


def _solve_linear_primal(
    bins: TrainingBins, penalty: float, offset: float, progress: Progress | None
) -> QuadraticForm:
    """Degree 1: one unknown per feature, and one for the constant."""
    num_features = bins.features.shape[1]
    normal = bins.features.new_zeros(num_features + 1, num_features + 1)
    moment = bins.features.new_zeros(num_features + 1)
    for chunk in _chunks(bins, progress):
        z = bins.features[chunk]
        x = torch.cat([z, torch.full_like(z[:, :1], math.sqrt(offset))], dim=-1)
        weighted = x if bins.weights is None else x * bins.weights[chunk, None]
        normal.addmm_(weighted.mT, x)
        moment.addmv_(weighted.mT, bins.targets[chunk])
    solved, report = solve_normal_equations_(normal, moment, penalty, restore=from_above)
    machine = QuadraticForm(solved.new_zeros(0, 0), solved[:-1], math.sqrt(offset) * solved[-1])
    machine.solved = report
    return machine


def _solve_quadratic_primal(
    bins: TrainingBins, penalty: float, offset: float, progress: Progress | None
) -> QuadraticForm:
    """Degree 2: one unknown per monomial, from sums of fixed size."""
    num_features = bins.features.shape[1]
    total = bins.features.new_zeros(ProductSums(num_features).num_held)
    pull = bins.targets if bins.weights is None else bins.targets * bins.weights
    for chunk in _chunks(bins, progress):
        weights = None if bins.weights is None else bins.weights[chunk]
        add_products_(total, bins.features[chunk], weights)
    normal = normal_matrix(total, num_features, offset)
    moment = sum_of_quadratic_features(bins.features, pull, offset)
    del total
    weights, report = solve_normal_equations_(normal, moment, penalty, restore=from_above)
    machine = from_primal(weights, num_features, offset)
    machine.solved = report
    return machine


def _chunks(bins: TrainingBins, progress: Progress | None) -> Iterator[slice]:
    starts: Iterable[int] = range(0, len(bins.features), CHUNK_BINS)
    for start in starts if progress is None else progress(starts, "normal equations"):
        yield slice(start, start + CHUNK_BINS)
