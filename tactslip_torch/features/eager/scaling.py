"""Rows and lines in float64 become heights over their least value, as parts of their span.

Heights are of order one, in the dtype of statistics, and 0 for a flat row. Small values on their
way to a large one, such as the lines beside that of an offset, so keep their digits.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from tactslip_torch.features.eager.calls import (
    Step,
    add,
    largest,
    least,
    memory,
    multiply,
    run,
    subtract,
    total,
)
from tactslip_torch.features.eager.constant import Constants, Known
from tactslip_torch.features.eager.forming import Forming
from tactslip_torch.features.eager.layout import Layout, Part
from tactslip_torch.features.eager.scratch import Scratch
from tactslip_torch.features.eager.table import TINIEST, Table

Array = np.ndarray[Any, Any]
FLATTEST = 1e-30
"""Instead of the span of a spectrum that is 0, in parts of its largest line."""


class InTime:
    """Heights of gauges, films and branches.

    Args:
        part: the rows, and spectra behind them.
        layout: of the plan.
        forming: what forms rows.
        table: where extremes and means go.
        scratch: where heights go.
    """

    def __init__(
        self, part: Part, layout: Layout, forming: Forming, table: Table, scratch: Scratch
    ) -> None:
        bins, num = scratch.num_bins, layout.maps.num_samples
        size = (part.split - part.first) * bins
        here = slice(part.first * bins, part.split * bins)
        rows, above = forming.rows.reshape(size, num), scratch.wide(size, num)
        self._extremes = table.extremes[:, here]
        top, low, self._mean = self._extremes
        self._span, self._finest = table.span[here], table.finest.reshape(-1)[here]
        self._inverse = memory(size)
        self._is_fine: Array = np.empty(size, bool)
        self._is_detail = layout.is_detail.repeat(bins)
        self._bins = bins
        self._forming: list[Step] = [
            *forming.time,
            largest(rows, top),
            least(rows, low),
            total(rows, self._mean),
            partial(np.multiply, self._mean, 1.0 / num, self._mean),
            partial(np.subtract, top, low, self._span),
            partial(np.less_equal, self._span, self._finest, self._is_fine),
        ]
        self._scaling: list[Step] = [
            subtract(rows, low[:, None], above),
            multiply(above, self._inverse[:, None], scratch.heights(size, num)),
        ]
        offset = np.empty((size // bins, bins))
        self._offsets: list[Step] = [
            partial(np.take, forming.first, layout.first_of, 0, offset, "clip"),
            partial(np.add, self._extremes, offset.reshape(-1), self._extremes),
        ]

    def __call__(self) -> Array | None:
        """Form rows; which are constant to rounding, if any is.

        Shape:
            - output: ``[rows, M]``
        """
        run(self._forming)
        span, inverse = self._span, self._inverse
        constant: Array | None = None
        if self._is_fine.any():
            constant = (span < self._finest) | (span == 0)
            inverse[...] = 0.0
            np.divide(1.0, span, out=inverse, where=~constant)
        else:
            np.divide(1.0, span, out=inverse)
        run(self._scaling)
        if constant is not None:
            span[constant] = 0.0
            self._mean[constant & self._is_detail] = 0.0
            self._extremes[:2, constant] = self._mean[constant]
        run(self._offsets)
        return None if constant is None else constant.reshape(-1, self._bins)


class Spectra:
    """Heights of spectra.

    Args:
        part: spectra, and rows in time before them.
        layout: of the plan.
        forming: what forms cosine and sine lines.
        table: where extremes and spans go.
        scratch: where heights go.
    """

    def __init__(
        self, part: Part, layout: Layout, forming: Forming, table: Table, scratch: Scratch
    ) -> None:
        bins, num = scratch.num_bins, layout.maps.num_lines
        before, size = (part.split - part.first) * bins, (part.stop - part.split) * bins
        here = slice(part.split * bins, part.stop * bins)
        self._forming = forming
        lines, squares = forming.lines.reshape(size, 2 * num), scratch.wide(size, num)
        heights = scratch.heights(before + size, num)[before:]
        top, low, _ = table.extremes[:, here]
        inverse, extent = memory(size), memory(size)
        lowest, factor = memory(size, dtype=scratch.dtype), memory(size, dtype=scratch.dtype)
        self._steps: list[Step] = [
            multiply(lines, lines, lines),
            add(lines[:, :num], lines[:, num:], squares),
            largest(squares, top),
            partial(np.maximum, top, TINIEST, inverse),  # a zero spectrum stays 0
            partial(np.divide, 1.0, inverse, inverse),
            multiply(squares, inverse[:, None], heights),
            partial(np.sqrt, heights, heights),
            partial(np.sqrt, top, top),
            least(heights, lowest),
            partial(np.subtract, 1.0, lowest, extent, dtype=np.float64),
            partial(np.multiply, extent, top, table.span[here]),
            partial(np.multiply, lowest, top, low),
            partial(np.maximum, extent, FLATTEST, extent),
            partial(np.divide, 1.0, extent, factor),
            subtract(heights, lowest[:, None], heights),
            multiply(heights, factor[:, None], heights),
        ]
        if "mode" in layout.wanted:
            self._steps.append(partial(np.multiply, lowest, factor, table.floor[here]))

    def __call__(self, constants: Constants, known: Known) -> None:
        """Form spectra of branches, of which it is known where they are constant."""
        run(self._forming.freq)
        if not known.is_plain:
            constants.mend_spectra(self._forming, known)
        run(self._steps)
