"""The detector that watches a stream, as a graph: ``StreamingDetector.push``.

What one decision hands to the next is walked by a ``Scan``; while nothing speaks for slip, nothing
is walked. With an onset classifier decisions are its hop apart, with the scores of
``OnsetStream.push``.
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
    OF_LAST_BIN,
    Precision,
    RawBin,
    Scored,
    Timing,
    dtype_of,
    machine,
    memory_shapes,
    memory_sizes,
    rule_start,
    scaled,
    score_bins,
)
from tactslip_torch.deploy.value import BOOL, END, F64, I64, Graph, Value
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.onset.decisions import LARGEST, AlarmSettings
from tactslip_torch.onset.evidence import (
    FEWEST_BLOCK_SAMPLES,
    FLOORS_S,
    MEAN_HOPS,
    OnsetClassifier,
    OnsetEvidence,
)
from tactslip_torch.onset.rules import NOTHING_YET, Cusum, Rule, most_lost
from tactslip_torch.signals.filtering import past_matrix

_LATCH_START = (0.0, 0.0, 2.0**52)
"""Armed, with no alarm before; the last number counts on exactly in float64."""


def stream_graph(
    detector: SlipDetector, settings: AlarmSettings, precision: Precision = "float32"
) -> Graph:
    """The graph of a stream: what comes next, and what was kept, to decisions and what is kept.

    Inputs ``samples [n, C]``, ``tail [r, C]``, ``state [s]`` and ``threshold [t]``; outputs
    ``score``, ``probability``, ``statistic``, ``valid``, ``in_range``, ``alarm``, ``on``,
    ``time_s``, ``onset_s``, ``[k]`` each, ``channels_lost [k, C]``, ``next_tail [Timing.tail, C]``
    and ``next_state [Timing.state_size]``. A stream begins with an empty tail and state; without a
    threshold that of the settings counts. Where nothing can be decided, next to nothing is
    computed.

    State, in float64: samples and decisions so far, where the run of positive ratios began, whether
    an alarm stands, decisions in a row that were low, decisions since the last alarm, decisions in
    a row that are not valid, the last sample of each channel, how many were equal to it, and the
    memory of the rule.

    With an onset classifier there are ``onset_score``, float64, ``by_onset`` and ``hint`` too, the
    threshold is the classifier's, and behind the memory of the rule the state has decisions of the
    alarm in a row that are not valid, the last bin's columns (``OF_LAST_BIN``, and the channels
    that were lost) and the memory of blocks (``_onset_scores``).

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
    no_sample = [math.nan] * num_channels + [0.0] * num_channels
    starts = [0, 0, 0, *_LATCH_START, 0, *no_sample, *rule_start(settings.rule)]
    start = graph.constant(starts, F64)
    if onset is not None:
        no_bin = [0.0, *([math.nan] * 3), 0.0, 0.0, math.inf, *([0.0] * num_channels)]
        start, given = graph.concat(start, graph.constant(no_bin, F64), axis=0), state
        small = timing.state_size - sum(memory_sizes(onset))
        state = given.slice(0, small, 0)
    else:
        small = timing.state_size
    state = graph.concat(state, start, axis=0).slice(0, small, 0)
    marked, stuck = _without_stuck(
        samples, state.slice(7, 7 + 2 * num_channels, 0), detector.sensing.stuck_samples
    )
    held = graph.concat(nothing, tail, marked, axis=0)
    seen = state.slice(0, 1, 0) + samples.length(0).cast(F64)
    decided = ((seen + float(timing.hop - timing.first)) / float(timing.hop)).floor().clamp(min=0.0)
    if timing.frame > timing.first:
        decided = graph.where(seen >= float(timing.frame), decided, 0.0)
    outputs: dict[str, np.dtype[Any]] = dict.fromkeys(("score", "probability", "statistic"), dtype)
    outputs |= dict.fromkeys(("valid", "in_range", "alarm", "on"), BOOL)
    outputs |= dict.fromkeys(("time_s", "onset_s"), F64)
    outputs["channels_lost"] = BOOL
    if onset is not None:
        outputs |= {"onset_score": F64, "by_onset": BOOL, "hint": BOOL}
    rate_hz = detector.pool.sample_rate_hz
    latch_times = tuple(settings.latch_times(rate_hz).values())
    decision_samples = settings.decision_samples
    window = timing.raw.length
    hold = round(settings.hold_s * rate_hz)

    def level(own: float, of_dtype: np.dtype[Any]) -> Value:
        """The threshold that is given, or the file's."""
        known = graph.concat(threshold, graph.constant([own], F64), axis=0)
        return known.slice(0, 1, 0).cast(of_dtype)

    def bins(made: Value) -> tuple[Value, Scored, Value]:
        """Number, scores and ratios of the next bins; a ratio counts where the score is valid."""
        places = _count_up((decided - made).cast(I64))
        number = places.cast(F64) + made
        windows = _windows(held, seen, made * float(timing.hop), places, detector, timing)
        scored = score_bins(windows.cast(dtype), detector, settings.sensing(detector.sensing))
        known: Any = graph.where(scored.is_valid, scored.score, 0.0)
        llr: Any = settings.calibration.llr(known)
        return number, scored, llr.clamp(-LARGEST, LARGEST)

    def gathered(
        number: Value, scored: Scored, llr: Value, run: Value, of_rule: Value, lost: Value
    ) -> list[Value]:
        """Statistics, where runs of positive ratios began, and what rule and ``lost`` are then."""

        def simply() -> list[Value]:
            statistic, after = _statistic_of(settings.rule, llr, of_rule)
            return [statistic, _latest(llr <= 0.0, run, number + 1.0), after, lost]

        def with_gaps() -> list[Value]:
            gaps = _Gaps.of(scored.is_valid, number, lost, most)
            statistic, after = gaps.statistic_of(settings.rule, llr, of_rule)
            is_end = ((llr <= 0.0) & scored.is_valid) | gaps.is_over
            return [statistic, _latest(is_end, run, number + 1.0), after, gaps.lost_after]

        return graph.if_(_is_whole(scored.is_valid, lost), simply, with_gaps)

    def raised(
        statistic: Value, high: Value, number: Value, of_latch: Value, valid: Value, lost: Value
    ) -> list[Value]:
        """Alarms, whether one stands, and what latch and ``lost`` are then."""

        def simply() -> list[Value]:
            return [*_latched(statistic, high, number, of_latch, *latch_times), lost]

        def with_gaps() -> list[Value]:
            gaps = _Gaps.of(valid, number, lost, most_lost(window, hold, decision_samples))
            return [*gaps.latched(statistic, high, number, of_latch, *latch_times), gaps.lost_after]

        return graph.if_(_is_whole(valid, lost), simply, with_gaps)

    def only_valid(value: Any, scored: Scored) -> Value:
        return graph.where(scored.is_valid, value, math.nan)

    def stated(ratio: Any) -> Any:
        return probability(ratio, settings.slip_share)

    most = most_lost(window, hold, timing.hop)
    sizes_before = [1, 1, 1, 3, 1, 2 * num_channels, len(rule_start(settings.rule))]

    def decide() -> list[Value]:
        parts = graph.ops("Split", state, graph.axes(*sizes_before), dtypes=[F64] * 7, axis=0)
        _, made, run, of_latch, lost, _, of_rule = parts
        number, scored, llr = bins(made)
        high = level(settings.threshold, dtype)
        statistic, runs, after, _ = gathered(number, scored, llr, run, of_rule, lost)
        alarm, on, memory, lost = raised(statistic, high, number, of_latch, scored.is_valid, lost)
        return [
            scored.score,
            only_valid(stated(llr), scored),
            statistic,
            scored.is_valid,
            scored.in_range,
            alarm,
            on,
            *_times_s(number, runs, settings, timing, rate_hz),
            scored.channels_lost,
            graph.concat(seen, decided, _last(runs), memory, lost, stuck, after, axis=0),
        ]

    def nothing_made() -> list[Value]:
        empty = [graph.constant([], kind) for kind in outputs.values()]
        place = list(outputs).index("channels_lost")
        empty[place] = graph.constant(np.zeros((0, num_channels)), BOOL)
        return empty

    def wait() -> list[Value]:
        rest = state.slice(7 + 2 * num_channels, END, 0)
        return [*nothing_made(), graph.concat(seen, state.slice(1, 7, 0), stuck, rest, axis=0)]

    def join(onset: OnsetClassifier) -> list[Value]:
        """Decisions a hop of the classifier apart, from its scores and the last bin by then."""
        num_kept = len(OF_LAST_BIN) + num_channels
        sizes = graph.axes(*sizes_before, 1, num_kept)
        parts = graph.ops("Split", state, sizes, dtypes=[F64] * 9, axis=0)
        before, made, run, of_latch, lost, _, of_rule, alarm_lost, last_bin = parts
        memory = _onset_memory(given, small, onset)

        def decide_bins() -> list[Value]:
            number, scored, llr = bins(made)
            statistic, runs, after, now_lost = gathered(number, scored, llr, run, of_rule, lost)
            unwaiting = replace(timing, frame=0)
            onset_s = _times_s(number, runs, settings, unwaiting, rate_hz)[1]
            columns = (
                scored.score,
                only_valid(stated(llr), scored),
                statistic,
                scored.is_valid,
                scored.in_range,
                onset_s,
            )
            of_bins = [x.cast(F64).unsqueeze(1) for x in columns]
            made_rows = graph.concat(*of_bins, scored.channels_lost.cast(F64), axis=1)
            rows = graph.concat(last_bin.unsqueeze(0), made_rows, axis=0)
            return [rows, decided, _last(runs), after, now_lost]

        rows, *of_bins = graph.if_(
            decided > made, decide_bins, lambda: [last_bin.unsqueeze(0), made, run, of_rule, lost]
        )
        hop, of_bin = float(onset.evidence.hop_samples), float(timing.hop)
        hops, first = (seen / hop).floor(), (before / hop).floor()

        def next_state(of_latch: Value, alarm_lost: Value, memory: Sequence[Value]) -> Value:
            now_decided, run, after, lost = of_bins
            kept = (seen, now_decided, run, of_latch, lost, stuck, after, alarm_lost)
            return graph.concat(*kept, _last(rows).squeeze(0), *memory, axis=0)

        def decide_hops() -> list[Value]:
            places = _count_up((hops - first).cast(I64))
            number = places.cast(F64) + first
            origin = first * hop - seen - float(onset.evidence.context)  # counted from the end
            x = held.slice(origin.cast(I64), END, 0)
            most_blocks = most_lost(onset.evidence.context + int(hop), hold, int(hop))
            onset_score, after = _onset_scores(x, places, memory, onset, most_blocks)
            by_onset = onset_score >= level(onset.threshold, F64)
            samples = (number + 1.0) * hop
            last = ((samples - float(timing.first)) / of_bin).floor()
            if timing.frame > timing.first:
                last = graph.where(samples >= float(timing.frame), last, -1.0)
            place = (last - made + 1.0).clamp(min=0.0).cast(I64)  # row 0 is what was known before
            at_hop = graph.op("Gather", rows, place, axis=0)
            score, stated, statistic, valid, in_range, onset_s = (
                at_hop[..., i] for i in range(len(OF_LAST_BIN))
            )
            statistic, time_s = statistic.cast(dtype), samples / rate_hz
            is_known = onset_score > NOTHING_YET
            hinted = onset_score >= onset.hint
            if math.isfinite(onset.hint):
                hinted |= by_onset  # as a threshold that is given may be below it
            is_high = by_onset.cast(F64)
            one = graph.constant([1.0], F64)
            alarm, on, of_alarm, now_lost = raised(
                is_high, one, number, of_latch, is_known, alarm_lost
            )
            return [
                score.cast(dtype),
                stated.cast(dtype),
                statistic,
                valid.cast(BOOL) | is_known,
                in_range.cast(BOOL),
                alarm,
                on,
                time_s,
                graph.where(by_onset, time_s - onset.lead_s, onset_s).minimum(time_s),
                at_hop.slice(len(OF_LAST_BIN), END, 1).cast(BOOL),
                onset_score,
                by_onset,
                hinted,
                next_state(of_alarm, now_lost, after),
            ]

        def wait_for_hop() -> list[Value]:
            return [*nothing_made(), next_state(of_latch, alarm_lost, memory)]

        return graph.if_(hops > first, decide_hops, wait_for_hop)

    if onset is None:
        *made, next_state = graph.if_(decided > state.slice(1, 2, 0), decide, wait)
    else:
        *made, next_state = join(onset)
    for name, value in zip(outputs, made, strict=True):
        graph.output(name, value, ("k", num_channels) if name == "channels_lost" else ("k",))
    graph.output("next_tail", held.slice(-timing.tail, END, 0), (timing.tail, num_channels))
    graph.output("next_state", next_state, (timing.state_size,))
    return graph


