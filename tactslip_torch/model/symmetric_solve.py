"""``(A + diag(1 / (C w))) x = b`` for a positive semi-definite A, however close to singular.

Three rungs, and a report of the one that was taken:

- *Cholesky*, wherever it succeeds and the condition, estimated for the system scaled to a diagonal
  of ones, is below both 1e12 and ``1 / (n eps)``. Bit for bit what ``cholesky_`` and
  ``cholesky_solve`` give: no later rung ever touches a well-posed answer. Refinement in float64
  would bring none closer: up to 1e12 the error is some 0.1 eps condition before it and after.
- *Jittered*: the factor of the system with more of its ridge, at least 1e-8 of the diagonal, is
  refined against the system itself, so that the answer is that of the system asked for. Taken if
  that converges, to a solution small enough that its rounding does not show.
- *Eigen*: ``sqrt(w) A sqrt(w)`` without its ridge is decomposed, and what is rounding noise is
  dropped: eigenvalues up to ``n eps`` of the largest. With a large C they would fill x with
  rounding. If they are null, as those of duplicates are, they add nothing to any score of a
  training bin; what they could add, as far as float64 tells, is in the error of the report. One
  above rounding, of features that are nearly duplicate, is refused where it would add 1e-2. An
  infinite C comes here at once, unless weights are so far apart that the cut would lose a bin:
  the minimum-norm least-squares solution.

Reference:
    Higham (2002), Accuracy and Stability of Numerical Algorithms, 2nd ed., sections 10.1 and 12
    (refinement); Golub and Van Loan, Matrix Computations, 4th ed., section 5.5 (rank).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import (
    check_finite,
    cholesky_,
    cholesky_solve,
    from_above,
    in_dtype,
    mirror_,
    refine,
)
from tactslip_torch.model.condition import (
    Method,
    SolveReport,
    inverse_growth,
    inverse_norm,
    scaled_norm,
)
from tactslip_torch.model.truncation import (
    LARGEST_ERROR,
    LARGEST_ERROR_FROM_FLOAT32,
    check_light,
    light_bins,
    truncated,
)
from tactslip_torch.runtime import for_each

log = logging.getLogger(__name__)

_EPS = torch.finfo(torch.float64).eps
_MOST_CONDITION = 1e12  # of what a plain Cholesky may solve
_SURE = 1e8  # a condition that the ridge keeps below this needs no better estimate
_JITTERS = (1e-8, 1e-6)  # of the diagonal: so much that what is null does not fill with rounding
_ENOUGH = 1e-8  # relative error that refinement may leave


class Solution(NamedTuple):
    """Of a system, and how it was come by.

    Attributes:
        x: ``[n]``, in the dtype of the matrix.
        report: on the solve.
    """

    x: Tensor
    report: SolveReport


def solve_symmetric_(
    matrix: Tensor,
    right: Tensor,
    penalty: float,
    weights: Tensor | None = None,
    *,
    name: str = "matrix",
    restore: Callable[[Tensor], object] | None = None,
    noise: float = 0.0,
    in_span: bool = False,
    most_condition: float | None = None,
) -> Solution:
    """``(matrix + diag(1 / (penalty weights)))^-1 right``, within the matrix.

    Needs no second matrix of its size for the first two rungs: the system stays above the
    diagonal, or ``restore`` writes it again. The eigendecomposition takes four more. The same bits
    for any number of threads. A float32 matrix is promoted (to one more), and carries an error of
    ``eps32``: refused if that times the condition exceeds 1e-2.

    Args:
        matrix: symmetric, positive semi-definite, row-major; its lower triangle is read. If the
            report says ``"cholesky"`` and it is float64, it holds the factor afterwards.
        right: kept.
        penalty: the paper's ``C``, positive; ``inf`` for minimum-norm (weighted) least squares.
        weights: positive weight of each unknown; default 1.
        name: of the matrix, for errors.
        restore: writes what stands below the diagonal again into its argument.
        noise: size (2-norm) of the error that matrix and right-hand side come with beyond rounding;
            refused where that of the matrix would be a thousandth of the solution.
        in_span: the right-hand side lies in the span of the matrix, so that the solution shows
            nothing of what is null: the condition takes two solves even if surely below 1e8.
        most_condition: raise an error instead of leaving the first rung, or above this condition.

    Shape:
        - matrix: ``[n, n]``; right, weights: ``[n]``

    Raises:
        ValueError: if a number is not finite, the matrix is not positive semi-definite, its
            errors drown the solution, or a later rung is needed and not allowed.

    Example:
        >>> twice = torch.ones(2, 2, dtype=torch.float64)  # one bin, twice
        >>> x, report = solve_symmetric_(twice, twice[0], penalty=1e30)
        >>> x, report.method, report.rank
        (tensor([0.5000, 0.5000], dtype=torch.float64), 'eigen', 1)
    """
    given = matrix.dtype
    system = _System(
        matrix if given == torch.float64 else matrix.double(),
        right.double(),
        penalty,
        torch.ones_like(right, dtype=torch.float64) if weights is None else weights.double(),
        name,
        restore if given == torch.float64 else None,
        noise,
        in_span,
        given,
    )
    x, report = system.solve(most_condition)
    return Solution(in_dtype(x, given, name), report)


def ridge_of(penalty: float, weights: Tensor) -> Tensor:
    """``1 / (C w)``, which must be finite."""
    ridge = 1 / (penalty * weights)
    if not (penalty > 0 and bool(ridge.isfinite().all())):
        raise ValueError(
            f"penalty (the paper's C) must be positive, and so large that 1 / (C w) is finite, "
            f"got {penalty}"
        )
    return ridge


def largest_condition(size: int, eps: float = _EPS) -> float:
    """Up to which a plain Cholesky solves a system that came with this relative error."""
    most = min(_MOST_CONDITION, 1 / (size * _EPS))
    return most if eps <= _EPS else min(most, LARGEST_ERROR_FROM_FLOAT32 / eps)


@dataclass
class _System:
    """A system on its way down the rungs; arguments of ``solve_symmetric_``, in float64."""

    matrix: Tensor
    right: Tensor
    penalty: float
    weights: Tensor
    name: str
    restore: Callable[[Tensor], object] | None
    noise: float
    in_span: bool
    given: torch.dtype  # what the matrix came in

    def __post_init__(self) -> None:
        self.dtype, self.eps = str(self.given).removeprefix("torch."), torch.finfo(self.given).eps
        self.ridge = ridge_of(self.penalty, self.weights)
        self.bare = self.matrix.diagonal().clone()
        self.whole = self.bare + self.ridge
        self.scale = torch.where(self.whole > 0, self.whole, 1.0).sqrt()
        self.matrix.diagonal().copy_(self.whole)
        self.norm = scaled_norm(self.matrix, self.scale)
        if not (math.isfinite(self.norm) and bool(self.right.isfinite().all())):
            check_finite(self.matrix, self.right, self.name)
            raise ValueError(f"{self.name} overflows float64; scale the features")

    def solve(self, most: float | None) -> Solution:
        light = bool(light_bins(self.bare, self.weights, self.eps).any())
        if math.isinf(self.penalty) and not light:
            return self.by_eigen()
        if most is None and self.restore is None:
            mirror_(self.matrix)
        bound = self.bound()
        try:
            cholesky_(self.matrix)
        except ValueError as failure:
            return self.escalated(most, math.inf, str(failure))
        x = cholesky_solve(self.matrix, self.right)
        sure = bound <= _SURE and self.eps <= _EPS
        cheap = sure and not self.in_span
        inverse = inverse_growth(self.matrix, self.scale, x) if cheap else 0.0
        inverse = inverse or inverse_norm(self.matrix, self.scale, 1 if sure else 3)
        inverse = min(inverse, bound / self.norm)
        condition = self.norm * inverse
        drowned = self.noise * min(inverse / float(self.whole.min()), float(1 / self.ridge.min()))
        given = float(self.noise / self.bare.max()) if self.noise > 0 else 0.0
        error = max(self.eps * condition, drowned, given)
        limit = min(largest_condition(len(x), self.eps), math.inf if most is None else most)
        if condition > limit or drowned > LARGEST_ERROR:
            return self.escalated(most, condition, "")
        return Solution(x, self.report("cholesky", condition, error, len(x)))

    def bound(self) -> float:
        """Of the condition: the norm over the least eigenvalue that the ridge leaves."""
        least = float((self.ridge / self.whole).min())
        return self.norm / least if least > 0 else math.inf

    def escalated(self, most: float | None, condition: float, reason: str) -> Solution:
        figure = f"{self.name} + I/C at penalty={self.penalty:g} has condition {condition:.1e}"
        if math.isinf(condition):
            figure = f"{self.name} + I/C at penalty={self.penalty:g}: {reason}"
        if self.eps > _EPS:
            wanted = "make it in float64, or lower the penalty"
            raise ValueError(f"{figure}, too much for a matrix in {self.dtype}; {wanted}")
        if most is not None:
            raise ValueError(f"{figure}, wanted up to {most:.0e}; lower the penalty")
        if self.noise > 0:
            wanted = "lower the penalty, or make it exactly"
            raise ValueError(f"{figure}, too much for its error of {self.noise:.0e}; {wanted}")
        log.warning("%s, too much for a plain Cholesky in float64", figure)
        solution = self.by_refinement(condition)
        if solution is None:
            solution = self.by_eigen()
        log.warning("%s: solved by %s", self.name, solution.report)
        return solution

    def reset(self) -> None:
        """The system as it was given, without its ridge, in both triangles."""
        (self.restore or from_above)(self.matrix)
        if self.restore not in (None, from_above):
            mirror_(self.matrix)
        self.matrix.diagonal().copy_(self.bare)

    def by_refinement(self, condition: float) -> Solution | None:
        """From the factor of a jittered system; none if that does not tell."""
        for jitter in _JITTERS:
            self.reset()
            more = jitter * float((self.whole / self.ridge).max())  # more ridge, so of its shape
            if not math.isfinite(more):
                return None
            self.matrix.diagonal().copy_(self.whole + more * self.ridge)
            try:
                cholesky_(self.matrix)
            except ValueError:
                continue
            x, steps, residual = refine(self.matrix, self.whole, self.right)
            least = torch.linalg.vector_norm(self.right / self.scale)
            rounding = _EPS * self.norm * float(torch.linalg.vector_norm(self.scale * x) / least)
            if residual > _ENOUGH or not rounding <= _ENOUGH:
                return None
            inverse = inverse_norm(self.matrix, self.scale)
            error = max(rounding, residual, _EPS * self.norm * inverse)
            report = self.report("jittered", min(condition, self.norm / _EPS), error, len(x))
            return Solution(x, replace(report, jitter=jitter, refinements=steps, residual=residual))
        return None

    def by_eigen(self) -> Solution:
        """Without the components that are rounding noise."""
        check_light(self.bare, self.weights, self.penalty, self.given, self.name)
        if not math.isinf(self.penalty):
            self.reset()
        roots = self.weights.sqrt()
        self.matrix.mul_(roots).mul_(roots[:, None])
        terms = self.right, roots, self.penalty, self.given
        more = partial(truncated, noise=self.noise, in_span=self.in_span, name=self.name)
        found: list[tuple[Tensor, float, float, float, int]] = []
        for_each(lambda matrix: found.append(more(matrix, *terms)), [self.matrix])  # for the bits
        x, condition, error, left_out, rank = found[0]
        report = self.report("eigen", condition, max(error, left_out), rank)
        report = replace(report, left_out=left_out)
        if math.isinf(self.penalty) and left_out > LARGEST_ERROR:
            log.warning("%s: solved by %s", self.name, report)
        return Solution(x, report)

    def report(self, method: Method, condition: float, error: float, rank: int) -> SolveReport:
        bound, size = self.bound(), len(self.right)
        known = bound if math.isfinite(bound) else None
        return SolveReport(method, self.dtype, size, self.penalty, condition, known, rank, error)
