"""From decisions on labelled bins to scores and events, and from several folds to one result.

Bins of a stroke in their order are a short stream: a rule makes alarms of the decisions, and these
find a slip or do not. The detector was not made for these rules; they show what its errors would
mean in use.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.special import ndtr, stdtrit
from torch import Tensor

from tactslip_torch.data.labels import NO_POSITION
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.onset.events import (
    Bootstrap,
    EventRecord,
    EventRules,
    LatencyParts,
    RecordingEvents,
    first_releases,
    pooled_metrics,
    recording_events,
)
from tactslip_torch.onset.rules import KOfN, latch
from tactslip_torch.report.metrics import (
    bin_metrics,
    confusion_matrix,
    merged_metrics,
    split_metrics,
    summed_metrics,
)
from tactslip_torch.training.datamodule import RecordingFeatures

RULES: Mapping[str, KOfN] = MappingProxyType(
    {"first_transition": KOfN(1, 1), "two_of_three": KOfN(2, 3)}
)
"""From decisions to alarms, each k of the last n: the paper's, every first slip bin after a
non-slip one, and two of three. Either is armed again by a decision for which it does not hold."""

FEWEST_GROUPS = 5
"""Materials or sessions over which an interval can be drawn; with fewer it is over recordings."""

BINS_APART = "bins of one stroke are on both sides of this split"
"""Why a split by bin has no events."""


class EvaluatedBins(NamedTuple):
    """Decisions on bins of one recording that have one role.

    Attributes:
        bins: which they are; without features.
        says_slip: of the detector, ``[N]``, bool; not where the decision is not valid.
        is_valid: whether the decision is, ``[N]``, bool.
        baselines: decisions of baselines by name, ``[N]`` each.
        is_whole: whether these are all bins of the recording.
    """

    bins: RecordingFeatures
    says_slip: Tensor
    is_valid: Tensor
    baselines: Mapping[str, Tensor]
    is_whole: bool


class Outcomes(NamedTuple):
    """Confusions of each recording, of the detector and of the baselines on the same bins.

    Attributes:
        recordings: ``R``.
        confusions: by method, ``[R, 2, 2]``, truth by row; the first is ``"detector"``.
    """

    recordings: tuple[RecordingId, ...]
    confusions: Mapping[str, Tensor]

    @classmethod
    def of(cls, parts: Sequence[EvaluatedBins]) -> Outcomes:
        """The confusions of the recordings; nothing of a recording without baselines."""
        number = torch.arange(len(parts)).repeat_interleave(
            torch.tensor([len(part.says_slip) for part in parts])
        )
        cell = 4 * number + 2 * torch.cat([part.bins.is_slip for part in parts]).long()
        decisions = {"detector": torch.cat([part.says_slip for part in parts])}
        for name in parts[0].baselines:
            decisions[name] = torch.cat([part.baselines[name] for part in parts])
        return cls(
            tuple(part.bins.recording for part in parts),
            {
                name: torch.bincount(cell + says_slip, minlength=4 * len(parts)).view(-1, 2, 2)
                for name, says_slip in decisions.items()
            },
        )


def evaluated_bins(
    batch: RecordingFeatures,
    says_slip: Tensor,
    is_valid: Tensor,
    baselines: Mapping[str, Tensor],
) -> dict[str, EvaluatedBins]:
    """Decisions ``[N]`` on the bins of a recording, for each role that some of them have."""
    heavy = ("features", "span", "run")
    light = batch._replace(**{name: getattr(batch, name)[:, :0] for name in heavy})
    return {
        role: EvaluatedBins(
            light.of(mask),
            says_slip[mask],
            is_valid[mask],
            {name: decisions[mask] for name, decisions in baselines.items()},
            bool(mask.all()),
        )
        for role, mask in batch.roles.items()
        if bool(mask.any())
    }


def bin_scores(parts: Sequence[EvaluatedBins]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """``bin_metrics`` of the detector, and ``split_metrics`` of each baseline, on all bins.

    Those of the detector have ``num_not_valid`` too: bins on which its decision is not valid.
    """
    truth = torch.cat([part.bins.is_slip for part in parts])
    places = torch.cat([part.bins.position for part in parts]).tolist()
    scores = bin_metrics(
        truth,
        torch.cat([part.says_slip for part in parts]),
        [part.bins.recording.material for part in parts for _ in part.says_slip],
        torch.cat([part.bins.speed_mm_s for part in parts]).tolist(),
        [part.bins.recording.scene for part in parts for _ in part.says_slip],
        [None if place == NO_POSITION else place for place in places],
    )
    scores["num_not_valid"] = sum(int((~part.is_valid).sum()) for part in parts)
    return scores, {
        name: split_metrics(
            confusion_matrix(truth, torch.cat([part.baselines[name] for part in parts]))
        )
        for name in parts[0].baselines
    }


def compared(outcomes: Sequence[Outcomes], role: str) -> dict[str, Any]:
    """By how much the balanced accuracy of each baseline differs from the detector's.

    Returns:
        ``baselines``: of each its ``balanced_accuracy``, and ``difference`` from the detector's
        with a 95 % interval, above 0 where the baseline is better; ``detector``: its balanced
        accuracy. The interval is a bootstrap over ``num_drawn`` of what ``drawn`` says, expanded
        for few: recordings or, where whole materials (or sessions) are left out and there are five
        or more, those.
        Empty without baselines or where a class is absent.

    Args:
        outcomes: of one or several folds that have no bin in common.
        role: what the recordings are.
    """
    names = [name for name in outcomes[0].confusions if name != "detector"]
    recordings = [recording for own in outcomes for recording in own.recordings]
    counts = {
        name: torch.cat([own.confusions[name] for own in outcomes]) for name in ("detector", *names)
    }
    if not names or not counts["detector"].sum((0, 2)).all():
        return {}
    drawn, groups = "recording", [str(recording) for recording in recordings]
    for group in ("material", "session") if role.endswith("unseen") else ():
        own = [str(getattr(recording, group)) for recording in recordings]
        if len(set(own)) >= FEWEST_GROUPS:
            drawn, groups = group, own
            break
    places = {group: place for place, group in enumerate(dict.fromkeys(groups))}
    place = torch.tensor([places[group] for group in groups])
    number = max(len(places), 2)
    # percentiles are too narrow for few: expanded as Hesterberg (2015), Am. Stat. 69, 371-386
    tail = ndtr(math.sqrt(number / (number - 1)) * stdtrit(number - 1, 0.025))
    bootstrap = Bootstrap(len(places), 1 - 2 * float(tail))

    def difference(sums: Tensor) -> Tensor:
        """``[n, 2, 2, 2]``, of the detector and a baseline, to ``[n]``."""
        detector, baseline = (sums.diagonal(dim1=-2, dim2=-1) / sums.sum(-1)).mean(-1).unbind(1)
        return baseline - detector

    def summed(name: str) -> Tensor:
        return torch.zeros(len(places), 2, 2).long().index_add(0, place, counts[name])

    detector = summed("detector")
    return {
        "drawn": drawn,
        "num_drawn": len(places),
        "detector": split_metrics(detector.sum(0).tolist())["balanced_accuracy"],
        "baselines": {
            name: {
                "balanced_accuracy": split_metrics(own.sum(0).tolist())["balanced_accuracy"],
                "difference": bootstrap.statistic(difference, torch.stack([detector, own], 1)),
            }
            for name in names
            for own in [summed(name)]
        },
    }


def events_by_rule(
    parts: Sequence[EvaluatedBins], latency: LatencyParts
) -> dict[str, list[RecordingEvents]]:
    """What each of ``RULES`` makes of the bins; no recordings where a split is by bin."""
    if not all(part.is_whole for part in parts):
        return {name: [] for name in RULES}
    return {
        name: [
            recording_events(_watched(part, rule, latency), EventRules(), latency) for part in parts
        ]
        for name, rule in RULES.items()
    }


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


def _watched(part: EvaluatedBins, rule: KOfN, latency: LatencyParts) -> EventRecord:
    """A recording as the detector saw it through an alarm of k of the last n decisions.

    It starts anew with every stroke and every unbroken stretch of bins of no stroke, whatever order
    their labels put them in. Watched is from one hop before the first decision of such a stretch to
    the last one. The rule passes over decisions that are not valid.
    """
    bins, times = part.bins, part.bins.times
    order = np.lexsort((bins.ends_s.numpy(), bins.stroke.numpy() < 0))
    available_s = (bins.ends_s + latency.look_ahead_s).numpy()[order]
    says_slip, stroke = part.says_slip.numpy()[order], bins.stroke.numpy()[order]
    is_valid = part.is_valid.numpy()[order]
    is_apart = np.diff(available_s) > bins.hop_s + 1e-6
    is_new = (np.diff(stroke) != 0) | ((stroke[1:] < 0) & is_apart)
    stretches = np.split(np.arange(len(stroke)), np.flatnonzero(is_new) + 1)
    alarms: list[tuple[float, float]] = []
    seen: list[tuple[float, float]] = []
    for rows in sorted(stretches, key=lambda rows: float(available_s[rows[0]])):
        before = seen[-1][1] if seen else -math.inf  # a hop may be longer than a bin
        begin_s, end_s = float(available_s[rows[0]]), float(available_s[rows[-1]])
        seen.append((max(begin_s - bins.hop_s, before), end_s))
        rows = rows[is_valid[rows]]
        hops_s = available_s[rows]
        statistic, _ = rule.scan_row(says_slip[rows].astype(float).tolist(), rule.start(), float)
        alarm, is_on, _ = latch(statistic, 1.0, rearm=1, refractory=0)
        raised = np.flatnonzero(alarm)
        off = np.append(np.flatnonzero(np.logical_not(is_on)), len(rows))
        ends = np.append(hops_s, math.inf)[off[np.searchsorted(off, raised)]]
        alarms += zip(hops_s[raised].tolist(), ends.tolist(), strict=True)
    first = []
    for number, release_s in enumerate(first_releases(times.onsets_s, times.released_s)):
        is_later = says_slip & (stroke == number) & (available_s >= release_s)
        first.append(next(iter(available_s[is_later].tolist()), math.nan))
    return EventRecord.of(
        times,
        recording=str(bins.recording),
        material=bins.recording.material,
        scene=bins.recording.scene,
        duration_s=seen[-1][1],
        alarms_s=tuple(alarm for alarm, _ in alarms),
        onset_estimates_s=(),
        first_positive_s=tuple(first),
        watched_s=tuple(seen),
        alarm_ends_s=tuple(end for _, end in alarms),
    )


def merged_results(
    folds: Mapping[str, Mapping[str, Any]],
    recording_events: Mapping[str, Mapping[str, Mapping[str, Sequence[RecordingEvents]]]],
    outcomes: Mapping[str, Mapping[str, Outcomes]] = MappingProxyType({}),
    *,
    by_fold: bool = False,
) -> dict[str, Any]:
    """Splits, baselines and events of several tests as of one, by role.

    Args:
        folds: of each its ``metrics`` as ``SlipLearner`` has them.
        recording_events: of each its ``events`` as ``SlipLearner`` has them.
        outcomes: of each its ``outcomes`` as ``SlipLearner`` has them, by role; none without
            baselines.
        by_fold: whether folds have the same bins, which then are not summed: results have each role
            of each fold, such as ``"protocol/unseen"``.
    """
    splits = defaultdict[str, list[Any]](list)
    baselines, events = (defaultdict[str, Any](lambda: defaultdict(list)) for _ in range(2))
    by_role = defaultdict[str, list[Outcomes]](list)
    for fold, found in folds.items():
        before = f"{fold}/" if by_fold else ""
        for role, scores in found["splits"].items():
            splits[before + role].append(scores)
        for name, baseline in found["baselines"].items():
            for role, scores in baseline["splits"].items():
                baselines[name][before + role].append(scores)
        for role, by_rule in recording_events[fold].items():
            for name, recordings in by_rule.items():
                events[before + role][name] += list(recordings)
        for role, own in outcomes.get(fold, {}).items():
            by_role[before + role].append(own)
    summed = {
        name: {"splits": {role: summed_metrics(own) for role, own in of_roles.items()}}
        for name, of_roles in baselines.items()
    }
    only = next(iter(folds.values()))["baselines"] if len(folds) == 1 else None
    return {
        "splits": {role: merged_metrics(scores) for role, scores in splits.items()},
        "baselines": summed if only is None else only,  # what they are is told of one fold alone
        "comparison": {
            role: found for role, of in by_role.items() if (found := compared(of, role))
        },
        "events": event_numbers(events),
    }
