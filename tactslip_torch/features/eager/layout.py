"""Where everything of a plan lies in the eager engine: rows, their parts, lines of values.

Rows come in this order: gauges, films themselves where a correlation wants them, branches,
spectra. A line holds one number of each bin: a descriptor of a row, the energy of a spectrum that
is no row, a band energy ratio. Columns of the output are some of the lines.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tactslip_torch.features.eager.linear import linear_of
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan, Row

Array = np.ndarray[Any, Any]
PLANES = ("largest", "least", "mean", "range")
"""What all rows have, wanted or not."""


class Part(NamedTuple):
    """Rows of one length, which are described together.

    Args:
        first: the first row.
        split: the first spectrum among them; ``stop`` if there is none.
        stop: behind the last row.
    """

    first: int
    split: int
    stop: int


class Layout:
    """Rows, lines and columns of a plan.

    Args:
        plan: what is wanted.
        maps: the constants of the bins.

    Attributes:
        rows: all of them, in order.
        num_before: how many of these are no branches: gauges and films.
        num_in_time: how many are no spectra.
        wanted: descriptor to the rows that want it, ascending; ``energy`` also where a band
            energy ratio needs it, of no row.
        planes: descriptors and extremes that have a line for every row.
        raw_of: the row of the film itself, by row.
        is_detail: ``[num_in_time]``, which rows have no offset.
        first_of: ``[num_in_time]``, the channel whose first sample is the row's offset.
        channel_of: ``[rows]``, place among the channels of the plan.
        energies: lines of energies that no row gives, by branch and film.
        energy_lines: ``[films * branches]``, the lines of the energies of films with ratios.
        ratios: lines of ratios, by film and branch.
        columns: ``[K]``, the line of each column.
    """

    def __init__(self, plan: Plan, maps: LinearMaps) -> None:
        self.maps, self.linear = maps, linear_of(plan, maps)
        self.channels = plan.channels
        films = [plan.channels[place] for place in self.linear.films]
        gauges = [Row("gauge", plan.channels[place], -1) for place in self.linear.gauges]
        raw = [Row("time", film, -1) for film in films] if plan.rows_for("correlation") else []
        self.has_raw = bool(raw)
        branches = [
            Row("time", films[film], block.branch)
            for block in self.linear.time
            for film in block.films
        ]
        spectra = [
            Row("freq", films[film], block.branch)
            for block in self.linear.freq
            for film in block.films
        ]
        self.rows = [*gauges, *raw, *branches, *spectra]
        self.num_before = len(gauges) + len(raw)
        self.num_in_time = self.num_before + len(branches)
        self.row_of = {row: index for index, row in enumerate(self.rows)}
        self.raw_of = [self.row_of.get(Row("time", row.channel, -1), 0) for row in self.rows]
        place = {channel: index for index, channel in enumerate(plan.channels)}
        self.channel_of = np.array([place[row.channel] for row in self.rows], np.intp)
        self.is_detail = np.array(
            [
                row.branch >= 0 and not maps.is_approximation[row.branch]
                for row in self.rows[: self.num_in_time]
            ],
            bool,
        )
        no_channel = len(plan.channels)
        self.first_of = np.where(
            self.is_detail, no_channel, self.channel_of[: self.num_in_time]
        ).astype(np.intp)
        self.wanted = self._wanted(plan)
        self.planes = (*PLANES, *(name for name in self.wanted if name not in PLANES))
        self._place_lines(plan, films)

    def _wanted(self, plan: Plan) -> dict[str, tuple[int, ...]]:
        found: dict[str, set[int]] = {"energy": set()} if plan.shares else {}
        for one in plan.wanted:
            found.setdefault(one.descriptor, set()).add(self.row_of[plan.rows[one.row]])
        return {name: tuple(sorted(rows)) for name, rows in found.items()}

    def _place_lines(self, plan: Plan, films: list[int]) -> None:
        plane = {name: index * len(self.rows) for index, name in enumerate(self.planes)}
        begin = len(self.planes) * len(self.rows)
        energy: dict[Row, int] = {}
        for row in self.rows[self.num_in_time :] if plan.shares else ():
            energy[row] = plane["energy"] + self.row_of[row]
        lonely = [
            Row("freq", films[film], branch)
            for branch in self.linear.energy_branches
            for film in self.linear.energy_films
        ]
        energy |= {row: begin + index for index, row in enumerate(lonely)}
        self.energies = slice(begin, begin + len(lonely))
        begin += len(lonely)
        shared, num = plan.share_channels, len(self.maps.branches)
        self.num_shared = len(shared)
        self.energy_lines = np.array(
            [energy[Row("freq", film, branch)] for film in shared for branch in range(num)], np.intp
        )
        self.ratios = slice(begin, begin + len(shared) * num)
        self.num_lines = self.ratios.stop
        self.columns = np.empty(plan.num_features, np.intp)
        for one in plan.wanted:
            self.columns[one.place] = plane[one.descriptor] + self.row_of[plan.rows[one.row]]
        for share in plan.shares:
            self.columns[share.place] = begin + shared.index(share.channel) * num + share.branch

    def parts(self) -> list[Part]:
        """All rows at once if they are of one length, else those in time, then spectra."""
        num, split = len(self.rows), self.num_in_time
        if self.maps.num_lines == self.maps.num_samples:
            return [Part(0, split, num)]
        found = [Part(0, split, split), Part(split, split, num)]
        return [part for part in found if part.first < part.stop]
