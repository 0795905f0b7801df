"""What the eager engine reads off sorted rows: median, interquartile range, mode and entropy.

Rows are heights over their least value as parts of their span, so from 0 to 1, sorted. Runs of
equal values are counted in one byte a value, on all rows as one flat array: the first value of a
row never continues a run, so no run crosses from row to row.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from tactslip_torch.features.descriptors import ENTROPY_LEVELS, HALF_SLACK, RUN_TOLERANCE
from tactslip_torch.features.eager.calls import Step, least, memory, run, total
from tactslip_torch.features.eager.scratch import Scratch
from tactslip_torch.features.runs import entropy_growth

Array = np.ndarray[Any, Any]
TOLERANCE = RUN_TOLERANCE[torch.float64] / (16 * torch.finfo(torch.float64).eps)
"""Of equal values, in parts of 16 eps of the size of the raw bin."""
MIXED_TOLERANCE = 2.0**-22
"""Part of a value by which equal ones may differ in float32: the rounding of heights."""
FEW_RUNS = 2**12
"""Values in which runs are found one by one, which takes fewer calls."""


def quantile_weights(num: int) -> tuple[Array, Array]:
    """Which sorted values make the median and the interquartile range, and with which weights.

    Shape:
        - output: ``[k]`` places, and ``[2, k]`` weights, float64: of the median, of the range
    """
    weights = np.zeros((2, num))
    for part in (0.25, 0.75):  # Hazen: q n + 1/2, counted from 1
        position = min(max(part * num - 0.5, 0.0), num - 1.0)
        below, share = int(position), position % 1
        sign = 1.0 if part > 0.5 else -1.0
        weights[1, below] += sign * (1 - share)
        weights[1, min(below + 1, num - 1)] += sign * share
    weights[0, (num - 1) // 2] += 0.5
    weights[0, num // 2] += 0.5
    places = np.flatnonzero(weights.any(0))
    return places, weights[:, places]


def rank_in_run(continues: Array, spare: Array, other: Array) -> Array:
    """Position of each value within its run, from 0, by doubling; stops with the longest run.

    Shape:
        - continues: ``[m]`` flat, unsigned integers: 1 where a value is of the run of the one
          before it, else 0. Becomes the result.
        - spare, other: ``[m]``, same dtype, overwritten
        - output: ``[m]``
    """
    rank = continues
    whole = np.negative(rank, out=spare)  # all bits set: the last ``width`` values all continue
    width = 1
    while width < len(rank) and whole.any():
        grown = np.bitwise_and(whole[width:], rank[:-width], out=other[width:])
        np.add(rank[width:], grown, out=rank[width:])
        np.bitwise_and(whole[width:], whole[:-width], out=other[width:])
        other[:width] = 0
        whole, other = other, whole
        width *= 2
    return rank


def first_of_longest(continues: Array, spare: Array, other: Array) -> Array:
    """Where the longest run of each row begins, the first of equally long ones.

    Shape:
        - continues, spare, other: ``[rows, n]``, as those of ``rank_in_run``; the first value of a
          row continues nothing
        - output: ``[rows]``
    """
    flat = (each.reshape(-1) for each in (continues, spare, other))
    rank = rank_in_run(*flat).reshape(continues.shape)
    last = rank.argmax(1)  # the first maximum: the end of the first longest run
    found: Array = last - rank[np.arange(len(rank)), last]
    return found


class Ordered:
    """Views of memory for sorted rows, and what is read off them.

    Args:
        scratch: the memory.
        num_rows: rows; each has as many bins as the scratch.
        num: values of each.
        num_quantised: how many of the rows, the first ones, want their entropy.

    Attributes:
        sorted: ``[num_rows * M, num]``.
    """

    def __init__(self, scratch: Scratch, num_rows: int, num: int, num_quantised: int) -> None:
        rows, quantised = num_rows * scratch.num_bins, num_quantised * scratch.num_bins
        self.sorted, self._gaps = scratch.ordered(rows, num), scratch.work(rows, num)
        self._ranks = scratch.counts(rows * num)
        self._rounding = MIXED_TOLERANCE if scratch.dtype == torch.float32 else 0.0
        places, weights = quantile_weights(num)
        self._places = places
        self._weights = np.ascontiguousarray(weights.T, dtype=self.sorted.dtype)
        flat, gaps = self.sorted.reshape(-1), self._gaps
        self._smallest = memory(rows, dtype=scratch.dtype)
        self._finding_gaps: list[Step] = [
            partial(np.subtract, flat[1:], flat[:-1], gaps.reshape(-1)[:-1]),
            partial(np.copyto, gaps[:, -1], np.inf),
            least(gaps, self._smallest),
        ]
        growth = entropy_growth(num)
        self._growth: Array = growth.to(scratch.dtype).numpy()
        self._parts: Array = np.concatenate([[0.0], growth.cumsum(0).numpy()])
        self._sums = memory(quantised, dtype=scratch.dtype)
        self._counted = scratch.work(quantised, num)
        half = np.array(0.5 + HALF_SLACK[scratch.dtype], self.sorted.dtype)
        levels = np.array(ENTROPY_LEVELS, self.sorted.dtype)
        level, self._is_same, is_top = scratch.flags(quantised * num)
        self._quantising: list[Step] = [
            partial(np.multiply, self.sorted[:quantised], levels, self._counted),
            partial(np.add, self._counted, half, self._counted),
            partial(np.copyto, level, self._counted.reshape(-1), "unsafe"),
            partial(np.equal, level[1:], level[:-1], self._is_same[1:]),
            # the maximum always has the top level, so the second highest level joins it
            partial(np.equal, level, np.uint8(ENTROPY_LEVELS), is_top),
            partial(np.logical_or, self._is_same, is_top, self._is_same),
            partial(np.copyto, self._is_same.reshape(quantised, num)[:, 0], False),
        ]
        self._adding_up = total(self._counted, self._sums)

    def quantiles(self) -> Array:
        """Median and interquartile range, ``[num_rows, 2]``."""
        found: Array = self.sorted.take(self._places, axis=1) @ self._weights
        return found

    def modes(self, finest: Array, span: Array, floor: Array) -> tuple[Array, Array]:
        """Modes that are not the smallest value: in which rows, and the first of the longest run.

        Only rows whose smallest gap is within the tolerance are looked at closer.

        Shape:
            - finest: ``[num_rows]``, 16 eps of the size of the raw bin
            - span: ``[num_rows]``, of the row
            - floor: ``[num_rows]``, what was subtracted after rounding, as part of the span
            - output: ``[k]`` rows, ``[k]`` values
        """
        run(self._finding_gaps)
        gaps, smallest = self._gaps, self._smallest
        wide = np.full_like(span, -1.0)  # the mode of a flat row is its smallest value
        np.divide(finest * TOLERANCE, span, out=wide, where=span > 0)
        wide += self._rounding * floor
        tolerance = wide.astype(gaps.dtype)
        rows = np.flatnonzero(smallest <= tolerance + gaps.dtype.type(self._rounding))
        if not len(rows):
            return rows, self.sorted[rows, 0]
        num = gaps.shape[1]
        continues, spare, other = (each[: len(rows) * num].reshape(-1, num) for each in self._ranks)
        continues[:, 0] = 0
        near = gaps[rows, :-1]
        if self._rounding:
            near -= self._rounding * self.sorted[rows, 1:]
        np.less_equal(near, tolerance[rows, None], out=continues[:, 1:], casting="unsafe")
        first = first_of_longest(continues, spare, other)
        rows, first = rows[first > 0], first[first > 0]
        return rows, self.sorted[rows, first]

    def entropy(self) -> Array:
        """Shannon entropy of the histogram of those rows that want it, in bits."""
        run(self._quantising)
        values, is_same = self._counted, self._is_same
        if values.size <= FEW_RUNS:
            return self._from_starts(np.flatnonzero(np.logical_not(is_same)), len(values))
        continues, spare, other = (each[: values.size] for each in self._ranks)
        np.copyto(continues, is_same)
        rank = rank_in_run(continues, spare, other)
        np.take(self._growth, rank, out=values.reshape(-1), mode="clip")
        self._adding_up()
        return self._sums

    def _from_starts(self, starts: Array, num_rows: int) -> Array:
        """Entropies from where runs start on the flat array; dear for many runs, quick for few."""
        counts = np.empty_like(starts)
        np.subtract(starts[1:], starts[:-1], out=counts[:-1])
        num = self.sorted.shape[1]
        counts[-1] = num_rows * num - starts[-1]
        found: Array = np.bincount(
            starts // num, weights=self._parts.take(counts), minlength=num_rows
        )
        return found
