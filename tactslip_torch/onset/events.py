"""What a detector is judged by in use: slips found, how late, and how often it cries for nothing.

What ``matching`` finds in each recording, put together in numbers (REFERENCE.md section 7), with
intervals over recordings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from tactslip_torch.onset.matching import (
    OUTCOMES,
    EventRules,
    LatencyParts,
    OnsetEvent,
    RecordingEvents,
    Watched,
    recording_events,
)
from tactslip_torch.onset.resampling import Draws, Resampled

__all__ = [
    "OUTCOMES",
    "EventRules",
    "LatencyParts",
    "OnsetEvent",
    "RecordingEvents",
    "Watched",
    "event_metrics",
    "pooled_metrics",
    "recording_events",
]

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

    outcomes = {outcome: of(outcome) for outcome in OUTCOMES}
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
