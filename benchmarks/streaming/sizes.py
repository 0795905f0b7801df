"""How much ``benchmarks.streaming`` measures."""

from __future__ import annotations

from dataclasses import dataclass

HOP, CHUNK = 20, 200
"""The settings that the limit is about: hop 10 ms, pushes of 100 ms."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        recordings: simulated, to whose bins the head is fitted.
        streamed: simulated, one after the other over and over: the stream.
        chunks: samples of a push, at ``HOP``.
        hops: samples between decisions, at ``CHUNK`` and of the naive stream.
        rounds: of every way.
        stretch_s: of the stream, that a way watches in a round.
        short_s: the same, sample by sample.
        watched_s: of the stream, while the memory is looked at.
        sample_s: of the stream, between two looks.
        settled_s: of the stream, until the memory has to stay where it is.
        seed: of the order of ways.
    """

    recordings: int = 8
    streamed: int = 12
    chunks: tuple[int, ...] = (1, 20, 200, 2000)
    hops: tuple[int, ...] = (10, 20, 50, 100)
    rounds: int = 20
    stretch_s: float = 4.0
    short_s: float = 0.5
    watched_s: float = 3600.0
    sample_s: float = 10.0
    settled_s: float = 300.0
    seed: int = 0


QUICK = Sizes(
    recordings=1,
    streamed=1,
    rounds=2,
    stretch_s=1.0,
    short_s=0.1,
    watched_s=6.0,
    sample_s=1.0,
    settled_s=2.0,
)
