"""Bins to measure with: generated ones of several kinds, and those of simulated recordings."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation.extremes import extreme_bins
from tactslip_torch.simulation.source import SimulatedRecordings
from tactslip_torch.training.datamodule import FeatureMaker

RANDOM, TIED, NEAR_CONSTANT, DEGENERATE = "random", "tied", "near constant", "degenerate"
KINDS = (RANDOM, TIED, NEAR_CONSTANT)
"""What is timed."""
DESCRIBED = {
    RANDOM: "normal noise of one volt",
    TIED: "whole counts of a 16-bit converter over 10 V, about 2 of them or about 900",
    NEAR_CONSTANT: "an offset of volts with noise of 1e-4 of it; in every third bin of 1e-16",
    DEGENERATE: "every second bin zero, constant, a spike, at the rails, alternating or a ramp",
}
_ODD = ("zero", "constant", "spike", "rails", "alternating", "ramp")
_VOLTS_A_COUNT = 10 / 2**16
_MATERIALS = ("M1", "M2", "M3", "M4", "M5", "M6")
WINDOW_LENGTHS = (51,) * 14 + (11,) * 10


class Labelled(NamedTuple):
    """Filtered bins ``[N, C, n]`` of simulated recordings, and whether each is slip ``[N]``."""

    bins: Tensor
    is_slip: Tensor


def bins_of(
    kind: str, num: int, num_channels: int = 24, num_samples: int = 100, seed: int = 0
) -> Tensor:
    """Generated bins of one kind.

    Args:
        kind: key of ``DESCRIBED``.
        num: how many.
        num_channels: C.
        num_samples: n.
        seed: of the noise.

    Shape:
        - output: ``[num, C, n]``, float64, volts
    """
    generator = torch.Generator().manual_seed(seed)
    shape = (num, num_channels, num_samples)
    noise = torch.randn(shape, generator=generator, dtype=torch.float64)
    if kind == RANDOM:
        return noise
    each = torch.randn(num, num_channels, 1, generator=generator, dtype=torch.float64)
    place = torch.arange(num)[:, None, None]
    if kind == TIED:
        return (torch.where(each > 0, 2.0, 900.0) * noise).round() * _VOLTS_A_COUNT
    if kind == NEAR_CONSTANT:
        part = torch.where(place % 3 == 2, 1e-16, 1e-4)
        return each.sign() * (1 + each.abs()) * (1 + part * noise)
    for index in range(0, num, 2):
        odd = _ODD[index // 2 % len(_ODD)]
        noise[index] = extreme_bins(odd, shape[1:], generator)
    return noise


def simulated_bins(num: int) -> Tensor:
    """Filtered bins ``[num, 24, 100]`` of a simulated recording, over and over; float64."""
    bins = labelled_bins(1).bins
    return bins[torch.arange(num) % len(bins)].clone()


@cache
def labelled_bins(num_recordings: int) -> Labelled:
    """Bins of simulated recordings of one material after the other. Do not write into them."""
    source = SimulatedRecordings(cycles=-(-num_recordings // 6), materials=_MATERIALS)
    channel_filter = ChannelFilter(WINDOW_LENGTHS)
    maker = FeatureMaker(source, FeaturePool(source.hand), channel_filter, LabelRule())
    ids = sorted(source.ids, key=lambda recording: (recording.cycle, recording.material))
    parts = [maker.filtered_bins(recording) for recording in ids[:num_recordings]]
    return Labelled(
        torch.cat([bins for bins, _ in parts]), torch.cat([laid.is_slip for _, laid in parts])
    )


@cache
def raw_bins(num: int) -> Tensor:
    """Raw bins of a simulated recording with their context, ``[num, 24, 150]``, float32."""
    source = SimulatedRecordings(cycles=1, materials=["M1"])
    context = ChannelFilter(WINDOW_LENGTHS).context
    samples = source.load(source.ids[0]).samples
    starts = torch.linspace(0, samples.shape[-1] - 100 - 2 * context, num).long()
    cut = [samples[:, start : start + 100 + 2 * context] for start in starts.tolist()]
    return torch.stack(cut).float()
