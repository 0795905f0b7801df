"""Gradients that must not be differentiated again, so that whoever tries is told.

``torch.autograd.function.once_differentiable`` raises for whoever calls ``backward``, but leaves
such a gradient out without a word where ``torch.autograd.grad`` reaches the same input another
way. Here a gradient hangs on everything that it depends on.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def once(what: str, gradient: Tensor, *sources: Tensor) -> Tensor:
    """The gradient itself; deriving it by any of the sources raises.

    Args:
        what: whose gradient it is, for the error.
        gradient: a result of ``backward``, without a graph.
        sources: the tensors that it depends on, with theirs.

    Shape:
        - gradient, output: ``[*]``

    Example:
        >>> x = torch.ones(1, requires_grad=True)
        >>> torch.autograd.grad(once("a fit", 2 * x.detach(), x), x)
        Traceback (most recent call last):
            ...
        RuntimeError: a fit can be differentiated once; a second derivative was asked for
    """
    held: Tensor = _Once.apply(what, gradient, *sources)  # type: ignore[no-untyped-call]
    return held


class _Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, what: str, gradient: Tensor, *sources: Tensor) -> Tensor:
        ctx.what = what
        return gradient.clone()

    @staticmethod
    def backward(ctx: Any, *pulls: Tensor) -> tuple[Tensor | None, ...]:
        raise RuntimeError(
            f"{ctx.what} can be differentiated once; a second derivative was asked for"
        )
