"""What became of slips and quiet on recordings that set nothing."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from tactslip_torch.alarming.methods import Method, labelled
from tactslip_torch.alarming.watching import Clock, Stream, decide, watched
from tactslip_torch.model.calibration import probability, reliability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.events import EventRules, LatencyParts, event_metrics
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.progress import bar
from tactslip_torch.report.metrics import weights_at_share


def events_of(
    parts: Mapping[str, Sequence[Stream]],
    methods: Mapping[str, Method],
    clocks: Mapping[str, Clock],
    compute_s: Mapping[str, float],
    level: float,
) -> dict[str, dict[str, Any]]:
    """Event metrics of every method on every part of the streams.

    Args:
        parts: streams by name, such as ``"test stream"``.
        methods: by name.
        clocks: of every scorer.
        compute_s: time of a decision, of scorers where it was measured.
        level: of intervals.
    """
    events: dict[str, dict[str, Any]] = {}
    for part, name in bar([(p, m) for p in parts for m in methods], "events", "table row"):
        scorer, settings, _ = methods[name]
        clock = clocks[scorer]
        latency = LatencyParts(clock.look_ahead_s, clock.bin_s, compute_s.get(scorer))
        seen = [watched(s, made) for s, made in decide(parts[part], scorer, settings, clock)]
        events.setdefault(part, {})[name] = event_metrics(seen, EventRules(), latency, level=level)
    return events


def reliability_of(
    parts: Mapping[str, Sequence[Stream]], scorer: str, settings: AlarmSettings, clock: Clock
) -> dict[str, Any]:
    """Stated probabilities beside what happened: of each part, and of each of its materials.

    Bins are weighted to the share of slip that probabilities are stated for.
    """
    found: dict[str, Any] = {}
    for part, streams in parts.items():
        groups: dict[str, list[Stream]] = {"": list(streams)}
        for stream in streams:
            groups.setdefault(stream.recording.material, []).append(stream)
        rows = {}
        for material, own in groups.items():
            scores, is_slip = labelled(own, scorer, clock)
            if bool(is_slip.any()) and not bool(is_slip.all()):
                stated = probability(settings.calibration.llr(scores), settings.slip_share)
                weights = weights_at_share(is_slip, settings.slip_share)
                rows[material] = reliability(stated, is_slip, weights=weights).to_dict()
        if "" in rows:
            found[part] = rows.pop("") | {"per_material": rows}
    return found


def push_seconds(detector: SlipDetector, settings: AlarmSettings, pushes: int = 200) -> float:
    """Median time of a push of one hop: what a decision costs a stream here, on one thread."""
    live = StreamingDetector(detector, settings)
    generator = torch.Generator().manual_seed(0)
    hop = torch.randn(settings.hop_samples, len(detector.pool.hand), generator=generator)
    taken = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        live.push(hop.repeat(-(-2 * detector.pool.bin_samples // settings.hop_samples), 1))  # full
        for _ in range(pushes):
            started = time.perf_counter()
            live.push(hop)
            taken.append(time.perf_counter() - started)
    finally:
        torch.set_num_threads(threads)
    return statistics.median(taken[pushes // 10 :])


def amounts_of(streams: Mapping[str, Sequence[Stream]]) -> dict[str, dict[str, dict[str, float]]]:
    """Recordings, hours and slips of each role and scene."""
    amounts: dict[str, dict[str, dict[str, float]]] = {}
    for role, own in streams.items():
        for stream in own:
            none = {"recordings": 0, "hours": 0.0, "slips": 0}
            row = amounts.setdefault(role, {}).setdefault(stream.recording.scene, none)
            row["recordings"] += 1
            row["hours"] += stream.duration_s / 3600
            row["slips"] += len(stream.onsets_s)
    return amounts
