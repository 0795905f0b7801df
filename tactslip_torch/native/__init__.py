"""The door to the native engine (``engine.cpp``), through ctypes.

The library lies beside this file if the package was installed, or is built at the first use, into
this folder or the user's cache. Without it (no compiler, or the environment has
``TACTSLIP_NATIVE=0``) what it does is done by torch; ``why_not`` tells. ``TACTSLIP_NATIVE=v3`` uses
no instruction set beyond AVX2, ``v2`` the one of any 64-bit processor.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from tactslip_torch.native.build import REMEDY, SWITCH, build_library, is_off, library_name

Array = np.ndarray[Any, Any]
BackendName = Literal["auto", "native", "torch"]
_LOG = logging.getLogger(__name__)
DESCRIPTORS = (
    "mean", "median", "mode", "range", "mean_deviation", "std", "cv", "iqr", "skewness",
    "kurtosis", "energy", "entropy", "peak_factor", "correlation", "spectral_centroid",
    "spectral_spread",
)  # fmt: skip
"""In the order of ``enum Descriptor``."""
MAX_BRANCHES = 32


class _Matrix(ctypes.Structure):
    _fields_ = (
        ("values", ctypes.c_void_p),
        ("first", ctypes.c_void_p),
        ("num_blocks", ctypes.c_int64),
        ("num_columns", ctypes.c_int64),
        ("width", ctypes.c_int64),
    )


class _Plan(ctypes.Structure):
    _numbers = (
        *("is_float", "num_channels", "num_samples", "num_lines", "num_branches"),
        *("num_features", "num_coefficients", "num_slow", "num_fast"),
    )
    _pointers = (
        *("slow", "fast", "first", "descriptor", "column", "need"),
        *("low", "high", "out", "lines", "ones", "frequency_hz", "gain_time", "gain_lines"),
    )
    _fields_ = tuple(
        [(name, ctypes.c_int64) for name in _numbers]
        + [(name, ctypes.c_void_p) for name in _pointers]
    )


class _BristleRun(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int64) for name in (
            "num_lanes", "num_bristles", "num_steps", "every", "patience")),
        ("step_s", ctypes.c_double),
        ("gamma", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in (
            "table", "pressure", "states", "bristles", "arm", "load", "out")),
    )  # fmt: skip


class FeatureEngine:
    """Features of bins by the native engine; called from several threads at once.

    Args:
        dtype: of the statistics; float32 for rows scaled to order one.
        num_channels: of bins.
        slow: indices of the channels that are described as they are.
        fast: indices of the channels whose branches and spectra are described.
        wanted: channel, row, descriptor and column of every feature. Rows are the branches (0 for a
            slow channel), their spectra, and one for band energy ratios, whose descriptor is the
            number of the branch.
        low: from a bin, or the approximation's coefficients of one level, to those of the next.
        high: from the same to the coefficients of details.
        out: from coefficients to branches A1, D1, A2, D2 and so on.
        spectrum: from a branch to its lines, cosines before sines.
        frequency_hz: of the lines.

    Shape:
        - low, high: ``[r, n or r before]`` each; out: ``[n, r]`` each; spectrum: ``[2 L, n]``

    Raises:
        OSError: if the engine is not available.
    """

    def __init__(
        self,
        *,
        dtype: type[np.floating[Any]],
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
        self._library = _library()
        self._level = _level(self._library)
        num_branches = len(out)
        self._num_rows = 2 * num_branches + 1
        self._kept: list[object] = []  # what the plan points to
        bands = [self._matrices(group, 4, np.float64) for group in (low, high, out)]
        lines = [spectrum @ matrix for matrix in out]
        wanted = sorted(wanted)
        place = np.array([w[0] * self._num_rows + w[1] for w in wanted], np.int64)
        first = np.searchsorted(place, np.arange(num_channels * self._num_rows + 1))
        descriptor = np.array([w[2] for w in wanted], np.int64)
        need = np.zeros(num_channels * self._num_rows, np.uint32)
        np.bitwise_or.at(need, place, np.uint32(1) << descriptor.astype(np.uint32))
        self.num_features = len(wanted)
        self._plan = _Plan(
            dtype is np.float32,
            num_channels,
            spectrum.shape[1],
            len(frequency_hz),
            num_branches,
            len(wanted),
            sum(len(matrix) + 8 for matrix in low) + 8,
            len(slow),
            len(fast),
            self._array(slow, np.int64),
            self._array(fast, np.int64),
            self._array(first, np.int64),
            self._array(descriptor, np.int64),
            self._array([w[3] for w in wanted], np.int64),
            self._array(need, np.uint32),
            *bands,
            self._matrices(lines, 8, dtype),
            self._array(spectrum.sum(-1), dtype),
            self._array(frequency_hz, np.float64),
            self._array(_entropy_growth(spectrum.shape[1]), np.float64),
            self._array(_entropy_growth(len(frequency_hz)), np.float64),
        )

    def __call__(self, bins: Array, out: Array) -> Array:
        """Write the features of some bins; which of them hold magnitudes out of range.

        Features of those are of no meaning. A channel with a NaN or Inf has features NaN.

        Shape:
            - bins: ``[M, C, n]``, float32 or float64, contiguous
            - out: ``[M, K]``, float32 or float64, contiguous, written
            - output: ``[M]``, bool
        """
        is_odd = np.zeros(len(bins), np.bool_)
        is_single = (bins.dtype == np.float32, out.dtype == np.float32)
        status = self._library.tactslip_features(
            self._level, ctypes.byref(self._plan),
            bins.ctypes.data, is_single[0], len(bins), out.ctypes.data, is_single[1],
            is_odd.ctypes.data,
        )  # fmt: skip
        if status:
            raise MemoryError("the native engine found no memory to work in")
        return is_odd

    def _array(self, values: Any, dtype: Any) -> int:
        array = np.ascontiguousarray(values, dtype)
        self._kept.append(array)
        return array.ctypes.data

    def _matrices(self, matrices: Sequence[Array], rows: int, dtype: Any) -> int:
        """Matrices in blocks of rows, each with the columns that are not zero in it."""
        made = (_Matrix * max(1, len(matrices)))()
        for to, matrix in zip(made, matrices, strict=False):
            num = -(-len(matrix) // rows)
            blocks = np.zeros((num * rows, matrix.shape[1]))
            blocks[: len(matrix)] = matrix
            blocks = blocks.reshape(num, rows, -1)
            used = (np.abs(blocks) > 1e-15 * np.abs(matrix).max()).any(1)
            start = used.argmax(1)
            width = int((matrix.shape[1] - used[:, ::-1].argmax(1) - start).max())
            start = np.minimum(start, matrix.shape[1] - width)
            columns = start[:, None] + np.arange(width)
            values = blocks[np.arange(num)[:, None], :, columns]  # [num, width, rows]
            to.values, to.first = self._array(values, dtype), self._array(start, np.int64)
            to.num_blocks, to.num_columns, to.width = num, matrix.shape[1], width
        self._kept.append(made)
        return ctypes.addressof(made)


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
    library, num_steps = _library(), len(arm) // 2
    out = np.empty((3, num_steps // every, len(bristles)))
    arrays = (table, pressure, states, bristles, arm, load, out)
    run = _BristleRun(
        *bristles.shape, num_steps, every, patience, step_s, gamma,
        *(array.ctypes.data for array in arrays),
    )  # fmt: skip
    if library.tactslip_bristles(_level(library), ctypes.byref(run)):
        raise MemoryError("the native engine found no memory to work in")
    return out


def _entropy_growth(num: int) -> Array:
    """What the value of each rank in its cell adds to the entropy of ``num`` values, in bits."""
    p = np.arange(num + 1) / num
    return np.diff(-p * np.log2(p + np.finfo(np.float64).eps))


def backend_of(name: BackendName) -> Literal["native", "torch"]:
    """What a name means on this machine: ``"auto"`` is native where that can be used.

    Raises:
        ValueError: for an unknown name, or ``"native"`` where it cannot be used.
    """
    if name not in get_args(BackendName):
        known = ", ".join(get_args(BackendName))
        raise ValueError(f"backend must be one of {known}, got {name!r}")
    trouble = "" if name == "torch" else why_not()
    if trouble and name == "native":
        raise ValueError(f'backend "native" cannot be used: {trouble}')
    return "torch" if trouble or name == "torch" else "native"


def why_not() -> str:
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
    library.tactslip_features.argtypes = (
        number, pointer, pointer, number, ctypes.c_int64, pointer, number, pointer,
    )  # fmt: skip
    library.tactslip_bristles.argtypes = (number, pointer)
    return library


def _library() -> ctypes.CDLL:
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
