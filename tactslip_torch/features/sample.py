"""Values to be described, with what several descriptors share; and when values count as constant.

The rules for extremes are ours (REFERENCE.md section 4): a sample whose span is below
``16 * eps * scale``, rounding noise beside the raw bin it comes from, is replaced by its mean.
Moments are two-pass, on values shifted by a sample and scaled by the span, so that large offsets,
denormals and 1e30 neither cancel nor overflow. Magnitudes whose squares leave the dtype are first
multiplied by a power of two (``stretch``), which costs no digit; all others by 1.
"""

from __future__ import annotations

import contextlib
import math
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn.functional import pad


def is_constant(x: Tensor, scale: Tensor) -> Tensor:
    """Whether the span of ``x`` is rounding noise beside ``scale``, the size of the raw bin.

    Shape:
        - x: ``[*, n]``; scale: ``[*]``; output: ``[*]``, bool
    """
    span = x.detach().amax(-1) - x.detach().amin(-1)
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
    with contextlib.suppress(RuntimeError):  # under vmap there is no memory to look at
        return may_look(mask) and not bool(mask.any())
    return False


def may_look(x: Tensor) -> bool:
    """Whether a decision may be taken on values: in eager mode, on a CPU, on at least one."""
    return x.device.type == "cpu" and x.numel() > 0 and not torch.compiler.is_compiling()


