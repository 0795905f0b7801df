"""Fitting the machine to training bins: balance, C, and the solve (REFERENCE.md section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from tactslip_torch.model.kernel_elm import (
    polynomial_kernel,
    solve_kernel_elm,
    solve_normal_equations,
)
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    collapse,
    from_primal,
    num_quadratic_features,
    quadratic_features,
)

Balance = Literal["undersample", "weights"]
Progress = Callable[[Iterable[int], str], Iterable[int]]
"""Wraps a range so that its progress shows; gets the range and what is being done."""

CHUNK_BINS = 2048
BLOCK_FEATURES = 1024


@dataclass(frozen=True)
class TrainingBins:
    """Scaled training bins of the machine, in float64.

    Args:
        features: ``[N, K]`` in [-1, 1].
        is_slip: ``[N]``, bool.
        weights: ``[N]``, positive, or ``None`` for 1 each.
    """

    features: Tensor
    is_slip: Tensor
    weights: Tensor | None = None

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
    offset: float = 0.5,
    progress: Progress | None = None,
) -> QuadraticForm:
    """Solve the degree-2 kernel machine and fold it into its quadratic form.

    Through the primal when there are more bins than monomials (7381 for 120 features), through the
    dual otherwise; both give the same machine.

    Args:
        bins: scaled training bins in float64.
        penalty: the paper's ``C``; ``inf`` for the pseudo-inverse.
        offset: the paper's ``c``.
        progress: shows the progress of the primal's accumulation.

    Raises:
        ValueError: if the system is not positive definite.
    """
    num_bins, num_features = bins.features.shape
    if num_bins > num_quadratic_features(num_features):
        weights = _solve_primal_in_chunks(bins, penalty, offset, progress)
        return from_primal(weights, num_features, offset)
    gram = polynomial_kernel(bins.features, bins.features, offset=offset)
    beta = solve_kernel_elm(gram, bins.targets, penalty, bins.weights)
    return collapse(bins.features, beta, Polynomial(2, offset))


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
    gram = polynomial_kernel(train.features, train.features, offset=offset)
    across = polynomial_kernel(held_out.features, train.features, offset=offset)
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


def _solve_primal_in_chunks(
    bins: TrainingBins, penalty: float, offset: float, progress: Progress | None
) -> Tensor:
    """``solve_primal`` on ``quadratic_features``, never holding them all; lower triangle only."""
    num_bins, num_features = bins.features.shape
    size = num_quadratic_features(num_features)
    normal = bins.features.new_zeros(size, size)
    moment = bins.features.new_zeros(size)
    starts: Iterable[int] = range(0, num_bins, CHUNK_BINS)
    for start in starts if progress is None else progress(starts, "normal equations"):
        chunk = slice(start, start + CHUNK_BINS)
        monomials = quadratic_features(bins.features[chunk], offset)
        weighted = monomials
        if bins.weights is not None:
            weighted = monomials * bins.weights[chunk, None]
        moment += weighted.mT @ bins.targets[chunk]
        for top in range(0, size, BLOCK_FEATURES):
            end = min(top + BLOCK_FEATURES, size)
            normal[top:end, :end].addmm_(weighted[:, top:end].mT, monomials[:, :end])
    if math.isinf(penalty):  # the pseudo-inverse reads both triangles
        normal = normal.tril() + normal.tril(-1).mT
    return solve_normal_equations(normal, moment, penalty)
