"""Hands unlike the paper's, noise that they feel, and detectors trained on it."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pywt
import torch

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.selection import ClassMoments, rank_features, t_scores
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.signals.filtering import Align, ChannelFilter, frame_lengths
from tactslip_torch.signals.wavelet import WaveletFilters, highest_level
from tactslip_torch.training.recipe import Paper


def own_wavelet() -> WaveletFilters:
    """Filters that no name stands for."""
    low, high, low_back, high_back = map(np.array, pywt.Wavelet("bior2.2").filter_bank)
    return WaveletFilters("own", 1.25 * low, 1.25 * high, low_back / 1.25, high_back / 1.25)


def own_kernels(channel_filter: ChannelFilter, seed: int = 7) -> dict[int, tuple[float, ...]]:
    """Kernels near those of a filter, which sum to 1 and, if it is centred, are symmetric."""
    generator = torch.Generator().manual_seed(seed)
    kernels = {}
    for length in {own for own in channel_filter.window_lengths if own > 1}:
        kernel = channel_filter.kernel(channel_filter.window_lengths.index(length))
        noise = torch.randn(length, generator=generator, dtype=torch.float64) / length
        kernel = kernel + (noise if channel_filter.align == "causal" else noise + noise.flip(0))
        kernels[length] = tuple((kernel / kernel.sum()).tolist())
    return kernels


@dataclass(frozen=True)
class AnyHand:
    """A hand and how its bins are laid.

    Args:
        channels: number of them by kind and by how they adapt.
        rate_hz: samples per second.
        bin_samples: length of a bin.
        hop: samples between decisions.
        frames: as ``features.frames``.
        wavelet: of the branches.
        level: of the branches, ``None`` for as many as there can be.
        align: of the filter.
        size: of the noise, in whatever unit.
        offset: that it stands on.
        num_features: to select.
        has_own_filters: whether wavelet and kernels of the filter are numbers of its own.
    """

    channels: dict[tuple[str, str], int]
    rate_hz: float
    bin_samples: int
    hop: int
    frames: dict[str, int | None]
    wavelet: str = "rbio2.2"
    level: int | None = None
    align: Align = "centred"
    size: float = 0.1
    offset: float = 0.0
    num_features: int = 12
    has_own_filters: bool = False

    def layout(self) -> HandLayout:
        """The channels, kinds by turns."""
        rows = [
            (place / num, Channel(f"{kind}{place}", kind, f"finger{place % 3}", "tip", adapting))
            for (kind, adapting), num in self.channels.items()
            for place in range(num)
        ]
        return HandLayout([channel for _, channel in sorted(rows, key=lambda row: row[0])])

    def pool(self) -> FeaturePool:
        highest = min(4, highest_level(self.bin_samples, self.wavelet))
        wavelet: str | WaveletFilters = self.wavelet
        if self.has_own_filters:
            wavelet = own_wavelet()
        return FeaturePool(
            self.layout(),
            self.rate_hz,
            bin_samples=self.bin_samples,
            wavelet=wavelet,
            level=self.level or highest,
        )

    def channel_filter(self) -> ChannelFilter:
        lengths = frame_lengths(self.layout(), self.frames)
        layer = ChannelFilter(lengths, align=self.align)
        if self.has_own_filters:
            layer = ChannelFilter(lengths, align=self.align, kernels=own_kernels(layer))
        return layer

    def noise(self, num: int, num_samples: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Raw bins, every other one slip, louder and smoother: ``[N, C, T]`` and ``[N]``."""
        generator = torch.Generator().manual_seed(seed)
        num_channels = sum(self.channels.values())
        shape = (num, num_channels, num_samples + 1)
        x = torch.randn(shape, generator=generator, dtype=torch.float64)
        loudness = 10 ** (torch.rand(num, 1, 1, generator=generator, dtype=torch.float64) - 0.5)
        is_slip = torch.arange(num) % 2 == 1
        rough, smooth = x[..., 1:], (x[..., 1:] + x[..., :-1]) / 2**0.5
        x = torch.where(is_slip[:, None, None], 3.0 * smooth, rough) * loudness
        return self.size * x + self.offset, is_slip


HANDS = {
    "24 electrodes at 100 Hz": AnyHand(
        {("electrode", "fast"): 24}, 100.0, 64, 32, {"electrode": 3}, size=40.0, offset=2000.0
    ),
    "one fast": AnyHand({("PVDF", "fast"): 1}, 2000.0, 100, 20, {"PVDF": 11}),
    "one slow": AnyHand({("force", "slow"): 1}, 50.0, 16, 8, {"force": None}, num_features=6),
    "bins of 5 samples": AnyHand(
        {("force", "slow"): 3}, 40.0, 5, 2, {"force": 3}, "haar", num_features=9, offset=1.0
    ),
    "five slow": AnyHand(
        {("SG", "slow"): 3, ("force", "slow"): 2}, 500.0, 50, 25, {"SG": 7, "force": None}
    ),
    "40 at 1 kHz": AnyHand(
        {("taxel", "fast"): 30, ("thermistor", "slow"): 10},
        1000.0,
        30,
        10,
        {"taxel": 5, "thermistor": 1},
        "db3",
        2,
        "causal",
        num_features=40,
    ),
    "one of 120 features by haar": AnyHand(
        {("electrode", "fast"): 1}, 2000.0, 100, 50, {"electrode": 11}, "haar", num_features=120
    ),
    "own filters": AnyHand(
        {("PVDF", "fast"): 2, ("SG", "slow"): 2},
        2000.0,
        100,
        20,
        {"PVDF": 11, "SG": 51},
        offset=1.0,
        num_features=40,
        has_own_filters=True,
    ),
    "own filters, causal": AnyHand(
        {("PVDF", "fast"): 2, ("SG", "slow"): 1},
        2000.0,
        100,
        20,
        {"PVDF": 11, "SG": 25},
        "bior2.2",
        align="causal",
        has_own_filters=True,
    ),
    "64 unfiltered": AnyHand(
        {("barometer", "fast"): 64}, 92.0, 41, 20, {"barometer": None}, "sym4", align="trailing"
    ),
}


@cache
def detector_of(name: str, backend: BackendName = "auto") -> SlipDetector:
    """A detector of one of ``HANDS``, trained on its noise."""
    hand = HANDS[name]
    pool, channel_filter = hand.pool(), hand.channel_filter()
    samples, is_slip = hand.noise(400, hand.bin_samples + 2 * channel_filter.context, seed=1)
    features = pool(channel_filter.valid(samples))
    moments = ClassMoments(len(pool.names))
    moments.update(features.float(), is_slip)
    scores, allowed = t_scores(moments), Paper(num_features=1).allowed(pool)
    scores[~allowed] = 0.0
    selected = rank_features(scores, hand.num_features).tolist()
    scaler = FeatureScaler.fit(features[:, selected])
    machine = fit_machine(TrainingBins(scaler(features[:, selected]), is_slip), 1.0)
    rule = Cusum(0.5, 0.4, 8.0)
    settings = AlarmSettings(
        hand.hop, Platt(4.0, 0.0), rule, threshold=2.0137, target_per_hour=1.0, rearm_s=0.0
    )
    info = {"simulated": False, KEY: settings.to_dict()}
    return SlipDetector(pool, channel_filter, selected, scaler, machine, info, backend=backend)
