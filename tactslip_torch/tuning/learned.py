"""The settings that tuning learns, as parameters that start at those of a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.scaling import FeatureScaler, signed_log
from tactslip_torch.signals.filter_bank import WaveletFilters
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.learnable import LearnableSmoothing
from tactslip_torch.signals.lifting import LiftedWavelet
from tactslip_torch.tuning.bins import TuningBins
from tactslip_torch.tuning.described import in_chunks, selected_features

Setting = Literal["penalty", "offset", "scales", "smoothing", "wavelet"]
SETTINGS: tuple[Setting, ...] = get_args(Setting)
FILTERS = ("smoothing", "wavelet")


class LearnedSettings(nn.Module):
    """C, the kernel's c, a scale for each feature, smoothing kernels and a wavelet.

    A scale below 1 narrows a feature in the kernel, and one of 0 would leave it out: soft
    selection. It divides the width of the range that becomes [-1, 1], so that a scaler holds it:
    below 1 less of a feature's tails is clipped, above 1 more. Logarithms of C, c and scales are
    learned. Filters are admissible whatever is learned (``LiftedWavelet``, ``LearnableSmoothing``).

    Args:
        learn: which of ``SETTINGS``; the others stay.
        penalty: C to start from.
        offset: c to start from, positive if it is learned.
        scaler: ranges of the features.
        names: of the features.
        pool: their pool.
        channel_filter: of the bins.

    Raises:
        ValueError: for an unknown setting, an offset of 0 that is to be learned, or a wavelet that
            is not made by the lifting steps that can be.
    """

    def __init__(
        self,
        learn: Sequence[str],
        penalty: float,
        offset: float,
        scaler: FeatureScaler,
        names: Sequence[FeatureName],
        pool: FeaturePool,
        channel_filter: ChannelFilter,
    ) -> None:
        super().__init__()
        if unknown := [name for name in learn if name not in SETTINGS]:
            raise ValueError(f"tuning.learn has {unknown}; known are {', '.join(SETTINGS)}")
        if "offset" in learn and not offset > 0:
            raise ValueError(
                "tuning learns log c, which needs recipe.offsets above 0; leave it out"
            )
        self.learn = tuple(learn)
        self.names, self.pool, self.channel_filter = tuple(names), pool, channel_filter
        self._start = scaler
        self._offset = offset
        self.log_penalty = _parameter(math.log(penalty), "penalty" in learn)
        self.log_offset = _parameter(math.log(offset) if offset > 0 else 0.0, "offset" in learn)
        self.log_scales = _parameter([0.0] * len(self.names), "scales" in learn)
        self.smoothing = LearnableSmoothing(channel_filter) if "smoothing" in learn else None
        self.wavelet: LiftedWavelet | None = None
        if "wavelet" in learn:
            if not isinstance(pool.wavelet, str):
                raise ValueError("tuning learns a wavelet from a named one; take features.wavelet")
            self.wavelet = LiftedWavelet(pool.wavelet)

    @property
    def learns_filters(self) -> bool:
        """Whether features change, so that raw bins are needed."""
        return any(name in self.learn for name in FILTERS)

    @property
    def penalty(self) -> Tensor:
        """C, ``[]``."""
        return self.log_penalty.exp()

    @property
    def offset(self) -> Tensor:
        """The kernel's c, ``[]``."""
        return self.log_offset.exp() if self._offset > 0 else self.log_offset

    @property
    def scales(self) -> Tensor:
        """Of the features, 1 at first: ``[K]``."""
        return self.log_scales.exp()

    def features(self, bins: TuningBins) -> Tensor:
        """Unscaled features of bins, ``[N, K]``, by the filters as they are now."""
        if not self.learns_filters:
            return bins.features
        if bins.raw is None:
            raise ValueError("filters are learned from raw bins, these have none")
        pool = self.pool
        if self.wavelet is not None:
            pool = pool.with_branches(self.wavelet.branch_matrix(pool.bin_samples, pool.level))

        def described(raw: Tensor) -> Tensor:
            filtered = (self.smoothing or self.channel_filter.valid)(raw)
            return selected_features(pool, filtered, self.names)

        return in_chunks(described, bins.raw)

    def scaled(self, features: Tensor) -> Tensor:
        """Features in the kernel, ``[N, K]`` in [-1, 1]; what ``scaler()`` makes of them."""
        start, scales = self._start, self.scales
        if start.knee is not None:
            features = signed_log(features, start.knee)
        width = start.maximum - start.minimum
        is_point = width == 0
        relative = (features - start.minimum) / torch.where(is_point, 1.0, width)
        return torch.where(is_point, 0.0, scales * (2 * relative - 1)).clamp(-1, 1)

    def scaler(self) -> FeatureScaler:
        """The ranges that stand for the scales as they are now."""
        start, scales = self._start, self.scales.detach()
        middle = (start.minimum + start.maximum) / 2
        half = (start.maximum - start.minimum) / 2 / scales
        return FeatureScaler(middle - half, middle + half, start.knee)

    def frozen_wavelet(self) -> WaveletFilters | None:
        """The wavelet as it is now; None if it stays."""
        return None if self.wavelet is None else self.wavelet.frozen()


def _parameter(value: float | list[float], is_learned: bool) -> nn.Parameter:
    return nn.Parameter(torch.tensor(value, dtype=torch.float64), requires_grad=is_learned)
