"""What each training bin would score had its whole group been left out, without refitting.

The weights of the machine are redone; features, scaling and bin weights stay. A group is a bin, a
cycle, a material: whatever must not stand on both sides of a validation. With ``G = K +
diag(1 / (C w))`` and ``beta = G^-1 t`` the residuals of a group under the machine without it are
``e_g = ((G^-1)_gg)^-1 beta_g``; in the primal ``e_g = (I - H_gg)^-1 (t - Phi v)_g`` with the hat
matrix ``H = Phi A^-1 Phi' W``. Either way one Cholesky factor serves all groups.

Reference:
    Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2, and An, Liu and
    Venkatesh (2007), Pattern Recognition 40(8), 2154-2162, for blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_, cholesky_solve, forward_solve
from tactslip_torch.model.downdate import (
    LEAST_EIGENVALUE,
    Monomials,
    residuals_without_groups,
    untold,
)
from tactslip_torch.model.fit import Route, TrainingBins
from tactslip_torch.model.kernel_elm import solve_kernel_elm_, solve_normal_equations_
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, lower_gram
from tactslip_torch.model.quadratic import QuadraticForm, collapse
from tactslip_torch.threads import for_each

_TILE = 256  # bins whose columns one thread solves at a time
_CHUNK = 1024  # bins in whole groups that are treated together, unless one group is larger
_LARGE = 512  # bins; in the primal larger groups go by conjugate gradients


class HeldOutFit(NamedTuple):
    """A machine, and what its training bins would score without their groups.

    Attributes:
        head: the machine of all bins.
        scores: ``[N]``, each from the machine that never met the bin's group.
    """

    head: QuadraticForm | KernelSum
    scores: Tensor


class HeldOut:
    """Exact leave-one-group-out scores for any number of values of C.

    Through the primal or the dual as ``fit_machine``. The matrix that does not depend on C is kept,
    ``[P, P]`` or ``[N, N]``, and ``at`` takes another one of that size.

    Args:
        bins: scaled training bins in float64.
        groups: ``[N]``, whole numbers; bins of one group need not stand together.
        kernel: of the machine.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if shapes or dtypes disagree, all bins are one group, leaving a group (named)
            out leaves one class, or the primal is asked of a kernel that does not fold.
    """

    def __init__(
        self,
        bins: TrainingBins,
        groups: Tensor,
        kernel: Kernel = PAPER_KERNEL,
        route: Route = "auto",
    ) -> None:
        _check_bins(bins, groups)
        names, member, counts = torch.unique(groups, return_inverse=True, return_counts=True)
        _check_groups(names, member, bins.is_slip)
        rank = counts.argsort(stable=True)  # large groups last: the later, the cheaper
        order = rank.argsort()[member].argsort(stable=True)
        self._names: list[int] = names[rank].tolist()
        self._sizes: list[int] = counts[rank].tolist()
        self._order, self._kernel = order, kernel
        self._z, self._targets = bins.features[order], bins.targets[order]
        weights = torch.ones_like(bins.targets) if bins.weights is None else bins.weights
        self._weights = weights[order]
        self._monomials = _monomials_of(kernel, self._z, route)
        if self._monomials is None:
            self._system = lower_gram(kernel, self._z)
        else:
            self._system = self._monomials.normal_matrix(self._z, self._weights)

    def at(self, penalty: float) -> HeldOutFit:
        """The machine and the held-out scores for one value of C, from one factorisation.

        Args:
            penalty: the paper's ``C``, positive and finite.

        Raises:
            ValueError: if the penalty is not that, the system is not positive definite, or the
                machine without a group (named) cannot be told in float64.
        """
        if not 0 < penalty < math.inf:
            raise ValueError(
                f"held-out scores in closed form need a positive and finite penalty (the paper's "
                f"C), got {penalty}; refit without each group for another"
            )
        if self._monomials is None:
            head, residuals = self._dual(penalty)
        else:
            head, residuals = self._primal(penalty, self._monomials)
        scores = torch.empty_like(residuals)
        scores[self._order] = self._targets - residuals
        return HeldOutFit(head, scores)

    def _dual(self, penalty: float) -> tuple[QuadraticForm | KernelSum, Tensor]:
        factor, targets = self._system.clone(), self._targets
        beta = solve_kernel_elm_(factor, targets, penalty, self._weights)
        residuals = torch.empty_like(beta)
        for _, sizes, part in _chunks(self._names, self._sizes):
            if len(sizes) == 1 and part.stop == len(beta):  # the last group's answer is in L
                before = targets[: part.start, None]
                known = forward_solve(factor[: part.start, : part.start], before)
                residuals[part] = targets[part] - (factor[part, : part.start] @ known)[:, 0]
            else:
                inverse = _inverse_within(factor, part, sizes)
                cholesky_(inverse)
                residuals[part] = cholesky_solve(inverse, beta[part])
        fold = collapse if self._kernel.collapses else KernelSum
        return fold(self._z, beta, self._kernel), residuals

    def _primal(self, penalty: float, monomials: Monomials) -> tuple[QuadraticForm, Tensor]:
        factor, z = self._system.clone(), self._z
        moment = monomials.gather(z, self._weights * self._targets)
        head = monomials.head(solve_normal_equations_(factor, moment, penalty))
        roots = self._weights.sqrt()
        right = roots * (self._targets - head(z))
        solved = torch.empty_like(right)
        small = sum(size <= _LARGE for size in self._sizes)
        for names, sizes, part in _chunks(self._names[:small], self._sizes[:small]):
            left = _left_within(factor, monomials, z[part], roots[part], sizes)
            solved[part] = _solve_left(left, right[part], names, sizes)
        if small < len(self._sizes):
            part = slice(sum(self._sizes[:small]), len(z))
            groups = list(zip(self._names[small:], self._sizes[small:], strict=True))
            solved[part] = residuals_without_groups(
                factor, monomials, z[part], roots[part], right[part], groups
            )
        return head, solved / roots


def _monomials_of(kernel: Kernel, z: Tensor, route: Route) -> Monomials | None:
    """The primal's unknowns; none for the dual."""
    if not isinstance(kernel, Polynomial) or not kernel.collapses:
        if route == "primal":
            raise ValueError(f"{kernel} has no primal of fixed size; take route='dual' or 'auto'")
        return None
    monomials = Monomials(kernel, z.shape[1])
    fewer = len(z) <= monomials.number
    return None if route == "dual" or (route == "auto" and fewer) else monomials


