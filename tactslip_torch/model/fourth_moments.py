"""Sums of products of up to four features: all that the primal solve needs to know of its bins.

An entry of the Gram matrix of ``quadratic_features`` is a sum over bins of four of the ``K + 1``
variables ``(1, z_1, .., z_K)``. There are only ``C(K + 4, 4)`` of those: 9.4 million for 120
features, where the triangle has 27. Offset, penalty, class weights and fewer features come later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from tactslip_torch.model.quadratic import num_quadratic_features
from tactslip_torch.runtime import for_each

_CHUNK_BINS = 256  # summed in one product and rounded once; more no longer fit the cache
_BLOCK = 8  # variables; more hold more sums twice, fewer make smaller products
_TILE = (128, 1024)  # rows and columns that one thread computes at a time
_MIRROR = 256  # rows and columns that one thread scales and mirrors at a time
_ROOM_BITS = 51  # that a sum of a chunk has on the grid, as the rounding is done
_ROUNDER = 1.5 * 2.0**52  # added to a number below 2^51 it leaves no fraction, rounded to even ..
_ROUNDER_BITS = 0x4338 << 48  # .. and the number in the last bits, below those of its own


@dataclass(frozen=True)
class Block:
    """The sums whose second smallest variable is one of a few.

    Rows are pairs ``i <= j`` with ``j`` in the block, columns pairs ``k <= l`` with ``k`` from the
    block's first variable on.
    """

    variables: range
    rows: slice  # of all pairs in the order of the larger index, then the smaller
    columns: slice  # of all pairs in the order of the smaller index, then the larger
    held: slice  # of the flat sums

    def of(self, total: Tensor) -> Tensor:
        """The block's own part of the flat sums, ``[rows, columns]``."""
        return total[self.held].view(self.rows.stop - self.rows.start, -1)

    def tiles(self) -> Iterator[tuple[Block, slice, slice]]:
        """The block with rows and columns of each piece that is computed at a time."""
        for row in range(0, self.rows.stop - self.rows.start, _TILE[0]):
            for column in range(0, self.columns.stop - self.columns.start, _TILE[1]):
                yield self, slice(row, row + _TILE[0]), slice(column, column + _TILE[1])


class ProductSums:
    """Where each sum of products of four variables stands in a flat tensor.

    Variable 0 is the constant 1, variables 1 to ``K`` are the features. The first sum is that of
    the weights alone.

    Args:
        num_features: ``K``, 1 or more.

    Example:
        >>> layout = ProductSums(120)
        >>> layout.num_distinct, layout.num_held
        (9381251, 10519381)
    """

    def __init__(self, num_features: int) -> None:
        if num_features < 1:
            raise ValueError(f"num_features must be 1 or more, got {num_features}")
        self.num_features = num_features
        self.num_pairs = num_quadratic_features(num_features)
        self.num_distinct = math.comb(num_features + 4, 4)
        self.num_held = 0
        blocks = []
        for first in range(0, num_features + 1, _BLOCK):
            variables = range(first, min(first + _BLOCK, num_features + 1))
            rows = slice(_triangle(first), _triangle(variables.stop))
            columns = slice(self.first_pair(first), self.num_pairs)
            start = self.num_held
            self.num_held += (rows.stop - rows.start) * (columns.stop - columns.start)
            blocks.append(Block(variables, rows, columns, slice(start, self.num_held)))
        self.blocks = tuple(blocks)

    def first_pair(self, k: int) -> int:
        """Index of the pair ``(k, k)`` in the order of the smaller index."""
        return k * (self.num_features + 1) - _triangle(k - 1)


@torch.no_grad()
def add_products_(
    total: Tensor,
    z: Tensor,
    weights: Tensor | None = None,
    grid_bits: int | None = None,
    sign: int = 1,
) -> None:
    """Add the products of bins to their sums, in place; the same bits on any number of threads.

    On a grid, every 256 bins, counted from the first one given, are summed in float64, rounded
    to a multiple of ``2**-grid_bits`` and added as integers: sums of sums are then exact, in any
    order, and ``sign=-1`` with the same arguments takes out what was put in.

    Args:
        total: the sums, as ``ProductSums`` lays them out; int64 with ``grid_bits``, else float64.
        z: features of bins.
        weights: of the bins; default 1.
        grid_bits: of the fraction.
        sign: 1 to add, -1 to take out.

    Shape:
        - total: ``[num_held]``; z: ``[N, K]``; weights: ``[N]``

    Raises:
        ValueError: if shapes or dtypes disagree, or 256 bins may sum to ``2**(51 - grid_bits)``
            or more, or are not finite, where the grid has no room; the sums are kept then.
    """
    layout = ProductSums(z.shape[-1])
    _check_sums(total, layout, torch.float64 if grid_bits is None else torch.int64)
    weights = z.new_ones(len(z)) if weights is None else weights
    if z.ndim != 2 or weights.shape != z.shape[:1] or {z.dtype, weights.dtype} != {torch.float64}:
        raise ValueError(
            f"expected float64 z [N, K] and weights [N], got {tuple(z.shape)} {z.dtype} "
            f"and {tuple(weights.shape)} {weights.dtype}"
        )
    if grid_bits is not None:
        check_room(z, weights, grid_bits)
    for chunk in zip(z.split(_CHUNK_BINS), weights.split(_CHUNK_BINS), strict=True):
        _add_chunk_(total, *chunk, grid_bits, sign)


