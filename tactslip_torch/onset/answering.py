"""What a decision answers by the bin alone: slip, non-slip or unsure."""

from __future__ import annotations

from torch import Tensor

from tactslip_torch.model.abstention import abstention_of
from tactslip_torch.model.conformal import UNSURE, answers
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decider import Decisions


def answer_of(detector: SlipDetector, decisions: Decisions) -> Tensor:
    """1 for slip, 0 for non-slip, -1 for unsure.

    By the detector's thresholds, without any by the sign of the score. Unsure too where a sensor in
    use is dead or broken: thresholds were set on recordings in which all felt.

    Shape:
        - output: ``[*, m]`` as the decisions, int8
    """
    found = abstention_of(detector)
    sure = found.answer(decisions.score) if found else answers(decisions.score, 0.0, 0.0)
    return sure.masked_fill(~decisions.is_valid, UNSURE)
