"""Features that rounding alone decides, whatever a channel feels: of some wavelets there are a few.

The details of Haar's, for one, come in pairs of opposite sign, so that their mean, their median and
their skewness are zero but for rounding. Two backends differ in them altogether, and a machine that
took them in would be another on every host.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.signals.spectrum import SpectrumMethod
from tactslip_torch.signals.wavelet import Wavelet

_BINS = 128  # of noise
_MOVE = 1e-13  # of its size, by which each sample is moved
_LARGE = 1e-3  # of its spread, by which a feature may move with that
_NONE = 1e-12  # a spread that is none
_SHARE = 1 / 16  # of bins, in which it may move further: a value may lie at an edge by chance


def is_rounding(pool: FeaturePool) -> Tensor:
    """Which features of a pool rounding decides, ``[F]``, bool; none for the paper's wavelet.

    Found on noise of size one: such a feature has no spread to speak of, or moves by much of it
    where samples move by ``1e-13``.
    """
    of_fast = _of_fast_channel(pool.bin_samples, pool.wavelet, pool.level, pool.spectrum)
    num_slow = len(pool.names) - len(pool.hand.fast) * len(of_fast)
    slow = torch.zeros(num_slow, dtype=torch.bool)
    return torch.cat([slow, of_fast.repeat(len(pool.hand.fast))])


@lru_cache(maxsize=16)
def _of_fast_channel(
    bin_samples: int, wavelet: Wavelet, level: int, spectrum: SpectrumMethod
) -> Tensor:
    """The same of the features of one channel that adapts fast."""
    hand = HandLayout((Channel("noise", "noise", "none", "none", "fast"),))
    options = {"bin_samples": bin_samples, "wavelet": wavelet, "level": level}
    pool = FeaturePool(hand, spectrum=spectrum, **options)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode(False), torch.no_grad():
        bins, move = torch.randn(2, _BINS, 1, bin_samples, generator=generator).double()
        before, after = pool(bins), pool(bins + _MOVE * move)
    spread = before.std(0)
    is_large = (after - before).abs() > _LARGE * spread
    found: Tensor = (is_large.double().mean(0) > _SHARE) | (spread < _NONE)
    return found
