"""Bins that real hands produce and textbooks do not: dead sensors, rails, offsets, lost tones.

For the certificate and for tests: each kind is a corner in which sums of squares cancel, overflow
or underflow, or a descriptor's definition ends.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

RAIL_V = 5.0
COUNT_V = 2 * RAIL_V / 2**16
"""One count of a converter of 16 bits."""

EXTREMES = (
    "plain",
    "constant",
    "zero",
    "spike",
    "offset 1e6, vibration 1e-6",
    "offset 1e3, vibration 1e-2",
    "rails",
    "outlier",
    "integers",
    "alternating",
    "ramp",
    "denormal",
    "huge",
    "tone without gain",
    "constant and dither",
    "synchronous",
    "mixed magnitudes",
)
"""Names of the kinds."""


def extreme_bins(
    kind: str,
    shape: Sequence[int],
    generator: torch.Generator,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Generated bins of one kind, in volts; drawn in float64 and rounded once.

    Args:
        kind: one of ``EXTREMES``.
        shape: of the result; the last axis is time and has at least two samples.
        generator: source of the random numbers.
        dtype: of the result. ``"denormal"`` and ``"huge"`` suit their size to it.

    Shape:
        - output: ``shape``

    Raises:
        ValueError: for an unknown kind or fewer than two samples.

    Example:
        >>> extreme_bins("rails", (3, 24, 100), torch.Generator().manual_seed(0)).unique()
        tensor([-5.,  5.], dtype=torch.float64)
    """
    size = tuple(shape)
    if not size or size[-1] < 2:
        raise ValueError(f"a bin needs at least two samples, got shape {size}")
    num, each = size[-1], (*size[:-1], 1)  # shape of one number a signal

    def noise(shape: tuple[int, ...] = size) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def uniform(shape: tuple[int, ...] = size) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    def power_of_ten(low: float, high: float) -> Tensor:
        return 10 ** (low + (high - low) * uniform(each))

    def is_at_one_sample() -> Tensor:
        return torch.arange(num) == torch.randint(num, each, generator=generator)

    limits = torch.finfo(dtype)
    match kind:
        case "plain":
            bins = noise() * power_of_ten(-4, 0)
        case "constant":
            bins = (2 * RAIL_V * uniform(each) - RAIL_V).expand(size).clone()
        case "zero":
            bins = torch.zeros(size, dtype=torch.float64)
        case "spike":
            height = noise(each) * power_of_ten(-6, 3)
            bins = torch.where(is_at_one_sample(), height, 0.0)
        case "offset 1e6, vibration 1e-6":
            bins = 1e6 + 1e-6 * noise()
        case "offset 1e3, vibration 1e-2":
            bins = 1e3 + 1e-2 * noise()
        case "rails":
            bins = RAIL_V * torch.where(uniform() < 0.5, -1.0, 1.0)
        case "outlier":
            quiet = 1e-3 * noise()
            bins = torch.where(is_at_one_sample(), RAIL_V, quiet)
        case "integers":
            bins = torch.randint(-3, 4, size, generator=generator)
        case "alternating":
            bins = (1.0 - 2.0 * (torch.arange(num) % 2)) * power_of_ten(-3, 1).expand(size)
        case "ramp":
            bins = noise(each) * torch.linspace(-1, 1, num, dtype=torch.float64)
        case "denormal":
            bins = noise() * (limits.tiny / 8)
        case "huge":
            bins = noise() * min(1e30, limits.max / 1e6)
        case "tone without gain":  # of whole counts; a moving average over its period is 0
            one = torch.randint(-9000, 9000, (*size[:-1], 51), generator=generator)
            is_short = uniform(each) < 0.5
            one[..., 11:] = torch.where(is_short, 0, one[..., 11:])
            one[..., :1] -= one.sum(-1, keepdim=True)
            period = torch.where(is_short, 11, 51)
            bins = COUNT_V * one.gather(-1, torch.arange(num) % period)
        case "constant and dither":
            counts = torch.randint(-(2**14), 2**14, each, generator=generator)
            bins = COUNT_V * (counts + torch.randint(0, 2, size, generator=generator))
        case "synchronous":  # a tone of which each period gives the same one, two or four samples
            turns = torch.tensor([1.0, 0.5, 0.25])[torch.randint(3, each, generator=generator)]
            phase = 2 * torch.pi * uniform(each)
            bins = torch.sin(2 * torch.pi * ((turns * torch.arange(num)) % 1) + phase)
        case "mixed magnitudes":
            most = 40.0 if limits.max > 1e40 else 36.0
            bins = noise() * power_of_ten(-most, most)
        case _:
            raise ValueError(f"kind must be one of {', '.join(EXTREMES)}, got {kind!r}")
    return bins.to(dtype)
