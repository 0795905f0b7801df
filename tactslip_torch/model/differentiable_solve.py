"""``G^-1 b`` from a factor of ``G``, differentiable any number of times in what G is made of.

By the implicit function theorem, not through the factorisation: given ``g = dL/dx``, the vector
``u = G^-1 g`` is what ``L`` says of ``b``, and ``-u' dG x`` what it says of ``G``. So going back
is one more solve by the factor that is there. ``u`` is a solve of the same kind, differentiable
likewise, which is what makes second derivatives right: they see that the factor moves too.

Reference:
    Giles (2008), Collected matrix derivative results for forward and reverse mode algorithmic
    differentiation, section 2.3.1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class System:
    """What G is made of, its *parameters*, in three functions.

    Args:
        solve: ``G^-1 b``, from the factor and ``b``.
        pulls: from u, x and the parameters, what ``-u' G x`` says of each parameter while u and x
            are held; made of differentiable operations.
        push: from x and the tangents of the parameters ``dG x``; ``None`` where derivatives are
            taken backwards alone.
    """

    solve: Callable[[Tensor, Tensor], Tensor]
    pulls: Callable[..., tuple[Tensor, ...]]
    push: Callable[..., Tensor] | None = None


def solve_by_factor(system: System, factor: Tensor, right: Tensor, *parameters: Tensor) -> Tensor:
    """``G^-1 right``, differentiable in ``right`` and in the parameters of G.

    Args:
        system: how to solve, and what G is made of.
        factor: of G at these parameters; how it came of them is nobody's concern.
        right: the right-hand side.
        parameters: as ``system`` takes them.

    Shape:
        - right, output: as ``system.solve`` has them
    """
    solved: Tensor = _Solve.apply(system, factor, right, *parameters)  # type: ignore[no-untyped-call]
    return solved


class _Solve(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(system: System, factor: Tensor, right: Tensor, *parameters: Tensor) -> Tensor:
        return system.solve(factor, right)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.system, factor, _, *parameters = inputs
        ctx.save_for_backward(factor, output, *parameters)
        ctx.save_for_forward(factor, output, *parameters)

    @staticmethod
    def backward(ctx: Any, pull: Tensor) -> tuple[Tensor | None, ...]:
        factor, x, *parameters = ctx.saved_tensors
        u = solve_by_factor(ctx.system, factor, pull, *parameters)
        pulls: Sequence[Tensor | None] = [None] * len(parameters)
        if any(ctx.needs_input_grad[3:]):
            pulls = ctx.system.pulls(u, x, *parameters)
        return None, None, u, *pulls

    @staticmethod
    def jvp(ctx: Any, _: None, __: None, right: Tensor | None, *tangents: Tensor | None) -> Tensor:
        factor, x, *parameters = ctx.saved_tensors
        change = torch.zeros_like(x) if right is None else right
        if any(tangent is not None for tangent in tangents):
            if ctx.system.push is None:
                raise NotImplementedError("derivatives of this solve are taken backwards alone")
            change = change - ctx.system.push(x, *tangents)
        return solve_by_factor(ctx.system, factor, change, *parameters)


def _solve_dense(factor: Tensor, right: Tensor) -> Tensor:
    return torch.cholesky_solve(right[..., None], factor).squeeze(-1)


def _pull_matrix(u: Tensor, x: Tensor, matrix: Tensor) -> tuple[Tensor]:
    """Symmetric, as the matrix is."""
    half = (-u / 2)[..., :, None] * x[..., None, :]
    return (half + half.mT,)


def _push_matrix(x: Tensor, matrix: Tensor) -> Tensor:
    return (((matrix + matrix.mT) / 2) @ x[..., None]).squeeze(-1)


DENSE = System(_solve_dense, _pull_matrix, _push_matrix)
"""A symmetric matrix ``[*, n, n]`` as its own parameter, with ``[*, n]`` beside it; the factor is
the lower one of Cholesky."""
