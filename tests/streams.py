"""Streams of a small hand, and detectors that watch them."""

import numpy as np
import torch
from small_detector import HAND, small_detector

from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.signals.filtering import ChannelFilter


def hand_of(kinds):
    """A hand by letters: ``"GFF"`` is a slow channel and two fast ones."""
    words = {"G": "SG", "F": "PVDF"}
    return HandLayout.from_rows(
        {"name": f"{words[kind]}{i}", "kind": words[kind], "finger": "index", "segment": "distal"}
        for i, kind in enumerate(kinds)
    )


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


def onset_of(samples, hand=HAND, seed=0, quantile=0.9, rate_hz=2000.0, hop=10):
    """A drawn classifier whose threshold so many hops of ``samples [C, T]`` do not reach.

    The mains are such that the comb has a part of a sample.
    """
    rng = np.random.default_rng(seed)
    evidence = OnsetEvidence(hand, rate_hz, hop, (1e-4,) * len(hand), 60.0, 2)
    columns, _, _ = evidence.columns(evidence.blocks_of_recording(samples))
    scaler, num = FeatureScaler.fit(columns), evidence.num_columns
    bend, linear = rng.standard_normal((num, num)) / num, rng.standard_normal(num)
    numbers = bend + bend.T, linear, np.array(0.1)
    head = QuadraticForm(*map(torch.from_numpy, numbers))
    threshold = float(head(scaler(columns)).quantile(quantile))
    hint = float(head(scaler(columns)).quantile(0.8 * quantile))
    return OnsetClassifier(evidence, scaler, head, threshold, hint, lead_s=0.004)
