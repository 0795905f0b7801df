"""From raw bins to scores, as a graph: what ``SlipDetector.predict_raw`` does, and no more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan, Wanted
from tactslip_torch.graph.descriptors import DESCRIPTORS
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.head import lost_features, machine, pooled, scaled, with_typical
from tactslip_torch.graph.missing import expected_scores, widened_llr_of
from tactslip_torch.graph.rows import EXACT, Front
from tactslip_torch.graph.sequence import llr_of, probability_of
from tactslip_torch.graph.shared import Shared
from tactslip_torch.graph.value import BOOL, F64, I64, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import Calibration
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.onset.settings import calibration_of


class Judged(NamedTuple):
    """What a graph makes of ``B`` bins.

    Attributes:
        score: ``[B]``, in the precision of the form; at least 0 is slip.
        is_valid: ``[B]``, bool: every channel in use can be trusted.
        is_usable: ``[B]``, bool: the score tells something (``onset.decisions.is_usable``).
        variance: ``[B]``, float64, of the score; ``None``: of none.
    """

    score: Value
    is_valid: Value
    is_usable: Value
    variance: Value | None = None

    def llr(self, calibration: Calibration) -> Value:
        """Log likelihood ratios ``[B]``, in the precision of the score."""
        if self.variance is None:
            return llr_of(self.score, calibration)
        return widened_llr_of(self.score, self.variance, calibration)


def judge_bins(
    graph: Graph, detector: SlipDetector, windows: Value, form: Form, dead: Value
) -> Judged:
    """Nodes that judge raw bins.

    Where samples of a bin differ by more than their precision can hold, or by so little that they
    are denormal in it, their channel may count as missing or dead (1e38 V and 1e-38 V in float32).

    Args:
        graph: to which they are added; may be a body.
        detector: whose judgement.
        windows: raw samples in volts, of the channels in use alone, float64 or of the form.
        form: precision.
        dead: which channels of the hand are missing whatever they say, ``[C]``, bool.

    Shape:
        - windows: ``[B, channels, Window.length]``

    """
    front = Front(graph, detector, windows, form)
    features = selected_features(graph, detector, front, form)
    is_dead = dead.take(front.window.channels, 0)
    is_missing = front.is_missing | is_dead
    z = scaled(graph, pooled(graph, features, is_missing, detector), detector.scaler)
    is_lost = lost_features(is_missing, detector)
    head, gaussians, variance = detector.head, detector.gaussians, None
    score = machine(graph, with_typical(graph, z, is_lost, detector), head, form)
    if gaussians is not None and isinstance(head, QuadraticForm):
        score, variance = expected_scores(graph, score, z, is_lost, head, gaussians)
    is_finite = score.is_finite()
    is_valid = _all(front.is_trusted & ~is_dead) & is_finite
    return Judged(score, is_valid, is_finite & ~_all(is_missing), variance)


def dead_input(graph: Graph, detector: SlipDetector) -> Value:
    """The input ``masked_channels [C]``, bool: by default no channel is."""
    num = len(detector.pool.hand)
    return graph.input("masked_channels", BOOL, (num,), np.zeros(num, bool))


def bin_graph(detector: SlipDetector, form: Form) -> Graph:
    """A graph of independent bins.

    Args:
        detector: whose judgement.
        form: precision.

    Shape:
        - in ``samples``: ``[batch, C, Window.length]``, volts, in the precision of the form
        - in ``masked_channels``: ``[C]``, bool; may be left out: none is
        - out ``score``, ``valid`` (bool) and, if calibrated, ``probability``: ``[batch]``
    """
    graph, window = Graph(), Window.of(detector)
    calibrated = calibration_of(detector)
    shape = ("batch", len(detector.pool.hand), window.length)
    samples = graph.input("samples", form.dtype, shape)
    dead = dead_input(graph, detector)

    def judged(body: Graph) -> list[Value]:
        windows = samples.at(body).take(window.channels, 1)
        found = judge_bins(body, detector, windows, form, dead.at(body))
        if calibrated is None:
            return [found.score, found.is_valid]
        calibration, slip_share = calibrated
        stated = probability_of(found.llr(calibration), slip_share)
        return [found.score, found.is_valid, stated]

    def nothing(body: Graph) -> list[Value]:  # onnxruntime reduces and reshapes no empty batch
        dtypes = (form.dtype, BOOL, *([] if calibrated is None else [form.dtype]))
        return [body.constant(np.zeros(0), dtype) for dtype in dtypes]

    made = graph.if_(samples.length(0).squeeze(0) > 0, judged, nothing)
    for name, value in zip(("score", "valid", "probability"), made, strict=False):
        graph.output(name, value, ("batch",))
    return graph


def selected_features(graph: Graph, detector: SlipDetector, front: Front, form: Form) -> Value:
    """Selected features in their order, ``[B, K]``, float64."""
    plan, axis_hz = detector.extractor.plan, LinearMaps.of(detector.pool).frequency_hz
    pieces, column_of, width = list[Value](), dict[int, int](), 0
    for wanted, exact in _batches(plan, form):
        names = {w.descriptor for w in wanted}
        rows = sorted({plan.rows[w.row] for w in wanted})
        made = front.of(
            rows,
            exact=exact,
            with_scale="mode" in names,
            with_film="correlation" in names,
        )
        place = {row: index for index, row in enumerate(made.rows)}
        places = {
            name: sorted({place[plan.rows[w.row]] for w in wanted if w.descriptor == name})
            for name in sorted(names)
        }
        axis = axis_hz if rows[0].kind == "freq" else axis_hz.new_zeros(front.window.bin)
        shared = Shared(
            graph,
            made,
            places,
            dtype=form.dtype,
            frequency_hz=axis,
        )
        for name in places:
            part = DESCRIPTORS[name](shared)
            for w in wanted:
                if w.descriptor == name:
                    column_of[w.place] = width + part.places.index(place[plan.rows[w.row]])
            pieces.append(part.value)
            width += len(part.places)
    for channel in plan.share_channels:
        branches = sorted({share.branch for share in plan.shares if share.channel == channel})
        pieces.append(front.shares(channel, branches))
        for share in plan.shares:
            if share.channel == channel:
                column_of[share.place] = width + branches.index(share.branch)
        width += len(branches)
    columns = [column_of[place] for place in range(plan.num_features)]
    return graph.concat(*pieces, axis=1).take(columns, 1)


def _batches(plan: Plan, form: Form) -> list[tuple[list[Wanted], bool]]:
    """Descriptors of rows that are made together, and whether in float64 whatever the form."""
    batches = []
    for is_freq in (False, True):
        for exact in (False, True):
            own = [
                wanted
                for wanted in plan.wanted
                if (plan.rows[wanted.row].kind == "freq") == is_freq
                and (wanted.descriptor in EXACT and form.dtype != F64) == exact
            ]
            if own:
                batches.append((own, exact))
    return batches


def _all(mask: Value) -> Value:
    """Whether it holds in every channel: ``[B, channels] -> [B]``."""
    return mask.cast(I64).amin(1).cast(BOOL)
