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

from tactslip_torch.features.eager.constant import ROUNDING, Constants
from tactslip_torch.features.eager.forming import Forming
from tactslip_torch.features.eager.layout import Layout
from tactslip_torch.features.eager.read import read_bins
from tactslip_torch.features.eager.rows import PartRows
from tactslip_torch.features.eager.scaling import InTime, Spectra
from tactslip_torch.features.eager.scratch import Scratch
from tactslip_torch.features.eager.table import Table
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan
from tactslip_torch.features.pool import FeaturePool

Array = np.ndarray[Any, Any]
CHUNK_ROWS = 3000
"""Rows in a chunk: fewer spend their time on starting calls, more on fetching from far memory."""
_KEPT = 3  # workspaces of a thread: of whole chunks, of rests, of single bins


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
        self._channels = torch.tensor(plan.channels)
        self._layout = Layout(plan, LinearMaps.of(pool))
        self._constants = Constants(self._layout)
        self.chunk_bins = max(1, min(256, CHUNK_ROWS // max(1, len(self._layout.rows))))
        self._local = threading.local()

    def read(self, bins: Tensor) -> tuple[Tensor, Tensor, Array]:
        """What ``__call__`` takes, from bins of all channels (``read_bins``)."""
        return read_bins(bins, self._channels)

    def __call__(self, x: Tensor, scale: Tensor, out: Tensor) -> None:
        """Write the features of some bins.

        Shape:
            - x: ``[M, C', n]``, float64, contiguous: filtered bins of the plan's channels, finite
            - scale: ``[M, C']``, float64, largest magnitude of each: 0 or ordinary
            - out: ``[M, K]``, float32 or float64, written; saturates at its largest number
        """
        kept: dict[int, Run] = self._local.__dict__.setdefault("runs", {})
        run = kept.pop(len(x), None)
        if run is None:
            if len(kept) >= _KEPT:
                del kept[next(iter(kept))]  # not used for longest
            run = Run(self._layout, self._constants, len(x), self.dtype)
        kept[len(x)] = run
        with np.errstate(all="ignore"):  # the caller's choice is about the caller's numbers
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
        forming = Forming(layout.linear, layout.maps, num_bins, layout.has_raw)
        table, parts = Table(layout, num_bins), layout.parts()
        scratch = Scratch(parts, layout, num_bins, dtype)
        self._forming, self._table = forming, table
        first, last = parts[0], parts[-1]
        self._in_time: InTime | None = None
        self._spectra: Spectra | None = None
        if first.first < first.split:
            self._in_time = InTime(first, layout, forming, table, scratch)
        if last.split < last.stop:
            self._spectra = Spectra(last, layout, forming, table, scratch)
        self._rows = [PartRows(part, layout, table, scratch, forming.rows) for part in parts]

    def __call__(self, x: Array, scale: Array, out: Array) -> None:
        """As the engine."""
        layout, forming, table = self._layout, self._forming, self._table
        finest = scale.T * ROUNDING
        forming.begin(x)
        np.take(finest, layout.channel_of, axis=0, out=table.finest, mode="clip")
        constant = None if self._in_time is None else self._in_time()
        if len(self._rows) > 1:  # heights of spectra take the same place
            self._rows[0]()
        known = self._constants.known(forming, constant, table.least, finest)
        if self._spectra is not None:
            self._spectra(self._constants, known)
        self._rows[-1]()
        table.finish()
        if layout.num_shared:
            if not known.is_plain:
                self._constants.mend_energies(forming, known)
            table.share(forming.energies)
        table.write(out)
