"""What keeps extremes from becoming silent numbers; on ordinary values none of it changes a bit.

The rules are ours (REFERENCE.md section 4): a sample whose span is below ``16 * eps * scale``,
rounding noise beside the raw bin it comes from, is replaced by its mean.
"""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.runtime import is_recorded


def is_constant(x: Tensor, scale: Tensor) -> Tensor:
    """Whether the span of ``x`` is rounding noise beside ``scale``, the size of the raw bin.

    Shape:
        - x: ``[*, n]``; scale: ``[*]``; output: ``[*]``, bool
    """
    x = x.detach()
    span = x.amax(-1) - x.amin(-1)
    return span * (1 / (16 * torch.finfo(x.dtype).eps)) < scale  # on this side nothing underflows


def settle(x: Tensor, scale: Tensor) -> Tensor:
    """Replace what ``is_constant`` by its mean, value by value; gradients there are 0.

    The mean is right to ``eps (n span / 2 + |mean|)``, and lies within the span.

    Shape:
        - x, output: ``[*, n]``; scale: ``[*]``
    """
    constant = is_constant(x, scale)
    if is_nowhere(constant):
        return x
    first = x[..., :1].detach()
    mean = first + (x.detach() - first).mean(-1, keepdim=True)
    return torch.where(constant[..., None], mean, x)


def is_nowhere(mask: Tensor) -> bool:
    """Whether a mask is known to hold nowhere, so that what depends on it can be passed over."""
    values = looked_at(mask)
    return values is not None and not values.any()


def are_positive(x: Tensor) -> bool:
    """Whether values are all known to be above 0."""
    values = looked_at(x)
    return values is not None and bool(values.min() > 0)


def looked_at(x: Tensor) -> np.ndarray[Any, Any] | None:
    """The values, if a decision may be taken on them: in eager mode, on a CPU, at least one."""
    if x.device.type == "cpu" and x.numel() and not is_recorded():
        with contextlib.suppress(RuntimeError):  # under vmap there is no memory to look at
            return x.detach().numpy()
    return None


def ordinary_sizes(dtype: torch.dtype) -> tuple[float, float]:
    """Between which magnitudes squares stay well within a dtype: 2^-320 and 2^448 in float64."""
    exponent = math.frexp(torch.finfo(dtype).max)[1]
    return 2.0 ** (-5 * exponent // 16), 2.0 ** (7 * exponent // 16)


def are_ordinary(magnitude: Tensor) -> bool:
    """Whether magnitudes are known to need no ``stretch``; false for NaN and 0."""
    values = looked_at(magnitude)
    low, high = ordinary_sizes(magnitude.dtype)
    return values is not None and bool(low <= values.min() and values.max() <= high)


def stretch(magnitude: Tensor) -> Tensor:
    """The power of two by which values of this magnitude are multiplied before they are squared.

    1 from 2^-320 to 2^448 (float32: 2^-40 to 2^56), so ordinary values keep every bit; beyond, what
    brings them near 1. Then no square overflows, no square of a difference underflows by more than
    rounding, and neither do the derivatives of roots of squares on their way back.

    Shape:
        - magnitude, output: ``[*]``
    """
    exponent = math.frexp(torch.finfo(magnitude.dtype).max)[1]

    def power(sixteenths: int) -> float:
        return 2.0 ** (sixteenths * exponent // 16)

    low, high = ordinary_sizes(magnitude.dtype)
    factor = torch.where(magnitude > high, power(-9), torch.ones_like(magnitude))
    factor = torch.where(magnitude > power(11), power(-12), factor)
    factor = torch.where(magnitude < low, power(8), factor)
    return torch.where(magnitude < power(-11), power(12), factor)


def bounded_gradient(x: Tensor, headroom: float = 1.0) -> Tensor:
    """``x``, whose gradient saturates at the largest finite number of the dtype.

    The derivative of a shape is of order 1/span, which for denormals no float can hold. Backward
    only: derivatives taken forwards become Inf there.

    Args:
        x: any values.
        headroom: the gradient saturates at this part below the largest number, so that a linear
            map on the way back, of no larger gain, does not overflow.

    Shape:
        - x, output: ``[*]``
    """
    if not (x.requires_grad and torch.is_grad_enabled()) or is_recorded():
        return x
    x = x.view_as(x)
    largest = torch.finfo(x.dtype).max / headroom
    # autograd hands on None for a gradient that is undefined
    x.register_hook(lambda g: None if g is None else g.clamp(-largest, largest))
    return x


def saturating(x: Tensor, dtype: torch.dtype) -> Tensor:
    """``x`` in another dtype; what is beyond its range becomes its largest finite number."""
    most = torch.finfo(dtype).max
    if torch.finfo(x.dtype).max <= most:
        return x.to(dtype)
    return x.clamp(-most, most).to(dtype)
