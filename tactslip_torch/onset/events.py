"""Slips found, how late, and false alarms: alarms of recordings matched with their onsets.

Numbers over recordings have intervals by a bootstrap over recordings, since what happens within
one is correlated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

_OUTCOMES = ("found", "early", "missed")  # what becomes of an onset
_LEVEL = 0.95  # of intervals
_STEPS = 20  # between the quantiles that are kept

_FOREVER_S = 1e9

PAPER_SCENE = "paper"
"""The scene of recordings that are the paper's protocol."""

Number = dict[str, float | None]
"""A ``value`` and the ends of its interval, ``low`` and ``high``; these are None where one
recording alone does not determine them."""


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
        early_s: an alarm this long before the first release is early, not false.
        settle_s: an alarm this long behind the end of a slide still belongs to it. None is for as
            long as a decision can rest on samples of the slide, and 50 ms: bin, look-ahead, 50 ms.
    """

    found_within_s: float = 0.5
    early_s: float = 0.2
    settle_s: float | None = None


@dataclass(frozen=True)
class EventRecord:
    """One recording as a detector saw it. Decisions and alarms are at the time they are available.

    Args:
        recording: its name.
        material: what the hand slid on.
        scene: what was done with the hand.
        duration_s: length of the recording.
        alarms_s: when an alarm was raised, ascending.
        onset_estimates_s: of each alarm, when its slip is thought to have begun; may be empty.
        onsets_s: exact onsets, ascending: half of the load has let go.
        sliding_s: of each onset, start and end of its slide.
        speeds_mm_s: of each onset, the steady speed of its stroke.
        first_positive_s: of each onset, the first decision behind its first release that speaks
            for slip, NaN where there is none; may be empty.
        watched_s: start and end of stretches that were watched; empty is the whole recording.
        alarm_ends_s: of each alarm, when its status ended, infinity if it did not; may be empty,
            and an alarm then holds until the next.
        released_s: of each onset, when the first and when the last element of the skin let go; may
            be empty, and the onset then stands for the first release.
        slip_s: stretches that are slip, begun nobody knows when.

    Raises:
        ValueError: if times do not ascend.
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
    released_s: tuple[tuple[float, float], ...] = ()
    slip_s: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        ends = tuple(end for _, end in self.sliding_s)
        edges = tuple(edge for stretch in self.watched_s for edge in stretch)
        for name, times in (
            ("alarms_s", self.alarms_s),
            ("onsets_s", self.onsets_s),
            ("first releases", first_releases(self.onsets_s, self.released_s)),
            ("ends of sliding_s", ends),
            ("watched_s", edges),
        ):
            if not all(before <= after for before, after in pairwise((-math.inf, *times))):
                raise ValueError(f"{self.recording}: {name} must ascend, got {times[:4]}..")

    @classmethod
    def of(cls, truth: Any, **seen: Any) -> EventRecord:
        """A record with what is true of a recording, by itself or by its timeline."""
        names = ("onsets_s", "sliding_s", "speeds_mm_s", "released_s", "slip_s")
        return cls(**{name: getattr(truth, name) for name in names}, **seen)


def first_releases(
    onsets_s: Sequence[float], released_s: Sequence[tuple[float, float]]
) -> tuple[float, ...]:
    """When the first element of each slip lets go, seconds; the onsets where that is not known."""
    return tuple(first for first, _ in released_s) or tuple(onsets_s)


class OnsetEvent(NamedTuple):
    """One onset: what became of it, and of a found one its delay and the parts of it (else NaN).

    Args:
        onset_s: when half of the load had let go.
        first_release_s: when the first element let go; NaN if not known.
        speed_mm_s: steady speed of the stroke, 0 if not known.
        outcome: found, early or missed.
        num_alarms: those that belong to its slip, early ones too.
        delay_s: alarm minus onset, negative where the alarm came before half of the load let go.
        delay_first_s: alarm minus first release; NaN if that is not known.
        slid_mm: way slid from the onset to the alarm at the steady speed. An upper bound: the arm
            may still be speeding up. NaN if no speed is known.
        bin_fill_s: part of the delay, as ``decision_s``; see ``recording_events``.
        decision_s: from the first decision for slip to the alarm.
        error_s: the estimate minus the onset.
    """

    onset_s: float
    first_release_s: float
    speed_mm_s: float
    outcome: str
    num_alarms: int
    delay_s: float = math.nan
    delay_first_s: float = math.nan
    slid_mm: float = math.nan
    bin_fill_s: float = math.nan
    decision_s: float = math.nan
    error_s: float = math.nan


