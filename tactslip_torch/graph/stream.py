"""The detector that watches a stream, as a graph: ``StreamingDetector.push`` without times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.graph.bins import Judged, dead_input, judge_bins
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.sequence import (
    LATCH_START,
    count_up,
    latched,
    latest,
    probability_of,
    rule_start,
    statistic_of,
)
from tactslip_torch.graph.value import BOOL, END, F64, I64, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.rules import NEUTRAL
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.signals.filtering import past_matrix

Judge = Callable[[Graph, SlipDetector, Value, Form, Value], Judged]


@dataclass(frozen=True)
class Timing:
    """When decisions are made, and how much is kept until then; lengths in samples.

    Attributes:
        window: of a bin.
        hop: distance of two decisions.
        first: that must have come before the first decision, but for long frames.
        frame: that must have come before any.
        tail: that are kept.
        state_size: numbers that are kept.
    """

    window: Window
    hop: int
    first: int
    frame: int
    tail: int
    state_size: int

    @classmethod
    def of(cls, detector: SlipDetector, settings: AlarmSettings) -> Timing:
        """That of a detector with these settings."""
        window = Window.of(detector)
        frame = max(detector.channel_filter.window_lengths[i] for i in window.channels)
        first = window.bin + window.after
        state_size = 6 + len(rule_start(settings.rule))
        return cls(window, settings.hop_samples, first, frame, window.length - 1, state_size)

    def decisions(self, num: int) -> int:
        """How many are made by the time that as many samples have come."""
        return 0 if num < max(self.first, self.frame) else (num - self.first) // self.hop + 1


def stream_graph(
    detector: SlipDetector, settings: AlarmSettings, form: Form, judge: Judge = judge_bins
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
        detector: whose judgement.
        settings: hop, calibration, rule and threshold.
        form: precision.
        judge: what makes scores of windows.

    Raises:
        ValueError: for a calibration or rule that no graph is written for.
    """
    timing = Timing.of(detector, settings)
    graph, num_channels = Graph(), len(detector.pool.hand)
    samples = graph.input("samples", form.dtype, ("n", num_channels))
    tail = graph.input("tail", form.dtype, ("r", num_channels))
    state = graph.input("state", F64, ("s",))
    threshold = graph.input("threshold", F64, ("t",))
    dead = dead_input(graph, detector)

    nothing = graph.constant([[0.0] * num_channels] * timing.tail, form.dtype)
    held = graph.concat(nothing, tail, samples, axis=0)
    start = graph.constant([0, 0, 0, *LATCH_START, *rule_start(settings.rule)], F64)
    state = graph.concat(state, start, axis=0).slice(0, timing.state_size, 0)
    seen = state.slice(0, 1, 0) + samples.length(0).cast(F64)
    decided = ((seen + float(timing.hop - timing.first)) / float(timing.hop)).floor().clamp(min=0.0)
    if timing.frame > timing.first:
        decided = graph.where(seen >= float(timing.frame), decided, 0.0)
    deciding = _Deciding(detector, settings, form, judge, timing, dead)
    made = graph.if_(
        decided > state.slice(1, 2, 0),
        lambda body: deciding(body, *(x.at(body) for x in (held, state, threshold, seen, decided))),
        lambda body: _none(seen.at(body), state.at(body), form),
    )
    for (name, _), value in zip(_outputs(form), made[:-1], strict=True):
        graph.output(name, value, ("k",))
    graph.output("next_tail", held.slice(-timing.tail, END, 0), (timing.tail, num_channels))
    graph.output("next_state", made[-1], (timing.state_size,))
    return graph


def _outputs(form: Form) -> list[tuple[str, np.dtype[Any]]]:
    """Names and dtypes of what there is one of per decision."""
    of_score = [(name, form.dtype) for name in ("score", "probability", "statistic")]
    flags = [(name, BOOL) for name in ("valid", "alarm", "on")]
    return [*of_score, *flags, ("time_s", F64), ("onset_s", F64)]


def _none(seen: Value, state: Value, form: Form) -> list[Value]:
    """No decision."""
    graph = seen.graph
    empty = [graph.constant([], dtype) for _, dtype in _outputs(form)]
    return [*empty, graph.concat(seen, state.slice(1, END, 0), axis=0)]


