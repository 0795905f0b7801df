"""Bins by kind in which sums cancel, overflow or underflow, or a descriptor's definition ends.

``TACTSLIP_SEED`` drives what hypothesis draws; the head of a run says which seed it has.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from hypothesis import strategies as st
from torch import Tensor

from tactslip_torch import HandLayout
from tactslip_torch.pretrained import sample_recording

SEED = int(os.environ.get("TACTSLIP_SEED", "1"))
RAIL_V = 5.0
COUNT_V = 2 * RAIL_V / 2**16  # of a converter of 16 bits


@dataclass
class Draw:
    """Random numbers of a shape whose last axis is time."""

    shape: tuple[int, ...]
    generator: torch.Generator
    limits: torch.finfo

    @property
    def each(self) -> tuple[int, ...]:
        return (*self.shape[:-1], 1)

    def noise(self, shape: Sequence[int] | None = None) -> Tensor:
        return torch.randn(shape or self.shape, generator=self.generator, dtype=torch.float64)

    def uniform(self, shape: Sequence[int] | None = None) -> Tensor:
        return torch.rand(shape or self.shape, generator=self.generator, dtype=torch.float64)

    def whole(self, low: int, high: int, shape: Sequence[int] | None = None) -> Tensor:
        return torch.randint(low, high, shape or self.each, generator=self.generator)

    def power(self, low: float, high: float) -> Tensor:
        return 10 ** (low + (high - low) * self.uniform(self.each))

    @property
    def time(self) -> Tensor:
        return torch.arange(self.shape[-1], dtype=torch.float64)

    @property
    def at_one(self) -> Tensor:
        return self.time == self.whole(0, self.shape[-1])


def _tone_without_gain(draw: Draw) -> Tensor:
    """Of whole counts; a moving average over its period of 11 or 51 samples is 0."""
    one, is_short = draw.whole(-9000, 9000, (*draw.shape[:-1], 51)), draw.uniform(draw.each) < 0.5
    one[..., 11:] = torch.where(is_short, 0, one[..., 11:])
    one[..., :1] -= one.sum(-1, keepdim=True)
    return COUNT_V * one.gather(-1, draw.time.long() % torch.where(is_short, 11, 51))


def _synchronous(draw: Draw) -> Tensor:
    """A tone of which each period gives the same one, two or four samples."""
    turns = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)[draw.whole(0, 3)]
    return torch.sin(2 * torch.pi * ((turns * draw.time) % 1 + draw.uniform(draw.each)))


def _mixed(draw: Draw) -> Tensor:
    most = 40.0 if draw.limits.max > 1e40 else 36.0
    return draw.noise() * draw.power(-most, most)


_KINDS: Mapping[str, Callable[[Draw], Tensor]] = {
    "plain": lambda d: d.noise() * d.power(-4, 0),
    "constant": lambda d: 2 * RAIL_V * d.uniform(d.each) - RAIL_V,
    "zero": lambda d: torch.zeros(d.each),
    "spike": lambda d: torch.where(d.at_one, d.noise(d.each) * d.power(-6, 3), 0.0),
    "offset 1e6, vibration 1e-6": lambda d: 1e6 + 1e-6 * d.noise(),
    "offset 1e3, vibration 1e-2": lambda d: 1e3 + 1e-2 * d.noise(),
    "rails": lambda d: RAIL_V * torch.where(d.uniform() < 0.5, -1.0, 1.0),
    "outlier": lambda d: torch.where(d.at_one, RAIL_V, 1e-3 * d.noise()),
    "integers": lambda d: d.whole(-3, 4, d.shape),
    "alternating": lambda d: (1.0 - 2.0 * (d.time % 2)) * d.power(-3, 1),
    "ramp": lambda d: d.noise(d.each) * torch.linspace(-1, 1, d.shape[-1]).double(),
    "denormal": lambda d: d.noise() * (d.limits.tiny / 8),
    "huge": lambda d: d.noise() * min(1e30, d.limits.max / 1e6),
    "tone without gain": _tone_without_gain,
    "constant and dither": lambda d: COUNT_V * (d.whole(-(2**14), 2**14) + d.whole(0, 2, d.shape)),
    "synchronous": _synchronous,
    "mixed magnitudes": _mixed,
}
EXTREMES = tuple(_KINDS)


def extreme_bins(
    kind: str,
    shape: Sequence[int],
    generator: torch.Generator,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Bins of one of ``EXTREMES`` in volts; drawn in float64 and rounded once."""
    found = _KINDS[kind](Draw(tuple(shape), generator, torch.finfo(dtype)))
    return found.expand(tuple(shape)).to(dtype).clone()


def generator(drawn: int) -> torch.Generator:
    """Random numbers that depend on the run's seed and a number that hypothesis drew."""
    return torch.Generator().manual_seed((SEED * 1_000_003 + drawn) % 2**63)


ORDINARY = ("plain", "integers", "ramp")  # drawn as often as all the others together


def mixed_bins(drawn: int, shape: tuple[int, int, int], dtype: torch.dtype) -> Tensor:
    """Bins ``[N, C, n]`` whose channels are of random kinds, each its own."""
    source = generator(drawn)
    menu = (*EXTREMES, *ORDINARY * (len(EXTREMES) // len(ORDINARY)))
    choice = torch.randint(len(menu), shape[:2], generator=source)
    bins = torch.empty(shape, dtype=dtype)
    for index, kind in enumerate(menu):
        here = choice == index
        bins[here] = extreme_bins(kind, (int(here.sum()), shape[-1]), source, dtype)
    return bins


def batches(shape: tuple[int, int, int], dtype: torch.dtype) -> st.SearchStrategy[Tensor]:
    """``mixed_bins`` by a number that hypothesis shrinks, which is as good as any."""
    return st.integers(0, 2**40).map(lambda drawn: mixed_bins(drawn, shape, dtype))


def slip_samples(hand: HandLayout, dtype: torch.dtype = torch.float64) -> Tensor:
    """1.5 s of the recording that comes with the package around its onset, ``[C, T]``, volts.

    Each channel is the first of the paper's hand that adapts as it does, or the next.
    """
    recording, paper = sample_recording(), HandLayout.paper24()
    start = round((recording.onsets_s[0] - 1.0) * 2000)
    places = {"slow": iter(paper.slow), "fast": iter(paper.fast)}
    rows = [next(places[str(channel.adapting)]) for channel in hand.channels]
    return recording.samples[rows, start : start + 3000].to(dtype).contiguous()
