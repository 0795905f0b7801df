"""Held-out residuals of large groups in the primal, by conjugate gradients on one factor.

Without a group's bins the normal matrix is ``A - B B'`` with ``B = Phi_g' W_g^1/2``, and a factor
of that costs a fit. But the residuals ``e`` that the machine without the group leaves on the
group's bins obey ``(I - B' A^-1 B) W^1/2 e = W^1/2 (t - Phi v)`` with ``v`` and ``A = L L'`` those
of all bins. The matrix is symmetric with eigenvalues in (0, 1]; applying it takes two triangular
solves, which all groups share, and a quadratic form on the group's features.

Reference:
    Golub and Van Loan, Matrix Computations, 4th ed., sections 11.3.3 (conjugate gradients) and
    10.1.2 (their coefficients are those of a Lanczos matrix, hence the smallest eigenvalue).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_solve
from tactslip_torch.model.fourth_moments import ProductSums, add_products_, normal_matrix
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    from_primal,
    num_quadratic_features,
    quadratic_features,
    sum_of_quadratic_features,
)
from tactslip_torch.threads import for_each

MOST_ITERATIONS = 600
TOLERANCE = 1e-9  # of the residuals, in units of the targets
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
        alpha = square / float((self.direction * image).sum())
        self.found.add_(self.direction, alpha=alpha)
        self.rest.sub_(image, alpha=alpha)
        beta = float(self.rest.square().sum()) / square
        self.direction.mul_(beta).add_(self.rest)
        self.steps.append((alpha, beta))

    def is_done(self) -> bool:
        """Whether the error, at most ``|rest|`` over the smallest eigenvalue, is small enough.

        The smallest eigenvalue is that of the tridiagonal matrix of the steps so far. It lies
        above ``least`` if and only if every pivot of that matrix less ``least`` is positive.
        """
        least = max(float(self.rest.norm()) / TOLERANCE, LEAST_EIGENVALUE)
        if not least < 1:
            return False
        pivot, link, square = 1.0, 0.0, 0.0
        for alpha, beta in self.steps:
            pivot = 1 / alpha + link - least - square / pivot
            if not pivot > 0:
                return False
            link, square = beta / alpha, beta / alpha**2
        return True


def residuals_without_groups(
    factor: Tensor,
    monomials: Monomials,
    z: Tensor,
    roots: Tensor,
    right: Tensor,
    groups: Sequence[tuple[int, int]],
) -> Tensor:
    """``(I - B' A^-1 B)^-1 right`` for each of several groups of bins.

    The error of each is at most ``TOLERANCE``, beyond what the rounding of ``L`` brings.

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
        ValueError: if a group (named) takes too many iterations.
    """
    sizes = [size for _, size in groups]
    parts = zip(*(x.split(sizes) for x in (z, roots, right)), strict=True)
    descents = [_Descent(part, root, rest.clone()) for part, root, rest in parts]
    going = list(range(len(groups)))
    for _ in range(MOST_ITERATIONS):
        going = [index for index in going if not descents[index].is_done()]
        if not going:
            break
        _step(factor, monomials, [descents[index] for index in going])
    else:
        raise untold(groups[going[0]][0])
    return torch.cat([descent.found for descent in descents])


def untold(name: int) -> ValueError:
    """The error for a group whose bins are almost alone in what they tell."""
    return ValueError(
        f"the machine without group {name} is too far from the machine of all bins to be told "
        "from it in float64; lower the penalty, or refit without the group"
    )


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
