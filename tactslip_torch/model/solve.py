"""``(A + diag(1 / (C w))) x = b`` for a positive semi-definite A, however close to singular.

Cholesky wherever the condition of the system, scaled to a diagonal of ones, allows it. Closer to
singular, and for an infinite C, ``sqrt(w) A sqrt(w)`` without its ridge is decomposed into
eigenvectors, and what is rounding noise is dropped: eigenvalues up to ``n eps`` of the largest.
With a large C they would fill x with rounding. If they are null, as those of duplicates are, they
add nothing to a score of a training bin; what they could add is part of the stated error. So an
infinite C gives the minimum-norm (weighted) least-squares solution.

Reference:
    Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd ed., sections 10.1 (Demmel's
    bounds: what counts is the condition of the scaled matrix) and 15.3 (its estimate, LAPACK's
    ``dpocon``); Golub and Van Loan, Matrix Computations, 4th ed., section 5.5 (rank).
"""

from __future__ import annotations

import logging
import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

log = logging.getLogger(__name__)

_EPS = torch.finfo(torch.float64).eps
_TINY = torch.finfo(torch.float64).tiny
_MOST_CONDITION = 1e12  # of what Cholesky may solve
_LARGEST_ERROR = 1e-2  # of a solution that is handed out
_MOVES, _ROUNDINGS = 8, 64  # how often roundings are drawn, and of how many eps each is
_LARGEST_UNSAID = 1e-3  # that may be left out of a least-squares solution without a word


@dataclass(frozen=True)
class SolveReport:
    """How a system was solved, and how far rounding may reach.

    Attributes:
        method: by which factorisation.
        dtype: of the arithmetic, ``"float64"``.
        size: number of unknowns.
        penalty: the paper's ``C``.
        condition: estimate for the system scaled to a diagonal of ones; of the components kept
            for ``"eigen"``.
        condition_bound: what it cannot exceed, since no eigenvalue is below the ridge's; ``None``
            without a ridge.
        rank: components kept; all but for ``"eigen"``.
        error: to first order in the rounding of the matrix, of ``"cholesky"`` that of the solution,
            relative, in the norm scaled like the system. Of ``"eigen"`` that of the scores of
            training bins, relative to the targets, in the mean square by weight; scores elsewhere
            may differ by more, where they tell apart what nearly repeats in training.
        left_out: for ``"eigen"``, what the components left out could add to a score of a training
            bin, relative to the targets: 0 if they are null, as those of exact duplicates are, but
            no more than this if they only are too small for float64 to tell.
        elsewhere: error of the machine's coefficients, relative to the largest, as random roundings
            of the matrix move them; infinite where what was left out may tell apart bins elsewhere.
            ``None`` where there are no coefficients.
    """

    method: Literal["cholesky", "eigen"]
    dtype: str
    size: int
    penalty: float
    condition: float
    condition_bound: float | None
    rank: int
    error: float
    left_out: float | None = None
    elsewhere: float | None = None

    def metadata(self) -> dict[str, Any]:
        """All of it as JSON holds it; an infinite number is the string ``"inf"``."""
        return {
            name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }

    def __str__(self) -> str:
        text = f"{self.method} of {self.size} unknowns at C={self.penalty:g} in {self.dtype}"
        if self.rank < self.size:
            text += f", {self.rank} of them kept"
        of = "" if self.method == "cholesky" else " of training scores"
        text += f": condition {self.condition:.1e}, relative error{of} up to {self.error:.0e}"
        if self.left_out is not None and self.left_out == self.error:
            text += " unless what is left out is null"
        if self.elsewhere == math.inf:
            text += "; scores of bins unlike those of training may be others"
        elif self.elsewhere is not None:
            text += f", of the coefficients up to {self.elsewhere:.0e}"
        return text


class Solution(NamedTuple):
    """Of a system, and how it was come by.

    Attributes:
        x: ``[n]``, float64.
        report: on the solve.
        factor: ``[n, n]``, float64, the lower Cholesky factor of ``A + diag(1 / (C w))``; ``None``
            if the method was another.
        moves: ``[n, 8]``, how roundings of the matrix may move ``x``.
    """

    x: Tensor
    report: SolveReport
    factor: Tensor | None
    moves: Tensor


