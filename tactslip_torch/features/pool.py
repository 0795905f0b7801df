"""The pool: every descriptor of every channel, branch and spectrum.

For the paper's hand 14 slow channels x 13 descriptors + 10 fast ones x (8 branches x (14 time + 15
frequency) + 8 band energy ratios) = 2582 features of a 50 ms bin, which are the paper's. Behind
them are 78 simple statistics of filtered bins, so that every channel has all five.

Two backends make the same features. ``"torch"`` is the definitions (``bank.py``): differentiable,
on any device. ``"native"`` is ``native/engine.cpp``, for values on the CPU. float64 agrees to 1e-9
of the larger of a value and the median of its column; where a value is all rounding (the sign of cv
at a mean of 0, the mode of values equal but for rounding) they may differ.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor, nn

from tactslip_torch import native
from tactslip_torch.features.bank import (
    Bank,
    Frame,
    LinearMaps,
    Plan,
    bounded_gradient,
    linear_maps,
    make_plan,
    pool_names,
)
from tactslip_torch.features.descriptors import DESCRIPTORS, FeatureName
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import check_choice, for_each, full_precision, is_concrete
from tactslip_torch.signals.filtering import check_samples
from tactslip_torch.signals.wavelet import (
    SpectrumMethod,
    Wavelet,
    WaveletFilters,
    as_wavelet,
    highest_level,
    spectrum_matrix,
    wavelet_steps,
)

Arithmetic = Literal["double", "native"]
NATIVE_SPAN = 2.0**-10
"""Part of a fast channel's magnitude; in float32 throughout, less may be lost in a branch."""
LEAST_SPAN = {torch.float32: 2.0**-17, torch.float64: 2.0**-22}
"""Part of the largest raw sample within reach that a filtered span must exceed, by the dtype of the
raw samples: 64 roundings of float32; of float64, what leaves seven digits to a filtered sample."""
MOST_BIN_SAMPLES = 1024
"""Beyond it the constant matrices take gigabytes or minutes."""
MOST_LEVELS = 4
"""Wavelet levels of the paper."""
_FEW_BINS = 4  # so few are done here: another thread would take longer to start
_CHUNK = {"native": 32, "torch": 16}  # bins of a thread at a time, whose memory fits the cache


def saturating(x: Tensor, dtype: torch.dtype) -> Tensor:
    """``x`` in another dtype; what is beyond its range becomes its largest finite number."""
    most = torch.finfo(dtype).max
    if torch.finfo(x.dtype).max <= most:
        return x.to(dtype)
    return x.clamp(-most, most).to(dtype)


