r"""Thresholds between which a score is left unsure, so that sure answers keep a stated coverage.

Conformal risk control with the recording as the unit: neighbouring bins of a recording resemble one
another, recordings of one kind are exchangeable. What is controlled of a recording is, for each
class, the share of its bins of that class whose truth the answer excludes. Of ``n`` recordings with
mean share ``R`` a threshold is good enough if ``(n R + 1) / (n + 1)`` is at most one minus the
coverage; then so is the mean share of the next recording, for any ``n`` and any detector.

Reference:
    Angelopoulos, Bates, Fisch, Lei and Schuster, Conformal risk control, ICLR 2024
    (arXiv:2208.02814), theorem 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

SLIP, NON_SLIP, UNSURE = 1, 0, -1
"""What ``answers`` are made of."""

_ROUNDING = 1e-12  # of a risk, which is a mean of at most some 1e6 shares


class Thresholds(NamedTuple):
    """Where an answer is sure.

    Attributes:
        low: below it a bin is non-slip; at most 0, ``-inf`` for never.
        high: from it on a bin is slip; at least 0, ``inf`` for never.
        num_slip: recordings with slip that ``low`` was set on.
        num_non_slip: recordings with non-slip that ``high`` was set on.
    """

    low: float
    high: float
    num_slip: int
    num_non_slip: int


def thresholds(scores: Tensor, is_slip: Tensor, unit: Tensor, coverage: float) -> Thresholds:
    """Thresholds by which both truths keep their coverage in the next recording.

    Each class by itself, so the promise does not hang on how common slip is. Where both classes
    are told apart well enough by the score's own sign, both thresholds are 0 and no bin is unsure:
    the two would cross otherwise, and drawing them back to 0 only lowers either risk.

    Args:
        scores: of bins that the machine never met; at least 0 speaks for slip.
        is_slip: their truth, bool.
        unit: a whole number for the recording of each bin; what is exchangeable.
        coverage: least mean share of a recording's bins of either class whose truth is in the
            answer; an unsure answer holds both.

    Shape:
        - scores, is_slip, unit: ``[N]``

    Raises:
        ValueError: if shapes differ, a score is not finite, a class is absent, or the coverage
            does not lie between 0 and 1.
    """
    check_coverage(coverage)
    if scores.ndim != 1 or not scores.shape == is_slip.shape == unit.shape:
        shapes = f"{tuple(scores.shape)}, {tuple(is_slip.shape)} and {tuple(unit.shape)}"
        raise ValueError(f"expected scores, is_slip and unit [N] of one N, got {shapes}")
    if not bool(scores.isfinite().all()):
        raise ValueError("scores must be finite to set thresholds; leave out what is not valid")
    x, slip = scores.detach().double(), is_slip.bool()
    for name, own in (("slip", slip), ("non-slip", ~slip)):
        if not bool(own.any()):
            raise ValueError(f"thresholds need bins of both classes, got no {name} bin")
    low = _highest(x[slip], unit[slip], 1 - coverage)
    high = -_highest(-x[~slip], unit[~slip], 1 - coverage)
    return Thresholds(
        low=min(low, 0.0),
        high=max(math.nextafter(high, math.inf), 0.0),  # the bin that sets it may stay unsure
        num_slip=len(unit[slip].unique()),
        num_non_slip=len(unit[~slip].unique()),
    )


def answers(scores: Tensor, low: float, high: float) -> Tensor:
    """``SLIP`` from ``high`` on, ``NON_SLIP`` below ``low``, else ``UNSURE``, as a NaN is.

    Shape:
        - scores, output: ``[*]``; output int8
    """
    unsure = torch.full_like(scores, UNSURE, dtype=torch.int8)
    return unsure.masked_fill(scores < low, NON_SLIP).masked_fill(scores >= high, SLIP)


def check_coverage(coverage: float) -> None:
    """Refuse what is no coverage.

    Raises:
        ValueError: if it does not lie between 0 and 1.
    """
    if type(coverage) not in (int, float) or not 0 < coverage < 1:
        raise ValueError(
            f"coverage must lie between 0 and 1, such as 0.95, got {coverage!r}; null sets no "
            "thresholds"
        )


def check_number(found: Thresholds, coverage: float) -> None:
    """Refuse thresholds of so few recordings that no answer could be sure.

    Raises:
        ValueError: if either class has fewer than ``fewest_recordings``.
    """
    if (fewest := fewest_recordings(coverage)) > min(found.num_slip, found.num_non_slip):
        raise ValueError(
            f"coverage={coverage:g} takes {fewest} training recordings of either class, there are "
            f"{found.num_slip} with slip and {found.num_non_slip} with non-slip; lower it"
        )


def fewest_recordings(coverage: float) -> int:
    """How many recordings any sure answer takes; with fewer, every bin is unsure.

    Example:
        >>> fewest_recordings(0.95)
        19
    """
    return math.ceil(1 / (1 - coverage) - 1 - _ROUNDING / (1 - coverage))


def _highest(x: Tensor, unit: Tensor, most_risk: float) -> float:
    """The highest threshold below which few enough of ``x`` lie, by shares of units.

    The risk rises at every value, from it on excluded: it is the first by which it is too high.
    """
    _, member, counts = unit.unique(return_inverse=True, return_counts=True)
    num = len(counts)
    budget = ((num + 1) * most_risk - 1) / num
    if budget < -_ROUNDING:
        return -math.inf
    x, order = x.sort()
    risk = (1 / (num * counts.double()))[member[order]].cumsum(0)  # just above each value
    place = int((risk <= budget + _ROUNDING).sum())
    return float(x[min(place, len(x) - 1)])
