"""How a detector is made of bins: rank, choose C on held-out groups, scale, balance, solve.

Pure of any engine: ``learning`` runs it under Lightning, anything else may call it as well. The
bins that come in are training bins; what is held out of training never gets here.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.selection import (
    ClassMoments,
    ScoreVariance,
    rank_features,
    t_scores,
)
from tactslip_torch.model.fit import (
    Balance,
    Progress,
    TrainingBins,
    balanced_choice,
    fit_machine,
    validation_scores,
)
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.scaling import MinMaxScaler
from tactslip_torch.model.threshold import FeatureThreshold, best_threshold

log = logging.getLogger(__name__)

GroupBy = Literal["material", "cycle"]
CYCLE_GROUPS = 5


@dataclass(frozen=True)
class Recipe:
    """How the machine is made; defaults are the paper's where it states one.

    Args:
        num_features: how many features are selected.
        score_variance: of the t-test, ``"pooled"`` or ``"welch"``.
        offset: the kernel's ``c``.
        penalties: values of ``C`` to choose from; a single one is taken as it is.
        balance: ``"undersample"`` (authors) or ``"weights"`` (ours).
        group_by: what a validation fold leaves out: a ``"material"`` or a fifth of the
            ``"cycle"`` numbers (ours; the authors' search is not described).
        fold_bins: at most so many training and so many held-out bins a fold.
        seed: of undersampling.

    Raises:
        ValueError: for an unknown name or a number that is not positive.
    """

    num_features: int = 120
    score_variance: ScoreVariance = "pooled"
    offset: float = 0.5
    penalties: Sequence[float] = (0.05, 0.08, 0.1, 0.13, 0.17, 0.2, 0.25, 0.3, 1.0, 3.0)
    balance: Balance = "undersample"
    group_by: GroupBy = "material"
    fold_bins: int = 3000
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "penalties", tuple(float(p) for p in self.penalties))
        choices = {
            "score_variance": ("pooled", "welch"),
            "balance": ("undersample", "weights"),
            "group_by": ("material", "cycle"),
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise ValueError(
                    f"detector.{name} must be one of {', '.join(known)}, "
                    f"got {getattr(self, name)!r}"
                )
        if self.num_features < 1 or self.fold_bins < 2:
            raise ValueError(
                "detector.num_features must be at least 1 and detector.fold_bins at least 2, got "
                f"{self.num_features} and {self.fold_bins}"
            )
        if not self.penalties or any(not penalty > 0 for penalty in self.penalties):
            raise ValueError(f"detector.penalties must be positive, got {list(self.penalties)}")
        if self.offset < 0:
            raise ValueError(f"detector.offset must not be negative, got {self.offset}")

    def group(self, recording: RecordingId) -> str:
        """The validation group of a recording."""
        if self.group_by == "material":
            return recording.material
        return str(recording.cycle % CYCLE_GROUPS)


class GroupedMoments:
    """Class moments of every feature, one set per validation group.

    Args:
        recipe: how groups and rankings are made.
        num_features: size of the pool.
    """

    def __init__(self, recipe: Recipe, num_features: int) -> None:
        self.recipe = recipe
        self.num_features = num_features
        self.groups: dict[str, ClassMoments] = {}

    def update(self, recording: RecordingId, features: Tensor, is_slip: Tensor) -> None:
        """Add training bins of a recording, ``[N, F]`` and ``[N]``."""
        group = self.recipe.group(recording)
        self.groups.setdefault(group, ClassMoments(self.num_features)).update(features, is_slip)

    def folds(self) -> list[str]:
        """Groups that validation leaves out one at a time; none if there is nothing to choose."""
        if len(self.recipe.penalties) == 1 or len(self.groups) < 2:
            return []
        return sorted(self.groups)

    def ranking(self, without: str | None = None) -> list[int]:
        """Pool indices of the selected features, best first, ranked without one group.

        Raises:
            ValueError: if a class is absent or the pool is smaller than the selection.
        """
        parts = [self.groups[group] for group in sorted(self.groups) if group != without]
        scores = t_scores(ClassMoments.merged(parts), self.recipe.score_variance)
        return [int(i) for i in rank_features(scores, self.recipe.num_features)]

    def columns(self) -> list[int]:
        """Every feature that the final ranking or that of a fold selects, ascending."""
        wanted = set(self.ranking())
        for fold in self.folds():
            wanted |= set(self.ranking(without=fold))
        return sorted(wanted)


@dataclass(frozen=True)
class CollectedBins:
    """The second pass's harvest: training bins of all recordings.

    Args:
        features: ``[N, len(columns)]``, float64, unscaled.
        is_slip: ``[N]``, bool.
        group: ``[N]``, index into ``group_names``.
        group_names: of the validation groups.
        columns: pool index of each column.
    """

    features: Tensor
    is_slip: Tensor
    group: Tensor
    group_names: tuple[str, ...]
    columns: tuple[int, ...]

    @classmethod
    def of(
        cls,
        recipe: Recipe,
        columns: Sequence[int],
        parts: Sequence[tuple[RecordingId, Tensor, Tensor]],
    ) -> CollectedBins:
        """Put recordings together in the order of their ids, whichever came first."""
        parts = sorted(parts, key=lambda part: part[0])
        groups = [recipe.group(recording) for recording, _, _ in parts]
        names = tuple(sorted(set(groups)))
        index = torch.tensor([names.index(group) for group in groups])
        lengths = torch.tensor([len(features) for _, features, _ in parts])
        return cls(
            features=torch.cat([features for _, features, _ in parts]).double(),
            is_slip=torch.cat([is_slip for _, _, is_slip in parts]),
            group=index.repeat_interleave(lengths),
            group_names=names,
            columns=tuple(columns),
        )

    def of_features(self, selected: Sequence[int]) -> Tensor:
        """The columns of the given pool indices, in their order, ``[N, len(selected)]``."""
        place = {column: position for position, column in enumerate(self.columns)}
        return self.features[:, [place[index] for index in selected]]


@dataclass(frozen=True)
class Fitted:
    """What ``fit_detector`` found.

    Args:
        selected: pool indices, best first.
        scaler: of the selected features.
        head: the machine.
        threshold: the best single selected feature, a rival to be reported beside.
        facts: JSON-able: penalty, validation, number of training bins.
        seconds: time by stage.
    """

    selected: list[int]
    scaler: MinMaxScaler
    head: QuadraticForm
    threshold: FeatureThreshold
    facts: dict[str, Any]
    seconds: dict[str, float]


def fit_detector(
    recipe: Recipe, moments: GroupedMoments, bins: CollectedBins, progress: Progress
) -> Fitted:
    """Choose C on held-out groups, then rank, scale, balance and solve on all training bins.

    Raises:
        ValueError: if a class is absent or a solve fails.
    """
    started = time.perf_counter()
    validation = validate(recipe, moments, bins, progress)
    penalty = chosen_penalty(recipe, validation)
    validated = time.perf_counter()
    selected = moments.ranking()
    features = bins.of_features(selected)
    scaler = MinMaxScaler.fit(features)
    index, weights = _draw(recipe, bins.is_slip, "fit")
    training = TrainingBins(scaler(features[index]), bins.is_slip[index], weights)
    head = fit_machine(training, penalty, Polynomial(2, recipe.offset), progress)
    seconds = {"validation": validated - started, "solve": time.perf_counter() - validated}
    facts = {
        "penalty": penalty if math.isfinite(penalty) else "inf",  # JSON has no infinity
        "offset": recipe.offset,
        "num_training_bins": len(index),
        "validation": {
            "group_by": recipe.group_by,
            "penalties": [p if math.isfinite(p) else "inf" for p in recipe.penalties],
            "balanced_accuracy": validation,
        },
    }
    threshold = best_threshold(features[index], bins.is_slip[index])
    return Fitted(selected, scaler, head, threshold, facts, seconds)


def validate(
    recipe: Recipe, moments: GroupedMoments, bins: CollectedBins, progress: Progress
) -> dict[str, list[float]]:
    """Balanced accuracy of every penalty on every group, by machines that never met the group.

    Ranking, scaling and fit are redone without it. Empty where there is nothing to choose.
    """
    results: dict[str, list[float]] = {}
    folds = moments.folds()
    for number in progress(range(len(folds)), "choose C on held-out groups") if folds else []:
        fold = folds[number]
        is_held_out = bins.group == bins.group_names.index(fold)
        features = bins.of_features(moments.ranking(without=fold))
        scaler = MinMaxScaler.fit(features[~is_held_out])
        sides = []
        for side, mask in (("train", ~is_held_out), ("held out", is_held_out)):
            rows = mask.nonzero().squeeze(-1)
            purpose = f"{fold} {side}"
            index, weights = _draw(recipe, bins.is_slip[rows], purpose, recipe.fold_bins)
            rows = rows[index]
            sides.append(TrainingBins(scaler(features[rows]), bins.is_slip[rows], weights))
        results[fold] = validation_scores(sides[0], sides[1], recipe.penalties, recipe.offset)
    return results


def chosen_penalty(recipe: Recipe, validation: dict[str, list[float]]) -> float:
    """The penalty of the best mean over folds; the smallest of equals."""
    penalties = list(recipe.penalties)
    if not validation:
        penalty = sorted(penalties)[len(penalties) // 2]
        if len(penalties) > 1:
            log.warning("C=%g is taken unvalidated: the training set is one group", penalty)
        return penalty
    means = [sum(column) / len(column) for column in zip(*validation.values(), strict=True)]
    best = max(means)
    return min(p for p, mean in zip(penalties, means, strict=True) if mean == best)


def _draw(
    recipe: Recipe, is_slip: Tensor, purpose: str, most: int | None = None
) -> tuple[Tensor, Tensor | None]:
    seed = recipe.seed * 1_000_003 + sum(purpose.encode())
    generator = torch.Generator().manual_seed(seed)
    return balanced_choice(is_slip, recipe.balance, generator, most)