def ordinary_sizes(dtype: torch.dtype) -> tuple[float, float]:
    """Between which magnitudes squares stay well within a dtype: 2^-320 and 2^448 in float64."""
    exponent = math.frexp(torch.finfo(dtype).max)[1]
    return 2.0 ** (-5 * exponent // 16), 2.0 ** (7 * exponent // 16)


def stretch(magnitude: Tensor) -> Tensor:
    """The power of two by which values of this magnitude are multiplied before they are squared.

    1 from 2^-320 to 2^448 (float32: 2^-40 to 2^56), so ordinary values keep every bit; 2^768 (2^96)
    below and its inverse above. Then no square overflows, and no square of a difference underflows
    by more than rounding.

    Shape:
        - magnitude, output: ``[*]``
    """
    low, high = ordinary_sizes(magnitude.dtype)
    factor = 2.0 ** (3 * math.frexp(torch.finfo(magnitude.dtype).max)[1] // 4)
    shrunk = torch.where(magnitude > high, 1 / factor, torch.ones_like(magnitude))
    return torch.where(magnitude < low, factor, shrunk)


def bounded_gradient(x: Tensor) -> Tensor:
    """``x``, whose gradient saturates at the largest finite number of the dtype.

    The derivative of a shape is of order 1/span, which for denormals no float can hold. Backward
    only: derivatives taken forwards become Inf there.

    Shape:
        - x, output: ``[*]``
    """
    if not (x.requires_grad and torch.is_grad_enabled()) or torch.compiler.is_compiling():
        return x
    x = x.view_as(x)
    x.register_hook(_saturate)
    return x


def _saturate(gradient: Tensor | None) -> Tensor | None:
    """Autograd hands on None for a gradient that is undefined."""
    if gradient is None:
        return None
    largest = torch.finfo(gradient.dtype).max
    return gradient.clamp(-largest, largest)


def rank_in_run(is_boundary: Tensor) -> Tensor:
    """Position of each sorted value within its run, from 0.

    The running maximum of where runs start, by doubling: log2(n) plain maxima of windows, which
    export to ONNX as ``cummax`` does not.

    Shape:
        - is_boundary: ``[*, n - 1]``, bool: a new run starts behind this value
        - output: ``[*, n]``, int32
    """
    num = is_boundary.shape[-1] + 1
    position = torch.arange(num, dtype=torch.int32, device=is_boundary.device)
    start = pad(torch.where(is_boundary, position[1:], 0), (num, 0))  # the window before the first
    left, width = num - 1, 1
    while left:
        step = min(width, left)
        start = torch.maximum(start[..., step:], start[..., :-step])
        left, width = left - step, 2 * width
    return position - start


class Sample:
    """Values to be described, and what several descriptors share.

    Args:
        x: the values, ``[*, n]`` with ``n >= 2``.
        scale: ``[*]``, largest magnitude of the raw bin they come from, by which ``mode``
            decides which values are equal. Default: their own.
        reference: what ``correlation`` correlates with, broadcastable to ``x``.
        frequency_hz: ``[n]``, the axis of a spectrum, for its centroid and spread.
    """

    def __init__(
        self,
        x: Tensor,
        scale: Tensor | None = None,
        reference: Sample | None = None,
        frequency_hz: Tensor | None = None,
    ) -> None:
        self.x = bounded_gradient(x)
        self.num = x.shape[-1]
        self._scale = scale
        self.reference = reference
        self.frequency_hz = frequency_hz

    @cached_property
    def ordered(self) -> Tensor:
        """Sorted values, ``[*, n]``; NumPy's vectorised sort where no derivative is asked for."""
        x = self.x
        if x.device.type == "cpu" and not (x.requires_grad or torch.compiler.is_compiling()):
            has_tangent = forward_ad.unpack_dual(x).tangent is not None
            with contextlib.suppress(RuntimeError):  # under vmap there is no memory to look at
                if not has_tangent:
                    return torch.from_numpy(np.sort(x.numpy(), axis=-1))
        return torch.sort(x, dim=-1).values

    @cached_property
    def largest(self) -> Tensor:
        """Largest value, ``[*]``."""
        return self.x.amax(-1)

    @cached_property
    def smallest(self) -> Tensor:
        """Smallest value, ``[*]``."""
        return self.x.amin(-1)

    @cached_property
    def magnitude(self) -> Tensor:
        """Largest absolute value, ``[*]``, without gradient; NaN or Inf where a value is."""
        return torch.maximum(self.largest.detach(), -self.smallest.detach())

    @cached_property
    def scale(self) -> Tensor:
        """The size values are compared by, ``[*]``."""
        return self.magnitude if self._scale is None else self._scale

    @cached_property
    def stretch(self) -> Tensor:
        """Power of two that keeps squares in range, 1 for ordinary values, ``[*]``."""
        return stretch(self.magnitude)

    @cached_property
    def is_ordinary(self) -> bool:
        """Whether no value needs a guard, which then costs nothing and would change no bit.

        That is: finite sizes in the range of ``stretch``, no flat sample, no negative amplitude.
        Unknown, so False, where values may not be looked at (compiling, vmap) or looking is dear.
        """
        if not may_look(self.x):
            return False
        low, high = ordinary_sizes(self.x.dtype)
        with contextlib.suppress(RuntimeError):  # under vmap there is no memory to look at
            least, most = self.magnitude.aminmax()
            is_amplitude = self.frequency_hz is None or bool(self.smallest.detach().amin() >= 0)
            narrowest = (self.largest.detach() - self.smallest.detach()).amin()
            return is_amplitude and bool((least >= low) & (most <= high) & (narrowest > 0))
        return False

    def in_unit(self, x: Tensor) -> Tensor:
        """``x``, one number a sample, in the stretched unit, which is ``stretch`` times smaller."""
        return x if self.is_ordinary else x * self.stretch

    def out_of_unit(self, x: Tensor) -> Tensor:
        """The way back."""
        return x if self.is_ordinary else x / self.stretch

    def unless_flat(self, x: Tensor, otherwise: float) -> Tensor:
        """``x``, one number a sample, and ``otherwise`` where all values are equal."""
        return x if self.is_ordinary else torch.where(self.is_flat, otherwise, x)

    # What follows is in the stretched unit.

    @cached_property
    def unit(self) -> Tensor:
        """Values, ``[*, n]``."""
        return self.x if self.is_ordinary else self.x * self.stretch[..., None]

    @property
    def ranked(self) -> Tensor:
        """Sorted values without gradient, ``[*, n]``; not kept, as memory costs more than time."""
        ordered = self.ordered.detach()
        return ordered if self.is_ordinary else ordered * self.stretch[..., None]

    @property
    def gaps(self) -> Tensor:
        """Differences of neighbours in ``ranked``, ``[*, n - 1]``."""
        ranked = self.ranked
        return ranked[..., 1:] - ranked[..., :-1]

    @cached_property
    def span(self) -> Tensor:
        """Largest minus smallest value, ``[*]``."""
        return self.in_unit(self.largest) - self.in_unit(self.smallest)

    @cached_property
    def is_flat(self) -> Tensor:
        """All values equal, ``[*]``."""
        return self.span.detach() == 0

    @cached_property
    def safe_span(self) -> Tensor:
        """The span without gradient, 1 where it is 0, ``[*]``."""
        return self.unless_flat(self.span.detach(), 1.0)

    @cached_property
    def mean(self) -> Tensor:
        """Arithmetic mean, ``[*]``; exact where the sum of differences from the first value is."""
        return self.unit[..., 0].detach() + self._shift_and_centred[0].squeeze(-1)

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square, ``[*]``; Inf for a zero sample, over which value and gradient are 0."""
        mean_square = (self.unit * self.unit).mean(-1)
        if not self.is_ordinary:
            mean_square = torch.where(self.magnitude == 0, torch.inf, mean_square)
        return mean_square.sqrt()

    @cached_property
    def centred(self) -> Tensor:
        """Values minus their mean, ``[*, n]``."""
        return self._shift_and_centred[1]

    @cached_property
    def _shift_and_centred(self) -> tuple[Tensor, Tensor]:
        """Mean of the values minus the first, ``[*, 1]``, and ``centred``; the first goes free."""
        shifted = self.unit - self.unit[..., :1].detach()
        shift = shifted.mean(-1, keepdim=True)
        return shift, shifted - shift

    # What follows has no unit.

    @cached_property
    def deviation(self) -> Tensor:
        """Values minus their mean, over the span: of order one, ``[*, n]``."""
        return self.centred / self.safe_span[..., None]

    @cached_property
    def squares(self) -> Tensor:
        """Squared ``deviation``, ``[*, n]``."""
        return self.deviation * self.deviation

    @cached_property
    def variance(self) -> Tensor:
        """Mean of ``squares``, 1 where the sample is flat, ``[*]``."""
        return self.unless_flat(self.squares.mean(-1), 1.0)

    @cached_property
    def weights(self) -> Tensor:
        """A spectrum's lines as shares of their sum, 0 for a zero spectrum, ``[*, n]``."""
        total = self.unit.sum(-1, keepdim=True)
        if not self.is_ordinary:
            total = torch.where(total.detach() == 0, torch.inf, total)
        return self.unit / total
