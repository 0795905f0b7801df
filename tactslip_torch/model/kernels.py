"""The kernel, its explicit features, and the quadratic form that a sum over bins becomes.

The paper's is the polynomial of degree 2 (section IV-E). Polynomials of degree 1 and 2 in K
features have few monomials, so the sum over the training bins folds into one quadratic form of
fixed size: of degree 2 ``sum_i beta_i (z_i . z + c)^2 = z' Q z + l' z + a`` with
``Q = Z' diag(beta) Z``, ``l = 2 c Z' beta`` and ``a = c^2 sum(beta)``; of degree 1 with ``Q = 0``
(not stored), ``l = Z' beta`` and ``a = c sum(beta)``.

``ProductSums`` are what the primal solve needs of the bins. Degree 1: sums of products of two of
the ``K + 1`` variables ``(1, z_1, .., z_K)``. Degree 2: an entry of the Gram matrix of the
monomials is a sum of products of four of them, and there are only ``C(K + 4, 4)`` of those: 9.4
million for 120 features, where the triangle of the matrix has 27.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Polynomial:
    """``(a . b + offset) ** degree``; differentiable in both.

    Args:
        degree: 1 or 2.
        offset: the paper's ``c``, at least 0.

    Raises:
        ValueError: if one of them is outside that.
    """

    degree: int = 2
    offset: float = 0.5

    def __post_init__(self) -> None:
        if self.degree not in (1, 2):
            raise ValueError(f"degree of the kernel must be 1 or 2, got {self.degree}")
        if not 0 <= self.offset < math.inf:
            raise ValueError(
                f"offset (the paper's c) must be finite and at least 0, got {self.offset}"
            )

    def __call__(self, a: Tensor, b: Tensor) -> Tensor:
        """Kernel matrix.

        Shape:
            - a: ``[*, N, K]``; b: ``[*, M, K]``; output: ``[*, N, M]``
        """
        gram: Tensor = (a @ b.mT + self.offset) ** self.degree
        return gram

    def num_monomials(self, num_features: int) -> int:
        """Number of explicit features, ``P``: of degree 2 and 120 features 7381."""
        return math.comb(num_features + self.degree, self.degree)

    def scale(self, num_features: int) -> Tensor:
        """What each monomial is multiplied with, so that the map gives the kernel: ``[P]``."""
        c, (first, second) = (
            torch.as_tensor(self.offset, dtype=torch.float64),
            self._pairs(num_features),
        )
        one = torch.ones_like(c)
        factors = [c.sqrt(), one] if self.degree == 1 else [c, (2 * c).sqrt(), one * math.sqrt(2)]
        of_each = torch.stack(factors)[(first > 0).long() + (second > 0)]
        return torch.where((first == second) & (first > 0), 1.0, of_each)

    def monomials(self, z: Tensor) -> Tensor:
        """The explicit feature map: ``phi(a) . phi(b)`` is the kernel.

        Of degree 1 the variables ``(1, z_1, .., z_K)``, of degree 2 the products of pairs of them,
        row by row: the constant, the features, then ``z_i z_j`` for i <= j. Each times its scale.

        Shape:
            - z: ``[N, K]``
            - output: ``[N, P]``, float64
        """
        variables, (first, second) = _with_one(z), self._pairs(z.shape[-1])
        return variables[:, first] * variables[:, second] * self.scale(z.shape[-1])

    def sum_of_monomials(self, z: Tensor, shares: Tensor) -> Tensor:
        """``monomials(z).mT @ shares`` without making them.

        Shape:
            - z: ``[N, K]``; shares: ``[N]``; output: ``[P]``, float64
        """
        variables = _with_one(z)
        if self.degree == 1:
            products = (shares @ variables)[None]
        else:
            products = variables.mT @ (variables * shares[:, None])
        return products[*self._pairs(z.shape[-1])] * self.scale(z.shape[-1])

    def head(self, weights: Tensor, num_features: int) -> QuadraticForm:
        """The quadratic form that weights of ``monomials`` stand for.

        Shape:
            - weights: ``[P]``

        Raises:
            ValueError: if the number of weights is another.
        """
        wanted = self.num_monomials(num_features)
        if weights.shape != (wanted,):
            raise ValueError(
                f"expected {wanted} weights for {num_features} features, got {tuple(weights.shape)}"
            )
        scaled = weights * self.scale(num_features)
        if self.degree == 1:
            return QuadraticForm(scaled.new_zeros(0, 0), scaled[1:], scaled[0])
        upper = scaled.new_zeros(num_features + 1, num_features + 1)
        upper = upper.index_put(self._pairs(num_features), scaled)
        squares = upper[1:, 1:]
        return QuadraticForm((squares + squares.mT) / 2, upper[0, 1:], upper[0, 0])

    def sums(self, z: Tensor, weights: Tensor) -> Tensor:
        """``X' W X`` of the monomials of bins, by way of the sums that are distinct.

        Shape:
            - z: ``[N, K]``; weights: ``[N]``; output: ``[P, P]``, all float64
        """
        layout = ProductSums(z.shape[1], self.degree)
        total = z.new_zeros(layout.num_held)
        layout.add_(total, z, weights)
        return layout.normal_matrix(total, self.scale(z.shape[1]))

    def _pairs(self, num_features: int) -> tuple[Tensor, Tensor]:
        """The two variables of each monomial, of which 0 is the constant 1."""
        if self.degree == 1:
            second = torch.arange(num_features + 1)
            return torch.zeros_like(second), second
        first, second = torch.triu_indices(num_features + 1, num_features + 1)
        return first, second

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; ``kernel_from_dict`` takes it."""
        return {"kind": "polynomial", **asdict(self)}


