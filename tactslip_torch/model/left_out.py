"""The residuals of groups of bins under the machine without them, from one factor of the dual.

With ``G = K + diag(1 / (C w))`` and ``beta = G^-1 t`` they are ``e_g = S_g^-1 beta_g``, where
``S_g`` is the block ``(G^-1)_gg``. Bins are sorted by the size of their group.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_, cholesky_solve, forward_solve
from tactslip_torch.model.condition import SolveReport
from tactslip_torch.model.kernel_elm import solve_kernel_elm_
from tactslip_torch.runtime import for_each

MOST_CONDITION = 1e10  # of all bins; above, the scores of a group left out lose their digits
TILE = 256  # bins whose columns one thread solves at a time
_CHUNK = 1024  # bins in whole groups that are treated together, unless one group is larger

Groups = Sequence[tuple[int, int]]  # name and number of bins of each


class LeftOut(NamedTuple):
    """A solved dual, and what its groups look like without themselves.

    Attributes:
        beta: ``[N]``, output weights of the machine of all bins.
        residuals: ``[N]``, ``t`` less the score from the machine without the bin's group.
        blocks: for each of ``chunks_of(groups)`` the factor of its blocks ``S_g``, ``[n, n]``;
            ``None`` for a last group alone in its chunk: its ``S_g^-1`` is ``L_gg L_gg'``. None
            kept if not asked for.
        report: on the solve.
    """

    beta: Tensor
    residuals: Tensor
    blocks: list[Tensor | None]
    report: SolveReport


def leave_out_(
    system: Tensor,
    targets: Tensor,
    penalty: float,
    weights: Tensor,
    groups: Groups,
    *,
    keep_blocks: bool = False,
) -> LeftOut:
    """Solve the dual, and leave each group out of it; the factor ``L`` overwrites the system.

    Args:
        system: kernel matrix of the bins; its lower triangle is read.
        targets: of the bins.
        penalty: the paper's ``C``.
        weights: of the bins.
        groups: of the bins, one after the other.
        keep_blocks: whether to hand out ``blocks``.

    Shape:
        - system: ``[N, N]``; targets, weights: ``[N]``

    Raises:
        ValueError: if the condition is above ``MOST_CONDITION``.
    """
    beta, report = solve_kernel_elm_(
        system, targets, penalty, weights, most_condition=MOST_CONDITION
    )
    residuals, blocks = torch.empty_like(beta), []
    for some, part in chunks_of(groups):
        if is_last_alone(some, part, len(beta)):  # its answer is in L
            before = targets[: part.start, None]
            known = forward_solve(system[: part.start, : part.start], before)
            residuals[part] = targets[part] - (system[part, : part.start] @ known)[:, 0]
            block = None
        else:
            block = _inverse_within(system, part, some)
            cholesky_(block)
            residuals[part] = cholesky_solve(block, beta[part])
        if keep_blocks:
            blocks.append(block)
    return LeftOut(beta, residuals, blocks, report)


def order_groups(groups: Tensor, is_slip: Tensor) -> tuple[Tensor, Groups]:
    """Which bin comes where when large groups come last, and the groups in that order.

    The later a group, the cheaper its columns.

    Args:
        groups: the group of each bin, whole numbers.
        is_slip: what each bin is.

    Shape:
        - groups, is_slip: ``[N]``; order: ``[N]``, indices into the bins

    Raises:
        ValueError: if shapes disagree, all bins are one group, or leaving a group (named) out
            leaves one class.
    """
    if groups.shape != is_slip.shape or groups.is_floating_point():
        raise ValueError(
            f"expected a whole number for the group of each of {len(is_slip)} bins, got "
            f"{tuple(groups.shape)} {groups.dtype}"
        )
    names, member, counts = torch.unique(groups, return_inverse=True, return_counts=True)
    _check_groups(names, member, is_slip)
    rank = counts.argsort(stable=True)
    order = rank.argsort()[member].argsort(stable=True)
    return order, list(zip(names[rank].tolist(), counts[rank].tolist(), strict=True))


def check_penalty(penalty: float) -> None:
    """That it is one for which groups can be left out in closed form.

    Raises:
        ValueError: if not.
    """
    if not 0 < penalty < math.inf:
        raise ValueError(
            f"held-out scores in closed form need a positive and finite penalty (the paper's "
            f"C), got {penalty}; refit without each group for another"
        )


def chunks_of(groups: Groups) -> Iterator[tuple[Groups, slice]]:
    """Whole groups and their bins: as many as fit a chunk, at least one."""
    first = start = width = 0
    for last, (_, size) in enumerate(groups):
        if last > first and width + size > _CHUNK:
            yield groups[first:last], slice(start, start + width)
            first, start, width = last, start + width, 0
        width += size
    if width:
        yield groups[first:], slice(start, start + width)


def is_last_alone(groups: Groups, part: slice, num_bins: int) -> bool:
    """Whether a chunk is one group, and the last: what ``L`` has of it is its own factor."""
    return len(groups) == 1 and part.stop == num_bins


def products_within(columns: Tensor, groups: Groups, *, triangular: bool) -> Tensor:
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
        tile = columns[start : start + TILE, start if triangular else 0 :]
        stop, last = start + len(tile), ends[min(start + TILE, len(ends)) - 1]
        products[start:last, start:stop] = (
            columns[start:last, start if triangular else 0 :] @ tile.mT
        )
        products[start:last, start:stop] *= group[start:last, None] == group[start:stop]

    for_each(multiply, range(0, len(columns), TILE))
    return products


def _inverse_within(factor: Tensor, part: slice, groups: Groups) -> Tensor:
    """``(L L')^-1`` between bins of one group, 0 across groups; lower triangle.

    From columns of ``L^-1``, which are 0 above the diagonal, so ``L`` is read from there on.

    Shape:
        - factor: ``[N, N]``; output: ``[n, n]`` for the n bins of ``part``
    """
    columns = factor.new_zeros(part.stop - part.start, len(factor) - part.start)  # one a row

    def fill(start: int) -> None:
        stop, shift = min(start + TILE, part.stop), part.start
        ones = factor.new_zeros(len(factor) - start, stop - start).fill_diagonal_(1)
        solved = forward_solve(factor[start:, start:], ones)
        columns[start - shift : stop - shift, start - shift :] = solved.mT

    for_each(fill, range(part.start, part.stop, TILE))
    return products_within(columns, groups, triangular=True)


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
