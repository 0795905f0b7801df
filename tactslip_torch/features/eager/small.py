"""Medians and interquartile ranges that are small beside the span, taken again in float64.

In float32 a height is no finer than 2^-25 of the span, which beside a spike of a thousand volts is
much of what is usual of a median. Rows of such values are few: they are sorted again in float64.
All other values are right to 1e-4 of themselves, without knowing what is usual.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from tactslip_torch.features.eager.calls import Step, run
from tactslip_torch.features.eager.order import TOLERANCE, first_of_longest, quantile_weights

Array = np.ndarray[Any, Any]
SMALL = 1 / 1500
"""Part of a row's span below which a value is small; float32 is right to 2^-24 of the span."""
NARROW = 2.0**-4
"""Part of the span between quartiles below which such a row's mode is taken again too."""


class Small:
    """Puts right small values of a part's rows in time, which come first in it.

    Args:
        rows: ``[rows, M, n]``, float64, over the first sample.
        wanted: rows in time that want a median, an interquartile range or a mode, by its name.
        here: numbers of the part's rows by name, ``[rows * M]``.
    """

    def __init__(
        self, rows: Array, wanted: Mapping[str, Sequence[int]], here: Mapping[str, Array]
    ) -> None:
        num_rows, bins, num = rows.shape
        size = num_rows * bins
        self._rows, self._here = rows.reshape(size, num), here
        self._quantiles, self._weights = quantile_weights(num)
        self._wants: dict[str, Array] = {
            name: np.isin(np.arange(num_rows), which).repeat(bins) for name, which in wanted.items()
        }
        span, least = here["range"][:size], here["least"][:size]
        limit, value = np.empty(size), np.empty(size)
        self._is_small: Array = np.zeros(size, bool)
        one = np.empty(size, bool)
        self._looking: list[Step] = [
            partial(np.multiply, span, SMALL, limit),
            partial(np.copyto, self._is_small, False),
        ]
        for name in ("median", "iqr"):
            if name not in wanted:
                continue
            self._looking.append(partial(np.multiply, here[name][:size], span, value))
            if name == "median":
                self._looking.append(partial(np.add, value, least, value))
                self._looking.append(partial(np.abs, value, value))
            self._looking.append(partial(np.less, value, limit, one))  # none of a flat row
            if not self._wants[name].all():
                self._looking.append(partial(np.logical_and, one, self._wants[name], one))
            self._looking.append(partial(np.logical_or, self._is_small, one, self._is_small))

    def __call__(self) -> None:
        """Look for small values, and write over them."""
        run(self._looking)
        places = np.flatnonzero(self._is_small)
        if not len(places):
            return
        here, ordered = self._here, self._rows[places]
        ordered.sort(axis=-1)
        ordered -= ordered[:, :1].copy()
        few = ordered.take(self._quantiles, axis=1)
        span = here["range"][places]
        median, iqr = (np.vecdot(few, weights) / span for weights in self._weights)
        for name, found in (("median", median), ("iqr", iqr)):
            if name in self._wants:
                here[name][places] = found
        if "mode" in self._wants:
            is_narrow = (iqr < NARROW) & self._wants["mode"][places]
            if is_narrow.any():
                self._put_modes(ordered[is_narrow], places[is_narrow])

    def _put_modes(self, ordered: Array, places: Array) -> None:
        """Of sorted heights in volts."""
        continues = np.zeros(ordered.shape, np.uint8 if ordered.shape[1] <= 256 else np.uint16)
        tolerance = self._here["finest"][places] * TOLERANCE
        np.less_equal(np.diff(ordered), tolerance[:, None], out=continues[:, 1:], casting="unsafe")
        spare, other = np.empty_like(continues), np.empty_like(continues)
        first = first_of_longest(continues, spare, other)
        found = ordered[np.arange(len(first)), first]
        self._here["mode"][places] = self._here["least"][places] + found