def _chunks(
    names: Sequence[int], sizes: Sequence[int]
) -> Iterator[tuple[Sequence[int], Sequence[int], slice]]:
    """Names and sizes of whole groups, and their bins: as many as fit a chunk, at least one."""
    first = start = width = 0
    for last, size in enumerate(sizes):
        if last > first and width + size > _CHUNK:
            yield names[first:last], sizes[first:last], slice(start, start + width)
            first, start, width = last, start + width, 0
        width += size
    if width:
        yield names[first:], sizes[first:], slice(start, start + width)


def _inverse_within(factor: Tensor, part: slice, sizes: Sequence[int]) -> Tensor:
    """``(L L')^-1`` between bins of one group, 0 across groups; lower triangle.

    From columns of ``L^-1``, which are 0 above the diagonal, so ``L`` is read from there on.

    Shape:
        - factor: ``[N, N]``; sizes: sum to the n bins of ``part``; output: ``[n, n]``
    """
    columns = factor.new_zeros(part.stop - part.start, len(factor) - part.start)  # one a row

    def fill(start: int) -> None:
        stop, shift = min(start + _TILE, part.stop), part.start
        ones = torch.eye(len(factor) - start, stop - start, dtype=factor.dtype)
        solved = forward_solve(factor[start:, start:], ones)
        columns[start - shift : stop - shift, start - shift :] = solved.mT

    for_each(fill, range(part.start, part.stop, _TILE))
    return _products_within(columns, sizes, triangular=True)


