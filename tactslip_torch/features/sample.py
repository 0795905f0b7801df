"""Values to be described, with what several descriptors share; and when values count as constant.

The rules for extremes are ours (REFERENCE.md section 4): a sample whose span is below
``16 * eps * scale``, rounding noise beside the raw bin it comes from, is replaced by its mean.
Moments are two-pass, on values shifted by a sample and scaled by the span, so that large offsets,
denormals and 1e30 neither cancel nor overflow.
"""

from __future__ import annotations

import contextlib
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad


def is_constant(x: Tensor, scale: Tensor) -> Tensor:
    """Whether the span of ``x`` is rounding noise beside ``scale``, the size of the raw bin.

    Shape:
        - x: ``[*, n]``; scale: ``[*]``; output: ``[*]``, bool
    """
    span = x.detach().amax(-1) - x.detach().amin(-1)
    return span < 16 * torch.finfo(x.dtype).eps * scale


def settle(x: Tensor, scale: Tensor) -> Tensor:
    """Replace what ``is_constant`` by its mean, value by value; gradients there are 0.

    Shape:
        - x, output: ``[*, n]``; scale: ``[*]``
    """
    first = x[..., :1].detach()
    mean = first + (x.detach() - first).mean(-1, keepdim=True)
    return torch.where(is_constant(x, scale)[..., None], mean, x)


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
        self.x = x
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
    def span(self) -> Tensor:
        """Largest minus smallest value, ``[*]``; NaN or Inf where a value is."""
        return self.x.amax(-1) - self.x.amin(-1)

    @cached_property
    def is_flat(self) -> Tensor:
        """All values equal, ``[*]``."""
        return self.span.detach() == 0

    @cached_property
    def magnitude(self) -> Tensor:
        """Largest absolute value, ``[*]``, without gradient."""
        return self.x.detach().abs().amax(-1)

    @cached_property
    def scale(self) -> Tensor:
        """The size values are compared by, ``[*]``."""
        return self.magnitude if self._scale is None else self._scale

    @cached_property
    def safe_span(self) -> Tensor:
        """The span without gradient, 1 where it is 0, ``[*]``."""
        return torch.where(self.is_flat, 1.0, self.span.detach())

    @cached_property
    def shifted(self) -> Tensor:
        """Values minus the first, over the span: of order one whatever the unit, ``[*, n]``."""
        return (self.x - self.x[..., :1].detach()) / self.safe_span[..., None]

    @cached_property
    def shifted_mean(self) -> Tensor:
        """Mean of ``shifted``, ``[*, 1]``."""
        return self.shifted.mean(-1, keepdim=True)

    @cached_property
    def deviation(self) -> Tensor:
        """Values minus their mean, over the span, ``[*, n]``."""
        return self.shifted - self.shifted_mean

    @cached_property
    def squares(self) -> Tensor:
        """Squared ``deviation``, ``[*, n]``."""
        return self.deviation * self.deviation

    @cached_property
    def variance(self) -> Tensor:
        """Mean of ``squares``, 1 where the sample is flat, ``[*]``."""
        return torch.where(self.is_flat, 1.0, self.squares.mean(-1))

    @cached_property
    def is_zero(self) -> Tensor:
        """All values zero, ``[*]``."""
        return self.magnitude == 0

    @cached_property
    def by_magnitude(self) -> Tensor:
        """Values over the largest magnitude (zeros stay zeros), ``[*, n]``."""
        return self.x / torch.where(self.is_zero, 1.0, self.magnitude)[..., None]

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square over the largest magnitude, 1 for a zero sample, ``[*]``."""
        mean_square = (self.by_magnitude * self.by_magnitude).mean(-1)
        return torch.where(self.is_zero, 1.0, mean_square).sqrt()

    @cached_property
    def weights(self) -> Tensor:
        """A spectrum's lines as shares of their sum, 0 for a zero spectrum, ``[*, n]``."""
        total = self.by_magnitude.sum(-1, keepdim=True)
        return self.by_magnitude / torch.where(self.is_zero[..., None], 1.0, total)
