"""Branches and spectra of a bin as products with constant matrices, through their low rank.

A detail branch of 100 samples has only 51, 27, 15 or 9 degrees of freedom, the coarsest
approximation 10: a bin goes to those few numbers first, and from there to the branch and to its
spectrum. All constants are float64, made from ``branch_matrix`` and ``spectrum_matrix``, so from
ptwt and torch.fft evaluated on an identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.spectrum import SpectrumMethod, frequency_axis_hz, spectrum_matrix
from tactslip_torch.signals.wavelet import Wavelet, branch_matrix, branch_names

RANK_TOLERANCE = 1e-12
"""Singular values below this part of the largest are rounding."""


@dataclass(frozen=True)
class LinearMaps:
    """Constant matrices of one kind of bin; ``n`` samples, ``L`` lines, ``r`` the branch's rank.

    Args:
        branches: names of the branches, in their order everywhere.
        is_approximation: which of them keep a constant; details remove it.
        dense: each branch, ``[n, n]``: ``branch = dense @ bin``.
        into: from a bin to the branch's few numbers, ``[r, n]``, orthonormal rows.
        out: from those to the branch, ``[n, r]``.
        lines: from those to the spectrum before its modulus, ``[2 L, r]``: L cosine rows, then
            L sine rows.
        dense_lines: from a branch (or any signal) to the same, ``[2 L, n]``.
        ones_lines: of the constant 1, ``[2 L]``.
        frequency_hz: of the lines, ``[L]``.
    """

    branches: tuple[str, ...]
    is_approximation: tuple[bool, ...]
    dense: tuple[Tensor, ...]
    into: tuple[Tensor, ...]
    out: tuple[Tensor, ...]
    lines: tuple[Tensor, ...]
    dense_lines: Tensor
    ones_lines: Tensor
    frequency_hz: Tensor

    @classmethod
    def of(cls, pool: FeaturePool) -> LinearMaps:
        """The maps behind a pool's features; made once, so do not write into them."""
        facts = (pool.bin_samples, pool.sample_rate_hz, pool.wavelet, pool.level, pool.spectrum)
        return _made(*facts)

    @property
    def num_samples(self) -> int:
        """Samples of a bin."""
        return self.dense_lines.shape[1]

    @property
    def num_lines(self) -> int:
        """Lines of a spectrum."""
        return len(self.frequency_hz)


@lru_cache(maxsize=16)
def _made(
    num: int, sample_rate_hz: float, wavelet: Wavelet, level: int, method: SpectrumMethod
) -> LinearMaps:
    spectrum = spectrum_matrix(num, method)
    dense_lines = torch.cat([spectrum.real, spectrum.imag]).contiguous()
    dense = branch_matrix(num, wavelet, level)
    factors = [_low_rank(matrix) for matrix in dense]
    names = branch_names(level)
    return LinearMaps(
        branches=names,
        is_approximation=tuple(name[0] == "A" for name in names),
        dense=tuple(dense),
        into=tuple(into for into, _ in factors),
        out=tuple(out for _, out in factors),
        lines=tuple((dense_lines @ out).contiguous() for _, out in factors),
        dense_lines=dense_lines,
        ones_lines=dense_lines.sum(-1),
        frequency_hz=frequency_axis_hz(num, sample_rate_hz, method),
    )


def _low_rank(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """``into [r, n]`` with orthonormal rows and ``out [n, r]``, whose product is ``matrix``."""
    left, sizes, right = torch.linalg.svd(matrix)
    rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
    return right[:rank].contiguous(), (left[:, :rank] * sizes[:rank]).contiguous()
