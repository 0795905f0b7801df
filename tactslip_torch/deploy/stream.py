"""The detector that watches a stream, as a graph: ``StreamingDetector.push``.

Samples become decisions, these a statistic (``onset.rules``), and that alarms. What one decision
hands to the next, and no more, is walked by a ``Scan``, an iteration of which costs as much as
several nodes do on all decisions together. While nothing speaks for slip, nothing is walked.
With an onset classifier decisions are its hop apart; its scores are those of ``OnsetStream.push``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from onnx import numpy_helper
from torch import Tensor

from tactslip_torch.deploy.bins import (
    SAID_OF_BIN,
    Precision,
    RawBin,
    Scored,
    Timing,
    dtype_of,
    memory_shapes,
    memory_size,
    rule_start,
    score_bins,
)
from tactslip_torch.deploy.head import machine, scaled
from tactslip_torch.deploy.value import BOOL, END, F64, I64, Graph, Value
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.evidence import MEAN_HOPS, OnsetClassifier, OnsetEvidence
from tactslip_torch.onset.rules import NEUTRAL, NOTHING_YET, Cusum, Rule
from tactslip_torch.signals.filtering import past_matrix

LATCH_START = (0.0, 0.0, 2.0**52)
"""Armed, with no alarm before; the last number counts on exactly in float64."""


def stream_graph(
    detector: SlipDetector, settings: AlarmSettings, precision: Precision = "float32"
) -> Graph:
    """The graph of a stream: what comes next, and what was kept, to decisions and what is kept.

    Inputs ``samples [n, C]``, ``tail [r, C]``, ``state [s]`` and ``threshold [t]``; outputs
    ``score``, ``probability``, ``statistic``, ``valid``, ``alarm``, ``on``, ``time_s``,
    ``onset_s``, ``[k]`` each, ``next_tail [Timing.tail, C]`` and ``next_state
    [Timing.state_size]``. A stream begins with an empty tail and state; without a threshold that of
    the settings counts. Where nothing can be decided, next to nothing is computed.

    State, in float64: samples and decisions so far, where the run of positive ratios began, whether
    an alarm stands, decisions in a row that were low, decisions since the last alarm, and the
    memory of the rule.

    With an onset classifier there are ``onset_score``, float64, and ``by_onset`` too, the threshold
    is the classifier's, and behind the memory of the rule the state has what is said of the last
    bin (``SAID_OF_BIN``) and the memory of blocks (``onset_scores``).

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

    onset = settings.onset
    before = 0.0 if onset is None else math.nan  # what no stream has is no evidence
    nothing = graph.constant(np.full((timing.tail, num_channels), before), dtype)
    held = graph.concat(nothing, tail, samples, axis=0)
    start = graph.constant([0, 0, 0, *LATCH_START, *rule_start(settings.rule)], F64)
    if onset is not None:
        says_nothing = graph.constant([0.0, settings.slip_share, NOTHING_YET, 0.0, math.inf], F64)
        start, given = graph.concat(start, says_nothing, axis=0), state
        small = timing.state_size - memory_size(onset.evidence)
        state = given.slice(0, small, 0)
    else:
        small = timing.state_size
    state = graph.concat(state, start, axis=0).slice(0, small, 0)
    seen = state.slice(0, 1, 0) + samples.length(0).cast(F64)
    decided = ((seen + float(timing.hop - timing.first)) / float(timing.hop)).floor().clamp(min=0.0)
    if timing.frame > timing.first:
        decided = graph.where(seen >= float(timing.frame), decided, 0.0)
    outputs: dict[str, np.dtype[Any]] = dict.fromkeys(("score", "probability", "statistic"), dtype)
    outputs |= dict.fromkeys(("valid", "alarm", "on"), BOOL)
    outputs |= dict.fromkeys(("time_s", "onset_s"), F64)
    if onset is not None:
        outputs |= {"onset_score": F64, "by_onset": BOOL}
    rate_hz = detector.pool.sample_rate_hz
    rearm, refractory = (
        settings.decisions(seconds, rate_hz)
        for seconds in (settings.rearm_s, settings.refractory_s)
    )

    def level(own: float, of_dtype: np.dtype[Any]) -> Value:
        """The threshold that is given, or the file's."""
        known = graph.concat(threshold, graph.constant([own], F64), axis=0)
        return known.slice(0, 1, 0).cast(of_dtype)

    def bins(made: Value, of_rule: Value) -> tuple[Value, Scored, Value, Value, Value]:
        """Number, scores, ratios and statistics of the next bins, and the memory of the rule."""
        places = _count_up((decided - made).cast(I64))
        number = places.cast(F64) + made
        windows = _windows(held, seen, made * float(timing.hop), places, detector, timing)
        scored = score_bins(windows.cast(dtype), detector)
        llr = graph.where(scored.is_usable, scored.llr(settings.calibration), NEUTRAL)
        return number, scored, llr, *statistic_of(settings.rule, llr, of_rule)

    def stated(ratio: Any) -> Any:
        return probability(ratio, settings.slip_share)

    def decide() -> list[Value]:
        sizes = graph.axes(1, 1, 1, 3, timing.state_size - 6)
        _, made, run, of_latch, of_rule = graph.ops("Split", state, sizes, dtypes=[F64] * 5, axis=0)
        number, scored, llr, statistic, of_rule = bins(made, of_rule)
        high = level(settings.threshold, dtype)
        latch = latched(statistic, high, number, of_latch, rearm=rearm, refractory=refractory)
        run = _latest(llr <= 0.0, run, number + 1.0)
        return [
            scored.score,
            stated(llr),
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

    def join(onset: OnsetClassifier) -> list[Value]:
        """Decisions a hop of the classifier apart, from its scores and the last bin by then."""
        num_said = len(SAID_OF_BIN)
        sizes = graph.axes(1, 1, 1, 3, small - 6 - num_said, num_said)
        parts = graph.ops("Split", state, sizes, dtypes=[F64] * 6, axis=0)
        before, made, run, of_latch, of_rule, said = parts
        memory = onset_memory(given, small, onset.evidence)

        def decide_bins() -> list[Value]:
            number, scored, llr, statistic, after = bins(made, of_rule)
            runs = _latest(llr <= 0.0, run, number + 1.0)
            unwaiting = replace(timing, frame=0)
            onset_s = _times_s(number, runs, settings, unwaiting, rate_hz)[1]
            columns = scored.score, stated(llr), statistic, scored.is_valid, onset_s
            made_rows = graph.concat(*(x.cast(F64).unsqueeze(1) for x in columns), axis=1)
            rows = graph.concat(said.unsqueeze(0), made_rows, axis=0)
            return [rows, decided, _last(runs), after]

        rows, *of_bins = graph.if_(
            decided > made, decide_bins, lambda: [said.unsqueeze(0), made, run, of_rule]
        )
        hop, of_bin = float(onset.evidence.hop_samples), float(timing.hop)
        hops, first = (seen / hop).floor(), (before / hop).floor()

        def next_state(of_latch: Value, memory: Sequence[Value]) -> Value:
            kept = (seen, *of_bins[:2], of_latch, of_bins[2], _last(rows).squeeze(0), *memory)
            return graph.concat(*kept, axis=0)

        def decide_hops() -> list[Value]:
            places = _count_up((hops - first).cast(I64))
            number = places.cast(F64) + first
            origin = first * hop - seen - float(onset.evidence.context)  # counted from the end
            x = held.slice(origin.cast(I64), END, 0)
            onset_score, after = onset_scores(x, places, memory, onset)
            by_onset = onset_score >= level(onset.threshold, F64)
            samples = (number + 1.0) * hop
            last = ((samples - float(timing.first)) / of_bin).floor()
            if timing.frame > timing.first:
                last = graph.where(samples >= float(timing.frame), last, -1.0)
            place = (last - made + 1.0).clamp(min=0.0).cast(I64)  # row 0 is what was known before
            told = graph.op("Gather", rows, place, axis=0)
            score, stated, statistic, valid, onset_s = (told[..., i] for i in range(num_said))
            statistic, time_s = statistic.cast(dtype), samples / rate_hz
            is_high = (by_onset | (statistic >= settings.threshold)).cast(F64)
            one, times = graph.constant([1.0], F64), {"rearm": rearm, "refractory": refractory}
            latch = latched(is_high, one, number, of_latch, **times)
            return [
                score.cast(dtype),
                stated.cast(dtype),
                statistic,
                valid.cast(BOOL),
                latch.alarm,
                latch.on,
                time_s,
                graph.where(by_onset, time_s - onset.lead_s, onset_s).minimum(time_s),
                onset_score,
                by_onset,
                next_state(latch.memory, after),
            ]

        def wait_for_hop() -> list[Value]:
            empty = [graph.constant([], kind) for kind in outputs.values()]
            return [*empty, next_state(of_latch, memory)]

        return graph.if_(hops > first, decide_hops, wait_for_hop)

    if onset is None:
        *made, next_state = graph.if_(decided > state.slice(1, 2, 0), decide, wait)
    else:
        *made, next_state = join(onset)
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


# Onset scores ----------------------------------------------------------------------------------


def onset_memory(state: Value, start: int, evidence: OnsetEvidence) -> list[Value]:
    """Scores of hops, half the log powers of blocks and their means, as a state has them; flat.

    Args:
        state: in which they lie last; empty: of no stream yet, NaN, on which no score rests.
        start: where they begin.
        evidence: whose they are.
    """
    graph = state.graph
    sizes = [MEAN_HOPS - 1, *(num * width for num, width in memory_shapes(evidence) if width)]

    def known() -> list[Value]:
        dtypes = [F64] * (1 + len(sizes))
        return list(graph.ops("Split", state, graph.axes(start, *sizes), dtypes=dtypes, axis=0))[1:]

    def nothing() -> list[Value]:
        nan = numpy_helper.from_array(np.array([np.nan]))
        return [graph.op("ConstantOfShape", graph.axes(n), dtype=F64, value=nan) for n in sizes]

    return graph.if_(state.length(0) > 0, known, nothing)


def onset_scores(
    samples: Value, places: Value, memory: Sequence[Value], classifier: OnsetClassifier
) -> tuple[Value, list[Value]]:
    """Scores of hops, ``NOTHING_YET`` where there is no evidence, and what is kept.

    Args:
        samples: from ``context`` samples before the first of these hops on; NaN before a stream.
        places: of the hops, from 0.
        memory: of ``onset_memory`` or the call before; as it is large, copied as seldom as can be.
        classifier: that scores.

    Shape:
        - samples: ``[m, C]``; places: ``[k]``, int64, k at least 1
        - output: ``[k]``, float64, and as memory
    """
    evidence, graph = classifier.evidence, samples.graph
    fast, slow = evidence.hand.fast, evidence.hand.slow
    hop, context, num_filters = evidence.hop_samples, evidence.context, len(evidence.fast_knee)
    longest, num_windows = evidence.windows[-1], len(evidence.windows)
    first = places.unsqueeze(1)

    def windows(rows: Value, start: Value, places: range) -> Value:
        """Rows at some places behind each start: ``[m, *]`` to ``[k, places, *]``."""
        return graph.op("Gather", rows, start + graph.axes(*places), axis=0)

    frames = windows(samples.take(fast, 1), first * hop, range(context + hop)).cast(F64)
    filters = evidence.filter_matrix.reshape(context + hop, -1).T
    heard = graph.constant(filters, F64) @ (frames - frames.slice(0, 1, 1))
    to_power = np.kron(np.eye(num_filters), np.full(hop, 1 / hop))
    square = graph.constant(to_power, F64) @ (heard * heard)  # [k, B, F]
    power = square + np.square(evidence.fast_knee)[:, None]
    made = [power.reshape(0, num_filters * len(fast)).log() * 0.5]
    if slow:
        block = windows(samples.take(slow, 1), first * hop, range(context, context + hop))
        made.append(block.cast(F64).mean(1))
    shapes = memory_shapes(evidence)[: len(made)]
    of_hops, *kept = memory
    kept = [x.reshape(*shape) for x, shape in zip(kept, shapes, strict=True)]

    def latest(of: int, num: int) -> Value:
        """Rows up to each hop, as many: ``[k, num, *]``."""
        rows = graph.concat(kept[of].slice(1 - num, END, 0), made[of], axis=0)
        return windows(rows, first, range(num))

    num_floor = evidence.memory - longest

    def one_floor() -> list[Value]:  # by a product, which copies nothing
        weights = np.append(np.full(num_floor, 1 / num_floor), np.zeros(longest - 1))
        return [graph.constant(weights[None], F64) @ kept[0]]

    def floors() -> list[Value]:
        rows = graph.concat(kept[0], made[0], axis=0)
        return [windows(rows, first, range(num_floor)).mean(1)]

    (floor,) = graph.if_(places.length(0).eq(1), one_floor, floors)
    to_means = np.zeros((num_windows, longest))
    for row, length in zip(to_means, evidence.windows, strict=True):
        row[-length:] = 1 / length
    power = (latest(0, longest) * 2.0).exp()
    measured: list[Any] = [
        (graph.constant(to_means, F64) @ power).reshape(0, num_windows, num_filters, len(fast)),
        floor.reshape(0, num_filters, len(fast)),
        None,
        graph.constant(np.ones(len(fast)), BOOL),
        None,
    ]
    if slow:
        means = latest(1, len(evidence.step_matrix))
        measured[2] = graph.constant(evidence.step_matrix.T, F64) @ (means - means.slice(0, 1, 1))
        measured[4] = graph.constant(np.ones(len(slow)), BOOL)
    pooled: Any = evidence.pooled(*measured)
    columns, is_usable = pooled
    score = machine(scaled(columns, classifier.scaler), classifier.head, F64)
    scores = graph.concat(of_hops, graph.where(is_usable, score, math.nan), axis=0)
    mean = windows(scores, first, range(MEAN_HOPS)).mean(1)
    after = [scores.slice(1 - MEAN_HOPS, END, 0)]
    for before, own, (num, _) in zip(kept, made, shapes, strict=True):
        after.append(before.slice(own.length(0), END, 0).reshape(-1))
        after.append(own.slice(-num, END, 0).reshape(-1))
    return graph.where(mean.isfinite(), mean, NOTHING_YET), after


# Rules and alarms ------------------------------------------------------------------------------


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