def _with_one(z: Tensor) -> Tensor:
    """The variables ``(1, z_1, .., z_K)`` of bins."""
    return torch.cat([torch.ones_like(z[:, :1]), z], dim=-1)


PAPER_KERNEL = Polynomial(degree=2, offset=0.5)


def kernel_from_dict(values: Mapping[str, Any]) -> Polynomial:
    """The kernel that ``to_dict`` described.

    Raises:
        ValueError: if the kind is unknown or its numbers are not those it has.

    Example:
        >>> kernel_from_dict({"kind": "polynomial", "degree": 1, "offset": 1.0})
        Polynomial(degree=1, offset=1.0)
    """
    numbers = dict(values)
    kind = numbers.pop("kind", None)
    if kind != "polynomial":
        raise ValueError(f"kind of the kernel must be polynomial, got {kind!r}")
    try:
        return Polynomial(**numbers)
    except TypeError as error:
        raise ValueError(f"{numbers} does not describe a polynomial kernel") from error


# Heads -------------------------------------------------------------------------------------------


class _Cost(NamedTuple):
    """What a head costs: multiply-adds to score one bin, and bytes to keep.

    Powers are not counted.
    """

    multiply_adds: int
    num_bytes: int


@dataclass(frozen=True)
class SolveReport:
    """How a system was solved, and how far rounding may reach.

    Attributes:
        method: by which factorisation.
        size: number of unknowns.
        penalty: the paper's ``C``.
        condition: of the components kept; for ``"cholesky"`` an estimate, of the system scaled to a
            diagonal of ones.
        rank: components kept; all but for ``"pinv"``.
        error: of the scores of training bins relative to the targets, in the mean square by weight,
            to first order in the rounding of the matrix. For ``"pinv"`` it counts what the
            components left out could add: nothing if they are null, as those of duplicates are.
    """

    method: Literal["cholesky", "pinv"]
    size: int
    penalty: float
    condition: float
    rank: int
    error: float

    def metadata(self) -> dict[str, Any]:
        """All of it as JSON holds it; an infinite number is the string ``"inf"``."""
        return {
            name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in asdict(self).items()
        }

    def __str__(self) -> str:
        kept = f", {self.rank} of them kept" if self.rank < self.size else ""
        return (
            f"{self.method} of {self.size} unknowns at C={self.penalty:g}{kept}: condition "
            f"{self.condition:.1e}, relative error of training scores up to {self.error:.0e}"
            f"{', unless what is left out is null' if self.rank < self.size else ''}"
        )


