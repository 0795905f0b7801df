"""Bins that real hands produce and textbooks do not: dead sensors, rails, offsets, denormals.

For the certificate and for tests: each kind is a corner in which sums of squares cancel, overflow
or underflow, or a descriptor's definition ends.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

RAIL_V = 5.0

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
        case _:
            raise ValueError(f"kind must be one of {', '.join(EXTREMES)}, got {kind!r}")
    return bins.to(dtype)
