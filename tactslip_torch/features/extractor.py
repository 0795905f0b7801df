"""The front door to features: a pool or a part of it, by the fastest engine that may be used.

``"reference"`` is ``FeaturePool`` itself: differentiable, on any device, the truth in tests.
``"eager"`` and ``"compiled"`` carry out a plan of the least work, forwards only and on the CPU:
PyTorch and NumPy, or kernels compiled by numba. All give the same values to rounding; where a
value is all rounding (the sign of cv at a mean of 0, the mode of values equal but for rounding)
they may differ. Where a derivative is asked for, a graph is recorded or bins lie on another device,
the reference takes over; so it does for each bin with magnitudes beyond ``ordinary_sizes``.
"""

from __future__ import annotations

import logging
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal, Protocol, cast, get_args

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.bank import Bank
from tactslip_torch.features.eager.engine import EagerEngine
from tactslip_torch.features.guards import ordinary_sizes
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.ops import saturating
from tactslip_torch.features.plan import make_plan
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.runtime import for_each, is_plain, usable_engine

EngineName = Literal["auto", "compiled", "eager", "reference"]
_LOG = logging.getLogger(__name__)
_FEW_BINS = 4  # so few are done here: another thread would take longer to start
_REFERENCE_CHUNK = 16  # what fits the cache of a processor


class Engine(Protocol):
    """Carries out a plan on ordinary bins; called from several threads at once.

    Attributes:
        chunk_bins: how many bins at once it is fastest with, and the most it takes.
    """

    chunk_bins: int

    def read(self, bins: Tensor) -> tuple[Tensor, Tensor, np.ndarray[Any, Any]]:
        """What ``__call__`` takes, in memory that is this thread's until its next call.

        Shape:
            - bins: ``[M, C, n]``, float32 or float64
            - output: x and scale as below; ``[M]``, bool, whether a bin is ordinary: no NaN, no
              Inf, and each magnitude 0 or within ``ordinary_sizes`` of float64
        """

    def __call__(self, x: Tensor, scale: Tensor, out: Tensor) -> None:
        """Write the features of some bins.

        Shape:
            - x: ``[M, C', n]``, float64, contiguous: filtered bins of the plan's channels
            - scale: ``[M, C']``, float64, largest magnitude of each: 0 or ordinary
            - out: ``[M, K]``, float32 or float64, written
        """


