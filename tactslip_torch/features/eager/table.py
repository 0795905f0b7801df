"""All numbers of a plan's rows in some bins: from sums over deviations to features.

Parts leave here what they found of their rows, in parts of the row's span. ``finish`` makes
descriptors of it, which is the same for all rows at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tactslip_torch.features.descriptors import CV_FLOOR
from tactslip_torch.features.eager.layout import Layout

Array = np.ndarray[Any, Any]
SUMS = frozenset({"mean_deviation", "median", "iqr", "skewness", "kurtosis", "correlation"})
"""Descriptors that are made of something in the unit of deviations."""
TINIEST = float(np.finfo(np.float64).tiny)
"""Instead of a divisor that is 0, below which there are only zeros."""
MOST = float(np.finfo(np.float32).max)


class Table:
    """Memory for numbers of rows.

    Args:
        layout: of the plan.
        num_bins: M.

    Attributes:
        values: ``[lines, M]``, float64.
        planes: lines of one descriptor, ``[rows * M]`` in the order of rows.
        sums: by the descriptor they are for, in parts of the span: median and range between
            quartiles of heights; of deviations from the mean the sums of magnitudes (mean
            deviation), of cubes (skewness), of fourth powers (kurtosis), and of products with
            those of the film (correlation). All other planes are written as they will be. What
            nobody wants stays 0.
        extremes: largest, least and mean of rows, ``[3, rows * M]``.
        least: of rows, ``[rows, M]``.
        span: largest minus least, ``[rows * M]``; 0 for a flat row.
        floor: least over span of spectra, for the mode; 0 of others.
        squares: sums of squared deviations, ``[rows * M]``.
        finest: 16 eps of the size of the raw bin, ``[rows, M]``; a span below it is rounding.
    """

    def __init__(self, layout: Layout, num_bins: int) -> None:
        self._layout = layout
        num = len(layout.rows)
        self.values: Array = np.zeros((layout.num_lines, num_bins))
        self.planes: dict[str, Array] = {
            name: self.values[place * num : (place + 1) * num].reshape(-1)
            for place, name in enumerate(layout.planes)
        }
        self.extremes: Array = self.values[: 3 * num].reshape(3, -1)
        self.least = self.values[num : 2 * num]
        self.span = self.planes["range"]
        self.floor: Array = np.zeros(num * num_bins)
        self.squares: Array = np.ones(num * num_bins)
        self.sums: dict[str, Array] = {
            name: np.zeros(num * num_bins) for name in layout.planes if name in SUMS
        }
        self.finest: Array = np.empty((num, num_bins))
        self._found: Array = np.empty((len(layout.columns), num_bins))
        self._wanted = frozenset(layout.wanted)
        self._raw = layout.raw_of
        lengths = np.full((num, num_bins), float(layout.maps.num_samples))
        lengths[layout.num_in_time :] = layout.maps.num_lines
        same = layout.maps.num_samples == layout.maps.num_lines
        self._num: Any = float(layout.maps.num_samples) if same else lengths.reshape(-1)
        self._root_num = np.sqrt(self._num)
        self._root_less = np.sqrt(self._num - 1)
        shape = (layout.num_shared, len(layout.maps.branches), num_bins)
        self._ratios: Array = self.values[layout.ratios].reshape(shape)
        linear = layout.linear
        shape = (len(linear.energy_branches), len(linear.energy_films), num_bins)
        self._lonely = self.values[layout.energies].reshape(shape)

    def grid(self, values: Array) -> Array:
        """``[rows * M]`` as ``[rows, M]``."""
        return values.reshape(-1, self.finest.shape[1])

    def finish(self) -> None:
        """Descriptors of all rows."""
        planes, wanted, span, squares = self.planes, self._wanted, self.span, self.squares
        flat = None if span.all() else span == 0
        if flat is not None:
            squares[flat] = 1.0  # where sums are 0 then so are quotients
        root = np.sqrt(squares)
        for name, found in self.sums.items():
            if name == "skewness":
                factor = self._root_num / (squares * root)
            elif name == "kurtosis":
                factor = self._num / (squares * squares)
            elif name == "correlation":
                factor = 1.0 / (root * self.grid(root)[self._raw].reshape(-1))
            elif name == "mean_deviation":
                factor = span / self._num
            else:
                factor = span
            np.multiply(found, factor, out=planes[name])
        if "median" in wanted:
            planes["median"] += planes["least"]
        root *= span
        if "std" in wanted:
            np.divide(root, self._root_less, out=planes["std"])
        if not wanted.isdisjoint(("energy", "peak_factor", "cv")):
            self._by_mean_square(root)
        if flat is not None:
            if "kurtosis" in wanted:
                planes["kurtosis"][flat] = 3.0
            if "entropy" in wanted:
                planes["entropy"][flat] = 0.0

    def _by_mean_square(self, root: Array) -> None:
        """Of the root of the sum of squared differences from the mean."""
        planes, wanted = self.planes, self._wanted
        mean = planes["mean"]
        size = np.abs(mean)
        around = root / self._root_num
        square = around * around + size * size
        if "energy" in wanted:
            np.multiply(square, self._num, out=planes["energy"])
        if wanted.isdisjoint(("peak_factor", "cv")):
            return
        rms = np.sqrt(square)
        np.maximum(rms, TINIEST, out=rms)  # cv and peak factor of a zero row are 0
        if "peak_factor" in wanted:
            np.divide(planes["largest"], rms, out=planes["peak_factor"])
        if "cv" in wanted:
            floor = np.maximum(size, rms * CV_FLOOR)
            np.divide(root / self._root_less, np.copysign(floor, mean + 0.0), out=planes["cv"])

    def share(self, energies: Array) -> None:
        """Band energy ratios: each branch's part of the energy of all spectra of a film.

        Shape:
            - energies: ``[films, M, branches]``, those that no row gives
        """
        if energies.size:
            self._lonely[...] = energies.transpose(2, 0, 1)
        found = self.values.take(self._layout.energy_lines, axis=0).reshape(self._ratios.shape)
        total = found.sum(1, keepdims=True)
        np.maximum(total, TINIEST, out=total)  # ratios of a zero film are 0
        np.divide(found, total, out=self._ratios)

    def write(self, out: Array) -> None:
        """Hand out the columns that are wanted; what is beyond float32 saturates there.

        Shape:
            - out: ``[M, K]``
        """
        found = self._found
        np.take(self.values, self._layout.columns, axis=0, out=found, mode="clip")
        if out.dtype == np.float32:
            np.minimum(found, MOST, out=found)
            np.maximum(found, -MOST, out=found)
        np.copyto(out, found.T, casting="same_kind")
