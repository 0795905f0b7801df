"""Thresholds for unsure answers from what the first pass kept of the training recordings.

Calibration recordings are not set aside: each sampled bin is scored in closed form by the machine
that never met its recording (``HeldOut``). Features, scaling, K, c and C are the plan's,
which saw all of them, and the detector itself is trained on the left-out recording too, so the
promise of ``model.conformal`` holds as far as one recording of the training set changes little;
``benchmarks.abstaining`` looks. A recording stands by its sampled bins, which are drawn by a hash
of the bin alone: its share of wrong bins has the same mean.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.abstention import Abstention
from tactslip_torch.model.conformal import check_coverage, check_number, thresholds
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.training.recipe import Recipe, stand_for
from tactslip_torch.training.selection import Plan

log = logging.getLogger(__name__)

LeftOut = Literal["recording", "group"]
"""What the machine that scores a calibration bin never met.

``"recording"`` is what the promise is about: another recording of a material that was trained on.
``"group"``, what validation leaves out, by default the material, is stricter: mistakes on materials
never met are counted. It is no promise for new ones: that would take materials as units, and for a
coverage of 95 % 19 of them.
"""


def held_out_scores(plan: Plan, recipe: Recipe, survey: Survey, groups: Tensor) -> Tensor:
    """Scores of the sampled training bins, each by the machine that never met its group.

    Args:
        plan: which features, how scaled, with which kernel and C.
        recipe: how the classes are balanced.
        survey: the first pass, whose sample is scored.
        groups: what each sampled bin is held out with, whole numbers.

    Shape:
        - groups, output: ``[n]``, in the order of the sample

    Raises:
        ValueError: if there is one group only, a class stands in one alone, or the machine without
            a group cannot be told (``HeldOut``).
    """
    sample = survey.sample.bins()
    weights = stand_for(sample, recipe, survey.moments.count.tolist())
    bins = TrainingBins(plan.frame(sample.features), sample.is_slip, weights)
    return HeldOut(bins, groups, plan.kernel).at(plan.penalty).scores


def groups_of(sample: SampledBins, left_out: LeftOut) -> Tensor:
    """The group of each sampled bin, ``[n]``."""
    return sample.recording if left_out == "recording" else sample.group


@dataclass(frozen=True)
class Abstaining:
    """Whether and how thresholds for unsure answers are set.

    Args:
        coverage: least mean share of a recording's bins of either class whose truth is in the
            answer; None sets no thresholds, and no answer is unsure.
        left_out: what the machine that scores a calibration bin never met.

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

    def settle(self, plan: Plan, recipe: Recipe, survey: Survey) -> Plan:
        """The plan with thresholds; as it is, and with a warning, where ``abstention`` refuses."""
        if self.coverage is None:
            return plan
        try:
            found = abstention(plan, recipe, survey, self.coverage, self.left_out)
        except ValueError as error:
            log.warning("no answer is ever unsure: %s", error)
            return plan
        return replace(plan, abstain=found.to_dict())


def abstention(
    plan: Plan, recipe: Recipe, survey: Survey, coverage: float, left_out: LeftOut = "recording"
) -> Abstention:
    """Thresholds that keep a coverage.

    Args:
        plan: of the detector.
        recipe: that it was planned by.
        survey: the first pass.
        coverage: least mean share of a recording's bins of either class whose truth is in the
            answer.
        left_out: what the machine that scores a calibration bin never met.

    Raises:
        ValueError: if no bin can be held out (``held_out_scores``), or there are too few recordings
            to be sure of anything.
    """
    sample = survey.sample.bins()
    scores = held_out_scores(plan, recipe, survey, groups_of(sample, left_out))
    found = thresholds(scores, sample.is_slip, sample.recording, coverage)
    check_number(found, coverage)
    facts: dict[str, Any] = {
        "unit": "recording",
        "left_out": "recording" if left_out == "recording" else recipe.group_by,
        "num_recordings": {"slip": found.num_slip, "non_slip": found.num_non_slip},
        "num_bins": len(scores),
        "how": "conformal risk control on closed-form held-out scores of sampled training bins",
    }
    return Abstention(coverage, found.low, found.high, facts)
