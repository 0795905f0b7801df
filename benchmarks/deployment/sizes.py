"""How much ``benchmarks.deployment`` measures."""

from __future__ import annotations

from dataclasses import dataclass

PUSHES = (200, 1)
"""Samples of a push: ten decisions at the usual hop, and one sample behind which none is due."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        recordings: simulated, to whose bins the machine is fitted; they are its kernel sum.
        held_out: bins of other recordings and materials, that are judged.
        judged_s: a way other than our export judges as many of them as it can in about so long.
        timed: bins that calls take in turn.
        threads: one after the other.
        rounds: of every way on a single bin.
        block_ms: a quick call is repeated for so long in every round.
        most_calls: in a round.
        chunks: bins at once.
        bulk_rounds: of every way on every chunk.
        longest_s: chunks that would take a way longer are left out.
        stream_rounds: of every way to watch a stream.
        stretch: pushes in a round.
        streamed_s: of stream, whose scores are held against the reference.
        starts: of every fresh process.
        has_naive: whether the naive export is made, which takes PyTorch half a minute.
        has_compile: whether ``torch.compile`` is tried, which takes as long again.
        has_loop: whether the loop of SciPy and PyWavelets runs.
        has_starts: whether processes are started.
        seed: of the order of calls.
    """

    recordings: int = 33
    held_out: int = 10_000
    judged_s: float = 1.5
    timed: int = 64
    threads: tuple[int, ...] = (1, 2)
    rounds: int = 20
    block_ms: float = 10.0
    most_calls: int = 60
    chunks: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    bulk_rounds: int = 4
    longest_s: float = 0.1
    stream_rounds: int = 10
    stretch: int = 40
    streamed_s: float = 20.0
    starts: int = 3
    has_naive: bool = True
    has_compile: bool = True
    has_loop: bool = True
    has_starts: bool = True
    seed: int = 0


QUICK = Sizes(
    recordings=1,
    held_out=32,
    judged_s=0.05,
    timed=4,
    rounds=2,
    block_ms=1.0,
    most_calls=3,
    chunks=(1, 4),
    bulk_rounds=1,
    stream_rounds=1,
    stretch=25,
    streamed_s=2.0,
    starts=1,
    has_naive=False,
    has_compile=False,
    has_loop=False,
    has_starts=False,
)