def check_room(z: Tensor, weights: Tensor, grid_bits: int) -> None:
    """Refuse what ``add_products_`` does, by the largest product that each bin may have."""
    room = 2.0 ** (_ROOM_BITS - grid_bits)
    most = weights.abs() * z.abs().amax(dim=1).clamp(min=1) ** 4
    for number, some in enumerate(most.split(_CHUNK_BINS)):
        if not some.sum() < room:
            raise ValueError(
                f"{len(some)} bins from {number * _CHUNK_BINS} on may sum to {some.sum():g}, and "
                f"this grid holds sums below {room:g}; scale them down or take fewer grid_bits"
            )


def from_grid(total: Tensor, grid_bits: int) -> Tensor:
    """Sums on a grid as float64, each rounded once."""
    return total.to(torch.float64).mul_(2.0**-grid_bits)


def normal_matrix(
    total: Tensor, num_features: int, offset: float = 0.5, use_features: int | None = None
) -> Tensor:
    """``X' W X`` of ``X = quadratic_features(z, offset)``, from the sums; both triangles.

    Args:
        total: float64 sums.
        num_features: that the sums are of.
        offset: the kernel's ``c``.
        use_features: take the first so many features alone; default all.

    Shape:
        - total: ``[num_held]``; output: ``[P, P]`` with ``P = (K + 1)(K + 2) / 2`` for the ``K``
          features in use

    Raises:
        ValueError: if the sums are of another number of features or dtype, or there are fewer
            than ``use_features``.
    """
    layout, last = _layout(total, num_features, use_features)
    num_squares = _triangle(last)
    matrix = total.new_empty(num_squares + last + 1, num_squares + last + 1)
    strip = total.new_empty(last + 1, len(matrix))  # rows (0, j), columns (0, 0), .., (1, 1), ..
    squares = matrix[:num_squares, :num_squares]
    for_each(lambda k: _spread_(squares, strip, total, layout, k), range(last + 1))
    turned = torch.arange(1, last + 2) % (last + 1)  # the constant comes last
    strip = strip[turned]
    scale, rest = _scales(total, last, offset).split([num_squares, last + 1])
    matrix[num_squares:, num_squares:] = strip[:, turned] * torch.outer(rest, rest)
    matrix[num_squares:, :num_squares] = strip[:, last + 1 :] * scale * rest[:, None]
    matrix[:num_squares, num_squares:] = matrix[num_squares:, :num_squares].mT

    def mirror(row: int) -> None:
        rows = slice(row, min(row + _MIRROR, num_squares))
        for column in range(row, num_squares, _MIRROR):
            columns = slice(column, min(column + _MIRROR, num_squares))
            tile = squares[rows, columns].mul_(scale[columns]).mul_(scale[rows, None])
            if row == column:
                tile.copy_(tile.triu() + tile.triu(1).mT)
            else:
                squares[columns, rows] = tile.mT

    for_each(mirror, range(0, num_squares, _MIRROR))
    return matrix


def moment_vector(
    total: Tensor, num_features: int, offset: float = 0.5, use_features: int | None = None
) -> Tensor:
    """``X' w``, the weighted sum of ``quadratic_features(z, offset)``, from the sums.

    Shape:
        - total: ``[num_held]``; output: ``[P]``

    Raises:
        ValueError: as ``normal_matrix``.
    """
    layout, last = _layout(total, num_features, use_features)
    sums = total[_pairs(layout, 0, last)]  # the first row is the pair (0, 0)
    ordered = torch.cat([sums[last + 1 :], sums[1 : last + 1], sums[:1]])
    return ordered * _scales(total, last, offset)


