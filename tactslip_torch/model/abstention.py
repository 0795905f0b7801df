"""A detector's third answer: *unsure*, where its score is too near the boundary to be held to.

``conformal`` sets the two thresholds on held-out recordings when a detector is trained; this is how
they are kept in its file and used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from tactslip_torch.model.conformal import answers, check_coverage
from tactslip_torch.model.detector import SlipDetector

KEY = "abstain"
"""Under which ``SlipDetector.info`` keeps the thresholds."""


@dataclass(frozen=True)
class Abstention:
    """Where a detector's answer is sure, and what was promised of it.

    The promise is of recordings like those it was trained on, hand, materials and all: in the mean
    over them, at least ``coverage`` of the bins of either class are not answered with the other.
    A sure answer is never another than the sign of the score.

    Args:
        coverage: that was asked for.
        low: below it a score is answered with non-slip.
        high: from it on a score is answered with slip.
        facts: on what the thresholds were set, JSON-able.

    Raises:
        ValueError: if the coverage does not lie between 0 and 1, or 0 not between the thresholds,
            which must be finite.
    """

    coverage: float
    low: float
    high: float
    facts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_coverage(self.coverage)
        if not -math.inf < self.low <= 0 <= self.high < math.inf:
            raise ValueError(
                f"expected finite low <= 0 <= high, got {self.low:g} and {self.high:g}; train again"
            )

    def answer(self, score: Tensor) -> Tensor:
        """1 for slip, 0 for non-slip, -1 for unsure, as a score of NaN is.

        Shape:
            - score, output: ``[*]``; output int8
        """
        return answers(score, self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {"coverage": self.coverage, "low": self.low, "high": self.high, **self.facts}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Abstention:
        """What ``to_dict`` wrote.

        Raises:
            ValueError: if it is nothing of this version.
        """
        try:
            facts = dict(plain)
            return cls(facts.pop("coverage"), facts.pop("low"), facts.pop("high"), facts)
        except (KeyError, TypeError) as error:
            raise ValueError(f"no thresholds for unsure answers of this version: {error}") from None

    @classmethod
    def of(cls, detector: SlipDetector) -> Abstention:
        """The thresholds in a detector's file.

        Raises:
            ValueError: if there are none.
        """
        found = abstention_of(detector)
        if found is None:
            raise ValueError(
                "this detector has no thresholds for unsure answers; train it with coverage=0.95"
            )
        return found


def abstention_of(detector: SlipDetector) -> Abstention | None:
    """The thresholds in a detector's file, None if there are none."""
    plain = detector.info.get(KEY)
    return None if plain is None else Abstention.from_dict(plain)
