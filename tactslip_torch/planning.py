"""From a first pass to a plan: features, scaling, K, c and C.

All is chosen from what the first pass learned of the training bins. Pure of any engine.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Kernel, Polynomial, kernel_from_dict
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.model_selection import candidates, choose_model, fitted_frame
from tactslip_torch.recipe import (
    Frame,
    Recipe,
    choose_frame,
    kept_shares,
    sample_groups,
    scene_weights,
    stand_for,
)
from tactslip_torch.validation import Progress as Progress
from tactslip_torch.validation import validate

log = logging.getLogger(__name__)

MOST_GAUSSIAN = 256
"""So many features at most have the expected score where channels are missing: its matrices are of
their number squared."""
MOST_KEPT_BINS = 8192
"""So many bins at most for a kernel that does not fold: its machine is a matrix of bins by bins."""


@dataclass(frozen=True)
class Plan:
    """What is decided before the second pass.

    Args:
        frame: which features, how scaled.
        kernel: of the machine.
        penalty: the paper's ``C``.
        balance: how the classes are balanced.
        shares: of non-slip and slip bins that are trained on.
        stands_for: how many bins each of those stands for, as in validation.
        num_bins: how many bins are trained on; about, where shares are below 1.
        typical: mean of the scaled features, both classes counting alike; it stands in where a
            sensor is missing.
        validation: one row per choice: what was chosen from, the balanced accuracy of each
            held-out group, and the calibration of held-out scores.
        among: of a recipe that restricts the ranking: to what, how many features that leaves
            (``matching``), and the numbers chosen from after cutting them to it; else ``None``.
        abstain: thresholds for unsure answers, as ``Abstention.to_dict`` has them, if set.
        gaussians: of the scaled features, for sensors that are missing; of a kernel that folds and
            at most ``MOST_GAUSSIAN`` features of channels.
        nested: balanced accuracy of the whole choice on groups that it did not see, if it was
            judged.
        scene_weights: weight of a bin by scene, non-slip and slip, balance among it; empty if
            scenes are not weighed.
        drop_channels: the largest part of channels left out of second copies of recordings.
    """

    frame: Frame
    kernel: Kernel
    penalty: float
    balance: str
    shares: tuple[float, float]
    stands_for: float
    num_bins: int
    typical: tuple[float, ...]
    validation: list[dict[str, Any]] = field(default_factory=list)
    among: dict[str, Any] | None = None
    abstain: dict[str, Any] | None = None
    gaussians: ClassGaussians | None = None
    nested: dict[str, Any] | None = None
    scene_weights: dict[str, tuple[float, float]] = field(default_factory=dict)
    drop_channels: float = 0.0

    @property
    def adds_up(self) -> bool:
        """Whether training bins become sums of fixed size; few bins, or other kernels, do not."""
        if not isinstance(self.kernel, Polynomial) or not self.kernel.collapses:
            return False
        return self.num_bins > self.kernel.num_monomials(self.frame.size)

    @property
    def calibration(self) -> dict[str, Any] | None:
        """By held-out scores of the choice that was taken; None if there was nothing to choose."""
        chosen = (self.frame.size, self.kernel.to_dict(), self.penalty)
        for row in self.validation:
            same = (row["num_features"], row["kernel"], row["penalty"]) == chosen
            if row.get("chosen", same and "use" not in row):
                return cast("dict[str, Any] | None", row.get("calibration"))
        return None

    def facts(self) -> dict[str, Any]:
        """JSON-able; ``Plan.of`` takes it together with the scaler and the Gaussians."""
        return {
            "selected": list(self.frame.selected),
            "kernel": self.kernel.to_dict(),
            "penalty": _json_number(self.penalty),
            "balance": self.balance,
            "shares": list(self.shares),
            "stands_for": self.stands_for,
            "num_bins": self.num_bins,
            "typical": list(self.typical),
            "validation": self.validation,
            "among": self.among,
            "abstain": self.abstain,
            "nested": self.nested,
            "scene_weights": self.scene_weights,
            "drop_channels": self.drop_channels,
        }

    def tensors(self) -> dict[str, Tensor]:
        """What ``facts`` leaves out: the scaler, and the Gaussians among it."""
        of_features = {} if self.gaussians is None else self.gaussians.tensors()
        return dict(self.frame.scaler.state_dict()) | of_features

    @classmethod
    def of(
        cls,
        facts: Mapping[str, Any],
        scaler: FeatureScaler,
        gaussians: ClassGaussians | None = None,
        pooling: ChannelPooling | None = None,
    ) -> Plan:
        """The plan that ``facts`` described."""
        return cls(
            frame=Frame(tuple(facts["selected"]), scaler, pooling),
            kernel=kernel_from_dict(facts["kernel"]),
            penalty=float(facts["penalty"]),
            balance=facts["balance"],
            shares=(facts["shares"][0], facts["shares"][1]),
            stands_for=facts["stands_for"],
            num_bins=facts["num_bins"],
            typical=tuple(facts["typical"]),
            validation=list(facts["validation"]),
            among=facts.get("among"),  # older plans know no such restriction
            abstain=facts.get("abstain"),  # nor unsure answers
            gaussians=gaussians,
            nested=facts.get("nested"),
            scene_weights={k: (v[0], v[1]) for k, v in facts.get("scene_weights", {}).items()},
            drop_channels=facts.get("drop_channels", 0.0),
        )


def plan_detector(
    recipe: Recipe,
    survey: Survey,
    progress: Progress,
    frame: Frame | None = None,
    allowed: Tensor | None = None,
    *,
    pool: FeaturePool | None = None,
    is_settled: bool = False,
    is_nested: bool = True,
) -> Plan:
    """Choose the features and the machine by validation on held-out groups.

    A recipe with ``validation="nested"`` chooses by ``model_selection`` and needs the ``pool``;
    ``is_nested=False`` does not evaluate the choice itself. For other recipes: rank, scale, and
    choose K, c and C by closed-form validation. Features that were ranked and scaled elsewhere come
    as a ``frame``; which ones may be selected here, for a recipe that restricts them, as
    ``allowed``, what ``recipe.allowed`` says.

    Of a recipe that leaves no choice nothing is validated, unless it ``is_settled``, by tuning:
    then held-out scores are wanted for what follows from them, such as a calibration.

    A held-out score is that of the machine refitted without the bin's group, from one
    factorisation per choice (``HeldOut``), with ranking and scaling held. So it chooses,
    but it is not what may be reported: for that, ranking and scaling are redone (``crossval``).

    Raises:
        ValueError: if a class is absent or a solve fails.
    """
    if recipe.validation == "nested" and frame is None:
        if pool is None:
            raise ValueError("recipe.validation=nested needs the pool; hand it over as pool=")
        return _plan_nested(recipe, survey, progress, pool, allowed, is_nested=is_nested)
    frame = frame or choose_frame(recipe, survey, allowed)
    sizes = sorted({min(size, frame.size) for size in recipe.sizes})
    if sizes[-1] < recipe.sizes[-1]:
        log.warning(
            "recipe.num_features=%d is cut to %d: no more match", recipe.sizes[-1], sizes[-1]
        )
    sample = survey.sample.bins()
    counts = survey.moments.count.tolist()
    weights = stand_for(sample, recipe, counts)
    choices = [
        (size, kernel, penalty)
        for size in sizes
        for kernel in recipe.kernels
        for penalty in recipe.penalties_ascending
    ]
    rows: list[dict[str, Any]] = []
    if (len(choices) > 1 or is_settled) and len(sample.group_names) > 1:
        bins = TrainingBins(frame(sample.features), sample.is_slip, weights)
        rows = validate(bins, sample.group, sample.group_names, choices, progress)
        best = max(row["mean"] for row in rows)
        place = next(i for i, row in enumerate(rows) if row["mean"] == best)
    else:
        num = len(recipe.penalties_ascending)  # of the most features and the last kernel
        place = len(choices) - num + num // 2
        if len(choices) > 1:
            log.warning("K=%d, %s, C=%g are taken unvalidated: one group", *choices[place])
    size, kernel, penalty = choices[place]
    shares = kept_shares(recipe, counts)
    num_bins = sum(count * share for count, share in zip(counts, shares, strict=True))
    stands_for = 1.0
    if num_bins > MOST_KEPT_BINS and not kernel.collapses:
        log.warning(
            "%s takes %d of %d training bins: its machine does not fold to a fixed size",
            kernel,
            MOST_KEPT_BINS,
            num_bins,
        )
        stands_for = num_bins / MOST_KEPT_BINS
        shares = [share / stands_for for share in shares]
        num_bins = MOST_KEPT_BINS
    frame = frame.first(size)
    z = frame(sample.features)
    has_gaussians = kernel.collapses and frame.pooling is None
    return Plan(
        frame=frame,
        kernel=kernel,
        penalty=penalty,
        balance=recipe.balance,
        shares=(shares[0], shares[1]),
        stands_for=stands_for,
        num_bins=round(num_bins),
        typical=_typical(z, sample.is_slip, weights),
        validation=rows,
        among=None if allowed is None else _narrowed(recipe, allowed, sizes),
        gaussians=ClassGaussians.fit(z, sample.is_slip, weights) if has_gaussians else None,
        drop_channels=0.0 if frame.pooling is None else recipe.drop_channels,
    )


def _plan_nested(
    recipe: Recipe,
    survey: Survey,
    progress: Progress,
    pool: FeaturePool,
    allowed: Tensor | None,
    *,
    is_nested: bool,
) -> Plan:
    """``plan_detector`` by nested validation."""
    sample = survey.sample.bins()
    counts = survey.moments.count.tolist()
    weights = stand_for(sample, recipe, counts)
    shares = kept_shares(recipe, counts)
    num_bins = round(sum(count * share for count, share in zip(counts, shares, strict=True)))
    structures = candidates(recipe, num_bins)
    rows: list[dict[str, Any]] = []
    nested = None
    structure = structures[0]
    penalty = recipe.penalties_ascending[len(recipe.penalties_ascending) // 2]
    if len(sample_groups(sample)[1]) > 1:
        options: dict[str, Any] = {"num_bins": num_bins, "allowed": allowed, "is_nested": is_nested}
        choice = choose_model(recipe, pool, sample, weights, progress, **options)
        structure, penalty = choice.structure, choice.penalty
        rows, nested = choice.rows, choice.nested
        if choice.edge:
            log.warning("%s", choice.edge)
    else:
        log.warning("%s, C=%g are taken unvalidated: one group", structure, penalty)
    frame = fitted_frame(recipe, pool, sample, structure, allowed)
    z = frame(sample.features)
    has_gaussians = frame.pooling is None and frame.size <= MOST_GAUSSIAN
    return Plan(
        frame=frame,
        kernel=structure.kernel,
        penalty=penalty,
        balance=recipe.balance,
        shares=(shares[0], shares[1]),
        stands_for=1.0,
        num_bins=num_bins,
        typical=_typical(z, sample.is_slip, weights),
        validation=rows,
        among=None if recipe.among is None or allowed is None else _narrowed(recipe, allowed, []),
        gaussians=ClassGaussians.fit(z, sample.is_slip, weights) if has_gaussians else None,
        nested=nested,
        scene_weights=scene_weights(recipe, sample) if recipe.scene_weights else {},
        drop_channels=recipe.drop_channels if frame.pooling is not None else 0.0,
    )


def _narrowed(recipe: Recipe, allowed: Tensor, sizes: Sequence[int]) -> dict[str, Any]:
    matching = int(allowed.sum())
    return {"wanted": recipe.facts()["among"], "matching": matching, "num_features": list(sizes)}


def _typical(scaled: Tensor, is_slip: Tensor, weights: Tensor) -> tuple[float, ...]:
    """Mean of scaled features ``[N, K]``, both classes counting alike; K numbers."""
    means = [weights[mine] @ scaled[mine] / weights[mine].sum() for mine in (is_slip, ~is_slip)]
    return tuple(((means[0] + means[1]) / 2).tolist())


def adds_up(kernel: Kernel) -> bool:
    """Whether training bins add up to sums of fixed size, as they do for degree 2."""
    return isinstance(kernel, Polynomial) and kernel.degree == 2


def _json_number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf"  # JSON has no infinity