class RecordingEvents(NamedTuple):
    """One recording's alarms against its onsets; ``quiet_s`` is how long an alarm was false."""

    recording: str
    material: str
    scene: str
    onsets: tuple[OnsetEvent, ...]
    false_alarms_s: tuple[float, ...]
    quiet_s: float
    latency: LatencyParts


def recording_events(
    record: EventRecord, rules: EventRules, latency: LatencyParts
) -> RecordingEvents:
    """What became of each onset that was watched, and which alarms were false.

    A slip has three instants: its first element lets go, half of the load has let go (the onset),
    its last element lets go. Its *window* reaches from ``early_s`` before the first release to
    ``settle_s`` behind the end of its slide; an alarm belongs to the last window that holds it, and
    in none it is false, unless it lies in slip without an onset, which is no quiet time either. Of
    each onset exactly one is true:

    - *early*: the last alarm before the first release is no more than ``early_s`` old and its
      status holds still;
    - *found*: not early, and an alarm at or behind the first release, before that of the next slip,
      at most ``found_within_s`` behind the onset and within its window. Its delay is that alarm's
      time minus the onset;
    - *missed*: neither. A status that has held for longer than ``early_s`` finds nothing.

    A delay is look-ahead, bin fill (until the bin of the first decision behind the first release
    that speaks for slip is full) and decision (from that one to the alarm). Bin fill counts from
    the onset and is negative where that bin was full before it. Where no such decision is known to
    come before the alarm, all is bin fill. Alarms outside the stretches watched are not counted.
    """
    settle_s = rules.settle_s
    if settle_s is None:
        settle_s = latency.bin_s + latency.look_ahead_s + 0.05
    look_ahead, settle, early = (_ns(x) for x in (latency.look_ahead_s, settle_s, rules.early_s))
    onsets = [_ns(time) for time in record.onsets_s]
    releases_s = first_releases(record.onsets_s, record.released_s)
    releases = [_ns(time) for time in releases_s]
    windows = [
        (release - early, max(onset, _ns(end)) + settle)
        for release, onset, (_, end) in zip(releases, onsets, record.sliding_s, strict=True)
    ]
    begun = [(_ns(start), _ns(end) + settle) for start, end in record.slip_s]
    spans = [(_ns(start), _ns(end)) for start, end in record.watched_s]

    def is_watched(time: int) -> bool:
        return not spans or any(start <= time <= end for start, end in spans)

    def window_of(time: int) -> int | None:
        held = [place for place, (first, last) in enumerate(windows) if first <= time <= last]
        return held[-1] if held else None

    ends = record.alarm_ends_s or (math.inf,) * len(record.alarms_s)
    raised = [
        _Alarm(at, _ns(end), number, window_of(at))
        for number, (at, end) in enumerate(zip(map(_ns, record.alarms_s), ends, strict=True))
        if is_watched(at)
    ]
    events = []
    for place, onset in enumerate(onsets):
        if not is_watched(onset):
            continue
        num_alarms = sum(alarm.window == place for alarm in raised)
        speed, release = record.speeds_mm_s[place], releases[place]
        known_s = releases_s[place] if record.released_s else math.nan
        event = OnsetEvent(record.onsets_s[place], known_s, speed, "missed", num_alarms)
        before = [alarm for alarm in raised if alarm.at < release]
        after = [alarm for alarm in raised if alarm.at >= release]
        first, last = windows[place]
        later = (time - 1 for time in releases[place + 1 :])
        until = min(onset + _ns(rules.found_within_s), last, *later)
        if before and before[-1].at >= first and before[-1].end > release:
            event = event._replace(outcome="early")
        elif after and after[0].at <= until:
            alarm = after[0]
            positive = record.first_positive_s[place] if record.first_positive_s else math.nan
            spoke = alarm.at if math.isnan(positive) else min(_ns(positive), alarm.at)
            estimates, delay_s = record.onset_estimates_s, (alarm.at - onset) / 1e9
            event = event._replace(
                outcome="found",
                delay_s=delay_s,
                delay_first_s=(alarm.at - release) / 1e9 if record.released_s else math.nan,
                slid_mm=speed * max(delay_s, 0.0) if speed > 0 else math.nan,
                bin_fill_s=(spoke - onset - look_ahead) / 1e9,
                decision_s=(alarm.at - spoke) / 1e9,
                error_s=(_ns(estimates[alarm.number]) - onset) / 1e9 if estimates else math.nan,
            )
        events.append(event)
    quiet = 0
    for start, end in spans or [(0, _ns(record.duration_s))]:
        for first, last in sorted(windows + begun):
            quiet += max(0, min(first, end) - start)
            start = max(start, last)
        quiet += max(0, end - start)
    in_none = [alarm for alarm in raised if alarm.window is None]
    false = [a for a in in_none if not any(at <= a.at <= last for at, last in begun)]
    return RecordingEvents(
        record.recording,
        record.material,
        record.scene,
        tuple(events),
        tuple(record.alarms_s[alarm.number] for alarm in false),
        quiet / 1e9,
        latency,
    )


