"""What a detector is evaluated by in use: slips found, how late, and how many false alarms.

Alarms of a recording against its onsets, by event and not by bin (REFERENCE.md section 7), put
together in numbers with intervals over recordings: a bootstrap that draws as many recordings with
replacement, since what happens within one hangs together.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypedDict

import torch
from torch import Tensor

_OUTCOMES = ("found", "early", "missed")
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


class Number(TypedDict):
    """A number and its interval; the ends are None where one recording alone says nothing of it."""

    value: float
    low: float | None
    high: float | None


class Draws(NamedTuple):
    """How recordings are drawn.

    Args:
        level: of the intervals, whose ends are percentiles.
        num: how many draws.
        seed: of the draws.
    """

    level: float = 0.95
    num: int = 1000
    seed: int = 0


class Resampled:
    """A set of recordings and its draws.

    An interval always holds its value. For shares and rates the score interval of independent
    events is taken where it reaches further: no miss among a few slips is no proof of none.

    Args:
        num_recordings: in the set.
        draws: how they are drawn.

    Raises:
        ValueError: if the level is not between 0 and 1, or nothing is to be drawn.

    Reference:
        Efron and Tibshirani (1993), An Introduction to the Bootstrap, chapters 8 and 13. Wilson
        (1927), J. Am. Stat. Assoc. 22, 209-212, and its form for a Poisson count.
    """

    def __init__(self, num_recordings: int, draws: Draws) -> None:
        if not (0 < draws.level < 1 and draws.num >= 1):
            raise ValueError(
                f"an interval needs a level between 0 and 1 and at least one draw, got {draws}"
            )
        generator = torch.Generator().manual_seed(draws.seed)
        shape = (draws.num, num_recordings)
        drawn = torch.randint(max(num_recordings, 1), shape, generator=generator)
        tail = (1 - draws.level) / 2
        self._ends = torch.tensor([tail, 1 - tail], dtype=torch.float64)
        self._z = float(torch.special.ndtri(self._ends[1]))
        self._times = torch.zeros(shape, dtype=torch.float64)  # how often each is in each draw
        self._times.scatter_add_(1, drawn, torch.ones_like(self._times))

    def share(self, parts: Sequence[float], wholes: Sequence[float]) -> Number | None:
        """Sum of parts, of which each is within its whole, by sum of wholes; None of nothing."""
        return self._ratio(parts, wholes, 1.0, _share_end)

    def rate(
        self, counts: Sequence[float], times: Sequence[float], per: float = 1.0
    ) -> Number | None:
        """Counts in so much time, for ``per`` units of it; None of no time."""
        return self._ratio(counts, times, per, _rate_end)

    def mean(self, sums: Sequence[float], numbers: Sequence[float]) -> Number | None:
        """Sum of sums by sum of numbers; None of nothing."""
        return self._ratio(sums, numbers, 1.0, None)

    def quantiles(self, values: Tensor, recording: Tensor, shares: Sequence[float]) -> list[Number]:
        """Quantiles of values, linear between neighbours, each value drawn with its recording.

        Shape:
            - values, recording: ``[N]``, N at least 1; recording is a number below that of the set
        """
        order = values.argsort()
        ordered = values[order]
        reached = self._times[:, recording[order]].cumsum(1)  # [draws, N], values up to each
        last = reached[:, -1:] - 1  # place of the last one drawn, -1 where none is
        numbers = []
        for share in shares:
            place = share * last
            low, high = (
                ordered[torch.searchsorted(reached, at, right=True).clamp(max=len(ordered) - 1)]
                for at in (place.floor(), place.ceil())
            )
            drawn = low + (place - place.floor()) * (high - low)
            drawn = torch.where(last < 0, torch.nan, drawn)[:, 0]
            numbers.append(self._between(float(ordered.quantile(share)), drawn, recording))
        return numbers

    def average(self, values: Tensor, recording: Tensor) -> Number:
        """Mean of values; shapes as of ``quantiles``."""
        times = self._times[:, recording]
        return self._between(float(values.mean()), times @ values / times.sum(1), recording)

    def deviation(self, values: Tensor, recording: Tensor) -> Number:
        """Standard deviation of values, of the population; shapes as of ``quantiles``."""
        away = values - values.mean()
        powers = torch.stack([torch.ones_like(away), away, away**2])  # [3, N]
        count, first, second = (self._times[:, recording] @ powers.T).T
        drawn = (second / count - (first / count) ** 2).clamp(min=0).sqrt()
        return self._between(float(away.square().mean().sqrt()), drawn, recording)

    def _ratio(
        self,
        parts: Sequence[float],
        wholes: Sequence[float],
        per: float,
        end: Callable[[float, float, float], float] | None,
    ) -> Number | None:
        part, whole = math.fsum(parts), math.fsum(wholes)
        if not whole > 0:
            return None
        sums = self._times @ torch.tensor([parts, wholes], dtype=torch.float64).T  # [draws, 2]
        having = torch.tensor(wholes).nonzero()
        number = self._between(per * part / whole, per * sums[:, 0] / sums[:, 1], having)
        if end is not None:
            low, high = (per * end(part, whole, z) for z in (-self._z, self._z))
            number["low"] = low if number["low"] is None else min(low, number["low"])
            number["high"] = high if number["high"] is None else max(high, number["high"])
        return number

    def _between(self, value: float, drawn: Tensor, recording: Tensor) -> Number:
        known = drawn[~drawn.isnan()]  # NaN where a draw says nothing
        if len(recording.unique()) < 2 or not len(known):
            return {"value": value, "low": None, "high": None}
        low, high = known.quantile(self._ends).tolist()
        return {"value": value, "low": min(low, value), "high": max(high, value)}


def _share_end(part: float, whole: float, z: float) -> float:
    spread = z * math.sqrt(part * (whole - part) / whole + z * z / 4)
    return min(max((part + z * z / 2 + spread) / (whole + z * z), 0.0), 1.0)


def _rate_end(count: float, time: float, z: float) -> float:
    return max(count + z * z / 2 + z * math.sqrt(count + z * z / 4), 0.0) / time


PAPER_SCENE = "paper"
"""The scene of recordings that are the paper's protocol."""

