"""All of the paper's features beside its peers: ``python -m benchmarks.features``.

Seconds and errors of all features of simulated bins, by the package, by NumPy with PyWavelets, and
by MiniRocket and TSFEL, which make other features of the same bins and so have no error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Job
from benchmarks.peers import arrays, others
from benchmarks.subjects import labelled_bins
from benchmarks.tables import Table, times
from benchmarks.timing import interleaved, on_threads
from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.features.pool import Arithmetic
from tactslip_torch.native import BackendName

HAND = HandLayout.paper24()
LENGTHS = (100, 256, 512, 1000, 1024)


@dataclass(frozen=True)
class Features(Benchmark):
    """All features of simulated bins, by the package and by its peers.

    Args:
        bins: of a call of the package and of MiniRocket.
        slow_bins: of a call of the reference and of NumPy.
        num_kernels: of MiniRocket.
        threads: of everything that takes threads.
        rounds: of every call.
    """

    title = "Features: the whole pool"
    about = "all features of filtered simulated bins of 24 channels and 50 ms"
    charts: ClassVar = {"": (("Time and error", "us a bin"),)}
    quick = "bins=32 slow_bins=4 num_kernels=168 rounds=2"
    libraries = ("PyWavelets", "ptwt", "tsfel", "aeon")
    bins: int = 4096
    slow_bins: int = 256
    num_kernels: int = 10_000
    threads: int = 2
    rounds: int = 7

    def measure(self, job: Job) -> dict[str, Any]:
        """Every way once a round."""
        some, _ = labelled_bins(1)
        bins = some[torch.arange(self.bins) % len(some)].clone()
        few = bins[: self.slow_bins]
        rocket = others.mini_rocket(bins[:64].numpy(), self.threads, self.num_kernels)
        windows = bins.float().numpy()
        ways: dict[str, tuple[int, Callable[[], Any]]] = {
            "tactslip_torch, float64": (len(bins), partial(_pool(torch.float64), bins)),
            "tactslip_torch, float32": (len(bins), partial(_pool(torch.float32), bins.float())),
            "reference, float64": (len(few), partial(_pool(torch.float64, "torch"), few)),
            "NumPy and PyWavelets, batched": (len(few), partial(arrays.features, few.numpy(), 14)),
            "aeon MiniRocket, transform": (len(windows), partial(rocket.transform, windows)),
            "TSFEL, all features": (1, partial(others.tsfel_features(), few[0].numpy())),
        }
        with torch.inference_mode(), on_threads(self.threads):
            calls = {name: call for name, (_, call) in ways.items()}
            timings = interleaved(calls, self.rounds, block_s=0)
            truth = torch.as_tensor(calls["reference, float64"]())
            rows = []
            for name, (num, call) in ways.items():
                found = torch.as_tensor(np.atleast_2d(call()))
                is_same = found.shape[1] == truth.shape[1] and "Rocket" not in name
                us = times(timings[name]["seconds"], 1e6 / num)
                row = {"way": name, "features": found.shape[1], "us a bin": us, "bins a call": num}
                rows.append(row | {"error": _error(found, truth) if is_same else None})
        note = (
            f"{self.threads} threads where a library takes threads. *Error*: the largest "
            "difference to the reference, divided by the larger of the reference's magnitude and "
            "the standard deviation of its column; for entropy and mode, which are discontinuous, "
            "the 99th percentile."
        )
        lengths = Table(self._by_length(), "Noise in float64, on one thread.")
        return {"tables": {"Time and error": Table(rows, note), "Length of bins": lengths}}

    @torch.inference_mode()
    def _by_length(self) -> list[dict[str, Any]]:
        """What a sample costs in bins of each length, of one bin and of several."""
        calls: dict[str, Callable[[], Any]] = {}
        nums = {"one bin": 1, "in bulk": self.slow_bins}
        for length in LENGTHS:
            pool = FeaturePool(HAND, bin_samples=length).paper()
            bins = torch.randn(self.slow_bins, len(HAND), length, dtype=torch.float64)
            calls |= {f"{length} {name}": partial(pool, bins[:n]) for name, n in nums.items()}
        with on_threads(1):
            timings = interleaved(calls, self.rounds, block_s=0)
        rows: list[dict[str, Any]] = [{"samples": length} for length in LENGTHS]
        for row, (name, n) in product(rows, nums.items()):
            seconds = timings[f"{row['samples']} {name}"]["seconds"]
            row[f"{name}, us a sample"] = times(seconds, 1e6 / n / row["samples"])
        return rows


def _error(found: Tensor, reference: Tensor) -> float:
    """The largest relative error; of descriptors that step, the 99th percentile."""
    num = min(len(found), len(reference))
    size = torch.maximum(reference[:num].abs(), reference.std(0, correction=0))
    distance = (found[:num].double() - reference[:num]).abs()
    relative = torch.where(distance == 0, 0.0, distance / size).nan_to_num(0.0, posinf=0.0)
    steps = [name.descriptor in ("entropy", "mode") for name in _pool(torch.float64).names]
    is_step = torch.tensor(steps)
    return float(max(relative[:, ~is_step].max(), relative[:, is_step].quantile(0.99)))


def _pool(dtype: torch.dtype, backend: BackendName = "auto") -> FeaturePool:
    """The paper's features, which the peers have too."""
    arithmetic: Arithmetic = "native" if dtype == torch.float32 else "double"
    return FeaturePool(HAND, arithmetic=arithmetic, backend=backend).paper()


if __name__ == "__main__":
    raise SystemExit(Features().run())
