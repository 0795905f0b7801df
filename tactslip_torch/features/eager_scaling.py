"""Rows and lines in float64 become heights over their least value, as parts of their span.

Heights are of order one, in the dtype of statistics, and 0 for a flat row. Small values on their
way to a large one, such as the lines beside that of an offset, so keep their digits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.eager_constant import Constants, Known
from tactslip_torch.features.eager_forming import Forming
from tactslip_torch.features.eager_layout import Layout, Part
from tactslip_torch.features.eager_scratch import Scratch
from tactslip_torch.features.eager_table import TINIEST, Table

Array = np.ndarray[Any, Any]


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
        self._steps = [step for block in forming.time for step in block]
        self._rows = forming.rows.flatten(0, 1)
        self._heights, self._above = scratch.heights(size, num), scratch.wide(size, num)
        self._extremes = table.extremes[:, here]
        self._largest, self._least, self._mean = self._extremes
        self._span, self._finest = table.span[here], table.finest.reshape(-1)[here]
        self._into = [torch.from_numpy(each) for each in self._extremes]
        self._inverse: Array = np.empty(size)
        self._is_rounding: Array = np.empty(size, bool)
        self._lowest, self._scaling = self._into[1][:, None], _column(self._inverse)
        self._first, self._first_of = forming.first, layout.first_of
        self._offset: Array = np.empty((size // bins, bins))
        self._is_detail = layout.is_detail.repeat(bins)
        self._num, self._bins = num, bins

    def __call__(self) -> Array | None:
        """Form rows; which are constant to rounding, if any is.

        Shape:
            - output: ``[rows, M]``
        """
        for step in self._steps:
            step()
        rows, span, inverse = self._rows, self._span, self._inverse
        torch.amax(rows, 1, out=self._into[0])
        torch.amin(rows, 1, out=self._into[1])
        torch.sum(rows, 1, out=self._into[2])
        self._mean *= 1.0 / self._num
        np.subtract(self._largest, self._least, out=span)
        constant: Array | None = None
        if np.less_equal(span, self._finest, out=self._is_rounding).any():
            constant = (span < self._finest) | (span == 0)
            inverse[...] = 0.0
            np.divide(1.0, span, out=inverse, where=~constant)
        else:
            np.divide(1.0, span, out=inverse)
        torch.sub(rows, self._lowest, out=self._above)
        torch.mul(self._above, self._scaling, out=self._heights)
        if constant is not None:
            span[constant] = 0.0
            self._mean[constant & self._is_detail] = 0.0
            self._extremes[:2, constant] = self._mean[constant]
        np.take(self._first, self._first_of, axis=0, out=self._offset, mode="clip")
        self._extremes += self._offset.reshape(-1)
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
        self._steps = [step for block in forming.freq for step in block]
        lines = forming.lines.flatten(0, 1)
        self._cosine, self._sine = lines[:, :num], lines[:, num:]
        self._squares = scratch.wide(size, num)
        self._heights = scratch.heights(before + size, num)[before:]
        self._amplitudes: Array = self._heights.numpy()
        self._largest, self._least, _ = table.extremes[:, here]
        self._span, self._floor = table.span[here], table.floor[here]
        self._into = torch.from_numpy(self._largest)
        self._inverse: Array = np.empty(size)
        self._scaling = _column(self._inverse)
        self._low: Array = np.empty(size, self._amplitudes.dtype)
        self._into_low, self._lowest = torch.from_numpy(self._low), _column(self._low)
        self._factor = np.empty_like(self._low)
        self._stretching = _column(self._factor)

    def __call__(self, constants: Constants, known: Known) -> None:
        """Form spectra of branches, of which it is known where they are constant."""
        for step in self._steps:
            step()
        if not known.is_plain:
            constants.mend_spectra(self._forming, known)
        largest, least, inverse = self._largest, self._least, self._inverse
        squares = torch.mul(self._cosine, self._cosine, out=self._squares)
        squares.addcmul_(self._sine, self._sine)
        torch.amax(squares, 1, out=self._into)
        np.maximum(largest, TINIEST, out=inverse)  # a zero spectrum stays 0
        np.divide(1.0, inverse, out=inverse)
        torch.mul(squares, self._scaling, out=self._heights)
        np.sqrt(self._amplitudes, out=self._amplitudes)
        np.sqrt(largest, out=largest)
        torch.amin(self._heights, 1, out=self._into_low)
        np.subtract(1.0, self._low, out=inverse, dtype=np.float64)
        np.multiply(inverse, largest, out=self._span)
        np.multiply(self._low, largest, out=least)
        if not inverse.all():
            inverse[inverse == 0] = 1.0
        np.divide(1.0, inverse, out=inverse)
        np.multiply(self._low, inverse, out=self._floor)
        np.copyto(self._factor, inverse, casting="same_kind")
        self._heights.sub_(self._lowest)
        self._heights.mul_(self._stretching)


def _column(values: Array) -> Tensor:
    return torch.from_numpy(values)[:, None]
