"""Cholesky factorisation and solves with the same bits for any number of threads.

LAPACK's own routines split their work over the threads they find, and round accordingly. Here a
matrix is cut into tiles of fixed shape, each computed by one thread (``threads.for_each``). All of
it works on row-major storage, reads the lower triangle alone and makes no copy of it.

Reference:
    Golub and Van Loan, Matrix Computations, 4th ed., sections 4.2.6 (block Cholesky), 3.1.4
    (block substitution) and 3.5.3 (iterative refinement).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tactslip_torch.runtime import for_each

_PANEL = 384  # columns that are factorised at a time
_TILE = 256  # rows of a panel, or right-hand sides, that one thread computes at a time
_FEW = 256  # right-hand sides; up to here the threads share every band of one solve
_BAND = 512  # rows of a factor that a solve reads at a time
_STRIP = 128  # rows of a band that one thread reads at a time, for few right-hand sides
_WIDTH = 1024  # columns of a band, likewise
_MOST_STEPS = 20  # of refinement
_CONVERGED = 1e-10  # error of a solution that needs no more of it, relative


def cholesky_(matrix: Tensor) -> None:
    """Overwrite the lower triangle of a matrix with its Cholesky factor: ``L L' = matrix``.

    Left-looking, in place. What stands above the diagonal is neither read nor written.

    Args:
        matrix: symmetric and positive definite, row-major; spoilt if an error is raised.

    Shape:
        - matrix: ``[n, n]``, float64 or float32

    Raises:
        ValueError: if the matrix is not square and row-major, or not positive definite.
    """
    _check_square(matrix, "matrix")
    for start in range(0, len(matrix), _PANEL):
        _factorise_panel(matrix, start, min(start + _PANEL, len(matrix)))


def forward_solve(factor: Tensor, right: Tensor) -> Tensor:
    """``L^-1 right``.

    Args:
        factor: ``L``; of ``factor`` only the lower triangle is read. May be a view of a larger
            factor, such as ``factor[o:, o:]``.
        right: the right-hand sides; kept.

    Shape:
        - factor: ``[m, m]``; right, output: ``[m, r]``

    Raises:
        ValueError: if shapes or dtypes disagree.
    """
    _check_system(factor, right)
    rows = right.mT.clone(memory_format=torch.contiguous_format)  # [r, m], one system a row
    _by_systems(lambda some: _forward_(factor, some), rows)
    return rows.mT


def cholesky_solve(factor: Tensor, right: Tensor) -> Tensor:
    """``(L L')^-1 right``.

    Args:
        factor: ``L``, as in ``forward_solve``.
        right: the right-hand sides; kept.

    Shape:
        - factor: ``[m, m]``; right, output: ``[m]`` or ``[m, r]``

    Raises:
        ValueError: if shapes or dtypes disagree.
    """
    if right.ndim == 1:
        return cholesky_solve(factor, right[:, None])[:, 0]
    _check_system(factor, right)
    rows = right.mT.clone(memory_format=torch.contiguous_format)

    def solve(some: Tensor) -> None:
        _forward_(factor, some)
        _backward_(factor, some)

    _by_systems(solve, rows)
    return rows.mT


def mirror_(matrix: Tensor) -> None:
    """Copy what stands below the diagonal above it, where a factor leaves it alone: ``[n, n]``."""
    _copy_across(matrix, up=True)


def from_above(matrix: Tensor) -> None:
    """Copy what stands above the diagonal below it, where a factor was: ``[n, n]``."""
    _copy_across(matrix, up=False)


def _copy_across(matrix: Tensor, *, up: bool) -> None:
    _check_square(matrix, "matrix")
    num = len(matrix)

    def copy(row: int) -> None:
        rows = slice(row, min(row + _TILE, num))
        for column in range(0, row, _TILE):
            columns = slice(column, column + _TILE)
            below, above = matrix[rows, columns], matrix[columns, rows].mT
            (above if up else below).copy_(below if up else above)
        corner = matrix[rows, rows]
        half = corner if up else corner.mT
        corner.copy_(half.tril() + half.tril(-1).mT)

    for_each(copy, range(0, num, _TILE))


def symmetric_product(matrix: Tensor, diagonal: Tensor, vector: Tensor) -> Tensor:
    """``A vector``, where ``A`` has this diagonal and what stands above that of ``matrix``.

    Shape:
        - matrix: ``[n, n]``; diagonal, vector, output: ``[n]``
    """
    product = diagonal * vector

    def add(row: int) -> None:
        rows, end = slice(row, row + _TILE), row + _TILE
        corner, own = matrix[rows, rows].triu(1), vector[rows]
        product[rows] += corner @ own + corner.mT @ own
        product[rows] += matrix[rows, end:] @ vector[end:]
        product[rows] += matrix[:row, rows].mT @ vector[:row]

    for_each(add, range(0, len(matrix), _TILE))
    return product


def refine(matrix: Tensor, diagonal: Tensor, right: Tensor) -> tuple[Tensor, int, float]:
    """Solve ``A x = right`` with the factor of a neighbour of ``A``, by iterative refinement.

    Not by conjugate gradients: where ``A`` is singular they blow up what rounding left there.

    Args:
        matrix: below its diagonal and on it the factor; above it what ``A`` has there.
        diagonal: of ``A``.
        right: the right-hand side; kept.

    Shape:
        - matrix: ``[n, n]``; diagonal, right: ``[n]``

    Returns:
        The solution, the number of steps, and the error of the solution in units of its own size:
        both in the norm that ``A`` gives, as far as the factor tells.
    """
    x, rest, size, steps, before = torch.zeros_like(right), right, 0.0, 0, math.inf
    while True:
        step = cholesky_solve(matrix, rest)
        square = max(float((rest * step).sum()), 0.0)
        size = size or square
        if square <= _CONVERGED**2 * size or not square < before / 4 or steps == _MOST_STEPS:
            return x, steps, math.sqrt(square / size) if size > 0 else 0.0
        x, before, steps = x + step, square, steps + 1
        rest = right - symmetric_product(matrix, diagonal, x)


def check_finite(matrix: Tensor, right: Tensor, name: str) -> None:
    """Name the first number that is not.

    Shape:
        - matrix: ``[*, n, n]``, its lower triangle is read; right: ``[*, n]``

    Raises:
        ValueError: if there is one.
    """
    for what, values in ((name, matrix.tril()), (f"right-hand side of {name}", right)):
        if not bool(values.isfinite().all()):
            place = (~values.isfinite()).nonzero()[0].tolist()
            raise ValueError(
                f"{what} must be finite, got {float(values[tuple(place)])} at {place}; leave out "
                "or mask the bin it comes from"
            )


def in_dtype(x: Tensor, given: torch.dtype, name: str) -> Tensor:
    """A solution as it is handed out: refused where the dtype has no room for it."""
    cast = x.to(given)
    if not bool(cast.isfinite().all()):
        raise ValueError(
            f"the solution for {name} leaves {str(given)[6:]}: an entry is "
            f"{float(x.detach()[~cast.isfinite()][0]):.3g}; scale the features or the penalty"
        )
    return cast


def _factorise_panel(matrix: Tensor, start: int, end: int) -> None:
    """Columns ``start`` to ``end`` of the factor, all columns before them being final."""
    left = matrix[start:end, :start]
    corner = matrix[start:end, start:end]
    work = corner.clone()  # LAPACK and tiles write to a whole square; the upper triangle is theirs
    below = range(end, len(matrix), _TILE)

    def update(row: int) -> None:
        if row < end:
            stop = min(row + _TILE, end)
            tile = work[row - start : stop - start, : stop - start]
        else:
            stop = min(row + _TILE, len(matrix))
            tile = matrix[row:stop, start:end]
        tile.addmm_(matrix[row:stop, :start], left[: tile.shape[1]].mT, alpha=-1)

    def factorise(lower: Tensor) -> None:
        factor, info = torch.linalg.cholesky_ex(work)
        if info:
            raise ValueError(
                f"matrix is not positive definite at row {start + int(info) - 1} in "
                f"{matrix.dtype}; add more to its diagonal (a lower penalty)"
            )
        corner.copy_(torch.where(lower, factor, corner))

    def divide(row: int) -> None:
        tile = matrix[row : row + _TILE, start:end]
        tile.copy_(torch.linalg.solve_triangular(corner.mT, tile, upper=True, left=False))

    for_each(update, [*range(start, end, _TILE), *below])
    for_each(factorise, [torch.ones_like(corner, dtype=torch.bool).tril_()])
    for_each(divide, below)


def _by_systems(solve: Callable[[Tensor], None], rows: Tensor) -> None:
    """Few systems share the threads; of many, each thread takes a tile at a time."""
    if len(rows) <= _FEW:
        solve(rows)
    else:
        for_each(solve, rows.split(_TILE))


def _forward_(factor: Tensor, rows: Tensor) -> None:
    """``L^-1`` on every row of ``[r, m]``, in place; reads the factor once, from the top."""
    for start in range(0, len(factor), _BAND):
        end = min(start + _BAND, len(factor))
        done = rows[:, :start].mT

        def reduce(row: int) -> None:
            strip = slice(row, min(row + _STRIP, end))  # noqa: B023
            rows[:, strip].mT.addmm_(factor[strip, :start], done, alpha=-1)  # noqa: B023

        def divide(corner: Tensor) -> None:
            part = rows[:, start:end].mT  # noqa: B023
            part.copy_(torch.linalg.solve_triangular(corner, part, upper=False))

        if start:
            for_each(reduce, range(start, end, _STRIP))
        for_each(divide, [factor[start:end, start:end]])


def _backward_(factor: Tensor, rows: Tensor) -> None:
    """``L'^-1`` on every row of ``[r, m]``, in place; reads the same bands, from the bottom."""
    for start in reversed(range(0, len(factor), _BAND)):
        band = factor[start : start + _BAND]
        part = rows[:, start : start + _BAND].mT

        def divide(corner: Tensor) -> None:
            part.copy_(torch.linalg.solve_triangular(corner.mT, part, upper=True))  # noqa: B023

        def reduce(column: int) -> None:
            width = slice(column, min(column + _WIDTH, start))  # noqa: B023
            rows[:, width].mT.addmm_(band[:, width].mT, part, alpha=-1)  # noqa: B023

        for_each(divide, [band[:, start : start + _BAND]])
        for_each(reduce, range(0, start, _WIDTH))


def _check_square(matrix: Tensor, name: str) -> None:
    num = matrix.shape[-1]
    if matrix.shape != (num, num) or matrix.stride(-1) != 1:
        raise ValueError(
            f"{name} must be [n, n] and row-major, got {tuple(matrix.shape)} with strides "
            f"{tuple(matrix.stride())}"
        )
    if not matrix.is_floating_point():
        raise ValueError(f"{name} must be floating, got {matrix.dtype}")


def _check_system(factor: Tensor, right: Tensor) -> None:
    _check_square(factor, "factor")
    if right.ndim != 2 or len(right) != len(factor) or right.dtype != factor.dtype:
        raise ValueError(
            f"right must have {len(factor)} rows of {factor.dtype} for this factor, got "
            f"{tuple(right.shape)} of {right.dtype}"
        )
