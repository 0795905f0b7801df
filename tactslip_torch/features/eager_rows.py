"""A part of the rows, formed and described while it lies in cache.

Every row is brought to order one: heights over its least value, as parts of its span, in the dtype
of statistics; 0 for a flat row. Small values on their way to a large one, such as the lines of an
offset, so keep their digits. What descriptors are made of, or they themselves, goes to ``Table``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from tactslip_torch.features.eager_constant import Constants, Known, is_rounding
from tactslip_torch.features.eager_forming import Forming, index_of
from tactslip_torch.features.eager_layout import Layout, Part
from tactslip_torch.features.eager_order import Ordered
from tactslip_torch.features.eager_scratch import Scratch
from tactslip_torch.features.eager_table import Table
from tactslip_torch.features.plan import ORDERED

Array = np.ndarray[Any, Any]
SQUARES = frozenset({"std", "cv", "skewness", "kurtosis", "correlation", "energy", "peak_factor"})
"""Descriptors that need the sum of squares."""


class PartRows:
    """Views of a part's memory, and the way from its rows to their descriptors.

    Args:
        part: which rows.
        layout: of the plan.
        forming: what forms them.
        table: where descriptors go.
        scratch: memory shared with other parts.
    """

    def __init__(
        self, part: Part, layout: Layout, forming: Forming, table: Table, scratch: Scratch
    ) -> None:
        self.part, self._table, self._forming = part, table, forming
        maps, num_bins = layout.maps, scratch.num_bins
        num = maps.num_samples if part.first < part.split else maps.num_lines
        self._shape = (part.stop - part.first, num_bins, num)
        size, self._split = self._shape[0] * num_bins, (part.split - part.first) * num_bins
        self._heights = scratch.heights(size, num)
        self._work = scratch.work(size, num)
        self._wide = scratch.wide(size, num)
        self._rows = forming.rows[part.first : part.split].flatten(0, 1)
        lines = slice(part.split - layout.num_in_time, part.stop - layout.num_in_time)
        self._lines = forming.lines[lines if part.split < part.stop else slice(0, 0)].flatten(0, 1)
        self._hertz = maps.frequency_hz.to(scratch.dtype)
        hertz = maps.frequency_hz.numpy()
        self._mean_hertz, self._variance_hertz = float(hertz.mean()), float(hertz.var())
        self._ones = np.ones(num, self._hertz.numpy().dtype)
        whole = slice(part.first * num_bins, part.stop * num_bins)
        self._here = {name: plane[whole] for name, plane in table.planes.items()}
        self._here |= {name: found[whole] for name, found in table.sums.items()}
        self._here |= {
            "largest": table.largest[whole],
            "least": table.least[whole],
            "floor": table.floor[whole],
            "center": table.center[whole],
            "squares": table.squares[whole],
            "scale": table.scale.reshape(-1)[whole],
        }
        self._scale = self._here["scale"]
        self._first_of = layout.first_of[part.first : part.split]
        self._is_detail = layout.is_detail[part.first : part.split].repeat(num_bins)
        self._raw = scratch.raw
        is_raw = layout.has_raw and part.first == 0 < part.split
        self._num_raw = min(part.split, layout.num_before) if is_raw else 0
        self._steps_in_time = [step for block in part.time for step in forming.time[block]]
        self._steps_of_spectra = [step for block in part.freq for step in forming.freq[block]]
        self._choose(layout, scratch)

    def _choose(self, layout: Layout, scratch: Scratch) -> None:
        """Which of these rows want what."""
        part = self.part
        here = {
            name: [row - part.first for row in rows if part.first <= row < part.stop]
            for name, rows in layout.wanted.items()
        }
        self._names = frozenset(name for name, rows in here.items() if rows)
        is_shared = bool(layout.num_shared) and part.split < part.stop
        self._has_squares = bool(SQUARES & self._names or is_shared or self._num_raw)
        self._has_moments = self._has_squares or "mean_deviation" in self._names
        axis = {*here.get("spectral_centroid", ()), *here.get("spectral_spread", ())}
        self._axis_rows = index_of(sorted(axis)) if axis else None
        entropy = here.get("entropy", [])
        ordered = {row for name in ORDERED for row in here.get(name, ())}
        self._take = index_of([*entropy, *sorted(ordered - {*entropy})])
        self._entropy_rows = index_of(entropy)
        num = len(ordered.union(entropy))
        self._order = Ordered(scratch, num, self._shape[2], len(entropy)) if num else None
        correlated = here.get("correlation", [])
        self._correlated = index_of(correlated)
        self._raw_of = [layout.raw_of[part.first + row] for row in correlated]

    def form_rows(self) -> Array | None:
        """Form gauges, films and branches; which are constant to rounding, if any is.

        Shape:
            - output: ``[rows in time * M]``
        """
        for step in self._steps_in_time:
            step()
        split, rows = self._split, self._rows
        largest, least = self._here["largest"][:split], self._here["least"][:split]
        span, mean = self._here["range"][:split], self._here["mean"][:split]
        torch.amax(rows, 1, out=torch.from_numpy(largest))
        lowest = torch.amin(rows, 1, out=torch.from_numpy(least))
        torch.mean(rows, 1, out=torch.from_numpy(mean))
        np.subtract(largest, least, out=span)
        constant = is_rounding(span, self._scale[:split])
        if constant is None:
            inverse = 1.0 / span
        else:
            inverse = np.where(constant, 0.0, 1.0 / np.where(constant, 1.0, span))
        above = torch.sub(rows, lowest[:, None], out=self._wide[:split])
        torch.mul(above, torch.from_numpy(inverse)[:, None], out=self._heights[:split])
        if constant is not None:
            span[constant] = 0.0
            mean[constant & self._is_detail] = 0.0
            least[constant] = largest[constant] = mean[constant]
        np.multiply(mean - least, inverse, out=self._here["center"][:split])
        offset = np.take(self._forming.first, self._first_of, axis=0, mode="clip").reshape(-1)
        for each in (mean, least, largest):
            each += offset
        return constant

    def form_spectra(self, constants: Constants, known: Known) -> None:
        """Form spectra."""
        for step in self._steps_of_spectra:
            step()
        if not known.is_plain:
            constants.mend_spectra(self._forming, known, self.part.freq)
        split, num = self._split, self._shape[2]
        cosine, sine = self._lines[:, :num], self._lines[:, num:]
        squares = torch.mul(cosine, cosine, out=self._wide[split:])
        squares.addcmul_(sine, sine)
        largest, least = self._here["largest"][split:], self._here["least"][split:]
        torch.amax(squares, 1, out=torch.from_numpy(largest))
        safe = largest if largest.all() else np.where(largest == 0, 1.0, largest)
        amplitudes = self._heights[split:]
        torch.mul(squares, torch.from_numpy(1.0 / safe)[:, None], out=amplitudes)
        np.sqrt(amplitudes.numpy(), out=amplitudes.numpy())
        np.sqrt(largest, out=largest)
        lowest = torch.amin(amplitudes, 1)
        np.copyto(least, lowest.numpy())
        extent = 1.0 - least
        span = np.multiply(extent, largest, out=self._here["range"][split:])
        least *= largest
        if not extent.all():
            extent[extent == 0] = 1.0
        inverse = 1.0 / extent
        if "mode" in self._names:
            np.multiply(lowest.numpy(), inverse, out=self._here["floor"][split:])
        inverse = inverse.astype(self._ones.dtype)
        amplitudes.sub_(lowest[:, None])
        amplitudes.mul_(torch.from_numpy(inverse)[:, None])
        center = np.vecdot(amplitudes.numpy(), self._ones, out=self._here["center"][split:])
        center *= 1.0 / num
        mean = np.multiply(center, span, out=self._here["mean"][split:])
        mean += least

    def describe(self) -> None:
        """Leave what descriptors are made of in the table."""
        here, names = self._here, self._names
        heights: Array = self._heights.numpy()
        if self._order is not None:
            self._in_order(heights, self._order)
        if self._axis_rows is not None:
            self._weigh(heights, self._axis_rows)
        if self._has_moments:
            center = here["center"].astype(self._ones.dtype)
            self._heights.sub_(torch.from_numpy(center)[:, None])
            self._moments(heights, self._work.numpy(), names, here)

    def _moments(
        self, deviations: Array, work: Array, names: frozenset[str], here: dict[str, Array]
    ) -> None:
        """Sums over deviations from the mean."""
        if self._has_squares:
            np.vecdot(deviations, deviations, out=here["squares"])
        if "mean_deviation" in names:
            np.abs(deviations, out=work)
            np.vecdot(work, self._ones, out=here["mean_deviation"])
        if not names.isdisjoint(("skewness", "kurtosis")):
            np.multiply(deviations, deviations, out=work)
            if "skewness" in names:
                np.vecdot(work, deviations, out=here["skewness"])
            if "kurtosis" in names:
                np.vecdot(work, work, out=here["kurtosis"])
        if self._num_raw:
            self._raw[: self._num_raw] = deviations.reshape(self._shape)[: self._num_raw]
        if self._raw_of:
            others = self._raw.take(self._raw_of, axis=0, mode="clip")
            found = np.vecdot(deviations.reshape(self._shape)[self._correlated], others)
            self._put("correlation", self._correlated, found)

    def _weigh(self, heights: Array, rows: slice | list[int]) -> None:
        """Centroid and spread, of a spectrum that is its least line and heights over it."""
        num_bins, num = self._shape[1:]
        weights = heights.reshape(-1, num_bins, num)[rows].reshape(-1, num)
        span, least = self._pick("range", rows), self._pick("least", rows) * num
        total = self._pick("mean", rows) * num
        if not total.all():
            total[total == 0] = 1.0
        centroid = np.vecdot(weights, self._hertz.numpy()) * span + least * self._mean_hertz
        centroid /= total
        if "spectral_centroid" in self._names:
            self._put("spectral_centroid", rows, centroid)
        if "spectral_spread" in self._names:
            work = self._work[: len(weights)]
            center = torch.from_numpy(centroid.astype(weights.dtype))[:, None]
            distance: Array = torch.sub(self._hertz, center, out=work).numpy()
            np.multiply(distance, distance, out=distance)
            around = centroid - self._mean_hertz
            square = np.vecdot(distance, weights) * span
            square += least * (around * around + self._variance_hertz)
            self._put("spectral_spread", rows, np.sqrt(square / total))

    def _in_order(self, heights: Array, order: Ordered) -> None:
        names, take = self._names, self._take
        grid = heights.reshape(self._shape)
        target = order.sorted.reshape(-1, *self._shape[1:])
        if isinstance(take, slice):
            np.copyto(target, grid[take])
        else:
            np.take(grid, take, axis=0, out=target, mode="clip")
        order.sorted.sort(axis=-1)
        if not names.isdisjoint(("median", "iqr")):
            quantiles = order.quantiles()
            for place, name in enumerate(("median", "iqr")):
                if name in names:
                    self._put(name, take, quantiles[:, place])
        if "mode" in names:
            span, mode = self._pick("range", take), self._pick("least", take)
            safe = span if span.all() else np.where(span == 0, 1.0, span)
            rows, found = order.modes(self._pick("scale", take), safe, self._pick("floor", take))
            mode[rows] += found * span[rows]
            self._put("mode", take, mode)
        if "entropy" in names:
            self._put("entropy", self._entropy_rows, order.entropy())

    def _pick(self, name: str, rows: slice | list[int]) -> Array:
        """Of some rows, a copy."""
        found: Array = self._here[name].reshape(-1, self._shape[1])[rows].flatten()
        return found

    def _put(self, name: str, rows: slice | list[int], found: Array) -> None:
        self._here[name].reshape(-1, self._shape[1])[rows] = found.reshape(-1, self._shape[1])
