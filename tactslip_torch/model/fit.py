"""Fitting the machine to training bins: balance, C, and the solve (REFERENCE.md section 5)."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from tactslip_torch.model.fourth_moments import ProductSums, add_products_, normal_matrix
from tactslip_torch.model.kernel_elm import (
    solve_kernel_elm,
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

log = logging.getLogger(__name__)

Balance = Literal["undersample", "weights"]
Route = Literal["auto", "primal", "dual"]
Progress = Callable[[Iterable[int], str], Iterable[int]]
"""Wraps a range so that its progress shows; gets the range and what is being done."""

CHUNK_BINS = 2048


@dataclass(frozen=True)
class TrainingBins:
    """Scaled training bins of the machine, in float64.

    Args:
        features: ``[N, K]`` in [-1, 1].
        is_slip: ``[N]``, bool.
        weights: ``[N]``, positive, or ``None`` for 1 each.

    Raises:
        ValueError: if shapes disagree or a weight is not positive.
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
        if self.weights is not None and not bool((self.weights > 0).all()):
            raise ValueError(f"weights must be positive, got {float(self.weights.min()):g}")

    @property
    def targets(self) -> Tensor:
        """+1 for slip, -1 for non-slip, ``[N]``."""
        return torch.where(self.is_slip, 1.0, -1.0).to(self.features)


def balanced_choice(
    is_slip: Tensor, balance: Balance, generator: torch.Generator, most: int | None = None
) -> tuple[Tensor, Tensor | None]:
    """Which bins to train on, and with what weight.

    ``undersample`` (the authors') draws as many bins of the larger class as the smaller one has;
    ``weights`` (Zong et al. 2013) keeps all and gives each class the same total weight.

    Args:
        is_slip: ``[N]``, bool.
        balance: how the classes are balanced.
        generator: of the draw.
        most: keep at most so many bins, drawn at random within the classes.

    Shape:
        - output: indices ``[M]``, ascending, and weights ``[M]`` (float64) or ``None``

    Raises:
        ValueError: if a class is absent (named) or the balance is unknown.
    """
    members = [(is_slip == value).nonzero().squeeze(-1) for value in (False, True)]
    for name, own in zip(("non-slip", "slip"), members, strict=True):
        if not len(own):
            raise ValueError(f"training needs bins of both classes, got no {name} bin")
    if balance == "undersample":
        smaller = min(len(own) for own in members)
        counts = [smaller, smaller]
    elif balance == "weights":
        counts = [len(own) for own in members]
    else:
        raise ValueError(f"balance must be 'undersample' or 'weights', got {balance!r}")
    if most is not None and sum(counts) > most:
        counts = [max(1, count * most // sum(counts)) for count in counts]
    drawn = [
        own[torch.randperm(len(own), generator=generator)[:count]]
        for own, count in zip(members, counts, strict=True)
    ]
    index = torch.cat(drawn).sort().values
    if balance == "undersample":
        return index, None
    share = torch.tensor([len(index) / (2 * count) for count in counts], dtype=torch.float64)
    return index, share[is_slip[index].long()]


def fit_machine(
    bins: TrainingBins,
    penalty: float,
    kernel: Kernel = PAPER_KERNEL,
    progress: Progress | None = None,
    route: Route = "auto",
) -> QuadraticForm | KernelSum:
    """Solve the kernel machine, and fold it into its quadratic form where the kernel folds.

    Through the primal when there are more bins than monomials (7381 for 120 features at degree 2,
    121 at degree 1), through the dual otherwise and for every kernel that does not fold; both give
    the same machine. The primal takes one matrix of monomials by monomials whatever the number of
    bins; the dual takes one of bins by bins.

    Args:
        bins: scaled training bins in float64.
        penalty: the paper's ``C``; ``inf`` for the pseudo-inverse.
        kernel: of the machine.
        progress: shows the progress of the primal's accumulation.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if the system is not positive definite, or the primal is asked of a kernel
            that does not fold.
    """
    if route not in ("auto", "primal", "dual"):
        raise ValueError(f"route must be 'auto', 'primal' or 'dual', got {route!r}")
    num_bins, num_features = bins.features.shape
    if isinstance(kernel, Polynomial) and kernel.collapses:
        linear = kernel.degree == 1
        num_monomials = num_features + 1 if linear else num_quadratic_features(num_features)
        if route == "primal" or (route == "auto" and num_bins > num_monomials):
            solve = _solve_linear_primal if linear else _solve_quadratic_primal
            return solve(bins, penalty, kernel.offset, progress)
    elif route == "primal":
        raise ValueError(f"{kernel} has no primal of fixed size; take route='dual' or 'auto'")
    gram = lower_gram(kernel, bins.features)
    beta = solve_kernel_elm_(gram, bins.targets, penalty, bins.weights)
    if kernel.collapses:
        return collapse(bins.features, beta, kernel)
    machine = KernelSum(bins.features, beta, kernel)
    log.info(machine.cost_note)
    return machine


def validation_scores(
    train: TrainingBins,
    held_out: TrainingBins,
    penalties: Sequence[float],
    offset: float = 0.5,
) -> list[float]:
    """Balanced accuracy on held-out bins for every penalty, from one kernel matrix.

    Raises:
        ValueError: if a class is absent from the held-out bins, or a solve fails.
    """
    kernel = Polynomial(2, offset)
    gram = kernel(train.features, train.features)
    across = kernel(held_out.features, train.features)
    is_slip = held_out.is_slip
    if bool(is_slip.all()) or not bool(is_slip.any()):
        raise ValueError("a validation fold needs held-out bins of both classes")
    scores = []
    for penalty in penalties:
        beta = solve_kernel_elm(gram, train.targets, penalty, train.weights)
        says_slip = across @ beta >= 0
        recalls = (says_slip[is_slip].double().mean(), (~says_slip[~is_slip]).double().mean())
        scores.append(float(sum(recalls) / 2))
    return scores


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
    solved = solve_normal_equations_(normal, moment, penalty)
    flat = solved.new_zeros(num_features, num_features)
    return QuadraticForm(flat, solved[:-1], math.sqrt(offset) * solved[-1])


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
    return from_primal(solve_normal_equations_(normal, moment, penalty), num_features, offset)


def _chunks(bins: TrainingBins, progress: Progress | None) -> Iterator[slice]:
    starts: Iterable[int] = range(0, len(bins.features), CHUNK_BINS)
    for start in starts if progress is None else progress(starts, "normal equations"):
        yield slice(start, start + CHUNK_BINS)
