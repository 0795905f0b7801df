"""What descriptors are made of, from the heights of rows: sums, sorted values, histograms."""

from __future__ import annotations

from typing import Any

import numpy as np

from tactslip_torch.features.eager.calls import Step, memory, multiply, run, subtract
from tactslip_torch.features.eager.forming import index_of
from tactslip_torch.features.eager.layout import Layout, Part
from tactslip_torch.features.eager.order import Ordered
from tactslip_torch.features.eager.scratch import Scratch
from tactslip_torch.features.eager.small import Small
from tactslip_torch.features.eager.table import TINIEST, Table
from tactslip_torch.features.plan import ORDERED

Array = np.ndarray[Any, Any]
SQUARES = frozenset({"std", "cv", "skewness", "kurtosis", "correlation", "energy", "peak_factor"})
"""Descriptors that need the sum of squares."""
AXIS = ("spectral_centroid", "spectral_spread")
FEW = 256
"""Spectra of which all are weighed at once, wanted or not, rather than some looked up."""


class PartRows:
    """Views of the memory of rows of one length, and what is said of them.

    Args:
        part: which rows.
        layout: of the plan.
        table: where it goes.
        scratch: where heights are.
        exact: ``[rows in time, M, n]``, float64, what heights of the part's rows were made of.
    """

    def __init__(
        self, part: Part, layout: Layout, table: Table, scratch: Scratch, exact: Array
    ) -> None:
        maps, num_bins = layout.maps, scratch.num_bins
        num = maps.num_samples if part.first < part.split else maps.num_lines
        self._shape = (part.stop - part.first, num_bins, num)
        size = self._shape[0] * num_bins
        before = (part.split - part.first) * num_bins
        whole = slice(part.first * num_bins, part.stop * num_bins)
        self._values, self._work = scratch.heights(size, num), scratch.work(size, num)
        kind = self._values.dtype
        self._ones: Array = np.ones(num, kind)
        self._mean_height = memory(size, dtype=scratch.dtype)
        self._centring = subtract(self._values, self._mean_height[:, None], self._values)
        self._here = {name: plane[whole] for name, plane in table.planes.items()}
        self._here |= {name: found[whole] for name, found in table.sums.items()}
        self._here |= {
            "least": table.extremes[1, whole],
            "floor": table.floor[whole],
            "squares": table.squares[whole],
            "finest": table.finest.reshape(-1)[whole],
        }
        self._spectra = slice(before, size)
        spectra = {name: self._here[name][before:] for name in ("mean", "range", "least")}
        self._mean, self._span, self._least = spectra.values()
        hertz = maps.frequency_hz
        self._hertz = (hertz * num**-0.5).numpy().astype(kind)  # so squares need no division
        self._axis = (hertz / num).numpy().astype(kind)
        self._mean_hertz = float(hertz.mean())
        self._variance_hertz = float(hertz.var(correction=0))
        self._raw = scratch.raw
        self._choose(part, layout, scratch, exact[part.first : part.split])

    def _choose(self, part: Part, layout: Layout, scratch: Scratch, exact: Array) -> None:
        """Which of these rows want what."""
        here = {
            name: [row - part.first for row in rows if part.first <= row < part.stop]
            for name, rows in layout.wanted.items()
        }
        self._names = frozenset(name for name, rows in here.items() if rows)
        has_films = layout.has_raw and part.first < part.split
        self._num_raw = layout.num_before if has_films else 0
        is_shared = layout.num_shared > 0 and part.split < part.stop
        self._has_squares = bool(SQUARES & self._names or is_shared or has_films)
        self._has_moments = self._has_squares or "mean_deviation" in self._names
        axis = sorted({row for name in AXIS for row in here.get(name, ())})
        if axis and (part.stop - part.split) * scratch.num_bins <= FEW:
            axis = list(range(part.split - part.first, part.stop - part.first))
        self._weighed = index_of(axis) if axis else None
        self._center = memory(len(axis) * scratch.num_bins, dtype=scratch.dtype)
        self._distance = self._work[: len(self._center)]
        self._measuring: list[Step] = [
            subtract(self._hertz, self._center[:, None], self._distance),
            multiply(self._distance, self._distance, self._distance),
        ]
        entropy = here.get("entropy", [])
        ordered = {row for name in ORDERED for row in here.get(name, ())}
        chosen = [*entropy, *sorted(ordered - {*entropy})]
        self._sorted, self._quantised = index_of(chosen), index_of(entropy)
        num = len(chosen)
        self._order = Ordered(scratch, num, self._shape[2], len(entropy)) if num else None
        small = {
            name: [row for row in here[name] if row < len(exact)]
            for name in sorted(ORDERED & self._names)
        }
        small = {name: rows for name, rows in small.items() if rows}
        is_coarse = self._values.dtype == np.float32
        has_quantiles = "median" in small or "iqr" in small
        self._small = Small(exact, small, self._here) if is_coarse and has_quantiles else None
        correlated = here.get("correlation", [])
        self._correlated = index_of(correlated)
        self._raw_of = [layout.raw_of[part.first + row] for row in correlated]

    def __call__(self) -> None:
        """Leave what descriptors are made of in the table; heights are used up."""
        if self._order is not None:
            self._in_order(self._order)
        center = np.vecdot(self._values, self._ones, out=self._mean_height)
        center *= 1.0 / self._shape[2]
        np.multiply(center[self._spectra], self._span, out=self._mean)
        self._mean += self._least
        if self._weighed is not None:
            self._weigh(self._weighed)
        if self._has_moments:
            self._centring()
            self._moments()

    def _moments(self) -> None:
        """Sums over deviations from the mean."""
        here, names, deviations, work = self._here, self._names, self._values, self._work
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
            self._raw[...] = deviations.reshape(self._shape)[: self._num_raw]
        if self._raw_of:
            others = self._raw.take(self._raw_of, axis=0, mode="clip")
            found = np.vecdot(deviations.reshape(self._shape)[self._correlated], others)
            self._put("correlation", self._correlated, found)

    def _weigh(self, rows: slice | list[int]) -> None:
        """Centroid and spread, of a spectrum that is its least line and heights over it."""
        num_bins, num = self._shape[1:]
        weights = self._values.reshape(-1, num_bins, num)[rows].reshape(-1, num)
        mean = np.maximum(self._pick("mean", rows), TINIEST)  # of a zero spectrum both are 0
        of_heights, of_least = self._pick("range", rows) / mean, self._pick("least", rows) / mean
        centroid = np.vecdot(weights, self._axis)
        centroid = centroid * of_heights
        centroid += of_least * self._mean_hertz
        if "spectral_centroid" in self._names:
            self._put("spectral_centroid", rows, centroid)
        if "spectral_spread" in self._names:
            np.multiply(centroid, num**-0.5, out=self._center, casting="same_kind")
            run(self._measuring)
            around = centroid - self._mean_hertz
            around *= around
            around += self._variance_hertz
            around *= of_least
            around += np.vecdot(self._distance, weights) * of_heights
            self._put("spectral_spread", rows, np.sqrt(around, out=around))

    def _in_order(self, order: Ordered) -> None:
        names, rows = self._names, self._sorted
        grid = self._values.reshape(self._shape)
        target = order.sorted.reshape(-1, *self._shape[1:])
        if isinstance(rows, slice):
            np.copyto(target, grid[rows])
        else:
            np.take(grid, rows, axis=0, out=target, mode="clip")
        order.sorted.sort(axis=-1)
        if not names.isdisjoint(("median", "iqr")):
            quantiles = order.quantiles()
            for place, name in enumerate(("median", "iqr")):
                if name in names:
                    self._put(name, rows, quantiles[:, place])
        if "mode" in names:
            span, mode = self._pick("range", rows), self._pick("least", rows).copy()
            which, found = order.modes(self._pick("finest", rows), span, self._pick("floor", rows))
            mode[which] += found * span[which]
            self._put("mode", rows, mode)
        if self._small is not None:
            self._small()
        if "entropy" in names:
            self._put("entropy", self._quantised, order.entropy())

    def _pick(self, name: str, rows: slice | list[int]) -> Array:
        """Of some rows, a copy where they do not lie side by side."""
        found: Array = self._here[name].reshape(-1, self._shape[1])[rows].reshape(-1)
        return found

    def _put(self, name: str, rows: slice | list[int], found: Array) -> None:
        self._here[name].reshape(-1, self._shape[1])[rows] = found.reshape(-1, self._shape[1])