class FeatureExtractor:
    """Features of filtered bins, the whole pool or those selected, as fast as can be.

    float32 bins are computed in float64 and rounded once; for a pool whose arithmetic is
    ``"native"`` the fast engines form branches in float64 and take statistics in float32 of rows
    scaled to order one, which is nearer to float64 than the reference in float32 throughout.

    Args:
        pool: what features there are.
        selected: pool indices of the features wanted, in the order of the output; default: all.
        engine: ``"auto"`` takes the compiled one where numba is installed, else the eager one. Its
            first use on a machine takes some 20 s (``warm_up``).

    Attributes:
        plan: the least work for these features.
        engine: the engine in use, never ``"auto"``.

    Raises:
        ValueError: for no feature, an index outside the pool, an unknown engine, or
            ``"compiled"`` without numba.

    Example:
        >>> from tactslip_torch import HandLayout
        >>> extractor = FeatureExtractor(FeaturePool(HandLayout.paper24()), selected=[200, 7])
        >>> extractor(torch.randn(5, 24, 100)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        pool: FeaturePool,
        selected: Sequence[int] | None = None,
        engine: EngineName = "auto",
    ) -> None:
        num = len(pool.names)
        chosen = range(num) if selected is None else [operator.index(i) for i in selected]
        outside = [i for i in chosen if not 0 <= i < num]
        if outside:
            raise ValueError(
                f"selected features must lie in 0..{num - 1}, the pool's {num}, got {outside[0]}"
            )
        self.pool = pool
        self.selected = tuple(chosen)
        self.engine: EngineName = resolved(engine)
        self.plan = make_plan(pool.hand, pool.level, self.names)
        self._start()

    @property
    def names(self) -> tuple[FeatureName, ...]:
        """Names of the features, in the order of the output."""
        return tuple(self.pool.names[i] for i in self.selected)

    def __call__(self, bins: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Features of filtered bins.

        Shape:
            - bins: ``[*, C, n]``, float32 or float64, volts
            - output: ``[*, K]`` in ``dtype``, by default that of ``bins``; NaN for features of a
              channel that holds a NaN or Inf; what is beyond the dtype saturates

        Raises:
            ValueError: as ``FeaturePool``.
        """
        self.pool.check(bins)
        dtype = dtype or bins.dtype
        if not is_plain(bins):
            return self._reference(bins, dtype)
        with torch.inference_mode(False), torch.no_grad():  # what engines keep outlives the mode
            return self._values(bins, dtype)

    def warm_up(self) -> FeatureExtractor:
        """Make ready what the first bins would wait for, kernels among it; returns itself."""
        if self.engine != "reference":
            for dtype in (torch.float64, torch.float32):
                self._engine_for(dtype)
        return self

    def stream(self, batches: Iterable[Tensor]) -> Iterator[Tensor]:
        """Features of one batch of bins after the other; no more than one is held.

        Shape:
            - of each batch: ``[*, C, n]``; of what is handed on for it: ``[*, K]``
        """
        for bins in batches:
            yield self(bins)

    def _values(self, bins: Tensor, dtype: torch.dtype) -> Tensor:
        flat = bins.detach().flatten(0, -3) if bins.ndim > 2 else bins.detach()[None]
        out = torch.empty(len(flat), len(self.selected), dtype=dtype, device="cpu")
        engine = None if self.engine == "reference" else self._engine_for(bins.dtype)
        chunk_bins = _REFERENCE_CHUNK if engine is None else engine.chunk_bins

        def work(start: int) -> None:
            part = slice(start, start + chunk_bins)
            if engine is None:
                out[part] = self._reference(flat[part], dtype)
            else:
                self._carry_out(engine, flat[part], out[part])

        starts = range(0, len(flat), chunk_bins)
        if len(flat) <= _FEW_BINS:
            for start in starts:
                work(start)
        else:
            for_each(work, starts)
        return out.reshape(*bins.shape[:-2], len(self.selected))

    def _carry_out(self, engine: Engine, bins: Tensor, out: Tensor) -> None:
        """The plan by an engine, and the reference for bins that are not ordinary."""
        x, scale, is_ordinary = engine.read(bins)
        if is_ordinary.all():
            engine(x, scale, out)
            return
        # the engine sees zeros where values are strange: bits do not depend on neighbours
        low, high = ordinary_sizes(torch.float64)
        broken, odd = [], []
        for index in (~is_ordinary).nonzero()[0].tolist():
            size = x[index].abs().amax(-1)
            is_broken = ~size.isfinite()
            if bool((is_broken | (size == 0) | ((size >= low) & (size <= high))).all()):
                broken.append((index, is_broken.nonzero().flatten().tolist()))
                x[index, is_broken], scale[index] = 0.0, torch.where(is_broken, 0.0, size)
            else:
                odd.append(index)
                x[index], scale[index] = 0.0, 0.0
        engine(x, scale, out)
        for index, places in broken:
            for place in places:
                out[index, self._columns[place]] = torch.nan
        for index in odd:
            out[index] = self._reference(bins[index], out.dtype)

    def _reference(self, bins: Tensor, dtype: torch.dtype) -> Tensor:
        x = self.pool.widen(bins)
        if x.dtype not in self._banks:
            self._banks[x.dtype] = self.pool.bank(self.plan, x.dtype)
        return saturating(self._banks[x.dtype].of_bins(x), dtype)

    def _engine_for(self, bins: torch.dtype) -> Engine:
        dtype = bins if self.pool.arithmetic == "native" else torch.float64
        engine = self._engines.get(dtype)
        if engine is None:  # two threads may make one each; a lock could be lost in a fork
            engine = self._engines.setdefault(dtype, self._made(dtype))
        return engine

    def _made(self, dtype: torch.dtype) -> Engine:
        if self.engine == "eager":
            return EagerEngine(self.pool, self.plan, dtype)
        from tactslip_torch.features.compiled.engine import CompiledEngine  # numba takes a second

        engine = CompiledEngine(self.pool, self.plan, dtype)
        if not engine.is_ready():
            _LOG.warning("compiling kernels for features: some 20 s, once; then they are kept")
        engine.warm_up()  # here, where an interrupt is heard
        return engine

    def _start(self) -> None:
        self._engines: dict[torch.dtype, Engine] = {}
        self._banks: dict[torch.dtype, Bank] = {}
        plan = self.plan
        owner = [(plan.rows[w.row].channel, w.place) for w in plan.wanted]
        owner += [(share.channel, share.place) for share in plan.shares]
        self._columns = [[p for c, p in owner if c == channel] for channel in plan.channels]

    def __getstate__(self) -> dict[str, Any]:
        """Without engines, which hold workspaces of threads."""
        return {
            name: value
            for name, value in self.__dict__.items()
            if name not in ("_engines", "_banks")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._start()


def resolved(engine: EngineName) -> EngineName:
    """The engine that a name means on this machine.

    Raises:
        ValueError: for an unknown name, or ``"compiled"`` where numba is absent or cannot be used.
    """
    known = get_args(EngineName)
    return cast(EngineName, usable_engine(engine, known, _load_kernels, "features are made"))


def _load_kernels() -> None:
    from tactslip_torch.features.compiled import engine  # noqa: F401