@dataclass(frozen=True)
class _Deciding:
    """What is done where there is at least one decision."""

    detector: SlipDetector
    settings: AlarmSettings
    form: Form
    judge: Judge
    timing: Timing
    dead: Value

    def __call__(
        self,
        graph: Graph,
        held: Value,
        state: Value,
        threshold: Value,
        seen: Value,
        decided: Value,
    ) -> list[Value]:
        """All outputs but the tail, the state last."""
        settings, pool = self.settings, self.detector.pool
        sizes = graph.axes(1, 1, 1, 3, self.timing.state_size - 6)
        parts = graph.ops("Split", state, sizes, dtypes=(F64,) * 5, axis=0)
        _, made, run, of_latch, of_rule = parts
        places = count_up((decided - made).cast(I64))
        number = places.cast(F64) + made
        windows = self._windows(graph, held, seen, made, places)
        judged = self.judge(graph, self.detector, windows, self.form, self.dead.at(graph))

        llr = graph.where(judged.is_usable, judged.llr(settings.calibration), NEUTRAL)
        statistic, of_rule = statistic_of(graph, settings.rule, llr, of_rule)
        own = graph.constant([settings.threshold], F64)
        level = graph.concat(threshold, own, axis=0).slice(0, 1, 0).cast(self.form.dtype)
        raised = latched(
            graph,
            statistic,
            level,
            number,
            of_latch,
            rearm=settings.decisions(settings.rearm_s, pool.sample_rate_hz),
            refractory=settings.decisions(settings.refractory_s, pool.sample_rate_hz),
        )
        run = latest(llr <= 0.0, run, number + 1.0)
        last_run = run.slice(-1, END, 0)
        return [
            judged.score,
            probability_of(llr, settings.slip_share),
            statistic,
            judged.is_valid,
            raised.alarm,
            raised.on,
            *self._times_s(number, run),
            graph.concat(seen, decided, last_run, raised.memory, of_rule, axis=0),
        ]

    def _windows(self, graph: Graph, held: Value, seen: Value, made: Value, places: Value) -> Value:
        """The samples of each decision, float64, ``[k, channels in use, Window.length]``.

        ``held`` ends with sample number ``seen``. Channels in between that are not in use go along,
        as columns are costly to pick and rows are not.
        """
        timing, window = self.timing, self.timing.window
        start = made * float(timing.hop)  # of the first bin
        origin = start - seen - float(window.before)  # negative: counted from the end
        x = held.slice(origin.cast(I64), END, 0)
        columns = self._columns
        if len(columns) < len(self.detector.pool.hand):
            x = x.slice(columns.start, columns.stop, 1)
        x = x.cast(F64)
        if window.before:
            whole, of_stream = x, start.cast(I64)
            x = graph.if_(
                start < float(window.before),
                lambda body: [self._with_past(whole.at(body), of_stream.at(body))],
                lambda body: [whole.at(body)],
            )[0]
        index = (places * timing.hop).unsqueeze(1) + graph.axes(*range(window.length))
        windows = graph.op("Gather", x, index, axis=0).transpose(0, 2, 1)
        if len(columns) == len(window.channels):
            return windows
        return windows.take([columns.index(channel) for channel in window.channels], 1)

    @property
    def _columns(self) -> range:
        """The channels from the first in use to the last."""
        channels = self.timing.window.channels
        return range(channels[0], channels[-1] + 1)

    def _with_past(self, x: Value, start: Value) -> Value:
        """The first window and what follows, with a made-up past before the stream's start.

        Args:
            x: ``[m, columns]``, from ``Window.before`` samples before ``start``.
            start: of the first bin, a sample of the stream, ``[1]``.
        """
        graph, window = x.graph, self.timing.window
        known = x.slice(-start + window.before, END, 0)
        lengths = self.detector.channel_filter.window_lengths
        shortest = min(lengths[channel] for channel in window.channels)
        of_column = [lengths[c] if c in window.channels else shortest for c in self._columns]
        pasts, order = list[Value](), list[int]()
        for length in dict.fromkeys(of_column):
            chosen = [i for i, own in enumerate(of_column) if own == length]
            frame = known.slice(0, length, 0).take(chosen, 1)
            sample = frame.slice(0, 1, 0)
            pasts.append(graph.constant(self._past(length), F64) @ (frame - sample) + sample)
            order += chosen
        past = graph.concat(*pasts, axis=1)
        if order != sorted(order):
            past = past.take(sorted(range(len(order)), key=order.__getitem__), 1)
        return graph.concat(past.slice(start, END, 0), known, axis=0)

    def _past(self, length: int) -> Tensor:
        """``past_matrix`` of a frame, with rows of 0 for what lies beyond its reach."""
        layer = self.detector.channel_filter
        past = past_matrix(length, layer.polyorder, layer.align)
        beyond = past.new_zeros(self.timing.window.before - len(past), length)
        return torch.cat([beyond, past])

    def _times_s(self, number: Value, run: Value) -> tuple[Value, Value]:
        """When decisions could be made, and when the slip began that they speak of."""
        timing, rate = self.timing, self.detector.pool.sample_rate_hz
        samples = number * float(timing.hop) + float(timing.first)
        time_s = samples / rate
        began_s = (run.minimum(number) * float(timing.hop) + float(timing.first)) / rate
        onset_s = (began_s - self.settings.lead_s).minimum(time_s)
        if timing.frame <= timing.first:
            return time_s, onset_s
        waited_s = samples.maximum(float(timing.frame)) / rate
        return waited_s, waited_s - (time_s - onset_s)
