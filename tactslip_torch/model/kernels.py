"""Kernels: how alike two bins are. Which of them fold into a quadratic form, and what heads cost.

The paper's is the polynomial of degree 2 (section IV-E). Polynomials of degree 1 and 2 in K
features have few monomials, so their sum over the training bins folds into one quadratic form of
fixed size (``quadratic``); the others keep every training bin (``kernel_sum``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

_GRAM_ROWS = 512


@dataclass(frozen=True)
class Polynomial:
    """``(a . b + offset) ** degree``; differentiable in both.

    Args:
        degree: at least 1.
        offset: the paper's ``c``, at least 0.

    Raises:
        ValueError: if one of them is outside that.
    """

    degree: int = 2
    offset: float = 0.5

    def __post_init__(self) -> None:
        if not (self.degree >= 1 and self.degree % 1 == 0):
            raise ValueError(
                f"degree of the kernel must be a whole number, at least 1, got {self.degree}"
            )
        if not 0 <= self.offset < math.inf:
            raise ValueError(
                f"offset (the paper's c) must be finite and at least 0, got {self.offset}"
            )

    @property
    def collapses(self) -> bool:
        """Whether a sum of them is a quadratic form of its argument."""
        return self.degree <= 2

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Kernel matrix.

        Shape:
            - a: ``[*, N, K]``; b: ``[*, M, K]``; output: ``[*, N, M]``
        """
        gram: Tensor = (a @ b.mT + self.offset) ** self.degree
        return gram

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; ``kernel_from_dict`` takes it."""
        return {"kind": "polynomial", **asdict(self)}


@dataclass(frozen=True)
class RadialBasis:
    """``exp(-gamma |a - b|^2)``; differentiable in both, at ``a = b`` as well.

    Squared distances come from squares and products, so they carry an error of some
    ``eps (|a|^2 + |b|^2)``, which scaled features keep small; none is negative.

    Args:
        gamma: positive; in units of 1 / squared scaled feature.

    Raises:
        ValueError: if it is not positive.
    """

    gamma: float

    def __post_init__(self) -> None:
        if not 0 < self.gamma < math.inf:
            raise ValueError(f"gamma of the kernel must be positive and finite, got {self.gamma}")

    @property
    def collapses(self) -> bool:
        """Never: the exponential has every degree."""
        return False

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Kernel matrix.

        Shape:
            - a: ``[*, N, K]``; b: ``[*, M, K]``; output: ``[*, N, M]``
        """
        norms = a.square().sum(-1)[..., :, None] + b.square().sum(-1)[..., None, :]
        squares = norms - 2 * (a @ b.mT)
        squares = squares - squares.detach().clamp(max=0)  # at least 0, and gradients stay whole
        return torch.exp(-self.gamma * squares)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; ``kernel_from_dict`` takes it."""
        return {"kind": "radial basis", **asdict(self)}


Kernel = Polynomial | RadialBasis
PAPER_KERNEL = Polynomial(degree=2, offset=0.5)

_KINDS: dict[str, type[Polynomial] | type[RadialBasis]] = {
    "polynomial": Polynomial,
    "radial basis": RadialBasis,
}


def kernel_from_dict(values: Mapping[str, Any]) -> Kernel:
    """The kernel that ``to_dict`` described.

    Raises:
        ValueError: if the kind is unknown or its numbers are not those it has.

    Example:
        >>> kernel_from_dict({"kind": "polynomial", "degree": 3, "offset": 1.0})
        Polynomial(degree=3, offset=1.0)
    """
    numbers = {name: value for name, value in values.items() if name != "kind"}
    kind = _KINDS.get(str(values.get("kind")))
    if kind is None:
        raise ValueError(
            f"kind of the kernel must be one of {', '.join(_KINDS)}, got {values.get('kind')!r}"
        )
    try:
        return kind(**numbers)
    except TypeError as error:
        raise ValueError(f"{numbers} does not describe a {values['kind']} kernel") from error


def lower_gram(kernel: Kernel, z: Tensor, out: Tensor | None = None) -> Tensor:
    """Kernel matrix of bins with themselves, for a Cholesky: only its lower triangle is filled.

    ``kernel(z, z)`` needs two more matrices of that size on the way; this needs none. Not
    differentiable.

    Args:
        kernel: of the machine.
        z: the bins.
        out: write it here instead, where it need not be 0.

    Shape:
        - z: ``[N, K]``; output: ``[N, N]``, above the diagonal what was there or the kernel
    """
    gram = z.new_zeros(len(z), len(z)) if out is None else out
    with torch.no_grad():
        for start in range(0, len(z), _GRAM_ROWS):
            end = start + _GRAM_ROWS
            gram[start:end, :end] = kernel(z[start:end], z[:end])
    return gram


class Solved(Protocol):
    """What a head remembers of the solve it comes from; ``SolveReport`` is one."""

    @property
    def condition(self) -> float:
        """Of the system."""

    def facts(self) -> dict[str, Any]:
        """JSON-able."""


class Cost(NamedTuple):
    """What a head costs: multiply-adds to score one bin, and bytes to keep.

    Powers and exponentials are not counted.
    """

    multiply_adds: int
    num_bytes: int

    def __str__(self) -> str:
        return (
            f"{self.multiply_adds / 1000:.1f} k multiply-adds a bin and "
            f"{self.num_bytes / 1000:.1f} kB"
        )
