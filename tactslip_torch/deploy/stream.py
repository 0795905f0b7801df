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
    Perceptron,
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

    State, in float64: samples and decisions so far, where the run of positive ratios began,
    decisions in a row that are not valid, and the memory of the rule; whether an alarm stands,
    decisions in a row that were low, and decisions since the last alarm; the last sample of each
    channel, and where those that are equal to it began, counted from the next.

    With an onset classifier there are ``onset_score``, float64, ``by_onset`` and ``hint`` too, the
    threshold is the classifier's, and behind that the state has decisions of the alarm in a row
    that are not valid, the last bin's columns (``OF_LAST_BIN``, and the channels that were lost)
    and the memory of blocks (``memory_sizes``).

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
    unknown = 0.0 if onset is None else math.nan  # what no stream has is no evidence
    nothing = graph.constant(np.full((timing.tail, num_channels), unknown), dtype)
    no_sample = [math.nan] * num_channels + [0.0] * num_channels
    starts = [[0.0], [0.0], [0.0, 0.0, *rule_start(settings.rule)], _LATCH_START, no_sample]
    sizes = list(map(len, starts))
    if onset is not None:
        no_bin = [*([math.nan] * 3), 0.0, 0.0, math.inf, *([0.0] * num_channels)]
        starts += [[0.0], no_bin]
        sizes += [1, len(no_bin), *filter(None, memory_sizes(onset))]

    def begun() -> list[Value]:
        known = [graph.constant(start, F64) for start in starts]
        nan = numpy_helper.from_array(np.array([np.nan]))  # on which no score rests
        memory = [
            graph.op("ConstantOfShape", graph.axes(size), dtype=F64, value=nan)
            for size in sizes[len(starts) :]
        ]
        if memory:  # neither lost nor known blocks
            memory[:2] = [graph.constant([0.0], F64)] * 2
        return known + memory

    before, made, of_bins, of_latch, of_samples, *of_onset = graph.if_(
        state.length(0) > 0, lambda: state.split(sizes, 0), begun
    )
    num = samples.length(0).cast(F64)
    marked, stuck = _without_stuck(samples, num, of_samples, detector.sensing.stuck_samples)
    held = graph.concat(nothing, tail, marked, axis=0)
    seen = before + num
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

    def bins() -> tuple[Value, Scored, Value]:
        """Number, scores and ratios of the next bins; a ratio counts where the score is valid."""
        places = _count_up((decided - made).cast(I64))
        number = places.cast(F64) + made
        windows = _windows(held, seen, made * float(timing.hop), places, detector, timing)
        scored = score_bins(windows.cast(dtype), detector, settings.sensing(detector.sensing))
        known: Any = graph.where(scored.is_valid, scored.score, 0.0)
        llr: Any = settings.calibration.llr(known)
        return number, scored, llr.clamp(-LARGEST, LARGEST)

    def gathered(number: Value, scored: Scored, llr: Value) -> tuple[Value, Value, Value]:
        """Statistics, where runs of positive ratios began, and what is kept of bins then."""
        run, lost, of_rule = of_bins.split([1, 1, len(rule_start(settings.rule))], 0)

        def simply() -> list[Value]:
            statistic, after = _statistic_of(settings.rule, llr, of_rule)
            return [statistic, _latest(llr <= 0.0, run, number + 1.0), after, lost]

        def with_gaps() -> list[Value]:
            gaps = _Gaps.of(scored.is_valid, number, lost, most)
            statistic, after = gaps.statistic_of(settings.rule, llr, of_rule)
            is_end = ((llr <= 0.0) & scored.is_valid) | gaps.is_over
            return [statistic, _latest(is_end, run, number + 1.0), after, gaps.lost_after]

        is_whole = _is_whole(scored.is_valid, lost)
        statistic, runs, after, now_lost = graph.if_(is_whole, simply, with_gaps)
        return statistic, runs, graph.concat(_last(runs), now_lost, after, axis=0)

    def raised(
        statistic: Value, high: Value, number: Value, valid: Value, lost: Value
    ) -> list[Value]:
        """Alarms, whether one stands, and what latch and ``lost`` are then.

        Next to nothing is to be done while all is valid and low, and no alarm stands.
        """
        is_whole, is_off = _is_whole(valid, lost), of_latch.slice(0, 1, 0) <= 0.0

        def quietly() -> list[Value]:
            none, since = statistic >= high, graph.constant([0, 0, 1], F64)
            return [none, none, of_latch + since * number.length(0).cast(F64), lost]

        def simply() -> list[Value]:
            return [*_latched(statistic, high, number, of_latch, *latch_times), lost]

        def with_gaps() -> list[Value]:
            gaps = _Gaps.of(valid, number, lost, most_lost(window, hold, decision_samples))
            return [*gaps.latched(statistic, high, number, of_latch, *latch_times), gaps.lost_after]

        return graph.if_(
            is_whole & (statistic.amax(0, keepdim=True) < high) & is_off,
            quietly,
            lambda: graph.if_(is_whole, simply, with_gaps),
        )

    def only_valid(value: Any, scored: Scored) -> Value:
        return graph.where(scored.is_valid, value, math.nan)

    def stated(ratio: Any) -> Any:
        return probability(ratio, settings.slip_share)

    most = most_lost(window, hold, timing.hop)

    def decide() -> list[Value]:
        number, scored, llr = bins()
        high, lost = level(settings.threshold, dtype), of_bins.slice(1, 2, 0)
        statistic, runs, after = gathered(number, scored, llr)
        alarm, on, memory, _ = raised(statistic, high, number, scored.is_valid, lost)
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
            graph.concat(seen, decided, after, memory, stuck, axis=0),
        ]

    def nothing_made() -> list[Value]:
        empty = [graph.constant([], kind) for kind in outputs.values()]
        place = list(outputs).index("channels_lost")
        empty[place] = graph.constant(np.zeros((0, num_channels)), BOOL)
        return empty

    def wait() -> list[Value]:
        return [*nothing_made(), graph.concat(seen, made, of_bins, of_latch, stuck, axis=0)]

    def join(onset: OnsetClassifier) -> list[Value]:
        """Decisions a hop of the classifier apart, from its scores and the last bin by then."""
        alarm_lost, last_bin, *memory = of_onset
        last_bin = last_bin.unsqueeze(0)

        def decide_bins() -> list[Value]:
            number, scored, llr = bins()
            statistic, runs, after = gathered(number, scored, llr)
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
            return [graph.concat(last_bin, made_rows, axis=0), after]

        rows, now_of_bins = graph.if_(decided > made, decide_bins, lambda: [last_bin, of_bins])
        hop, of_bin = float(onset.evidence.hop_samples), float(timing.hop)
        hops, first = (seen / hop).floor(), (before / hop).floor()

        def next_state(of_latch: Value, alarm_lost: Value, memory: Sequence[Value]) -> Value:
            bin_now = _last(rows).reshape(-1)
            kept = (seen, decided, now_of_bins, of_latch, stuck, alarm_lost, bin_now)
            return graph.concat(*kept, *memory, axis=0)

        def decide_hops() -> list[Value]:
            number = _from_to(first, hops)
            samples = (number + 1.0) * hop
            most_blocks = most_lost(onset.evidence.context + int(hop), hold, int(hop))
            onset_score, after = _onset_scores(
                held, samples - seen, number - hops, memory, onset, most_blocks
            )
            high = level(onset.threshold, F64)
            by_onset = onset_score >= high
            num_bins = ((samples + (of_bin - float(timing.first))) / of_bin).floor()
            if timing.frame > timing.first:
                num_bins = graph.where(samples >= float(timing.frame), num_bins, 0.0)
            place = (num_bins - made).clamp(min=0.0).cast(I64)  # row 0 is what was known before
            at_hop = graph.op("Gather", rows, place, axis=0)
            given, flags, time_s = at_hop.cast(dtype), at_hop.cast(BOOL), samples / rate_hz
            is_known = onset_score > NOTHING_YET
            hinted = onset_score >= onset.hint
            if math.isfinite(onset.hint):
                hinted |= by_onset  # as a threshold that is given may be below it
            alarm, on, of_alarm, now_lost = raised(onset_score, high, number, is_known, alarm_lost)
            return [
                given[..., 0],
                given[..., 1],
                given[..., 2],
                flags[..., 3] | is_known,
                flags[..., 4],
                alarm,
                on,
                time_s,
                graph.where(by_onset, time_s - onset.lead_s, at_hop[..., 5]).minimum(time_s),
                flags[..., len(OF_LAST_BIN) :],
                onset_score,
                by_onset,
                hinted,
                next_state(of_alarm, now_lost, after),
            ]

        def wait_for_hop() -> list[Value]:
            return [*nothing_made(), next_state(of_latch, alarm_lost, memory)]

        return graph.if_(hops > first, decide_hops, wait_for_hop)

    if onset is None:
        *columns, next_state = graph.if_(decided > made, decide, wait)
    else:
        *columns, next_state = join(onset)
    for name, value in zip(outputs, columns, strict=True):
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


