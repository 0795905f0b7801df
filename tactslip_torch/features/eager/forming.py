"""Branch rows and lines of spectra of a number of bins: the products of ``Linear``, in memory.

Rows come by kind (gauges, raw films, branches; spectra), then bins. Views of memory and the steps
that fill it are made once for a number of bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from tactslip_torch.features.eager.calls import Step, add, memory, multiply, product, run
from tactslip_torch.features.eager.linear import Block, Linear
from tactslip_torch.features.linear_maps import LinearMaps

Array = np.ndarray[Any, Any]


class Forming:
    """Memory for some bins, and what fills it.

    Args:
        linear: what is to be formed.
        maps: the constants behind it.
        num_bins: M.
        has_raw: whether the films themselves become rows, for correlations.

    Attributes:
        rows: ``[rows, M, n]``: gauges, raw films if any, branches; relative to the first sample.
        lines: ``[spectra, M, 2 L]``: cosine and sine lines, complete.
        first: ``[channels + 1, M]``: first samples by channel of the plan; the last row is 0.
        bins: ``[films, M, n]``: films relative to the first sample, which stands in its place.
        watch: ``[films, M, branches]``: of watched branches, a sum no larger than the span.
        energies: ``[films, M, branches]``: of spectra that are no rows, for band energy ratios.
        time: what fills branches, once ``begin`` is done.
        freq: what fills spectra.
    """

    def __init__(self, linear: Linear, maps: LinearMaps, num_bins: int, has_raw: bool) -> None:
        num, width = maps.num_samples, 2 * maps.num_lines
        gauges, films = len(linear.gauges), len(linear.films)
        before = gauges + (films if has_raw else 0)
        self.first: Array = np.zeros((gauges + films + 1, num_bins))
        self.rows = memory(before + _height(linear.time), num_bins, num)
        self.lines = memory(_height(linear.freq), num_bins, width)
        self.bins = memory(films, num_bins, num)
        self._gauge_rows, self._raw_rows = self.rows[:gauges], self.rows[gauges:before]
        self._gauges, self._films = index_of(linear.gauges), index_of(linear.films)
        into = linear.into.numpy()
        small = memory(films, num_bins, into.shape[1])
        self.watch = small[..., into.shape[1] - len(linear.watched) :]
        self._first_steps: list[Step] = []
        if into.size and films:
            self._first_steps.append(product(_flat(self.bins), into, _flat(small)))
        shape = (len(linear.energy_films), num_bins)
        self.energies: Array = np.empty((*shape, len(linear.energy_branches)))
        if linear.energy_branches:
            energy, starts = linear.energy.numpy(), list(linear.energy_starts)
            roots = memory(*shape, energy.shape[1])
            some = _of_films(self.bins, linear.energy_films, self._first_steps)
            self._first_steps += [
                product(_flat(some), energy, _flat(roots)),
                multiply(roots, roots, roots),
                partial(np.add.reduceat, roots, starts, -1, None, self.energies),
            ]
        self.time = _steps(linear.time, self.bins, small, self.rows[before:])
        self.freq = _steps(linear.freq, self.bins, small, self.lines)

    def begin(self, x: Array) -> None:
        """Take in bins, form gauges, films and what all blocks start from.

        Shape:
            - x: ``[M, C', n]``
        """
        by_channel = x.transpose(1, 0, 2)
        first = self.first[:-1]
        first[...] = by_channel[:, :, 0]
        if len(self._gauge_rows):
            take = self._gauges
            np.subtract(by_channel[take], first[take, :, None], out=self._gauge_rows)
        if len(self.bins):
            take = self._films
            np.subtract(by_channel[take], first[take, :, None], out=self.bins)
            if len(self._raw_rows):
                np.copyto(self._raw_rows, self.bins)
            self.bins[..., 0] = first[take]
        run(self._first_steps)


def index_of(places: Sequence[int]) -> slice | list[int]:
    """A slice if they lie side by side and in order, which then is no copy."""
    if not places:
        return slice(0, 0)
    if list(places) == list(range(places[0], places[0] + len(places))):
        return slice(places[0], places[-1] + 1)
    return list(places)


def _steps(blocks: Sequence[Block], films: Array, small: Array, target: Array) -> list[Step]:
    """What fills ``target`` block by block, from films or from their small numbers."""
    steps: list[Step] = []
    for block in blocks:
        out = target[block.first : block.stop]
        if block.parts is not None:
            low, high = (target[blocks[part].first : blocks[part].stop] for part in block.parts)
            steps.append(add(low, high, out))
        elif block.matrix is not None:
            source = films if block.columns is None else small[..., block.columns]
            some = _of_films(source, block.films, steps)
            steps.append(product(_flat(some), block.matrix.numpy(), _flat(out)))
    return steps


def _of_films(source: Array, films: tuple[int, ...], steps: list[Step]) -> Array:
    """The part of ``[films, M, k]``, where it lies or copied together by a further step."""
    take = index_of(films)
    if isinstance(take, slice):
        return source[take]
    found = memory(len(films), *source.shape[1:])
    steps.append(partial(np.take, source, take, 0, found, "clip"))
    return found


def _flat(values: Array) -> Array:
    """``[films, M, k]`` as ``[films * M, k]``, a view."""
    num, bins, width = values.shape
    step = values.strides[1]
    shape, strides = (num * bins, width), (step, values.strides[2])
    return np.lib.stride_tricks.as_strided(values, shape, strides)


def _height(blocks: Sequence[Block]) -> int:
    return sum(len(block.films) for block in blocks)