class _Alarm(NamedTuple):
    """When it was raised, when its status ended, which one it is, and in whose slip's window."""

    at: int
    end: int
    number: int
    window: int | None


def _ns(seconds: float) -> int:
    return round(min(seconds, _FOREVER_S) * 1e9)


class Bootstrap:
    """A set of recordings, and as many drawn with replacement, again and again.

    An interval always holds its value. For shares and rates the score interval of independent
    events is taken where it reaches further: no miss among a few slips is no proof of none.

    Args:
        num_recordings: in the set.
        level: of the intervals, whose ends are percentiles.
        num: how many draws.
        groups: if given, of each recording, ``[R]``: as many are drawn of each group as it has.

    Reference:
        Efron and Tibshirani (1993), An Introduction to the Bootstrap, chapters 8 and 13. Wilson
        (1927), J. Am. Stat. Assoc. 22, 209-212, and its form for a Poisson count.
    """

    def __init__(
        self,
        num_recordings: int,
        level: float = _LEVEL,
        num: int = 1000,
        groups: Tensor | None = None,
    ) -> None:
        generator = torch.Generator().manual_seed(0)
        shape = (num, num_recordings)
        group = torch.zeros(num_recordings) if groups is None else groups
        drawn = torch.zeros(shape, dtype=torch.long)
        for name in group.unique():
            own = (group == name).nonzero()[:, 0]
            drawn[:, own] = own[torch.randint(len(own), (num, len(own)), generator=generator)]
        self._ends = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
        self._z = float(torch.special.ndtri(self._ends[1]))
        self._times = torch.zeros(shape, dtype=torch.float64)  # how often each is in each draw
        self._times.scatter_add_(1, drawn, torch.ones_like(self._times))

    def share(self, parts: Sequence[float], wholes: Sequence[float]) -> Number | None:
        """``ratio`` of parts that are each within their whole."""
        return self.ratio(parts, wholes, end=_share_end)

    def rate(
        self, counts: Sequence[float], times: Sequence[float], per: float = 1.0
    ) -> Number | None:
        """``ratio`` of counts in so much time, for ``per`` units of it."""
        return self.ratio(counts, times, per, _rate_end)

    def ratio(
        self,
        parts: Sequence[float],
        wholes: Sequence[float],
        per: float = 1.0,
        end: Callable[[float, float, float], float] | None = None,
    ) -> Number | None:
        """Sum of parts by sum of wholes, of each recording; None of nothing."""
        part, whole = math.fsum(parts), math.fsum(wholes)
        if not whole > 0:
            return None
        sums = self._times @ torch.tensor([parts, wholes], dtype=torch.float64).T  # [draws, 2]
        drawn, having = per * sums[:, 0] / sums[:, 1], torch.tensor(wholes).nonzero()
        number = self._number(per * part / whole, drawn, having)
        if end is None:
            return number
        low, high = (per * end(part, whole, z) for z in (-self._z, self._z))
        if number["low"] is not None and number["high"] is not None:
            low, high = min(low, number["low"]), max(high, number["high"])
        return number | {"low": low, "high": high}

    def statistic(self, of: Callable[[Tensor], Tensor], counts: Tensor) -> Number:
        """A statistic of counts that are summed over recordings, such as a difference of scores.

        Args:
            of: the statistic, ``[n, ...] -> [n]``; NaN where a draw has none.
            counts: of each recording.

        Shape:
            - counts: ``[R, ...]``
        """
        values = counts.double()
        drawn = of(torch.tensordot(self._times, values, 1))
        return self._number(float(of(values.sum(0)[None])), drawn, torch.arange(len(values)))

    def quantile(self, values: Tensor, recording: Tensor, share: float) -> Number:
        """Quantile of values, linear between neighbours, each value drawn with its recording.

        Shape:
            - values, recording: ``[N]``, N at least 1; recording is a number below that of the set
        """
        order = values.argsort()
        ordered = values[order]
        reached = self._times[:, recording[order]].cumsum(1)  # [draws, N], values up to each
        place = share * (reached[:, -1:] - 1)  # below 0 where none is drawn
        low, high = (
            ordered[torch.searchsorted(reached, at, right=True).clamp(max=len(ordered) - 1)]
            for at in (place.floor(), place.ceil())
        )
        drawn = low + (place - place.floor()) * (high - low)
        drawn = torch.where(reached[:, -1:] < 1, torch.nan, drawn)[:, 0]
        return self._number(float(ordered.quantile(share)), drawn, recording)

    def _number(self, value: float, drawn: Tensor, recording: Tensor) -> Number:
        known = drawn[~drawn.isnan()]  # NaN where a draw has none
        if len(recording.unique()) < 2 or not len(known):
            return {"value": value, "low": None, "high": None}
        low, high = known.quantile(self._ends).tolist()
        return {"value": value, "low": min(low, value), "high": max(high, value)}


