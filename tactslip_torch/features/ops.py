"""Operations of the definitions that ``torch`` has not under one name, or not as they need them.

All else that ``descriptors.py`` and ``bank.py`` are written in are functions and methods of torch
that ``deploy.value.Value`` takes part in (``__torch_function__``). So each function here asks once
whether it has a tensor before it, or a value of a graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

TINY = 1e-300
"""Instead of 0 in a divisor, where a quotient of 0 is to be 0."""


def is_traced() -> bool:
    """Whether what runs is being written down as a graph, in which no value may be looked at."""
    is_jit = torch.jit.is_tracing()  # type: ignore[attr-defined,no-untyped-call]
    return bool(is_jit or torch.compiler.is_compiling())


def _has_values(x: Tensor) -> bool:
    """Whether a decision may be taken on the values, wherever they lie and whatever comes along.

    Not so where a graph is recorded or ``x`` is transformed (vmap, func.grad, jvp).
    """
    if is_traced():
        return False
    try:
        x.detach().flatten()[:0].cpu().numpy()  # of what is transformed not even nothing
    except (RuntimeError, TypeError):  # transformed, or NumPy has no such dtype
        return False
    return True


def is_concrete(x: Tensor) -> bool:
    """Whether only values are asked for, and lie in memory that can be looked at.

    Not so where a gradient or a tangent is carried along, a graph is recorded, ``x`` is transformed
    (vmap), or lies on another device than the CPU.
    """
    if not x.is_cpu or is_traced() or (x.requires_grad and torch.is_grad_enabled()):
        return False
    try:
        x.detach().numpy()  # under vmap and other transforms there is no memory to look at
        return forward_ad.unpack_dual(x).tangent is None
    except (RuntimeError, TypeError):  # transformed, or NumPy has no such dtype
        return False


def stamps_of(tensors: Iterable[Tensor]) -> list[tuple[Tensor, int | Tensor]]:
    """What ``are_unchanged`` compares: tensors, and how often each was changed in place.

    Inference tensors do not count that: of those a copy.
    """
    return [(x, x.clone() if x.is_inference() else x._version) for x in tensors]


def are_unchanged(tensors: Sequence[Tensor], stamps: Sequence[tuple[Tensor, int | Tensor]]) -> bool:
    """Whether tensors are those of the stamps, none of them replaced or changed since."""
    return len(tensors) == len(stamps) and all(
        x is same and (torch.equal(x, was) if isinstance(was, Tensor) else x._version == was)
        for x, (same, was) in zip(tensors, stamps, strict=True)
    )


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Within it ``torch.autocast`` narrows nothing that is computed on the device of ``x``."""
    kind = x.device.type
    is_on = torch.is_autocast_enabled(kind)
    return torch.autocast(kind, enabled=False) if is_on else nullcontext()


def root(square: Tensor) -> Tensor:
    """Square root, whose derivative at 0 is 0."""
    if not isinstance(square, Tensor):
        return square.sqrt()
    is_zero = square.detach() <= 0  # not so for NaN
    return torch.where(is_zero, 0.0, torch.where(is_zero, 1.0, square).sqrt())


def ascending(x: Tensor, count: int) -> Tensor:
    """The smallest values along the last axis, at least ``count`` of them, in ascending order.

    By NumPy where only values are asked for: it sorts short rows several times as fast.
    """
    if not isinstance(x, Tensor):
        return x.ascending(count)
    if is_concrete(x):
        return torch.from_numpy(np.sort(x.detach().numpy(), axis=-1))
    return x.sort(-1).values


def taken(x: Tensor, index: Tensor | None, axis: int) -> Tensor:
    """Entries at constant places along an axis; ``None`` is all of them."""
    if index is None:
        return x
    if not isinstance(x, Tensor):
        return x.take(index.tolist(), axis)
    return x.index_select(axis, index.to(x.device))


