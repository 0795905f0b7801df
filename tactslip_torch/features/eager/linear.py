"""The linear part of the eager engine: bins in, branch rows and lines of spectra out, in float64.

Samples are taken relative to the first of their bin, which then is 0; its place carries that
first sample itself, times the spectrum of the constant 1, where an approximation is to have it.
A branch goes through its low rank or straight through one matrix, whichever multiplies less; an
approximation whose two parts are there for the same films is their sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan, Row


@dataclass(frozen=True)
class Block:
    """Rows of one branch, for some films: a product or a sum.

    Args:
        branch: index in ``branch_names``.
        films: places among the films of the plan, ascending.
        first: the first of its rows in its buffer.
        parts: places of the two blocks whose sum it is, else none.
        columns: its columns among the stacked small numbers; none: it comes straight from bins.
        matrix: ``[columns or n, width]``, what they are multiplied by; none for a sum.
    """

    branch: int
    films: tuple[int, ...]
    first: int
    parts: tuple[int, int] | None
    columns: slice | None
    matrix: Tensor | None

    @property
    def stop(self) -> int:
        """Behind its last row."""
        return self.first + len(self.films)


@dataclass(frozen=True)
class Linear:
    """All products of a plan.

    Args:
        gauges: places of gauges among the channels of the plan.
        films: places of films.
        into: ``[n, K]``, from films to the small numbers of all branches that go through them,
            and behind these to the numbers that watch.
        time: blocks of branch rows, in the order in which they are formed.
        freq: blocks of spectra.
        watched: branches whose span nobody else takes but which a spectrum or an energy asks for.
        energy_films: films with band energy ratios, places among the films.
        energy_branches: branches of these films whose energies no spectrum gives.
        energy: ``[n, sum r]``: the squares of the product, summed over the part of a branch, are
            the energy of its spectrum.
        energy_starts: where the parts begin.
    """

    gauges: tuple[int, ...]
    films: tuple[int, ...]
    into: Tensor
    time: tuple[Block, ...]
    freq: tuple[Block, ...]
    watched: tuple[int, ...]
    energy_films: tuple[int, ...]
    energy_branches: tuple[int, ...]
    energy: Tensor
    energy_starts: tuple[int, ...]


def linear_of(plan: Plan, maps: LinearMaps) -> Linear:
    """Choose how each branch of a plan is formed."""
    films = sorted(
        {row.channel for row in plan.rows if row.kind != "gauge"} | {*plan.share_channels}
    )
    place = {channel: index for index, channel in enumerate(films)}
    time = _films_of(plan.rows_of("time"), place)
    freq = _films_of(plan.rows_of("freq"), place)
    shared = tuple(place[channel] for channel in plan.share_channels)
    missing = tuple(
        branch for branch in range(len(maps.branches)) if not {*shared} <= {*freq.get(branch, ())}
    )
    asked = [(branch, film) for branch, some in freq.items() for film in some]
    asked += [(branch, film) for branch in missing for film in shared]
    watched = sorted({branch for branch, film in asked if film not in time.get(branch, ())})
    columns, stacked = _stacked(time, freq, len(films), maps)
    stacked += [_through(maps, branch, _watching(maps.num_samples)) for branch in watched]
    energies = [_energy_factor(maps, branch) for branch in missing]
    starts = np.cumsum([0, *(matrix.shape[1] for matrix in energies)])[:-1]
    channels = {channel: index for index, channel in enumerate(plan.channels)}
    return Linear(
        gauges=tuple(channels[row.channel] for row in plan.rows_of("gauge")),
        films=tuple(channels[channel] for channel in films),
        into=_joined(stacked, maps.num_samples),
        time=_blocks(time, columns, maps, "time"),
        freq=_blocks(freq, columns, maps, "freq"),
        watched=tuple(watched),
        energy_films=shared if missing else (),
        energy_branches=missing,
        energy=_joined(energies, maps.num_samples),
        energy_starts=tuple(int(start) for start in starts),
    )


def _films_of(rows: Sequence[Row], place: dict[int, int]) -> dict[int, tuple[int, ...]]:
    """Which films want a branch."""
    branches = sorted({row.branch for row in rows})
    return {
        branch: tuple(place[row.channel] for row in rows if row.branch == branch)
        for branch in branches
    }


def _is_sum(branch: int, films: dict[int, tuple[int, ...]], maps: LinearMaps) -> bool:
    """Whether an approximation can be had as A + D of the next level, for the same films."""
    parts = (films.get(branch + 2), films.get(branch + 3))
    return maps.is_approximation[branch] and parts == (films[branch], films[branch])


def _stacked(
    time: dict[int, tuple[int, ...]],
    freq: dict[int, tuple[int, ...]],
    num_films: int,
    maps: LinearMaps,
) -> tuple[dict[int, slice], list[Tensor]]:
    """Which columns hold the small numbers of which branch, and what leads there.

    The last column of an approximation is the first sample, for its spectrum.
    """
    num, width = maps.num_samples, 2 * maps.num_lines
    columns: dict[int, slice] = {}
    stacked: list[Tensor] = []
    begin = 0
    for branch in range(len(maps.branches)):
        rank = maps.into[branch].shape[0] + maps.is_approximation[branch]
        outputs = sum(
            len(films[branch]) * size
            for films, size in ((time, num), (freq, width))
            if branch in films and not _is_sum(branch, films, maps)
        )
        if outputs * num <= num_films * rank * num + outputs * rank:
            continue  # as many multiplications straight from the bin
        into = maps.into[branch].T.clone()
        into[0] = 0.0
        if maps.is_approximation[branch]:
            into = torch.cat([into, torch.eye(num, 1, dtype=into.dtype)], 1)
        stacked.append(into)
        columns[branch] = slice(begin, begin + into.shape[1])
        begin += into.shape[1]
    return columns, stacked


def _blocks(
    films: dict[int, tuple[int, ...]],
    columns: dict[int, slice],
    maps: LinearMaps,
    kind: Literal["time", "freq"],
) -> tuple[Block, ...]:
    """Blocks of one kind, the coarsest branch first, rows in that order."""
    blocks: list[Block] = []
    place: dict[int, int] = {}
    first = 0
    for branch in sorted(films, reverse=True):
        parts: tuple[int, int] | None = None
        column: slice | None = None
        matrix: Tensor | None = None
        if _is_sum(branch, films, maps):
            parts = (place[branch + 2], place[branch + 3])
        elif branch in columns and kind == "time":
            rank = len(maps.into[branch])
            column = slice(columns[branch].start, columns[branch].start + rank)
            matrix = maps.out[branch].T.contiguous()
        elif branch in columns:
            column, matrix = columns[branch], _with_ones(maps, branch, maps.lines[branch]).T
        elif kind == "time":
            matrix = _through(maps, branch, None)
        else:
            matrix = _through(maps, branch, maps.dense_lines)
            if maps.is_approximation[branch]:
                matrix[0] = maps.ones_lines
        place[branch] = len(blocks)
        matrix = None if matrix is None else matrix.contiguous()
        blocks.append(Block(branch, films[branch], first, parts, column, matrix))
        first += len(films[branch])
    return tuple(blocks)


def _through(maps: LinearMaps, branch: int, then: Tensor | None) -> Tensor:
    """From a bin to a branch and on, ``[n, width]``; the first sample counts as 0."""
    matrix = maps.dense[branch].clone()
    matrix[:, 0] = 0.0
    return (matrix if then is None else then @ matrix).T.contiguous()


def _with_ones(maps: LinearMaps, branch: int, lines: Tensor) -> Tensor:
    """``[2 L, r]``, for an approximation with the spectrum of the constant 1 behind it."""
    if not maps.is_approximation[branch]:
        return lines
    return torch.cat([lines, maps.ones_lines[:, None]], 1)


def _energy_factor(maps: LinearMaps, branch: int) -> Tensor:
    """``[n, r]``: the squared length of a bin's product is the energy of the branch's spectrum."""
    into = maps.into[branch].clone()
    into[:, 0] = 0.0
    if maps.is_approximation[branch]:
        first = torch.eye(1, into.shape[1], dtype=into.dtype)
        into = torch.cat([into, first])
    triangle: Tensor = torch.linalg.qr(_with_ones(maps, branch, maps.lines[branch]), mode="r").R
    factor: Tensor = (triangle @ into).T.contiguous()
    return factor


def _watching(num: int) -> Tensor:
    """``[1, n]``: weights whose sum is 0 and whose magnitudes sum to 2.

    A weighted sum of a row is then no larger than its span, and of a row that is not constant no
    structure of the data makes it 0.
    """
    weights = torch.sin(torch.arange(num, dtype=torch.float64) ** 2)
    weights = weights - weights.mean()
    return (2 * weights / weights.abs().sum())[None]


def _joined(parts: Sequence[Tensor], num: int) -> Tensor:
    if not parts:
        return torch.empty(num, 0, dtype=torch.float64)
    return torch.cat(list(parts), 1).contiguous()
