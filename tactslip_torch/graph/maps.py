"""The constant matrices of a graph: filter, branches and spectra fused, and cut to their rank.

A bin's window goes to a few coordinates of each branch (51, 27, 15 or 9 for 100 samples), in
float64; from coordinates brought to length one it goes on to branches and spectra, which are then
good to rounding in any precision. All of it is made of ``LinearMaps`` and the filter's kernel.

A window ``x`` is given as ``[x - first, first]``, ``first`` being the first sample of its bin: so
a small vibration keeps its digits on any offset, and details of a constant are exactly 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.linear_maps import RANK_TOLERANCE, LinearMaps
from tactslip_torch.features.plan import Row
from tactslip_torch.signals.filtering import ChannelFilter

Matrix = NDArray[np.float64]
BlockKind = Literal["gauge", "branch", "level"]
"""``branch``: a detail, or a centred approximation. ``level``: an approximation as it is, for its
spectrum, which knows the offset."""


@dataclass(frozen=True)
class Block:
    """The coordinates of one branch (or of a gauge's bin), and what is made of them.

    Args:
        kind: which coordinates.
        branch: index in ``branch_names``; -1 for a gauge.
        into: from ``[x - first, first]`` to the coordinates, ``[W + 1, r]``; their length is that
            of the branch.
        mean: from the same to the branch's mean, ``[W + 1]``.
        out: from coordinates to the branch less its mean, ``[r, n]``; None if they are that.
        cosine: from coordinates to the real part of its spectrum, ``[r, L]``.
        sine: to the imaginary part.
        is_detail: whether its mean vanishes with the rest.
    """

    kind: BlockKind
    branch: int
    into: Matrix
    mean: Matrix
    out: Matrix | None
    cosine: Matrix
    sine: Matrix
    is_detail: bool

    @property
    def rank(self) -> int:
        """Number of coordinates."""
        return int(self.into.shape[1])


def block_kind(row: Row, maps: LinearMaps) -> BlockKind:
    """Which coordinates a row is made of."""
    if row.kind == "gauge":
        return "gauge"
    return "level" if row.kind == "freq" and maps.is_approximation[row.branch] else "branch"


def block(kind: BlockKind, branch: int, maps: LinearMaps, smooth: Tensor) -> Block:
    """The coordinates of one branch.

    Args:
        kind: which.
        branch: index in ``branch_names``.
        maps: of the pool.
        smooth: the filter, ``[n, W]`` (``filter_matrix``).
    """
    num = maps.num_samples
    identity = torch.eye(num, dtype=torch.float64)
    dense = identity if kind == "gauge" else maps.dense[branch]
    is_detail = kind != "gauge" and not maps.is_approximation[branch]
    shown = dense - dense.mean(0) if kind != "level" and not is_detail else dense
    if kind == "gauge":
        out, into = identity, shown
    else:
        left, sizes, right = torch.linalg.svd(shown)
        rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
        out, into = left[:, :rank], sizes[:rank, None] * right[:rank]
    lines = maps.dense_lines @ out
    offset = into.sum(-1) if kind == "level" else into.new_zeros(len(into))
    centred = None if kind == "gauge" else (out - out.mean(0)).T.numpy()
    return Block(
        kind,
        branch,
        torch.cat([into @ smooth, offset[:, None]], dim=-1).T.numpy(),
        torch.cat([dense.mean(0) @ smooth, dense.new_tensor([float(not is_detail)])]).numpy(),
        centred,
        lines[: maps.num_lines].T.numpy(),
        lines[maps.num_lines :].T.numpy(),
        is_detail,
    )


def blocks(rows: Iterable[Row], maps: LinearMaps, smooth: Tensor) -> dict[Any, Block]:
    """The blocks of rows, by kind and branch, in order."""
    wanted = sorted({(block_kind(row, maps), row.branch) for row in rows})
    return {key: block(*key, maps, smooth) for key in wanted}


def filter_matrix(channel_filter: ChannelFilter, channel: int, num: int) -> Tensor:
    """A channel's filter from its window to the bin's ``num`` samples, ``[num, W]``, float64."""
    kernel = channel_filter.kernel(channel)
    matrix = torch.zeros(num, num + len(kernel) - 1, dtype=torch.float64)
    for place in range(num):
        matrix[place, place : place + len(kernel)] = kernel
    return matrix


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
    own = [
        block("level" if is_approximation else "branch", branch, maps, smooth)
        for branch, is_approximation in enumerate(maps.is_approximation)
    ]
    lines = [np.concatenate([each.cosine, each.sine], axis=1).T @ each.into.T for each in own]
    parts = [np.concatenate(lines), *(lines[branch] for branch in branches)]
    columns = []
    for part in parts:  # [lines, W + 1]
        _, sizes, right = np.linalg.svd(part, full_matrices=False)
        rank = max(1, int((sizes > RANK_TOLERANCE * sizes[0]).sum()))
        columns.append((sizes[:rank, None] * right[:rank]).T)
    return np.concatenate(columns, axis=1), [each.shape[1] for each in columns]
