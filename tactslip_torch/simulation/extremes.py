"""Bins that real hands produce and textbooks do not: dead sensors, rails, offsets, denormals.

For the certificate and for tests: each kind is a corner in which sums of squares cancel, overflow
or underflow, or a descriptor's definition ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

RAIL_V = 5.0

_Draw = Callable[[tuple[int, ...], torch.Generator], Tensor]


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
    if kind not in _DRAWS and kind not in ("denormal", "huge"):
        raise ValueError(f"kind must be one of {', '.join(EXTREMES)}, got {kind!r}")
    size = tuple(shape)
    if not size or size[-1] < 2:
        raise ValueError(f"a bin needs at least two samples, got shape {size}")
    if kind in _DRAWS:
        return _DRAWS[kind](size, generator).to(dtype)
    facts = torch.finfo(dtype)
    if kind == "denormal":
        return (_noise(size, generator) * (facts.tiny / 8)).to(dtype)
    return (_noise(size, generator) * min(1e30, facts.max / 1e6)).to(dtype)


def _noise(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def _sizes(shape: tuple[int, ...], generator: torch.Generator, low: float, high: float) -> Tensor:
    """One power of ten per signal, between ``10^low`` and ``10^high``."""
    share = torch.rand((*shape[:-1], 1), generator=generator, dtype=torch.float64)
    return 10 ** (low + (high - low) * share)


def _one_sample(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """True at one sample of every signal."""
    place = torch.randint(shape[-1], (*shape[:-1], 1), generator=generator)
    return torch.arange(shape[-1]) == place


def _plain(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return _noise(shape, generator) * _sizes(shape, generator, -4, 0)


def _constant(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return (2 * RAIL_V * _uniform((*shape[:-1], 1), generator) - RAIL_V).expand(shape).clone()


def _uniform(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def _zero(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.zeros(shape, dtype=torch.float64)


def _spike(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    height = _noise((*shape[:-1], 1), generator) * _sizes(shape, generator, -6, 3)
    return torch.where(_one_sample(shape, generator), height, 0.0)


def _offset(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return 1e6 + 1e-6 * _noise(shape, generator)


def _gauge(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return 1e3 + 1e-2 * _noise(shape, generator)


def _rails(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return RAIL_V * torch.where(_uniform(shape, generator) < 0.5, -1.0, 1.0)


def _outlier(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    quiet = 1e-3 * _noise(shape, generator)
    return torch.where(_one_sample(shape, generator), RAIL_V, quiet)


def _integers(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    return torch.randint(-3, 4, shape, generator=generator).double()


def _alternating(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    sign = 1.0 - 2.0 * (torch.arange(shape[-1]) % 2)
    return sign * _sizes(shape, generator, -3, 1).expand(shape)


def _ramp(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    slope = _noise((*shape[:-1], 1), generator)
    return slope * torch.linspace(-1, 1, shape[-1], dtype=torch.float64)


_DRAWS: dict[str, _Draw] = {
    "plain": _plain,
    "constant": _constant,
    "zero": _zero,
    "spike": _spike,
    "offset 1e6, vibration 1e-6": _offset,
    "offset 1e3, vibration 1e-2": _gauge,
    "rails": _rails,
    "outlier": _outlier,
    "integers": _integers,
    "alternating": _alternating,
    "ramp": _ramp,
}
EXTREMES: tuple[str, ...] = (*_DRAWS, "denormal", "huge")
"""Names of the kinds."""