def _without_stuck(samples: Value, num: Value, known: Value, most: int) -> tuple[Value, Value]:
    """Samples with NaN where a channel is stuck (``StuckChannels``), and what is kept.

    Args:
        samples: that came next.
        num: how many, ``[1]``, float64.
        known: the last sample of each channel, and where those that are equal to it began, counted
            from the next sample; one behind the other.
        most: equal samples in a row that are let pass.

    Shape:
        - samples: ``[n, C]``, n may be 0; known: ``[2 C]``, float64
    """
    graph = samples.graph
    last, began = known.reshape(2, -1).split([1, 1], 0)
    last = last.cast(samples.dtype)
    rows = graph.concat(last, last, samples, axis=0)
    is_same = rows.slice(1, END, 0).eq(rows.slice(0, -1, 0))  # [1 + n, C]
    place = _from_to(graph.constant([-1.0], F64), num).unsqueeze(1)
    now_began = graph.where(is_same, began, place).amax(0, keepdim=True) - num

    def marked() -> list[Value]:
        num_new = (~is_same).cast(I64).cumsum(0)
        passed = place.slice(1, END, 0) + 1.0
        ago = (passed - float(most)).clamp(min=0.0).squeeze(1).cast(I64)
        earlier = graph.op("Gather", num_new, ago, axis=0)
        keeps = num_new.slice(1, END, 0).eq(earlier) & (passed - began > float(most))
        return [graph.where(keeps, math.nan, samples)]

    may_be = num - began.amin(1) > float(most)
    after = graph.concat(_last(rows).cast(F64), now_began, axis=0).reshape(-1)
    return graph.if_(may_be, marked, lambda: [samples])[0], after


