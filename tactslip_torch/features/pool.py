"""The pool: every descriptor of every channel, branch and spectrum (REFERENCE.md section 4).

For the paper's hand 14 gauges x 13 descriptors + 10 films x (8 branches x (14 time + 15 frequency)
+ 8 band energy ratios) = 2582 features of a 50 ms bin. Of any hand, a gauge is a channel that
adapts slowly, a film one that adapts fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from tactslip_torch.features.bank import Bank, Frame
from tactslip_torch.features.linear_maps import LinearMaps, linear_maps
from tactslip_torch.features.names import pool_names
from tactslip_torch.features.ops import bounded_gradient, saturating
from tactslip_torch.features.plan import Plan, make_plan
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import is_traced
from tactslip_torch.signals.spectrum import SpectrumMethod
from tactslip_torch.signals.wavelet import WaveletFilters, as_wavelet, wavelet_fact

Arithmetic = Literal["double", "native"]
NATIVE_SPAN = 2.0**-10
"""Part of a film's magnitude; in float32 throughout, less may be lost in a branch."""
VALIDITY = (
    "every channel in use is finite, and its filtered span above 64 eps of its magnitude; in "
    "native float32 that of a film above 2^-10 of it"
)
"""``FeaturePool.validity`` of the channels in use, in words for people."""
LARGEST_SAMPLE = torch.finfo(torch.float64).max / 64
"""Volts; what is larger counts as Inf, because its branches and spectra may leave float64."""