_STEPS = 20  # between the quantiles that are kept


def event_metrics(
    watched: Sequence[Watched],
    rules: EventRules,
    latency: LatencyParts,
    *,
    level: float = 0.95,
    num_resamples: int = 1000,
    seed: int = 0,
) -> dict[str, Any]:
    """``pooled_metrics`` of recordings that one detector watched, with ``rules`` and ``level``."""
    events = [recording_events(one, rules, latency) for one in watched]
    return pooled_metrics(events, level=level, num_resamples=num_resamples, seed=seed)


def pooled_metrics(
    events: Sequence[RecordingEvents],
    *,
    level: float = 0.95,
    num_resamples: int = 1000,
    seed: int = 0,
) -> dict[str, Any]:
    """All recordings together, in JSON-able numbers; their order does not matter.

    - ``num_recordings``, ``num_onsets``, ``num_found``, ``num_early``, ``num_missed``,
      ``num_false_alarms``, ``quiet_hours``: counts, and the time in which an alarm was false.
    - ``found``, ``early``, ``missed``: shares of the onsets; ``alarms_per_slip``: alarms that
      belong to a slip, by onsets. None without onsets.
    - ``false_alarms_per_minute``, ``false_alarms_per_hour``: None without such time.
    - ``delay_ms`` of the slips found: ``median``, ``p95``, and ``quantiles`` from least to most in
      steps of 5 %. ``latency_ms``: means of its parts, which add up to ``delay``, and ``compute``
      (None where not measured). ``onset_error_ms``: ``median``, ``sd`` (of the population) and
      ``mean_abs`` of the estimates. None where there is nothing to say this of.
    - ``per_material``, ``per_scene``, ``per_speed``: the same of groups, without groups, level and
      quantiles; a false alarm has no speed. Of several scenes, materials and speeds are of the
      paper's alone.

    A number with an interval is ``{"value", "low", "high"}``, by bootstrap over recordings
    (``resampling``); what bears one name is one recording.

    Args:
        events: of ``recording_events``; of several detectors if they are to be pooled.
        level: of the intervals.
        num_resamples: draws.
        seed: of the draws.

    Raises:
        ValueError: if the level is not between 0 and 1, or nothing is to be drawn.
    """
    events = sorted(events, key=lambda one: (*_name(one), one.quiet_s, str(one.onsets)))
    draws = Draws(level, num_resamples, seed)
    is_one = len({one.scene for one in events}) < 2
    counted = [one for one in events if is_one or one.scene == PAPER_SCENE]
    speeds = sorted({onset.speed_mm_s for one in counted for onset in one.onsets})

    def of_group(own: Sequence[RecordingEvents]) -> dict[str, Any]:
        numbers = _summary(own, draws)
        if numbers["delay_ms"]:
            del numbers["delay_ms"]["quantiles"]
        return numbers

    def by(name: str, among: Sequence[RecordingEvents]) -> dict[str, Any]:
        groups: dict[str, list[RecordingEvents]] = {}
        for one in among:
            groups.setdefault(getattr(one, name), []).append(one)
        return {group: of_group(own) for group, own in groups.items()}

    def at(speed: float) -> list[RecordingEvents]:
        own = (
            (one, tuple(onset for onset in one.onsets if onset.speed_mm_s == speed))
            for one in counted
        )
        return [one._replace(onsets=o, false_alarms_s=(), quiet_s=0.0) for one, o in own if o]

    return {
        **_summary(events, draws),
        "level": level,
        "per_material": by("material", counted),
        "per_speed": {f"{speed:g}": of_group(at(speed)) for speed in speeds},
        "per_scene": by("scene", events),
    }


