"""What a test says of a detector: decisions on labelled bins, as scores and as events.

Bins of a stroke in their order are a short stream: a rule makes alarms of the decisions, and these
find a slip or do not. The detector was not made for these rules; they show what its errors would
mean in use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from tactslip_torch.data.labels import NO_POSITION
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.feature_maker import RecordingFeatures, Stroke
from tactslip_torch.onset.events import (
    EventRules,
    LatencyParts,
    RecordingEvents,
    Watched,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.latch import latch, latch_start
from tactslip_torch.onset.sequential import KOfN
from tactslip_torch.report.metrics import (
    answer_counts,
    answer_metrics,
    bin_metrics,
    confusion_matrix,
    split_metrics,
)

RULES: Mapping[str, KOfN] = MappingProxyType(
    {"first_transition": KOfN(1, 1), "two_of_three": KOfN(2, 3)}
)
"""From decisions to alarms: the paper's, every first slip bin behind a non-slip one, and two of the
last three. Either is armed again by a decision for which it does not hold."""

BINS_APART = "bins of one stroke are on both sides of this split"
"""Why a split by bin has no events."""


class JudgedBins(NamedTuple):
    """Decisions on bins of one recording that have one role.

    Attributes:
        baselines: decisions of baselines by name (``tactslip_torch.baselines``).
        is_whole: whether these are all bins of the recording.
        answer: slip, non-slip or unsure (``model.conformal``); None of a detector that is never
            unsure.

    Shape:
        - truth, says_slip, speed_mm_s, position, stroke, ends_s, answer, each of baselines: ``[N]``
    """

    recording: RecordingId
    truth: Tensor
    says_slip: Tensor
    baselines: Mapping[str, Tensor]
    speed_mm_s: Tensor
    position: Tensor
    stroke: Tensor
    ends_s: Tensor
    strokes: tuple[Stroke, ...]
    hop_s: float
    is_whole: bool
    answer: Tensor | None = None


def judged_bins(
    batch: RecordingFeatures,
    says_slip: Tensor,
    baselines: Mapping[str, Tensor],
    answer: Tensor | None = None,
) -> dict[str, JudgedBins]:
    """Decisions ``[N]`` on the bins of a recording, for each role that some of them have."""
    return {
        role: JudgedBins(
            batch.recording,
            batch.is_slip[mask],
            says_slip[mask],
            {name: decisions[mask] for name, decisions in baselines.items()},
            batch.speed_mm_s[mask],
            batch.position[mask],
            batch.stroke[mask],
            batch.ends_s[mask],
            batch.strokes,
            batch.hop_s,
            bool(mask.all()),
            None if answer is None else answer[mask],
        )
        for role, mask in batch.roles.items()
        if bool(mask.any())
    }


def bin_scores(parts: Sequence[JudgedBins]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """``bin_metrics`` of the detector, and ``split_metrics`` of each baseline, on all bins."""
    truth = torch.cat([part.truth for part in parts])
    places = torch.cat([part.position for part in parts]).tolist()
    scores = bin_metrics(
        truth,
        torch.cat([part.says_slip for part in parts]),
        [part.recording.material for part in parts for _ in part.truth],
        torch.cat([part.speed_mm_s for part in parts]).tolist(),
        [part.recording.scene for part in parts for _ in part.truth],
        [None if place == NO_POSITION else place for place in places],
    )
    return scores, {
        name: split_metrics(
            confusion_matrix(truth, torch.cat([part.baselines[name] for part in parts]))
        )
        for name in parts[0].baselines
    }


def answer_scores(parts: Sequence[JudgedBins], coverage: float) -> dict[str, Any]:
    """``answer_metrics`` of bins that a detector with thresholds for unsure answers judged."""
    counts = {
        str(part.recording): answer_counts(part.truth, part.answer)
        for part in parts
        if part.answer is not None
    }
    return answer_metrics(counts, coverage)


def events_by_rule(
    parts: Sequence[JudgedBins], latency: LatencyParts
) -> dict[str, list[RecordingEvents]]:
    """What each of ``RULES`` makes of the bins; no recordings where a split is by bin.

    A rule starts anew with every stroke and every unbroken stretch of bins of no stroke. Watched is
    from one hop before the first decision of such a stretch to the last one.
    """
    if not all(part.is_whole for part in parts):
        return {name: [] for name in RULES}
    streams = [(part, rows) for part in parts for rows in _stretches(part)]
    says_slip = pad_sequence([part.says_slip[rows] for part, rows in streams], batch_first=True)
    llr = torch.where(says_slip, 1.0, -1.0)  # [streams, most bins]; what is padded changes nothing
    events = {}
    for name, rule in RULES.items():
        statistic, _ = rule.scan(llr, rule.start(llr[:, 0]))
        start = latch_start(llr[:, 0])
        is_alarm, is_on, _ = latch(
            statistic, 0.0, margin=rule.margin, rearm=1, refractory=0, state=start
        )
        heard: dict[RecordingId, list[_Stream]] = {}
        for (part, rows), alarms, status in zip(streams, is_alarm, is_on, strict=True):
            available_s = part.ends_s[rows] + latency.look_ahead_s
            stream = _Stream(available_s, alarms[: len(rows)], status[: len(rows)])
            heard.setdefault(part.recording, []).append(stream)
        events[name] = [
            recording_events(_watched(part, heard[part.recording], latency), EventRules(), latency)
            for part in parts
        ]
    return events


def event_numbers(
    events: Mapping[str, Mapping[str, Sequence[RecordingEvents]]],
) -> dict[str, dict[str, Any]]:
    """``pooled_metrics`` by role and rule; of no recordings with the ``reason``, all None."""
    return {
        role: {
            name: pooled_metrics(own) | ({} if own else {"reason": BINS_APART})
            for name, own in by_rule.items()
        }
        for role, by_rule in events.items()
    }


def together(
    parts: Sequence[Mapping[str, Mapping[str, Sequence[RecordingEvents]]]],
) -> dict[str, dict[str, list[RecordingEvents]]]:
    """Events of several tests by role and rule, as of one."""
    merged: dict[str, dict[str, list[RecordingEvents]]] = {}
    for part in parts:
        for role, by_rule in part.items():
            for name, own in by_rule.items():
                merged.setdefault(role, {}).setdefault(name, []).extend(own)
    return merged


class _Stream(NamedTuple):
    """Decisions in their order: when each is available, and what a rule made of them, ``[T]``."""

    available_s: Tensor
    is_alarm: Tensor
    is_on: Tensor


def _stretches(part: JudgedBins) -> list[Tensor]:
    """The rows of each stroke, and of each unbroken stretch of bins of no stroke."""
    rows = torch.arange(len(part.stroke))
    is_apart = part.ends_s.diff() > part.hop_s + 1e-6
    is_new = (part.stroke.diff() != 0) | ((part.stroke[1:] < 0) & is_apart)
    return list(rows.tensor_split(rows[1:][is_new]))


def _watched(part: JudgedBins, streams: Sequence[_Stream], latency: LatencyParts) -> Watched:
    """A recording as the detector saw it through a rule."""
    alarms: list[tuple[float, float]] = []
    seen: list[tuple[float, float]] = []
    for stream in sorted(streams, key=lambda stream: float(stream.available_s[0])):
        available_s = stream.available_s.tolist()
        ended = (~stream.is_on).nonzero().flatten().tolist()
        for raised in stream.is_alarm.nonzero().flatten().tolist():
            end = next((available_s[place] for place in ended if place > raised), math.inf)
            alarms.append((available_s[raised], end))
        before = seen[-1][1] if seen else -math.inf  # a hop may be longer than a bin
        seen.append((max(available_s[0] - part.hop_s, before), available_s[-1]))
    positive = part.ends_s[part.says_slip] + latency.look_ahead_s
    of = part.stroke[part.says_slip]
    first = []
    for number, stroke in enumerate(part.strokes):
        later = positive[(of == number) & (positive >= stroke.onset_s)]
        first.append(float(later.min()) if len(later) else math.nan)
    return Watched(
        recording=str(part.recording),
        material=part.recording.material,
        scene=part.recording.scene,
        duration_s=seen[-1][1],
        alarms_s=tuple(alarm for alarm, _ in alarms),
        onset_estimates_s=(),
        onsets_s=tuple(stroke.onset_s for stroke in part.strokes),
        sliding_s=tuple((stroke.onset_s, stroke.slide_end_s) for stroke in part.strokes),
        speeds_mm_s=tuple(stroke.speed_mm_s for stroke in part.strokes),
        first_positive_s=tuple(first),
        watched_s=tuple(seen),
        alarm_ends_s=tuple(end for _, end in alarms),
    )
