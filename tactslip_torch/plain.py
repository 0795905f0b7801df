"""Whether a tensor is no more than its values: then shorter ways to the same values are open."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad


def is_recorded() -> bool:
    """Whether what runs is being written down as a graph, in which no value may be looked at."""
    is_traced = torch.jit.is_tracing()  # type: ignore[attr-defined,no-untyped-call]
    return bool(is_traced or torch.compiler.is_compiling())


def has_values(x: Tensor) -> bool:
    """Whether a decision may be taken on the values, wherever they lie and whatever comes along.

    Not so where a graph is recorded or ``x`` is transformed (vmap, func.grad, jvp).
    """
    if is_recorded():
        return False
    try:
        x.detach().flatten()[:0].cpu().numpy()  # of what is transformed not even nothing
    except RuntimeError:
        return False
    return True


def is_plain(x: Tensor) -> bool:
    """Whether only values are asked for, and lie in memory that can be looked at.

    Not so where a gradient or a tangent is carried along, a graph is recorded, ``x`` is transformed
    (vmap), or lies on another device than the CPU.
    """
    if x.device.type != "cpu" or is_recorded() or (x.requires_grad and torch.is_grad_enabled()):
        return False
    try:
        x.detach().numpy()  # under vmap and other transforms there is no memory to look at
        return forward_ad.unpack_dual(x).tangent is None
    except RuntimeError:
        return False
