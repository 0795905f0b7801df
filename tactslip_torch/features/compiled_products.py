"""The linear maps of a plan: from bins to few coordinates, from those to branches and lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.compiled_jit import Array, kernel
from tactslip_torch.features.compiled_steps import TIME, Forming, width_of
from tactslip_torch.features.linear_maps import LinearMaps


class ProductSpace(NamedTuple):
    """Memory of one thread for products of a whole chunk.

    Args:
        shifted: ``[M, F, n]``, bins of films less their first sample.
        coordinates: ``[M, F, R]``, of all branches that are formed.
        picked: coordinates of branches that only some films need.
        formed: branches and lines, where each ``Forming`` says.
    """

    shifted: Tensor
    coordinates: Tensor
    picked: Tensor
    formed: Tensor


@kernel
def shift(x: Array, channels: Array, y: Array) -> None:
    """Bins of some channels less their first sample.

    Shape:
        - x: ``[M, C, n]``; channels: ``[F]``; y: ``[M, F, n]``, written
    """
    for m in range(x.shape[0]):
        for f in range(channels.size):
            row, to = x[m, channels[f]], y[m, f]
            first = row[0]
            for i in range(row.size):
                to[i] = row[i] - first


@kernel
def pick(coordinates: Array, parts: Array, films: Array, picked: Array) -> None:
    """Coordinates of branches that only some films need, side by side.

    Args:
        coordinates: of all branches of all films.
        parts: first coordinate and number of them, first of ``films`` and number of them, and
            where in ``picked`` to begin.
        films: which films.
        picked: written.

    Shape:
        - coordinates: ``[M, F, R]``; parts: ``[P, 5]``
    """
    for p in range(parts.shape[0]):
        first, num, start, count, to = parts[p]
        for m in range(coordinates.shape[0]):
            for k in range(count):
                row = coordinates[m, films[start + k], first : first + num]
                for i in range(num):
                    picked[to + i] = row[i]
                to += num


class Products:
    """Products of a chunk, in float64, by BLAS.

    Args:
        maps: the matrices.
        made: which products.
        num_films: films in a plan.
        capacity: the most bins of a chunk.
    """

    def __init__(
        self, maps: LinearMaps, made: list[Forming], num_films: int, capacity: int
    ) -> None:
        self.num_samples = maps.num_samples
        self.num_films = num_films
        branches = sorted({forming.branch for forming in made})
        first, rank = {}, 0
        for branch in branches:
            first[branch] = rank
            rank += len(maps.into[branch])
        self._capacity = capacity
        empty = torch.empty(0, maps.num_samples, dtype=torch.float64)
        self._into = torch.cat([empty, *(maps.into[b] for b in branches)]).T.contiguous()
        self._parts: list[tuple[Forming, Tensor, int, int]] = []
        picks: dict[tuple[int, tuple[int, ...]], int] = {}
        table: list[tuple[int, ...]] = []
        films: list[int] = []
        self._num_picked = self._num_formed = 0
        for forming in made:
            key = (forming.branch, forming.films)
            size = len(maps.into[forming.branch])
            if len(forming.films) < num_films and key not in picks:
                picks[key] = self._num_picked
                table.append(
                    (first[forming.branch], size, len(films), len(forming.films), self._num_picked)
                )
                films += forming.films
                self._num_picked += capacity * len(forming.films) * size
            matrix = (maps.out if forming.kind == TIME else maps.lines)[forming.branch]
            self._parts.append(
                (forming, matrix.T.contiguous(), first[forming.branch], picks.get(key, -1))
            )
            width = width_of(maps, forming.kind)
            self._num_formed = forming.base + capacity * len(forming.films) * width
        self._picks = np.array(table, np.int64).reshape(-1, 5)
        self._films = np.array(films, np.int64)

    def new_space(self) -> ProductSpace:
        """Memory for one thread."""
        num, films = self._capacity, self.num_films
        return ProductSpace(
            shifted=torch.empty(num, films, self.num_samples, dtype=torch.float64),
            coordinates=torch.empty(num, films, self._into.shape[1], dtype=torch.float64),
            picked=torch.empty(self._num_picked, dtype=torch.float64),
            formed=torch.empty(self._num_formed, dtype=torch.float64),
        )

    def __call__(self, bins: Array, channels: Array, space: ProductSpace) -> None:
        """Fill the memory from bins.

        Shape:
            - bins: ``[M, C', n]``; channels: ``[F]``, those that are films
        """
        num = len(bins)
        if not self.num_films:
            return
        shift(bins, channels, space.shifted.numpy())
        coordinates = space.coordinates[:num].flatten(0, 1)
        torch.mm(space.shifted[:num].flatten(0, 1), self._into, out=coordinates)
        if len(self._picks):
            pick(space.coordinates[:num].numpy(), self._picks, self._films, space.picked.numpy())
        for forming, matrix, first, picked in self._parts:
            rank, width = matrix.shape
            rows = num * len(forming.films)
            if picked < 0:
                left = coordinates[:, first : first + rank]
            else:
                left = space.picked[picked : picked + rows * rank].view(rows, rank)
            to = space.formed[forming.base : forming.base + rows * width].view(rows, width)
            torch.mm(left, matrix, out=to)