class FeaturePool(nn.Module):
    """All features of filtered bins, in the paper's order.

    Follows the dtype and the device of its input. Gradients flow wherever the descriptor is
    differentiable; they are finite up to 1e288 V. The linear maps (wavelet branches and spectrum)
    are evaluated on an identity in float64 through ptwt and torch.fft.

    float32 bins are computed in float64 and rounded once at the end. If ``arithmetic`` is
    ``"native"``, their branches and order statistics are still float64, all other statistics
    float32.

    Args:
        hand: the channels, in the order in which bins hold them.
        sample_rate_hz: of the bins.
        bin_samples: length of a bin; 100 (50 ms at 2 kHz) in the paper.
        wavelet: its name or, of one without a name, its filters (or their ``to_dict``).
        level: number of wavelet levels.
        spectrum: ``"reference"`` (the authors') or ``"clean"`` (ours).
        arithmetic: ``"double"``, or ``"native"`` to compute in the dtype of the bins.

    Raises:
        ValueError: if the rate is not positive, the bin is too short for the levels, or the
            arithmetic none of those there are.

    Example:
        >>> pool = FeaturePool(HandLayout.paper24())
        >>> pool(torch.randn(5, 24, 100)).shape, str(pool.names[0])
        (torch.Size([5, 2582]), 'SG1 raw time mean')
    """

    def __init__(
        self,
        hand: HandLayout,
        sample_rate_hz: float = 2000.0,
        *,
        bin_samples: int = 100,
        wavelet: str | WaveletFilters | Mapping[str, Any] = "rbio2.2",
        level: int = 4,
        spectrum: SpectrumMethod = "reference",
        arithmetic: Arithmetic = "double",
    ) -> None:
        super().__init__()
        if not sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz must be positive, got {sample_rate_hz}")
        if arithmetic not in get_args(Arithmetic):
            raise ValueError(
                f"arithmetic must be one of {', '.join(get_args(Arithmetic))}, got {arithmetic!r}"
            )
        self.hand = hand
        self.sample_rate_hz = float(sample_rate_hz)
        self.bin_samples = bin_samples
        self.wavelet = as_wavelet(wavelet)
        self.level = level
        self.spectrum: SpectrumMethod = spectrum
        self.arithmetic: Arithmetic = arithmetic
        self._inverses: dict[torch.dtype, Tensor] = {}
        self._banks: dict[torch.dtype, Bank] = {}
        self.names = pool_names(hand, level)
        _ = self.maps  # refuses a bin that is too short for the levels

    @property
    def maps(self) -> LinearMaps:
        """The constant matrices behind the features."""
        return linear_maps(
            self.bin_samples, self.sample_rate_hz, self.wavelet, self.level, self.spectrum
        )

    def facts(self) -> dict[str, Any]:
        """All arguments but the hand, as JSON-able values; ``FeaturePool(hand, **facts)``."""
        return {
            "sample_rate_hz": self.sample_rate_hz,
            "bin_samples": self.bin_samples,
            "wavelet": wavelet_fact(self.wavelet),
            "level": self.level,
            "spectrum": self.spectrum,
            "arithmetic": self.arithmetic,
        }

    def forward(self, bins: Tensor) -> Tensor:
        """Features of filtered bins.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*, F]``, dtype of ``bins``, every value finite where the bins are; NaN for
              every feature of a channel that holds a NaN or Inf. What is beyond the dtype, an
              energy or a gradient, saturates at its largest finite number.

        Raises:
            ValueError: if the number of channels or samples is another, or bins are neither float32
                nor float64.
        """
        self.check(bins)
        x = self.widen(bins)
        if x.dtype not in self._banks:
            self._banks[x.dtype] = self.bank(make_plan(self.hand, self.level, self.names), x.dtype)
        return saturating(self._banks[x.dtype].of_bins(x), bins.dtype)

    def bank(self, plan: Plan, dtype: torch.dtype) -> Bank:
        """What makes a part of the features of bins that ``widen`` has brought to this dtype."""
        frames = [
            Frame(tuple(sorted(own)), is_film)
            for is_film, kind in ((False, self.hand.slow), (True, self.hand.fast))
            if (own := set(kind).intersection(plan.channels))
        ]
        return Bank(self.maps, plan, frames, dtype)

    def widen(self, x: Tensor) -> Tensor:
        """Samples in the dtype that features are computed in; filter after it, not before.

        Raises:
            ValueError: if they are neither float32 nor float64.
        """
        if x.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"expected float32 or float64 samples in volts, got {x.dtype}")
        x = bounded_gradient(x)
        return x if self.arithmetic == "native" else x.double()

    def validity(self, bins: Tensor) -> Tensor:
        """Which channels can be trusted.

        False where a channel holds a NaN or Inf (``is_missing``) or its span is within 64 eps of
        its magnitude (a dead sensor, or a vibration the dtype cannot resolve). In native float32 a
        film's span must be a thousandth of it, for its branches to survive.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*, C]``, bool

        Raises:
            ValueError: as ``forward``.
        """
        self.check(bins)
        return self.is_alive(bins) & ~self.is_missing(bins)

    def is_alive(self, bins: Tensor) -> Tensor:
        """Which channels have a span the dtype can resolve: ``validity`` but for its limit.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*, C]``, bool
        """
        high, low = bins.amax(-1), bins.amin(-1)  # by the inverse, so that nothing underflows
        return (high - low) * self.inverse_span(bins) > torch.maximum(high, -low)

    def inverse_span(self, like: Tensor) -> Tensor:
        """One over the least span that resolves, as a part of the magnitude, ``[C]``."""
        if like.dtype not in self._inverses:
            least = [64 * torch.finfo(like.dtype).eps] * len(self.hand)
            if self.arithmetic == "native" and like.dtype == torch.float32:
                for film in self.hand.fast:
                    least[film] = NATIVE_SPAN
            with torch.inference_mode(False):  # it may be needed for a gradient later
                self._inverses[like.dtype] = torch.tensor(least, dtype=like.dtype).reciprocal()
        return self._inverses[like.dtype].to(like.device)

    def is_missing(self, bins: Tensor) -> Tensor:
        """Which channels hold a NaN or Inf, or a sample beyond ``LARGEST_SAMPLE``.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*, C]``, bool
        """
        largest = min(LARGEST_SAMPLE, torch.finfo(bins.dtype).max)
        if is_traced():  # onnxruntime's maxima pass over NaN
            return (~(bins.abs() <= largest)).any(-1)
        return ~(torch.maximum(bins.amax(-1), -bins.amin(-1)) <= largest)

    def check(self, bins: Tensor) -> None:
        """Refuse what are no bins of this hand.

        Raises:
            ValueError: as ``forward``.
        """
        if bins.ndim < 2 or bins.shape[-2:] != (len(self.hand), self.bin_samples):
            raise ValueError(
                f"expected bins [*, {len(self.hand)}, {self.bin_samples}] (channels, samples), "
                f"got {tuple(bins.shape)}"
            )
        if bins.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"expected float32 or float64 bins in volts, got {bins.dtype}")
