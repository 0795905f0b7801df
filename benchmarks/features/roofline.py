"""How near the engines come to what the machine can do: its ceilings, and a count of the work.

The model of a bin (ours, and small): bins are read once and features written once, all else stays
in the cache. A branch goes through its rank r: 2 n r operations in, 2 n r out, 4 L r for the L
complex lines of its spectrum; A branches above the coarsest, and their lines, are sums of two
others. Every value of every row that is described takes the operations of ``OPERATIONS``. Least
time is the larger of bytes over memory bandwidth, and products over the float64 matmul ceiling plus
all other operations over that of the dtype of the statistics. No statistic runs at the speed of a
product of large matrices: the fraction says what is left at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch

from benchmarks.clocks import on_threads, shuffled_turns
from benchmarks.engines import DTYPES, FLOAT64, pool_of
from benchmarks.features.sizes import Sizes
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.spectrum import frequency_axis_hz
from tactslip_torch.signals.wavelet import branch_matrix, branch_names

OPERATIONS = {
    "mean, deviation": 2,
    "second, third, fourth moment": 6,
    "mean deviation": 2,
    "energy": 2,
    "extremes": 2,
    "quantise and count": 4,
    "runs of the mode": 2,
}
"""Of a value of any row; sorting comes on top with log2(n) comparisons."""
OF_BRANCH = {"correlation": 2}
OF_SPECTRUM = {"modulus": 4, "centroid": 3, "spread": 4}
GEMM, MEMORY = "gemm", "memory"


def roofline(sizes: Sizes) -> dict[str, Any]:
    """Ceilings of the machine by threads, and the work of a bin by dtype."""
    return {
        "ceilings": {str(threads): ceilings(sizes, threads) for threads in _threads(sizes)},
        "work": {dtype: work(pool_of(dtype), dtype) for dtype in DTYPES},
        "operations": {"any row": OPERATIONS, "branch": OF_BRANCH, "spectrum": OF_SPECTRUM},
    }


def ceilings(sizes: Sizes, threads: int) -> dict[str, float]:
    """Operations a second of large matrix products, and bytes a second of a sum of two arrays."""
    num, of = sizes.pool.matrix, sizes.pool
    calls: dict[str, Callable[[], object]] = {}
    for name, way in DTYPES.items():
        a, b, c = (torch.rand(num, num, dtype=way.dtype) for _ in range(3))
        calls[f"{GEMM} {name}"] = partial(torch.mm, a, b, out=c)
    x, y, z = (torch.rand(of.streamed_mb * 2**17, dtype=torch.float64) for _ in range(3))
    calls[MEMORY] = partial(torch.add, x, y, out=z)
    with torch.inference_mode(), on_threads(threads):
        turns = shuffled_turns(calls, of.ceiling_rounds, sizes.seed, f"ceilings, {threads}")
    amount = {f"{GEMM} {name}": 2.0 * num**3 for name in DTYPES}
    amount[MEMORY] = 3.0 * x.nbytes
    return {name: amount[name] / min(of.seconds) for name, of in turns.items()}


def work(pool: FeaturePool, dtype: str) -> dict[str, float]:
    """Bytes and operations of a bin, by the model above."""
    num = pool.bin_samples
    lines = len(frequency_axis_hz(num, pool.sample_rate_hz, pool.spectrum))
    films, gauges = len(pool.hand.fast), len(pool.hand.slow)
    names = branch_names(pool.level)
    ranks = torch.linalg.matrix_rank(branch_matrix(num, pool.wavelet, pool.level)).tolist()
    products = 0.0
    for name, rank in zip(names, ranks, strict=True):
        is_sum = name[0] == "A" and name != f"A{pool.level}"
        products += (num + 2 * lines) if is_sum else (4 * num + 4 * lines) * rank
    branches = films * len(names)

    def described(count: int, values: int, extra: Mapping[str, int]) -> float:
        each = sum(OPERATIONS.values()) + sum(extra.values()) + math.log2(values)
        return count * values * each

    statistics = described(gauges, num, {}) + described(branches, num, OF_BRANCH)
    statistics += described(branches, lines, OF_SPECTRUM)
    size = torch.finfo(DTYPES[dtype].dtype).bits // 8
    return {
        "bytes": float(size * (len(pool.hand) * num + len(pool.names))),
        "products": films * products,
        "statistics": statistics,
    }


def least_seconds(
    work: Mapping[str, float], ceilings: Mapping[str, float], dtype: str
) -> dict[str, float]:
    """What a bin takes at least, by each ceiling.

    Args:
        work: of ``work``.
        ceilings: of ``ceilings``.
        dtype: of the statistics.
    """
    memory = work["bytes"] / ceilings[MEMORY]
    arithmetic = work["products"] / ceilings[f"{GEMM} {FLOAT64}"]
    arithmetic += work["statistics"] / ceilings[f"{GEMM} {dtype}"]
    return {"memory": memory, "arithmetic": arithmetic, "least": max(memory, arithmetic)}


def _threads(sizes: Sizes) -> list[int]:
    return sorted({1, sizes.pool.threads})
