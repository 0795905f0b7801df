"""Thresholds for abstaining, from what the first pass kept of the training recordings.

Calibration recordings are not set aside: each sampled bin is scored in closed form by the machine
that was fitted without its recording (``HeldOut``). Features, scaling, K, c and C are the plan's,
which saw all of them, and the detector itself is trained on the left-out recording too, so the
guarantee of ``model.abstention`` holds as far as one recording of the training set changes little;
``benchmarks.abstaining`` looks. A recording stands by its sampled bins, which are drawn by a hash
of the bin alone: its share of wrong bins has the same mean.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.model.abstention import Abstention, check_coverage, conformal_abstention
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.training.selection import Plan

log = logging.getLogger(__name__)

LeftOut = Literal["recording", "group"]
"""What the machine that scores a calibration bin was fitted without.

``"recording"`` is what the guarantee is about: another recording of a material that was trained on.
``"group"``, what validation leaves out, by default the material, is stricter: mistakes on unseen
materials are counted. It is no guarantee for new ones: that would take materials as units, and for
a coverage of 95 % 19 of them.
"""


def held_out_scores(plan: Plan, sample: SampledBins, left_out: LeftOut = "recording") -> Tensor:
    """Scores of the sampled training bins, each by the machine without its recording or group.

    Shape:
        - output: ``[n]``, in the order of the sample

    Raises:
        ValueError: if there is one group only, a class stands in one alone, or the machine without
            a group cannot be told (``HeldOut``).
    """
    groups = sample.recording if left_out == "recording" else sample.group
    return HeldOut(plan.training_bins(sample), groups, plan.kernel).at(plan.penalty).scores


@dataclass(frozen=True)
class Abstaining:
    """Whether and how thresholds for abstaining are set.

    Args:
        coverage: least mean share of a recording's bins of either class whose truth is in the
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
        try:
            found = self.abstention(plan, sample)
        except ValueError as error:
            log.warning("the detector never abstains: %s", error)
            return plan
        return replace(plan, abstain=found.to_dict())

    def abstention(self, plan: Plan, sample: SampledBins) -> Abstention:
        """Thresholds that keep the coverage.

        Raises:
            ValueError: if no bin can be held out (``held_out_scores``), or there are too few
                recordings to answer at all.
        """
        assert self.coverage is not None  # settle
        is_by_recording = self.left_out == "recording"
        metadata: dict[str, Any] = {
            "unit": "recording",
            "left_out": "recording" if is_by_recording else plan.recipe.group_by,
            "how": "conformal risk control on closed-form held-out scores of sampled training bins",
        }
        scores = held_out_scores(plan, sample, self.left_out)
        return conformal_abstention(
            scores, sample.is_slip, sample.recording, self.coverage, metadata
        )
