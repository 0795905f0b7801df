"""Small batches of extreme samples of several lengths, for comparison with exact arithmetic."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import oracles
import torch
from torch import Tensor

from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins

SIZES = ((4, 2), (4, 3), (3, 7), (2, 100))

_Draw = Callable[[tuple[int, int], torch.Generator, torch.dtype], Tensor]


def _noise(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)


def _largest(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Both ends of the dtype and values between: their difference is no float."""
    share = _noise(shape, generator, dtype).clamp(-1, 1)
    return share * torch.finfo(dtype).max


def _one_end(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """All within a few digits of the largest number: their sum is no float."""
    few = 1 - 1e-3 * _noise(shape, generator, dtype).abs()
    return few * torch.finfo(dtype).max


def _quanta(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """A few times the smallest number."""
    facts = torch.finfo(dtype)
    return torch.randint(-3, 7, shape, generator=generator).to(dtype) * (facts.tiny * facts.eps)


def _two_sizes(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """One huge value among ordinary ones."""
    x = _noise(shape, generator, dtype)
    x[:, -1] *= torch.finfo(dtype).max / 64
    return x


def _wide(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Magnitudes over 20 decades."""
    x = _noise(shape, generator, torch.float64)
    return (x * 10 ** (6 * _noise(shape, generator, torch.float64).clamp(-2, 2))).to(dtype)


def _plausible(shape: tuple[int, int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Filtered bins of some channels: preload, bursts, a rail, a dead channel."""
    seed = int(torch.randint(2**31, (1,), generator=generator))
    bins = oracles.plausible_bins(np.random.default_rng(seed), 1)[0, [0, 14, 15, 16][: shape[0]]]
    return torch.from_numpy(bins[:, : shape[1]].copy()).to(dtype)


_DRAWS: dict[str, _Draw] = {
    "largest": _largest,
    "one end": _one_end,
    "quanta": _quanta,
    "two sizes": _two_sizes,
    "wide": _wide,
    "plausible": _plausible,
}
KINDS = (*EXTREMES, *_DRAWS)


def samples(kind: str, dtype: torch.dtype) -> list[Tensor]:
    """The same at every call."""
    generator = torch.Generator().manual_seed(zlib.crc32(kind.encode()))
    if kind in _DRAWS:
        return [_DRAWS[kind](size, generator, dtype) for size in SIZES]
    return [extreme_bins(kind, size, generator, dtype) for size in SIZES]
