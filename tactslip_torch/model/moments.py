"""Sums over training bins: all that the primal solve needs to know of them, of one size.

For a machine of degree 1 these are sums of products of two of the ``K + 1`` variables
``(1, z_1, .., z_K)``. For degree 2 an entry of the Gram matrix of the monomials is a sum of
products of four of them, and there are only ``C(K + 4, 4)`` of those: 9.4 million for 120 features,
where the triangle of the matrix has 27. Offset, penalty, class weights and fewer features come
later. Sums add: batches may come in any order, over any number of workers, and be taken out
again; the order shows in the last digits alone.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.kernels import Polynomial, QuadraticForm
from tactslip_torch.model.solve import check_weights
from tactslip_torch.package_files import DAMAGE_ERRORS, load_table, save_table
from tactslip_torch.package_files import SUMS as FORMAT
from tactslip_torch.runtime import SeenBatches, content_digest

_CLASSES = ("non-slip", "slip")
_CHUNK_BINS = 512  # whose products of two variables are held at a time
_BLOCK = 8  # variables; more hold more sums twice, fewer make smaller products
_STRIP = 256  # rows of a normal matrix that are scaled and mirrored at a time


class SufficientStats:
    """Sums over training bins, from which any class weights, penalty, offset and size are solved.

    Memory does not grow with the number of bins: 168 MB for 120 features at degree 2, and a name
    and a digest for every batch.

    Args:
        num_features: ``K``.
        metadata: what the features are (hand, names, scaling), as JSON holds it; only sums that
            agree in it merge.
        degree: of the machine, 1 or 2.

    Attributes:
        sums: ``[2, num_held]``, float64: of non-slip and slip, as ``ProductSums`` lays them out.
        count: ``[2]``, int64: number of bins.
        seen_batches: names and digests of batches.
        metadata: as given.

    Raises:
        ValueError: if JSON does not hold ``metadata``, or for another degree.

    Example:
        >>> stats = SufficientStats(2)
        >>> z = torch.tensor([[0.5, -0.25], [-0.5, 0.0], [1.0, 0.5]])
        >>> stats.update("M1/c00", z, torch.tensor([True, False, True]))
        >>> stats.count, len(stats.seen_batches)
        (tensor([1, 2]), 1)
        >>> stats.solve(penalty=1.0)(z.double()) > 0
        tensor([ True, False,  True])
    """

    def __init__(
        self, num_features: int, metadata: Mapping[str, Any] | None = None, degree: int = 2
    ) -> None:
        try:
            text = json.dumps(metadata or {}, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"metadata must be what JSON holds: {error}") from None
        self.metadata: dict[str, Any] = json.loads(text)
        self.num_features, self.degree = num_features, degree
        self._layout = ProductSums(num_features, degree)
        self.sums = torch.zeros(2, self._layout.num_held, dtype=torch.float64)
        self.count = torch.zeros(2, dtype=torch.int64)
        self.seen_batches = SeenBatches()

    def __repr__(self) -> str:
        quiet, slip = self.count.tolist()
        return (
            f"SufficientStats({len(self.seen_batches)} batches, {slip} slip and {quiet} non-slip "
            f"bins of {self.num_features} features, degree {self.degree})"
        )

    @property
    def weight(self) -> Tensor:
        """``[2]``, float64: sum of the weights of bins."""
        return self.sums[:, 0].clone()

    def update(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None = None
    ) -> None:
        """Add the bins of a batch: all of them or, on an error, none.

        Args:
            batch_id: a name of its own, such as that of the recording.
            z: scaled features, in [-1, 1].
            is_slip: 1 or True for slip.
            weights: positive weight of each bin; default 1. Classes are balanced in ``solve``.

        Shape:
            - z: ``[N, K]``; is_slip, weights: ``[N]``

        Raises:
            ValueError: if the batch is in already, for another shape or a value that is not
                allowed.
        """
        batch = self._checked(batch_id, z, is_slip, weights)
        self.seen_batches.add(batch_id, content_digest(*batch))
        self._add(*batch, sign=1)

    def remove(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None = None
    ) -> None:
        """Take the bins of a batch out again; what stays of them is rounding.

        Args:
            batch_id: as given to ``update``, like the others.
            z: scaled features.
            is_slip: classes.
            weights: of the bins.

        Raises:
            ValueError: if the batch was never added or held something else.
        """
        batch = self._checked(batch_id, z, is_slip, weights)
        self.seen_batches.remove(batch_id, content_digest(*batch))
        self._add(*batch, sign=-1)
        self.sums[self.count == 0] = 0.0

    def merge(self, other: SufficientStats) -> None:
        """Add the batches of other sums: all of them or, on an error, none.

        Raises:
            ValueError: if a batch is in both, or if the two differ in metadata, in
                degree or in the number of features.
        """
        ours = {"num_features": self.num_features, "degree": self.degree, **self.metadata}
        theirs = {"num_features": other.num_features, "degree": other.degree, **other.metadata}
        for key in ours | theirs:
            if ours.get(key) != theirs.get(key):
                raise ValueError(
                    f"cannot merge sums that differ in {key}: "
                    f"{ours.get(key)!s:.60} and {theirs.get(key)!s:.60}"
                )
        self.seen_batches.merge(other.seen_batches)
        self.sums += other.sums
        self.count += other.count

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all."""
        metadata = {
            "num_features": self.num_features,
            "degree": self.degree,
            "metadata": self.metadata,
            "batches": self.seen_batches,
        }
        save_table(path, FORMAT, metadata, {"sums": self.sums, "count": self.count})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SufficientStats:
        """The sums in a file.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it holds no sums, or is damaged.
        """
        metadata, tensors = load_table(path, FORMAT)
        parts: dict[str, Any] = metadata | tensors
        try:
            return cls.restored(**parts)
        except DAMAGE_ERRORS as error:
            raise ValueError(f"{os.fspath(path)} is damaged: {error}; make it again") from error

    @classmethod
    def restored(
        cls,
        num_features: int,
        metadata: Mapping[str, Any],
        batches: Mapping[str, str],
        sums: Tensor,
        count: Tensor,
        degree: int = 2,
    ) -> SufficientStats:
        """The sums that had these attributes.

        Raises:
            ValueError: if sums or counts are not those of so many features.
        """
        wanted = (2, ProductSums(num_features, degree).num_held)
        if sums.shape != wanted or sums.dtype != torch.float64:
            raise ValueError(f"sums must be float64 {list(wanted)}, got {list(sums.shape)}")
        if count.shape != (2,) or count.dtype != torch.int64 or bool((count < 0).any()):
            raise ValueError(f"count must be two whole numbers from 0, got {count!r:.60}")
        stats = cls(num_features, metadata, degree)
        stats.seen_batches = SeenBatches(batches)
        stats.sums, stats.count = sums, count
        return stats

    def solve(
        self,
        penalty: float,
        offset: float = 0.5,
        num_features: int | None = None,
        balance: Literal["weights", "none"] = "weights",
    ) -> QuadraticForm:
        """The kernel machine of all bins, as ``fit_machine`` makes it of them through the primal.

        Takes two float64 matrices of ``P`` by ``P`` monomials beside the sums (436 MB each for 120
        features at degree 2).

        Args:
            penalty: the paper's ``C``; ``inf`` for the pseudo-inverse, which takes several such
                matrices and much longer.
            offset: the kernel's ``c``, 0 or more.
            num_features: take the first so many features alone; default all.
            balance: ``weights`` gives both classes the same total weight; ``none`` takes the
                bins' own.

        Raises:
            ValueError: if a class is absent, or an argument is not allowed.

        Reference:
            Zong, Huang and Chen (2013), Neurocomputing 101, 229-242 (weighted ELM).
        """
        normal, moment = self.normal_equations(offset, num_features, balance)
        kernel = Polynomial(self.degree, offset)
        return kernel.solve(normal, moment, penalty, num_features or self.num_features)[0]

    def normal_equations(
        self, offset: float, num_features: int | None = None, balance: str = "weights"
    ) -> tuple[Tensor, Tensor]:
        """``X' W X``, ``[P, P]``, and ``X' W t``, ``[P]``; arguments and errors as ``solve``."""
        if not 0 <= offset < math.inf:
            raise ValueError(f"offset (the kernel's c) must be 0 or more, got {offset}")
        for name, num in zip(_CLASSES, self.count.tolist(), strict=True):
            if num == 0:
                raise ValueError(f"there is no {name} bin in these sums; add bins of both classes")
        scale = self.class_scale(balance)
        rest, slip = self.sums[0] * scale[0], self.sums[1] * scale[1]
        moment = self._layout.moment_vector(slip - rest, offset, num_features)
        return self._layout.normal_matrix(rest.add_(slip), offset, num_features), moment

    def class_scale(self, balance: str = "weights") -> Tensor:
        """What a balance, as ``solve`` has it, multiplies weights of either class with, ``[2]``."""
        if balance not in ("weights", "none"):
            raise ValueError(f"balance must be 'weights' or 'none', got {balance!r}")
        weight = self.weight
        return weight.sum() / (2 * weight) if balance == "weights" else torch.ones_like(weight)

    def _checked(
        self, batch_id: str, z: Tensor, is_slip: Tensor, weights: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The batch in float64 and bool, with weights."""
        shapes = [tuple(each.shape) for each in (z, is_slip, weights) if each is not None]
        if z.ndim != 2 or z.shape[1] != self.num_features or {*shapes[1:]} != {(len(z),)}:
            raise ValueError(
                f"batch {batch_id!r}: expected z [N, {self.num_features}], is_slip [N] and "
                f"weights [N], got {', '.join(map(str, shapes))}"
            )
        z = z.detach().cpu().double()
        weights = z.new_ones(len(z)) if weights is None else weights.detach().cpu().double()
        if len(outside := (~(z.abs() <= 1)).nonzero()):
            number, feature = outside[0].tolist()
            raise ValueError(
                f"batch {batch_id!r}: z must be within [-1, 1], got {float(z[number, feature]):g} "
                f"at bin {number}, feature {feature}; scale it and clip"
            )
        try:
            check_weights(weights)
        except ValueError as error:
            raise ValueError(f"batch {batch_id!r}: {error}") from None
        return z, is_slip.cpu().bool(), weights

    def _add(self, z: Tensor, is_slip: Tensor, weights: Tensor, sign: int) -> None:
        for label, of in enumerate((~is_slip, is_slip)):
            self._layout.add_(self.sums[label], z[of], sign * weights[of])
            self.count[label] += sign * int(of.sum())


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

    def normal_matrix(
        self, total: Tensor, offset: float = 0.5, use_features: int | None = None
    ) -> Tensor:
        """``X' W X`` of the monomials ``X`` of the machine's kernel, from the sums.

        Args:
            total: the sums.
            offset: the kernel's ``c``.
            use_features: take the first so many features alone; default all.

        Shape:
            - total: ``[num_held]``; output: ``[P, P]``

        Raises:
            ValueError: if there are fewer than ``use_features``.
        """
        num = self._num_used(use_features) + 1
        scale = Polynomial(self.degree, offset).scale(num - 1)
        if self.degree == 1:
            sums = total.view(self.num_features + 1, -1)[:num, :num]
            return sums * scale * scale[:, None]
        matrix = total.new_empty(len(scale), len(scale))
        for second in range(num):
            self._spread_(matrix, total, second, num)
        for start in range(0, len(matrix), _STRIP):  # only what is above the diagonal is there
            own, after = slice(start, start + _STRIP), slice(start, None)
            strip = matrix[own, after].mul_(scale[after]).mul_(scale[own, None])
            corner, others = strip[:, : len(strip)], strip[:, len(strip) :]
            corner.copy_(corner.triu() + corner.triu(1).mT)
            matrix[start + len(strip) :, own] = others.mT
        return matrix

    def moment_vector(
        self, total: Tensor, offset: float = 0.5, use_features: int | None = None
    ) -> Tensor:
        """``X' w``, the weighted sum of the monomials, from the sums.

        Shape:
            - total: ``[num_held]``; output: ``[P]``

        Raises:
            ValueError: as ``normal_matrix``.
        """
        num = self._num_used(use_features) + 1
        scale = Polynomial(self.degree, offset).scale(num - 1)
        if self.degree == 1:
            return total[:num] * scale
        sums = self._of(self._blocks[0], total)[0]  # of the pair (0, 0) with any other
        return sums[self._columns(0, num)] * scale

    def _num_used(self, use_features: int | None) -> int:
        used = self.num_features if use_features is None else use_features
        if not 1 <= used <= self.num_features:
            raise ValueError(f"use_features must be in 1..{self.num_features}, got {use_features}")
        return used

    def _of(self, block: _Block, total: Tensor) -> Tensor:
        return total[block.held].view(block.rows.stop - block.rows.start, -1)

    def _columns(self, first: int, num: int) -> Tensor:
        """Where a block has the pairs of variables from ``first`` up to ``num``."""
        block, whole = self._blocks[first // _BLOCK], self.num_features + 1
        smaller, larger = torch.triu_indices(num - first, num - first) + first
        start = smaller * whole - smaller * (smaller - 1) // 2 - smaller
        places: Tensor = start + larger - block.columns.start
        return places

    def _spread_(self, matrix: Tensor, total: Tensor, second: int, num: int) -> None:
        """Write every sum whose second smallest variable is this one above the diagonal.

        For a smallest variable ``i`` these are a symmetric matrix over ``t, u >= second``. Its
        triangle is the end of row ``(i, second)``; its row ``t`` a part of row ``(i, t)``.
        """
        block = self._blocks[second // _BLOCK]
        row = _triangle(second) - block.rows.start
        sums = self._of(block, total)[row : row + second + 1]  # a row for each i
        triangle = sums.index_select(1, self._columns(second, num))
        rest = num - second
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