# Onset scores ----------------------------------------------------------------------------------


class _Measured(NamedTuple):
    """What is measured of blocks; of no channels None.

    Attributes:
        power: that of fast channels, and mean products of pairs behind it, ``[k, B, F + P]``.
        means: of slow channels, ``[k, S]``.
        is_known: which blocks are not lost, ``[k]``, bool.
    """

    power: Value | None
    means: Value | None
    is_known: Value


def _measured(held: Value, ends: Value, evidence: OnsetEvidence) -> _Measured:
    """``OnsetEvidence.blocks`` and which are not lost; arguments as of ``_onset_scores``."""
    graph = held.graph
    fast, slow = evidence.hand.fast, evidence.hand.slow
    hop, context, num_filters = evidence.hop_samples, evidence.context, evidence.num_filters
    frames = _rows(held, ends.cast(I64).unsqueeze(1), range(-context - hop, 0)).cast(F64)
    own = frames.slice(context, END, 1)
    power = means = None
    if fast:
        of_fast = frames.take(fast, 2)
        x = (of_fast - of_fast.slice(0, 1, 1)).transpose(0, 2, 1)
        heard = x @ evidence.filter_matrix.reshape(context + hop, -1)  # [k, F, B * hop]
        each = np.stack([np.arange(len(fast))] * 2)  # power: the product of each with itself
        one, other = (
            heard.take(of.tolist(), 1) for of in np.concatenate([each, evidence.pairs], 1)
        )
        to_mean = np.kron(np.eye(num_filters), np.full((hop, 1), 1 / hop))
        rounding = np.zeros((num_filters, len(fast) + evidence.pairs.shape[1]))
        rounding[:, : len(fast)] = evidence.rounding
        power = (one * other @ to_mean).transpose(0, 2, 1) + rounding  # [k, B, F + P]
        of_fast = power[..., : len(fast)]
        moves = (of_fast - (2.0 * evidence.silence).exp()).amax(1) > 0.0
        if hop >= FEWEST_BLOCK_SAMPLES:
            of_own = own.take(fast, 2)
            moves = moves & (of_own.amax(1) > of_own.amin(1))
        if any(evidence.is_still):
            moves = moves | graph.constant(evidence.is_still, BOOL)
        known = moves & (of_fast.sum(1) < math.inf)
    if slow:
        means = own.take(slow, 2).mean(1)
        if not fast:
            known = means.isfinite()
    is_known = known.cast(F64).sum(1) >= float(evidence.min_alive)
    return _Measured(power, means, is_known)


