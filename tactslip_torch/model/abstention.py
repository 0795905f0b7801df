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
from typing import Any, Protocol

import torch
from torch import Tensor

KEY = "abstain"
"""Under which ``SlipDetector.info`` keeps the thresholds."""

SLIP, NON_SLIP, ABSTAIN = 1, 0, -1
"""What ``Abstention.answer`` is made of."""

_ROUNDING = 1e-12  # of a risk, which is a mean of at most some 1e6 shares


class _HasInfo(Protocol):
    """A ``SlipDetector``."""

    info: dict[str, Any]


@dataclass(frozen=True)
class Abstention:
    """Where a detector answers, and the coverage of its answers.

    It holds for recordings like those it was trained on, hand, materials and all: in the mean
    over them, at least ``coverage`` of the bins of either class are not answered with the other.
    An answer is never another than the sign of the score.

    Args:
        coverage: that was asked for.
        low: below it a score is answered with non-slip; at most 0.
        high: from it on a score is answered with slip; at least 0.
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

    @classmethod
    def fit(
        cls,
        scores: Tensor,
        is_slip: Tensor,
        unit: Tensor,
        coverage: float,
        metadata: Mapping[str, Any] | None = None,
    ) -> Abstention:
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
            metadata: kept, with the numbers of bins and recordings.

        Shape:
            - scores, is_slip, unit: ``[N]``

        Raises:
            ValueError: if shapes differ, a score is not finite, the coverage does not lie between
                0 and 1, or a class has too few recordings for any answer.
        """
        check_coverage(coverage)
        if scores.ndim != 1 or not scores.shape == is_slip.shape == unit.shape:
            shapes = f"{tuple(scores.shape)}, {tuple(is_slip.shape)} and {tuple(unit.shape)}"
            raise ValueError(f"expected scores, is_slip and unit [N] of one N, got {shapes}")
        if not bool(scores.isfinite().all()):
            raise ValueError("scores must be finite to set thresholds; leave out what is not valid")
        x, slip = scores.detach().double(), is_slip.bool()
        num_slip, num_rest = (len(unit[own].unique()) for own in (slip, ~slip))
        fewest = math.ceil(1 / (1 - coverage) - 1 - _ROUNDING / (1 - coverage))
        if fewest > min(num_slip, num_rest):
            raise ValueError(
                f"coverage={coverage:g} takes {fewest} training recordings of either class, there "
                f"are {num_slip} with slip and {num_rest} with non-slip; lower it"
            )
        low = _highest(x[slip], unit[slip], 1 - coverage)
        high = -_highest(-x[~slip], unit[~slip], 1 - coverage)
        numbers = {"slip": num_slip, "non_slip": num_rest}
        more = {"num_recordings": numbers, "num_bins": len(x)}
        # the bin that sets the upper threshold gets no answer
        high = max(math.nextafter(high, math.inf), 0.0)
        return cls(coverage, min(low, 0.0), high, {**(metadata or {}), **more})

    def answer(self, score: Tensor) -> Tensor:
        """1 for slip, 0 for non-slip, -1 for none, as of a score of NaN.

        Shape:
            - score, output: ``[*]``; output int8
        """
        none = torch.full_like(score, ABSTAIN, dtype=torch.int8)
        return none.masked_fill(score < self.low, NON_SLIP).masked_fill(score >= self.high, SLIP)

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
    def of(cls, detector: _HasInfo) -> Abstention | None:
        """The thresholds in a detector's file, None if there are none: it never abstains."""
        plain = detector.info.get(KEY)
        return None if plain is None else cls.from_dict(plain)


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


def _highest(x: Tensor, unit: Tensor, most_risk: float) -> float:
    """The highest threshold below which few enough of ``x`` lie, by shares of units.

    The risk rises at every value, from it on excluded: it is the first by which it is too high.
    """
    _, member, counts = unit.unique(return_inverse=True, return_counts=True)
    num = len(counts)
    x, order = x.sort()
    risk = (1 / (num * counts.double()))[member[order]].cumsum(0)  # just above each value
    place = int((risk <= ((num + 1) * most_risk - 1) / num + _ROUNDING).sum())
    return float(x[min(place, len(x) - 1)])
