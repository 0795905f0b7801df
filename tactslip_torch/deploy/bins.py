"""From raw bins to scores, as a graph: what ``SlipDetector.predict_raw`` does, and no more.

``RawBin`` and ``Timing`` say which samples a bin is scored by, and when a stream decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.deploy.value import BOOL, F32, F64, Graph, Value
from tactslip_torch.features.bank import Bank, Frame, Samples
from tactslip_torch.features.descriptors import TINY
from tactslip_torch.features.pooling import over_channels
from tactslip_torch.features.sensing import FEWEST_SAMPLES, LARGEST_SAMPLE, Sensing, is_enough
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.evidence import FLOORS_S, MEAN_HOPS, OnsetClassifier
from tactslip_torch.onset.rules import NOTHING_YET, KOfN, Rule
from tactslip_torch.package_files import SIDECAR as FORMAT
from tactslip_torch.runtime import __version__
from tactslip_torch.signals.filtering import overlap_matrix

Precision = Literal["float32", "float64"]
"""Of samples, scores and all that there is one of per sample; what steps or cancels is float64."""


def dtype_of(precision: str) -> np.dtype[Any]:
    """The dtype of samples and scores.

    Raises:
        ValueError: for another precision.
    """
    if precision not in (known := get_args(Precision)):
        raise ValueError(f"precision must be one of {', '.join(known)}, got {precision!r}")
    return np.dtype(precision)


@dataclass(frozen=True)
class RawBin:
    """The raw samples that one bin is scored by.

    Attributes:
        channels: indices in the hand of the channels in use, ascending.
        before: samples before the bin that their filters take in.
        bin: samples of the bin.
        after: samples behind it, the look-ahead.
    """

    channels: tuple[int, ...]
    before: int
    bin: int
    after: int

    @classmethod
    def of(cls, detector: SlipDetector) -> RawBin:
        """That of a detector."""
        channels = detector.extractor.plan.channels
        reaches = [detector.channel_filter.reaches[channel] for channel in channels]
        before, after = (max(each) for each in zip(*reaches, strict=True))
        return cls(channels, before, detector.pool.bin_samples, after)

    @property
    def length(self) -> int:
        """Of all samples."""
        return self.before + self.bin + self.after


OF_LAST_BIN = ("score", "probability", "statistic", "valid", "in_range", "onset_s")
"""What is kept of the last bin for decisions with an onset classifier; lost channels behind it."""


@dataclass(frozen=True)
class Timing:
    """When decisions are made, and how much is kept until then; lengths in samples.

    Attributes:
        raw: the samples of a bin.
        hop: distance of two decisions on bins.
        first: samples that must have come before the first of these, but for long frames.
        frame: samples that must have come before any of these.
        tail: samples that are kept.
        state_size: numbers that are kept.
        onset_hop: distance of two decisions with an onset classifier.
    """

    raw: RawBin
    hop: int
    first: int
    frame: int
    tail: int
    state_size: int
    onset_hop: int | None = None

    @classmethod
    def of(cls, detector: SlipDetector, settings: AlarmSettings) -> Timing:
        """That of a detector with these settings."""
        raw = RawBin.of(detector)
        frame = max(detector.channel_filter.window_lengths[i] for i in raw.channels)
        num_channels = len(detector.pool.hand)
        size = 7 + 2 * num_channels + len(rule_start(settings.rule))
        times = settings.hop_samples, raw.bin + raw.after, frame
        if settings.onset is None:
            return cls(raw, *times, raw.length - 1, size)
        evidence = settings.onset.evidence
        tail = max(raw.length, evidence.context + evidence.hop_samples) - 1
        size += 1 + len(OF_LAST_BIN) + num_channels + sum(memory_sizes(settings.onset))
        return cls(raw, *times, tail, size, evidence.hop_samples)

    def decisions(self, num: int) -> int:
        """How many are made by the time that as many samples have come."""
        if self.onset_hop is not None:
            return num // self.onset_hop
        return 0 if num < max(self.first, self.frame) else (num - self.first) // self.hop + 1


def memory_sizes(onset: OnsetClassifier) -> list[int]:
    """Numbers kept of a stream: lost and known blocks, scores, ``memory_shapes``, floors."""
    num_floors = len(FLOORS_S) * onset.evidence.num_filters * len(onset.evidence.hand.fast)
    num_floors += onset.evidence.step_matrix.shape[1] * len(onset.evidence.hand.slow)
    rows = [rows * width for rows, width in memory_shapes(onset)]
    return [1, 1, MEAN_HOPS - 1, *rows, num_floors]


def memory_shapes(onset: OnsetClassifier) -> list[tuple[int, int]]:
    """Rows kept of power with products, means, sizes of steps and scaled columns."""
    evidence = onset.evidence
    num_slow, num_steps = len(evidence.hand.slow), evidence.step_matrix.shape[1]
    num_fast = len(evidence.hand.fast) + evidence.pairs.shape[1]
    return [
        (evidence.delay, evidence.num_filters * num_fast),
        (len(evidence.step_matrix) - 1, num_slow),
        (evidence.delay, num_steps * num_slow),
        (max(onset.lags, default=0), evidence.num_columns),
    ]


def rule_start(rule: Rule) -> list[float]:
    """What is remembered before the first decision."""
    return [NOTHING_YET] * (rule.n - 1) if isinstance(rule, KOfN) else [0.0]


class Scored(NamedTuple):
    """What a graph makes of ``B`` bins.

    Attributes:
        score: ``[B]``, at least 0 is slip; NaN where not valid.
        is_valid: ``[B]``, bool: enough channels are alive, and the score is finite.
        in_range: ``[B]``, bool: and they move about as much as in training.
        channels_lost: ``[B, C]``, bool, of all channels of the hand.
    """

    score: Value
    is_valid: Value
    in_range: Value
    channels_lost: Value


def bin_graph(detector: SlipDetector, precision: Precision = "float32") -> Graph:
    """A graph of independent bins.

    Args:
        detector: that scores them.
        precision: of samples and scores.

    Shape:
        - in ``samples``: ``[batch, C, RawBin.length]``, volts
        - out ``score``, ``valid`` and ``in_range`` (bool) and, if calibrated, ``probability``:
          ``[batch]``; ``channels_lost`` (bool): ``[batch, C]``

    Raises:
        ValueError: for another precision.
    """
    graph, raw, dtype = Graph(), RawBin.of(detector), dtype_of(precision)
    num_channels = len(detector.pool.hand)
    samples = graph.input("samples", dtype, ("batch", num_channels, raw.length))
    calibrated = detector.calibration
    outputs = dict(zip(Scored._fields, (dtype, BOOL, BOOL, BOOL), strict=True))
    if calibrated is not None:
        outputs["probability"] = dtype

    def scores() -> list[Value]:
        found = score_bins(samples.take(raw.channels, 1), detector)
        if calibrated is None:
            return list(found)
        known: Any = graph.where(found.is_valid, found.score, 0.0)
        stated: Any = probability(calibrated[0].llr(known), calibrated[1])
        return [*found, graph.where(found.is_valid, stated, math.nan)]

    def nothing() -> list[Value]:  # onnxruntime reduces and reshapes no empty batch
        shapes = {"channels_lost": (0, num_channels)}
        return [
            graph.constant(np.zeros(shapes.get(name, 0)), kind) for name, kind in outputs.items()
        ]

    made = graph.if_(samples.length(0).squeeze(0) > 0, scores, nothing)
    for name, value in zip(outputs, made, strict=True):
        shape = ("batch", num_channels) if name == "channels_lost" else ("batch",)
        graph.output({"is_valid": "valid"}.get(name, name), value, shape)
    return graph


def score_bins(windows: Value, detector: SlipDetector, sensing: Sensing | None = None) -> Scored:
    """Score raw bins.

    Args:
        windows: raw samples in volts of the channels in use, in the dtype that scores shall have.
        detector: that scores them.
        sensing: by whose spans they are in range; default: the detector's.

    Shape:
        - windows: ``[B, channels in use, RawBin.length]``, at least one bin
    """
    features, alive, span = described(windows, detector)
    channels, graph = RawBin.of(detector).channels, windows.graph
    score = _scored(features, ~alive, detector, windows.dtype)
    counted = detector.counted[list(channels)]
    valid, in_range = is_enough(alive, span, counted, sensing or detector.sensing, channels)
    valid = valid & score.isfinite()
    of_hand = np.equal.outer(np.array(channels), np.arange(len(detector.pool.hand)))
    lost = (~alive).cast(F32) @ of_hand.astype(np.float32) > 0.0
    return Scored(graph.where(valid, score, math.nan), valid, in_range & valid, lost)


def described(windows: Value, detector: SlipDetector) -> tuple[Value, Value, Value]:
    """Features of raw bins, which channels are alive, and spans of the filtered bins.

    Shape:
        - windows: as ``score_bins``
        - output: ``[B, M]``, float64, the selected features in their order; ``[B, channels]``
          twice, bool and float64
    """
    used, graph = RawBin.of(detector).channels, windows.graph
    layer, fast = detector.channel_filter, set(detector.pool.hand.fast)
    alike: dict[tuple[int, bool], list[int]] = {}
    for channel in used:
        alike.setdefault((layer.window_lengths[channel], channel in fast), []).append(channel)
    frames = [
        Frame(
            tuple(channels),
            is_fast,
            overlap_matrix(layer.kernel(channels[0]), detector.pool.bin_samples).T.contiguous(),
        )
        for (_, is_fast), channels in alike.items()
    ]
    samples, alive, span = zip(
        *(_samples(windows, detector, frame) for frame in frames), strict=True
    )
    # strongly compressed columns magnify the rounding of features
    is_wide = windows.dtype == F64 or detector.scaler.columns is not None
    dtype = torch.float64 if is_wide else torch.float32
    features: Any = Bank(detector.pool.maps, detector.extractor.plan, frames, dtype)(samples)
    order = [channel for frame in frames for channel in frame.channels]
    places = [order.index(channel) for channel in used]
    living, spans = (graph.concat(*each, axis=1).take(places, 1) for each in (alive, span))
    return features, living, spans


def _samples(windows: Value, detector: SlipDetector, frame: Frame) -> tuple[Samples, Value, Value]:
    """What rows are made of; which channels of the frame are alive, and the spans of their bins."""
    raw, graph, dtype = RawBin.of(detector), windows.graph, windows.dtype
    assert frame.smooth is not None  # frames of raw samples have a filter
    before, after = detector.channel_filter.reaches[frame.channels[0]]
    start = raw.before - before
    x: Any = windows.take([raw.channels.index(channel) for channel in frame.channels], 1)
    x = x.slice(start, start + before + raw.bin + after, 2).double()
    unit, loudest = None, x.abs().amax(2)
    if dtype == F64:  # whose squares float64 does not hold
        unit = loudest.maximum(TINY).unsqueeze(2)
        x, loudest = x / unit, loudest / unit.squeeze(2)
    first = x.slice(before, before + 1, 2)
    moving = x - first
    shifted = graph.concat(moving, first, axis=2)
    moving = moving @ frame.smooth.T
    filtered = moving + first
    high, low = filtered.amax(2), filtered.amin(2)
    scale = high.maximum(-low)
    probe = filtered[..., 0]  # NaN if anything in the window is no number
    probe = scale + (probe - probe)
    unit = None if unit is None else unit.squeeze(2)
    largest = min(LARGEST_SAMPLE, float(np.finfo(dtype).max))
    is_known = (probe if unit is None else probe * unit) <= largest
    given = torch.float64 if dtype == F64 else torch.float32
    channels = list(frame.channels)
    inverse = detector.pool.inverse_span(given, is_raw=True)[channels]
    span = high - low
    volts = span if unit is None else span * unit
    alive = is_known
    if raw.bin >= FEWEST_SAMPLES:
        floor = torch.tensor(detector.sensing.floor, dtype=torch.float64)[channels]
        moves = span * inverse > loudest
        alive = moves & (volts >= floor) & is_known
    values: tuple[Any, ...] = shifted, moving, scale, unit
    return Samples(*values), alive, volts


def host_metadata(detector: SlipDetector, kind: str, precision: Precision) -> dict[str, Any]:
    """All that a host must know of a graph."""
    hand, info, raw = detector.pool.hand, detector.info, RawBin.of(detector)
    calibrated = detector.calibration
    metadata = {
        "format": FORMAT,
        "version": __version__,
        "graph": kind,
        "precision": precision,
        "channels": list(hand.names),
        "kinds": [channel.kind for channel in hand.channels],
        "unit": info.get("units", "V"),
        "sample_rate_hz": detector.pool.sample_rate_hz,
        "tare_s": (info.get("reading") or {}).get("tare_s"),
        "bin_samples": raw.bin,
        "context_before_samples": raw.before,
        "context_after_samples": raw.after,
        "features": [str(name) for name in detector.selected_names],
        "slip_if_score_at_least": 0.0,
        "calibration": calibrated and calibrated[0].to_dict(),
        "slip_share": calibrated and calibrated[1],
        "experiment": info.get("experiment"),
        "train_materials": list(info.get("train_materials", ())),
        "simulated": info.get("simulated"),
    }
    if kind == "stream":
        settings = AlarmSettings.of(detector)
        timing = Timing.of(detector, settings)
        metadata |= {
            "hop_samples": timing.hop,
            "first_samples": timing.first,
            "frame_samples": timing.frame,
            "tail_samples": timing.tail,
            "state_size": timing.state_size,
            "rule": settings.rule.to_dict(),
            "threshold": settings.alarm_threshold,
            "target_false_alarms_per_hour": settings.target_per_hour,
            "threshold_curve": settings.metadata.get("threshold_curve", []),
        }
        if settings.onset is not None:  # whose threshold the one above is
            metadata["onset_hop_samples"] = timing.onset_hop
            if math.isfinite(settings.threshold):  # of bins, which raise no alarm
                metadata["status_threshold"] = settings.threshold
            if math.isfinite(settings.onset.hint):
                metadata["hint_threshold"] = settings.onset.hint
    return metadata


# From features to scores -------------------------------------------------------------------------

_LARGEST = float(np.finfo(np.float64).max)


def _scored(features: Value, is_lost: Value, detector: SlipDetector, dtype: np.dtype[Any]) -> Value:
    """Scores; columns of lost channels take their imputation values.

    Args:
        features: of channels, float64; anything where lost.
        is_lost: which channels in use are, bool.
        detector: whose columns, scaler and head.
        dtype: of scores.

    Shape:
        - features: ``[B, M]``; is_lost: ``[B, channels in use]``
        - output: ``[B]``
    """
    channels = detector.extractor.plan.channels
    z = scaled(_pooled(features, is_lost, detector), detector.scaler)
    # a column that is pooled is of no channel; a product is quicker than to pick flags
    of_channel = np.equal.outer(np.array(channels), detector.channel_index.numpy())
    if of_channel.any():
        is_filled = is_lost.cast(F32) @ of_channel > 0.0  # [B, S]
        z = z.graph.where(is_filled, _float64(z, detector.imputation), z)
    return machine(z, detector.head, dtype)


def _pooled(features: Value, is_lost: Value, detector: SlipDetector) -> Value:
    """Columns for the scaler, ``[B, K]``, float64: ``ChannelPooling``; without one as they are."""
    layer, graph = detector.pooling, features.graph
    if layer is None:
        return features
    used = detector.extractor.plan.channels
    columns, is_some = list[Any](), list[Value]()
    if layer.singles:
        columns.append(features.take(layer.singles, 1))
    for group in layer.groups:
        num = len(group.channels)
        in_use: Any = ~is_lost.take([used.index(channel) for channel in group.channels], 1)
        is_some.append(in_use.any(1, keepdim=True))
        values = features.take(group.columns, 1).reshape(0, len(group.families), num)
        scale = layer.compression[list(group.families), None].double()
        bent: Any = (values.abs() * (1 / scale) + 1.0).log() * values.sign() * scale
        columns += over_channels(bent, in_use.unsqueeze(1), group.statistics, num)
    always = is_some[0] | ~is_some[0]
    known = graph.concat(*is_some, always, axis=1).cast(F32).take(layer.kind_of, 1) > 0.0
    made = graph.concat(*columns, axis=1).take(layer.order, 1)
    return graph.where(known, made, _float64(made, layer.fill))


def scaled(features: Value, scaler: FeatureScaler) -> Value:
    """Columns ``[B, K]`` in [-1, 1], ``[B, S]``, float64: ``FeatureScaler``.

    ONNX has no ``log1p``: the logarithm becomes ``Log(1 + x)``, off by some eps of the scale.
    """
    if scaler.columns is not None:
        features = features.take(scaler.columns.tolist(), 1)
    least, width = scaler.minimum.double(), (scaler.maximum - scaler.minimum).double()
    is_point = width == 0
    slope = torch.where(is_point, 0.0, 2 / width.masked_fill(is_point, 1.0))
    offset = torch.where(is_point, 0.0, -1 - slope * least)
    if bool(is_point.any()):  # 0 times Inf
        features = features.clamp(-_LARGEST, _LARGEST)
    if scaler.compression is not None:
        scale = scaler.compression.double()
        slope = slope * scale
        features = (features.abs() * (1 / scale) + 1.0).log() * features.sign()
    return (features * slope + _float64(features, offset)).clamp(-1.0, 1.0)


def machine(z: Value, head: QuadraticForm, dtype: np.dtype[Any]) -> Value:
    """The score of scaled columns, in its dtype: ``[B, S] -> [B]``.

    Computed in float64: columns that are scaled more than once have terms that cancel.
    """
    num = head.quadratic.shape[1]
    pull: Value = z.graph.constant(head.linear.double(), F64)
    is_whole = num == head.num_features and head.signs is None
    if is_whole:
        pull = z @ head.quadratic.double() + pull
    score = (pull * z).sum(1) + float(head.constant)
    if not (is_whole or head.is_linear):
        first: Value = z.slice(0, num, 1)
        if head.signs is None:
            score = score + (first @ head.quadratic.double() * first).sum(1)
        else:
            products: Value = first @ head.quadratic.double().mT
            signs = z.graph.constant(head.signs.double(), F64)
            score = score + (products * products * signs).sum(1)
    largest = float(np.finfo(dtype).max)
    return score.clamp(-largest, largest).cast(dtype)


def _float64(like: Value, x: Tensor) -> Value:
    """A tensor as a constant in float64, in the graph of a value."""
    return like.graph.constant(x.double(), F64)
