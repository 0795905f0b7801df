"""Score of a bin by a method that the paper argues against.

The threshold lies on "the maximal discrete wavelet transform (DWT) detail coefficient" (paper II-B,
after Liu et al. 2024). The largest fast channel counts. A score is the natural log of an amplitude
in volts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from tactslip_torch.features.bank import power_of_two_below
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import LARGEST_SAMPLE, Sensing, is_alive
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.wavelet import (
    Wavelet,
    branch_matrix,
)

FLOOR_V = 1e-6
"""Amplitudes below it count as it, so that a dead hand has a score (ours; 16 bits at +-5 V resolve
150 times as much)."""
_NO_FAST = "a score of fast channels needs one; give their positions"


def largest_detail(
    bins: Tensor,
    fast: Sequence[int] | Tensor,
    wavelet: Wavelet = "rbio2.2",
    level: int = 4,
) -> Tensor:
    """Log of the largest magnitude that a fast channel's detail branches reach within the bin.

    Args:
        bins: filtered, in volts.
        fast: positions of the fast channels, or a mask of them.
        wavelet: of the branches, as features have it; a name or filters.
        level: number of levels.

    Shape:
        - bins: ``[*, C, n]``
        - output: ``[*]``, log volts of at least ``FLOOR_V``; NaN where a fast channel is not finite

    Raises:
        ValueError: if there is no fast channel, or bins are too short for so many levels.
    """
    details = branch_matrix(bins.shape[-1], wavelet, level)[1::2].flatten(0, 1)  # D1, D2, ..
    x = bins[..., torch.as_tensor(fast, device=bins.device), :] if len(fast) else bins[..., :0, :]
    if not x.shape[-2]:
        raise ValueError(_NO_FAST)
    magnitude = torch.maximum(x.amax(-1), -x.amin(-1)).detach()
    unit = power_of_two_below(magnitude)  # brings them to order one
    x = x / unit[..., None]
    products = (x - x[..., :1].detach()) @ details.to(x).T  # exact on a large constant
    largest = torch.maximum(products.amax(-1), -products.amin(-1)) * unit
    largest = torch.where(magnitude.isfinite(), largest, torch.nan)
    return largest.amax(-1).clamp(min=FLOOR_V).log()


@dataclass(frozen=True)
class BaselineDetector:
    """The largest detail as a detector: of the same hand, filter and bins as another.

    Args:
        pool: of the detector that it stands beside.
        channel_filter: of that detector.

    Raises:
        ValueError: if the hand has no fast channel.
    """

    pool: FeaturePool
    channel_filter: ChannelFilter

    def __post_init__(self) -> None:
        if not self.pool.hand.fast:
            raise ValueError(_NO_FAST)

    @property
    def needed_index(self) -> Tensor:
        """Channels in use, ``[F]``."""
        return torch.tensor(self.pool.hand.fast, dtype=torch.int64)

    @property
    def look_ahead(self) -> int:
        """Samples behind a bin that the fast channels' filter takes in."""
        reaches = self.channel_filter.reaches
        return max(reaches[place][1] for place in self.pool.hand.fast)

    def predict_raw(self, samples: Tensor, *, given: torch.dtype | None = None) -> Prediction:
        """Filter and score raw bins that come with their context.

        A fast channel that is missing counts as silent. With fewer than half of them alive the
        score is NaN and not valid. Other channels are not looked at, and never lost.

        Args:
            samples: in volts.
            given: dtype in which they were measured, and of the score; by default theirs.

        Shape:
            - samples: ``[*, C, context_before + n + context_after]``

        Raises:
            ValueError: if the number of channels or samples is another.
        """
        given, pool, fast = given or samples.dtype, self.pool, list(self.pool.hand.fast)
        filtered = self.channel_filter.valid(samples, fast)
        pool.check(filtered)
        bins = filtered[..., fast, :]
        high, low = bins.detach().amax(-1).double(), bins.detach().amin(-1).double()
        is_known = torch.maximum(high, -low) <= min(LARGEST_SAMPLE, torch.finfo(bins.dtype).max)
        inverse = pool.inverse_span(given, is_raw=True).to(high.device)[fast]
        magnitude = self.channel_filter.raw_magnitude(samples, fast)[..., fast]
        alive = is_alive(high - low, magnitude, is_known, inverse, torch.zeros_like(inverse))
        bins, every = torch.where(is_known[..., None], bins.to(given), 0.0), range(len(fast))
        score = largest_detail(bins, every, pool.wavelet, pool.level)
        is_valid = alive.sum(-1) >= self.sensing.min_alive
        is_lost = is_known.new_zeros(samples.shape[:-1])
        is_lost[..., fast] = ~alive
        span = torch.full_like(is_lost, torch.nan, dtype=torch.float64)
        span[..., fast] = torch.where(is_known, high - low, torch.nan)
        score = torch.where(is_valid, score, torch.nan)
        return Prediction(score, is_valid, is_valid, is_lost, span)

    @cached_property
    def sensing(self) -> Sensing:
        """Without training: half of the fast channels must be alive."""
        pool = self.pool
        return Sensing.unknown(len(pool.hand), len(pool.hand.fast), pool.sample_rate_hz)