def _left_within(
    factor: Tensor, monomials: Monomials, z: Tensor, roots: Tensor, sizes: Sequence[int]
) -> Tensor:
    """``I - W^1/2 Phi (L L')^-1 Phi' W^1/2`` between bins of one group, 0 across; lower triangle.

    Shape:
        - factor: ``[P, P]``; z: ``[n, K]``; roots: ``[n]``; output: ``[n, n]``
    """
    columns = factor.new_empty(len(z), len(factor))

    def fill(start: int) -> None:
        tile = slice(start, start + _TILE)
        scaled = monomials.of(z[tile]) * roots[tile, None]
        columns[tile] = forward_solve(factor, scaled.mT).mT

    for_each(fill, range(0, len(z), _TILE))
    left = _products_within(columns, sizes, triangular=False).neg_()
    left.diagonal().add_(1)
    return left


def _products_within(columns: Tensor, sizes: Sequence[int], *, triangular: bool) -> Tensor:
    """Products of columns of one group, 0 across groups; lower triangle.

    Args:
        columns: one a row.
        sizes: columns in each group.
        triangular: whether column ``i`` is 0 before its entry ``i``.

    Shape:
        - columns: ``[n, m]``; output: ``[n, n]``
    """
    group = torch.repeat_interleave(torch.tensor(sizes))
    ends = torch.tensor(sizes).cumsum(0)[group].tolist()  # of the group of each column
    products = columns.new_zeros(len(columns), len(columns))

    def multiply(start: int) -> None:
        tile = columns[start : start + _TILE, start if triangular else 0 :]
        stop, last = start + len(tile), ends[min(start + _TILE, len(ends)) - 1]
        products[start:last, start:stop] = (
            columns[start:last, start if triangular else 0 :] @ tile.mT
        )
        products[start:last, start:stop] *= group[start:last, None] == group[start:stop]

    for_each(multiply, range(0, len(columns), _TILE))
    return products


def _solve_left(left: Tensor, right: Tensor, names: Sequence[int], sizes: Sequence[int]) -> Tensor:
    """``left^-1 right``, refused for a group (named) that has too little left.

    Shape:
        - left: ``[n, n]``; right, output: ``[n]``
    """
    factor = left.clone()
    try:
        cholesky_(factor)
    except ValueError:
        bad = [max(int(torch.linalg.cholesky_ex(left).info) - 1, 0)]
    else:
        bad = (factor.diagonal().square() < LEAST_EIGENVALUE).nonzero().flatten().tolist()
    if bad:
        raise untold(
            [name for name, size in zip(names, sizes, strict=True) for _ in range(size)][bad[0]]
        )
    return cholesky_solve(factor, right)


def _check_bins(bins: TrainingBins, groups: Tensor) -> None:
    if groups.shape != bins.is_slip.shape or groups.is_floating_point():
        raise ValueError(
            f"expected a whole number for the group of each of {len(bins.is_slip)} bins, got "
            f"{tuple(groups.shape)} {groups.dtype}"
        )
    if bins.features.dtype != torch.float64:
        raise ValueError(f"held-out scores need features in float64, got {bins.features.dtype}")


def _check_groups(names: Tensor, member: Tensor, is_slip: Tensor) -> None:
    if len(names) < 2:
        raise ValueError(
            f"held-out scores need at least two groups, all {len(is_slip)} bins are in "
            f"{names.tolist()}"
        )
    for kind, own in (("slip", is_slip), ("non-slip", ~is_slip)):
        counts = torch.bincount(member[own], minlength=len(names))
        lost = (counts == own.sum()).nonzero().flatten().tolist()
        if lost:
            raise ValueError(
                f"without group {int(names[lost[0]])} no {kind} bin is left to train on; take "
                "smaller groups, or other bins"
            )
