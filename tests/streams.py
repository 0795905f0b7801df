"""Streams of a small hand, and detectors that watch them."""

import numpy as np
import torch
from small_detector import small_detector

from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter


def signal(num_samples, seed=0, dtype=torch.float64):
    """Noise ``[4, T]`` in volts whose size changes by and by, the gauges on an offset."""
    rng = np.random.default_rng(seed)
    loudness = np.interp(
        np.arange(num_samples),
        np.arange(0, num_samples + 300, 150),
        10 ** rng.uniform(-2, 0, (num_samples + 449) // 150),
    )
    samples = loudness * rng.standard_normal((4, num_samples))
    offsets = np.array([1.0, -0.5, 0.0, 0.0])[:, None]
    return torch.from_numpy(samples + offsets).to(dtype)


def detector_of(kind="all", align="centred", backend="auto"):
    """The small detector, or that part of it which looks at films (``"PVDF"``) alone."""
    whole = small_detector(backend=backend)
    layer = ChannelFilter(whole.channel_filter.window_lengths, align=align)
    names = whole.selected_names
    kept = [i for i, name in enumerate(names) if kind == "all" or name.channel.startswith(kind)]
    head, scaler = whole.head, whole.scaler
    part = QuadraticForm(head.quadratic[kept][:, kept], head.linear[kept], head.constant)
    ranges = FeatureScaler(scaler.minimum[kept], scaler.maximum[kept])
    selected = [whole.selected[i] for i in kept]
    return SlipDetector(whole.pool, layer, selected, ranges, part, backend=backend)