def _summary(events: Sequence[RecordingEvents], draws: Draws) -> dict[str, Any]:
    names = {name: place for place, name in enumerate(dict.fromkeys(map(_name, events)))}
    place = [names[_name(one)] for one in events]
    resampled = Resampled(len(names), draws)

    def total(of: Callable[[RecordingEvents], float]) -> list[float]:
        sums = [0.0] * len(names)
        for at, one in zip(place, events, strict=True):
            sums[at] += of(one)
        return sums

    def of(outcome: str) -> list[float]:
        return total(lambda one: sum(onset.outcome == outcome for onset in one.onsets))

    outcomes = {outcome: of(outcome) for outcome in _OUTCOMES}
    onsets = total(lambda one: len(one.onsets))
    alarms = total(lambda one: sum(onset.num_alarms for onset in one.onsets))
    false = total(lambda one: len(one.false_alarms_s))
    hours = total(lambda one: one.quiet_s / 3600)
    found = [
        (at, one.latency, onset)
        for at, one in zip(place, events, strict=True)
        for onset in one.onsets
        if onset.outcome == "found"
    ]
    return {
        "num_recordings": len(names),
        "num_onsets": int(sum(onsets)),
        **{f"num_{outcome}": int(sum(counts)) for outcome, counts in outcomes.items()},
        "num_false_alarms": int(sum(false)),
        "quiet_hours": sum(hours),
        **{outcome: resampled.share(counts, onsets) for outcome, counts in outcomes.items()},
        "alarms_per_slip": resampled.mean(alarms, onsets),
        "false_alarms_per_minute": resampled.rate(false, hours, per=1 / 60),
        "false_alarms_per_hour": resampled.rate(false, hours),
        "delay_ms": _delays(found, resampled),
        "latency_ms": _parts(found),
        "onset_error_ms": _errors(found, resampled),
    }


_Found = Sequence[tuple[int, LatencyParts, OnsetEvent]]
"""The slips found: which recording's, and the rest of what their delay is made of."""


def _delays(found: _Found, resampled: Resampled) -> dict[str, Any] | None:
    if not found:
        return None
    delay = 1000 * torch.tensor([onset.delay_s for _, _, onset in found], dtype=torch.float64)
    recording = torch.tensor([at for at, _, _ in found])
    median, p95 = resampled.quantiles(delay, recording, (0.5, 0.95))
    steps = torch.linspace(0, 1, _STEPS + 1, dtype=torch.float64)
    return {"median": median, "p95": p95, "quantiles": delay.quantile(steps).tolist()}


def _parts(found: _Found) -> dict[str, float | None] | None:
    if not found:
        return None

    def mean_ms(seconds: Sequence[float]) -> float:
        return 1000 * math.fsum(seconds) / len(seconds)

    measured = [latency.compute_s for _, latency, _ in found if latency.compute_s is not None]
    return {
        "look_ahead": mean_ms([latency.look_ahead_s for _, latency, _ in found]),
        "bin_fill": mean_ms([onset.bin_fill_s for _, _, onset in found]),
        "decision": mean_ms([onset.decision_s for _, _, onset in found]),
        "delay": mean_ms([onset.delay_s for _, _, onset in found]),
        "compute": mean_ms(measured) if measured else None,
    }


def _errors(found: _Found, resampled: Resampled) -> dict[str, Any] | None:
    known = [(at, onset.error_s) for at, _, onset in found if not math.isnan(onset.error_s)]
    if not known:
        return None
    recording = torch.tensor([at for at, _ in known])
    error = 1000 * torch.tensor([error for _, error in known], dtype=torch.float64)
    return {
        "median": resampled.quantiles(error, recording, (0.5,))[0],
        "sd": resampled.deviation(error, recording),
        "mean_abs": resampled.average(error.abs(), recording),
    }


def _name(one: RecordingEvents) -> tuple[str, str, str]:
    return one.scene, one.material, one.recording
