"""ctypes bindings of the native engine (``engine.cpp`` and its neighbours).

The engine computes in one number type throughout, float64 or float32, which the arrays that it is
given have as well.

The library lies beside this file if the package was installed, or is built at the first use, into
this folder or the user's cache. Without it (no compiler, or ``TACTSLIP_NATIVE=0``) what it does is
done by torch; ``reason_unavailable`` says why. ``TACTSLIP_NATIVE=v3`` uses no instruction set
beyond AVX2, ``v2`` the one of any 64-bit processor.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from tactslip_torch.native.build import REMEDY, SWITCH, build_library, is_off, library_name

Array = np.ndarray[Any, Any]
Number = type[np.float64] | type[np.float32]
BackendName = Literal["auto", "native", "torch"]
_LOG = logging.getLogger(__name__)
MAX_BRANCHES = 32
_ROWS = 8  # of a block of a matrix
_SHORT = 256  # samples of a bin up to which all spectra are products with a matrix
_WHOLE = 16  # numbers to a multiple of which arrays of the machine are filled up


class _Matrix(ctypes.Structure):
    _fields_ = (
        ("values", ctypes.c_void_p),
        ("first", ctypes.c_void_p),
        ("num_blocks", ctypes.c_int32),
        ("num_columns", ctypes.c_int32),
        ("width", ctypes.c_int32),
    )


class _Plan(ctypes.Structure):
    _numbers = (
        *("num_channels", "num_samples", "num_lines", "num_branches"),
        *("num_features", "num_coefficients", "num_slow", "num_fast", "num_points"),
    )
    _pointers = (
        *("slow", "fast", "first", "descriptor", "column", "need"),
        *("low", "high", "out", "lines", "cosines", "line_gains"),
        *("ones", "frequency_hz", "gain_time", "gain_lines"),
    )
    _fields_ = tuple(
        [(name, ctypes.c_int32) for name in _numbers]
        + [(name, ctypes.c_void_p) for name in _pointers]
    )


class _Filter(ctypes.Structure):
    _fields_ = (
        ("weights", ctypes.c_void_p),
        ("length", ctypes.c_int32),
        ("start", ctypes.c_int32),
    )


class _Sensing(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("inverse_span", "floor", "low", "high", "counted")),
        ("min_alive", ctypes.c_int32),
    )


class _Bins(ctypes.Structure):
    _fields_ = (
        ("samples", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in (
            "is_float", "num_bins", "bin_stride", "channel_stride")),
        *((name, ctypes.c_void_p) for name in ("filters", "features")),
        ("features_are_float", ctypes.c_int32),
        *((name, ctypes.c_void_p) for name in (
            "is_odd", "scaled", "score", "sensing", "is_lost", "is_valid", "in_range", "span")),
        ("score_as_float", ctypes.c_int32),
    )  # fmt: skip


class _Pool(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int32) for name in ("num_channels", "num_families", "num_statistics")),
        *((name, ctypes.c_void_p) for name in (
            "channels", "inputs", "statistics", "columns", "fractions", "scales")),
    )  # fmt: skip


class _Machine(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int32) for name in (
            "num_channels", "num_inputs", "num_columns", "num_scaled", "num_quadratic",
            "num_factors", "num_singles", "num_pools", "most_channels")),
        *((name, ctypes.c_void_p) for name in (
            "single_inputs", "single_columns", "pools", "fill", "sources", "minimum", "width",
            "compression", "centre", "imputation", "channels", "quadratic", "signs", "linear")),
        ("constant", ctypes.c_double),
    )  # fmt: skip


class _BristleRun(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in (
            "num_lanes", "num_bristles", "num_steps", "every", "patience")),
        ("step_s", ctypes.c_double),
        ("gamma", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in (
            "table", "pressure", "states", "bristles", "arm", "load", "out")),
    )  # fmt: skip


class _Onset(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int32) for name in (
            "num_fast", "num_slow", "num_filters", "num_windows", "num_pairs", "num_steps",
            "num_lags", "num_columns", "num_layers", "hop", "context", "delay", "step_length",
            "blind", "min_alive", "most_lost")),
        *((name, ctypes.c_void_p) for name in (
            "fast", "slow", "windows", "first", "second", "lags", "widths", "filters", "steps",
            "rounding", "silence", "least_step", "rates", "slope", "offset", "weights", "biases",
            "quadratic", "linear", "is_still")),
        ("constant", ctypes.c_double),
    )  # fmt: skip


class _OnsetHops(ctypes.Structure):
    _fields_ = (
        ("samples", ctypes.c_void_p),
        *((name, ctypes.c_int32) for name in (
            "is_float", "channel_stride", "num_hops", "num_lost")),
        *((name, ctypes.c_void_p) for name in (
            "memory", "in_use", "score", "is_lost", "columns")),
    )  # fmt: skip


class _Kept:
    """The library, and the arrays that its structures point to."""

    def __init__(self, dtype: Number = np.float64) -> None:
        self._library = _library()
        self._level = _level(self._library)
        self._held: list[object] = []
        self.dtype = dtype

    def _array(self, values: Any, dtype: Any = None) -> int:
        array = np.array(values, dtype or self.dtype, order="C")  # a copy: tensors may move theirs
        self._held.append(array)
        return array.ctypes.data

    def _filled_up(self, values: Any, filler: float, dtype: Any = None) -> int:
        """An array whose last axis is filled up, so that any vector of the engine reads whole."""
        array = np.asarray(values)
        widths = [(0, 0)] * (array.ndim - 1) + [(0, -array.shape[-1] % _WHOLE)]
        return self._array(np.pad(array, widths, constant_values=filler), dtype)

    def _run(self, plan: Any, machine: Any, bins: _Bins) -> None:
        pointers = (each and ctypes.byref(each) for each in (plan, machine, bins))
        is_float = self.dtype is np.float32
        if self._library.tactslip_features(self._level, is_float, *pointers):
            raise MemoryError("the native engine found no memory to work in")


class Filters(_Kept):
    """Filters of channels: weights, and where the frame of a bin's first sample begins."""

    def __init__(
        self, weights: Sequence[Array], starts: Sequence[int], dtype: Number = np.float64
    ) -> None:
        super().__init__(dtype)
        made = (_Filter * len(weights))()
        for to, own, start in zip(made, weights, starts, strict=True):
            to.weights, to.length, to.start = self._array(own), len(own), start
        self._held.append(made)
        self.address = ctypes.addressof(made)


