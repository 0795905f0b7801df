"""Branch rows and lines of spectra of a number of bins: the products of ``Linear``, in memory.

Rows come by kind (gauges, raw films, branches; spectra), then bins. Views of memory and the steps
that fill it are made once for a number of bins, so that one bin costs few calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.eager_linear import Block, Linear
from tactslip_torch.features.linear_maps import LinearMaps

Array = np.ndarray[Any, Any]
Step = Callable[[], object]
FEW = 2**17
"""Multiplications up to which NumPy's product is quicker to start, and uses one thread."""


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
        time: what fills each block of branches, once ``begin`` is done.
        freq: what fills each block of spectra, after the blocks before it.
    """

    def __init__(self, linear: Linear, maps: LinearMaps, num_bins: int, has_raw: bool) -> None:
        num, width = maps.num_samples, 2 * maps.num_lines
        gauges, films = len(linear.gauges), len(linear.films)
        before = gauges + (films if has_raw else 0)
        self.first: Array = np.zeros((gauges + films + 1, num_bins))
        self.rows = _empty(before + _height(linear.time), num_bins, num)
        self.lines = _empty(_height(linear.freq), num_bins, width)
        films_there = _empty(films, num_bins, num)
        self.bins: Array = films_there.numpy()
        self._gauge_rows: Array = self.rows[:gauges].numpy()
        self._raw_rows: Array = self.rows[gauges:before].numpy()
        self._gauges, self._films = index_of(linear.gauges), index_of(linear.films)
        small = _empty(films, num_bins, linear.into.shape[1])
        self.watch: Array = small.numpy()[..., linear.into.shape[1] - len(linear.watched) :]
        self._first_steps: list[Step] = []
        if linear.into.shape[1]:
            self._first_steps.append(_product(films_there, linear.into, small))
        shape = (len(linear.energy_films), num_bins)
        self.energies: Array = np.empty((*shape, len(linear.energy_branches)))
        if linear.energy_branches:
            roots = _empty(*shape, linear.energy.shape[1])
            some = _of_films(films_there, linear.energy_films, self._first_steps)
            squares, starts = roots.numpy(), list(linear.energy_starts)
            self._first_steps += [
                _product(some, linear.energy, roots),
                partial(np.multiply, squares, squares, squares),
                partial(np.add.reduceat, squares, starts, -1, None, self.energies),
            ]
        self.time = _steps(linear.time, films_there, small, self.rows[before:])
        self.freq = _steps(linear.freq, films_there, small, self.lines)

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
        for step in self._first_steps:
            step()


def index_of(places: Sequence[int]) -> slice | list[int]:
    """A slice if they lie side by side and in order, which then is no copy."""
    if not places:
        return slice(0, 0)
    if list(places) == list(range(places[0], places[0] + len(places))):
        return slice(places[0], places[-1] + 1)
    return list(places)


def _steps(
    blocks: Sequence[Block], films: Tensor, small: Tensor, target: Tensor
) -> list[list[Step]]:
    """What fills each block's rows of ``target``, from films or from their small numbers."""
    found: list[list[Step]] = []
    for block in blocks:
        out = target[block.first : block.stop]
        steps: list[Step] = []
        if block.parts is not None:
            low, high = (target[blocks[part].first : blocks[part].stop] for part in block.parts)
            steps.append(partial(torch.add, low, high, out=out))
        elif block.matrix is not None:
            source = films if block.columns is None else small[..., block.columns]
            some = _of_films(source, block.films, steps)
            steps.append(_product(some, block.matrix, out))
        found.append(steps)
    return found


def _of_films(source: Tensor, films: tuple[int, ...], steps: list[Step]) -> Tensor:
    """The part of ``[films, M, k]``, where it lies or copied together by a further step."""
    take = index_of(films)
    if isinstance(take, slice):
        return source[take]
    found = _empty(len(films), *source.shape[1:])
    steps.append(partial(torch.index_select, source, 0, torch.tensor(take), out=found))
    return found


def _product(left: Tensor, right: Tensor, out: Tensor) -> Step:
    left, out = left.flatten(0, 1), out.flatten(0, 1)
    if left.shape[0] * left.shape[1] * right.shape[1] <= FEW:
        return partial(np.matmul, left.numpy(), right.numpy(), out.numpy())
    return partial(torch.mm, left, right, out=out)


def _empty(*shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.float64)


def _height(blocks: Sequence[Block]) -> int:
    return sum(len(block.films) for block in blocks)
