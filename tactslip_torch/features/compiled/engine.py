"""The compiled engine: products by BLAS, sorts by NumPy, everything else in kernels by numba."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.compiled.bins import describe_bins
from tactslip_torch.features.compiled.jit import Array
from tactslip_torch.features.compiled.kept import is_noted, note
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
from tactslip_torch.features.plan import Plan, make_plan
from tactslip_torch.features.pool import FeaturePool

_MANY_ROWS = 100
_MOST_BINS, _MOST_ROWS = 64, 2800
"""Bins a chunk for few rows, and rows a chunk for many, whose memory should fit the cache."""
_WARM: set[str] = set()
"""Kinds of engine whose kernels this process has compiled or loaded."""
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
    room: Array


class CompiledEngine:
    """Carries out a plan on ordinary bins, on the CPU and forwards only.

    Branches are products in float64; lines are products in the dtype of the statistics, of bins
    scaled to order one. Kernels walk over the bins, describe each branch and spectrum while it
    lies in cache, and leave deviations to be sorted, all at once.

    Args:
        pool: what features there are.
        plan: which of them are wanted.
        dtype: of the statistics; ``torch.float32`` for rows scaled to order one.

    Attributes:
        chunk_bins: the most bins a call, and how many it is fastest with.
    """

    def __init__(self, pool: FeaturePool, plan: Plan, dtype: torch.dtype) -> None:
        with _ordinary_memory():
            self._prepare(pool, plan, dtype)

    def _prepare(self, pool: FeaturePool, plan: Plan, dtype: torch.dtype) -> None:
        maps = LinearMaps.of(pool)
        num_rows = len(plan.rows)
        self.chunk_bins = _MOST_BINS if num_rows <= _MANY_ROWS else max(1, _MOST_ROWS // num_rows)
        made, chains = formings(plan, maps, self.chunk_bins)
        self._pool, self._dtype = pool, dtype
        self.num_features = plan.num_features
        self._channels = np.array(plan.channels, np.int64)
        self._steps = steps_of(plan, maps, made, chains)
        self._sorts = sorts_of(plan)
        self._num_sorted = tuple(len(rows) for rows in sorted_rows(plan))
        self._products = Products(maps, made, len(self._steps.film_channel), self.chunk_bins, dtype)
        self._local = threading.local()

    def is_ready(self) -> bool:
        """Whether the kernels need no compiling: done in this process, or kept on disk."""
        return self._kind in _WARM or is_noted(self._kind)

    def warm_up(self) -> None:
        """Compile all kernels, or load them: for a plan of any features, and any bins."""
        if self._kind in _WARM:
            return
        pool = self._pool
        few = {c.kind: c.name for c in pool.hand.channels}.values()
        names = [name for name in pool.names if name.channel in few]
        with _ordinary_memory():
            engine = CompiledEngine(pool, make_plan(pool.hand, pool.level, names), self._dtype)
            for dtype in (torch.float32, torch.float64):
                bins = torch.zeros(1, len(pool.hand), pool.bin_samples, dtype=dtype)
                x, scale, _ = engine.read(bins)
                engine(x, scale, torch.empty(1, engine.num_features))
        _WARM.add(self._kind)
        note(self._kind)

    @property
    def _kind(self) -> str:
        """What decides which kernels there are: a hand without films needs fewer."""
        kinds = sorted({channel.kind for channel in self._pool.hand.channels})
        return "-".join([str(self._dtype).removeprefix("torch."), *kinds])

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
                written, room = values.numpy(), space.room
                describe_sorted(rows, fact, sorts, bins, steps.dense, room, written, limit)
        out.copy_(values)

    def _workspace(self) -> _Workspace:
        space: _Workspace | None = getattr(self._local, "space", None)
        if space is None:
            with _ordinary_memory():
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
            room=np.empty((2, n)),
        )


@contextmanager
def _ordinary_memory() -> Iterator[None]:
    """Tensors made within are the CPU's and may be written to anywhere, whatever modes are on."""
    with torch.inference_mode(False), torch.device("cpu"):
        yield