def _windows(
    held: Value, seen: Value, start: Value, places: Value, detector: SlipDetector, timing: Timing
) -> Value:
    """The raw samples of each decision, ``[k, channels in use, RawBin.length]``.

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
    x = held.slice(origin.cast(I64), END, 0).take(raw.channels, 1)
    if raw.before:
        x = graph.if_(
            start < float(raw.before),
            lambda: [_with_past(x, start.cast(I64), detector, raw)],
            lambda: [x],
        )[0]
    index = (places * timing.hop).unsqueeze(1) + graph.axes(*range(raw.length))
    return graph.op("Gather", x, index, axis=0).transpose(0, 2, 1)


def _with_past(x: Value, start: Value, detector: SlipDetector, raw: RawBin) -> Value:
    """The first raw bin and what follows, with a made-up past before the stream's start.

    Args:
        x: ``[m, channels in use]``, from ``RawBin.before`` samples before ``start``.
        start: of the first bin, a sample of the stream, ``[1]``.
        detector: whose filter makes the past up.
        raw: its raw bin.
    """
    graph, layer = x.graph, detector.channel_filter
    known = x.slice(-start + raw.before, END, 0)
    lengths = [layer.window_lengths[channel] for channel in raw.channels]
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


def _without_stuck(samples: Value, known: Value, most: int) -> tuple[Value, Value]:
    """Samples with NaN where a channel is stuck (``StuckChannels``), and what is kept.

    Args:
        samples: that came next.
        known: the last sample of each channel, and how many were equal to it, one behind the other.
        most: equal samples in a row that are let pass.

    Shape:
        - samples: ``[n, C]``, n may be 0; known: ``[2 C]``, float64
    """
    graph = samples.graph
    num = samples.length(0)

    def mark() -> list[Value]:
        sizes = graph.op("Div", known.length(0), graph.axes(2))
        last, run = (
            each.unsqueeze(0) for each in (known.slice(0, sizes, 0), known.slice(sizes, END, 0))
        )
        before = graph.concat(last.cast(samples.dtype), samples.slice(0, -1, 0), axis=0)
        is_new = ~samples.eq(before)
        places = (_count_up(num).cast(F64) + 1.0).unsqueeze(1)  # [n, 1]
        counted = num.cast(F64)
        began = graph.where(is_new, places, 0.0).amax(0, keepdim=True)
        run_after = graph.where(began > 0.0, counted + 1.0 - began, run + counted)

        def is_stuck() -> list[Value]:
            seen = is_new.cast(I64).cumsum(0)
            none = graph.op("Sub", seen.slice(0, 1, 0), seen.slice(0, 1, 0))
            ago = (places - float(most)).maximum(0.0).squeeze(1).cast(I64)
            earlier = graph.op("Gather", graph.concat(none, seen, axis=0), ago, axis=0)
            keeps = seen.eq(earlier) & ((run + places) > float(most))
            return [graph.where(keeps, math.nan, samples)]

        may_be = (run.amax(1) + counted).squeeze(0) > float(most)
        marked = graph.if_(may_be, is_stuck, lambda: [samples])[0]
        now = samples.slice(-1, END, 0).cast(F64).squeeze(0)
        return [marked, graph.concat(now, run_after.squeeze(0), axis=0)]

    marked, after = graph.if_(num.squeeze(0) > 0, mark, lambda: [samples, known])
    return marked, after


# Onset scores ----------------------------------------------------------------------------------


def _onset_memory(state: Value, start: int, onset: OnsetClassifier) -> list[Value]:
    """What is kept of a stream's evidence (``memory_sizes``); flat, but for empty parts.

    Args:
        state: in which they lie last; empty: of no stream yet, NaN, on which no score rests.
        start: where they begin.
        onset: whose they are.
    """
    graph = state.graph
    sizes = [size for size in memory_sizes(onset) if size]

    def known() -> list[Value]:
        dtypes = [F64] * (1 + len(sizes))
        return list(graph.ops("Split", state, graph.axes(start, *sizes), dtypes=dtypes, axis=0))[1:]

    def nothing() -> list[Value]:
        nan = numpy_helper.from_array(np.array([np.nan]))
        none = [graph.constant([0.0], F64)] * 2
        return none + [
            graph.op("ConstantOfShape", graph.axes(n), dtype=F64, value=nan) for n in sizes[2:]
        ]

    return graph.if_(state.length(0) > 0, known, nothing)


class _Measured(NamedTuple):
    """Rows of blocks, ``[k, width]`` each; of no channels None.

    Attributes:
        logs: half the log powers, filter by filter.
        products: mean products of pairs.
        means: of slow channels.
        is_known: which blocks are not lost, ``[k]``, bool.
    """

    logs: Value | None
    products: Value | None
    means: Value | None
    is_known: Value


def _measured(samples: Value, places: Value, evidence: OnsetEvidence) -> _Measured:
    """``OnsetEvidence.blocks`` and which are not lost; arguments as of ``_onset_scores``."""
    graph, first = samples.graph, places.unsqueeze(1)
    fast, slow = evidence.hand.fast, evidence.hand.slow
    hop, context, num_filters = evidence.hop_samples, evidence.context, evidence.num_filters
    logs = products = means = None
    if fast:
        frames = _rows(samples.take(fast, 1), first * hop, range(context + hop)).cast(F64)
        filters = evidence.filter_matrix.reshape(context + hop, -1).T
        heard = graph.constant(filters, F64) @ (frames - frames.slice(0, 1, 1))
        to_mean = graph.constant(np.kron(np.eye(num_filters), np.full(hop, 1 / hop)), F64)
        of_fast = (to_mean @ (heard * heard) + evidence.rounding).log() * 0.5  # [k, B, F]
        logs = of_fast.reshape(0, num_filters * len(fast))
        if len(fast) > 1:
            one, other = (heard.take(of.tolist(), 2) for of in evidence.pairs)
            products = (to_mean @ (one * other)).reshape(0, -1)
        known = of_fast.sum(1).isfinite()
        moves = (of_fast - evidence.silence).amax(1) > 0.0
        if hop >= FEWEST_BLOCK_SAMPLES:
            own = frames.slice(context, END, 1)
            moves = moves & ~(own - own.slice(0, 1, 1)).abs().amax(1).eq(0.0)
        is_still = graph.constant(evidence.is_still or [False] * len(fast), BOOL)
        known = known & (moves | is_still)
    if slow:
        block = _rows(samples.take(slow, 1), first * hop, range(context, context + hop))
        means = block.cast(F64).mean(1)
        if not fast:
            known = means.isfinite()
    is_known = known.cast(F64).sum(1) >= float(evidence.min_alive)
    return _Measured(logs, products, means, is_known)


def _onset_scores(
    samples: Value,
    places: Value,
    memory: Sequence[Value],
    onset: OnsetClassifier,
    most: int,
) -> tuple[Value, list[Value]]:
    """Scores of hops, ``NOTHING_YET`` where there is no evidence, and what is kept.

    Args:
        samples: from ``context`` samples before the first of these hops on; NaN before a stream.
        places: of the hops, from 0.
        memory: of ``_onset_memory`` or the call before.
        onset: that scores.
        most: lost blocks in a row, beyond which the memory begins anew.

    Shape:
        - samples: ``[m, C]``; places: ``[k]``, int64, k at least 1
        - output: ``[k]``, float64, and as memory
    """
    evidence, graph = onset.evidence, samples.graph
    made = _measured(samples, places, evidence)
    lost, filled, of_hops, *rows = memory
    shapes = [shape for shape in memory_shapes(onset) if all(shape)]
    *kept, floors = rows
    kept = [x.reshape(*shape) for x, shape in zip(kept, shapes, strict=True)]

    def scores_of(measured: _Measured, begins: Value) -> list[Value]:
        """Scores of known blocks, the first of whose streams stand at ``begins``, below 0 before.

        And what is kept, but for ``lost``.
        """
        num = begins.length(0)
        number = _count_up(num).cast(F64) - begins.cast(F64) + 1.0  # of each block in its stream
        scores, after = _scores_of_known(measured, begins, number, kept, floors, onset)
        scores = graph.concat(of_hops, scores, axis=0)
        mean = _rows(scores, _count_up(num).unsqueeze(1), range(MEAN_HOPS)).mean(1)
        mean = graph.where(mean.isfinite(), mean, NOTHING_YET)
        return [mean, _last(number), scores.slice(1 - MEAN_HOPS, END, 0), *after]

    before = (filled * -1.0).cast(I64)  # where the stream of before began

    def all_known() -> list[Value]:
        mean, *after = scores_of(made, before + places * 0)
        return [mean, lost * 0.0, *after]

    def some_lost() -> list[Value]:
        gaps = _Gaps.of(made.is_known, places.cast(F64), lost, most)

        def nothing_known() -> list[Value]:
            mean = graph.where(made.is_known, 0.0, graph.constant([NOTHING_YET], F64))
            return [mean, filled, of_hops, *rows]

        def those_known() -> list[Value]:
            parts = (None if part is None else gaps.valid_of(part) for part in made)
            own = _Measured(*parts)  # type: ignore[arg-type]  # flags are there
            place = _count_up(own.is_known.length(0))
            begins = _latest(gaps.valid_of(gaps.begins_anew), before, place)
            mean, *after = scores_of(own, begins)
            mean = gaps.spread(mean, graph.constant([NOTHING_YET], F64))
            return [graph.where(made.is_known, mean, NOTHING_YET), *after]

        mean, *after = graph.if_(gaps.has_valid, those_known, nothing_known)
        return [mean, gaps.lost_after, *after]

    score, *after = graph.if_(_is_whole(made.is_known, lost), all_known, some_lost)
    return score, after


def _scores_of_known(
    measured: _Measured,
    begins: Value,
    number: Value,
    kept: Sequence[Value],
    floors: Value,
    onset: OnsetClassifier,
) -> tuple[Value, list[Value]]:
    """``OnsetClassifier.scores``, NaN without evidence, and the rows and floors that are kept.

    Args:
        measured: of known blocks, ``k`` of them.
        begins: place of the first block of each one's stream; below 0: before these.
        number: of each block in its stream, from 1.
        kept: rows of the blocks before; of no stream yet NaN.
        floors: of the blocks before.
        onset: that scores.
    """
    evidence, graph = onset.evidence, begins.graph
    fast, slow, num_filters = evidence.hand.fast, evidence.hand.slow, evidence.num_filters
    num, places, delay = begins.length(0), _count_up(begins.length(0)).unsqueeze(1), evidence.delay
    given, rows, after = list(kept), list[Value](), list[Value]()

    def joined(latest: Value) -> tuple[Value, int, Value]:
        """Rows with those that are kept, how many these are, and the first place that counts."""
        before = given.pop(0)
        size = [s for s in memory_shapes(onset) if all(s)][len(rows)][0]
        rows.append(graph.concat(before, latest, axis=0))
        lowest = (begins + size).maximum(0).unsqueeze(1)
        end = _count_up(graph.axes(size)) + num
        after.append(graph.op("Gather", rows[-1], end.maximum(_last(lowest).squeeze(1)), axis=0))
        return rows[-1], size, lowest

    def latest(of: tuple[Value, int, Value], back: range) -> Value:
        """Rows so many blocks back of each block, none before its stream: ``[k, back, width]``."""
        all_rows, size, lowest = of
        index = (places + graph.axes(*(size - i for i in back))).maximum(lowest)
        return graph.op("Gather", all_rows, index, axis=0)

    longest = range(delay - 1, -1, -1)
    to_means = [
        graph.constant(np.r_[np.zeros(delay - n), np.full(n, 1 / n)][None], F64)
        for n in evidence.windows
    ]
    power, products, delayed = list[Value](), list[Value](), list[Value]()
    if measured.logs is not None:
        logs = joined(measured.logs)
        powers = (latest(logs, longest) * 2.0).exp()
        power = [(each @ powers).reshape(0, num_filters, len(fast)) for each in to_means]
        delayed = [latest(logs, range(delay, delay + 1)).squeeze(1)] * len(FLOORS_S)
    if measured.products is not None:
        pairs = latest(joined(measured.products), longest)
        shape = (num_filters, evidence.pairs.shape[1])
        products = [(each @ pairs).reshape(0, *shape) for each in to_means]
    steps: Any = None
    if measured.means is not None:
        reach, num_steps = len(evidence.step_matrix), evidence.step_matrix.shape[1]
        means = latest(joined(measured.means), range(reach - 1, -1, -1))
        steps = graph.constant(evidence.step_matrix.T, F64) @ (means - means.slice(0, 1, 1))
        sizes = joined(steps.abs().reshape(0, num_steps * len(slow)))
        delayed.append(latest(sizes, range(delay, delay + 1)).squeeze(1))
    usual, now = _followed(graph.concat(*delayed, axis=1), number, floors, evidence)
    num_logs = num_filters * len(fast)
    of_logs = [
        usual.slice(i * num_logs, (i + 1) * num_logs, 1).reshape(0, num_filters, len(fast))
        for i in range(len(FLOORS_S) if fast else 0)
    ]
    of_steps: Any = None
    if slow:
        of_steps = usual.slice(len(of_logs) * num_logs, END, 1).reshape(0, num_steps, len(slow))
    in_use: list[Any] = [graph.constant(np.ones(len(each)), BOOL) for each in (fast, slow)]
    pooled: Any = evidence.pooled(
        *(power, products, of_logs),  # type: ignore[arg-type]  # values in place of tensors
        *(steps, of_steps, *in_use),
    )
    columns, is_usable = pooled
    inputs = scaled(columns, onset.scaler)
    if lags := onset.lags:
        of_before = joined(inputs)
        back = [latest(of_before, range(lag, lag + 1)).squeeze(1) for lag in lags]
        inputs = graph.concat(inputs, *back, axis=1)
    head: Any = onset.head
    score = machine(inputs, head, F64) if isinstance(head, QuadraticForm) else head(inputs)
    is_usable = is_usable & (number > float(evidence.blind))
    flat = [each.reshape(-1) for each in after]
    return graph.where(is_usable, score, math.nan), [*flat, now]


def _followed(
    values: Value, number: Value, floors: Value, evidence: OnsetEvidence
) -> tuple[Value, Value]:
    """Recursive means of delayed values, as ``OnsetEvidence`` has its floors; the last of them.

    Shape:
        - values: ``[k, V]``; number: ``[k]``, of each block in its stream; floors: ``[V]``
    """
    graph, num_fast = values.graph, len(evidence.hand.fast)
    num_logs = evidence.num_filters * num_fast
    rates = np.repeat(evidence.floor_rates, num_logs)
    num_sizes = evidence.step_matrix.shape[1] * len(evidence.hand.slow)
    rates = np.r_[rates, np.full(num_sizes, evidence.floor_rates[0])]
    since = (number - float(evidence.delay)).clamp(min=1.0).unsqueeze(1)
    rate = (1.0 / since).maximum(rates)  # [k, V]
    is_first = number.eq(1.0).unsqueeze(1).cast(F64) + rate * 0.0

    def follow(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        x, share, anew = row
        before = graph.where(anew > 0.0, math.nan, state[0])
        known = graph.where(before.isfinite(), before, x)
        after = graph.where(x.isfinite(), known + share * (x - known), before)
        return [after], [after]

    (after,), (made,) = graph.scan(follow, [floors], [values, rate, is_first], (len(rates),))
    return made, after


def _rows(rows: Value, start: Value, places: range) -> Value:
    """Rows at some places behind each start: ``[m, *]`` to ``[k, places, *]``."""
    return rows.graph.op("Gather", rows, start + rows.graph.axes(*places), axis=0)


# Rules and alarms ------------------------------------------------------------------------------


def _statistic_of(
    rule: Rule, llr: Value, memory: Value, anew: Value | None = None
) -> tuple[Value, Value]:
    """The statistic of each decision as the rule's ``scan_row`` makes it, and the memory behind.

    Args:
        rule: whose statistic.
        llr: finite ratios.
        memory: of ``rule_start`` or the call before.
        anew: decisions with which the rule begins anew, ``[k]``, bool; default: none.

    Shape:
        - llr, statistic: ``[k]``, k at least 1
        - memory: as many as ``rule_start`` gives, float64
    """
    graph, before = llr.graph, memory.cast(llr.dtype)
    if isinstance(rule, Cusum):
        step = llr - rule.drift if rule.drift else llr
        step = step * rule.evidence if rule.evidence != 1 else step

        rows = [step] if anew is None else [step, graph.where(anew, 0.0, step * 0.0 + 1.0)]

        def add(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
            total = state[0] + row[0] if anew is None else state[0] * row[1] + row[0]
            return [total.clamp(0.0, rule.ceiling)], [total]

        # where every step takes away at least what is there, the sum is 0 without a walk
        is_quiet = before + step.amax(0, keepdim=True) <= 0.0
        totals = graph.if_(
            is_quiet, lambda: [step], lambda: graph.scan(add, [before.squeeze(0)], rows)[1]
        )
        total = totals[0].clamp(0.0, rule.ceiling)
        return total, _last(total).cast(F64)
    if rule.n == 1:
        return llr, memory
    known = graph.concat(before, llr, axis=0)  # [n - 1 + k]
    places = _count_up(llr.length(0)).unsqueeze(1) + graph.axes(*range(rule.n))
    last_n = graph.op("Gather", known, places, axis=0)  # [k, n]
    kept = known.slice(1 - rule.n, END, 0).cast(F64)
    if anew is not None:  # what was before a beginning is not known
        run = anew.cast(I64).cumsum(0)
        run = graph.concat(graph.constant([0] * (rule.n - 1), I64), run, axis=0)
        is_own = graph.op("Gather", run, places, axis=0).eq(
            run.slice(rule.n - 1, END, 0).unsqueeze(1)
        )
        last_n = graph.where(is_own, last_n, NOTHING_YET)
        kept = graph.where(run.slice(1 - rule.n, END, 0).eq(_last(run)), kept, NOTHING_YET)
    largest = graph.ops("TopK", last_n, graph.axes(rule.k), dtypes=(None, I64))[0]
    return largest.slice(rule.k - 1, rule.k, 1).squeeze(1), kept


class _Gaps(NamedTuple):
    """Decisions of which some are not valid: these are left out, and put back (``rules``).

    Attributes:
        valid: which count, ``[k]``, bool.
        has_valid: whether any does.
        begins_anew: valid ones behind more than ``most`` that are not, ``[k]``, bool.
        is_over: those that are not, behind at least ``most``, ``[k]``, bool.
        lost_after: not valid ones in a row at the end, ``[1]``.
    """

    valid: Value
    has_valid: Value
    begins_anew: Value
    is_over: Value
    lost_after: Value

    @classmethod
    def of(cls, valid: Value, number: Value, lost: Value, most: int) -> _Gaps:
        """Of decisions.

        Args:
            valid: which count.
            number: of each, ``[k]``, float64, rising by one.
            lost: decisions in a row before these that do not, ``[1]``.
            most: of these in a row that change nothing.
        """
        graph = valid.graph
        before = number.slice(0, 1, 0) - lost - 1.0
        in_row = number - _latest(valid, before, number)
        ahead = graph.concat(lost, in_row.slice(0, -1, 0), axis=0)
        has_valid = valid.cast(I64).amax(0).cast(BOOL)
        anew = valid & (ahead > float(most))
        return cls(valid, has_valid, anew, in_row > float(most), _last(in_row))

    def valid_of(self, values: Value) -> Value:
        """Those of valid decisions."""
        return values.graph.op("Compress", values, self.valid, axis=0)

    def spread(self, values: Value, before: Value) -> Value:
        """Values of valid decisions to all, of others the last one; ``before [1]`` the first."""
        graph = values.graph
        place = self.valid.cast(I64).cumsum(0)
        return graph.op("Gather", graph.concat(before, values, axis=0), place, axis=0)

    def statistic_of(self, rule: Rule, llr: Value, memory: Value) -> tuple[Value, Value]:
        """As ``_statistic_of``; NaN where not valid."""
        graph = llr.graph

        def some() -> list[Value]:
            own, anew = self.valid_of(llr), self.valid_of(self.begins_anew)
            found, after = _statistic_of(rule, own, memory, anew)
            return [self.spread(found, graph.constant([math.nan], llr.dtype)), after]

        def none() -> list[Value]:
            return [llr, memory]

        found, after = graph.if_(self.has_valid, some, none)
        return graph.where(self.valid, found, math.nan), after

    def latched(
        self,
        statistic: Value,
        level: Value,
        number: Value,
        memory: Value,
        rearm: int,
        refractory: int,
    ) -> _Latched:
        """As ``latched``; decisions that are not valid raise nothing, and end an alarm in time."""
        graph = statistic.graph

        def some() -> list[Value]:
            found = _latched(
                self.valid_of(statistic),
                level,
                self.valid_of(number),
                memory,
                rearm,
                refractory,
                first=number.slice(0, 1, 0),
                anew=self.valid_of(self.begins_anew),
            )
            was_on = memory.slice(0, 1, 0) > 0.0
            on = self.spread(found.on, was_on)
            alarm = self.spread(found.alarm, was_on) & self.valid
            since = _last(number) - _last(self.valid_of(number))
            return [alarm, on, found.memory + graph.constant([0, 0, 1], F64) * since]

        def none() -> list[Value]:
            was_on = memory.slice(0, 1, 0) > 0.0
            num = number.length(0).cast(F64)
            after = memory + graph.constant([0, 0, 1], F64) * num
            return [self.valid, self.spread(self.valid_of(self.valid), was_on), after]

        alarm, on, after = graph.if_(self.has_valid, some, none)
        is_over = _last(self.is_over)
        armed = graph.concat(*[graph.constant([0.0, 0.0], F64), after.slice(2, 3, 0)], axis=0)
        return _Latched(alarm, on & ~self.is_over, graph.where(is_over, armed, after))


class _Latched(NamedTuple):
    """Which decisions raise an alarm.

    Attributes:
        alarm: whether it raises one, ``[k]``, bool.
        on: whether one stands after it, ``[k]``, bool.
        memory: what ``latched`` is given for the next decisions, ``[3]``.
    """

    alarm: Value
    on: Value
    memory: Value


def _latched(
    statistic: Value,
    level: Value,
    number: Value,
    memory: Value,
    rearm: int,
    refractory: int,
    *,
    first: Value | None = None,
    anew: Value | None = None,
) -> _Latched:
    """Alarms as ``onset.rules.latch`` raises them.

    One is raised where the statistic is high, and the last alarm is no later than the last
    re-arming and than ``refractory`` decisions back. So only the number of the last alarm is
    walked, and nothing where the statistic is low and no alarm stands.

    Args:
        statistic: finite.
        level: from which on an alarm is raised.
        number: of the decisions in their stream, float64.
        memory: whether an alarm stands, for how many decisions then the statistic was low, and
            decisions since the last alarm (``_LATCH_START``); float64.
        rearm: decisions in a row that must be low.
        refractory: shortest distance of two alarms, in decisions.
        first: number of the first decision behind the memory, where others were left out.
        anew: decisions before which the latch is armed, and no decision was low, ``[k]``, bool.

    Shape:
        - statistic, number: ``[k]``, k at least 1
        - level, first: ``[1]``
        - memory: ``[3]``
    """
    graph, is_high = statistic.graph, statistic >= level

    def raise_(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        last = graph.where(state[0] <= row[0], row[1], state[0])
        return [last], [last]

    def awake() -> list[Value]:
        on, below, since = graph.ops("Split", memory, dtypes=[F64] * 3, axis=0, num_outputs=3)
        last = (number.slice(0, 1, 0) if first is None else first) - 1.0 - since
        place = _count_up(number.length(0)).cast(F64)
        high = _latest(is_high, -1.0 - below, place)  # the last one that was not low
        if anew is not None:  # before such a one, none was low
            is_edge = is_high | anew
            high = _latest(is_edge, -1.0 - below, graph.where(is_high, place, place - 1.0))
        rearms, since_when = place - high >= float(max(rearm, 1)), number
        if anew is not None:  # armed before it, so that it may raise an alarm itself
            rearms, since_when = rearms | anew, graph.where(anew & is_high, number - 1.0, number)
        rearmed = _latest(rearms, last - on, since_when)
        allowed = rearmed.minimum(number - float(refractory))
        allowed = graph.where(is_high, allowed, -math.inf)
        (end,), (alarms,) = graph.scan(raise_, [last.squeeze(0)], [allowed, number])
        is_on = alarms > rearmed
        now = _last(number)
        after = _last(is_on).cast(F64), _last(place) - _last(high), now - end
        return [alarms.eq(number), is_on, graph.concat(*after, axis=0)]

    def asleep() -> list[Value]:  # nothing is high
        num = _last(number) + 1.0 - (number.slice(0, 1, 0) if first is None else first)
        return [is_high, is_high, memory + graph.constant([0, 0, 1], F64) * num]

    is_awake = (statistic.amax(0, keepdim=True) >= level) | (memory.slice(0, 1, 0) > 0.0)
    return _Latched(*graph.if_(is_awake, awake, asleep))


def _count_up(num: Value) -> Value:
    """The whole numbers from 0 to before ``num`` ``[1]``, int64."""
    graph = num.graph
    return graph.op("Range", graph.constant(0, I64), num.squeeze(0), graph.constant(1, I64))


def _latest(mask: Value, start: Value, values: Value) -> Value:
    """The value where the mask held last, ``start`` ``[1]`` where it did not yet: ``[k]``."""
    graph = values.graph
    held = graph.concat(start, graph.op("Compress", values, mask, axis=0), axis=0)
    return graph.op("Gather", held, mask.cast(I64).cumsum(0), axis=0)


def _is_whole(valid: Value, lost: Value) -> Value:
    """Whether all decisions ``[k]`` are valid, and so was the one before, a scalar."""
    return valid.cast(I64).amin(0).cast(BOOL) & (lost <= 0.0).squeeze(0)


def _last(value: Value) -> Value:
    return value.slice(-1, END, 0)