def solve_symmetric(
    matrix: Tensor,
    right: Tensor,
    penalty: float,
    weights: Tensor | None = None,
    *,
    name: str = "matrix",
    in_span: bool = False,
    most_condition: float | None = None,
) -> Solution:
    """``(matrix + diag(1 / (penalty weights)))^-1 right`` in float64, and a report.

    Needs one more matrix of that size, the eigendecomposition four. Not differentiable.

    Args:
        matrix: symmetric, positive semi-definite; kept.
        right: kept.
        penalty: the paper's ``C``, positive; ``inf`` for minimum-norm (weighted) least squares.
        weights: positive weight of each unknown; default 1.
        name: of the matrix, for errors.
        in_span: the right-hand side lies in the span of the matrix, as that of normal equations.
        most_condition: raise an error instead of leaving Cholesky, or above this condition.

    Shape:
        - matrix: ``[n, n]``, float64; right, weights: ``[n]``

    Raises:
        ValueError: for another dtype, if a number is not finite, the matrix is not positive
            semi-definite, its rounding drowns the solution, or eigenvectors are needed and not
            allowed.

    Example:
        >>> twice = torch.ones(2, 2, dtype=torch.float64)  # one bin, twice
        >>> x, report, *_ = solve_symmetric(twice, twice[0], penalty=1e30)
        >>> x, report.method, report.rank
        (tensor([0.5000, 0.5000], dtype=torch.float64), 'eigen', 1)
    """
    if matrix.dtype != torch.float64:
        raise ValueError(f"expected {name} in float64, got {matrix.dtype}; promote it first")
    matrix, right = matrix.detach(), right.detach().double()
    weights = torch.ones_like(right) if weights is None else weights.detach().double()
    ridge = 1 / (penalty * weights)
    if not (penalty > 0 and bool(ridge.isfinite().all())):
        raise ValueError(
            f"penalty (the paper's C) must be positive, and so large that 1 / (C w) is finite, "
            f"got {penalty}"
        )
    system = matrix.clone()
    system.diagonal().add_(ridge)
    whole = system.diagonal().clone()
    scale = torch.where(whole > 0, whole, 1.0).sqrt()
    system.div_(scale).div_(scale[:, None])
    norm = float(torch.linalg.matrix_norm(system, 1))
    if not (math.isfinite(norm) and bool(right.isfinite().all())):
        _check_finite(matrix, right, name)
        raise ValueError(f"{name} overflows float64; scale the features")
    least = float((ridge / whole).min())
    bound = norm / least if least > 0 else math.inf
    size, known = len(right), bound if math.isfinite(bound) else None
    report = SolveReport("cholesky", "float64", size, penalty, math.inf, known, size, math.inf)
    # bins that a cut at rounding would lose for their weights
    own, cutoff = matrix.diagonal() * weights, size * _EPS
    is_faint = matrix.diagonal() <= cutoff * matrix.diagonal().max()
    is_light = (own <= cutoff * own.max()) & ~is_faint
    if not math.isinf(penalty) or bool(is_light.any()):
        factor = system.mT  # column-major, so that LAPACK works within the copy
        info = torch.empty((), dtype=torch.int32, device=matrix.device)
        torch.linalg.cholesky_ex(factor, out=(factor, info))
        condition = math.inf if info else min(bound, _condition(factor, norm))
        limit = min(_MOST_CONDITION, 1 / (size * _EPS))
        if condition <= (limit if most_condition is None else min(limit, most_condition)):
            factor.mul_(scale[:, None])
            x = torch.cholesky_solve(right[:, None], factor)[:, 0]
            noise = _noise(scale * x) * scale[:, None]
            error = math.sqrt(size) * _EPS * condition
            report = replace(report, condition=condition, error=error)
            return Solution(_finite(x, name), report, factor, torch.cholesky_solve(noise, factor))
        reason = f"{name} + I/C at penalty={penalty:g} has condition {condition:.1e}"
        if most_condition is not None:
            raise ValueError(f"{reason}, wanted up to {most_condition:.0e}; lower the penalty")
        log.warning("%s, too much for Cholesky in float64", reason)
    del system
    if bool((is_light & (own > 1e-2 * (own + 1 / penalty))).any()):  # a hundredth of its score
        raise ValueError(
            f"{name} at penalty={penalty:g} is singular, with weights from "
            f"{float(weights.min()):.1e} to {float(weights.max()):.1e} too far apart to leave only "
            "noise out; bring them closer, or lower the penalty"
        )
    x, report, moves = _truncated(matrix, right, report, weights.sqrt(), in_span, name)
    if not math.isinf(penalty) or (report.left_out or 0.0) > _LARGEST_UNSAID:
        log.warning("%s: solved by %s", name, report)
    return Solution(_finite(x, name), report, None, moves)


def check_weights(weights: Tensor) -> None:
    """Refuse weights of bins that are not positive and finite.

    Raises:
        ValueError: if there is one.
    """
    if len(wrong := (~((weights > 0) & weights.isfinite())).nonzero()):
        place = int(wrong[0])
        raise ValueError(
            f"weights must be positive and finite, got {float(weights[place]):g} at bin {place}"
        )


