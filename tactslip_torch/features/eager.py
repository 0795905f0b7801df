"""The eager engine: a plan carried out by PyTorch and NumPy, forwards only, on the CPU.

Linear maps are taken in float64 of samples relative to their bin's first, so that a vibration on
an offset keeps its digits. Every row is then brought to order one, where statistics need no guard
against overflow or cancellation, and may be taken in float32 (``mixed``) or float64.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.eager_constant import Constants, Known
from tactslip_torch.features.eager_forming import Forming
from tactslip_torch.features.eager_layout import Layout
from tactslip_torch.features.eager_rows import PartRows
from tactslip_torch.features.eager_scratch import Scratch
from tactslip_torch.features.eager_table import Table
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan
from tactslip_torch.features.pool import FeaturePool

Array = np.ndarray[Any, Any]
CHUNK_ROWS = 2800
"""Rows in a chunk; fewer spend their time on starting calls."""
PART_ROWS = 700
"""Rows that are described together; more do not fit the cache."""
_KEPT = 2  # workspaces of a thread: of whole chunks, and of the rest or of single bins


class EagerEngine:
    """Carries out a plan on ordinary bins. Thread-safe: each thread has memory of its own.

    Args:
        pool: what features mean.
        plan: which of them are wanted.
        dtype: of statistics; float32 (``mixed``) or float64. Linear maps are in float64 always.

    Attributes:
        chunk_bins: how many bins at once it is fastest with, and the most it takes.

    Raises:
        ValueError: if the dtype is another.
    """

    def __init__(self, pool: FeaturePool, plan: Plan, dtype: torch.dtype) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype of statistics must be float32 or float64, got {dtype}")
        self.dtype = dtype
        self._layout = Layout(plan, LinearMaps.of(pool))
        self._constants = Constants(self._layout)
        self.chunk_bins = max(1, min(256, CHUNK_ROWS // max(1, len(self._layout.rows))))
        self._local = threading.local()

    def __call__(self, x: Tensor, scale: Tensor, out: Tensor) -> None:
        """Write the features of some bins.

        Shape:
            - x: ``[M, C', n]``, float64, contiguous: filtered bins of the plan's channels, finite
            - scale: ``[M, C']``, float64, largest magnitude of each: 0 or ordinary
            - out: ``[M, K]``, float32 or float64, written; saturates at its largest number
        """
        kept: dict[int, Run] = self._local.__dict__.setdefault("runs", {})
        run = kept.get(len(x))
        if run is None:
            while len(kept) >= _KEPT:
                del kept[next(iter(kept))]
            run = kept[len(x)] = Run(self._layout, self._constants, len(x), self.dtype)
        run(x.numpy(), scale.numpy(), out.numpy())


class Run:
    """Memory for a number of bins, and the way through it.

    Args:
        layout: of the plan.
        constants: of the same.
        num_bins: M.
        dtype: of statistics.
    """

    def __init__(
        self, layout: Layout, constants: Constants, num_bins: int, dtype: torch.dtype
    ) -> None:
        self._layout, self._constants = layout, constants
        self._forming = Forming(layout.linear, layout.maps, num_bins, layout.has_raw)
        self._table = Table(layout, num_bins)
        parts = list(layout.parts(num_bins, PART_ROWS))
        scratch = Scratch(parts, layout, num_bins, dtype)
        self._parts = [PartRows(p, layout, self._forming, self._table, scratch) for p in parts]
        self._constant: Array = np.zeros((layout.num_in_time, num_bins), bool)
        self._has_spectra = layout.num_in_time < len(layout.rows)

    def __call__(self, x: Array, scale: Array, out: Array) -> None:
        """As the engine."""
        layout, forming, table = self._layout, self._forming, self._table
        by_channel = scale.T
        forming.begin(x)
        np.take(by_channel, layout.channel_of, axis=0, out=table.scale, mode="clip")
        constant: Array | None = None
        known: Known | None = None
        for rows in self._parts:
            part = rows.part
            if part.first < part.split:
                found = rows.form_rows()
                if found is not None:
                    if constant is None:
                        constant = self._constant
                        constant[...] = False
                    constant[part.first : part.split] = found.reshape(-1, len(x))
            if part.split < part.stop:
                known = known or self._known(constant, by_channel)
                rows.form_spectra(self._constants, known)
            rows.describe()
        table.finish()
        if layout.num_shared:
            if layout.linear.energy_branches:
                known = known or self._known(constant, by_channel)
                if not known.is_plain:
                    self._constants.mend_energies(forming, known)
            table.share(forming.energies)
        table.write(out)

    def _known(self, constant: Array | None, scale: Array) -> Known:
        mean = self._table.grid(self._table.least)
        return self._constants.known(self._forming, constant, mean, scale)
