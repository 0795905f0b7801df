"""How much ``benchmarks.throughput`` measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        recordings: simulated, to whose bins the head is fitted.
        bulk_bins: of a call that is to be as fast as can be.
        reference_bins: of a call of the reference.
        onnx_bins: of a call of the exported file.
        batches: bins at once, of the curve over batches.
        many: batches from here on are timed call by call, smaller ones in blocks.
        bins_ms: lengths of bins, of the curve over lengths.
        channels: numbers of channels, of the curve over channels.
        curve_samples: of all channels of a call of these two curves.
        threads: one after the other; memory and streams take the most.
        held: bins at once, of the curve of memory.
        pieced: bins that the pool takes in one piece, for comparison.
        streamed: bins that pass as chunks.
        streamed_pool: bins of which the whole pool passes.
        chunk: bins of a chunk.
        rounds: of every call.
        few_rounds: of long ones.
        has_onnx: whether the exported file is timed too.
        seed: of the order of calls.
    """

    recordings: int = 8
    bulk_bins: int = 4096
    reference_bins: int = 64
    onnx_bins: int = 1024
    batches: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096, 16_384, 65_536)
    many: int = 1024
    bins_ms: tuple[int, ...] = (10, 20, 50, 100, 200, 400)
    channels: tuple[int, ...] = (1, 4, 24, 64, 256)
    curve_samples: int = 240_000
    threads: tuple[int, ...] = (1, 2)
    held: tuple[int, ...] = (1024, 16_384, 65_536)
    pieced: int = 1024
    streamed: int = 1_000_000
    streamed_pool: int = 100_000
    chunk: int = 4096
    rounds: int = 5
    few_rounds: int = 3
    has_onnx: bool = True
    seed: int = 0


QUICK = Sizes(
    recordings=1,
    bulk_bins=64,
    reference_bins=8,
    onnx_bins=8,
    batches=(1, 16, 64),
    many=64,
    bins_ms=(10, 50),
    channels=(1, 24),
    curve_samples=20_000,
    held=(64,),
    pieced=16,
    streamed=1000,
    streamed_pool=200,
    chunk=100,
    rounds=2,
    few_rounds=1,
    has_onnx=False,
)