class QuadraticForm(nn.Module):
    """``x' Q x + l' z + a``, with the first ``m`` of the K features ``z`` in ``x``.

    With signs ``Q`` is given by factors, and ``x' Q x`` is ``sum_k signs_k (F_k . x)^2``; a form
    of low rank is then scored and stored in ``r (m + 1)`` numbers.

    Args:
        quadratic: ``Q [m, m]``, symmetric, or the factors ``F [r, m]``; of a linear machine empty,
            ``[0, 0]``.
        linear: ``[K]``.
        constant: a scalar tensor.
        signs: ``[r]``, 1 or -1; ``None``: there are none.

    Attributes:
        solved: how its numbers were solved for; ``None`` if read from a file or made by hand.

    Raises:
        ValueError: if shapes disagree, or a sign is neither 1 nor -1.
    """

    quadratic: Tensor
    linear: Tensor
    constant: Tensor
    signs: Tensor | None

    def __init__(
        self, quadratic: Tensor, linear: Tensor, constant: Tensor, signs: Tensor | None = None
    ) -> None:
        super().__init__()
        self.solved: SolveReport | None = None
        num = quadratic.shape[-1] if quadratic.ndim else -1
        rows = num if signs is None else signs.numel()
        is_known = quadratic.shape == (rows, num) and linear.ndim == 1 and num <= len(linear)
        if not is_known or constant.shape != () or (signs is not None and signs.ndim != 1):
            wanted = "[m, m]" if signs is None else "[r, m], signs [r]"
            given = (quadratic, *(() if signs is None else (signs,)), linear)
            raise ValueError(
                f"expected quadratic {wanted}, linear [K], m at most K, and a scalar constant, got "
                f"{', '.join(str(tuple(x.shape)) for x in given)} and {tuple(constant.shape)}"
            )
        if signs is not None and bool((is_other := signs.abs() != 1).any()):
            raise ValueError(f"signs of factors must be 1 or -1, got {signs[is_other][0]:g}")
        self.register_buffer("quadratic", quadratic.clone())
        self.register_buffer("linear", linear.clone())
        self.register_buffer("constant", constant.clone())
        self.register_buffer("signs", None if signs is None else signs.to(quadratic, copy=True))

    @property
    def num_features(self) -> int:
        """How many features it takes."""
        return self.linear.shape[-1]

    @property
    def is_linear(self) -> bool:
        """Whether there is no quadratic part, as of degree 1."""
        return self.quadratic.numel() == 0

    @property
    def matrix(self) -> Tensor:
        """``Q``, of factors their sum: ``[m, m]``."""
        if self.signs is None:
            return self.quadratic
        return self.quadratic.mT @ (self.quadratic * self.signs[:, None])

    @property
    def cost(self) -> _Cost:
        """Multiply-adds a bin and bytes, whatever the number of training bins.

        The native engine multiplies one triangle of a symmetric ``Q``; a file keeps it whole.
        """
        num_values, num = self.num_features + self.quadratic.numel(), len(self.quadratic)
        num_values += 0 if self.signs is None else len(self.signs)
        products = num_values - (num * (num - 1) // 2 if self.signs is None else 0)
        return _Cost(products, (num_values + 1) * self.linear.element_size())

    def forward(self, z: Tensor) -> Tensor:
        """The score.

        Shape:
            - z: ``[*, K]``
            - output: ``[*]``
        """
        num = self.quadratic.shape[-1]
        if self.signs is None and num == self.num_features:
            pull = nn.functional.linear(z, self.quadratic, self.linear)  # as few calls as can be
            whole: Tensor = torch.linalg.vecdot(pull, z) + self.constant
            return whole
        score: Tensor = torch.linalg.vecdot(self.linear, z) + self.constant
        if not self.is_linear:
            first = z[..., :num]
            pull = nn.functional.linear(first, self.quadratic)
            other = first if self.signs is None else pull * self.signs
            score = score + torch.linalg.vecdot(pull, other)
        return score


def collapse(support: Tensor, beta: Tensor, kernel: Polynomial = PAPER_KERNEL) -> QuadraticForm:
    """Fold ``sum_i beta_i kernel(z, z_i)`` into its quadratic form.

    Sums and result are in float64 whatever comes in: the terms are many and cancel. Differentiable
    in both tensors.

    Args:
        support: scaled training bins.
        beta: their output weights.
        kernel: of the machine.

    Shape:
        - support: ``[N, K]``
        - beta: ``[N]``
    """
    support, beta = support.double(), beta.double()
    pull, total = support.mT @ beta, beta.sum()
    if kernel.degree == 1:
        return QuadraticForm(support.new_zeros(0, 0), pull, kernel.offset * total)
    bend = support.mT @ (support * beta[:, None])
    return QuadraticForm(bend, 2 * kernel.offset * pull, kernel.offset**2 * total)


def coordinates_of(support: Tensor) -> tuple[Tensor, Tensor | None]:
    """Bins in coordinates of the directions that they span, at most as many as there are bins.

    Returns:
        Coordinates ``[N, r]`` and directions ``[r, m]``, whose product is ``support``; directions
        are ``None``, and coordinates the columns, where there are no more columns than bins.

    Shape:
        - support: ``[N, m]``, float64
    """
    if len(support) >= support.shape[1]:
        return support, None
    squares, vectors = torch.linalg.eigh(support @ support.mT)
    is_kept = squares > len(squares) * torch.finfo(squares.dtype).eps * squares.amax()
    sizes, vectors = squares[is_kept].sqrt(), vectors[:, is_kept]
    return vectors * sizes, (vectors / sizes).mT @ support


def factors_of(
    support: Tensor, beta: Tensor, *, most: int = 64, tolerance: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Factors and signs of ``sum_i beta_i (z_i . z)^2``, those of the largest eigenvalues.

    They are the fewest whose error at the bins ``z_i``, root mean square, is at most ``tolerance``
    of the standard deviation of the sum there, or ``most``. No ``[m, m]`` is formed where there
    are fewer bins than columns. For ``QuadraticForm``; in float64 and without derivatives.

    Args:
        support: scaled training bins, the columns of the quadratic part alone.
        beta: their output weights.
        most: number of factors, at least 1.
        tolerance: at least 0; with 0 none is left out but by ``most`` and by rounding.

    Shape:
        - support: ``[N, m]``; beta: ``[N]``; output: ``[r, m]`` and ``[r]``

    Raises:
        ValueError: if shapes disagree, or a number is outside its range.
    """
    if support.ndim != 2 or beta.shape != support.shape[:1] or not len(beta):
        raise ValueError(
            f"expected support [N, m] and beta [N], N at least 1, got {tuple(support.shape)} and "
            f"{tuple(beta.shape)}"
        )
    if most < 1 or not tolerance >= 0:
        raise ValueError(
            f"most must be at least 1 and tolerance at least 0, got {most} and {tolerance}"
        )
    with torch.no_grad():
        support, beta = support.double(), beta.double()
        bins, basis = coordinates_of(support)
        values, vectors = torch.linalg.eigh(bins.mT @ (bins * beta[:, None]))
        order = values.abs().argsort(descending=True)
        values, vectors = values[order], vectors[:, order]
        terms = (bins @ vectors).square() * values
        left_out = terms.flip(1).cumsum(1).flip(1).square().mean(0).sqrt()  # without the first r
        allowed = tolerance * terms.sum(1).std(correction=0)
        is_enough = torch.cat([left_out <= allowed, allowed.new_ones(1, dtype=torch.bool)])
        num = min(int(is_enough.nonzero()[0]), most)
        vectors = vectors[:, :num] * values[:num].abs().sqrt()
        factors = vectors.mT if basis is None else vectors.mT @ basis
        return factors.contiguous(), torch.where(values[:num] < 0, -1.0, 1.0).to(factors)


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
