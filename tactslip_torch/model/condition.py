"""How far rounding carries in a symmetric positive definite system: its condition, estimated.

What decides the error of a Cholesky solve, and whether the factorisation succeeds at all, is the
condition of ``H = D^-1 A D^-1``, the matrix scaled to a diagonal of ones: bins of any weight and
features of any unit cost nothing. Each function therefore takes the ``scale`` D; all ones give the
condition of A itself.

Reference:
    Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd ed., sections 10.1 (Demmel's
    bounds for Cholesky) and 15.2-15.3 (estimating the 1-norm of an inverse); Higham and Tisseur
    (2000), SIAM J. Matrix Anal. Appl. 21(4), 1185-1201 (blocks of vectors).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_solve, forward_solve
from tactslip_torch.runtime import for_each

_ROWS = 256  # that one thread sums at a time
_WIDTH = 512  # columns at a time: what fits a cache


Method = Literal["cholesky", "jittered", "eigen"]


@dataclass(frozen=True)
class SolveReport:
    """How a system was solved, and how far rounding may reach.

    Attributes:
        method: the rung.
        dtype: of the matrix as it was given; the arithmetic is float64's always.
        size: number of unknowns.
        penalty: the paper's ``C``.
        condition: estimate for the system scaled to a diagonal of ones; of the components kept
            for ``"eigen"``.
        condition_bound: what it cannot exceed, since no eigenvalue is below the ridge's; ``None``
            without a ridge.
        rank: components kept; all but for ``"eigen"``.
        jitter: least part by which the diagonal of the system whose factor refines is larger.
        refinements: steps of it.
        residual: what they left, relative, in the norm of the system.
        left_out: for ``"eigen"``, what the components left out could add to a score of a training
            bin, relative to the targets: 0 if they are null, as those of exact duplicates are, but
            no more than this if they only are too small for float64 to tell.
        error: relative error of first order of the solution: rounding of the matrix, or the error
            it came with, times the condition; at least ``left_out``.
    """

    method: Method
    dtype: str
    size: int
    penalty: float
    condition: float
    condition_bound: float | None
    rank: int
    error: float
    jitter: float | None = None
    refinements: int = 0
    residual: float | None = None
    left_out: float | None = None

    def facts(self) -> dict[str, Any]:
        """All of it as JSON holds it; an infinite number is the string ``"inf"``."""
        return {
            name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }

    def __str__(self) -> str:
        text = f"{self.method} of {self.size} unknowns at C={self.penalty:g} in {self.dtype}"
        if self.rank < self.size:
            text += f", {self.rank} of them kept"
        if self.refinements:
            text += f", {self.refinements} refinements"
        text += f": condition {self.condition:.1e}, relative error about {self.error:.0e}"
        if self.left_out is not None and self.left_out == self.error:
            text += " unless what is left out is null"
        return text


def scaled_norm(matrix: Tensor, scale: Tensor) -> float:
    """The 1-norm of ``D^-1 A D^-1``, exactly; no less than its largest eigenvalue.

    NaN or infinite if an entry is.

    Args:
        matrix: ``A``, symmetric; only its lower triangle is read.
        scale: the diagonal of ``D``, positive.

    Shape:
        - matrix: ``[n, n]``; scale: ``[n]``

    Example:
        >>> scaled_norm(torch.tensor([[4.0, 0.0], [-1.0, 1.0]]), torch.tensor([2.0, 1.0]))
        1.5
    """
    shares = 1 / scale
    starts = range(0, len(matrix), _ROWS)
    sums = matrix.new_zeros(len(starts), len(matrix))  # what each strip adds, to its columns too

    def add(row: int) -> None:
        rows, own = slice(row, row + _ROWS), sums[row // _ROWS]
        for column in range(0, row, _WIDTH):
            columns = slice(column, min(column + _WIDTH, row))
            sizes = matrix[rows, columns].abs()
            own[rows].addmv_(sizes, shares[columns])
            own[columns] = shares[rows] @ sizes
        corner = matrix[rows, rows].tril().abs()
        own[rows] += corner @ shares[rows] + corner.tril(-1).mT @ shares[rows]

    for_each(add, starts)
    return float((sums.sum(0) * shares).max())


def inverse_norm(factor: Tensor, scale: Tensor, rounds: int = 3) -> float:
    """An estimate of the 1-norm of ``(D^-1 L L' D^-1)^-1``: never above, rarely a third of it.

    Hager's ascent with two vectors at a time; no random numbers.

    Args:
        factor: ``L``, the Cholesky factor of ``A``; only its lower triangle is read.
        scale: the diagonal of ``D``, positive.
        rounds: of two solves each, at most; two nearly always do, one is rarely off by ten.

    Shape:
        - factor: ``[n, n]``; scale: ``[n]``
    """
    num, column = len(factor), scale[:, None]
    ramp = torch.linspace(1, 2, num, dtype=factor.dtype, device=factor.device)
    ramp[1::2] *= -1  # what cancellation hides from ones
    tried = torch.stack([torch.full_like(ramp, 1 / num), ramp / ramp.abs().sum()], dim=-1)
    best, seen = 0.0, torch.zeros(num, dtype=torch.bool)
    for _ in range(rounds):
        image = column * cholesky_solve(factor, column * tried)
        found = float(image.abs().sum(0).max())
        if not found > best:
            break
        signs = torch.where(image < 0, -1.0, 1.0).to(image)
        slopes = (column * cholesky_solve(factor, column * signs)).abs().amax(1)
        best = max(found, float(slopes.max()))
        order = slopes.masked_fill(seen, -1).argsort(descending=True, stable=True)[:2]
        if bool(seen[order].any()):
            break
        seen[order] = True
        tried = torch.zeros_like(tried[:, : len(order)])
        tried[order, torch.arange(len(order))] = 1
    return best


def inverse_growth(factor: Tensor, scale: Tensor, solution: Tensor) -> float:
    """A lower bound of the largest eigenvalue of ``(D^-1 L L' D^-1)^-1`` for half a solve.

    One and a half steps of inverse iteration: the solution of a system is the first. It tells
    nothing of directions that the right-hand side does not have.

    Args:
        factor: ``L``, the Cholesky factor of ``A``.
        scale: the diagonal of ``D``.
        solution: of a system in ``A``; 0 tells nothing.

    Shape:
        - factor: ``[n, n]``; scale, solution: ``[n]``
    """
    turned = scale * solution
    size = float(torch.linalg.vector_norm(turned))
    if size == 0:
        return 0.0
    half = forward_solve(factor, (scale * (turned / size))[:, None])
    return float(torch.linalg.vector_norm(half)) ** 2


def condition_of(matrix: Tensor, factor: Tensor) -> float:
    """Estimate for a positive definite matrix scaled to a diagonal of ones, from its factor.

    Shape:
        - matrix, factor: ``[n, n]``, row-major; only their lower triangles are read
    """
    scale = matrix.diagonal().sqrt()
    return scaled_norm(matrix, scale) * inverse_norm(factor, scale)


def conditions_of(system: Tensor, factor: Tensor, info: Tensor) -> list[float]:
    """Of each matrix of a batch; infinite where its factorisation failed."""
    num = system.shape[-1]
    return [
        math.inf if failed else condition_of(matrix, lower.contiguous())
        for matrix, lower, failed in zip(
            system.reshape(-1, num, num).cpu(),
            factor.reshape(-1, num, num).cpu(),
            info.reshape(-1).tolist(),
            strict=True,
        )
    ]
