"""What columns cost: parts of the native engine's work, each paid once by all columns that need it.

A column needs its channels read and filtered, the wavelet transform down to its branch, the branch,
for some its spectrum, sums over it, and its descriptor; pooled, on every channel of the kind.
Channels are computed several at a time, as many as a vector has lanes, and pay together.
``costs.json`` holds what a unit of each kind of work costs; ``python -m benchmarks.costs``
measures it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import SORTED, FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.selection import ColumnCosts
from tactslip_torch.native import transform_work
from tactslip_torch.signals.wavelet import wavelet_steps

COSTS_PATH = Path(__file__).parent / "costs.json"
MACHINES = ("m7", "x86")
"""Cortex-M7: instructions, of a float32 file; x86-64 with AVX-512: microseconds, in float64."""
_ROWS = 8  # of a matrix, multiplied together

Parts = Mapping[tuple[object, ...], float]
"""How much work each part is. The first word of a part is the kind of work, the rest what for."""


class WorkCosts:
    """Costs of the columns of a pool.

    Args:
        pool: whose hand, bins, wavelet and spectrum decide how much work a part is.
        costs: of a unit of each kind of work; ``decision`` is what any decision costs.
        lanes: channels that are computed together.
    """

    def __init__(self, pool: FeaturePool, costs: Mapping[str, float], lanes: int) -> None:
        self.pool, self.costs, self.lanes = pool, costs, lanes

    @classmethod
    def measured(cls, pool: FeaturePool, machine: str) -> WorkCosts:
        """By what was measured on one of ``MACHINES``."""
        content = json.loads(COSTS_PATH.read_text(encoding="utf-8"))["machines"][machine]
        return cls(pool, content["costs"], content["lanes"])

    def parts(self, column: FeatureName) -> Parts:
        """What a column needs: a feature of the pool or, with a statistic, a pooled one."""
        if not column.is_pooled:
            return self._of_channel(column)
        family, hand = replace(column, statistic=""), self.pool.hand
        channels = [hand.names[index] for index in hand.indices(column.channel)]
        of_each = [self._of_channel(replace(family, channel=channel)) for channel in channels]
        return _union([{("pooled", family): len(channels)}, *of_each])

    def cost(self, parts: Iterable[Parts]) -> float:
        """Of all parts together, each paid once."""
        return sum(self.costs[str(part[0])] * amount for part, amount in _union(parts).items())

    def decision(
        self, columns: Sequence[FeatureName], num_scaled: int, multiply_adds: int
    ) -> Parts:
        """What a decision of a detector needs.

        Args:
            columns: that it computes.
            num_scaled: columns that it makes of these.
            multiply_adds: of its machine (``QuadraticForm.cost``).
        """
        rest: Parts = {("decision",): 1, ("scaled",): num_scaled, ("multiply-add",): multiply_adds}
        return _union([rest, *map(self.parts, columns)])

    def table(self, columns: Sequence[FeatureName]) -> ColumnCosts:
        """Costs of some scaled columns, of which several may be of one name; float64."""
        of_name = {name: self.parts(name) for name in dict.fromkeys(columns)}
        union = _union(of_name.values())
        place = {part: index for index, part in enumerate(union)}
        needs = torch.zeros(len(columns), len(place), dtype=torch.float64)
        for row, name in enumerate(columns):
            needs[row, [place[part] for part in of_name[name]]] = 1
        costs = [self.cost([{part: amount}]) for part, amount in union.items()]
        of_part = torch.tensor(costs, dtype=torch.float64)
        return ColumnCosts(needs, of_part, self.costs["scaled"])

    def _of_channel(self, name: FeatureName) -> Parts:
        """Of a feature of one channel, which it shares with the channels computed beside it."""
        hand, num, row = self.pool.hand, self.pool.bin_samples, (name.component, name.domain)
        kind, channels = "fast", hand.fast
        if (index := hand.names.index(name.channel)) in hand.slow:
            kind, channels = "slow", hand.slow
        found: dict[tuple[object, ...], float] = {(f"{kind} channel",): num}
        if name.component != "raw":
            found |= self._of_branch(name)
        if name.descriptor == "band_energy_ratio":
            found[name.descriptor,] = 1
        else:
            size = self.pool.maps.num_lines if name.domain == "freq" else num
            found[f"{name.domain} row", *row] = found[name.descriptor, *row] = size
            if name.descriptor in (*SORTED, "entropy"):
                found["sorted", *row] = size
        group = kind, channels.index(index) // self.lanes
        return {(part[0], *group, *part[1:]): amount for part, amount in found.items()}

    def _of_branch(self, name: FeatureName) -> dict[tuple[object, ...], float]:
        """Its branch and, in frequency, its spectrum; of a band energy ratio all of them."""
        levels, lines = range(1, self.pool.level + 1), self.pool.maps.num_lines
        branches, deepest = [name.component], int(name.component[1:])
        if name.descriptor == "band_energy_ratio":
            branches, deepest = [f"{kind}{m}" for m in levels for kind in "AD"], levels[-1]
        spectra = branches if name.domain == "freq" else []
        products = [*branches, *(f"level {m}" for m in range(1, deepest + 1))]
        for kind, level in ((each[0], int(each[1:])) for each in spectra):
            if kind == "D":
                products.append(f"D{level} lines")
            else:  # the sum of what lies below it, the last approximation and details
                below = (f"D{m} lines" for m in levels if m > level)
                products += [f"A{levels[-1]} lines", *below]
        return {
            ("bin of branches",): self.pool.bin_samples,
            **{("product", each): self._products[each] for each in products},
            **{("branch", each): self.pool.bin_samples for each in branches},
            **{("spectrum", each): lines for each in spectra},
        }

    @cached_property
    def _products(self) -> dict[str, float]:
        """Multiplications of each matrix: to a level, from there to a branch, and to its lines."""
        pool, found = self.pool, dict[str, float]()
        steps = wavelet_steps(pool.bin_samples, pool.wavelet, pool.level)
        transform = transform_work(pool.maps.dense_lines.numpy())
        for m, (low, high) in enumerate(zip(steps.low, steps.high, strict=True)):
            found[f"level {m + 1}"] = _multiplications(low) + _multiplications(high)
            for kind, out in zip("AD", steps.out[2 * m :], strict=False):
                found[f"{kind}{m + 1}"] = _multiplications(out)
                to_lines = pool.maps.dense_lines @ out
                found[f"{kind}{m + 1} lines"] = min(_multiplications(to_lines), transform)
        return found


def _multiplications(matrix: Tensor) -> int:
    """By a matrix in blocks of rows, each as wide as the widest."""
    rows = torch.arange(len(matrix)).split(_ROWS)
    used = [matrix[each].abs().amax(0) > 1e-15 * matrix.abs().max() for each in rows]
    places = [each.nonzero()[:, 0] for each in used]
    return _ROWS * len(rows) * max(int(each[-1] - each[0]) + 1 for each in places)


def _union(parts: Iterable[Parts]) -> Parts:
    return dict(chain.from_iterable(each.items() for each in parts))
