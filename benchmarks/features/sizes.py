"""How much ``benchmarks.features`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        bins: whose features are taken in one call.
        scored: bins judged at once.
        solved: training bins of a solve.
        threads: of PyTorch, one after the other.
        rounds: of every call.
        seed: of the order of calls.
    """

    bins: int = 64
    scored: tuple[int, ...] = (1, 64)
    solved: tuple[int, ...] = (500, 2_000)
    threads: tuple[int, ...] = (1, 2)
    rounds: int = 31
    seed: int = 0


QUICK = Sizes(bins=4, scored=(1,), solved=(60,), rounds=3)
