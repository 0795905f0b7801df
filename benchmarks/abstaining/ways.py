"""Ways to leave a bin unsure, and what their answers are worth on bins of each role."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from benchmarks.abstaining.splits import ROLES, Scored, SplitScores
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.conformal import answers, thresholds
from tactslip_torch.report.metrics import answer_counts, answer_metrics

Ends = tuple[float, float]
"""Below the first non-slip, from the second on slip."""


def by_recording(split: SplitScores, coverage: float) -> Ends:
    """Ours: recordings are the units, each scored by the machine without it."""
    return _conformal(split.held_out["recording"], coverage, of_bins=False)


def by_material(split: SplitScores, coverage: float) -> Ends:
    """The stricter setting: recordings are units, scored by the machine without the material."""
    return _conformal(split.held_out["material"], coverage, of_bins=False)


def by_bin(split: SplitScores, coverage: float) -> Ends:
    """Split conformal as if bins were exchangeable: each bin a unit, its neighbours trained on."""
    return _conformal(split.held_out["bin"], coverage, of_bins=True)


def by_probability(split: SplitScores, coverage: float) -> Ends:
    """Unsure where the calibrated probability of the likelier class is below the coverage.

    Platt's, on scores of machines without the material, at equal shares: what a detector's file
    has for probabilities.
    """
    own = split.held_out["material"]
    platt = fit_platt(own.score, own.is_slip, split.weights)
    if platt.slope == 0:
        return -math.inf, math.inf
    reach = math.log(coverage / (1 - coverage))
    return (-reach - platt.offset) / platt.slope, (reach - platt.offset) / platt.slope


def by_sign(split: SplitScores, coverage: float) -> Ends:
    """Never unsure."""
    return 0.0, 0.0


WAYS: Mapping[str, Callable[[SplitScores, float], Ends]] = {
    "recordings as units, ours": by_recording,
    "the same, material left out": by_material,
    "bins as units": by_bin,
    "probability threshold": by_probability,
    "never unsure": by_sign,
}


def measure_split(split: SplitScores, coverages: tuple[float, ...]) -> list[dict[str, Any]]:
    """A row for each way, coverage and role, JSON-able."""
    rows = []
    for way, ends in WAYS.items():
        for coverage in coverages:
            low, high = ends(split, coverage)
            for role in ROLES:
                found = _judged(split.judged[role], low, high, coverage)
                about = {"way": way, "asked": coverage, "role": role, "unseen": list(split.unseen)}
                rows.append(about | found)
    return rows


def _conformal(own: Scored, coverage: float, *, of_bins: bool) -> Ends:
    unit = torch.arange(len(own.score)) if of_bins else own.recording
    found = thresholds(own.score, own.is_slip, unit, coverage)
    return found.low, found.high


def _judged(bins: Scored, low: float, high: float, coverage: float) -> dict[str, Any]:
    given = answers(bins.score, low, high)
    counts = {
        str(name): answer_counts(bins.is_slip[mine], given[mine])
        for name in bins.recording.unique().tolist()
        for mine in [bins.recording == name]
    }
    found = answer_metrics(counts, coverage)
    del found["recordings"], found["coverage"]
    return found
