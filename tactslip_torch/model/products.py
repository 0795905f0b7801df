"""Sums over bins of products of two or four variables: what the primal solve needs of the bins.

For a machine of degree 1 these are sums of products of two of the ``K + 1`` variables
``(1, z_1, .., z_K)``. For degree 2 an entry of the Gram matrix of the monomials is a sum of
products of four of them, and there are only ``C(K + 4, 4)`` of those: 9.4 million for 120 features,
where the triangle of the matrix has 27.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_CHUNK_BINS = 512  # whose products of two variables are held at a time
_BLOCK = 8  # variables; more hold more sums twice, fewer make smaller products
_STRIP = 256  # rows of a normal matrix that are scaled and mirrored at a time


class _Block(NamedTuple):
    """The sums of four whose second smallest variable is one of a few."""

    first: int  # of the variables
    rows: slice  # of all pairs in the order of the larger variable, then the smaller
    columns: slice  # of all pairs in the order of the smaller variable, then the larger
    held: slice  # of the flat sums


class ProductSums:
    """Where each sum of products of two or four variables stands in a flat tensor.

    Variable 0 is the constant 1, variables 1 to ``K`` are the features. The first sum is that of
    the weights alone.

    Args:
        num_features: ``K``, 1 or more.
        degree: of the machine, 1 for products of two, 2 for products of four.

    Raises:
        ValueError: for another number or degree.

    Example:
        >>> ProductSums(120).num_held, ProductSums(120, 1).num_held
        (10519381, 14641)
    """

    def __init__(self, num_features: int, degree: int = 2) -> None:
        if num_features < 1 or degree not in (1, 2):
            raise ValueError(
                f"sums take 1 feature or more and degree 1 or 2, got {num_features} and {degree}"
            )
        self.num_features, self.degree = num_features, degree
        num = num_features + 1
        self.num_held = num * num if degree == 1 else 0
        self._blocks: list[_Block] = []
        for first in range(0, num if degree == 2 else 0, _BLOCK):
            stop = min(first + _BLOCK, num)
            rows = slice(_triangle(first), _triangle(stop))
            columns = slice(_triangle(num) - _triangle(num - first), _triangle(num))
            size = (rows.stop - rows.start) * (columns.stop - columns.start)
            held = slice(self.num_held, self.num_held + size)
            self._blocks.append(_Block(first, rows, columns, held))
            self.num_held = held.stop

    def add_(self, total: Tensor, z: Tensor, weights: Tensor) -> None:
        """Add the products of bins to their sums, in place; negative weights take them out.

        Shape:
            - total: ``[num_held]``; z: ``[N, K]``; weights: ``[N]``, all float64
        """
        num = self.num_features + 1
        larger, smaller = torch.tril_indices(num, num), torch.triu_indices(num, num)
        for part, own in zip(z.split(_CHUNK_BINS), weights.split(_CHUNK_BINS), strict=True):
            variables = torch.cat([torch.ones_like(part[:, :1]), part], dim=1).mT.contiguous()
            weighted = variables * own
            if self.degree == 1:
                total.view(num, num).addmm_(variables, weighted.mT)
                continue
            left = variables[larger[1]] * weighted[larger[0]]
            right = variables[smaller[0]] * variables[smaller[1]]
            for block in self._blocks:
                self._of(block, total).addmm_(left[block.rows], right[block.columns].mT)

    def normal_matrix(self, total: Tensor, scale: Tensor) -> Tensor:
        """``X' W X`` of the monomials, each times its scale.

        Shape:
            - total: ``[num_held]``; scale: ``[P]``; output: ``[P, P]``
        """
        num = self.num_features + 1
        if self.degree == 1:
            return total.view(num, num) * scale * scale[:, None]
        matrix = total.new_empty(len(scale), len(scale))
        for second in range(num):
            self._spread_(matrix, total, second)
        for start in range(0, len(matrix), _STRIP):  # only what is above the diagonal is there
            own, after = slice(start, start + _STRIP), slice(start, None)
            strip = matrix[own, after].mul_(scale[after]).mul_(scale[own, None])
            corner, others = strip[:, : len(strip)], strip[:, len(strip) :]
            corner.copy_(corner.triu() + corner.triu(1).mT)
            matrix[start + len(strip) :, own] = others.mT
        return matrix

    def moment_vector(self, total: Tensor, scale: Tensor) -> Tensor:
        """``X' w``, the weighted sum of the monomials, each times its scale: ``[P]``."""
        if self.degree == 1:
            return total[: self.num_features + 1] * scale
        return self._of(self._blocks[0], total)[0] * scale  # of the pair (0, 0) with any other

    def _of(self, block: _Block, total: Tensor) -> Tensor:
        return total[block.held].view(block.rows.stop - block.rows.start, -1)

    def _spread_(self, matrix: Tensor, total: Tensor, second: int) -> None:
        """Write every sum whose second smallest variable is this one above the diagonal.

        For a smallest variable ``i`` these are a symmetric matrix over ``t, u >= second``. Its
        triangle is the end of row ``(i, second)``; its row ``t`` a part of row ``(i, t)``.
        """
        num = self.num_features + 1
        block = self._blocks[second // _BLOCK]
        row = _triangle(second) - block.rows.start
        sums = self._of(block, total)[row : row + second + 1]  # a row for each i
        rest = num - second
        triangle = sums[:, sums.shape[1] - _triangle(rest) :]  # pairs from ``second`` on
        rows, columns = torch.triu_indices(rest, rest)
        places = torch.empty(rest, rest, dtype=torch.int64)
        places[rows, columns] = places[columns, rows] = torch.arange(len(rows))
        square = triangle.index_select(1, places.view(-1)).view(-1, rest, rest)
        start = len(matrix) - _triangle(rest)
        for i in range(second + 1):
            own = len(matrix) - _triangle(num - i) + second - i
            matrix[own, start:] = triangle[i]
            matrix[own + 1 : own + rest, start : start + rest] = square[i, 1:]


def _triangle(num: int) -> int:
    return num * (num + 1) // 2
