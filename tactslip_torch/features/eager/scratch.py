"""Memory that the steps of the eager engine use one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from tactslip_torch.features.eager.calls import memory
from tactslip_torch.features.eager.layout import Layout, Part

Array = np.ndarray[Any, Any]


class Scratch:
    """Memory of the size of the largest part; nothing in it outlives a part but ``raw``.

    Args:
        parts: which use it.
        layout: of the plan.
        num_bins: M.
        dtype: of statistics.

    Attributes:
        raw: ``[rows, M, n]``, deviations of gauges and films, for correlations.
    """

    def __init__(
        self, parts: Sequence[Part], layout: Layout, num_bins: int, dtype: torch.dtype
    ) -> None:
        self.dtype, self.num_bins = dtype, num_bins
        num = max(layout.maps.num_samples, layout.maps.num_lines)
        size = max(part.stop - part.first for part in parts) * num_bins * num
        self._wide = memory(size)
        self._some = [memory(size, dtype=dtype) for _ in range(3)]
        self._counts = [np.empty(size, np.uint8 if num <= 256 else np.uint16) for _ in range(3)]
        self._bytes = [np.empty(size, np.uint8) for _ in range(3)]
        raw = layout.num_before if layout.has_raw else 0
        self.raw = memory(raw, num_bins, layout.maps.num_samples, dtype=dtype)

    def wide(self, rows: int, num: int) -> Array:
        """``[rows, num]``, float64."""
        return self._wide[: rows * num].reshape(rows, num)

    def heights(self, rows: int, num: int) -> Array:
        """``[rows, num]``."""
        return self._some[0][: rows * num].reshape(rows, num)

    def work(self, rows: int, num: int) -> Array:
        """``[rows, num]``, in which nothing stays from one descriptor to the next."""
        return self._some[1][: rows * num].reshape(rows, num)

    def ordered(self, rows: int, num: int) -> Array:
        """``[rows, num]``, sorted values."""
        return self._some[2][: rows * num].reshape(rows, num)

    def counts(self, size: int) -> list[Array]:
        """Three times ``[size]``, unsigned integers that can count a row."""
        return [each[:size] for each in self._counts]

    def flags(self, size: int) -> tuple[Array, Array, Array]:
        """``[size]`` bytes, and twice ``[size]`` bool."""
        level, one, other = (each[:size] for each in self._bytes)
        return level, one.view(bool), other.view(bool)
