"""Scores of a bin by the methods that the paper argues against.

Thresholds lie on "filtered vibration amplitudes" (paper II-B, after Romeo and Zollo 2020), here the
power of the fast channels' band, and on "the maximal discrete wavelet transform (DWT) detail
coefficient" (after Liu et al. 2024). The largest fast channel counts. A score is the natural log of
an amplitude in volts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.features.bank import power_of_two_below
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import LARGEST_SAMPLE, Sensing, is_alive
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.runtime import check_choice
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.wavelet import (
    Wavelet,
    branch_matrix,
    frequency_axis_hz,
    spectrum_matrix,
)

BaselineName = Literal["fast_band_power", "largest_detail"]
VIBRATION_HZ = (5.0, 400.0)
"""Where the fast-adapting afferents of a hand answer, FA-I 5 to 50 Hz and FA-II 40 to 400 Hz.

Johansson and Flanagan (2009), Nature Reviews Neuroscience 10, 345-359.
"""
FLOOR_V = 1e-6
"""Amplitudes below it count as it, so that a dead hand has a score (ours; 16 bits at +-5 V resolve
150 times as much)."""
_NO_FAST = "a score of fast channels needs one; give their positions"


def fast_band_power(
    bins: Tensor,
    fast: Sequence[int] | Tensor,
    sample_rate_hz: float = 2000.0,
) -> Tensor:
    """Log of the root of the power in the band of touch (``VIBRATION_HZ``), largest channel.

    The power is the mean square of the bin's part in the band: its lines by ``rfft``, without a
    window, the constant never among them. Filtering leaves little of it above 182 Hz, the first
    zero of 11 samples.

    Args:
        bins: filtered, in volts.
        fast: positions of the fast channels, or a mask of them.
        sample_rate_hz: of the bins.

    Shape:
        - bins: ``[*, C, n]``
        - output: ``[*]``, log volts of at least ``FLOOR_V``; NaN where a fast channel is not finite

    Raises:
        ValueError: if there is no fast channel, or no line of a bin's spectrum lies in the band.
    """
    return _log_of_largest(bins, fast, _band_lines(bins.shape[-1], float(sample_rate_hz)), 2)


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
    return _log_of_largest(bins, fast, details, math.inf)


@dataclass(frozen=True)
class BaselineDetector:
    """A baseline where ``score_stream`` takes a ``SlipDetector``: the same hand, filter and bins.

    Args:
        name: which score.
        pool: of the detector that it stands beside.
        channel_filter: of that detector.

    Raises:
        ValueError: if there is no such baseline, or the hand has no fast channel.
    """

    name: BaselineName
    pool: FeaturePool
    channel_filter: ChannelFilter

    def __post_init__(self) -> None:
        check_choice("baseline", self.name, get_args(BaselineName))
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
        if self.name == "fast_band_power":
            score = fast_band_power(bins, every, pool.sample_rate_hz)
        else:
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


def _log_of_largest(
    bins: Tensor, fast: Sequence[int] | Tensor, rows: Tensor, order: float
) -> Tensor:
    """Log of the largest amplitude among channels: the norm of an order of rows times the signal.

    Rows pass over a constant; the signal is brought to where squares neither overflow nor vanish.
    """
    x = bins[..., torch.as_tensor(fast, device=bins.device), :] if len(fast) else bins[..., :0, :]
    if not x.shape[-2]:
        raise ValueError(_NO_FAST)
    magnitude = torch.maximum(x.amax(-1), -x.amin(-1)).detach()
    unit = power_of_two_below(magnitude)
    x = x / unit[..., None]
    products = (x - x[..., :1].detach()) @ rows.to(x).T  # exact on a large constant
    if order == math.inf:  # as vector_norm, in an eighth of its time
        largest = torch.maximum(products.amax(-1), -products.amin(-1)) * unit
    else:
        largest = torch.linalg.vector_norm(products, order, -1) * unit
    largest = torch.where(magnitude.isfinite(), largest, torch.nan)
    return largest.amax(-1).clamp(min=FLOOR_V).log()


@lru_cache(maxsize=16)
def _band_lines(num_samples: int, sample_rate_hz: float) -> Tensor:
    """Rows whose products with a bin, squared and added up, are its mean square in the band."""
    low, high = VIBRATION_HZ
    frequency = frequency_axis_hz(num_samples, sample_rate_hz, "clean")
    is_in = (frequency >= low) & (frequency <= high) & (frequency > 0)
    if not bool(is_in.any()):
        raise ValueError(
            f"no line of {num_samples} samples at {sample_rate_hz:g} Hz lies in {low:g} to "
            f"{high:g} Hz; lengthen the bins"
        )
    with torch.inference_mode(False):  # it may be needed for a gradient later
        rows = spectrum_matrix(num_samples, "clean")  # of amplitudes: a tone has half its square
        is_tone = 2 * torch.arange(len(rows)) < num_samples  # but for half the sample rate
        rows = torch.where(is_tone[:, None], rows / 2**0.5, rows)[is_in]
        return torch.cat([rows.real, rows.imag])
