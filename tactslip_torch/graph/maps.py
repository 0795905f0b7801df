"""The constant matrices of a graph: filter, branches and spectra fused, and cut to their rank.

A bin's window goes to a few coordinates of each branch (51, 27, 15 or 9 for 100 samples) and to its
mean, in float64; from coordinates brought to length one it goes on to branches and spectra, which
are then good to rounding in any precision. All is made of ``LinearMaps`` and the filter's kernel.

A window ``x`` is given as ``[x - first, first]``, ``first`` being the first sample of its bin: so
a small vibration keeps its digits on any offset, and details of a constant are exactly 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.linear_maps import RANK_TOLERANCE, LinearMaps
from tactslip_torch.signals.filtering import ChannelFilter, overlap_matrix

Matrix = NDArray[np.float64]
GAUGE = -1
"""Instead of a branch: a gauge's bin as it is."""


@dataclass(frozen=True)
class Block:
    """The coordinates of one branch (or of a gauge's bin), and what is made of them.

    Args:
        into: from ``[x - first, first]`` to coordinates, ``[W + 1, r + 1]``: r of the branch less
            its mean, and its mean. Their length is that of the branch, less its mean and in full.
        out: from the first r to the branch less its mean, ``[r, n]``; None if they are that.
        cosine: from all to the real part of its spectrum, ``[r + 1, L]``.
        sine: to the imaginary part.
        is_detail: whether its mean vanishes with the rest.
    """

    into: Matrix
    out: Matrix | None
    cosine: Matrix
    sine: Matrix
    is_detail: bool

    @property
    def rank(self) -> int:
        """Number of coordinates but the mean."""
        return int(self.into.shape[1]) - 1


def block(branch: int, maps: LinearMaps, smooth: Tensor) -> Block:
    """The coordinates of one branch.

    Args:
        branch: index in ``branch_names``, or ``GAUGE``.
        maps: of the pool.
        smooth: the filter, ``[n, W]`` (``filter_matrix``).
    """
    num = maps.num_samples
    identity = torch.eye(num, dtype=torch.float64)
    dense = identity if branch == GAUGE else maps.dense[branch]
    is_detail = branch != GAUGE and not maps.is_approximation[branch]
    mean = dense.mean(0, keepdim=True)
    if branch == GAUGE:
        out, into = identity, dense - mean
    else:
        left, sizes, right = torch.linalg.svd(dense - mean)
        rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
        out, into = left[:, :rank], sizes[:rank, None] * right[:rank]
    root = math.sqrt(num)
    both = torch.cat([into, root * mean]) @ smooth
    of_first = torch.zeros(len(both), 1, dtype=torch.float64)
    of_first[-1] = 0.0 if is_detail else root
    lines = maps.dense_lines @ torch.cat([out, out.new_full((num, 1), 1 / root)], dim=-1)
    return Block(
        torch.cat([both, of_first], dim=-1).T.numpy(),
        None if branch == GAUGE else out.T.numpy(),
        lines[: maps.num_lines].T.numpy(),
        lines[maps.num_lines :].T.numpy(),
        is_detail,
    )


def filter_matrix(channel_filter: ChannelFilter, channel: int, num: int) -> Tensor:
    """A channel's filter from its window to the bin's ``num`` samples, ``[num, W]``, float64."""
    return overlap_matrix(channel_filter.kernel(channel), num).T.contiguous()


def energy_matrix(
    maps: LinearMaps, smooth: Tensor, branches: Sequence[int]
) -> tuple[Matrix, list[int]]:
    """From ``[x - first, first]`` to numbers whose squares add up to energies of spectra.

    Args:
        maps: of the pool.
        smooth: the filter, ``[n, W]``.
        branches: of which energies are wanted.

    Returns:
        The matrix of all branches together and of each wanted one, ``[W + 1, sum of ranks]``; and
        these ranks.
    """
    own = [block(branch, maps, smooth) for branch in range(len(maps.branches))]
    lines = [np.concatenate([each.cosine, each.sine], axis=1).T @ each.into.T for each in own]
    parts = [np.concatenate(lines), *(lines[branch] for branch in branches)]
    columns = []
    for part in parts:  # [lines, W + 1]
        _, sizes, right = np.linalg.svd(part, full_matrices=False)
        rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
        columns.append((sizes[:rank, None] * right[:rank]).T)
    return np.concatenate(columns, axis=1), [each.shape[1] for each in columns]
