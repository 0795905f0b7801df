"""Values to be described, with what several descriptors share.

Moments are two-pass, on values shifted by a sample and scaled by the span, so that large offsets,
denormals and 1e30 neither cancel nor overflow. Magnitudes whose squares leave the dtype are first
multiplied by a power of two (``guards.stretch``), which costs no digit; all others by 1. Where no
value of a batch is extreme, which one look tells, guards are passed over: they would change no bit.
"""

from __future__ import annotations

import contextlib
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from tactslip_torch.features.guards import (
    bounded_gradient,
    looked_at,
    ordinary_sizes,
    stretch,
)
from tactslip_torch.runtime import is_recorded


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
        if x.device.type == "cpu" and not (x.requires_grad or is_recorded()):
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
        smallest, largest = looked_at(self.smallest), looked_at(self.largest)
        if smallest is None or largest is None:
            return False
        low, high = ordinary_sizes(self.x.dtype)
        size = np.maximum(largest, -smallest)
        is_amplitude = self.frequency_hz is None or smallest.min() >= 0
        in_range = low <= size.min() and size.max() <= high
        return bool(is_amplitude and in_range and (largest > smallest).all())

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
    def std(self) -> Tensor:
        """Standard deviation with ``n - 1``, 0 for a constant, ``[*]``."""
        # not by the span, which as a factor would make denormals of the gradient on its way back
        square = (self.centred * self.centred).mean(-1) * (self.num / (self.num - 1))
        return self.unless_flat(self.unless_flat(square, 1.0).sqrt(), 0.0)

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
