"""Mean, standard deviation and rms of channels, out of features of the pool."""

from __future__ import annotations

import torch
from torch import Tensor

from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool


class SimpleStatistics:
    """Mean, standard deviation and rms of each channel's filtered bin, out of pool features.

    Of a fast channel the pool has wavelet branches alone. The first approximation and detail add up
    to the bin, ``x = A1 + D1``, so ``mean(x) = mean(A1) + mean(D1)``, and with the correlation
    ``r`` of each with ``x``, ``std(x) = r(A1) std(A1) + r(D1) std(D1)``.

    Args:
        pool: of the features.
    """

    def __init__(self, pool: FeaturePool) -> None:
        place = {name: index for index, name in enumerate(pool.names)}

        def of(channels: tuple[int, ...], component: str, descriptor: str) -> list[int]:
            names = (
                FeatureName(pool.hand.names[c], component, "time", descriptor) for c in channels
            )
            return [place[name] for name in names]

        self.num_samples = pool.bin_samples
        slow, fast = pool.hand.slow, pool.hand.fast
        self._slow = [of(slow, "raw", d) for d in ("mean", "std", "energy")]
        self._fast = {
            d: [of(fast, branch, d) for branch in ("A1", "D1")]
            for d in ("mean", "std", "correlation")
        }

    def __call__(self, features: Tensor) -> Tensor:
        """All means, then standard deviations, then rms, of slow channels and then of fast ones.

        Standard deviations have ``n - 1`` in the denominator, rms ``n``.

        Shape:
            - features: ``[N, F]``, of the whole pool; output: ``[N, 3 C]``, float64, in the unit of
              the samples
        """
        x, num = features.double(), self.num_samples
        mean, std, energy = (x[:, places] for places in self._slow)
        parts = {
            d: torch.stack([x[:, places] for places in of]) for d, of in self._fast.items()
        }  # [2, N, fast channels]
        fast_mean = parts["mean"].sum(0)
        fast_std = (parts["correlation"] * parts["std"]).sum(0).clamp(min=0.0)
        fast_rms = (fast_mean.square() + fast_std.square() * ((num - 1) / num)).sqrt()
        rms = (energy / num).sqrt()
        return torch.cat([mean, fast_mean, std, fast_std, rms, fast_rms], 1)
