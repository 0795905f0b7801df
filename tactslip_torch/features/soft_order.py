"""Sorted values that move smoothly: order statistics of a distribution function without steps.

Each of ``n`` values is spread by a kernel of half-width ``h``. The sum of their distribution
functions rises smoothly from 0 to n, and the smoothed ``k``-th smallest value is where it passes
``k - 1/2``: at ``x_(k) + h`` it is at least k, at ``x_(k) - h`` at most k - 1. So it lies within
``h`` of the exact one, and is the exact one where no other value lies within ``h``.

The kernel is the biweight ``15/16 (1 - v^2)^2``: nothing beyond ``h`` has a say, and the result has
two continuous derivatives. The first are weights, ``kernel_i / sum of kernels``: positive, of sum
1. As the kernel is log-concave, their denominator is at least its height wherever half a value is
to be shared out, so they are never ill-conditioned.

Reference:
    Nadaraya (1964), Theory Probab. Appl. 9, 497-500; Azzalini (1981), Biometrika 68, 326-328.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.features.guards import looked_at

_BISECTIONS = 8  # then the error is so small beside 1 / curvature that each step squares it
_STEPS = 4


def spread(v: Tensor) -> Tensor:
    """The biweight kernel, 0 beyond [-1, 1]: ``[*] -> [*]``."""
    return 15 / 16 * (1 - v.clamp(-1, 1).square()).square()


def share_below(v: Tensor) -> Tensor:
    """Its integral from -1, 1 beyond 1: ``[*] -> [*]``."""
    v = v.clamp(-1, 1)
    square = v.square()
    return 0.5 + v * (15 / 16 + square * (-5 / 8 + square * (3 / 16)))


def num_near(ordered: Tensor, distance: float) -> int:
    """How many sorted values ``[*, n]`` lie at most that far above one, at most in any sample.

    All others where values may not be looked at (compiling, vmap).
    """
    last = ordered.shape[-1] - 1
    for lag in range(1, last + 1):
        gap = looked_at(ordered[..., lag:] - ordered[..., :-lag])
        if gap is not None and not (gap <= distance).any():
            return lag - 1
    return last


def smooth_order(x: Tensor, ranks: Sequence[int], width: float) -> Tensor:
    """Smoothed order statistics, twice continuously differentiable; no more memory than ``x``.

    Args:
        x: finite values; where one is not, the result is NaN.
        ranks: 0 for the smallest, n - 1 for the largest, in any order.
        width: half the width of the kernel, in the unit of the values.

    Shape:
        - x: ``[*, n]``
        - output: ``[*, len(ranks)]``, each within ``width`` of the sorted value

    Example:
        >>> smooth_order(torch.tensor([3.0, 1.0, 3.0, 7.0]), [0, 3], width=0.5)  # both alone
        tensor([1., 7.])
    """
    found: Tensor = _SmoothOrder.apply(x, tuple(ranks), width)  # type: ignore[no-untyped-call]
    return found


class _SmoothOrder(torch.autograd.Function):
    """The root, and its derivatives of every order: backward is written in terms of the root."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, ranks: tuple[int, ...], width: float) -> Tensor:
        ordered = x.sort(-1).values
        reach = num_near(ordered, 2 * width)  # of those further off, each counts wholly or not
        before = ordered.new_full((*ordered.shape[:-1], reach), -torch.inf)
        padded = torch.cat([before, ordered, -before], dim=-1)
        near = torch.stack([padded[..., k : k + 2 * reach + 1] for k in ranks], dim=-2)
        middle, sought = near[..., reach], reach + 0.5
        low, high = middle - width, middle + width
        for _ in range(_BISECTIONS):
            v = (middle[..., None] - near) / width
            is_above = share_below(v).sum(-1) > sought
            low, high = torch.where(is_above, low, middle), torch.where(is_above, middle, high)
            middle = (low + high) / 2
        for _ in range(_STEPS):
            v = (middle[..., None] - near) / width
            step = (share_below(v).sum(-1) - sought) / spread(v).sum(-1)
            middle = (middle - width * step).clamp(low, high)
        return middle

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, _, ctx.width = inputs
        ctx.save_for_backward(x, output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        x, root = ctx.saved_tensors  # the root is this function again, so this can be derived
        kernel = spread((root[..., :, None] - x[..., None, :]) / ctx.width)
        weights = kernel / kernel.sum(-1, keepdim=True)
        return (gradients[0][..., None] * weights).sum(-2), None, None
