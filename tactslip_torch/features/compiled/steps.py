"""A plan and its linear maps as the arrays that kernels walk along.

Approximations come by addition from the small side where that is less work: A3 = A4 + D4.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from tactslip_torch.features.compiled.jit import Array
from tactslip_torch.features.compiled.numbering import DESCRIPTORS
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import ORDERED, Plan, Row
from tactslip_torch.features.runs import entropy_growth

TIME, LINES = 0, 1
SKIP, OWN, ADD = range(3)
WANTS_ENTROPY, WANTS_CENTROID = 1, 2


class Steps(NamedTuple):
    """What is to be done; rows, gauges, films, branches and lines by number.

    Args:
        gauge_channel: ``[G]``, where in the bins each gauge lies.
        gauge_row: ``[G]``, the row it is.
        film_channel: ``[F]``, where in the bins each film lies.
        row: ``[2, F, B]``, rows in time and of spectra; -1 where none is wanted.
        base: ``[2, F, B]``, where the formed values of the first bin lie; -1 where none do.
        stride: ``[2, B]``, how far on those of the next bin lie.
        chain: ``[2, F, levels]``, how an approximation is had: ``SKIP``, its ``OWN`` values, or
            ``ADD`` the detail to the approximation one level coarser.
        flags: ``[R]``, ``WANTS_ENTROPY`` and ``WANTS_CENTROID``.
        slot: ``[R]``, where among the rows to be sorted its values go, or -1.
        start: ``[R + 1]``, which part of ``what`` and ``place`` is a row's.
        what: descriptors but those of sorted values.
        place: their columns.
        share_start: ``[F + 1]``, which part of the next two is a film's.
        share_branch: band energy ratios.
        share_place: their columns.
        dense: ``[B, n, n]``, each branch as one matrix.
        gain: ``[B]``, the most that a branch can span where the bin spans 1.
        ones: ``[2 L]``, spectrum of the constant 1, cosines before sines.
        frequency_hz: ``[L]``.
        growth: ``[2, n or L]``, what a value adds to the entropy, by its rank in its cell.
        grown: ``[2, n + 1]``, what a cell of so many values adds.
        reach: the most that a line can grow by where the span is 1.
    """

    gauge_channel: Array
    gauge_row: Array
    film_channel: Array
    row: Array
    base: Array
    stride: Array
    chain: Array
    flags: Array
    slot: Array
    start: Array
    what: Array
    place: Array
    share_start: Array
    share_branch: Array
    share_place: Array
    dense: Array
    gain: Array
    ones: Array
    frequency_hz: Array
    growth: Array
    grown: Array
    reach: float


class Sorts(NamedTuple):
    """What sorted rows of one kind are wanted for.

    Args:
        start: ``[S + 1]``, which part of the next two is a sorted row's.
        what: ``"median"``, ``"mode"`` or ``"iqr"``, by number.
        place: their columns.
        channel: ``[S]``, where in the bins each row's channel lies.
        branch: ``[S]``, which it is; -1 for a gauge's bin, -2 for a spectrum.
    """

    start: Array
    what: Array
    place: Array
    channel: Array
    branch: Array


class Forming(NamedTuple):
    """One product: a branch in time, or its lines, for some films.

    Args:
        kind: ``TIME`` or ``LINES``.
        branch: which.
        films: for which films, ascending.
        base: where its values begin in the memory for all formed of its kind.
    """

    kind: int
    branch: int
    films: tuple[int, ...]
    base: int


def formings(
    plan: Plan, maps: LinearMaps, capacity: int
) -> tuple[list[Forming], dict[tuple[int, int], tuple[int, ...]]]:
    """All products of a plan for chunks of that many bins, and the chain of each (kind, film)."""
    films = films_of(plan)
    ranks = tuple(len(into) for into in maps.into)
    chains: dict[tuple[int, int], tuple[int, ...]] = {}
    formed: dict[tuple[int, int], list[int]] = {}
    for kind in (TIME, LINES):
        for film, channel in enumerate(films):
            wanted = wanted_branches(plan, channel, kind, len(ranks))
            chains[kind, film], branches = chain_of(wanted, ranks)
            for branch in branches:
                formed.setdefault((kind, branch), []).append(film)
    found, base = [], [0, 0]
    for (kind, branch), of in sorted(formed.items()):
        found.append(Forming(kind, branch, tuple(of), base[kind]))
        base[kind] += capacity * len(of) * width_of(maps, kind)
    return found, chains


def width_of(maps: LinearMaps, kind: int) -> int:
    """Values of a formed row: samples, or cosines and sines of the lines."""
    return maps.num_samples if kind == TIME else 2 * maps.num_lines


def films_of(plan: Plan) -> tuple[int, ...]:
    """Channels that are films, ascending."""
    gauges = {row.channel for row in plan.rows_of("gauge")}
    return tuple(channel for channel in plan.channels if channel not in gauges)


def steps_of(
    plan: Plan,
    maps: LinearMaps,
    made: list[Forming],
    chains: dict[tuple[int, int], tuple[int, ...]],
) -> Steps:
    """The plan as arrays."""
    films = films_of(plan)
    num_branches = len(maps.branches)
    place_of = {channel: place for place, channel in enumerate(plan.channels)}
    row = np.full((2, len(films), num_branches), -1)
    gauges = []
    for index, r in enumerate(plan.rows):
        if r.kind == "gauge":
            gauges.append((place_of[r.channel], index))
        else:
            row[int(r.kind == "freq"), films.index(r.channel), r.branch] = index
    base, stride = np.full(row.shape, -1), np.zeros((2, num_branches), np.int64)
    for forming in made:
        width = width_of(maps, forming.kind)
        stride[forming.kind, forming.branch] = len(forming.films) * width
        for slot, film in enumerate(forming.films):
            base[forming.kind, film, forming.branch] = forming.base + slot * width
    chain = np.zeros((2, len(films), num_branches // 2), np.int64)
    for (kind, film), how in chains.items():
        chain[kind, film] = how
    flags, slot_of = np.zeros(len(plan.rows), np.int64), np.full(len(plan.rows), -1)
    flags[list(plan.rows_for("entropy"))] |= WANTS_ENTROPY
    flags[list(plan.rows_for("spectral_centroid", "spectral_spread"))] |= WANTS_CENTROID
    for rows in sorted_rows(plan):
        slot_of[rows] = range(len(rows))
    start, what, place = _by_row(
        range(len(plan.rows)),
        [
            (w.row, DESCRIPTORS.index(w.descriptor), w.place)
            for w in plan.wanted
            if w.descriptor not in ORDERED
        ],
    )
    share_start, share_branch, share_place = _by_row(
        range(len(films)), [(films.index(s.channel), s.branch, s.place) for s in plan.shares]
    )
    dense = np.stack([matrix.numpy() for matrix in maps.dense])
    growth = np.zeros((2, max(maps.num_samples, maps.num_lines)))
    for kind, num in enumerate((maps.num_samples, maps.num_lines)):
        growth[kind, :num] = entropy_growth(num)
    return Steps(
        gauge_channel=np.array([channel for channel, _ in gauges], np.int64),
        gauge_row=np.array([index for _, index in gauges], np.int64),
        film_channel=np.array([place_of[channel] for channel in films], np.int64),
        row=row,
        base=base,
        stride=stride,
        chain=chain,
        flags=flags,
        slot=slot_of,
        start=start,
        what=what,
        place=place,
        share_start=share_start,
        share_branch=share_branch,
        share_place=share_place,
        dense=dense,
        gain=2 * np.abs(dense).sum(-1).max(-1),
        ones=maps.ones_lines.numpy(),
        frequency_hz=maps.frequency_hz.numpy(),
        growth=growth,
        grown=np.pad(np.cumsum(growth, axis=1), ((0, 0), (1, 0))),
        reach=float(maps.dense_lines.unflatten(0, (2, -1)).norm(dim=0).sum(-1).max()),
    )


def wanted_branches(plan: Plan, channel: int, kind: int, num_branches: int) -> set[int]:
    """Branches of a film that are described, in time or as spectra, or whose energy is needed."""
    name = ("time", "freq")[kind]
    wanted = {r.branch for r in plan.rows if r.kind == name and r.channel == channel}
    if kind == LINES and channel in plan.share_channels:
        wanted |= set(range(num_branches))
    return wanted


def chain_of(wanted: set[int], ranks: tuple[int, ...]) -> tuple[tuple[int, ...], set[int]]:
    """How each approximation is had, and which branches are formed by a product: the least work.

    Branches are numbered A1, D1, A2, D2 and so on; work is counted in ranks.

    Example:
        >>> chain_of({0, 1, 4}, (51, 51, 27, 27, 15, 15, 10, 9))
        ((2, 2, 1, 0), {1, 3, 4, 5})
        >>> chain_of({0, 1, 2, 3}, (51, 51, 27, 27, 15, 15, 10, 9))
        ((2, 1, 0, 0), {1, 2, 3})
    """
    levels = len(ranks) // 2
    formed = {branch for branch in wanted if branch % 2}
    chain = [SKIP] * levels
    had = levels  # the approximation had last; none yet
    for level in range(levels - 1, -1, -1):
        if 2 * level not in wanted:
            continue
        best, start = ranks[2 * level], level
        for coarse in range(level + 1, min(had, levels - 1) + 1):
            details = [2 * m + 1 for m in range(level + 1, coarse + 1)]
            work = sum(ranks[d] for d in details if d not in formed)
            work += 0 if coarse == had else ranks[2 * coarse]
            if work < best:
                best, start = work, coarse
        if start != had:
            chain[start] = OWN
            formed.add(2 * start)
        for m in range(level, start):
            chain[m] = ADD
            formed.add(2 * m + 3)
        had = level
    return tuple(chain), formed


def sorted_rows(plan: Plan) -> tuple[list[int], list[int]]:
    """Rows to be sorted: of samples, and of lines."""
    rows = plan.rows_for(*ORDERED)
    of_lines = [row for row in rows if plan.rows[row].kind == "freq"]
    return [row for row in rows if plan.rows[row].kind != "freq"], of_lines


def sorts_of(plan: Plan) -> tuple[Sorts, Sorts]:
    """What to do with them once they are sorted."""
    ordered = [
        (w.row, DESCRIPTORS.index(w.descriptor), w.place)
        for w in plan.wanted
        if w.descriptor in ORDERED
    ]
    samples, lines = (
        Sorts(
            *_by_row(rows, [w for w in ordered if w[0] in set(rows)]),
            channel=np.array([plan.channels.index(plan.rows[r].channel) for r in rows], np.int64),
            branch=np.array([_branch_in_time(plan.rows[r]) for r in rows], np.int64),
        )
        for rows in sorted_rows(plan)
    )
    return samples, lines


def _branch_in_time(row: Row) -> int:
    return -2 if row.kind == "freq" else row.branch


def _by_row(rows: Iterable[int], wanted: list[tuple[int, int, int]]) -> tuple[Array, Array, Array]:
    """Where each row's part of the wanted starts, and the wanted in that order."""
    parts = [[w[1:] for w in wanted if w[0] == row] for row in rows]
    start = np.cumsum([0, *(len(part) for part in parts)])
    flat = np.array([w for part in parts for w in part], np.int64).reshape(-1, 2)
    return start, flat[:, 0].copy(), flat[:, 1].copy()