def _onset_scores(
    held: Value,
    ends: Value,
    place: Value,
    memory: Sequence[Value],
    onset: OnsetClassifier,
    most: int,
) -> tuple[Value, list[Value]]:
    """Scores of hops, ``NOTHING_YET`` where there is no evidence, and what is kept.

    Args:
        held: samples, NaN before a stream.
        ends: where the blocks of these hops end, counted from the end of the samples.
        place: of these hops: -1 is the last of them.
        memory: ``memory_sizes``, but for empty parts.
        onset: that scores.
        most: lost blocks in a row, beyond which the memory begins anew.

    Shape:
        - held: ``[m, C]``; ends, place: ``[k]``, float64, k at least 1
        - output: ``[k]``, float64, and as memory
    """
    graph, made = held.graph, _measured(held, ends, onset.evidence)
    lost, filled, *kept = memory

    def all_known() -> list[Value]:
        begins = place.slice(0, 1, 0) - filled
        return [*_scores_of_known(made, place, begins, kept, onset), lost * 0.0]

    def some_lost() -> list[Value]:
        gaps = _Gaps.of(made.is_known, place, lost, most)

        def nothing_known() -> list[Value]:
            mean = graph.where(made.is_known, 0.0, graph.constant([NOTHING_YET], F64))
            return [mean, filled, *kept]

        def those_known() -> list[Value]:
            parts = (None if part is None else gaps.valid_of(part) for part in made)
            own = _Measured(*parts)  # type: ignore[arg-type]  # flags are there
            num = own.is_known.length(0).cast(F64)
            own_place = _from_to(-num, graph.constant([0.0], F64))
            begins = _latest(gaps.valid_of(gaps.begins_anew), -num - filled, own_place)
            mean, *after = _scores_of_known(own, own_place, begins, kept, onset)
            mean = gaps.spread(mean, graph.constant([NOTHING_YET], F64))
            return [graph.where(made.is_known, mean, NOTHING_YET), *after]

        return [*graph.if_(gaps.has_valid, those_known, nothing_known), gaps.lost_after]

    is_whole = _is_whole(made.is_known, lost)
    score, *after, now_lost = graph.if_(is_whole, all_known, some_lost)
    return score, [now_lost, *after]


def _scores_of_known(
    measured: _Measured,
    place: Value,
    begins: Value,
    kept: Sequence[Value],
    onset: OnsetClassifier,
) -> list[Value]:
    """Means of ``OnsetClassifier.scores``, how many blocks are known, and what is kept.

    Args:
        measured: of known blocks, ``k`` of them.
        place: of each: -1 is the last, ``[k]``, float64.
        begins: place of the first block of each one's stream, ``[k]`` or ``[1]``.
        kept: ``memory_sizes`` from scores on, but for empty parts.
        onset: that scores.
    """
    evidence, graph = onset.evidence, begins.graph
    fast, slow, num_filters = evidence.hand.fast, evidence.hand.slow, evidence.num_filters
    delay, windows, reach = evidence.delay, evidence.windows, len(evidence.step_matrix)
    number = place - begins + 1.0  # of each block in its stream
    of_scores, *given, floors = kept
    shapes = [shape for shape in memory_shapes(onset) if all(shape)]
    after = list[Value]()

    # rows of before a stream's first block are equal to it
    backs = [range(MEAN_HOPS - 1, -1, -1), range(delay - 1, -1, -1), [delay]]
    backs += [range(reach - 1, -1, -1), [0, *onset.lags]]
    earliest = graph.constant(-np.concatenate(backs), F64)
    at_back = (place.unsqueeze(1) + earliest).maximum(begins.unsqueeze(1)).cast(I64)
    of_mean, latest, delayed, of_steps, of_lags = at_back.split(list(map(len, backs)), 1)

    def joined(rows: Value) -> Value:
        """Rows with those of the blocks before."""
        num_rows, width = shapes[len(after)]
        flat = graph.concat(given[len(after)], rows.reshape(-1), axis=0)
        after.append(flat.slice(-num_rows * width, END, 0))
        return flat.reshape(-1, width)

    def at(rows: Value, places: Value) -> Value:
        return graph.op("Gather", rows, places, axis=0)

    num_levels, width = len(windows) * num_filters, len(fast) + evidence.pairs.shape[1]
    power, products, of_floors, steps = list[Any]([None] * 4)
    to_follow = list[Value]()
    if measured.power is not None:
        rows = joined(measured.power)
        to_means = [np.r_[np.zeros(delay - n), np.full(n, 1 / n)] for n in windows]
        means = graph.constant(to_means, F64) @ at(rows, latest)
        means = means.reshape(0, num_levels, width)
        power, products = means.split([len(fast), width - len(fast)], 2)
        quiet = at(rows, delayed).reshape(0, num_filters, width)[..., : len(fast)].log() * 0.5
        to_follow = [quiet.reshape(0, num_filters * len(fast))] * len(FLOORS_S)
    step_floor: Any = None
    if measured.means is not None:
        levels = at(joined(measured.means), of_steps)
        steps = graph.constant(evidence.step_matrix.T, F64) @ (levels - levels.slice(0, 1, 1))
        num_steps = evidence.step_matrix.shape[1]
        sizes = joined(steps.abs())
        to_follow.append(at(sizes, delayed.squeeze(1)))
    usual, now = _followed(graph.concat(*to_follow, axis=1), number, floors, evidence)
    num_logs = len(FLOORS_S) * num_filters * len(fast)
    if fast:
        of_floors = usual.slice(0, num_logs, 1).reshape(0, len(FLOORS_S) * num_filters, len(fast))
    if slow:
        step_floor = usual.slice(num_logs, END, 1).reshape(0, num_steps, len(slow))
    pooled: Any = evidence.pooled(power, products, of_floors, steps, step_floor)
    columns, is_usable = pooled
    inputs = scaled(columns, onset.scaler)
    if onset.lags:
        inputs = at(joined(inputs), of_lags).reshape(0, len(backs[-1]) * evidence.num_columns)
    head = onset.head
    if isinstance(head, QuadraticForm):
        score = machine(inputs, head, F64)
    else:
        score = _network(inputs, head)
    score = graph.where(is_usable & (number > float(evidence.blind)), score, math.nan)
    scores = graph.concat(of_scores, score, axis=0)
    mean = at(scores, of_mean).mean(1)
    mean = graph.where(mean.isfinite(), mean, NOTHING_YET)
    return [mean, _last(number), scores.slice(1 - MEAN_HOPS, END, 0), *after, now]


