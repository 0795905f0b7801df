"""The detector that watches a stream, as a graph: ``StreamingDetector.push``.

Samples become decisions, these a statistic (``onset.rules``), and that alarms. What one decision
hands to the next, and no more, is walked by a ``Scan``, an iteration of which costs as much as
several nodes do on all decisions together. While nothing speaks for slip, nothing is walked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.deploy.bins import Precision, RawBin, dtype_of, masked_input, score_bins
from tactslip_torch.deploy.value import BOOL, END, F64, I64, Graph, Value
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.rules import NEUTRAL, NOTHING_YET, Cusum, KOfN, Rule
from tactslip_torch.signals.filtering import past_matrix

LATCH_START = (0.0, 0.0, 2.0**52)
"""Armed, with no alarm before; the last number counts on exactly in float64."""


@dataclass(frozen=True)
class Timing:
    """When decisions are made, and how much is kept until then; lengths in samples.

    Attributes:
        raw: the samples of a bin.
        hop: distance of two decisions.
        first: samples that must have come before the first decision, but for long frames.
        frame: samples that must have come before any.
        tail: samples that are kept.
        state_size: numbers that are kept.
    """

    raw: RawBin
    hop: int
    first: int
    frame: int
    tail: int
    state_size: int

    @classmethod
    def of(cls, detector: SlipDetector, settings: AlarmSettings) -> Timing:
        """That of a detector with these settings."""
        raw = RawBin.of(detector)
        frame = max(detector.channel_filter.window_lengths[i] for i in raw.channels)
        size = 6 + len(rule_start(settings.rule))
        return cls(raw, settings.hop_samples, raw.bin + raw.after, frame, raw.length - 1, size)

    def decisions(self, num: int) -> int:
        """How many are made by the time that as many samples have come."""
        return 0 if num < max(self.first, self.frame) else (num - self.first) // self.hop + 1


def stream_graph(
    detector: SlipDetector, settings: AlarmSettings, precision: Precision = "float32"
) -> Graph:
    """The graph of a stream: what comes next, and what was kept, to decisions and what is kept.

    Inputs ``samples [n, C]``, ``tail [r, C]``, ``state [s]``, ``threshold [t]`` and
    ``masked_channels [C]``, which may be left out; outputs
    ``score``, ``probability``, ``statistic``, ``valid``, ``alarm``, ``on``, ``time_s``,
    ``onset_s``, ``[k]`` each, ``next_tail [Timing.tail, C]`` and ``next_state
    [Timing.state_size]``. A stream begins with an empty tail and state; without a threshold that of
    the settings counts. Where nothing can be decided, next to nothing is computed.

    State, in float64: samples and decisions so far, where the run of positive ratios began, whether
    an alarm stands, decisions in a row that were low, decisions since the last alarm, and the
    memory of the rule.

    Args:
        detector: that scores the bins.
        settings: hop, calibration, rule and threshold.
        precision: of samples and scores.

    Raises:
        ValueError: for another precision, or a calibration that no graph is written for.
    """
    graph, dtype = Graph(), dtype_of(precision)
    timing, num_channels = Timing.of(detector, settings), len(detector.pool.hand)
    samples = graph.input("samples", dtype, ("n", num_channels))
    tail = graph.input("tail", dtype, ("r", num_channels))
    state = graph.input("state", F64, ("s",))
    threshold = graph.input("threshold", F64, ("t",))
    masked = masked_input(graph, detector)

    nothing = graph.constant(np.zeros((timing.tail, num_channels)), dtype)
    held = graph.concat(nothing, tail, samples, axis=0)
    start = graph.constant([0, 0, 0, *LATCH_START, *rule_start(settings.rule)], F64)
    state = graph.concat(state, start, axis=0).slice(0, timing.state_size, 0)
    seen = state.slice(0, 1, 0) + samples.length(0).cast(F64)
    decided = ((seen + float(timing.hop - timing.first)) / float(timing.hop)).floor().clamp(min=0.0)
    if timing.frame > timing.first:
        decided = graph.where(seen >= float(timing.frame), decided, 0.0)
    outputs: dict[str, np.dtype[Any]] = dict.fromkeys(("score", "probability", "statistic"), dtype)
    outputs |= dict.fromkeys(("valid", "alarm", "on"), BOOL)
    outputs |= dict.fromkeys(("time_s", "onset_s"), F64)

    def decide() -> list[Value]:
        sizes = graph.axes(1, 1, 1, 3, timing.state_size - 6)
        _, made, run, of_latch, of_rule = graph.ops("Split", state, sizes, dtypes=[F64] * 5, axis=0)
        places = _count_up((decided - made).cast(I64))
        number = places.cast(F64) + made
        windows = _windows(held, seen, made * float(timing.hop), places, detector, timing)
        scored = score_bins(windows.cast(dtype), detector, masked)
        llr = graph.where(scored.is_usable, scored.llr(settings.calibration), NEUTRAL)
        statistic, of_rule = statistic_of(settings.rule, llr, of_rule)
        own = graph.constant([settings.threshold], F64)
        level = graph.concat(threshold, own, axis=0).slice(0, 1, 0).cast(dtype)
        rate_hz = detector.pool.sample_rate_hz
        rearm, refractory = (
            settings.decisions(seconds, rate_hz)
            for seconds in (settings.rearm_s, settings.refractory_s)
        )
        latch = latched(statistic, level, number, of_latch, rearm=rearm, refractory=refractory)
        run = _latest(llr <= 0.0, run, number + 1.0)
        ratio: Any = llr
        stated: Any = probability(ratio, settings.slip_share)
        return [
            scored.score,
            stated,
            statistic,
            scored.is_valid,
            latch.alarm,
            latch.on,
            *_times_s(number, run, settings, timing, rate_hz),
            graph.concat(seen, decided, _last(run), latch.memory, of_rule, axis=0),
        ]

    def wait() -> list[Value]:
        empty = [graph.constant([], kind) for kind in outputs.values()]
        return [*empty, graph.concat(seen, state.slice(1, END, 0), axis=0)]

    *made, next_state = graph.if_(decided > state.slice(1, 2, 0), decide, wait)
    for name, value in zip(outputs, made, strict=True):
        graph.output(name, value, ("k",))
    graph.output("next_tail", held.slice(-timing.tail, END, 0), (timing.tail, num_channels))
    graph.output("next_state", next_state, (timing.state_size,))
    return graph


def _windows(
    held: Value, seen: Value, start: Value, places: Value, detector: SlipDetector, timing: Timing
) -> Value:
    """The raw samples of each decision, ``[k, channels in use, RawBin.length]``.

    Channels in between that are not in use go along, as columns are costly to pick and rows are
    not.

    Args:
        held: samples, the last of which is number ``seen``, ``[m, C]``.
        seen: how many came so far, ``[1]``.
        start: sample at which the first bin begins, ``[1]``.
        places: of the decisions, from 0, ``[k]``.
        detector: that scores them.
        timing: its own.
    """
    graph, raw = held.graph, timing.raw
    origin = start - seen - float(raw.before)  # negative: counted from the end
    x = held.slice(origin.cast(I64), END, 0)
    columns = range(raw.channels[0], raw.channels[-1] + 1)
    if len(columns) < len(detector.pool.hand):
        x = x.slice(columns.start, columns.stop, 1)
    if raw.before:
        x = graph.if_(
            start < float(raw.before),
            lambda: [_with_past(x, start.cast(I64), columns, detector, raw)],
            lambda: [x],
        )[0]
    index = (places * timing.hop).unsqueeze(1) + graph.axes(*range(raw.length))
    windows = graph.op("Gather", x, index, axis=0).transpose(0, 2, 1)
    if len(columns) == len(raw.channels):
        return windows
    return windows.take([columns.index(channel) for channel in raw.channels], 1)


def _with_past(
    x: Value, start: Value, columns: range, detector: SlipDetector, raw: RawBin
) -> Value:
    """The first raw bin and what follows, with a made-up past before the stream's start.

    Args:
        x: ``[m, columns]``, from ``RawBin.before`` samples before ``start``.
        start: of the first bin, a sample of the stream, ``[1]``.
        columns: channels of the hand that are there.
        detector: whose filter makes the past up.
        raw: its raw bin.
    """
    graph, layer = x.graph, detector.channel_filter
    known = x.slice(-start + raw.before, END, 0)
    shortest = min(layer.window_lengths[channel] for channel in raw.channels)
    lengths = [layer.window_lengths[c] if c in raw.channels else shortest for c in columns]
    pasts, order = list[Value](), list[int]()
    for length in dict.fromkeys(lengths):
        chosen = [i for i, own in enumerate(lengths) if own == length]
        frame = known.slice(0, length, 0).take(chosen, 1).double()
        sample = frame.slice(0, 1, 0)
        past: Tensor = past_matrix(length, layer.polyorder, layer.align)
        beyond = past.new_zeros(raw.before - len(past), length)  # further than this filter reaches
        matrix = graph.constant(torch.cat([beyond, past]), F64)
        pasts.append((matrix @ (frame - sample) + sample).cast(x.dtype))
        order += chosen
    past_of_all = graph.concat(*pasts, axis=1)
    if order != sorted(order):
        past_of_all = past_of_all.take(sorted(range(len(order)), key=order.__getitem__), 1)
    return graph.concat(past_of_all.slice(start, END, 0), known, axis=0)


def _times_s(
    number: Value, run: Value, settings: AlarmSettings, timing: Timing, rate_hz: float
) -> tuple[Value, Value]:
    """When decisions could be made, and when the slip began that they speak of."""
    samples = number * float(timing.hop) + float(timing.first)
    time_s = samples / rate_hz
    began_s = (run.minimum(number) * float(timing.hop) + float(timing.first)) / rate_hz
    onset_s = (began_s - settings.lead_s).minimum(time_s)
    if timing.frame <= timing.first:
        return time_s, onset_s
    waited_s = samples.maximum(float(timing.frame)) / rate_hz
    return waited_s, waited_s - (time_s - onset_s)


# Rules and alarms ------------------------------------------------------------------------------


def rule_start(rule: Rule) -> list[float]:
    """What is remembered before the first decision."""
    return [NOTHING_YET] * (rule.n - 1) if isinstance(rule, KOfN) else [0.0]


def statistic_of(rule: Rule, llr: Value, memory: Value) -> tuple[Value, Value]:
    """The statistic of each decision as the rule's ``scan`` makes it, and the memory behind.

    Args:
        rule: whose statistic.
        llr: finite ratios.
        memory: of ``rule_start`` or the call before.

    Shape:
        - llr, statistic: ``[k]``, k at least 1
        - memory: as many as ``rule_start`` gives, float64
    """
    graph, before = llr.graph, memory.cast(llr.dtype)
    if isinstance(rule, Cusum):
        step = llr - rule.drift if rule.drift else llr
        step = step * rule.evidence if rule.evidence != 1 else step

        def add(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
            total = state[0] + row[0]
            return [total.clamp(0.0, rule.ceiling)], [total]

        # where every step takes away at least what is there, the sum is 0 without a walk
        is_quiet = before + step.amax(0, keepdim=True) <= 0.0
        totals = graph.if_(
            is_quiet, lambda: [step], lambda: graph.scan(add, [before.squeeze(0)], [step])[1]
        )
        total = totals[0].clamp(0.0, rule.ceiling)
        return total, _last(total).cast(F64)
    if rule.n == 1:
        return llr, memory
    known = graph.concat(before, llr, axis=0)  # [n - 1 + k]
    places = _count_up(llr.length(0)).unsqueeze(1) + graph.axes(*range(rule.n))
    last_n = graph.op("Gather", known, places, axis=0)  # [k, n]
    largest = graph.ops("TopK", last_n, graph.axes(rule.k), dtypes=(None, I64))[0]
    kept = known.slice(1 - rule.n, END, 0).cast(F64)
    return largest.slice(rule.k - 1, rule.k, 1).squeeze(1), kept


class Latched(NamedTuple):
    """Which decisions raise an alarm.

    Attributes:
        alarm: whether it raises one, ``[k]``, bool.
        on: whether one stands after it, ``[k]``, bool.
        memory: what ``latched`` is given for the next decisions, ``[3]``.
    """

    alarm: Value
    on: Value
    memory: Value


def latched(
    statistic: Value, level: Value, number: Value, memory: Value, *, rearm: int, refractory: int
) -> Latched:
    """Alarms as ``onset.rules.latch`` raises them.

    One is raised where the statistic is high, and the last alarm is no later than the last
    re-arming and than ``refractory`` decisions back. So only the number of the last alarm is
    walked, and nothing where the statistic is low and no alarm stands.

    Args:
        statistic: finite.
        level: from which on an alarm is raised.
        number: of the decisions in their stream, float64.
        memory: whether an alarm stands, for how many decisions then the statistic was low, and
            decisions since the last alarm (``LATCH_START``); float64.
        rearm: decisions in a row that must be low.
        refractory: shortest distance of two alarms, in decisions.

    Shape:
        - statistic, number: ``[k]``, k at least 1
        - level: ``[1]``
        - memory: ``[3]``
    """
    graph, is_high = statistic.graph, statistic >= level

    def raise_(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        last = graph.where(state[0] <= row[0], row[1], state[0])
        return [last], [last]

    def awake() -> list[Value]:
        on, below, since = graph.ops("Split", memory, dtypes=[F64] * 3, axis=0, num_outputs=3)
        before = number.slice(0, 1, 0) - 1.0
        last = before - since
        high = _latest(is_high, before - below, number)  # the last one that was not low
        rearmed = _latest(number - high >= float(max(rearm, 1)), last - on, number)
        allowed = rearmed.minimum(number - float(refractory))
        allowed = graph.where(is_high, allowed, -math.inf)
        (end,), (alarms,) = graph.scan(raise_, [last.squeeze(0)], [allowed, number])
        is_on = alarms > rearmed
        now = _last(number)
        after = _last(is_on).cast(F64), now - _last(high), now - end
        return [alarms.eq(number), is_on, graph.concat(*after, axis=0)]

    def asleep() -> list[Value]:  # nothing is high
        num = number.length(0).cast(F64)
        return [is_high, is_high, memory + graph.constant([0, 0, 1], F64) * num]

    is_awake = (statistic.amax(0, keepdim=True) >= level) | (memory.slice(0, 1, 0) > 0.0)
    return Latched(*graph.if_(is_awake, awake, asleep))


def _count_up(num: Value) -> Value:
    """The whole numbers from 0 to before ``num`` ``[1]``, int64."""
    graph = num.graph
    return graph.op("Range", graph.constant(0, I64), num.squeeze(0), graph.constant(1, I64))


def _latest(mask: Value, start: Value, values: Value) -> Value:
    """The value where the mask held last, ``start`` ``[1]`` where it did not yet: ``[k]``."""
    graph = values.graph
    held = graph.concat(start, graph.op("Compress", values, mask, axis=0), axis=0)
    return graph.op("Gather", held, mask.cast(I64).cumsum(0), axis=0)


def _last(value: Value) -> Value:
    return value.slice(-1, END, 0)
