"""Features of bins, the whole pool or a part of it, by the fastest backend that may be used.

``"torch"`` is the definitions (``FeaturePool``): differentiable, on any device, the truth in tests.
``"native"`` carries out a plan of the least work by ``native/engine.cpp``, forwards only and on the
CPU. Both give the same values to rounding; where a value is all rounding (the sign of cv at a mean
of 0, the mode of values equal but for rounding) they may differ. Where a derivative is asked for, a
graph is recorded or bins lie on another device, torch takes over; so it does for each bin
with magnitudes beyond 2^-320 to 2^448.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch import native
from tactslip_torch.features.bank import Bank
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.ops import saturating
from tactslip_torch.features.plan import make_plan
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import for_each, is_concrete
from tactslip_torch.signals.spectrum import frequency_axis_hz, spectrum_matrix
from tactslip_torch.signals.wavelet import wavelet_steps

_FEW_BINS = 4  # so few are done here: another thread would take longer to start
_CHUNK = {"native": 32, "torch": 16}  # bins of a thread at a time, whose memory fits the cache


class FeatureExtractor:
    """Features of filtered bins, the whole pool or those selected, as fast as can be.

    float32 bins are computed in float64 and rounded once; for a pool whose arithmetic is
    ``"native"`` the native engine forms branches in float64 and takes statistics in float32 of rows
    scaled to order one, which is nearer to float64 than the reference in float32 throughout.

    Args:
        pool: what features there are.
        selected: pool indices of the features wanted, in the order of the output; default: all.
        backend: ``"auto"`` takes the native one where it can be used (``native.why_not``).

    Attributes:
        plan: the least work for these features.
        backend: the one in use, never ``"auto"``.

    Raises:
        ValueError: for no feature, an index outside the pool, an unknown backend, or
            ``"native"`` where it cannot be used.

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
        backend: BackendName = "auto",
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
        self.backend = native.backend_of(backend)
        self.plan = make_plan(pool.hand, pool.level, self.names)
        self._engines: dict[torch.dtype, native.FeatureEngine] = {}
        self._banks: dict[torch.dtype, Bank] = {}

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
        if not is_concrete(bins):
            return self._by_torch(bins, dtype)
        with torch.inference_mode(False), torch.no_grad():  # what is kept outlives the mode
            flat = bins.detach().reshape(-1, *bins.shape[-2:])
            features = torch.empty(len(flat), len(self.selected), dtype=dtype, device="cpu")
            describe = self._by_native if self.backend == "native" else self._into_by_torch
            size = _CHUNK[self.backend]
            starts = range(0, len(flat), size)

            def work(start: int) -> None:
                describe(flat[start : start + size], features[start : start + size])

            if len(flat) <= _FEW_BINS:
                for start in starts:
                    work(start)
            else:
                for_each(work, starts)
            return features.reshape(*bins.shape[:-2], len(self.selected))

    def _by_native(self, bins: Tensor, features: Tensor) -> None:
        engine = self._engine_for(bins.dtype)
        is_odd = engine(bins.contiguous().numpy(), features.numpy())
        for index in is_odd.nonzero()[0]:  # one by one: a product's bits depend on its size
            features[index] = self._by_torch(bins[index], features.dtype)

    def _into_by_torch(self, bins: Tensor, features: Tensor) -> None:
        features.copy_(self._by_torch(bins, features.dtype))

    def _by_torch(self, bins: Tensor, dtype: torch.dtype) -> Tensor:
        x = self.pool.widen(bins)
        if x.dtype not in self._banks:
            self._banks[x.dtype] = self.pool.bank(self.plan, x.dtype)
        return saturating(self._banks[x.dtype].of_bins(x), dtype)

    def _engine_for(self, dtype: torch.dtype) -> native.FeatureEngine:
        """The engine for bins of a dtype; two threads may make one each, to the same end."""
        statistics = dtype if self.pool.arithmetic == "native" else torch.float64
        if statistics not in self._engines:
            with torch.device("cpu"):
                self._engines[statistics] = self._make_engine(statistics)
        return self._engines[statistics]

    def _make_engine(self, statistics: torch.dtype) -> native.FeatureEngine:
        pool, plan = self.pool, self.plan
        steps = wavelet_steps(pool.bin_samples, pool.wavelet, pool.level)
        spectrum = spectrum_matrix(pool.bin_samples, pool.spectrum)
        axis = frequency_axis_hz(pool.bin_samples, pool.sample_rate_hz, pool.spectrum)
        num_branches = len(steps.out)
        offset = {"gauge": 1, "time": 0, "freq": num_branches}  # a gauge is row 0 of its channel
        rows = [(row.channel, offset[row.kind] + row.branch) for row in plan.rows]
        wanted = [(*rows[w.row], native.DESCRIPTORS.index(w.descriptor), w.place)
                  for w in plan.wanted]  # fmt: skip
        wanted += [(s.channel, 2 * num_branches, s.branch, s.place) for s in plan.shares]
        return native.FeatureEngine(
            dtype=np.float32 if statistics == torch.float32 else np.float64,
            num_channels=len(pool.hand),
            slow=[channel for channel in plan.channels if channel in pool.hand.slow],
            fast=[channel for channel in plan.channels if channel in pool.hand.fast],
            wanted=wanted,
            low=[matrix.numpy() for matrix in steps.low],
            high=[matrix.numpy() for matrix in steps.high],
            out=[matrix.numpy() for matrix in steps.out],
            spectrum=torch.cat([spectrum.real, spectrum.imag]).numpy(),
            frequency_hz=axis.numpy(),
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without engines, which hold addresses, and banks, which are soon made."""
        return {**self.__dict__, "_engines": {}, "_banks": {}}
