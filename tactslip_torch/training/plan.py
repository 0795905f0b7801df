"""A plan: what is decided before the second pass, and the machine that its training bins make.

``plan_detector`` decides from the statistics of the first pass; ``TrainingPass`` gathers the bins
of the second in any order and solves; ``Abstaining`` sets the thresholds for abstaining.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.bin_sample import SampledBins, bin_keys
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.model.abstention import Abstention, check_coverage
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Head, Kernel, Polynomial, kernel_from_dict
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import SeenBatches, content_digest
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.recipe import (
    FeatureSelection,
    Recipe,
    class_fractions,
    number_of_bins,
    sample_groups,
    sample_weight,
    scene_weights,
    select_features,
)
from tactslip_torch.training.selection import (
    candidates,
    choose_held,
    choose_model,
    fitted_selection,
)

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
        recipe: that it follows.
        selection: which features, how scaled.
        kernel: of the machine.
        penalty: the paper's ``C``.
        fractions: the part of non-slip and slip bins that is trained on.
        bin_weight: of each of those, as one of several of which it alone is kept.
        num_bins: how many bins are trained on; about, where fractions are below 1.
        imputation: mean of the scaled features, both classes counting alike; for channels that are
            missing.
        gaussians: of the scaled features, for channels that are missing; of a kernel that folds.
        validation: one row per choice: what was chosen from, the balanced accuracy of each
            held-out group; of the one that was taken also ``chosen``, and the calibration of its
            held-out scores.
        nested: balanced accuracy of the whole choice on groups that it did not see, if it was
            evaluated.
        feature_filter: of a recipe that restricts the ranking: to what, how many features that
            leaves (``matching``), and the numbers chosen from after cutting them to it.
        abstain: thresholds for abstaining, as ``Abstention.to_dict`` has them, if set.
        scene_weights: weight of a bin by scene, non-slip and slip, classes balanced; empty if
            scenes are not weighed.
    """

    recipe: Recipe
    selection: FeatureSelection
    kernel: Kernel
    penalty: float
    fractions: tuple[float, float]
    bin_weight: float
    num_bins: int
    imputation: Tensor
    gaussians: ClassGaussians | None = None
    validation: list[dict[str, Any]] = field(default_factory=list)
    nested: dict[str, Any] | None = None
    feature_filter: dict[str, Any] | None = None
    abstain: dict[str, Any] | None = None
    scene_weights: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def adds_up(self) -> bool:
        """Whether training bins become sums of fixed size; few bins, or other kernels, do not."""
        if not isinstance(self.kernel, Polynomial) or not self.kernel.collapses:
            return False
        return self.num_bins > self.kernel.num_monomials(self.selection.size)

    @property
    def calibration(self) -> dict[str, Any] | None:
        """By held-out scores of the choice that was taken; None if there was nothing to choose."""
        chosen = (row.get("calibration") for row in self.validation if row.get("chosen"))
        return next(chosen, None)

    @property
    def metadata(self) -> dict[str, Any]:
        """What was decided, for files, JSON-able."""
        return {
            "recipe": self.recipe.name,
            "kernel": self.kernel.to_dict(),
            "penalty": self.penalty if math.isfinite(self.penalty) else "inf",  # JSON has none
            "balance": self.recipe.balance,
            "num_bins": self.num_bins,
        }

    def training_bins(self, sample: SampledBins) -> TrainingBins:
        """Sampled bins, scaled, each with the weight of all that it was drawn from."""
        weights = sample_weight(self.recipe, sample)
        return TrainingBins(self.selection(sample.features), sample.is_slip, weights)

    def detector(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        head: Head,
        info: Mapping[str, Any],
        backend: BackendName = "auto",
    ) -> SlipDetector:
        """The detector of this plan with a machine that was solved for it."""
        selection = self.selection
        return SlipDetector(
            pool,
            channel_filter,
            selection.selected,
            selection.scaler,
            head,
            info,
            self.imputation,
            self.gaussians,
            selection.pooling,
            backend=backend,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values and tensors, for a checkpoint; without the recipe."""
        plain = {k: v for k, v in vars(self).items() if k not in ("recipe", "selection")}
        pooling = self.selection.pooling
        return plain | {
            "selected": self.selection.selected,
            "scaler": dict(self.selection.scaler.state_dict()),
            "pooling": pooling and (pooling.to_dict(), dict(pooling.state_dict())),
            "kernel": self.kernel.to_dict(),
            "gaussians": self.gaussians and dict(self.gaussians.state_dict()),
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any], recipe: Recipe, pool: FeaturePool) -> Plan:
        """What ``to_dict`` described, of the same recipe and pool."""
        values = dict(plain)
        selected, scaler = values.pop("selected"), FeatureScaler(**values.pop("scaler"))
        pooling = values.pop("pooling")
        pooling = pooling and ChannelPooling.from_dict(pool.hand, *pooling)
        values["kernel"] = kernel_from_dict(values["kernel"])
        values["gaussians"] = values["gaussians"] and ClassGaussians(**values["gaussians"])
        return cls(recipe, FeatureSelection(tuple(selected), scaler, pooling), **values)


def plan_detector(
    recipe: Recipe,
    statistics: TrainingStatistics,
    pool: FeaturePool | None = None,
    selection: FeatureSelection | None = None,
    *,
    is_settled: bool = False,
    is_nested: bool = True,
    show: bool = False,
) -> Plan:
    """Choose the features and the machine by validation on held-out groups.

    Of a recipe that leaves no choice nothing is validated, unless it ``is_settled``, by tuning:
    then held-out scores are wanted for what follows from them, such as a calibration.

    Args:
        recipe: what to choose from, and how.
        statistics: statistics of the training bins.
        pool: of the features; only without it may every feature be selected whatever its name.
        selection: features that were ranked and scaled elsewhere.
        is_settled: whether to validate a single choice too.
        is_nested: whether to evaluate a nested choice itself.
        show: a progress bar.

    Raises:
        ValueError: if a class is absent, a solve fails, or the recipe needs the pool.
    """
    sample = statistics.sample.bins()
    allowed = None if pool is None else recipe.allowed(pool)
    fractions, bin_weight = class_fractions(recipe, sample), 1.0
    num_bins = number_of_bins(recipe, sample)
    nested, most_gaussian = None, math.inf
    if recipe.validation == "nested" and selection is None:
        if pool is None:
            raise ValueError("recipe.validation=nested needs the pool; hand it over as pool=")
        most_gaussian = MOST_GAUSSIAN
        if len(sample_groups(sample)[1]) > 1:
            choice = choose_model(recipe, pool, sample, is_nested=is_nested, show=show)
            structure, penalty = choice.structure, choice.penalty
            rows, nested = choice.rows, choice.nested
            if choice.edge:
                log.warning("%s", choice.edge)
        else:
            penalties = recipe.penalties_ascending
            structure, penalty = candidates(recipe, num_bins)[0], penalties[len(penalties) // 2]
            rows = []
            log.warning("%s, C=%g are taken unvalidated: one group", structure, penalty)
        kernel: Kernel = structure.kernel
        selection = fitted_selection(recipe, pool, sample, structure)
    else:
        selection = selection or select_features(recipe, statistics, allowed)
        rows, size, kernel, penalty = choose_held(
            recipe, selection, sample, is_settled=is_settled, show=show
        )
        selection = selection.first(size)
    if num_bins > MOST_KEPT_BINS and not kernel.collapses:
        log.warning(
            "%s takes %d of %d training bins: its machine does not fold to a fixed size",
            kernel,
            MOST_KEPT_BINS,
            num_bins,
        )
        bin_weight, num_bins = num_bins / MOST_KEPT_BINS, MOST_KEPT_BINS
        fractions = fractions[0] / bin_weight, fractions[1] / bin_weight
    z, weights = selection(sample.features), sample_weight(recipe, sample)
    means = [
        weights[own] @ z[own] / weights[own].sum() for own in (sample.is_slip, ~sample.is_slip)
    ]
    gaussians = None
    if kernel.collapses and selection.pooling is None and selection.size <= most_gaussian:
        gaussians = ClassGaussians.fit(z, sample.is_slip, weights)
    feature_filter = None
    if recipe.feature_filter is not None and allowed is not None:
        matching = int(allowed.sum())
        feature_filter = {
            "wanted": {name: list(values) for name, values in recipe.feature_filter.items()},
            "matching": matching,
            "num_features": sorted({min(size, matching) for size in recipe.sizes}),
        }
    return Plan(
        recipe=recipe,
        selection=selection,
        kernel=kernel,
        penalty=penalty,
        fractions=fractions,
        bin_weight=bin_weight,
        num_bins=num_bins,
        imputation=(means[0] + means[1]) / 2,
        gaussians=gaussians,
        validation=rows,
        nested=nested,
        feature_filter=feature_filter,
        scene_weights=scene_weights(recipe, sample) if recipe.scene_weights else {},
    )


# The second pass ---------------------------------------------------------------------------------


class TrainingPass:
    """What a plan needs of the training bins, gathered recording by recording.

    Sums of fixed size for polynomial kernels and many bins; the bins themselves where they are few
    or the kernel is another.

    Args:
        plan: what was decided.

    Attributes:
        seen_batches: recordings that are in, where bins themselves are kept.
        bins: of each recording columns ``[N, K]``, labels and weights ``[N]``.
        stats: the sums; None where bins themselves are kept.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.seen_batches = SeenBatches()
        self.bins: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        self.stats: SufficientStats | None = None
        if plan.adds_up:
            assert isinstance(plan.kernel, Polynomial)
            self.stats = SufficientStats(plan.selection.size, degree=plan.kernel.degree)

    def update(
        self, recording: str, features: Tensor, is_slip: Tensor, scene: str = PAPER_SCENE
    ) -> None:
        """Add the training bins of a recording, ``[N, F]`` and ``[N]``.

        With ``recipe.drop_channels`` they come twice, without some channels the second time, each
        copy counting half.

        Raises:
            ValueError: if the recording is there already.
        """
        plan = self.plan
        kept = _is_kept(recording, is_slip, plan.fractions)
        features, is_slip = features[kept], is_slip[kept].bool()
        z, pooling = plan.selection(features), plan.selection.pooling
        of_class = torch.tensor(plan.scene_weights.get(scene, (1.0, 1.0)), dtype=torch.float64)
        weights = plan.bin_weight * of_class[is_slip.long()]
        if plan.recipe.drop_channels > 0 and pooling is not None:
            is_missing = _dropped(recording, len(pooling.hand), plan.recipe.drop_channels)
            fewer = plan.selection(features, is_missing.expand(len(z), -1))
            z, is_slip, weights = torch.cat([z, fewer]), is_slip.repeat(2), weights.repeat(2) / 2
        if self.stats is not None:
            self.stats.update(recording, z, is_slip, weights)
            return
        self.seen_batches.add(recording, content_digest(z, is_slip))
        self.bins[recording] = (z, is_slip, weights)

    def solve(self) -> Head:
        """The machine.

        Raises:
            ValueError: if a class is absent, or the system cannot be told in float64.
        """
        plan = self.plan
        balance: Literal["weights", "none"] = "none"
        if plan.recipe.balance == "weights" and not plan.scene_weights:  # which are balanced
            balance = "weights"
        if self.stats is not None:
            assert isinstance(plan.kernel, Polynomial)
            return self.stats.solve(plan.penalty, plan.kernel.offset, balance=balance)
        columns = zip(*(self.bins[name] for name in sorted(self.bins)), strict=True)
        z, is_slip, weights = map(torch.cat, columns)
        if balance == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights = weights * (len(z) / (2 * counts.double()))[is_slip.long()]
        return fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)


