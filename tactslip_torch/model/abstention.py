r"""When a detector abstains: two thresholds on its score, set by conformal risk control.

Between the thresholds a bin gets no answer, so that given answers keep a stated coverage. The unit
is the recording: neighbouring bins of a recording resemble one another, recordings of one kind are
exchangeable. What is controlled of a recording is, for each class, the share of its bins of that
class whose truth the answer excludes. Of ``n`` recordings with mean share ``R`` a threshold is good
enough if ``(n R + 1) / (n + 1)`` is at most one minus the coverage; then so is the mean share of
the next recording, for any ``n`` and any detector.

Reference:
    Angelopoulos, Bates, Fisch, Lei and Schuster, Conformal risk control, ICLR 2024
    (arXiv:2208.02814), theorem 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.detector import SlipDetector

KEY = "abstain"
"""Under which ``SlipDetector.info`` keeps the thresholds."""

SLIP, NON_SLIP, ABSTAIN = 1, 0, -1
"""What ``answers`` are made of."""

_ROUNDING = 1e-12  # of a risk, which is a mean of at most some 1e6 shares


@dataclass(frozen=True)
class Abstention:
    """Where a detector answers, and the coverage of its answers.

    It holds for recordings like those it was trained on, hand, materials and all: in the mean
    over them, at least ``coverage`` of the bins of either class are not answered with the other.
    An answer is never another than the sign of the score.

    Args:
        coverage: that was asked for.
        low: below it a score is answered with non-slip.
        high: from it on a score is answered with slip.
        metadata: on what the thresholds were set, JSON-able.

    Raises:
        ValueError: if the coverage does not lie between 0 and 1, or 0 not between the thresholds,
            which must be finite.
    """

    coverage: float
    low: float
    high: float
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_coverage(self.coverage)
        if not -math.inf < self.low <= 0 <= self.high < math.inf:
            raise ValueError(
                f"expected finite low <= 0 <= high, got {self.low:g} and {self.high:g}; train again"
            )

    def answer(self, score: Tensor) -> Tensor:
        """1 for slip, 0 for non-slip, -1 for none, as of a score of NaN.

        Shape:
            - score, output: ``[*]``; output int8
        """
        return answers(score, self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"coverage": self.coverage, "low": self.low, "high": self.high, **self.metadata}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Abstention:
        """What ``to_dict`` wrote.

        Raises:
            ValueError: if it is nothing of this version.
        """
        try:
            rest = dict(plain)
            return cls(rest.pop("coverage"), rest.pop("low"), rest.pop("high"), rest)
        except (KeyError, TypeError) as error:
            raise ValueError(f"no thresholds of abstention of this version: {error}") from None

    @classmethod
    def of(cls, detector: SlipDetector) -> Abstention:
        """The thresholds in a detector's file.

        Raises:
            ValueError: if there are none.
        """
        if (found := abstention_of(detector)) is None:
            raise ValueError("this detector never abstains; train it with coverage=0.95")
        return found


def abstention_of(detector: SlipDetector) -> Abstention | None:
    """The thresholds in a detector's file, None if there are none."""
    plain = detector.info.get(KEY)
    return None if plain is None else Abstention.from_dict(plain)


class Thresholds(NamedTuple):
    """Where a bin is answered.

    Attributes:
        low: below it with non-slip; at most 0, ``-inf`` for never.
        high: from it on with slip; at least 0, ``inf`` for never.
        num_slip: recordings with slip that ``low`` was set on.
        num_non_slip: recordings with non-slip that ``high`` was set on.
    """

    low: float
    high: float
    num_slip: int
    num_non_slip: int


def thresholds(scores: Tensor, is_slip: Tensor, unit: Tensor, coverage: float) -> Thresholds:
    """Thresholds by which both classes keep their coverage in the next recording.

    Each class by itself, so it does not matter how common slip is. Where both classes are told
    apart well enough by the score's own sign, both thresholds are 0 and every bin is answered:
    the two would cross otherwise, and drawing them back to 0 only lowers either risk.

    Args:
        scores: of bins that the machine was not fitted to; at least 0 speaks for slip.
        is_slip: their truth, bool.
        unit: a whole number for the recording of each bin; what is exchangeable.
        coverage: least mean share of a recording's bins of either class whose truth is in the
            answer; none holds both.

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
        high=max(math.nextafter(high, math.inf), 0.0),  # the bin that sets it gets no answer
        num_slip=len(unit[slip].unique()),
        num_non_slip=len(unit[~slip].unique()),
    )


def conformal_abstention(
    scores: Tensor,
    is_slip: Tensor,
    unit: Tensor,
    coverage: float,
    metadata: Mapping[str, Any] | None = None,
) -> Abstention:
    """``thresholds`` as a detector keeps them, with metadata and the numbers they were set on.

    Raises:
        ValueError: as ``thresholds``, or if either class has fewer than ``fewest_recordings``.
    """
    found = thresholds(scores, is_slip, unit, coverage)
    if (fewest := fewest_recordings(coverage)) > min(found.num_slip, found.num_non_slip):
        raise ValueError(
            f"coverage={coverage:g} takes {fewest} training recordings of either class, there are "
            f"{found.num_slip} with slip and {found.num_non_slip} with non-slip; lower it"
        )
    numbers = {"slip": found.num_slip, "non_slip": found.num_non_slip}
    more = {"num_recordings": numbers, "num_bins": len(scores)}
    return Abstention(coverage, found.low, found.high, {**(metadata or {}), **more})


def answers(scores: Tensor, low: float, high: float) -> Tensor:
    """``SLIP`` from ``high`` on, ``NON_SLIP`` below ``low``, else ``ABSTAIN``, as of a NaN.

    Shape:
        - scores, output: ``[*]``; output int8
    """
    none = torch.full_like(scores, ABSTAIN, dtype=torch.int8)
    return none.masked_fill(scores < low, NON_SLIP).masked_fill(scores >= high, SLIP)


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


def fewest_recordings(coverage: float) -> int:
    """How many recordings any answer takes; with fewer, every bin is left without.

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
