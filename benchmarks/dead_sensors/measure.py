"""Accuracy and calibration of a detector without some of its sensors, by every way to go on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from benchmarks.clocks import say
from benchmarks.dead_sensors.sizes import Sizes
from benchmarks.dead_sensors.subject import ROLES, Bins, Subject, class_weights
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.calibration import Calibration, fit_platt, probability, reliability
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.model.missing_channels import MissingScores, dead_mask, widened_llr

OURS, MEAN, ZERO, VOLTS, REFIT = "closed form", "mean-fill", "zero-fill", "0 V", "refit"
_CALIBRATED_ON = 3000  # training bins at most that a refitted machine is calibrated on

Scored = tuple[Tensor, Tensor, Calibration]
"""Scores, their variances, and what makes probabilities of them."""


def masks(hand: HandLayout, sizes: Sizes) -> dict[str, dict[str, list[str]]]:
    """Names of dead channels by kind of loss and name."""
    generator = torch.Generator().manual_seed(sizes.seed)
    fingers = dict.fromkeys(str(channel.finger) for channel in hand.channels)
    kinds = dict.fromkeys(channel.kind for channel in hand.channels)
    drawn = [torch.randperm(len(hand), generator=generator) for _ in range(sizes.halves)]
    return {
        "channel": {name: [name] for name in hand.names},
        "finger": {f: [c.name for c in hand.channels if c.finger == f] for f in fingers},
        "kind": {str(k): [c.name for c in hand.channels if c.kind == k] for k in kinds},
        "half": {
            f"half {number}": [hand.names[i] for i in order[: len(hand) // 2].tolist()]
            for number, order in enumerate(drawn, 1)
        },
    }


@torch.no_grad()
def losses(subject: Subject, sizes: Sizes) -> list[dict[str, Any]]:
    """A row for each loss, role and way; of losses that take a feature and leave one."""
    detector = subject.detector
    rows = []
    for group, named in masks(detector.pool.hand, sizes).items():
        for name, channels in named.items():
            dead = dead_mask(channels, detector.pool.hand.names)
            is_lost = dead[detector.channel_index]
            if not is_lost.any() or is_lost.all():
                continue
            say(f"without {name}: {int(is_lost.sum())} features less")
            refitted = _refit(subject, is_lost) if sizes.refit else None
            for role in ROLES:
                if role not in subject.bins:
                    continue
                bins = subject.bins[role]
                ways = _ways(subject, bins, dead)
                if refitted is not None:
                    head, calibration = refitted
                    score = head(bins.z[:, ~is_lost])
                    ways[REFIT] = (score, torch.zeros_like(score), calibration)
                facts = {"group": group, "dead": name, "role": role, "lost": int(is_lost.sum())}
                rows += [facts | row for row in judged(bins, ways, sizes)]
    return rows


def _ways(subject: Subject, bins: Bins, dead: Tensor) -> dict[str, Scored]:
    detector = subject.detector
    head, typical, index = detector.head, detector.typical, detector.channel_index
    silent = detector.pool(detector.pool.widen(torch.zeros(len(dead), detector.pool.bin_samples)))
    features = detector.scaler(silent[list(detector.selected)].double())
    fills = {MEAN: typical, ZERO: torch.zeros_like(typical), VOLTS: features}
    ways = {OURS: MissingScores(head, typical, index, detector.gaussians)}
    ways |= {name: MissingScores(head, fill, index, None) for name, fill in fills.items()}
    whole, is_missing = head(bins.z), dead.expand(len(bins.z), -1)
    return {
        name: (*way(whole, bins.z, is_missing), subject.calibration) for name, way in ways.items()
    }


def _refit(subject: Subject, is_lost: Tensor) -> tuple[Any, Calibration]:
    """The machine of the features that are left, calibrated without each material in turn."""
    own = subject.bins["train"]
    z, weights = own.z[:, ~is_lost], class_weights(own.is_slip)
    head = fit_machine(TrainingBins(z, own.is_slip, weights), subject.penalty)
    some = torch.randperm(len(z), generator=torch.Generator().manual_seed(0))[:_CALIBRATED_ON]
    stand = weights[some] * (len(z) / len(some))
    held = HeldOut(TrainingBins(z[some], own.is_slip[some], stand), own.material[some])
    scores = held.at(subject.penalty).scores
    return head, fit_platt(scores, own.is_slip[some], weights[some])


def judged(bins: Bins, ways: Mapping[str, Scored], sizes: Sizes) -> list[dict[str, Any]]:
    """Accuracy and calibration of every way; beside them the gap to ours and its standard error.

    The error is of recordings drawn anew, the same for both ways.
    """
    names, place = torch.unique(bins.recording, return_inverse=True)
    generator = torch.Generator().manual_seed(sizes.seed)
    drawn = torch.randint(len(names), (sizes.draws, len(names)), generator=generator)
    counts = torch.stack([each.bincount(minlength=len(names)) for each in drawn]).double()
    right = {
        name: _recalls((way[0] >= 0) == bins.is_slip, bins, place, len(names))
        for name, way in ways.items()
    }
    rows = []
    for name, (score, variance, calibration) in ways.items():
        stated = probability(widened_llr(calibration, score, variance), 0.5)
        weights = class_weights(bins.is_slip)
        gaps = _balanced(right[OURS], counts) - _balanced(right[name], counts)
        rows.append(
            {
                "way": name,
                "balanced_accuracy": float(_balanced(right[name], torch.ones(1, len(names)))),
                "ece": reliability(stated, bins.is_slip, weights=weights).ece,
                "ours_gap_se": float(gaps.std()) if len(gaps) > 1 else 0.0,
            }
        )
    return rows


def _recalls(is_right: Tensor, bins: Bins, place: Tensor, num: int) -> Tensor:
    """Right and all bins of either class by recording, ``[2, 2, num]``."""
    sums = torch.zeros(2, 2, num, dtype=torch.float64)
    for index, mine in enumerate((~bins.is_slip, bins.is_slip)):
        for part, counted in enumerate((is_right & mine, mine)):
            sums[index, part].index_add_(0, place, counted.double())
    return sums


def _balanced(sums: Tensor, counts: Tensor) -> Tensor:
    """Balanced accuracies ``[draws]`` of recordings that count so often ``[draws, num]``."""
    right, every = ((sums[:, part] @ counts.double().mT) for part in (0, 1))
    return (right / every).mean(0)
