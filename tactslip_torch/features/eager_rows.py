"""A part of the rows, formed and described while it lies in cache.

Every row is brought to order one: deviations from its mean over its span, in the dtype of
statistics; 0 for a flat row. What descriptors are made of, or they themselves, goes to ``Table``.
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
        self._deviations = scratch.deviations(size, num)
        self._work = scratch.work(size, num)
        self._wide = scratch.wide(size, num)
        self._rows = forming.rows[part.first : part.split].flatten(0, 1)
        lines = slice(part.split - layout.num_in_time, part.stop - layout.num_in_time)
        self._lines = forming.lines[lines if part.split < part.stop else slice(0, 0)].flatten(0, 1)
        self._hertz = maps.frequency_hz.to(scratch.dtype)
        self._ones = np.ones(num, self._hertz.numpy().dtype)
        whole = slice(part.first * num_bins, part.stop * num_bins)
        self._here = {name: plane[whole] for name, plane in table.planes.items()}
        self._here |= {name: found[whole] for name, found in table.sums.items()}
        self._here |= {"largest": table.largest[whole], "squares": table.squares[whole]}
        self._scale = table.scale.reshape(-1)[whole]
        self._first_of = layout.first_of[part.first : part.split]
        self._offset: Array = np.empty((part.split - part.first, num_bins))
        self._is_detail = layout.is_detail[part.first : part.split].repeat(num_bins)
        raw = range(part.first, min(part.split, layout.num_before)) if layout.has_raw else range(0)
        self._raw = scratch.raw
        self._raw_here = slice(raw.start, raw.stop) if len(raw) else None
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
        self._has_squares = bool(SQUARES & self._names or is_shared or self._raw_here)
        split = part.split - part.first
        axis = {*here.get("spectral_centroid", ()), *here.get("spectral_spread", ())}
        self._axis = index_of([row - split for row in sorted(axis)])
        self._axis_rows = index_of(sorted(axis))
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
        mean, span = self._here["mean"][:split], self._here["range"][:split]
        largest = self._here["largest"][:split]
        np.take(self._forming.first, self._first_of, axis=0, out=self._offset, mode="clip")
        torch.amax(rows, 1, out=torch.from_numpy(largest))
        np.subtract(largest, torch.amin(rows, 1).numpy(), out=span)
        center = torch.mean(rows, 1, out=torch.from_numpy(mean))
        constant = is_rounding(span, self._scale[:split])
        if constant is None:
            inverse = 1.0 / span
        else:
            inverse = np.where(constant, 0.0, 1.0 / np.where(constant, 1.0, span))
        centred = torch.sub(rows, center[:, None], out=self._wide[:split])
        torch.mul(centred, torch.from_numpy(inverse)[:, None], out=self._deviations[:split])
        if constant is not None:
            span[constant] = 0.0
            mean[constant & self._is_detail] = 0.0
            largest[constant] = mean[constant]
        offset = self._offset.reshape(-1)
        mean += offset
        largest += offset
        return constant

    def form_spectra(self, constants: Constants, known: Known) -> None:
        """Form spectra; centroid and spread are taken on the way."""
        for step in self._steps_of_spectra:
            step()
        if not known.is_plain:
            constants.mend_spectra(self._forming, known, self.part.freq)
        split, num = self._split, self._shape[2]
        cosine, sine = self._lines[:, :num], self._lines[:, num:]
        squares = torch.mul(cosine, cosine, out=self._wide[split:])
        squares.addcmul_(sine, sine)
        mean, span = self._here["mean"][split:], self._here["range"][split:]
        largest = self._here["largest"][split:]
        torch.amax(squares, 1, out=torch.from_numpy(largest))
        safe = largest if largest.all() else np.where(largest == 0, 1.0, largest)
        spectra = self._deviations[split:]
        torch.mul(squares, torch.from_numpy(1.0 / safe)[:, None], out=spectra)
        amplitudes: Array = spectra.numpy()
        np.sqrt(amplitudes, out=amplitudes)
        np.sqrt(largest, out=largest)
        np.vecdot(amplitudes, self._ones, out=mean)
        if self._axis_rows:
            self._weigh(amplitudes, mean)
        mean *= 1.0 / num
        extent = 1.0 - torch.amin(spectra, 1).double().numpy()
        np.multiply(extent, largest, out=span)
        if not extent.all():
            extent = np.where(extent == 0, 1.0, extent)
        spectra.sub_(torch.from_numpy(mean).to(spectra.dtype)[:, None])
        spectra.mul_(torch.from_numpy(1.0 / extent).to(spectra.dtype)[:, None])
        mean *= largest

    def _weigh(self, amplitudes: Array, total: Array) -> None:
        """Centroid and spread."""
        num_bins, num = self._shape[1:]
        weights = amplitudes.reshape(-1, num_bins, num)[self._axis].reshape(-1, num)
        total = total.reshape(-1, num_bins)[self._axis].reshape(-1)
        if not total.all():
            total = np.where(total == 0, 1.0, total)
        centroid = np.vecdot(weights, self._hertz.numpy()) / total
        if "spectral_centroid" in self._names:
            self._put("spectral_centroid", self._axis_rows, centroid)
        if "spectral_spread" in self._names:
            work = self._work[: len(weights)]
            center = torch.from_numpy(centroid).to(work.dtype)
            distance: Array = torch.sub(self._hertz, center[:, None], out=work).numpy()
            np.multiply(distance, distance, out=distance)
            spread = np.sqrt(np.vecdot(distance, weights) / total)
            self._put("spectral_spread", self._axis_rows, spread)

    def describe(self) -> None:
        """All other descriptors."""
        here, names = self._here, self._names
        deviations: Array = self._deviations.numpy()
        work: Array = self._work.numpy()
        if self._raw_here is not None:
            self._raw[self._raw_here] = deviations.reshape(self._shape)[: self._raw_here.stop]
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
        if self._raw_of:
            others = self._raw.take(self._raw_of, axis=0, mode="clip")
            found = np.vecdot(deviations.reshape(self._shape)[self._correlated], others)
            self._put("correlation", self._correlated, found)
        if self._order is not None:
            self._in_order(deviations, self._order)

    def _in_order(self, deviations: Array, order: Ordered) -> None:
        here, names, take = self._here, self._names, self._take
        grid = deviations.reshape(self._shape)
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
            span, mean = self._pick(here["range"]), self._pick(here["mean"])
            mode = self._pick(here["largest"]) - span  # the smallest value, to its last digit
            safe = span if span.all() else np.where(span == 0, 1.0, span)
            rows, found = order.modes(self._pick(self._scale), safe)
            mode[rows] = found * span[rows] + mean[rows]
            self._put("mode", take, mode)
        if "entropy" in names:
            self._put("entropy", self._entropy_rows, order.entropy())

    def _pick(self, values: Array) -> Array:
        """Of the rows that are sorted."""
        found: Array = values.reshape(-1, self._shape[1])[self._take].reshape(-1)
        return found

    def _put(self, name: str, rows: slice | list[int], found: Array) -> None:
        self._here[name].reshape(-1, self._shape[1])[rows] = found.reshape(-1, self._shape[1])
