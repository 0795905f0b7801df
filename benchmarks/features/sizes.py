"""How much ``benchmarks.features`` measures."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class PoolSizes:
    """How much of the whole pool is measured.

    Args:
        bins: of a call of an engine.
        reference_bins: of a call of the reference, and of NumPy.
        oracle_bins: of a call of the slow NumPy oracle.
        windows: that MiniRocket transforms in a call.
        judged: bins whose features are held against the reference.
        threads: of everything that takes threads.
        rounds: of every call.
        ceiling_rounds: of every ceiling of the machine.
        matrix: rows and columns of the product that is the ceiling of arithmetic.
        streamed_mb: of each of the three arrays that are the ceiling of memory.
    """

    bins: int = 4096
    reference_bins: int = 256
    oracle_bins: int = 48
    windows: int = 1024
    judged: int = 512
    threads: int = 2
    rounds: int = 7
    ceiling_rounds: int = 11
    matrix: int = 1536
    streamed_mb: int = 128


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        pool: of the whole pool.
        bins: whose features are taken in one call, with guards and without.
        scored: bins judged at once.
        solved: training bins of a solve.
        threads: of PyTorch, one after the other.
        rounds: of every call.
        seed: of the order of calls.
    """

    pool: PoolSizes = field(default_factory=PoolSizes)
    bins: int = 64
    scored: tuple[int, ...] = (1, 64)
    solved: tuple[int, ...] = (500, 2_000)
    threads: tuple[int, ...] = (1, 2)
    rounds: int = 31
    seed: int = 0


QUICK = Sizes(
    pool=PoolSizes(
        bins=64,
        reference_bins=8,
        oracle_bins=4,
        windows=16,
        judged=32,
        rounds=2,
        ceiling_rounds=2,
        matrix=256,
        streamed_mb=16,
    ),
    bins=4,
    scored=(1,),
    solved=(60,),
    rounds=3,
)