def _network(inputs: Value, head: Perceptron) -> Value:
    """Its score of inputs, ``[k, K] -> [k]``; hops are columns, which is quicker for few."""
    graph, z, last = inputs.graph, inputs, len(head.weights) - 1
    for number, (weight, bias) in enumerate(zip(head.weights, head.biases, strict=True)):
        layer = graph.constant(weight, F64), z, graph.constant(bias[:, None], F64)
        z = graph.op("Gemm", *layer, transB=int(number == 0))
        z = z * z.sigmoid() if number < last else z
    return z.squeeze(0)


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
    rate = (1.0 / since).maximum(rates)  # [k, V]; 1 of a first block
    nothing = values - values
    is_known = nothing.eq(0.0) | number.eq(1.0).unsqueeze(1)  # a first block leaves nothing before

    def follow(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        (before,), (x, share, is_known) = state, row
        start = graph.where(before.eq(before), before, x)
        after = graph.where(is_known, start + share * (x - start), before)
        return [after], [after]

    rows = [values + nothing, rate, is_known]
    (after,), (made,) = graph.scan(follow, [floors], rows, (len(rates),))
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
    walked.

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

    on, below, since = memory.split([1, 1, 1], 0)
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
    return _Latched(alarms.eq(number), is_on, graph.concat(*after, axis=0))


def _count_up(num: Value) -> Value:
    """The whole numbers from 0 to before ``num`` ``[1]``, int64."""
    graph = num.graph
    return graph.op("Range", graph.constant(0, I64), num.squeeze(0), graph.constant(1, I64))


def _from_to(start: Value, stop: Value) -> Value:
    """The numbers ``start``, ``start + 1`` and so on to before ``stop``, ``[1]`` both, float64."""
    graph = start.graph
    return graph.op("Range", start.squeeze(0), stop.squeeze(0), graph.constant(1.0, F64))


def _latest(mask: Value, start: Value, values: Value) -> Value:
    """The value where the mask held last, ``start`` ``[1]`` where it did not yet: ``[k]``."""
    graph = values.graph
    held = graph.concat(start, graph.op("Compress", values, mask, axis=0), axis=0)
    return graph.op("Gather", held, mask.cast(I64).cumsum(0), axis=0)


def _is_whole(valid: Value, lost: Value) -> Value:
    """Whether all decisions ``[k]`` are valid, and so was the one before, ``[1]``."""
    return valid.cast(F64).amin(0, keepdim=True) - lost > 0.0


def _last(value: Value) -> Value:
    return value.slice(-1, END, 0)