def _truncated(
    matrix: Tensor,
    right: Tensor,
    report: SolveReport,
    roots: Tensor,
    in_span: bool,
    name: str,
) -> tuple[Tensor, SolveReport, Tensor]:
    """The solution on what is above rounding, and how it moves; ``roots`` are of the weights.

    Raises:
        ValueError: if the matrix is not positive semi-definite, its rounding drowns what is kept,
            or what is left out is above rounding and adds a hundredth to a score.
    """
    penalty = report.penalty
    values, vectors = torch.linalg.eigh(roots * matrix * roots[:, None])
    top, low, num = float(values[-1]), float(values[0]), len(values)
    rounding, cutoff = _EPS * max(top, -low), num * _EPS * top
    if low < -max(10 * cutoff, 0.0):
        raise ValueError(
            f"{name} is not positive semi-definite: it has the eigenvalue {low:.3g} beside "
            f"{top:.3g}; it must be a sum of squares"
        )
    kept, ridge = values > cutoff, 1 / penalty
    rank = int(kept.sum())
    along = vectors.mT @ (roots * right)
    solved = torch.where(kept, along / torch.where(kept, values + ridge, 1.0), 0.0)
    least = float(values[num - rank] + ridge) if rank else math.inf
    condition, error = (top + ridge) / least, math.sqrt(num) * rounding / least
    if error > _LARGEST_ERROR:
        raise ValueError(
            f"{name} at penalty={penalty:g} has rank {rank} of {num} and a condition of "
            f"{condition:.1e}, too much for its rounding ({error:.0e} of the solution); lower the "
            "penalty, or leave out what is nearly duplicate"
        )
    dropped, away = values[: num - rank], vectors[:, : num - rank]
    size = float(torch.linalg.vector_norm(values.clamp(min=0).sqrt() * solved))

    def added(at: Tensor) -> float:
        """To a score of a training bin, relative, were these the eigenvalues left out."""
        part = along[: num - rank].abs()
        if in_span:  # that of the targets is this over the root of the eigenvalue
            scores = (at.sqrt() / (at + ridge)).nan_to_num(0.0) * part
            most = torch.linalg.vector_norm(scores) / size
        else:
            scores = (at / (at + ridge)).nan_to_num(0.0) * part
            most = (away.abs() @ scores / roots).max() / right.abs().max()
        return min(float(most.nan_to_num(0.0)), 1.0)

    seen = added(torch.where(dropped > math.sqrt(num) * rounding, dropped, 0.0))
    if seen > _LARGEST_ERROR:
        raise ValueError(
            f"{name} at penalty={penalty:g} is nearly singular: eigenvalues of "
            f"{float(dropped[-1]) / top:.0e} of the largest add {seen:.0e} to scores, but drown in "
            "rounding; leave out what is nearly duplicate, or lower the penalty"
        )
    unseen = dropped.clamp(min=0) + rounding
    if in_span:
        unseen = unseen.clamp(max=max(ridge, _TINY))  # where it would add most
    left_out = added(unseen)
    error = max(error, left_out)
    report = replace(
        report, method="eigen", condition=condition, rank=rank, error=error, left_out=left_out
    )
    noise = top * _noise(solved) / torch.where(kept, values + ridge, math.inf)[:, None]
    return roots * (vectors @ solved), report, roots[:, None] * (vectors @ noise)


def _noise(x: Tensor) -> Tensor:
    """What roundings of a matrix with a norm of one may add to its product with ``x``, ``[n, 8]``.

    Each of its entries is off by a few eps, independently, so each of the product by as much of the
    length of ``x``.
    """
    generator = torch.Generator().manual_seed(0)
    normal = torch.randn(len(x), _MOVES, generator=generator, dtype=torch.float64).to(x.device)
    size: Tensor = torch.linalg.vector_norm(x)
    moved: Tensor = _ROUNDINGS * _EPS * size * normal
    return moved


def _condition(factor: Tensor, norm: float) -> float:
    """Estimate from a lower Cholesky factor, column-major, and the 1-norm of the matrix."""
    from scipy.linalg.lapack import dpocon  # as long to import as a fifth of torch

    reciprocal, _ = dpocon(factor.cpu().numpy(), norm, uplo="L")
    return 1 / reciprocal if reciprocal > 0 else math.inf


def _check_finite(matrix: Tensor, right: Tensor, name: str) -> None:
    """Name the first number that is not."""
    for what, values in ((name, matrix), (f"right-hand side of {name}", right)):
        if not bool(values.isfinite().all()):
            place = (~values.isfinite()).nonzero()[0].tolist()
            raise ValueError(
                f"{what} must be finite, got {float(values[tuple(place)])} at {place}; leave out "
                "or mask the bin it comes from"
            )


def _finite(x: Tensor, name: str) -> Tensor:
    """A solution as it is handed out: refused where it overflows float64."""
    if not bool(x.isfinite().all()):
        worst = float(x[~x.isfinite()][0])
        raise ValueError(
            f"the solution for {name} leaves float64: an entry is {worst:.3g}; scale the features "
            "or the penalty"
        )
    return x
