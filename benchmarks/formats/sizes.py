"""How much ``benchmarks.formats`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        duration_s: of the recording that is written and read.
        piece_ms: of a recording that is read in pieces.
        rounds: of every call.
        seed: of the order of calls.
    """

    duration_s: float = 14.0
    piece_ms: float = 100.0
    rounds: int = 15
    seed: int = 0


QUICK = Sizes(duration_s=1.0, rounds=2)
