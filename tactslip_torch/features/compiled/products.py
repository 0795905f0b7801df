"""The linear maps of a plan: from bins to few coordinates, from those to branches and lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.compiled.jit import Array, kernel
from tactslip_torch.features.compiled.steps import LINES, TIME, Forming, width_of
from tactslip_torch.features.linear_maps import LinearMaps


class ProductSpace(NamedTuple):
    """Memory of one thread for products of a whole chunk.

    Args:
        shifted: ``[M, F, n]``, bins of films less their first sample.
        unit: ``[M, F]``, one over the magnitude of the film, 0 for 0.
        coordinates: ``[M, F, R]``, of all branches that are formed.
        picked: coordinates side by side, for branches in time and for lines.
        formed: branches in time, and lines, where each ``Forming`` says.
        calls: the products, by number of bins: left, right and where to.
    """

    shifted: Tensor
    unit: Array
    coordinates: Tensor
    picked: tuple[Tensor, Tensor]
    formed: tuple[Tensor, Tensor]
    calls: dict[int, list[tuple[Tensor, Tensor, Tensor]]]


class _Part(NamedTuple):
    """A product: its matrix, where its coordinates begin among all, and in ``picked`` or -1."""

    forming: Forming
    matrix: Tensor
    first: int
    picked: int


@kernel
def shift(x: Array, scale: Array, channels: Array, y: Array, unit: Array) -> None:
    """Bins of films less their first sample, and one over their magnitude.

    Shape:
        - x: ``[M, C, n]``; scale: ``[M, C]``; channels: ``[F]``; y: ``[M, F, n]``, written;
          unit: ``[M, F]``, written
    """
    for m in range(x.shape[0]):
        for f in range(channels.size):
            row, to = x[m, channels[f]], y[m, f]
            first, size = row[0], scale[m, channels[f]]
            unit[m, f] = 1 / size if size > 0 else 0.0
            for i in range(row.size):
                to[i] = row[i] - first


@kernel
def pick(coordinates: Array, unit: Array, parts: Array, films: Array, picked: Array) -> None:
    """Coordinates of some branches of some films, side by side, times the film's unit.

    Args:
        coordinates: of all branches of all films.
        unit: of each film.
        parts: first coordinate and number of them, first of ``films`` and number of them, and
            where in ``picked`` to begin.
        films: which films.
        picked: written.

    Shape:
        - coordinates: ``[M, F, R]``; unit: ``[M, F]``; parts: ``[P, 5]``
    """
    for p in range(parts.shape[0]):
        first, num, start, count, to = parts[p]
        for m in range(coordinates.shape[0]):
            for k in range(start, start + count):
                row = coordinates[m, films[k], first : first + num]
                factor = unit[m, films[k]]
                place = picked[to : to + num]
                for i in range(num):
                    place[i] = row[i] * factor
                to += num


class Products:
    """Products of a chunk by BLAS: branches in float64, lines in the dtype of the statistics.

    Lines are of bins in their film's unit, so of order one; in float64 nothing else changes.

    Args:
        maps: the matrices.
        made: which products.
        num_films: films in a plan.
        capacity: the most bins of a chunk.
        dtype: of lines.
    """

    def __init__(
        self,
        maps: LinearMaps,
        made: list[Forming],
        num_films: int,
        capacity: int,
        dtype: torch.dtype,
    ) -> None:
        self._dtypes = (torch.float64, dtype)
        self._capacity = capacity
        self._shape = (num_films, maps.num_samples)
        branches = sorted({forming.branch for forming in made})
        first, rank = {}, 0
        for branch in branches:
            first[branch] = rank
            rank += len(maps.into[branch])
        empty = torch.empty(0, maps.num_samples, dtype=torch.float64)
        self._into = torch.cat([empty, *(maps.into[b] for b in branches)]).T.contiguous()
        self._parts: list[_Part] = []
        self._num_picked, self._num_formed = [0, 0], [0, 0]
        tables: tuple[list[tuple[int, ...]], ...] = ([], [])
        films: tuple[list[int], ...] = ([], [])
        for forming in made:
            kind, size = forming.kind, len(maps.into[forming.branch])
            matrix = (maps.out, maps.lines)[kind][forming.branch].T.contiguous()
            start, picked = first[forming.branch], -1
            count = len(forming.films)
            if kind == LINES or count < num_films:
                picked = self._num_picked[kind]
                tables[kind].append((start, size, len(films[kind]), count, picked))
                films[kind].extend(forming.films)
                self._num_picked[kind] += capacity * count * size
            self._parts.append(_Part(forming, matrix.to(self._dtypes[kind]), start, picked))
            width = width_of(maps, kind)
            self._num_formed[kind] = forming.base + capacity * count * width
        self._tables = tuple(np.array(table, np.int64).reshape(-1, 5) for table in tables)
        self._films = tuple(np.array(of, np.int64) for of in films)

    def new_space(self) -> ProductSpace:
        """Memory for one thread."""
        films, samples = self._shape
        num, rank = self._capacity, self._into.shape[1]

        def memory(sizes: list[int]) -> tuple[Tensor, Tensor]:
            return (
                torch.empty(sizes[TIME], dtype=self._dtypes[TIME]),
                torch.empty(sizes[LINES], dtype=self._dtypes[LINES]),
            )

        return ProductSpace(
            shifted=torch.empty(num, films, samples, dtype=torch.float64),
            unit=np.empty((num, films)),
            coordinates=torch.empty(num, films, rank, dtype=torch.float64),
            picked=memory(self._num_picked),
            formed=memory(self._num_formed),
            calls={},
        )

    def __call__(self, bins: Array, scale: Array, channels: Array, space: ProductSpace) -> None:
        """Fill the memory from bins.

        Shape:
            - bins: ``[M, C', n]``; scale: ``[M, C']``; channels: ``[F]``, those that are films
        """
        num = len(bins)
        if not len(channels):
            return
        shift(bins, scale, channels, space.shifted.numpy(), space.unit)
        if num not in space.calls:
            space.calls[num] = self._calls(num, space)
        (left, right, to), *rest = space.calls[num]
        torch.mm(left, right, out=to)
        coordinates = space.coordinates[:num].numpy()
        units = (np.ones_like(space.unit), space.unit)
        for kind in (TIME, LINES):
            if len(self._films[kind]):
                to = space.picked[kind]
                table, films = self._tables[kind], self._films[kind]
                pick(coordinates, units[kind], table, films, to.numpy())
        for left, right, to in rest:
            torch.mm(left, right, out=to)

    def _calls(self, num: int, space: ProductSpace) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Views are made once, as making them takes as long as a small product."""
        coordinates = space.coordinates[:num].flatten(0, 1)
        calls = [(space.shifted[:num].flatten(0, 1), self._into, coordinates)]
        for forming, matrix, first, picked in self._parts:
            rank, width = matrix.shape
            rows = num * len(forming.films)
            left = coordinates[:, first : first + rank]
            if picked >= 0:
                left = space.picked[forming.kind][picked : picked + rows * rank].view(rows, rank)
            to = space.formed[forming.kind][forming.base : forming.base + rows * width]
            calls.append((left, matrix, to.view(rows, width)))
        return calls
