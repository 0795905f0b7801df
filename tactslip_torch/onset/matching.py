"""Alarms of a recording against its onsets: which slip was found, how late, and what was false.

By event, not by bin (REFERENCE.md section 7). Instants are compared in whole nanoseconds, so that
rounding moves no alarm across an edge.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

OUTCOMES = ("found", "early", "missed")
"""What becomes of an onset: exactly one of these."""

_FOREVER_S = 1e9


@dataclass(frozen=True)
class LatencyParts:
    """What of a delay is fixed.

    Args:
        look_ahead_s: from the end of a bin to its score, for which the filter waits.
        bin_s: length of a bin.
        compute_s: time of a decision, where it was measured; stands beside delays, not in them.
    """

    look_ahead_s: float
    bin_s: float
    compute_s: float | None = None


@dataclass(frozen=True)
class EventRules:
    """Which alarm belongs to which slip.

    Args:
        found_within_s: an alarm this long behind the onset still finds the slip.
        early_s: an alarm this long before the onset is early, not false.
        settle_s: an alarm this long behind the end of a slide still belongs to it. None is for as
            long as a decision can rest on samples of the slide, and 50 ms: bin, look-ahead, 50 ms.
    """

    found_within_s: float = 0.5
    early_s: float = 0.2
    settle_s: float | None = None


@dataclass(frozen=True)
class Watched:
    """One recording as a detector saw it. Decisions and alarms are at the time they are available.

    Args:
        recording: its name.
        material: what the hand slid on.
        scene: what was done with the hand.
        duration_s: length of the recording.
        alarms_s: when an alarm was raised, ascending.
        onset_estimates_s: of each alarm, when its slip is thought to have begun; may be empty.
        onsets_s: exact onsets, ascending.
        sliding_s: of each onset, start and end of its slide.
        speeds_mm_s: of each onset, the steady speed of its stroke.
        first_positive_s: of each onset, the first decision behind it that speaks for slip, NaN
            where there is none; may be empty.
        watched_s: start and end of stretches that were watched; empty is the whole recording.
        alarm_ends_s: of each alarm, when its status ended, infinity if it did not; may be empty,
            and an alarm then holds until the next.

    Raises:
        ValueError: if two of them disagree in their number, or times do not ascend.
    """

    recording: str
    material: str
    scene: str
    duration_s: float
    alarms_s: tuple[float, ...]
    onset_estimates_s: tuple[float, ...]
    onsets_s: tuple[float, ...]
    sliding_s: tuple[tuple[float, float], ...]
    speeds_mm_s: tuple[float, ...]
    first_positive_s: tuple[float, ...] = ()
    watched_s: tuple[tuple[float, float], ...] = ()
    alarm_ends_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        onsets, alarms = len(self.onsets_s), len(self.alarms_s)
        for name, allowed in (
            ("sliding_s", {onsets}),
            ("speeds_mm_s", {onsets}),
            ("first_positive_s", {0, onsets}),
            ("onset_estimates_s", {0, alarms}),
            ("alarm_ends_s", {0, alarms}),
        ):
            if len(getattr(self, name)) not in allowed:
                raise ValueError(
                    f"{self.recording}: {name} has {len(getattr(self, name))} entries for {onsets} "
                    f"onsets and {alarms} alarms; give one each"
                )
        ends = tuple(end for _, end in self.sliding_s)
        edges = tuple(edge for stretch in self.watched_s for edge in stretch)
        for name, times in (
            ("alarms_s", self.alarms_s),
            ("onsets_s", self.onsets_s),
            ("ends of sliding_s", ends),
            ("watched_s", edges),
        ):
            if not all(before <= after for before, after in pairwise((-math.inf, *times))):
                raise ValueError(f"{self.recording}: {name} must ascend, got {times[:4]}..")


class OnsetEvent(NamedTuple):
    """One onset: what became of it, and of a found one the parts of its delay (else NaN).

    ``num_alarms`` counts those that belong to its slip, early ones too. ``error_s`` is the estimate
    minus the onset.
    """

    onset_s: float
    speed_mm_s: float
    outcome: str
    num_alarms: int
    delay_s: float
    bin_fill_s: float
    decision_s: float
    error_s: float


class RecordingEvents(NamedTuple):
    """One recording's alarms against its onsets; ``quiet_s`` is how long an alarm was false."""

    recording: str
    material: str
    scene: str
    onsets: tuple[OnsetEvent, ...]
    false_alarms_s: tuple[float, ...]
    quiet_s: float
    latency: LatencyParts


