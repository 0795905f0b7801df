"""What a model is tried on before it is left: noise, broken sensors, and a simulated slip."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import cycle

import torch
from torch import Tensor

from tactslip_torch.hand import HandLayout
from tactslip_torch.simulation.extremes import EXTREMES, RAIL_V, extreme_bins
from tactslip_torch.simulation.scene import Scene
from tactslip_torch.simulation.simulate import simulate

BROKEN = ("step", "nan", "inf", "-inf", "all nan")
KINDS: tuple[str, ...] = (*EXTREMES, *BROKEN)
"""Degenerate bins by name."""

_BEFORE_S, _AFTER_S = 1.0, 0.5  # of the simulated onset
_SPARE = 10  # samples that the simulator may leave out at the ends
_QUIET_V = 2e-3  # twice the least range of a channel of a detector of simulated recordings
_FEWEST_BINS = 4  # that a simulated slip lasts at least, whatever the rate


def noise_bins(hand: HandLayout, num: int, length: int, seed: int, dtype: torch.dtype) -> Tensor:
    """Noise of sizes from 1 V to 1 mV, the gauges on an offset: ``[num, C, length]``, volts."""
    generator = torch.Generator().manual_seed(seed)
    size = 10 ** torch.linspace(0, -3, num, dtype=torch.float64)[:, None, None]
    noise = torch.randn(num, len(hand), length, generator=generator, dtype=torch.float64)
    samples = size * noise
    samples[:, list(hand.slow)] += 1.0
    return samples.to(dtype)


def degenerate_bins(
    hand: HandLayout, kind: str, num: int, length: int, dtype: torch.dtype
) -> Tensor:
    """Bins of one of ``KINDS``, ``[num, C, length]``, volts.

    ``"nan"`` and the infinities are one sample of one channel of noise, wandering from bin to bin.
    """
    generator = torch.Generator().manual_seed(KINDS.index(kind))
    if kind in EXTREMES:
        return extreme_bins(kind, (num, len(hand), length), generator, dtype)
    samples = noise_bins(hand, num, length, KINDS.index(kind), dtype)
    rows = torch.arange(num)
    if kind == "step":
        edge = torch.randint(length, (num, len(hand), 1), generator=generator)
        return torch.where(torch.arange(length) < edge, 0.0, RAIL_V).to(dtype)
    if kind == "all nan":
        return samples.fill_(torch.nan)
    channels = torch.randint(len(hand), (num,), generator=generator)
    samples[rows, channels, torch.randint(length, (num,), generator=generator)] = float(kind)
    return samples


def dead_masks(hand: HandLayout, used: Tensor) -> dict[str, Tensor]:
    """Masks ``[C]`` of dead sensors by name: the first in use, every other one, all of them."""
    none = torch.zeros(len(hand), dtype=torch.bool)
    chosen = {"the first": used[:1], "every other": used[::2], "all": used}
    return {name: none.index_fill(0, own, True) for name, own in chosen.items()}


def simulated_stream(
    hand: HandLayout, sample_rate_hz: float, dtype: torch.dtype, at_least: int = 0
) -> Tensor:
    """A slip as the simulator records it, ``[C, T]``, volts; 1 s before its onset, .5 s behind.

    Of another hand than the simulated one, each channel is the next that adapts as it does. Where
    that makes fewer samples than ``at_least``, the rate is that at which it makes so many: what a
    model is tried on must fill bins, not keep time.
    """
    simulated = HandLayout.paper24()
    places = {"slow": cycle(simulated.slow), "fast": cycle(simulated.fast)}
    rows = [next(places[str(channel.adapting)]) for channel in hand.channels]
    fewest = (at_least + _SPARE) / (_BEFORE_S + _AFTER_S)
    return _simulated(max(sample_rate_hz, fewest))[rows].to(dtype)


def simulated_bins(
    hand: HandLayout, sample_rate_hz: float, num: int, length: int, dtype: torch.dtype
) -> Tensor:
    """Bins of the simulated slip, evenly spread over it: ``[num, C, length]``, volts."""
    samples = simulated_stream(hand, sample_rate_hz, dtype, _FEWEST_BINS * length)
    starts = torch.linspace(0, samples.shape[-1] - length, num).long()
    return samples.unfold(-1, length, 1)[:, starts].movedim(1, 0).contiguous()


def unit_of(least_range: Tensor | None) -> float:
    """What a volt is to a detector, a power of 2 from 1 on.

    One that leaves out channels which hardly move, by what it was trained on in another unit, must
    hear of something in what it is tried on.

    Args:
        least_range: of a channel that is not stuck, by kind (``ChannelPooling``).
    """
    if least_range is None or not len(least_range):
        return 1.0
    quietest = float(least_range.max()) / _QUIET_V
    return 2.0 ** max(math.ceil(math.log2(quietest)), 0) if quietest > 0 else 1.0


@lru_cache(maxsize=1)
def _simulated(sample_rate_hz: float) -> Tensor:
    """Of the whole hand, float64; not to be written to."""
    scene = Scene("M1", seed=1, sample_rate_hz=sample_rate_hz)
    onset_s = simulate(scene, windows=[]).onsets_s[0]
    window = (onset_s - _BEFORE_S, onset_s + _AFTER_S)
    samples = simulate(scene, windows=[window], dtype=torch.float64).samples
    return samples[:, samples.isfinite().all(0)]