def _share_end(part: float, whole: float, z: float) -> float:
    spread = z * math.sqrt(part * (whole - part) / whole + z * z / 4)
    return min(max((part + z * z / 2 + spread) / (whole + z * z), 0.0), 1.0)


def _rate_end(count: float, time: float, z: float) -> float:
    return max(count + z * z / 2 + z * math.sqrt(count + z * z / 4), 0.0) / time


def pooled_metrics(
    events: Sequence[RecordingEvents], *, num_resamples: int = 1000
) -> dict[str, Any]:
    """All recordings together, in JSON-able numbers; their order does not matter.

    - ``num_recordings``, ``num_onsets``, ``num_found``, ``num_early``, ``num_missed``,
      ``num_false_alarms``, ``quiet_hours``: counts, and the time in which an alarm was false.
    - ``found``, ``early``, ``missed``: shares of the onsets; ``alarms_per_slip``: alarms that
      belong to a slip, by onsets. None without onsets.
    - ``false_alarms_per_minute``, ``false_alarms_per_hour``: None without such time.
    - ``delay_ms`` of the slips found: ``median``, ``p95``, and ``quantiles`` from least to most in
      steps of 5 %. ``delay_first_ms``, from the first release, and ``slid_mm``, at most slid until
      the alarm: ``median`` and ``p95``. ``latency_ms``: means of the delay's parts, which add up to
      ``delay``, and ``compute`` (None where not measured). None where there is nothing to say this
      of.
    - ``per_material``, ``per_scene``, ``per_speed``: the same of groups, without groups, level and
      quantiles; a false alarm has no speed. Of several scenes, materials and speeds are of the
      paper's alone, where it is one of them.

    A number with an interval is ``{"value", "low", "high"}``, by bootstrap over recordings;
    what bears one name is one recording.

    Args:
        events: of ``recording_events``; of several detectors if they are to be pooled.
        num_resamples: draws.
    """
    events = sorted(events, key=lambda one: (*_name(one), one.quiet_s, str(one.onsets)))
    scenes = {one.scene for one in events}
    is_all = len(scenes) < 2 or PAPER_SCENE not in scenes
    counted = [one for one in events if is_all or one.scene == PAPER_SCENE]

    def summary(own: Sequence[RecordingEvents], *, is_group: bool = True) -> dict[str, Any]:
        numbers = _summary(own, num_resamples)
        if is_group and numbers["delay_ms"]:
            del numbers["delay_ms"]["quantiles"]
        return numbers

    def by(name: str, events: Sequence[RecordingEvents]) -> dict[str, Any]:
        groups = dict.fromkeys(getattr(one, name) for one in events)
        return {
            group: summary([one for one in events if getattr(one, name) == group])
            for group in groups
        }

    per_speed = {}
    for speed in sorted({onset.speed_mm_s for one in counted for onset in one.onsets}):
        own = [
            one._replace(onsets=onsets, false_alarms_s=(), quiet_s=0.0)
            for one in counted
            if (onsets := tuple(onset for onset in one.onsets if onset.speed_mm_s == speed))
        ]
        per_speed[f"{speed:g}"] = summary(own)
    return {
        **summary(events, is_group=False),
        "level": _LEVEL,
        "per_material": by("material", counted),
        "per_speed": per_speed,
        "per_scene": by("scene", events),
    }