def solve_metadata(head: Head) -> dict[str, Any]:
    """How a machine was solved for, JSON-able: method, condition, error (``SolveReport``)."""
    return {} if head.solved is None else head.solved.facts()


def _is_kept(recording: str, is_slip: Tensor, fractions: Sequence[float]) -> Tensor:
    """Which bins ``[N]`` of a recording are trained on; it depends on the bin alone."""
    if all(fraction >= 1 for fraction in fractions):
        return torch.ones_like(is_slip, dtype=torch.bool)
    keys = bin_keys(recording, len(is_slip))  # [N] in [0, 1)
    return keys < torch.tensor(fractions, dtype=torch.float64)[is_slip.long()]


def _dropped(recording: str, num: int, largest: float) -> Tensor:
    """Channels that the second copy of a recording is without, ``[num]``, bool."""
    keys = bin_keys(f"{recording}, channels", num + 1)
    order = keys[1:].argsort()[: math.floor(float(keys[0]) * (math.floor(largest * num) + 1))]
    return torch.zeros(num, dtype=torch.bool).index_fill(0, order, True)


# Abstention --------------------------------------------------------------------------------------

LeftOut = Literal["recording", "group"]
"""What the machine that scores a calibration bin was fitted without.

``"recording"`` is what the guarantee is about: another recording of a material that was trained on.
``"group"``, what validation leaves out, by default the material, is stricter: mistakes on unseen
materials are counted. It is no guarantee for new ones: that would take materials as units, and for
a coverage of 95 % 19 of them.
"""


