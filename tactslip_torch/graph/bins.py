"""From raw bins to scores, as a graph: what ``SlipDetector.predict_raw`` does, and no more."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.bank import Bank, Frame, Samples
from tactslip_torch.features.ops import TINY
from tactslip_torch.features.pool import LARGEST_SAMPLE
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.head import lost_features, machine, pooled, scaled, with_typical
from tactslip_torch.graph.missing import expected_scores, widened_llr_of
from tactslip_torch.graph.sequence import llr_of, probability_of
from tactslip_torch.graph.value import BOOL, F64, I64, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import Calibration
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.onset.settings import calibration_of
from tactslip_torch.signals.filtering import overlap_matrix


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
    features, is_missing, is_trusted = described(graph, detector, windows, form)
    is_dead = dead.take(detector.extractor.plan.channels, 0)
    is_missing = is_missing | is_dead
    z = scaled(graph, pooled(graph, features, is_missing, detector), detector.scaler)
    is_lost = lost_features(is_missing, detector)
    head, gaussians, variance = detector.head, detector.gaussians, None
    score = machine(graph, with_typical(graph, z, is_lost, detector), head, form)
    if gaussians is not None and isinstance(head, QuadraticForm):
        score, variance = expected_scores(graph, score, z, is_lost, head, gaussians)
    is_finite = score.isfinite()
    is_valid = _all(is_trusted & ~is_dead) & is_finite
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


class Described(NamedTuple):
    """Features of ``B`` bins, and what can be said of their channels in use.

    Attributes:
        features: selected ones in their order, ``[B, K]``, float64.
        is_missing: ``[B, channels]``, bool: a NaN or Inf is within the frame of the filter.
        is_trusted: ``[B, channels]``, bool: neither missing nor dead (``FeaturePool.validity``).
    """

    features: Value
    is_missing: Value
    is_trusted: Value


def described(graph: Graph, detector: SlipDetector, windows: Value, form: Form) -> Described:
    """Nodes that filter and describe raw bins; arguments as ``judge_bins`` has them."""
    used = Window.of(detector).channels
    films, lengths = set(detector.pool.hand.fast), detector.channel_filter.window_lengths
    by_frame: dict[tuple[int, bool], list[int]] = {}
    for channel in used:
        by_frame.setdefault((lengths[channel], channel in films), []).append(channel)
    frames = [
        Frame(tuple(channels), is_film, _filter_matrix(detector, channels[0]))
        for (_, is_film), channels in by_frame.items()
    ]
    read = [_samples(graph, detector, windows, frame, form) for frame in frames]
    dtype = torch.float64 if form.dtype == F64 else torch.float32
    bank = Bank(detector.pool.maps, detector.extractor.plan, frames, dtype)
    order = [channel for frame in frames for channel in frame.channels]
    places = [order.index(channel) for channel in used]
    is_missing, is_trusted = (
        graph.concat(*parts, axis=1).take(places, 1)
        for parts in zip(*(flags for _, flags in read), strict=True)
    )
    features: Any = bank([samples for samples, _ in read])
    return Described(features, is_missing, is_trusted)


def _filter_matrix(detector: SlipDetector, channel: int) -> Tensor:
    """A channel's filter from its window to the samples of the bin, ``[n, W]``, float64."""
    kernel = detector.channel_filter.kernel(channel)
    return overlap_matrix(kernel, detector.pool.bin_samples).T.contiguous()


def _samples(
    graph: Graph, detector: SlipDetector, windows: Value, frame: Frame, form: Form
) -> tuple[Samples, tuple[Value, Value]]:
    """What rows are made of; and which channels of the frame are missing, and can be trusted."""
    window, smooth = Window.of(detector), frame.smooth
    assert smooth is not None  # frames of raw samples have a filter
    before, after = detector.channel_filter.reaches[frame.channels[0]]
    x: Any = windows.take([window.channels.index(channel) for channel in frame.channels], 1)
    start = window.before - before
    x = x.slice(start, start + before + window.bin + after, 2)
    first = x.slice(before, before + 1, 2)
    moving, unit = x - first, None
    if form.dtype == F64:  # whose squares float64 does not hold
        unit = x.abs().amax(2, keepdim=True).maximum(TINY)
        moving, first = moving / unit, first / unit
        shifted = graph.concat(moving, first, axis=2)
    else:
        shifted = graph.concat(x.double() - first.double(), first.double(), axis=2)
    moving = moving.cast(form.dtype) @ smooth.T
    filtered = moving + first.cast(form.dtype)
    high, low = filtered.amax(2), filtered.amin(2)
    scale = high.maximum(-low)
    probe = filtered[..., 0]  # NaN if anything in the window is no number
    probe = scale + (probe - probe)
    largest = min(LARGEST_SAMPLE, float(np.finfo(form.dtype).max))
    is_known = (probe if unit is None else probe * unit.squeeze(2)) <= largest
    of_dtype = torch.empty(0, dtype=torch.float64 if form.dtype == F64 else torch.float32)
    inverse = detector.pool.inverse_span(of_dtype)[list(frame.channels)]
    is_alive = (high - low) * graph.constant(inverse, form.dtype) > scale
    values: tuple[Any, ...] = shifted, moving, scale.double(), unit and unit.squeeze(2)
    return Samples(*values), (~is_known, is_alive & is_known)


def _all(mask: Value) -> Value:
    """Whether it holds in every channel: ``[B, channels] -> [B]``."""
    return mask.cast(I64).amin(1).cast(BOOL)