def _add_chunk_(total: Tensor, z: Tensor, weights: Tensor, bits: int | None, sign: int) -> None:
    layout = ProductSums(z.shape[1])
    variables = torch.cat([torch.ones_like(z[:, :1]), z], dim=1).mT.contiguous()  # [K + 1, N]
    weighted = variables * weights
    if bits is not None:
        weighted *= 2.0**bits
    by_larger, by_smaller = z.new_empty(2, layout.num_pairs, len(z))

    def multiply(block: Block) -> None:
        for j in block.variables:
            pairs = by_larger[_triangle(j) : _triangle(j + 1)]
            torch.mul(variables[: j + 1], weighted[j], out=pairs)
            pairs = by_smaller[layout.first_pair(j) : layout.first_pair(j + 1)]
            torch.mul(variables[j:], variables[j], out=pairs)

    def add(tile: tuple[Block, slice, slice]) -> None:
        block, rows, columns = tile
        sums = block.of(total)[rows, columns]
        left, right = by_larger[block.rows][rows], by_smaller[block.columns][columns].mT
        if bits is None:
            sums.addmm_(left, right, alpha=sign)
        else:
            rounded = torch.mm(left, right).add_(_ROUNDER).view(torch.int64)
            sums.add_(rounded.sub_(_ROUNDER_BITS), alpha=sign)

    for_each(multiply, layout.blocks)
    for_each(add, [tile for block in layout.blocks for tile in block.tiles()])


def _spread_(squares: Tensor, strip: Tensor, total: Tensor, layout: ProductSums, k: int) -> None:
    """Write every sum whose second smallest variable is ``k``, above the squares' diagonal.

    For a smallest variable ``i`` these are a symmetric matrix over ``t, u >= k``. Its triangle is
    the end of row ``(i, k)``; its row ``j`` is the part ``(k, k), (k, k + 1), ..`` of ``(i, j)``.
    """
    last = len(strip) - 1
    block = layout.blocks[k // _BLOCK]
    row = _triangle(k) - block.rows.start
    sums = block.of(total)[row : row + k + 1]  # a row for each i
    triangle = sums.index_select(1, _pairs(layout, k, last) - block.columns.start)
    num = last + 1 - k
    rows, columns = torch.triu_indices(num, num)
    places = torch.empty(num, num, dtype=torch.int64)
    places[rows, columns] = places[columns, rows] = torch.arange(len(rows))
    square = triangle.index_select(1, places.view(-1)).view(k + 1, num, num)
    start = strip.shape[1] - _triangle(num)
    strip[k, start:] = triangle[0]
    strip[k + 1 :, start : start + num] = square[0, 1:]
    start -= last + 1  # the strip has the pairs with 0 in front
    for i in range(1, k + 1):
        own = len(squares) - _triangle(last + 1 - i) + k - i
        squares[own, start:] = triangle[i]
        squares[own + 1 : own + num, start : start + num] = square[i, 1:]


def _layout(total: Tensor, num_features: int, use_features: int | None) -> tuple[ProductSums, int]:
    last = num_features if use_features is None else use_features
    layout = ProductSums(num_features)
    _check_sums(total, layout, torch.float64)
    if not 1 <= last <= num_features:
        raise ValueError(f"use_features must be in 1..{num_features}, got {use_features}")
    return layout, last


def _pairs(layout: ProductSums, k: int, last: int) -> Tensor:
    """Where the pairs ``k <= t <= u <= last`` stand in the order of ``t``, then ``u``."""
    smaller, larger = torch.triu_indices(last + 1 - k, last + 1 - k) + k
    starts = torch.tensor([layout.first_pair(t) - t for t in range(last + 1)])
    return torch.add(starts[smaller], larger)


def _scales(total: Tensor, last: int, offset: float) -> Tensor:
    """What ``quadratic_features`` multiplies each product with."""
    squares = total.new_full((_triangle(last),), math.sqrt(2))
    squares[[len(squares) - _triangle(n) for n in range(1, last + 1)]] = 1.0
    linear = total.new_full((last,), math.sqrt(2 * offset))
    return torch.cat([squares, linear, total.new_full((1,), offset)])


def _triangle(num: int) -> int:
    return num * (num + 1) // 2


def _check_sums(total: Tensor, layout: ProductSums, dtype: torch.dtype) -> None:
    if total.shape != (layout.num_held,) or total.dtype != dtype or not total.is_contiguous():
        raise ValueError(
            f"sums of {layout.num_features} features must be {layout.num_held} contiguous {dtype}, "
            f"got {tuple(total.shape)} {total.dtype}"
        )
