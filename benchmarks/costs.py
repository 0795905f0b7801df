"""Costs of the kinds of work of the native engine: ``python -m benchmarks.costs [m7] [x86]``.

Detectors of different columns are run: on a Cortex-M7 that QEMU emulates, in instructions, and on
this machine, in microseconds. The costs, none of them negative, are those that explain all runs
best by the parts that each needs (``features/cost.py``). Writes ``features/costs.json``. The board
needs what ``.ci/boards`` installs.
"""

from __future__ import annotations

import json
import random
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls

from benchmarks.harness import say
from benchmarks.native_c import on_board, sample_counts
from benchmarks.timing import interleaved, on_threads
from tactslip_torch import SlipDetector
from tactslip_torch.deploy.native import SOURCE, NativeFile
from tactslip_torch.features.cost import COSTS_PATH, MACHINES, WorkCosts
from tactslip_torch.features.descriptors import DESCRIPTORS, FeatureName
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import instruction_set
from tactslip_torch.runtime import write_json

LANES = {"m7": 2, "x86": {"v4": 8, "v3": 4}.get(instruction_set(), 2)}
UNITS = {"m7": "instructions, float32", "x86": f"us, float64, x86-64-{instruction_set()}"}
_SAMPLES = 800  # of the sample recording
_ROUNDS, _BLOCK_S = 60, 1e-3


class _Design(NamedTuple):
    """A detector to run: its columns, how often each is scaled, and factors of its machine."""

    columns: Sequence[FeatureName]
    times: int = 1
    factors: int = 0

    def detector(self, base: SlipDetector) -> SlipDetector:
        """With the filter, pool and alarm of another."""
        num = len(self.columns) * self.times
        families = {replace(name, statistic="") for name in self.columns if name.is_pooled}
        ones, names = torch.ones(num).double(), self.columns
        pooling = ChannelPooling(
            base.pool.hand, names, torch.ones(len(families)), torch.zeros(len(names))
        )
        place = torch.arange(len(names)).repeat(self.times)
        scaler = FeatureScaler(-ones, ones, ones, place)
        factors = torch.ones(self.factors, num * bool(self.factors)).double()
        signs = torch.ones(self.factors).double() if self.factors else None
        head = QuadraticForm(factors, ones, ones.sum() * 0, signs)
        selected = base.pool.places(pooling.inputs)
        args = base.pool, base.channel_filter, selected, scaler, head, base.info, 0 * ones, pooling
        return SlipDetector(*args)

    def work(self, detector: SlipDetector, lanes: int) -> dict[str, float]:
        """Units of each kind that its detector needs."""
        costs, found = WorkCosts(detector.pool, {}, lanes), defaultdict[str, float](float)
        num = len(self.columns) * self.times
        parts = costs.decision(self.columns, num, detector.head.cost.multiply_adds)
        for part, amount in parts.items():
            found[str(part[0])] += amount
        return found


def designs(base: SlipDetector) -> list[_Design]:
    """Those that tell the kinds of work from each other, and some drawn."""
    hand, draw = base.pool.hand, random.Random(0)

    def of(channel: int, pooled: bool = True) -> list[FeatureName]:
        own = [name for name in base.pool.names if name.channel == hand.names[channel]]
        kind = hand.channels[channel].kind
        return [replace(n, channel=kind, statistic="mean") if pooled else n for n in own]

    slow, fast = of(hand.slow[0]), of(hand.fast[0])
    means = [name for name in fast if name.descriptor == "mean"]
    found = [_Design([of(c, False)[0] for c in own[:num]])
             for own in (hand.slow, hand.fast) for num in (1, 2, 3, 5, 8, 10)]  # fmt: skip
    found += [_Design([name]) for name in (*means, slow[0])]
    ratios = [name for name in fast if name.descriptor == "band_energy_ratio"]
    found += [_Design(means[:num]) for num in range(2, len(means) + 1, 2)]
    found += [_Design(ratios[:1]), _Design(ratios), _Design([*means, *ratios])]
    for every in (slow, means):
        found += [_Design(every, times) for times in (4, 20, 80)]
        found += [_Design(every, 20, factors) for factors in (8, 32)]
    found.append(
        _Design([replace(n, statistic=s) for n in means for s in ("mean", "std", "min", "max")])
    )
    for descriptor in DESCRIPTORS:
        own = [name for name in (*fast, *slow) if name.descriptor in (descriptor, "mean")]
        found.append(_Design(own))
    found += [_Design(slow), _Design(fast), _Design([*slow, *fast])]
    every = [*slow, *fast]
    for _ in range(40):
        some = draw.sample(every, draw.choice([3, 6, 12, 25, 50, 100]))
        found.append(_Design(some, draw.choice([1, 2])))
    return found


def on_m7(detectors: Sequence[SlipDetector]) -> list[float]:
    """Instructions of a decision of each on an emulated Cortex-M7."""
    counts, scale = sample_counts()
    found = []
    with TemporaryDirectory(prefix="tactslip-bench-") as folder:
        for detector in detectors:
            made = NativeFile.of(detector, "float32", scale=scale)
            (Path(folder) / SOURCE).write_bytes(made.as_constants())
            ran = on_board("m7", Path(folder), counts[:_SAMPLES])
            found.append(float(ran["instructions"]))
            say(f"costs: {len(found)} of {len(detectors)}, {found[-1] / 1e6:.3f} M")
    return found


@torch.inference_mode()
def on_x86(detectors: Sequence[SlipDetector]) -> list[float]:
    """Microseconds of a raw bin to its score of each, the median."""
    first = detectors[0]
    size = first.pool.bin_samples + first.context_before + first.context_after
    samples = torch.randn(1, len(first.pool.hand), size, generator=torch.Generator().manual_seed(0))
    calls = {str(i): partial(each.score_raw, samples) for i, each in enumerate(detectors)}
    with on_threads(1):
        timed = interleaved(calls, _ROUNDS, block_s=_BLOCK_S)
    return [1e6 * timed[name]["p50_s"] for name in calls]


RUNS: dict[str, Callable[[Sequence[SlipDetector]], list[float]]] = {"m7": on_m7, "x86": on_x86}


def main(machines: Sequence[str]) -> None:
    """Measure some machines, and keep what is known of others."""
    base = SlipDetector.pretrained()
    made = designs(base)
    detectors = [each.detector(base) for each in made]
    kept = json.loads(COSTS_PATH.read_text()) if COSTS_PATH.exists() else {"machines": {}}
    for machine in machines or MACHINES:
        work = [a.work(b, LANES[machine]) for a, b in zip(made, detectors, strict=True)]
        kinds = sorted(set().union(*work))
        costs = np.array(RUNS[machine](detectors))
        units = np.array([[each.get(kind, 0) for kind in kinds] for each in work])
        found, _ = nnls(units / costs[:, None], np.ones(len(costs)))
        off = np.abs(units @ found / costs - 1)
        say(f"{machine}: {len(costs)} runs, off by {off.mean():.1%} in the mean, {off.max():.1%}")
        kept["machines"][machine] = {
            "unit": UNITS[machine],
            "lanes": LANES[machine],
            "mean_error": round(float(off.mean()), 4),
            "largest_error": round(float(off.max()), 4),
            "costs": {kind: float(f"{of:.4g}") for kind, of in zip(kinds, found, strict=True)},
        }
    write_json(COSTS_PATH, {"command": "python -m benchmarks.costs", "machines": kept["machines"]})


if __name__ == "__main__":
    main(sys.argv[1:])