class Channels(_Kept):
    """What is known of channels that work (``features.sensing.Sensing``).

    Args:
        inverse_span: one over the least span above rounding, as a part of the loudest sample.
        floor: span below which a channel is silent.
        bounds: least and largest span in range.
        counted: channels that count among those that must be alive.
        min_alive: how many of them.
        dtype: number type of the engine that asks.

    Shape:
        - all but the last: ``[C]``
    """

    def __init__(
        self,
        inverse_span: Array,
        floor: Sequence[float],
        bounds: tuple[Sequence[float], Sequence[float]],
        counted: Array,
        min_alive: int,
        dtype: Number = np.float64,
    ) -> None:
        super().__init__(dtype)
        spans = [self._array(each) for each in (inverse_span, floor, *bounds)]
        self.of = _Sensing(*spans, self._array(counted, np.uint8), min_alive)
        self.address = ctypes.addressof(self.of)


class FeatureEngine(_Kept):
    """Features of bins by the native engine; called from several threads at once.

    Args:
        dtype: number type of the engine.
        num_channels: of bins.
        slow: indices of the channels that are described as they are.
        fast: indices of the channels whose branches and spectra are described.
        wanted: channel, row, descriptor and column of every feature. Rows are the branches, their
            spectra, one for band energy ratios, whose descriptor is the number of the branch, and
            the bin itself, the only one of a slow channel. Descriptors are numbered as ``enum
            Descriptor``.
        low: from a bin, or the approximation's coefficients of one level, to those of the next.
        high: from the same to the coefficients of details.
        out: from coefficients to branches A1, D1, A2, D2 and so on.
        spectrum: from a branch to lines of its Fourier transform, cosines before sines.
        frequency_hz: of the lines.

    Shape:
        - low, high: ``[r, n or r before]`` each; out: ``[n, r]`` each; spectrum: ``[2 L, n]``

    Raises:
        OSError: if the engine is not available.
    """

    def __init__(
        self,
        *,
        dtype: Number,
        num_channels: int,
        slow: Sequence[int],
        fast: Sequence[int],
        wanted: Sequence[tuple[int, int, int, int]],
        low: Sequence[Array],
        high: Sequence[Array],
        out: Sequence[Array],
        spectrum: Array,
        frequency_hz: Array,
    ) -> None:
        super().__init__(dtype)
        num_branches = len(out)
        if num_branches > MAX_BRANCHES:
            raise ValueError(
                f"the native engine has {MAX_BRANCHES // 2} levels at most, got {num_branches // 2}"
                '; use backend="torch"'
            )
        self._num_rows = 2 * num_branches + 2
        bands = [self._matrices(group) for group in (low, high, out)]
        wanted = sorted(wanted)
        place = np.array([w[0] * self._num_rows + w[1] for w in wanted], np.int32)
        first = np.searchsorted(place, np.arange(num_channels * self._num_rows + 1))
        descriptor = np.array([w[2] for w in wanted], np.int32)
        need = np.zeros(num_channels * self._num_rows, np.uint32)
        np.bitwise_or.at(need, place, np.uint32(1) << descriptor.astype(np.uint32))
        is_read = _spectra_read(need.reshape(num_channels, -1), num_branches)
        most = transform_work(spectrum)
        is_dense = [len(spectrum) * matrix.shape[1] <= most for matrix in out]
        lines = [
            spectrum @ matrix if read and dense else matrix[:0]
            for read, dense, matrix in zip(is_read, is_dense, out, strict=True)
        ]
        num_points = 0 if all(np.less_equal(is_read, is_dense)) else _num_points(spectrum)
        angles = 2 * np.pi / max(1, num_points) * np.arange(num_points // 4 * 5)
        self.num_channels, self.num_features = num_channels, len(wanted)
        self._none = Filters([np.ones(1)] * num_channels, [0] * num_channels, dtype)
        self.plan = _Plan(
            num_channels,
            spectrum.shape[1],
            len(frequency_hz),
            num_branches,
            len(wanted),
            sum(len(matrix) + 8 for matrix in low) + 8,
            *map(len, (slow, fast)),
            num_points,
            self._array(slow, np.int32),
            self._array(fast, np.int32),
            self._array(first, np.int32),
            self._array(descriptor, np.int32),
            self._array([w[3] for w in wanted], np.int32),
            self._array(need, np.uint32),
            *bands,
            self._matrices(lines),
            self._array(np.cos(angles)),
            self._array(spectrum[: len(frequency_hz), 0]),
            self._array(spectrum.sum(-1)),
            self._array(frequency_hz),
            self._array(_entropy_growth(spectrum.shape[1])),
            self._array(_entropy_growth(len(frequency_hz))),
        )

    def __call__(self, bins: Array, out: Array) -> Array:
        """Write the features of some bins; which of them hold magnitudes out of range.

        Features of those are of no meaning. A channel with a NaN or Inf has features NaN.

        Shape:
            - bins: ``[M, C, n]``, float32 or float64; samples of a channel lie side by side
            - out: ``[M, K]``, float32 or float64, contiguous, written
            - output: ``[M]``, bool
        """
        is_odd = np.zeros(len(bins), np.bool_)
        _check_floats(out)
        to = (out.ctypes.data, out.dtype == np.float32, is_odd.ctypes.data)
        self._run(self.plan, None, _Bins(*_samples_of(bins), self._none.address, *to))
        return is_odd

    def score(
        self,
        machine: Machine,
        bins: Array,
        filters: Filters | None,
        given: Any,
        channels: Channels,
    ) -> Scores:
        """Scores of bins, all in one call.

        Args:
            machine: from features to the score.
            bins: with the context that the filters need.
            filters: of the channels; None: bins are filtered.
            given: dtype of the score.
            channels: which of them are lost, and whether enough are alive.

        Shape:
            - bins: ``[M, C, n + context]``, float32 or float64; samples of a channel lie side by
              side
        """
        num, width = len(bins), 0 if machine.has_head else machine.num_scaled
        each, own = self.num_channels, self.dtype
        sizes = np.dtype(own).itemsize * np.array([num, num * each, num * width])
        ends = [*accumulate((*sizes.tolist(), num, num, num, num * each))]
        memory = np.zeros(ends[-1], np.uint8)  # of all that is found: one address to ask for
        start = memory.ctypes.data
        call = _Bins(
            *_samples_of(bins), (filters or self._none).address, None, False, start + ends[2],
            None if machine.has_head else start + ends[1], start if machine.has_head else None,
            channels.address, start + ends[5], start + ends[3], start + ends[4], start + ends[0],
            given == np.float32,
        )  # fmt: skip
        self._run(self.plan, machine.of, call)
        flags = memory[ends[2] :].view(np.bool_)
        return Scores(
            flags[:num],
            memory[ends[1] : ends[2]].view(own).reshape(num, width),
            memory[: ends[0]].view(own).astype(given) if machine.has_head else None,
            flags[num : 2 * num],
            flags[2 * num : 3 * num],
            flags[3 * num :].reshape(num, each),
            memory[ends[0] : ends[1]].view(own).reshape(num, each),
        )

    def _matrices(self, matrices: Sequence[Array]) -> int:
        """Matrices in blocks of rows, each with the columns that are not zero in it."""
        made = (_Matrix * max(1, len(matrices)))()
        for to, matrix in zip(made, matrices, strict=False):
            if not len(matrix):
                continue
            num = -(-len(matrix) // _ROWS)
            blocks = np.zeros((num * _ROWS, matrix.shape[1]))
            blocks[: len(matrix)] = matrix
            blocks = blocks.reshape(num, _ROWS, -1)
            used = (np.abs(blocks) > 1e-15 * np.abs(matrix).max()).any(1)
            start = used.argmax(1)
            width = int((matrix.shape[1] - used[:, ::-1].argmax(1) - start).max())
            start = np.minimum(start, matrix.shape[1] - width)
            columns = start[:, None] + np.arange(width)
            values = blocks[np.arange(num)[:, None], :, columns]  # [num, width, rows]
            to.values, to.first = self._array(values), self._array(start, np.int32)
            to.num_blocks, to.num_columns, to.width = num, matrix.shape[1], width
        self._held.append(made)
        return ctypes.addressof(made)


@dataclass(frozen=True)
class Pool:
    """What is pooled over the channels of one kind.

    Attributes:
        channels: in the hand, m of them.
        inputs: each descriptor of all channels, ``[R, m]``.
        statistics: mean, std, min, max, or the place of an order statistic, from 0 to 1.
        columns: that they are, ``[statistics, R]``; -1: not wanted.
        scales: compression scales of the descriptors, ``[R]``.
    """

    channels: Sequence[int]
    inputs: Array
    statistics: Sequence[str | float]
    columns: Array
    scales: Array


class Machine(_Kept):
    """From inputs, the features that are read, to columns, scaled columns and a score.

    Args:
        num_channels: of the hand.
        num_inputs: features that go in.
        num_columns: K, of which S scaled columns are made.
        singles: input and column of what is not pooled.
        pools: what is; their columns and the singles' are all there are.
        fill: columns where no channel of their kind is in use, ``[K]``.
        scaling: minimum, maximum, compression scales (or None) and the columns that are scaled
            (None: one each), ``[S]``; None: nothing is scaled, and S is K.
        imputation: scaled columns of lost channels, and the channel of each (-1: of several),
            ``[S]``; None: they stay as they are.
        head: quadratic part ``[m, m]`` of the first m scaled columns (or empty), linear part
            ``[S]`` and constant; None: no score.
        signs: of the factors, ``[r]``, which are then the quadratic part, ``[r, m]``.
        dtype: number type of the engine.
    """

    def __init__(
        self,
        *,
        num_channels: int,
        num_inputs: int,
        num_columns: int,
        singles: Sequence[tuple[int, int]],
        pools: Sequence[Pool] = (),
        fill: Array | None = None,
        scaling: tuple[Array, Array, Array | None, Array | None] | None = None,
        imputation: tuple[Array, Array] | None = None,
        head: tuple[Array, Array, float] | None = None,
        signs: Array | None = None,
        dtype: Number = np.float64,
    ) -> None:
        super().__init__(dtype)
        minimum, maximum, compression, sources = scaling or (None,) * 4
        if sources is None:
            sources = np.arange(num_columns)
        self.num_scaled, self.has_head = len(sources), head is not None
        made = (_Pool * max(1, len(pools)))()
        for to, pool in zip(made, pools, strict=False):
            kinds = ("mean", "std", "min", "max")
            codes = [kinds.index(s) if isinstance(s, str) else len(kinds) for s in pool.statistics]
            fractions = [0.0 if isinstance(s, str) else s for s in pool.statistics]
            to.num_channels, to.num_families = len(pool.channels), len(pool.scales)
            to.num_statistics = len(codes)
            to.channels = self._array(pool.channels, np.int32)
            to.statistics = self._array(codes, np.int32)
            to.fractions = self._array(fractions)
            to.inputs = self._filled_up(pool.inputs.T, 0, np.int32)
            to.columns = self._filled_up(pool.columns, -1, np.int32)
            to.scales = self._filled_up(pool.scales, 1.0)
        self._held.append(made)
        places = np.array(singles, np.int32).reshape(-1, 2)
        self.of = _Machine(
            num_channels, num_inputs, num_columns, self.num_scaled, 0, 0, len(places), len(pools),
            max((len(pool.channels) for pool in pools), default=0),
            *(self._array(each, np.int32) for each in places.T), ctypes.addressof(made),
        )  # fmt: skip
        self.of.sources = self._filled_up(sources, 0, np.int32)
        if fill is not None:
            self.of.fill = self._array(fill)
        if minimum is not None and maximum is not None:
            if dtype is np.float32:
                centre, minimum, maximum = _centred(minimum, maximum, compression)
                if centre.any():
                    self.of.centre = self._filled_up(centre, 0.0)
            self.of.minimum = self._filled_up(minimum, 0.0)
            self.of.width = self._filled_up(maximum - minimum, 0.0)
        if compression is not None:
            self.of.compression = self._filled_up(compression, 1.0)
        if imputation is not None:
            self.of.imputation = self._array(imputation[0])
            self.of.channels = self._array(imputation[1], np.int32)
        if head is not None:
            quadratic, linear, constant = head
            self.of.linear = self._filled_up(linear, 0.0)
            self.of.constant = constant
            rows = quadratic
            if signs is None:
                rows = np.tril(quadratic + quadratic.T)
                rows[np.diag_indices_from(rows)] /= 2
            elif len(signs):
                self.of.num_factors = len(signs)
                self.of.signs = self._filled_up(signs, 0.0)
                rows = np.pad(rows, [(0, 0), (0, -rows.shape[1] % _WHOLE)])
            if len(rows):
                blocks = np.pad(rows, [(0, -len(rows) % _WHOLE), (0, 0)])
                blocks = blocks.reshape(-1, _WHOLE, rows.shape[1]).swapaxes(1, 2)
                self.of.num_quadratic = rows.shape[1]
                self.of.quadratic = self._array(blocks)

    def columns(self, inputs: Array, is_lost: Array | None = None) -> Array:
        """Columns of bins, scaled if there is a scaling, ``[M, S]``.

        Shape:
            - inputs: ``[M, inputs]``
            - is_lost: ``[M, C]``, bool, channels that are left out of their pools
        """
        found = np.empty((len(inputs), self.num_scaled), self.dtype)
        inputs = np.asarray(inputs, self.dtype)  # has a name, or it is gone before it is read
        call = _Bins(*_samples_of(inputs), scaled=found.ctypes.data)
        if is_lost is not None:
            is_lost = np.ascontiguousarray(is_lost)
            call.is_lost = is_lost.ctypes.data
        self._run(None, self.of, call)
        return found


_NARROW = 16  # ranges of a column between it and 0, from which on it has a centre


def _centred(
    minimum: Array, maximum: Array, compression: Array | None
) -> tuple[Array, Array, Array]:
    """Centres of scaled columns in float32, and minimum and maximum less those, all ``[S]``.

    A centre is a column's value in the middle of a narrow range, or 0. Rounding to float32 is of
    the size of a value; of its distance from the centre it is little where ranges are narrow.

    Args:
        minimum: ``[S]``, of compressed columns where there is compression.
        maximum: ``[S]``.
        compression: scales, ``[S]``.
    """
    middle = minimum / 2 + maximum / 2
    is_narrow = np.abs(middle) > _NARROW * (maximum - minimum)
    with np.errstate(over="ignore"):
        spread = middle if compression is None else np.expm1(np.abs(middle) / compression)
        centre = middle if compression is None else np.sign(middle) * compression * spread
        centre = np.where(is_narrow, centre, 0.0).astype(np.float32)
    centre = np.where(np.isfinite(centre), centre, 0.0).astype(np.float64)
    at = centre
    if compression is not None:
        at = np.sign(centre) * compression * np.log1p(np.abs(centre) / compression)
    return centre, minimum - at, maximum - at


class Scores(NamedTuple):
    """What ``FeatureEngine.score`` finds of ``M`` bins.

    Attributes:
        is_odd: magnitudes are out of range, and all else is of no meaning, ``[M]``.
        scaled: columns, ``[M, S]``; S is 0 where there is a score.
        score: ``[M]``, NaN where not valid; None without a head.
        is_valid: enough channels are alive, ``[M]``.
        in_range: so is the size of their signals, ``[M]``.
        is_lost: channels that are missing or silent, ``[M, C]``.
        span: of the filtered bin of each channel, NaN where missing, ``[M, C]``.
    """

    is_odd: Array
    scaled: Array
    score: Array | None
    is_valid: Array
    in_range: Array
    is_lost: Array
    span: Array


def _samples_of(array: Array) -> tuple[int, bool, int, int, int]:
    """Address, precision, length and strides of an array, whose last axis must be contiguous."""
    _check_floats(array)
    size, strides = array.itemsize, array.strides
    if array.size and array.shape[-1] > 1 and strides[-1] != size:
        raise ValueError(f"expected an array whose last axis is contiguous, got {strides}")
    return array.ctypes.data, size == 4, len(array), strides[0] // size, strides[1] // size


def _check_floats(array: Array) -> None:
    if array.dtype not in (np.float32, np.float64):
        raise ValueError(f"the native engine takes float32 and float64, got {array.dtype}")


class OnsetEngine(_Kept):
    """Scores of a stream's hops by the native engine, as ``onset/evidence.py`` defines them.

    Args:
        fast: indices of the fast channels.
        slow: of the slow ones.
        windows: over how many blocks levels are taken, ascending.
        pairs: places among the fast channels of those whose correlation is taken.
        lags: hops back of further columns that the head takes, ascending.
        filters: a block with its context to the outputs of all filters.
        context: samples before a block that are handed over.
        steps: means of the last blocks to steps.
        rounding: power of the converter's rounding behind each filter.
        least_step: of each slow channel, beside its usual steps.
        silence: half the log power of a silent channel.
        rates: what a block adds to each floor.
        scaling: factor and offset of each column, which is then clipped to [-1, 1].
        layers: weights ``[out, in]`` and biases of a network; empty: there is a form.
        form: quadratic part (or empty), linear part and constant; ``None``: there are layers.
        is_still: fast channels whose usual block holds one value.
        min_alive: channels that must be alive.
        blind: known blocks before the first with a score.
        most_lost: lost blocks in a row, beyond which the memory begins anew.
        with_columns: whether columns are handed out.

    Attributes:
        memory: what is kept of a stream, float64.

    Shape:
        - pairs: ``[2, P]``; filters: ``[context + hop, B, hop]``; steps: ``[b, D]``
        - rounding, silence: ``[B, F]``

    Raises:
        OSError: if the engine is not available.
    """

    def __init__(
        self,
        *,
        fast: Sequence[int],
        slow: Sequence[int],
        windows: Sequence[int],
        pairs: Array,
        lags: Sequence[int],
        filters: Array,
        context: int,
        steps: Array,
        rounding: Array,
        least_step: Array,
        silence: Array,
        rates: Sequence[float],
        scaling: tuple[Array, Array],
        layers: Sequence[tuple[Array, Array]],
        form: tuple[Array, Array, float] | None,
        is_still: Sequence[bool],
        min_alive: int,
        blind: int,
        most_lost: int,
        with_columns: bool,
    ) -> None:
        super().__init__()
        _, num_filters, hop = filters.shape
        num_columns, delay, num_steps = len(scaling[0]), windows[-1], steps.shape[1]
        quadratic, linear, constant = form or (np.empty(0), np.empty(0), 0.0)
        weights = np.concatenate([np.empty(0), *(each.T.ravel() for each, _ in layers)])
        biases = np.concatenate([np.empty(0), *(bias for _, bias in layers)])
        widths = [layers[0][0].shape[1], *(len(bias) for _, bias in layers)] if layers else []
        whole = (fast, slow, windows, *pairs, lags, widths)
        numbers = (
            filters, steps, rounding, silence, least_step, rates, *scaling, weights, biases,
            quadratic, linear,
        )  # fmt: skip
        self.of = _Onset(
            len(fast), len(slow), num_filters, len(windows), pairs.shape[1], num_steps, len(lags),
            num_columns, len(layers), hop, context, delay, len(steps), blind, min_alive, most_lost,
            *(self._array(each, np.int32) for each in whole),
            *(self._array(each) if np.size(each) else None for each in numbers),
            self._array(is_still, np.uint8), constant,
        )  # fmt: skip
        num_logs, num_sizes = num_filters * len(fast), num_steps * len(slow)
        kept = delay * (num_logs + num_filters * pairs.shape[1] + num_sizes)
        kept += (len(steps) - 1) * len(slow) + len(rates) * num_logs + num_sizes
        self.memory = np.zeros(1 + kept + (max(lags) if lags else 0) * num_columns)
        self._num_lost, self._with_columns = 0, with_columns

    def __call__(self, samples: Array, in_use: Array) -> tuple[Array, Array, Array]:
        """The scores of the next hops, which of their blocks are lost, and their columns.

        Args:
            samples: of the hops, with their context.
            in_use: channels that are not left out.

        Shape:
            - samples: ``[C, context + k * hop]``, float32 or float64; in_use: ``[C]``, bool
            - output: ``[k]``, NaN without evidence; ``[k]``; ``[k, K]``, or ``[0, K]``
        """
        address, is_float, _, stride, _ = _samples_of(samples[:, None])
        num = (samples.shape[1] - self.of.context) // self.of.hop
        score, is_lost = np.empty(num), np.zeros(num, np.bool_)
        columns = np.empty((num * self._with_columns, self.of.num_columns))
        call = _OnsetHops(
            address, is_float, stride, num, self._num_lost, self.memory.ctypes.data,
            in_use.ctypes.data, score.ctypes.data, is_lost.ctypes.data,
            columns.ctypes.data if self._with_columns else None,
        )  # fmt: skip
        if self._library.tactslip_onset(self._level, ctypes.byref(self.of), ctypes.byref(call)):
            raise MemoryError("the native engine found no memory to work in")
        self._num_lost = call.num_lost
        return score, is_lost, columns


def carry_bristles(
    table: Array,
    pressure: Array,
    states: Array,
    bristles: Array,
    arm: Array,
    load: Array,
    *,
    step_s: float,
    gamma: float,
    every: int,
    patience: int,
) -> Array:
    """Carry lanes through time as ``simulation/_bristles.py`` defines it; float64, contiguous.

    Args:
        table: mass, k, k1, tau, c, mu_s, mu_k, Stribeck speed, stiffness and damping of a bristle,
            ``1 / (1 + a / tau)`` and inertia of each lane.
        pressure: part of the load on each bristle.
        states: u, v and q, taken on.
        bristles: deflections, taken on.
        arm: speed at both stages of each step.
        load: at the same times.
        step_s: length of a step.
        gamma: length of a stage in steps.
        every: of how many steps the last is kept.
        patience: evaluations after which every other step halves the bracket.

    Shape:
        - table: ``[12, L]``; pressure: ``[n]``; states: ``[3, L]``; bristles: ``[L, n]``;
          arm, load: ``[2 steps, L]``
        - output: friction, inertia and slip, ``[3, steps / every, L]``
    """
    loaded, num_steps = _library(), len(arm) // 2
    out = np.empty((3, num_steps // every, len(bristles)))
    arrays = (table, pressure, states, bristles, arm, load, out)
    run = _BristleRun(
        *bristles.shape, num_steps, every, patience, step_s, gamma,
        *(array.ctypes.data for array in arrays),
    )  # fmt: skip
    if loaded.tactslip_bristles(_level(loaded), ctypes.byref(run)):
        raise MemoryError("the native engine found no memory to work in")
    return out


def _entropy_growth(num: int) -> Array:
    """What the value of each rank in its cell adds to the entropy of ``num`` values, in bits.

    More than the rank before; the first times ``num`` is the entropy of ``num`` cells.
    """
    p = np.arange(num + 1) / num
    return np.diff(np.diff(-p * np.log2(p + np.finfo(np.float64).eps)), prepend=0.0)


def transform_work(spectrum: Array) -> float:
    """Multiplications by a matrix that take as long as the engine's Fourier transform of a row.

    Infinite where there is none: bins are short, or points of the transform no multiple of 4.

    Shape:
        - spectrum: ``[2 L, n]``, cosines before sines
    """
    num_samples, num_points = spectrum.shape[1], _num_points(spectrum)
    if num_samples <= _SHORT or num_points % 4:
        return math.inf
    leaf, stages = num_points, 0
    while leaf % 2 == 0 and leaf > 8:
        leaf, stages = leaf // 2, stages + 1
    return float(2 * num_samples * leaf + 4 * num_points * stages)  # measured, on x86-64 v4


def _num_points(spectrum: Array) -> int:
    """Of the Fourier transform whose lines these are: the first turns by one of them a sample."""
    cosine, sine = spectrum[[1, len(spectrum) // 2 + 1], 1]
    return round(2 * math.pi / math.atan2(-sine, cosine))


def _spectra_read(need: Array, num_branches: int) -> list[bool]:
    """Of which branches A1, D1, A2 ... the spectrum is formed from coefficients.

    Those of details that are wanted, and of a channel's coarsest approximation that is; finer ones
    are sums of these and the details between. Band energy ratios want all.

    Shape:
        - need: ``[C, rows]``, descriptors wanted of each row
    """
    wanted: Array = need[:, num_branches : 2 * num_branches] | need[:, 2 * num_branches, None]
    read: Array = np.any(wanted, 0)
    levels = read[::2].nonzero()[0]  # of approximations
    read[::2] = False
    if len(levels):
        read[[2 * row.nonzero()[0][-1] for row in wanted[:, ::2] if row.any()]] = True
        read[2 * levels[0] + 3 : 2 * levels[-1] + 2 : 2] = True
    return [bool(each) for each in read]


def backend_of(name: BackendName) -> Literal["native", "torch"]:
    """What a name means on this machine: ``"auto"`` is native where that can be used.

    Raises:
        ValueError: for an unknown name, or ``"native"`` where it cannot be used.
    """
    if name not in get_args(BackendName):
        known = ", ".join(get_args(BackendName))
        raise ValueError(f"backend must be one of {known}, got {name!r}")
    trouble = "" if name == "torch" else reason_unavailable()
    if trouble and name == "native":
        raise ValueError(f'backend "native" cannot be used: {trouble}')
    return "torch" if trouble or name == "torch" else "native"


def reason_unavailable() -> str:
    """Why the engine cannot be used here, and the remedy; empty if it can. Builds it if need be."""
    loaded = _loaded()
    return loaded if isinstance(loaded, str) else ""


def instruction_set() -> str:
    """For which the engine in use is compiled: v4 (AVX-512), v3 (AVX2) or v2 of x86-64, or v1."""
    return f"v{_level(_library())}"


def _level(library: ctypes.CDLL) -> int:
    """The best that the processor has, or less, as the switch says."""
    best = int(library.tactslip_level())
    chosen = os.environ.get(SWITCH, "")
    return min(best, int(chosen[1:])) if re.fullmatch("v[1-4]", chosen) else best


@lru_cache(maxsize=1)
def _loaded() -> ctypes.CDLL | str:
    """The library, or why there is none; asked once."""
    try:
        if is_off():
            raise OSError(f"the native engine is switched off by {SWITCH}=0")
        library = ctypes.CDLL(str(_library_path()))
    except OSError as error:
        _LOG.warning("features and simulation are made by torch, which is slower: %s", error)
        return str(error)
    pointer, number = ctypes.c_void_p, ctypes.c_int
    library.tactslip_features.argtypes = (number, number, pointer, pointer, pointer)
    library.tactslip_bristles.argtypes = (number, pointer)
    library.tactslip_onset.argtypes = (number, pointer, pointer)
    return library


def _library() -> ctypes.CDLL:
    """The library that holds the engine and the C interface ``tactslip.h``.

    Raises:
        OSError: if it is not available.
    """
    loaded = _loaded()
    if isinstance(loaded, str):
        raise OSError(loaded)
    return loaded


def _library_path() -> Path:
    """Where the library lies; built first, if it is there neither beside the sources nor kept."""
    here, name = Path(__file__).parent, library_name()
    folders = [here, *_user_cache()]
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    _LOG.warning("building the native engine from its sources: under a minute, once")
    for folder in folders:
        with contextlib.suppress(OSError):  # a file in the way, or no leave to write: the next
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                break
    else:
        raise OSError(f"no folder for the native engine can be written to; {REMEDY}")
    return build_library(folder)


def _user_cache() -> list[Path]:
    """The user's cache, if there is a home; no shared folder, as code in it is run."""
    chosen = os.environ.get("XDG_CACHE_HOME")
    try:
        base = Path(chosen) if chosen else Path.home() / ".cache"
    except RuntimeError:
        return []
    return [base / "tactslip_torch" / "native"]