def looked_up(table: Tensor, index: Tensor) -> Tensor:
    """Entries of a constant table ``[n]`` at places that were computed, in the shape of these."""
    return table.to(index.device)[index] if isinstance(index, Tensor) else index.entries_of(table)


def counted(index: Tensor, num: int) -> Tensor:
    """How often each of the numbers 0 to ``num - 1`` occurs along the last axis.

    Shape:
        - index: ``[*, n]``, whole numbers in that range
        - output: ``[*, num]``
    """
    if not isinstance(index, Tensor):
        return index.counted(num)
    none = index.new_zeros(*index.shape[:-1], num)
    return none.scatter_add(-1, index, torch.ones_like(index))


def like(constant: Tensor, x: Tensor) -> Tensor:
    """A constant with the dtype and the device of what it meets; a value of a graph asks itself."""
    return constant.to(x) if isinstance(x, Tensor) else constant


def power_of_two_below(magnitude: Tensor) -> Tensor:
    """The largest power of two that is no larger, by which to divide rounds nothing; no gradient.

    Of magnitudes below 1e-300, 0 among them, that of 1e-300 (the dtype's smallest normal number).
    """
    tiny = max(TINY, torch.finfo(magnitude.dtype).tiny)
    return magnitude.detach().clamp(min=tiny).log2().floor().exp2()


def is_all_false(mask: Tensor) -> bool:
    """Whether a mask is known to hold nowhere, so that what depends on it can be passed over."""
    return mask.device.type == "cpu" and _has_values(mask) and not bool(mask.any())


def bounded_gradient(x: Tensor) -> Tensor:
    """``x``, whose gradient saturates at the largest finite number of the dtype.

    The derivative of a shape is of order 1/span, which for denormals no float can hold. Backward
    only: derivatives taken forwards become Inf there.

    Shape:
        - x, output: ``[*]``
    """
    if not (x.requires_grad and torch.is_grad_enabled()) or is_traced():
        return x
    x = x.view_as(x)
    largest = torch.finfo(x.dtype).max
    # autograd hands on None for a gradient that is undefined
    x.register_hook(lambda g: None if g is None else g.clamp(-largest, largest))
    return x


def saturating(x: Tensor, dtype: torch.dtype) -> Tensor:
    """``x`` in another dtype; what is beyond its range becomes its largest finite number."""
    most = torch.finfo(dtype).max
    if torch.finfo(x.dtype).max <= most:
        return x.to(dtype)
    return x.clamp(-most, most).to(dtype)


def signed_log(features: Tensor, scale: Tensor) -> Tensor:
    """``sign(f) * scale * log1p(|f| / scale)``: nearly ``f`` below the scale, logarithmic above.

    Monotone, odd, with derivative ``scale / (scale + |f|)``, 1 at 0. Finite for every finite ``f``,
    also where ``|f| / scale`` passes the largest float; NaN stays NaN.

    Shape:
        - features, output: ``[*, K]``
        - scale: broadcasts with ``features``, positive
    """
    dtype_info = torch.finfo(features.dtype)
    if is_concrete(features) and is_concrete(scale):  # the same in fewer passes
        ratio = features.abs() / scale
        if ratio.numel() and bool(ratio.amax().isfinite()):
            bent, is_tiny = ratio.log1p().mul_(scale), ratio < dtype_info.tiny
            if bool(is_tiny.any()):
                bent = torch.where(is_tiny, features.abs(), bent)
            return bent.copysign_(features)
    is_negative = features < 0
    size = torch.where(is_negative, -features, features)  # abs() has derivative 0 at 0
    ratio = size / scale
    bent = scale * ratio.log1p()
    if not _has_values(features) or bool(ratio.isinf().any()):
        far = torch.maximum(size, scale).log() - scale.log()
        far = far.clamp(min=math.log(dtype_info.max))  # no step back where log1p ends
        bent = torch.where(ratio.isinf(), scale * far, bent)
    bent = torch.where(ratio < dtype_info.tiny, size, bent)  # a denormal ratio has lost its digits
    return torch.where(is_negative, -bent, bent)