def recording_events(watched: Watched, rules: EventRules, latency: LatencyParts) -> RecordingEvents:
    """What became of each onset that was watched, and which alarms were false.

    The *window* of a slip reaches from ``early_s`` before its onset to ``settle_s`` behind the end
    of its slide; an alarm belongs to the last window that holds it, and in none it is false. Of
    each onset exactly one is true:

    - *early*: the last alarm before it is no more than ``early_s`` old and its status holds still;
    - *found*: not early, and an alarm at or behind it, before the next onset, within
      ``found_within_s`` and within its window. Its delay is that alarm's time minus the onset;
    - *missed*: neither. A status that has held for longer than ``early_s`` finds nothing.

    A delay is look-ahead, bin fill (until the bin of the first decision behind the onset that
    speaks for slip is full) and decision (from that one to the alarm). Where no such decision is
    known to come before the alarm, it is bin fill. Alarms outside the stretches watched are not
    counted.

    Reference:
        REFERENCE.md section 7.
    """
    windows = _Windows.of(watched, rules, latency)
    stretches = [(_ns(start), _ns(end)) for start, end in watched.watched_s]

    def is_watched(time: int) -> bool:
        return not stretches or any(start <= time <= end for start, end in stretches)

    ends = watched.alarm_ends_s or (math.inf,) * len(watched.alarms_s)
    raised = (
        _Alarm(at, _ns(end), number)
        for number, (at, end) in enumerate(zip(map(_ns, watched.alarms_s), ends, strict=True))
    )
    alarms = [alarm for alarm in raised if is_watched(alarm.at)]
    belongs = [windows.holding(alarm.at) for alarm in alarms]
    num_alarms = Counter(belongs)
    onsets = tuple(
        _onset_event(watched, place, alarms, windows, latency)._replace(
            num_alarms=num_alarms[place]
        )
        for place, onset in enumerate(windows.onset)
        if is_watched(onset)
    )
    false = [a.number for a, place in zip(alarms, belongs, strict=True) if place is None]
    whole = stretches or [(0, _ns(watched.duration_s))]
    return RecordingEvents(
        watched.recording,
        watched.material,
        watched.scene,
        onsets,
        tuple(watched.alarms_s[number] for number in false),
        sum(end - start - windows.inside(start, end) for start, end in whole) / 1e9,
        latency,
    )


class _Alarm(NamedTuple):
    """When it was raised, when its status ended, and which one it is."""

    at: int
    end: int
    number: int


class _Windows(NamedTuple):
    """Onsets and the windows of their slips, ascending; ``until`` is how long each can be found."""

    onset: list[int]
    first: list[int]
    last: list[int]
    until: list[int]

    @classmethod
    def of(cls, watched: Watched, rules: EventRules, latency: LatencyParts) -> _Windows:
        settle_s = rules.settle_s
        if settle_s is None:
            settle_s = latency.bin_s + latency.look_ahead_s + 0.05
        onset = [_ns(time) for time in watched.onsets_s]
        ends = [_ns(end) for _, end in watched.sliding_s]
        last = [max(time, end) + _ns(settle_s) for time, end in zip(onset, ends, strict=True)]
        following = [time - 1 for time in onset[1:]] + [_ns(_FOREVER_S)]
        until = [
            min(time + _ns(rules.found_within_s), stop, before_next)
            for time, stop, before_next in zip(onset, last, following, strict=False)
        ]
        return cls(onset, [time - _ns(rules.early_s) for time in onset], last, until)

    def holding(self, time: int) -> int | None:
        """The last window that holds an instant."""
        place = bisect_right(self.first, time) - 1
        return place if place >= 0 and time <= self.last[place] else None

    def inside(self, start: int, end: int) -> int:
        """How much of a stretch lies inside windows, which may overlap."""
        inside, reached = 0, start
        for first, last in zip(self.first, self.last, strict=True):
            inside += max(0, min(last, end) - max(first, reached))
            reached = max(reached, last)
        return inside


def _onset_event(
    watched: Watched,
    place: int,
    alarms: Sequence[_Alarm],
    windows: _Windows,
    latency: LatencyParts,
) -> OnsetEvent:
    """What became of one onset; alarms are not counted yet."""
    onset = windows.onset[place]
    event = OnsetEvent(
        watched.onsets_s[place], watched.speeds_mm_s[place], "missed", 0, *(math.nan,) * 4
    )
    after = bisect_left(alarms, onset, key=lambda alarm: alarm.at)
    if after and alarms[after - 1].at >= windows.first[place] and alarms[after - 1].end > onset:
        return event._replace(outcome="early")
    if after == len(alarms) or alarms[after].at > windows.until[place]:
        return event
    alarm = alarms[after]
    positive = watched.first_positive_s[place] if watched.first_positive_s else math.nan
    spoke = alarm.at if math.isnan(positive) else min(_ns(positive), alarm.at)
    look_ahead = _ns(latency.look_ahead_s)
    bin_fill = max(0, spoke - onset - look_ahead)  # one that spoke before had no need of it
    estimates = watched.onset_estimates_s
    return event._replace(
        outcome="found",
        delay_s=(alarm.at - onset) / 1e9,
        bin_fill_s=bin_fill / 1e9,
        decision_s=(alarm.at - onset - look_ahead - bin_fill) / 1e9,
        error_s=(_ns(estimates[alarm.number]) - onset) / 1e9 if estimates else math.nan,
    )


def _ns(seconds: float) -> int:
    return round(min(seconds, _FOREVER_S) * 1e9)
