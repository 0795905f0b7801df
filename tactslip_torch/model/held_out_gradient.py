"""Held-out scores that can be differentiated: what a loss over them says of features and C.

Scores as ``held_out`` has them in the dual: ``t - e`` with ``e_g = S_g^-1 (G^-1 t)_g``. Their
differential has the rank of the number of groups: given ``r = dL/de``,

    dL = -sum_g a_g' dG b_g   with   a_g = G^-1 E_g S_g^-1 r_g   and   b_g = beta - G^-1 E_g e_g,

where ``E_g`` puts a group's values among those of all bins and ``b_g`` is the machine without the
group, 0 on its bins. So going back takes the factors of the way forward, two triangular solves for
each of ``a`` and ``b``, and the kernel once more, tile by tile.

Reference:
    Giles (2008), An extended collection of matrix derivative results for forward and reverse mode
    algorithmic differentiation, for the differential of an inverse.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_solve
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Polynomial, lower_gram
from tactslip_torch.model.left_out import (
    Groups,
    check_penalty,
    chunks_of,
    leave_out_,
    order_groups,
)
from tactslip_torch.model.once import once
from tactslip_torch.runtime import for_each

_ROWS = 256  # of the kernel matrix that one thread makes at a time
_TOGETHER = 256  # groups whose machines are kept at a time


def held_out_scores(
    z: Tensor,
    is_slip: Tensor,
    groups: Tensor,
    penalty: Tensor | float,
    offset: Tensor | float = 0.5,
    weights: Tensor | None = None,
) -> Tensor:
    """What each bin scores under the machine of degree 2 that never met its group, differentiable.

    The scores of ``HeldOut(bins, groups, Polynomial(2, offset), route="dual").at(penalty)``. Once
    differentiable in ``z``, ``penalty``, ``offset`` and ``weights``: a second derivative raises.
    Until then it keeps the factor, ``[N, N]``, and one of each group's own bins.

    Args:
        z: scaled features of the bins; promoted to float64.
        is_slip: what each bin is.
        groups: whole numbers; bins of one group need not stand together.
        penalty: the paper's ``C``, positive and finite; a number or a tensor of one.
        offset: the kernel's ``c``, at least 0; likewise.
        weights: positive weight of each bin; default 1.

    Shape:
        - z: ``[N, K]``; is_slip, groups, weights, output: ``[N]``

    Raises:
        ValueError: if shapes disagree, a value is outside its range, all bins are one group,
            leaving a group (named) out leaves one class, or the condition of all bins is above
            ``left_out.MOST_CONDITION``.

    Example:
        >>> z = torch.tensor([[0.9], [0.8], [-0.7], [-0.6]]).double().requires_grad_()
        >>> is_slip = torch.tensor([True, False, True, False])
        >>> scores = held_out_scores(z, is_slip, torch.tensor([0, 0, 1, 1]), penalty=1.0)
        >>> scores.sum().backward()
        >>> z.grad.shape
        torch.Size([4, 1])
    """
    TrainingBins(z, is_slip, weights)  # checks them
    order, names = order_groups(groups, is_slip)
    z = z.double()[order]
    numbers = [
        torch.as_tensor(number, dtype=z.dtype, device=z.device) for number in (penalty, offset)
    ]
    weights = torch.ones_like(z[:, 0]) if weights is None else weights.double()[order]
    targets = torch.where(is_slip[order], 1.0, -1.0).to(z)
    residuals = _Residuals.apply(z, *numbers, weights, targets, names)  # type: ignore[no-untyped-call]
    scores: Tensor = (targets - residuals)[order.argsort()]
    return scores


class _Residuals(torch.autograd.Function):
    """Targets less held-out scores, of bins sorted as ``order_groups`` says."""

    @staticmethod
    def forward(
        ctx: Any,
        z: Tensor,
        penalty: Tensor,
        offset: Tensor,
        weights: Tensor,
        targets: Tensor,
        groups: Groups,
    ) -> Tensor:
        check_penalty(float(penalty))
        factor = lower_gram(Polynomial(2, float(offset)), z)
        left_out = leave_out_(factor, targets, float(penalty), weights, groups, keep_blocks=True)
        ctx.groups = groups
        kept = z, penalty, offset, weights, factor, left_out.beta, left_out.residuals
        ctx.save_for_backward(*kept, *left_out.blocks)
        return left_out.residuals

    @staticmethod
    def backward(ctx: Any, r: Tensor) -> tuple[Tensor | None, ...]:
        z, penalty, offset, weights, *_ = ctx.saved_tensors
        with torch.no_grad():
            pulls = _pulls(ctx, r)
        held = [once("held_out_scores", pull, r, z, penalty, offset, weights) for pull in pulls]
        return *held, None, None


def _pulls(ctx: Any, r: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What ``r = dL/de`` says of z, C, c and the weights."""
    z, penalty, offset, weights, factor, beta, residuals, *blocks = ctx.saved_tensors
    shares = _weighed(factor, blocks, r, ctx.groups)
    z_pull, offset_pull = torch.zeros_like(z), torch.zeros_like(offset)
    ridge_pull = torch.zeros_like(beta)
    for own in _members(ctx.groups):
        right = torch.cat([own * shares[:, None], own * residuals[:, None]], dim=1)
        a, without = cholesky_solve(factor, right).tensor_split(2, dim=1)
        b = beta[:, None] - without
        ridge_pull -= (a * b).sum(1)
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[2]:
            offset_pull += _pull_gram_(z_pull, z, offset, a, b)
    penalty_pull = -(ridge_pull / weights).sum() / penalty**2  # the ridge is 1 / (C w)
    weights_pull = -ridge_pull / (penalty * weights**2)
    return z_pull, penalty_pull, offset_pull, weights_pull


def _members(groups: Groups) -> Iterator[Tensor]:
    """Which bin is in which group, ``[N, m]``, a few groups at a time."""
    sizes = torch.tensor([size for _, size in groups])
    member = torch.repeat_interleave(sizes)
    for some in torch.arange(len(groups)).split(_TOGETHER):
        yield member[:, None] == some


def _weighed(factor: Tensor, blocks: list[Tensor | None], r: Tensor, groups: Groups) -> Tensor:
    """``S_g^-1 r_g`` of each group.

    Shape:
        - factor: ``[N, N]``; r, output: ``[N]``
    """
    weighed = torch.empty_like(r)
    for block, (_, part) in zip(blocks, chunks_of(groups), strict=True):
        if block is None:
            own = factor[part, part].tril()
            weighed[part] = own @ (own.mT @ r[part])
        else:
            weighed[part] = cholesky_solve(block, r[part])
    return weighed


def _pull_gram_(z_pull: Tensor, z: Tensor, offset: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Add to ``z_pull`` what ``-sum_g a_g' K b_g`` says of z; returns what it says of the offset.

    With ``K_ij = (z_i . z_j + c)^2``; a tile of rows at a time, whatever the number of groups.

    Shape:
        - z_pull, z: ``[N, K]``; a, b: ``[N, m]``; output: a scalar
    """
    starts = range(0, len(z), _ROWS)
    sums = z.new_zeros(len(starts))

    def pull(row: int) -> None:
        rows = slice(row, row + _ROWS)
        shares = (a[rows] @ b.mT).addmm_(b[rows], a.mT)  # of K_ij and K_ji
        shares.mul_(torch.addmm(offset, z[rows], z.mT)).mul_(-2)
        z_pull[rows].addmm_(shares, z)
        sums[row // _ROWS] = shares.sum() / 2

    for_each(pull, starts)
    return sums.sum()
