"""The degree-2 kernel machine as what it is: a quadratic form (REFERENCE.md section 5).

``sum_i beta_i (z_i . z + c)^2 = z' Q z + l' z + a`` with ``Q = Z' diag(beta) Z``,
``l = 2 c Z' beta`` and ``a = c^2 sum(beta)``: exact, and of one size whatever the number of
training bins. Degree 1 likewise, with ``Q = 0`` (not stored), ``l = Z' beta``, ``a = c sum(beta)``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from tactslip_torch.model.kernels import PAPER_KERNEL, Cost, Kernel, Polynomial, Solved


class QuadraticForm(nn.Module):
    """``z' Q z + l' z + a``.

    Args:
        quadratic: ``[K, K]``, symmetric; of a linear machine empty, ``[0, 0]``.
        linear: ``[K]``.
        constant: a scalar tensor.

    Attributes:
        solved: how its numbers were solved for; ``None`` if read from a file or made by hand.

    Raises:
        ValueError: if shapes disagree.
    """

    quadratic: Tensor
    linear: Tensor
    constant: Tensor

    def __init__(self, quadratic: Tensor, linear: Tensor, constant: Tensor) -> None:
        super().__init__()
        self.solved: Solved | None = None
        num = linear.shape[-1]
        is_known = quadratic.shape in ((num, num), (0, 0))
        if not is_known or linear.shape != (num,) or constant.shape != ():
            raise ValueError(
                "expected quadratic [K, K] or [0, 0], linear [K] and a scalar constant, got "
                f"{tuple(quadratic.shape)}, {tuple(linear.shape)} and {tuple(constant.shape)}"
            )
        self.register_buffer("quadratic", quadratic.clone())
        self.register_buffer("linear", linear.clone())
        self.register_buffer("constant", constant.clone())

    @property
    def num_features(self) -> int:
        """How many features it takes."""
        return self.linear.shape[-1]

    @property
    def is_linear(self) -> bool:
        """Whether there is no quadratic part, as of degree 1."""
        return self.quadratic.numel() == 0

    @property
    def dense_quadratic(self) -> Tensor:
        """``Q``, ``[K, K]``, of a linear machine too."""
        num = self.num_features
        return self.linear.new_zeros(num, num) if self.is_linear else self.quadratic

    @property
    def cost(self) -> Cost:
        """Multiply-adds a bin and bytes, whatever the number of training bins."""
        num_values = self.num_features + self.quadratic.numel()
        return Cost(num_values, (num_values + 1) * self.linear.element_size())

    def forward(self, z: Tensor) -> Tensor:
        """The score.

        Shape:
            - z: ``[*, K]``
            - output: ``[*]``
        """
        if self.is_linear:
            linear: Tensor = torch.linalg.vecdot(self.linear, z) + self.constant
            return linear
        pull = nn.functional.linear(z, self.quadratic, self.linear)  # as few calls as can be
        score: Tensor = torch.linalg.vecdot(pull, z) + self.constant
        return score


def collapse(support: Tensor, beta: Tensor, kernel: Kernel = PAPER_KERNEL) -> QuadraticForm:
    """Fold a kernel sum of degree 1 or 2 into its quadratic form.

    Sums and result are in float64 whatever comes in: the terms are many and cancel. Differentiable
    in both tensors.

    Args:
        support: scaled training bins.
        beta: their output weights.
        kernel: a polynomial of degree 1 or 2.

    Shape:
        - support: ``[N, K]``
        - beta: ``[N]``

    Raises:
        ValueError: for a kernel that does not fold.
    """
    if not isinstance(kernel, Polynomial) or not kernel.collapses:
        raise ValueError(
            f"{kernel} does not fold into a quadratic form, polynomials of degree 1 and 2 do; "
            "keep the sum as a KernelSum"
        )
    support, beta = support.double(), beta.double()
    pull, total = support.mT @ beta, beta.sum()
    if kernel.degree == 1:
        return QuadraticForm(support.new_zeros(0, 0), pull, kernel.offset * total)
    bend = support.mT @ (support * beta[:, None])
    return QuadraticForm(bend, 2 * kernel.offset * pull, kernel.offset**2 * total)


def num_quadratic_features(num_features: int) -> int:
    """Number of monomials up to degree 2: 7381 for 120 features."""
    return (num_features + 1) * (num_features + 2) // 2


def quadratic_features(z: Tensor, offset: float = 0.5) -> Tensor:
    """The explicit feature map of the degree-2 kernel: ``phi(a) . phi(b) = (a . b + offset)^2``.

    Order: ``z_i z_j`` for i <= j row by row (those with i < j times sqrt 2), then
    ``sqrt(2 offset) z``, then ``offset``.

    Shape:
        - z: ``[N, K]``
        - output: ``[N, (K + 1)(K + 2) / 2]``
    """
    num = z.shape[-1]
    squares = [
        torch.cat([z[:, i : i + 1], math.sqrt(2) * z[:, i + 1 :]], dim=-1) * z[:, i : i + 1]
        for i in range(num)
    ]
    last = torch.full_like(z[:, :1], offset)
    return torch.cat([*squares, math.sqrt(2 * offset) * z, last], dim=-1)


def sum_of_quadratic_features(z: Tensor, beta: Tensor, offset: float = 0.5) -> Tensor:
    """``quadratic_features(z, offset).mT @ beta`` without making them.

    Shape:
        - z: ``[N, K]``; beta: ``[N]``
        - output: ``[(K + 1)(K + 2) / 2]``
    """
    num = z.shape[-1]
    rows, columns = torch.triu_indices(num, num, device=z.device)
    squares = (z.mT @ (z * beta[:, None]))[rows, columns]
    squares = torch.where(rows == columns, squares, math.sqrt(2) * squares)
    linear = math.sqrt(2 * offset) * (z.mT @ beta)
    return torch.cat([squares, linear, offset * beta.sum()[None]])


def from_primal(weights: Tensor, num_features: int, offset: float = 0.5) -> QuadraticForm:
    """The quadratic form that weights of ``quadratic_features`` stand for.

    Shape:
        - weights: ``[(K + 1)(K + 2) / 2]``

    Raises:
        ValueError: if the number of weights is another.
    """
    if weights.shape != (num_quadratic_features(num_features),):
        raise ValueError(
            f"expected {num_quadratic_features(num_features)} weights for {num_features} "
            f"features, got {tuple(weights.shape)}"
        )
    rows, columns = torch.triu_indices(num_features, num_features)
    upper = weights.new_zeros(num_features, num_features)
    upper[rows, columns] = weights[: len(rows)] * math.sqrt(0.5)
    upper.diagonal().mul_(math.sqrt(0.5))
    linear = weights[len(rows) : -1] * math.sqrt(2 * offset)
    return QuadraticForm(upper + upper.T, linear, weights[-1] * offset)
