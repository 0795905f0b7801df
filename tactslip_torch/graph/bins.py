"""From raw bins to scores, as a graph: what ``SlipDetector.judge_raw`` does, and no more."""

from __future__ import annotations

from typing import NamedTuple

from tactslip_torch.graph.form import Form
from tactslip_torch.graph.value import Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector


class Judged(NamedTuple):
    """What a graph makes of ``B`` bins.

    Attributes:
        score: ``[B]``, in the precision of the form; finite, at least 0 is slip.
        is_valid: ``[B]``, bool: every channel in use can be trusted.
        is_usable: ``[B]``, bool: the score tells something (``onset.decider.is_usable``).
    """

    score: Value
    is_valid: Value
    is_usable: Value


def judge_bins(graph: Graph, detector: SlipDetector, windows: Value, form: Form) -> Judged:
    """Nodes that judge raw bins.

    Args:
        graph: to which they are added; may be a body.
        detector: whose judgement.
        windows: raw samples in volts, of the channels in use alone, float64 or of the form.
        form: precision and layout.

    Shape:
        - windows: ``[B, channels, Window.length]``; B may be 0 only if it is so at run time
    """
    raise NotImplementedError
