"""Held-out residuals in the primal from the factor of all bins: by blocks, or by iteration.

Without a group's bins the normal matrix is ``A - B B'`` with ``B = Phi_g' W_g^1/2``, and a factor
of that costs a fit. But the residuals ``e`` that the machine without the group leaves on the
group's bins obey ``(I - B' A^-1 B) W^1/2 e = W^1/2 (t - Phi v)`` with ``v`` and ``A = L L'`` those
of all bins. The matrix is symmetric with eigenvalues in (0, 1]. For a small group it is formed and
factorised. For large ones conjugate gradients need its products alone: two triangular solves,
which all groups share, a quadratic form of the group's features, and its transpose.

Reference:
    Golub and Van Loan, Matrix Computations, 4th ed., sections 11.3 (conjugate gradients) and 10.1
    (Lanczos: their steps tell the smallest eigenvalue).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_, cholesky_solve
from tactslip_torch.model.fourth_moments import ProductSums, add_products_, normal_matrix
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    from_primal,
    num_quadratic_features,
    quadratic_features,
    sum_of_quadratic_features,
)
from tactslip_torch.runtime import for_each

MOST_ITERATIONS = 600
TOLERANCE = 1e-9  # of the residuals, in units of the targets
_PROBE_TOLERANCE = 0.03  # well below what a random vector has of any eigenvector
LEAST_EIGENVALUE = 1e-6  # below, the rounding of the factor shows in the scores


@dataclass(frozen=True)
class Monomials:
    """The explicit features of a polynomial kernel of degree 1 or 2, and sums over them.

    Args:
        kernel: its degree is 1 or 2.
        num_features: K.
    """

    kernel: Polynomial
    num_features: int

    @property
    def number(self) -> int:
        """How many there are: P."""
        if self.kernel.degree == 1:
            return self.num_features + 1
        return num_quadratic_features(self.num_features)

    def of(self, z: Tensor) -> Tensor:
        """The monomials of bins.

        Shape:
            - z: ``[N, K]``; output: ``[N, P]``
        """
        if self.kernel.degree == 2:
            return quadratic_features(z, self.kernel.offset)
        return torch.cat([z, torch.full_like(z[:, :1], math.sqrt(self.kernel.offset))], dim=-1)

    def gather(self, z: Tensor, shares: Tensor) -> Tensor:
        """``of(z)' shares``, without the monomials.

        Shape:
            - z: ``[N, K]``; shares: ``[N]``; output: ``[P]``
        """
        if self.kernel.degree == 2:
            return sum_of_quadratic_features(z, shares, self.kernel.offset)
        total = math.sqrt(self.kernel.offset) * shares.sum()
        return torch.cat([z.mT @ shares, total[None]])

    def normal_matrix(self, z: Tensor, weights: Tensor) -> Tensor:
        """``of(z)' diag(weights) of(z)``.

        Shape:
            - z: ``[N, K]``; weights: ``[N]``; output: ``[P, P]``
        """
        if self.kernel.degree == 1:
            monomials = self.of(z)
            return monomials.mT @ (monomials * weights[:, None])
        total = z.new_zeros(ProductSums(self.num_features).num_held)
        add_products_(total, z, weights)
        return normal_matrix(total, self.num_features, self.kernel.offset)

    def head(self, weights: Tensor) -> QuadraticForm:
        """The machine that weights of the monomials stand for.

        Shape:
            - weights: ``[P]``
        """
        if self.kernel.degree == 2:
            return from_primal(weights, self.num_features, self.kernel.offset)
        flat = weights.new_zeros(self.num_features, self.num_features)
        return QuadraticForm(flat, weights[:-1], math.sqrt(self.kernel.offset) * weights[-1])


@dataclass
class _Descent:
    """Conjugate gradients of one group, between two solves."""

    z: Tensor
    root: Tensor  # of the weights
    rest: Tensor  # what is still to be explained
    enough: float  # error of the solution that is
    direction: Tensor = field(init=False)
    found: Tensor = field(init=False)
    steps: list[tuple[float, float]] = field(default_factory=list)  # alpha and beta of each

    def __post_init__(self) -> None:
        self.direction, self.found = self.rest.clone(), torch.zeros_like(self.rest)

    def ask(self, monomials: Monomials) -> Tensor:
        """``B direction``."""
        return monomials.gather(self.z, self.root * self.direction)

    def take(self, monomials: Monomials, answer: Tensor) -> None:
        """One step, given ``A^-1 B direction``."""
        image = self.direction - self.root * monomials.head(answer)(self.z)
        square = float(self.rest.square().sum())
        curve = float((self.direction * image).sum())
        alpha = square / curve if curve > 0 else math.nan  # the matrix is singular in float64
        self.found.add_(self.direction, alpha=alpha)
        self.rest.sub_(image, alpha=alpha)
        beta = float(self.rest.square().sum()) / square
        self.direction.mul_(beta).add_(self.rest)
        self.steps.append((alpha, beta))

    def is_done(self) -> bool:
        """Whether the error, at most ``|rest|`` over the smallest eigenvalue, is small enough."""
        return bool(self.steps) and self.is_above(float(self.rest.norm()) / self.enough)

    def is_above(self, least: float) -> bool:
        """Whether the smallest eigenvalue, as far as the steps tell, is larger than ``least``.

        They make a tridiagonal matrix, whose smallest eigenvalue falls to that of the group. It
        is larger if and only if every pivot of the matrix less ``least`` is positive.
        """
        pivot, link, square = 1.0, 0.0, 0.0
        for alpha, beta in self.steps:
            pivot = 1 / alpha + link - least - square / pivot
            if not pivot > 0:
                return False
            link, square = beta / alpha, beta / alpha**2
        return True


def residuals_by_block(left: Tensor, right: Tensor, groups: Sequence[tuple[int, int]]) -> Tensor:
    """``left^-1 right``, with the matrices ``I - B' A^-1 B`` of small groups along the diagonal.

    Args:
        left: 0 between groups; only its lower triangle is read.
        right: as in ``residuals_by_iteration``.
        groups: likewise.

    Shape:
        - left: ``[n, n]``; right, output: ``[n]``

    Raises:
        ValueError: if a group (named) leaves too little.
    """
    factor = left.clone()
    try:
        cholesky_(factor)
        low = factor.diagonal().square() < LEAST_EIGENVALUE
    except ValueError:
        row = max(int(torch.linalg.cholesky_ex(left).info) - 1, 0)
        low = torch.arange(len(left)) == row
    if bool(low.any()):
        ends = torch.tensor([size for _, size in groups]).cumsum(0)
        raise _untold(groups[int((ends <= low.nonzero()[0]).sum())][0])
    return cholesky_solve(factor, right)


def residuals_by_iteration(
    factor: Tensor,
    monomials: Monomials,
    z: Tensor,
    roots: Tensor,
    right: Tensor,
    groups: Sequence[tuple[int, int]],
) -> Tensor:
    """``(I - B' A^-1 B)^-1 right`` for each of several groups of bins.

    The error of each is at most ``TOLERANCE``, beyond what the rounding of ``L`` brings. What the
    eigenvectors of tiny eigenvalues are to ``right`` is as tiny, so that it may not show them; a
    random vector beside does.

    Args:
        factor: ``L`` of the normal matrix of all bins.
        monomials: of the kernel.
        z: features of the groups' bins, one group after the other.
        roots: square roots of their weights.
        right: the same roots times the residuals of the machine of all bins.
        groups: name and number of bins of each group.

    Shape:
        - factor: ``[P, P]``; z: ``[N, K]``; roots, right, output: ``[N]``

    Raises:
        ValueError: if a group (named) leaves too little, or takes too many iterations.
    """
    sizes = [size for _, size in groups]
    draws = torch.randn(right.shape, generator=torch.Generator().manual_seed(0), dtype=right.dtype)
    enough = TOLERANCE * min(1.0, float(roots.min()))
    descents = []
    for start, tolerance in ((right, enough), (draws, _PROBE_TOLERANCE)):
        parts = zip(z.split(sizes), roots.split(sizes), start.clone().split(sizes), strict=True)
        descents += [_Descent(own, root, rest, tolerance) for own, root, rest in parts]
    going = list(zip(descents, [*groups, *groups], strict=True))
    for _ in range(MOST_ITERATIONS):
        _step(factor, monomials, [descent for descent, _ in going])
        for descent, (name, _) in going:
            if not descent.is_above(LEAST_EIGENVALUE):
                raise _untold(name)
        going = [(descent, group) for descent, group in going if not descent.is_done()]
        if not going:
            return torch.cat([descent.found for descent in descents[: len(groups)]])
    raise _untold(going[0][1][0])


def _step(factor: Tensor, monomials: Monomials, descents: Sequence[_Descent]) -> None:
    """One iteration of several groups, which share the two triangular solves."""
    asked = factor.new_empty(len(descents), len(factor))

    def ask(index: int) -> None:
        asked[index] = descents[index].ask(monomials)

    def take(index: int) -> None:
        descents[index].take(monomials, answers[:, index])

    for_each(ask, range(len(descents)))
    answers = cholesky_solve(factor, asked.mT)
    for_each(take, range(len(descents)))


def _untold(name: int) -> ValueError:
    """The error for a group whose bins are almost alone in what they tell."""
    return ValueError(
        f"the machine without group {name} is too far from the machine of all bins to be told "
        "from it in float64; lower the penalty, or refit without the group"
    )
