"""Hops and filters: what each costs and buys, with thresholds for one and the same target.

Detectors watch every recording once, at the shortest hop; a longer one has every second, fifth,
tenth of the decisions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from benchmarks.clocks import say
from benchmarks.engines import ENGINES
from benchmarks.onset.cost import push_seconds
from benchmarks.onset.sizes import Sizes
from benchmarks.onset.trained import alarming_of, at_hop, composed
from tactslip_torch.analysis.pareto import nondominated
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.training.alarm import (
    FITS,
    CalibratedAlarm,
    amounts_of,
    events_of,
    labelled,
    threshold_facts,
)
from tactslip_torch.training.stream_evaluation import Clock, Stream, watch

JUDGED = ("test", "unseen")
"""Roles of streams that set nothing: other cycles of the materials trained on, and new ones."""


def front_of(sizes: Sizes, trained: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Every filter at every hop: delay, slips found, false alarms achieved, compute.

    Args:
        sizes: how much.
        trained: ``train_all``.

    Returns:
        ``"streams"``, recordings, hours and slips of each role and scene; ``"rows"``.
    """
    files = {align: of["file"] for align, of in trained.items()}
    detectors = {align: SlipDetector.load(file) for align, file in files.items()}
    config = composed(sizes, sizes.aligns[0])
    finest = alarming_of(config, sizes.hop_ms[0], sizes.hours, sizes.target_per_hour)
    streams = watched_by(finest, detectors)
    rows: list[dict[str, Any]] = []
    settings = {}
    for align, hop_ms in product(detectors, sizes.hop_ms):
        say(f"front: {align}, a decision every {hop_ms:g} ms")
        detector = detectors[align]
        stage = at_hop(finest, hop_ms, float(config.labels.bin_ms))
        step = stage.hop_samples // finest.hop_samples
        own = {role: [every(s, align, step) for s in of] for role, of in streams.items()}
        rate, bin_samples = detector.pool.sample_rate_hz, detector.pool.bin_samples
        clock = Clock(rate, stage.hop_samples, bin_samples, detector.look_ahead)
        found, settings[align, hop_ms] = judged(stage, own, align, clock)
        look_ahead_ms = 1e3 * clock.look_ahead_s
        rows.append({"align": align, "hop_ms": hop_ms, "look_ahead_ms": look_ahead_ms, **found})
    live = {
        f"{engine} {align} {hop_ms}": StreamingDetector(detector, settings[align, hop_ms])
        for engine, (align, file) in product(ENGINES, files.items())
        for detector in [SlipDetector.load(file, engine)]
        for hop_ms in sizes.hop_ms
    }
    seconds = push_seconds(live, finest.streams, sizes.rounds, sizes.seed)
    for row in rows:
        at = f"{row['align']} {row['hop_ms']}"
        row["push_s"] = {engine: seconds[f"{engine} {at}"] for engine in ENGINES}
    return {"streams": amounts_of(streams), "rows": on_fronts(rows)}


def watched_by(
    alarming: CalibratedAlarm, detectors: Mapping[str, SlipDetector], num_workers: int | None = None
) -> dict[str, list[Stream]]:
    """The recordings of every role, as the detectors score them at the hop of the stage.

    Args:
        alarming: whose roles.
        detectors: by name, all trained on the same recordings.
        num_workers: processes.
    """
    roles = alarming.roles(next(iter(detectors.values())))
    role_of = {recording: role for role, own in roles.items() for recording in own}
    streams: dict[str, list[Stream]] = {role: [] for role in roles}
    for stream in watch(
        alarming.streams, list(role_of), dict(detectors), alarming.hop_samples, num_workers
    ):
        streams[role_of[stream.recording]].append(stream)
    return streams


def every(stream: Stream, scorer: str, step: int) -> Stream:
    """A stream as one detector would have scored it at a hop ``step`` times as long."""
    return replace(
        stream,
        score={scorer: stream.score[scorer][::step]},
        is_valid={scorer: stream.is_valid[scorer][::step]},
        is_usable={scorer: stream.is_usable[scorer][::step]},
    )


def judged(
    stage: CalibratedAlarm, streams: Mapping[str, Sequence[Stream]], scorer: str, clock: Clock
) -> tuple[dict[str, Any], AlarmSettings]:
    """The main rule, set on the streams that calibrate and judged on the others.

    Args:
        stage: its promise and rule.
        streams: by role, one decision per hop of the clock.
        scorer: whose scores.
        clock: of these.

    Returns:
        ``"threshold"`` and what became of each role of ``JUDGED``, JSON-able; and the settings.
    """
    calibrating = streams["calibrate"]
    calibration = FITS[stage.calibration](*labelled(calibrating, scorer, clock))
    rule = stage.made_rules(clock.bin_samples)[stage.rule]
    method = stage.budget().calibrated(scorer, rule, calibration, calibrating, clock)
    assert method.threshold is not None
    parts = {role: streams[role] for role in JUDGED}
    events = events_of(parts, {scorer: method}, {scorer: clock}, {}, stage.level)
    found = {role: in_short(events[role][scorer]) for role in JUDGED}
    return {"threshold": threshold_facts(method.threshold), **found}, method.settings


def in_short(events: Mapping[str, Any]) -> dict[str, Any]:
    """Event metrics without those of groups."""
    return {name: of for name, of in events.items() if not name.startswith("per_")}


def compute(row: Mapping[str, Any], engine: str) -> float:
    """Processor seconds of one second of stream."""
    return float(row["push_s"][engine]) * 1e3 / float(row["hop_ms"])


def median_ms(row: Mapping[str, Any], role: str) -> float:
    """Of the delays of slips found; infinite where none was."""
    delay = row[role]["delay_ms"]
    return math.inf if delay is None else float(delay["median"]["value"])


def on_fronts(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows with the fronts they lie on: those that no other beats, as good in both ways or better.

    ``"on"`` has ``"compute"``, delay of seen materials against compute by the fastest engine, and
    by role delay against slips not found, early ones among them. Who finds no slip is on none.
    """
    axes = {
        "compute": [(median_ms(row, "test"), compute(row, ENGINES[0])) for row in rows],
        **{role: [(median_ms(row, role), not_found(row[role])) for row in rows] for role in JUDGED},
    }
    best = {
        name: {points[place] for place in nondominated(points) if points[place][0] < math.inf}
        for name, points in axes.items()
    }
    return [
        {**row, "on": [name for name, points in axes.items() if points[place] in best[name]]}
        for place, row in enumerate(rows)
    ]


def not_found(events: Mapping[str, Any]) -> float:
    """Share of slips without an alarm within half a second behind the onset."""
    return 1 - float(events["found"]["value"])