class FeaturePool(nn.Module):
    """Features of filtered bins: all of a hand, the paper's before others, or some of them.

    Follows the dtype of its input. Gradients flow wherever the descriptor is differentiable; they
    are finite up to 1e288 V. The linear maps (wavelet branches and spectrum) are evaluated on an
    identity in float64 through ptwt and torch.fft.

    Where only values are asked for, on the CPU, the native engine makes them. The definitions on
    torch do where a gradient is asked for, a graph is recorded (``torch.compile``, ONNX), bins are
    transformed (vmap) or on another device; for a bin with magnitudes beyond 2^-320 to 2^448; and
    everywhere with ``backend="torch"``.

    float32 bins are computed in float64 and rounded once at the end. If ``arithmetic`` is
    ``"native"``, they are computed in float32 throughout by the native engine; by torch, their
    branches and order statistics are still float64.

    Args:
        hand: the channels, in the order in which bins hold them.
        sample_rate_hz: of the bins.
        bin_samples: length of a bin; 100 (50 ms at 2 kHz) in the paper.
        wavelet: its name or, of one without a name, its filters (or their ``to_dict``).
        level: number of wavelet levels; ``None``: as many as the bin allows, at most 4.
        spectrum: ``"reference"`` (the authors') or ``"clean"`` (ours).
        arithmetic: ``"double"``, or ``"native"`` to compute in the dtype of the bins.
        backend: ``"auto"`` takes the native one where there is one (``native.reason_unavailable``).

    Attributes:
        names: of the features, in the order of the output.
        selected: their places in the whole pool.
        backend: the one in use, never ``"auto"``.

    Raises:
        ValueError: if the rate is not positive, the bin is too short for the levels, the arithmetic
            or backend none of those there are, or ``"native"`` cannot be used.

    Example:
        >>> pool = FeaturePool(HandLayout.paper24())
        >>> pool(torch.randn(5, 24, 100)).shape, str(pool.names[0])
        (torch.Size([5, 2660]), 'SG1 raw time mean')
        >>> int(pool.is_paper.sum()), str(pool.names[-1])
        (2582, 'PVDF10 raw time mean_abs_change')
        >>> pool.select([200, 7])(torch.randn(5, 24, 100)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        hand: HandLayout,
        sample_rate_hz: float = 2000.0,
        *,
        bin_samples: int = 100,
        wavelet: str | WaveletFilters | Mapping[str, Any] = "rbio2.2",
        level: int | None = MOST_LEVELS,
        spectrum: SpectrumMethod = "reference",
        arithmetic: Arithmetic = "double",
        backend: BackendName = "auto",
    ) -> None:
        super().__init__()
        if not sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz must be positive, got {sample_rate_hz}")
        if bin_samples > MOST_BIN_SAMPLES:
            raise ValueError(
                f"bins have at most {MOST_BIN_SAMPLES} samples, got {bin_samples}; take shorter "
                "bins (labels.bin_ms) or a lower rate (data.reading.resample_hz)"
            )
        check_choice("arithmetic", arithmetic, get_args(Arithmetic))
        self.hand = hand
        self.sample_rate_hz = float(sample_rate_hz)
        self.bin_samples = bin_samples
        self.wavelet = as_wavelet(wavelet)
        if level is None:
            level = min(MOST_LEVELS, highest_level(bin_samples, self.wavelet))
        self.level = level
        self.spectrum: SpectrumMethod = spectrum
        self.arithmetic: Arithmetic = arithmetic
        self.backend = native.backend_of(backend)
        self.names = pool_names(hand, level)
        self.selected = tuple(range(len(self.names)))
        self._inverses: dict[tuple[torch.dtype, bool], Tensor] = {}
        self._banks: dict[torch.dtype, Bank] = {}
        self._engines: dict[torch.dtype, native.FeatureEngine] = {}
        _ = self.maps  # refuses a bin that is too short for the levels

    def select(self, index: Sequence[int], backend: BackendName | None = None) -> FeaturePool:
        """The pool of some of these features, which does the least work for them.

        Args:
            index: places in ``names``, in the order of the output; repeats are allowed.
            backend: another one; default: the same.

        Raises:
            ValueError: for no feature, an index outside the pool, or as the constructor.
        """
        num, chosen = len(self.names), [operator.index(i) for i in index]
        if outside := [i for i in chosen if not 0 <= i < num]:
            raise ValueError(
                f"selected features must lie in 0..{num - 1}, the pool's {num}, got {outside[0]}"
            )
        pool = FeaturePool(self.hand, **self.config(), backend=backend or self.backend)
        pool.names = tuple(self.names[i] for i in chosen)
        pool.selected = tuple(self.selected[i] for i in chosen)
        _ = pool.plan  # refuses an empty one
        return pool

    def paper(self) -> FeaturePool:
        """The pool of those of these features that the paper has."""
        return self.select(self.is_paper.nonzero()[:, 0].tolist())

    def places(self, names: Iterable[FeatureName]) -> list[int]:
        """Where features of these names are among ``names``.

        Raises:
            KeyError: if there is none of a name.
        """
        place = {name: index for index, name in enumerate(self.names)}
        return [place[name] for name in names]

    @property
    def is_paper(self) -> Tensor:
        """Which of the features the paper has, ``[F]``, bool; in a whole pool the first."""
        paper = set(pool_names(self.hand, self.level, is_paper=True))
        return torch.tensor([name in paper for name in self.names])

    @property
    def maps(self) -> LinearMaps:
        """The constant matrices behind the features."""
        return linear_maps(
            self.bin_samples, self.sample_rate_hz, self.wavelet, self.level, self.spectrum
        )

    @cached_property
    def plan(self) -> Plan:
        """The least work for the features."""
        return make_plan(self.hand, self.level, self.names)

    def config(self) -> dict[str, Any]:
        """All arguments but hand and backend, as JSON-able values: ``FeaturePool(hand, **config)``.

        Of a selection, those of the whole pool.
        """
        return {
            "sample_rate_hz": self.sample_rate_hz,
            "bin_samples": self.bin_samples,
            "wavelet": self.wavelet if isinstance(self.wavelet, str) else self.wavelet.to_dict(),
            "level": self.level,
            "spectrum": self.spectrum,
            "arithmetic": self.arithmetic,
        }

    def forward(self, bins: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Features of filtered bins.

        Shape:
            - bins: ``[*, C, n]``, float32 or float64, volts
            - output: ``[*, F]`` in ``dtype``, by default that of ``bins``, every value finite where
              the bins are; NaN for every feature of a channel that holds a NaN or Inf. What is
              beyond the dtype, an energy or a gradient, saturates at its largest finite number.

        Raises:
            ValueError: if the number of channels or samples is another, or bins are neither float32
                nor float64.
        """
        self.check(bins)
        dtype = dtype or bins.dtype
        if not is_concrete(bins) or dtype not in (torch.float32, torch.float64):
            with full_precision(bins):
                return self._by_torch(bins, dtype)
        with torch.inference_mode(False), torch.no_grad():  # what is kept outlives the mode
            flat = bins.detach().reshape(-1, *bins.shape[-2:])
            features = torch.empty(len(flat), len(self.names), dtype=dtype, device="cpu")
            size = _CHUNK[self.backend]

            def work(start: int) -> None:
                some, out = flat[start : start + size], features[start : start + size]
                if self.backend == "native":
                    self._by_native(some, out)
                else:
                    out.copy_(self._by_torch(some, dtype))

            if len(flat) <= _FEW_BINS:
                for start in range(0, len(flat), size):
                    work(start)
            else:
                for_each(work, range(0, len(flat), size))
            return features.reshape(*bins.shape[:-2], len(self.names))

    def _by_native(self, bins: Tensor, features: Tensor) -> None:
        is_odd = self.engine(bins.dtype)(bins.contiguous().numpy(), features.numpy())
        for index in is_odd.nonzero()[0]:  # one by one: a product's bits depend on its size
            features[index] = self._by_torch(bins[index], features.dtype)

    def _by_torch(self, bins: Tensor, dtype: torch.dtype) -> Tensor:
        x = self.widen(bins)
        if x.dtype not in self._banks:
            frames = [
                Frame(tuple(sorted(own)), is_fast)
                for is_fast, kind in ((False, self.hand.slow), (True, self.hand.fast))
                if (own := set(kind).intersection(self.plan.channels))
            ]
            self._banks[x.dtype] = Bank(self.maps, self.plan, frames, x.dtype)
        return saturating(self._banks[x.dtype].of_bins(x), dtype)

    def engine(self, dtype: torch.dtype) -> native.FeatureEngine:
        """The native engine for bins of a dtype; two threads may make one each, to the same end."""
        statistics = dtype if self.arithmetic == "native" else torch.float64
        if statistics not in self._engines:
            with torch.inference_mode(False), torch.device("cpu"):
                self._engines[statistics] = self._make_engine(statistics)
        return self._engines[statistics]

    def _make_engine(self, statistics: torch.dtype) -> native.FeatureEngine:
        plan, steps = self.plan, wavelet_steps(self.bin_samples, self.wavelet, self.level)
        spectrum = spectrum_matrix(self.bin_samples, self.spectrum)
        num_branches = len(steps.out)
        # rows are branches, their spectra, band energy ratios, and the bin, whose branch is -1
        offset = {"time": 0, "freq": num_branches, "raw": 2 * num_branches + 2}
        rows = [(row.channel, offset[row.kind] + row.branch) for row in plan.rows]
        wanted = [(*rows[w.row], tuple(DESCRIPTORS).index(w.descriptor), w.place)
                  for w in plan.wanted]  # fmt: skip
        wanted += [(s.channel, 2 * num_branches, s.branch, s.place) for s in plan.shares]
        return native.FeatureEngine(
            dtype=np.float32 if statistics == torch.float32 else np.float64,
            num_channels=len(self.hand),
            slow=[channel for channel in plan.channels if channel in self.hand.slow],
            fast=[channel for channel in plan.channels if channel in self.hand.fast],
            wanted=wanted,
            low=[matrix.numpy() for matrix in steps.low],
            high=[matrix.numpy() for matrix in steps.high],
            out=[matrix.numpy() for matrix in steps.out],
            spectrum=torch.cat([spectrum.real, spectrum.imag]).numpy(),
            frequency_hz=self.maps.frequency_hz.numpy(),
        )

    def __repr__(self) -> str:
        wavelet = self.wavelet if isinstance(self.wavelet, str) else "own wavelet"
        return (
            f"FeaturePool({len(self.names)} features of {len(self.hand)} channels, bins of "
            f"{self.bin_samples} samples at {self.sample_rate_hz:g} Hz, {wavelet} to level "
            f"{self.level}, {self.backend} backend)"
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without engines, which hold addresses, and banks, which are soon made."""
        return {**self.__dict__, "_engines": {}, "_banks": {}}

    def widen(self, x: Tensor) -> Tensor:
        """Samples in the dtype that features are computed in; filter after it, not before.

        Raises:
            ValueError: if they are neither float32 nor float64.
        """
        check_samples(x)
        x = bounded_gradient(x)
        return x if self.arithmetic == "native" else x.double()

    def inverse_span(self, given: torch.dtype, is_raw: bool) -> Tensor:
        """One over the least span that is resolved, as a part of the magnitude, ``[C]``, float64.

        Args:
            given: dtype of the samples.
            is_raw: whether the magnitude is that of raw samples, or of filtered ones.
        """
        if (inverse := self._inverses.get((given, is_raw))) is None:
            span = LEAST_SPAN[given] if is_raw else 64 * torch.finfo(given).eps
            least = [span] * len(self.hand)
            if self.arithmetic == "native" and given == torch.float32:
                for channel in self.hand.fast:
                    least[channel] = NATIVE_SPAN
            with torch.inference_mode(False):  # it may be needed for a gradient later
                inverse = torch.tensor(least, dtype=torch.float64, device="cpu").reciprocal()
            self._inverses[given, is_raw] = inverse
        return inverse

    def check(self, bins: Tensor) -> None:
        """Refuse what are no bins of this hand.

        Raises:
            ValueError: as ``forward``.
        """
        check_samples(bins, "bins")
        if bins.ndim < 2 or bins.shape[-2:] != (len(self.hand), self.bin_samples):
            raise ValueError(
                f"expected bins [*, {len(self.hand)}, {self.bin_samples}] (channels, samples), "
                f"got {tuple(bins.shape)}"
            )


def is_simple_of(pool: FeaturePool) -> Tensor:
    """Which features of a pool are simple statistics of filtered bins, ``[F]``, bool."""
    return torch.tensor([name.is_simple for name in pool.names])


_NOISE_BINS = 128
_MOVE = 1e-13  # of its size, by which each sample of noise is moved
_LARGE = 1e-3  # of its spread, by which a feature may move with that
_NONE = 1e-12  # a spread that is none
_SHARE = 1 / 16  # of bins, in which it may move further: a value may lie at an edge by chance


def is_rounding(pool: FeaturePool) -> Tensor:
    """Which features of a pool rounding decides, ``[F]``, bool; none of the paper's wavelet.

    The details of Haar's, for one, come in pairs of opposite sign, so that their mean, median and
    skewness are zero but for rounding, and two backends differ in them altogether. Found on noise
    of size one: such a feature has no spread to speak of, or moves by much of it where samples move
    by ``1e-13``.
    """
    of_branches = _of_branches(pool.bin_samples, pool.wavelet, pool.level, pool.spectrum)
    return torch.tensor([replace(name, channel="") in of_branches for name in pool.names])


@lru_cache(maxsize=16)
def _of_branches(
    bin_samples: int, wavelet: Wavelet, level: int, spectrum: SpectrumMethod
) -> frozenset[FeatureName]:
    """Those of the branches of any channel, as names without a channel; of a bin itself none is."""
    hand = HandLayout((Channel("noise", "noise", "none", "none", "fast"),))
    options = {"bin_samples": bin_samples, "wavelet": wavelet, "level": level}
    pool = FeaturePool(hand, spectrum=spectrum, backend="torch", **options)  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode(False), torch.no_grad():
        bins, move = torch.randn(2, _NOISE_BINS, 1, bin_samples, generator=generator).double()
        before, after = pool(bins), pool(bins + _MOVE * move)
    spread = before.std(0)
    is_large = (after - before).abs() > _LARGE * spread
    found: Tensor = (is_large.double().mean(0) > _SHARE) | (spread < _NONE)
    names = zip(pool.names, found.tolist(), strict=True)
    return frozenset(replace(n, channel="") for n, is_found in names if is_found)
