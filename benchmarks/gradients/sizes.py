"""How much ``benchmarks.gradients`` measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["dual", "primal", "left out"]


@dataclass(frozen=True)
class Problem:
    """A fit to go back through.

    Args:
        kind: the machine of all bins by one of the two routes, or the scores of groups left out.
        num_bins: to fit.
        num_features: of them.
        has_peer: whether autograd goes through the same.
    """

    kind: Kind
    num_bins: int
    num_features: int
    has_peer: bool

    def __str__(self) -> str:
        return f"{self.kind}, {self.num_bins:,} x {self.num_features}"


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        problems: to fit; small ones are there for autograd's sake.
        groups: that are left out.
        scored: other bins, whose loss is differentiated where all bins are fitted.
        penalty: the paper's ``C``.
        offset: the paper's ``c``.
        rounds: of every way.
        threads: of every process.
        seed: of the order of ways.
    """

    problems: tuple[Problem, ...] = (
        Problem("dual", 8000, 120, has_peer=True),
        Problem("primal", 8000, 120, has_peer=False),
        Problem("dual", 4000, 120, has_peer=True),
        Problem("dual", 2000, 120, has_peer=True),
        Problem("left out", 4800, 60, has_peer=False),
        Problem("left out", 4800, 120, has_peer=False),
        Problem("left out", 2000, 60, has_peer=True),
    )
    groups: int = 6
    scored: int = 1000
    penalty: float = 1.0
    offset: float = 0.5
    rounds: int = 3
    threads: int = 2
    seed: int = 0


QUICK = Sizes(
    problems=(
        Problem("dual", 200, 12, has_peer=True),
        Problem("primal", 200, 12, has_peer=False),
        Problem("left out", 200, 12, has_peer=True),
    ),
    rounds=1,
)
