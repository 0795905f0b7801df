"""What depends on the order of values or on how many are equal: median, iqr, mode, entropy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from tactslip_torch.features.descriptors import ENTROPY_LEVELS, HALF_SLACK, RUN_TOLERANCE
from tactslip_torch.features.runs import EPS64
from tactslip_torch.graph.value import F64, I64, TINY, Value
from tactslip_torch.graph.writer import Graph


def medians(values: Value, num: int) -> Value:
    """Middle value, or the mean of the two: ``[B, R, n] -> [B, R]``."""
    largest = _largest(values, num - (num - 1) // 2)
    middle = _from_below(largest, num, (num - 1) // 2)
    return middle if num % 2 else (middle + _from_below(largest, num, num // 2)) * 0.5


def interquartile(values: Value, num: int) -> Value:
    """Interquartile range at Hazen positions: ``[B, R, n] -> [B, R]``."""
    low, high = (min(max(q * num - 0.5, 0.0), num - 1.0) for q in (0.25, 0.75))
    largest = _largest(values, num - int(low))

    def at(position: float) -> Value:
        below, share = int(position), position % 1
        near = _from_below(largest, num, below)
        if share == 0:
            return near
        return near * (1 - share) + _from_below(largest, num, min(below + 1, num - 1)) * share

    return at(high) - at(low)


def modes(graph: Graph, values: Value, scale: Value, num: int) -> Value:
    """Most frequent value, the smallest of ties: ``[B, R, n] -> [B, R]``, float64.

    Neighbours within a tolerance of ``scale [B, R]`` are one value. Only where some row of the
    batch has such a pair are runs counted; elsewhere the smallest value is it.
    """
    ordered = ascending(values, num)
    tolerance = scale * RUN_TOLERANCE[torch.float64]
    is_new = ordered.slice(1, num, 2) - ordered.slice(0, num - 1, 2) > tolerance.expand(2)
    has_runs = (~is_new).cast(I64).amax(2).amax(1).amax(0) > 0

    def counted(body: Graph) -> Sequence[Value]:
        rank = _rank_in_run(is_new.at(body), num)  # [B, R, n]
        last = body.op("ArgMax", rank, dtype=I64, axis=2, keepdims=1)
        length = body.op("GatherElements", rank, last, axis=2)
        return [body.op("GatherElements", ordered.at(body), last - length, axis=2)]

    def smallest(body: Graph) -> Sequence[Value]:
        return [ordered.at(body).slice(0, 1, 2)]

    return graph.if_(has_runs, counted, smallest)[0].squeeze(2)


def entropy(values: Value, num: int, dtype: np.dtype[Any]) -> Value:
    """Shannon entropy of the amplitude histogram in bits: ``[B, R, n] -> [B, R]``, float64.

    Values are counted by their level, 0 to 255; the two highest levels in use share a cell.

    Args:
        values: float64, so that no rounding moves one to another level.
        num: of values in a row.
        dtype: of counts and logarithms.
    """
    graph = values.graph
    least = values.amin(2, keep=True)
    span = values.amax(2, keep=True) - least
    levels = ENTROPY_LEVELS / span.max(TINY)
    level = ((values - least) * levels + (0.5 + HALF_SLACK[torch.float64])).floor()
    ones = (values * 0.0 + 1.0).cast(dtype)
    none = (span * 0.0).cast(dtype) + graph.constant(np.zeros(ENTROPY_LEVELS + 1), dtype)
    place = graph.where(level >= 0.0, level, 0.0).cast(I64)  # NaN, of a missing channel, is none
    count = graph.op("ScatterElements", none, place, ones, axis=2, reduction="add")
    below = count.slice(0, ENTROPY_LEVELS, 2)
    top = count.slice(ENTROPY_LEVELS, ENTROPY_LEVELS + 1, 2)
    numbers = graph.constant(np.arange(1, ENTROPY_LEVELS + 1), dtype)
    second = (numbers * below.min(1.0)).amax(2, keep=True)  # 1 + level, 0 for none
    moved = below * numbers.equals(second).cast(dtype)
    counts = graph.concat(below - moved, top + moved.sum(2, keep=True), axis=2)
    share = counts * (1.0 / num)
    bits = -(share * (share + EPS64).log()).sum(2).cast(F64) * (1.0 / math.log(2.0))
    return bits * (span.squeeze(2) > 0.0).cast(F64)


def _largest(values: Value, count: int) -> Value:
    """The largest ``count`` values, falling."""
    count_of = values.graph.axes(count)
    return values.graph.ops("TopK", values, count_of, dtypes=(None, I64), axis=2)[0]


def ascending(values: Value, num: int) -> Value:
    """All values along the last of three axes, smallest first."""
    count_of = values.graph.axes(num)
    return values.graph.ops("TopK", values, count_of, dtypes=(None, I64), axis=2, largest=0)[0]


def _from_below(largest: Value, num: int, place: int) -> Value:
    """The value at a place of rising order, ``[B, R]``."""
    index = num - 1 - place
    return largest.slice(index, index + 1, 2).squeeze(2)


def _rank_in_run(is_new: Value, num: int) -> Value:
    """Position of each sorted value within its run, ``[B, R, n]``: ``features.runs``."""
    graph = is_new.graph
    places = graph.constant(np.arange(1, num), I64)
    starts = graph.where(is_new, places, graph.constant(0, I64))
    margin = graph.constant([0, 0, num + 1, 0, 0, 0], I64)
    start = graph.op("Pad", starts, margin, graph.constant(0, I64))  # the window before the first
    left, width, length = num, 1, 2 * num
    while left:
        step = min(width, left)
        start = start.slice(step, length, 2).max(start.slice(0, length - step, 2))
        left, width, length = left - step, 2 * width, length - step
    return graph.constant(np.arange(num), I64) - start
