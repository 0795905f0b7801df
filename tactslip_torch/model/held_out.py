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
from tactslip_torch.model.downdate import Monomials, residuals_by_block, residuals_by_iteration
from tactslip_torch.model.fit import Route, TrainingBins, takes_dual
from tactslip_torch.model.kernel_elm import solve_kernel_elm_, solve_normal_equations_
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, lower_gram
from tactslip_torch.model.quadratic import QuadraticForm, collapse
from tactslip_torch.threads import for_each

MOST_CONDITION = 1e10  # of all bins; above, the scores of a group left out lose their digits
_TILE = 256  # bins whose columns one thread solves at a time
_CHUNK = 1024  # bins in whole groups that are treated together, unless one group is larger
_ITERATIONS = 60  # that conjugate gradients usually take
_WAIT = 30  # groups whose triangular solves take as long as reading a factor does

Groups = Sequence[tuple[int, int]]  # name and number of bins of each


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
    ``[P, P]`` or ``[N, N]``, and ``at`` takes another one of that size. Beyond the fit it costs
    about one and a half factorisations in the dual. In the primal all large groups together cost
    two triangular solves an iteration, of which there are some 30 to 200, more with C; a bin of
    the small ones costs ``P^2 / 2`` multiply-adds.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        groups: ``[N]``, whole numbers; bins of one group need not stand together.
        kernel: of the machine.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if shapes disagree, all bins are one group, leaving a group (named)
            out leaves one class, or the primal is asked of a kernel that does not fold.
    """

    def __init__(
        self,
        bins: TrainingBins,
        groups: Tensor,
        kernel: Kernel = PAPER_KERNEL,
        route: Route = "auto",
    ) -> None:
        bins = bins.double()
        _check_bins(bins, groups)
        names, member, counts = torch.unique(groups, return_inverse=True, return_counts=True)
        _check_groups(names, member, bins.is_slip)
        rank = counts.argsort(stable=True)  # large groups last: the later, the cheaper
        order = rank.argsort()[member].argsort(stable=True)
        self._groups = list(zip(names[rank].tolist(), counts[rank].tolist(), strict=True))
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

        The scores are right to 100 eps times the condition of the system of all bins.

        Args:
            penalty: the paper's ``C``, positive and finite.

        Raises:
            ValueError: if the penalty is not that, the condition is above ``MOST_CONDITION``, or
                the machine without a group (named) cannot be told in float64.
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
        beta, report = solve_kernel_elm_(
            factor, targets, penalty, self._weights, most_condition=MOST_CONDITION
        )
        residuals = torch.empty_like(beta)
        for groups, part in _chunks(self._groups):
            if len(groups) == 1 and part.stop == len(beta):  # the last group's answer is in L
                before = targets[: part.start, None]
                known = forward_solve(factor[: part.start, : part.start], before)
                residuals[part] = targets[part] - (factor[part, : part.start] @ known)[:, 0]
            else:
                inverse = _inverse_within(factor, part, groups)
                cholesky_(inverse)
                residuals[part] = cholesky_solve(inverse, beta[part])
        fold = collapse if self._kernel.collapses else KernelSum
        head = fold(self._z, beta, self._kernel)
        head.solved = report
        return head, residuals

    def _primal(self, penalty: float, monomials: Monomials) -> tuple[QuadraticForm, Tensor]:
        factor, z = self._system.clone(), self._z
        moment = monomials.gather(z, self._weights * self._targets)
        weights, report = solve_normal_equations_(
            factor, moment, penalty, most_condition=MOST_CONDITION
        )
        head = monomials.head(weights)
        head.solved = report
        roots = self._weights.sqrt()
        right = roots * (self._targets - head(z))
        solved = torch.empty_like(right)
        small = _num_small(self._groups, monomials.number)
        for groups, part in _chunks(self._groups[:small]):
            left = _left_within(factor, monomials, z[part], roots[part], groups)
            solved[part] = residuals_by_block(left, right[part], groups)
        if small < len(self._groups):
            groups = self._groups[small:]
            part = slice(len(z) - sum(size for _, size in groups), len(z))
            solved[part] = residuals_by_iteration(
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
    cheaper = takes_dual(kernel, len(z), z.shape[1])
    return None if route == "dual" or (route == "auto" and cheaper) else monomials


def _num_small(groups: Groups, num_monomials: int) -> int:
    """How many of the groups, by ascending size, cost less as blocks than by iterations.

    In units of ``P^2 / 2`` multiply-adds a block costs a triangular solve for each bin, products
    of those, and a factor; an iteration two triangular solves, a quadratic form and its transpose.
    """
    savings = []
    for _, size in groups:
        share = size / num_monomials
        block = size * (1 + share + share**2 / 3)
        savings.append(block - _ITERATIONS * (2 + 8 * share))
    large = [saving for saving in savings if saving > 0]
    return len(groups) - (len(large) if sum(large) > _ITERATIONS * 2 * _WAIT else 0)


def _chunks(groups: Groups) -> Iterator[tuple[Groups, slice]]:
    """Whole groups and their bins: as many as fit a chunk, at least one."""
    first = start = width = 0
    for last, (_, size) in enumerate(groups):
        if last > first and width + size > _CHUNK:
            yield groups[first:last], slice(start, start + width)
            first, start, width = last, start + width, 0
        width += size
    if width:
        yield groups[first:], slice(start, start + width)


def _inverse_within(factor: Tensor, part: slice, groups: Groups) -> Tensor:
    """``(L L')^-1`` between bins of one group, 0 across groups; lower triangle.

    From columns of ``L^-1``, which are 0 above the diagonal, so ``L`` is read from there on.

    Shape:
        - factor: ``[N, N]``; output: ``[n, n]`` for the n bins of ``part``
    """
    columns = factor.new_zeros(part.stop - part.start, len(factor) - part.start)  # one a row

    def fill(start: int) -> None:
        stop, shift = min(start + _TILE, part.stop), part.start
        ones = factor.new_zeros(len(factor) - start, stop - start).fill_diagonal_(1)
        solved = forward_solve(factor[start:, start:], ones)
        columns[start - shift : stop - shift, start - shift :] = solved.mT

    for_each(fill, range(part.start, part.stop, _TILE))
    return _products_within(columns, groups, triangular=True)


def _left_within(
    factor: Tensor, monomials: Monomials, z: Tensor, roots: Tensor, groups: Groups
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
    left = _products_within(columns, groups, triangular=False).neg_()
    left.diagonal().add_(1)
    return left


def _products_within(columns: Tensor, groups: Groups, *, triangular: bool) -> Tensor:
    """Products of columns of one group, 0 across groups; lower triangle.

    Args:
        columns: one a row.
        groups: that the columns are of.
        triangular: whether column ``i`` is 0 before its entry ``i``.

    Shape:
        - columns: ``[n, m]``; output: ``[n, n]``
    """
    sizes = torch.tensor([size for _, size in groups])
    group = torch.repeat_interleave(sizes)
    ends = sizes.cumsum(0)[group].tolist()  # of the group of each column
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


def _check_bins(bins: TrainingBins, groups: Tensor) -> None:
    if groups.shape != bins.is_slip.shape or groups.is_floating_point():
        raise ValueError(
            f"expected a whole number for the group of each of {len(bins.is_slip)} bins, got "
            f"{tuple(groups.shape)} {groups.dtype}"
        )


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
