"""How much ``benchmarks.latency`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        recordings: simulated, to whose bins heads are fitted.
        bins: raw bins that calls take in turn.
        judged: of them, whose scores are held against the reference.
        looped: of these, by the loop.
        rounds: of every call.
        block_ms: a quick call is repeated for so long in every round.
        most_calls: in a round.
        num_kernels: of MiniRocket.
        has_onnx: whether the exported file is timed too.
        seed: of the order of calls.
    """

    recordings: int = 8
    bins: int = 64
    judged: int = 64
    looped: int = 4
    rounds: int = 40
    block_ms: float = 20.0
    most_calls: int = 60
    num_kernels: int = 10_000
    has_onnx: bool = True
    seed: int = 0


QUICK = Sizes(
    recordings=1,
    bins=4,
    judged=4,
    looped=1,
    rounds=3,
    block_ms=2.0,
    most_calls=5,
    num_kernels=168,
    has_onnx=False,
)