def _summary(events: Sequence[RecordingEvents], num_resamples: int) -> dict[str, Any]:
    """The numbers of ``pooled_metrics`` but for its groups."""
    places = {name: place for place, name in enumerate(dict.fromkeys(map(_name, events)))}
    bootstrap = Bootstrap(len(places), num=num_resamples)
    sums = {
        name: [0.0] * len(places) for name in (*_OUTCOMES, "onsets", "alarms", "false", "hours")
    }
    found: list[tuple[int, LatencyParts, OnsetEvent]] = []
    for one in events:
        place = places[_name(one)]
        sums["false"][place] += len(one.false_alarms_s)
        sums["hours"][place] += one.quiet_s / 3600
        for onset in one.onsets:
            sums["onsets"][place] += 1
            sums["alarms"][place] += onset.num_alarms
            sums[onset.outcome][place] += 1
            if onset.outcome == "found":
                found.append((place, one.latency, onset))
    recordings = torch.tensor([place for place, _, _ in found])

    def known(name: str, factor: float) -> tuple[Tensor, Tensor]:
        """What is known of the onsets found, and the place of their recordings."""
        values = [factor * getattr(onset, name) for _, _, onset in found]
        tensor = torch.tensor(values, dtype=torch.float64)
        return tensor[~tensor.isnan()], recordings[~tensor.isnan()]

    def spread(name: str, factor: float = 1000) -> dict[str, Any] | None:
        values, own = known(name, factor)
        shares = {"median": 0.5, "p95": 0.95} if len(values) else {}
        return {n: bootstrap.quantile(values, own, share) for n, share in shares.items()} or None

    delay_ms, latency_ms = spread("delay_s"), None
    if delay_ms:
        steps = torch.linspace(0, 1, _STEPS + 1, dtype=torch.float64)
        delay, _ = known("delay_s", 1000)
        delay_ms["quantiles"] = delay.quantile(steps).tolist()
        parts = {
            "look_ahead": [latency.look_ahead_s for _, latency, _ in found],
            "bin_fill": [onset.bin_fill_s for _, _, onset in found],
            "decision": [onset.decision_s for _, _, onset in found],
            "delay": [onset.delay_s for _, _, onset in found],
            "compute": [of.compute_s for _, of, _ in found if of.compute_s is not None],
        }
        latency_ms = {
            name: 1000 * math.fsum(seconds) / len(seconds) if seconds else None
            for name, seconds in parts.items()
        }
    shares = {name: bootstrap.share(sums[name], sums["onsets"]) for name in _OUTCOMES}
    return {
        "num_recordings": len(places),
        **{f"num_{name}": int(sum(sums[name])) for name in ("onsets", *_OUTCOMES)},
        "num_false_alarms": int(sum(sums["false"])),
        "quiet_hours": sum(sums["hours"]),
        **shares,
        "alarms_per_slip": bootstrap.ratio(sums["alarms"], sums["onsets"]),
        "false_alarms_per_minute": bootstrap.rate(sums["false"], sums["hours"], per=1 / 60),
        "false_alarms_per_hour": bootstrap.rate(sums["false"], sums["hours"]),
        "delay_ms": delay_ms,
        "delay_first_ms": spread("delay_first_s"),
        "slid_mm": spread("slid_mm", 1),
        "latency_ms": latency_ms,
    }


def _name(one: RecordingEvents) -> tuple[str, str, str]:
    return one.scene, one.material, one.recording