@dataclass(frozen=True)
class Abstaining:
    """Whether and how thresholds for abstaining are set.

    Calibration recordings are not set aside: each sampled bin is scored in closed form by the
    machine that was fitted without its recording (``HeldOut``). Features, scaling, K, c and C are
    the plan's, which saw all of them, and the detector itself is trained on the left-out recording
    too, so the guarantee of ``model.abstention`` holds as far as one recording of the training set
    changes little; ``benchmarks.abstaining`` looks. A recording has the mean of its sampled bins,
    which are drawn by a hash of the bin alone.

    Args:
        coverage: least mean fraction of a recording's bins of either class whose truth is in the
            answer; None sets no thresholds, and the detector never abstains.
        left_out: what the machine that scores a calibration bin was fitted without.

    Raises:
        ValueError: if these are no such values.
    """

    coverage: float | None = None
    left_out: LeftOut = "recording"

    def __post_init__(self) -> None:
        if self.coverage is not None:
            check_coverage(self.coverage)
        if self.left_out not in get_args(LeftOut):
            raise ValueError(f"coverage_by must be recording or group, got {self.left_out!r}")

    def settle(self, plan: Plan, sample: SampledBins) -> Plan:
        """The plan with thresholds; as it is, and with a warning, where there are too few."""
        if self.coverage is None:
            return plan
        is_by_recording = self.left_out == "recording"
        metadata = {
            "unit": "recording",
            "left_out": "recording" if is_by_recording else plan.recipe.group_by,
            "how": "conformal risk control on closed-form held-out scores of sampled training bins",
        }
        groups = sample.recording if is_by_recording else sample.group
        try:
            held_out = HeldOut(plan.training_bins(sample), groups, plan.kernel)
            scores = held_out.at(plan.penalty).scores
            found = Abstention.fit(
                scores, sample.is_slip, sample.recording, self.coverage, metadata
            )
        except ValueError as error:
            log.warning("the detector never abstains: %s", error)
            return plan
        return replace(plan, abstain=found.to_dict())
