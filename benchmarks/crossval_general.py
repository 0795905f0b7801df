"""The general recipe on every choice: ``python -m benchmarks.crossval_general``.

It takes longest, so it has a run and a table of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from benchmarks.crossval import Crossval


@dataclass(frozen=True)
class CrossvalGeneral(Crossval):
    """The general recipe alone."""

    recipes: tuple[str, ...] = ("general",)
    seeds: tuple[int, ...] = (0, 4)
    charts: ClassVar = {
        "": [("By choice, seed 0", "mean"), ("By material, seed 0", "general mean")]
    }


if __name__ == "__main__":
    raise SystemExit(CrossvalGeneral().run())
