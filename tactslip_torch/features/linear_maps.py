"""Branches and spectra of a bin as products with constant matrices, through their low rank.

A detail branch of 100 samples has only 51, 27, 15 or 9 degrees of freedom, the coarsest
approximation 10: a bin goes to those few numbers first, and from there to the branch and to its
spectrum. All constants are float64, made from ``branch_matrix`` and ``spectrum_matrix``, so from
ptwt and torch.fft evaluated on an identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from tactslip_torch.signals.spectrum import SpectrumMethod, frequency_axis_hz, spectrum_matrix
from tactslip_torch.signals.wavelet import Wavelet, branch_matrix, branch_names

RANK_TOLERANCE = 1e-12
"""Singular values below this part of the largest are rounding."""


@dataclass(frozen=True)
class Block:
    """The coordinates of one branch, or of a slow channel's bin, and what is made of them.

    There are ``r`` of the branch less its mean, of the same length as it, and then its sum: the sum
    of whole numbers is exact.

    Args:
        into: from a bin to all coordinates, ``[n, r + 1]``.
        out: from the first r to the branch less its mean, ``[r, n]``; None if they are that.
        lines: from all to the spectrum before its modulus, ``[r + 1, 2 L]``: L real parts, then L
            imaginary ones.
        is_detail: whether its mean vanishes with the rest.
    """

    into: Tensor
    out: Tensor | None
    lines: Tensor
    is_detail: bool

    @property
    def rank(self) -> int:
        """Number of coordinates but the mean."""
        return self.into.shape[1] - 1

    def of_window(self, smooth: Tensor | None) -> Tensor:
        """From ``[x - first, first]`` to all coordinates, ``[W + 1, r + 1]``.

        ``first`` is the first sample of the bin: a small vibration keeps its digits on any offset,
        and details of a constant are exactly 0.

        Args:
            smooth: the filter, ``[n, W]``; None: ``x`` is filtered.
        """
        into = self.into if smooth is None else smooth.T @ self.into
        of_first = into.new_zeros(1, into.shape[1])
        of_first[0, -1] = 0.0 if self.is_detail else len(self.into)
        return torch.cat([into, of_first])

    @cached_property
    def energy_root(self) -> Tensor:
        """From coordinates to numbers whose squares add up to the energy of the spectrum."""
        triangle: Tensor = torch.linalg.qr(self.lines.T, mode="r").R
        return triangle.T


@dataclass(frozen=True)
class LinearMaps:
    """Constant matrices of one kind of bin; ``n`` samples, ``L`` lines, ``r`` the branch's rank.

    Args:
        branches: names of the branches, in their order everywhere.
        is_approximation: which of them keep a constant; details remove it.
        dense: each branch, ``[n, n]``: ``branch = dense @ bin``.
        dense_lines: from a branch (or any signal) to its spectrum before the modulus, ``[2 L, n]``:
            L cosine rows, then L sine rows.
        frequency_hz: of the lines, ``[L]``.
    """

    branches: tuple[str, ...]
    is_approximation: tuple[bool, ...]
    dense: tuple[Tensor, ...]
    dense_lines: Tensor
    frequency_hz: Tensor

    @property
    def num_samples(self) -> int:
        """Samples of a bin."""
        return self.dense_lines.shape[1]

    @property
    def num_lines(self) -> int:
        """Lines of a spectrum."""
        return len(self.frequency_hz)

    def block(self, branch: int) -> Block:
        """The coordinates of a branch by its index; of a slow channel's bin for -1."""
        return self._blocks[branch]

    @cached_property
    def _blocks(self) -> dict[int, Block]:
        num = self.num_samples
        identity = torch.eye(num, dtype=torch.float64)
        blocks = {}
        for branch, dense in enumerate((identity, *self.dense), -1):
            centred = dense - dense.mean(0)
            if branch < 0:
                into, out = centred, identity
            else:
                into, out = _low_rank(centred)
            lines = self.dense_lines @ torch.cat([out, out.new_full((num, 1), 1 / num)], dim=-1)
            blocks[branch] = Block(
                into=torch.cat([into, dense.sum(0, keepdim=True)]).T.contiguous(),
                out=None if branch < 0 else out.T.contiguous(),
                lines=lines.T.contiguous(),
                is_detail=branch >= 0 and not self.is_approximation[branch],
            )
        return blocks


@lru_cache(maxsize=16)
def linear_maps(
    num: int, sample_rate_hz: float, wavelet: Wavelet, level: int, method: SpectrumMethod
) -> LinearMaps:
    """The maps of bins of ``num`` samples; made once, so do not write into them.

    Raises:
        ValueError: if a bin is too short for the levels.
    """
    spectrum = spectrum_matrix(num, method)
    names = branch_names(level)
    return LinearMaps(
        branches=names,
        is_approximation=tuple(name[0] == "A" for name in names),
        dense=tuple(branch_matrix(num, wavelet, level)),
        dense_lines=torch.cat([spectrum.real, spectrum.imag]).contiguous(),
        frequency_hz=frequency_axis_hz(num, sample_rate_hz, method),
    )


def _low_rank(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """``into [r, n]`` and ``out [n, r]``, orthonormal, whose product is ``matrix``."""
    left, sizes, right = torch.linalg.svd(matrix)
    rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
    return (sizes[:rank, None] * right[:rank]).contiguous(), left[:, :rank].contiguous()
