"""The compiled engine: products by BLAS, sorts by NumPy, everything else in kernels by numba."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.compiled.bins import describe_bins
from tactslip_torch.features.compiled.jit import Array
from tactslip_torch.features.compiled.products import Products, ProductSpace
from tactslip_torch.features.compiled.ranked import describe_sorted
from tactslip_torch.features.compiled.read import read_bins
from tactslip_torch.features.compiled.rows import Desk, desk_of
from tactslip_torch.features.compiled.steps import (
    formings,
    sorted_rows,
    sorts_of,
    steps_of,
)
from tactslip_torch.features.guards import ordinary_sizes
from tactslip_torch.features.linear_maps import LinearMaps
from tactslip_torch.features.plan import Plan
from tactslip_torch.features.pool import FeaturePool

_MANY_ROWS = 100
_FEW, _MANY = 16, 64
"""Bins a chunk for many rows, whose memory should fit the cache, and for few."""
_SIZES = ordinary_sizes(torch.float64)


class _Workspace(NamedTuple):
    """Memory of one thread, for a whole chunk."""

    products: ProductSpace
    samples: Array
    sample_facts: Array
    lines: Array
    line_facts: Array
    values: Tensor
    bins: Tensor
    scale: Tensor
    is_ordinary: Array
    desk: Desk


class CompiledEngine:
    """Carries out a plan on ordinary bins, on the CPU and forwards only.

    Linear maps are products in float64. Kernels walk over the bins, describe each branch and
    spectrum while it lies in cache, and leave deviations to be sorted, all at once.

    Args:
        pool: what features there are.
        plan: which of them are wanted.
        dtype: of the statistics; ``torch.float32`` for rows scaled to order one.

    Attributes:
        chunk_bins: the most bins a call, and how many it is fastest with.
    """

    def __init__(self, pool: FeaturePool, plan: Plan, dtype: torch.dtype) -> None:
        maps = LinearMaps.of(pool)
        self.chunk_bins = _FEW if len(plan.rows) > _MANY_ROWS else _MANY
        made, chains = formings(plan, maps, self.chunk_bins)
        self._dtype = dtype
        self.num_features = plan.num_features
        self._channels = np.array(plan.channels, np.int64)
        self._steps = steps_of(plan, maps, made, chains)
        self._sorts = sorts_of(plan)
        self._num_sorted = tuple(len(rows) for rows in sorted_rows(plan))
        self._products = Products(maps, made, len(self._steps.film_channel), self.chunk_bins, dtype)
        self._local = threading.local()

    def read(self, bins: Tensor) -> tuple[Tensor, Tensor, Array]:
        """What ``__call__`` takes, from bins of all channels, in memory of this thread.

        Shape:
            - bins: ``[M, C, n]``, float32 or float64
            - output: x ``[M, C', n]``, scale ``[M, C']``, and ``[M]``, whether a bin is ordinary:
              without NaN and Inf, each channel's magnitude 0 or ordinary
        """
        space, num = self._workspace(), len(bins)
        x, scale = space.bins[:num], space.scale[:num]
        is_ordinary = space.is_ordinary[:num]
        source = bins.contiguous().numpy()
        read_bins(source, self._channels, *_SIZES, x.numpy(), scale.numpy(), is_ordinary)
        return x, scale, is_ordinary

    def __call__(self, x: Tensor, scale: Tensor, out: Tensor) -> None:
        """Write the features of some bins.

        Shape:
            - x: ``[M, C', n]``, float64, contiguous: filtered bins of the plan's channels
            - scale: ``[M, C']``, float64, largest magnitude of each: 0 or ordinary
            - out: ``[M, K]``, float32 or float64, written
        """
        space = self._workspace()
        num = len(x)
        bins, values = x.numpy(), space.values[:num]
        steps, limit = self._steps, torch.finfo(out.dtype).max
        self._products(bins, scale.numpy(), steps.film_channel, space.products)
        samples, lines = space.samples[:num], space.lines[:num]
        describe_bins(
            bins,
            space.products.shifted.numpy(),
            scale.numpy(),
            space.products.unit,
            space.products.formed[0].numpy(),
            space.products.formed[1].numpy(),
            steps,
            space.desk,
            samples,
            space.sample_facts,
            lines,
            space.line_facts,
            values.numpy(),
            limit,
        )
        facts = (space.sample_facts, space.line_facts)
        for rows, fact, sorts in zip((samples, lines), facts, self._sorts, strict=True):
            if rows.shape[1]:
                rows.sort(axis=-1)
                describe_sorted(rows, fact, sorts, values.numpy(), limit)
        out.copy_(values)

    def _workspace(self) -> _Workspace:
        space: _Workspace | None = getattr(self._local, "space", None)
        if space is None:
            space = self._local.space = self._new_workspace()
        return space

    def _new_workspace(self) -> _Workspace:
        num, n = self.chunk_bins, self._steps.dense.shape[-1]
        num_lines = len(self._steps.frequency_hz)
        number = np.float32 if self._dtype == torch.float32 else np.float64
        in_time, in_frequency = self._num_sorted
        return _Workspace(
            products=self._products.new_space(),
            samples=np.empty((num, in_time, n), number),
            sample_facts=np.empty((num, in_time, 3)),
            lines=np.empty((num, in_frequency, num_lines), number),
            line_facts=np.empty((num, in_frequency, 3)),
            values=torch.empty(num, self.num_features, dtype=torch.float64),
            bins=torch.empty(num, len(self._channels), n, dtype=torch.float64),
            scale=torch.empty(num, len(self._channels), dtype=torch.float64),
            is_ordinary=np.empty(num, np.bool_),
            desk=desk_of(self._steps, number),
        )
