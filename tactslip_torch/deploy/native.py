"""A detector as one file for libtactslip, the C library (``native/tactslip.h``).

``detector.tslip`` is little-endian and read in place: a head with version, length and checksum,
then what the library reads in its order (``native/file.h``), each table at a multiple of its
numbers' size. It holds all that a stream needs: filter, features, scaling, head, rule and
threshold, the onset classifier, floors of channels, and scale and offset of a converter.
"""

from __future__ import annotations

import ctypes
import math
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from tactslip_torch import native
from tactslip_torch.deploy.bins import Precision, RawBin, Timing, dtype_of
from tactslip_torch.deploy.check import Run, compare
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import HOST_COLUMNS, AlarmSettings
from tactslip_torch.onset.evidence import FLOORS_S, OnsetClassifier, engine_of
from tactslip_torch.onset.rules import NOTHING_YET, Cusum, KOfN, most_lost
from tactslip_torch.runtime import whole_file
from tactslip_torch.signals.filtering import past_matrix

FILE, SOURCE = "detector.tslip", "detector.c"
FORMAT = 1
_MAGIC = b"tactslip"
_HEAD = struct.Struct("<8sIIII")  # magic, version, bytes, checksum of the rest, bytes of a number

Array = NDArray[Any]


class _Writer:
    """Bytes, one table behind the other."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self.dtype, self.content = dtype, bytearray(_HEAD.size)

    def table(self, values: Any, dtype: Any = None) -> None:
        """Of numbers, by default in the file's precision."""
        array = np.asarray(values, dtype or self.dtype)
        array = array.astype(array.dtype.newbyteorder("<"), order="C")
        self.content += bytes(-len(self.content) % array.dtype.itemsize)
        self.content += array.tobytes()

    def numbers(self, *values: int) -> None:
        """Whole numbers."""
        self.table(values, np.int32)

    def real(self, value: float) -> None:
        """In float64, whatever the precision."""
        self.content += struct.pack("<d", value)

    def fields(self, of: ctypes.Structure, *names: str) -> None:
        """Whole numbers of a structure of the engine."""
        self.numbers(*(getattr(of, name) for name in names))

    def arrays(self, of: ctypes.Structure, dtype: Any = None, **counts: int) -> None:
        """Tables that a structure of the engine points to, each with how many numbers it has."""
        for name, count in counts.items():
            self.table(_pointed(getattr(of, name), count, dtype or np.float64), dtype)

    def whole(self) -> bytes:
        """The file."""
        self.content += bytes(-len(self.content) % 8)
        number_bytes = struct.pack("<I", self.dtype.itemsize)
        rest = zlib.crc32(number_bytes + self.content[_HEAD.size :])
        head = (_MAGIC, FORMAT, len(self.content), rest, self.dtype.itemsize)
        return _HEAD.pack(*head) + bytes(self.content[_HEAD.size :])


def _pointed(address: int | None, count: int, dtype: Any) -> Array:
    """Numbers at an address of a structure, copied."""
    size = count * np.dtype(dtype).itemsize
    assert address or not count
    memory = ctypes.string_at(address or 0, size) if count else b""
    return np.frombuffer(memory, dtype)


@dataclass(frozen=True)
class NativeFile:
    """A detector as the C library reads it.

    Attributes:
        content: of ``detector.tslip``.
        why_double: how float32 failed its comparison, where ``checked`` took float64 instead.
    """

    content: bytes
    why_double: str = ""

    @classmethod
    def of(
        cls,
        detector: SlipDetector,
        precision: Precision = "float32",
        *,
        scale: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
    ) -> NativeFile:
        """That of a detector with alarm settings.

        Args:
            detector: as fitted.
            precision: of all numbers, samples and scores: float32 or float64.
            scale: of a converter, one number or one a channel: a sample is scale * count + offset.
            offset: likewise.

        Raises:
            ValueError: if the detector has no alarm settings, a number is none of these, or a scale
                is 0.
        """
        dtype, settings = dtype_of(precision), AlarmSettings.of(detector)
        given = torch.float32 if precision == "float32" else torch.float64
        out, num_channels = _Writer(dtype), len(detector.pool.hand)
        _write_stream(out, detector, settings)
        for name, values in (("scale", scale), ("offset", offset)):
            out.table(np.broadcast_to(_of_converter(name, values, num_channels), num_channels))
        _write_filters(out, detector, given, settings)
        features, machine = detector.engine_tables()
        _write_plan(out, features)
        _write_machine(out, machine)
        if settings.onset is not None:
            evidence = settings.onset.evidence
            hold = round(settings.hold_s * evidence.sample_rate_hz)
            window = evidence.context + evidence.hop_samples
            _write_onset(out, settings.onset, most_lost(window, hold, evidence.hop_samples))
        return cls(out.whole())

    @classmethod
    def checked(
        cls,
        detector: SlipDetector,
        precision: Precision | Literal["auto"] = "auto",
        **counts: float | Sequence[float],
    ) -> NativeFile:
        """That of a detector, compared with torch.

        Args:
            detector: as of ``of``.
            precision: ``"auto"`` is float32 where its comparison passes, and float64 elsewhere.
            counts: ``scale`` and ``offset``.

        Raises:
            ValueError: as ``of``, or if a comparison fails.
        """
        only: Precision = "float32" if precision == "auto" else precision
        made = cls.of(detector, only, **counts)
        try:
            compare(_runner(made), detector, "stream", only, exact_onsets=only == "float64")
        except ValueError as error:
            if precision == "auto":
                return replace(cls.checked(detector, "float64", **counts), why_double=str(error))
            advice = "; give precision=float64 or auto" if precision == "float32" else ""
            raise ValueError(f"{FILE} was not written: {error}{advice}") from error
        return made

    def write(self, folder: str | os.PathLike[str], *, source: bool = False) -> tuple[Path, ...]:
        """Write ``detector.tslip`` and, on request, its bytes as constants for flash.

        Args:
            folder: for the files.
            source: whether ``detector.c`` is written too.
        """
        contents = {FILE: self.content} | ({SOURCE: self.as_constants()} if source else {})
        for name, each in contents.items():
            with whole_file(Path(folder) / name) as temporary:
                temporary.write_bytes(each)
        return tuple(Path(folder) / name for name in contents)

    @property
    def precision(self) -> Precision:
        """Of all its numbers."""
        return "float32" if _HEAD.unpack_from(self.content)[-1] == 4 else "float64"

    def as_constants(self) -> bytes:
        """The file as C source, at a multiple of 8 bytes."""
        words = np.frombuffer(self.content, "<u8").tolist()
        lines = ",\n".join(f"0x{word:x}ull" for word in words)
        return (
            "/* Written by tactslip export graph=native. */\n"
            "#include <stddef.h>\n#include <stdint.h>\n"
            f"const uint64_t tactslip_detector[] = {{\n{lines}}};\n"
            "const size_t tactslip_detector_bytes = sizeof tactslip_detector;\n"
        ).encode()

    def stream(self) -> _NativeStream:
        """A stream that the library decides on, as any C program runs it.

        Raises:
            ValueError: if this is no such file, or a damaged one, in the library's words.
            OSError: if the library is not available.
        """
        return _NativeStream(self.content)


def _of_converter(name: str, values: float | Sequence[float], num_channels: int) -> Array:
    """Scale or offset as float64: one number, or one a channel."""
    try:
        numbers = np.asarray(values)
    except ValueError:  # lists of several lengths
        numbers = np.empty(0)
    is_number = numbers.dtype.kind in "iuf" and np.isfinite(numbers).all()
    if not is_number or numbers.shape not in ((), (num_channels,)):
        raise ValueError(
            f"native.{name} must be a finite number, or one for each of {num_channels} channels, "
            f"got {values!r}"
        )
    if name == "scale" and not numbers.all():
        raise ValueError(f"native.scale must not be 0, got {values!r}: it is volts a count")
    return numbers.astype(np.float64)


def _write_stream(out: _Writer, detector: SlipDetector, settings: AlarmSettings) -> None:
    raw, timing = RawBin.of(detector), Timing.of(detector, settings)
    rule, onset, rate_hz = settings.rule, settings.onset, detector.pool.sample_rate_hz
    out.numbers(
        *(len(detector.pool.hand), raw.bin, raw.before, raw.after, timing.frame, timing.hop),
        *(detector.sensing.stuck_samples, round(settings.hold_s * rate_hz)),
        *((rule.n, rule.k) if isinstance(rule, KOfN) else (0, 0)),
        *settings.latch_times(rate_hz).values(),
        onset is not None,
    )
    share = settings.slip_share
    sums = (rule.drift, rule.evidence, rule.ceiling) if isinstance(rule, Cusum) else (0.0, 1.0, 1.0)
    for value in (
        *(rate_hz, settings.calibration.slope, settings.calibration.offset),
        *(math.log(share) - math.log1p(-share), *sums, settings.threshold, settings.lead_s),
        *((onset.threshold, onset.hint, onset.lead_s) if onset else (0.0, 0.0, 0.0)),
    ):
        out.real(value)
    names = (*detector.pool.hand.names, detector.info.get("units", "V"))
    text = b"".join(name.encode() + b"\0" for name in names)
    out.numbers(len(text))
    out.content += text


def _write_filters(
    out: _Writer, detector: SlipDetector, given: torch.dtype, settings: AlarmSettings
) -> None:
    layer, used = detector.channel_filter, RawBin.of(detector).channels
    first = {layer.window_lengths[channel]: channel for channel in used}  # a channel of each frame
    out.numbers(len(first))
    for length, channel in first.items():
        past = past_matrix(length, layer.polyorder, layer.align)
        out.numbers(length, len(past))
        out.table(layer.kernel(channel))
        out.table(past)
    places = [*first]
    frame_of = [places.index(layer.window_lengths[channel]) for channel in used]
    of_hand = np.full(len(detector.pool.hand), -1)
    of_hand[list(used)] = frame_of
    out.numbers(*of_hand)
    out.table(1.0)
    sensing, largest = detector.sensing, float(np.finfo(out.dtype).max)
    out.table(detector.pool.inverse_span(given, is_raw=True))
    for spans in (sensing.floor, *settings.sensing(sensing).bounds):
        out.table(np.minimum(spans, largest))
    out.table(detector.counted, np.uint8)
    out.numbers(sensing.min_alive)


def _write_plan(out: _Writer, plan: ctypes.Structure) -> None:
    num_levels, num_features = plan.num_branches // 2, plan.num_features
    out.numbers(plan.num_lines, num_levels)
    out.fields(plan, "num_features", "num_slow", "num_fast", "num_points")
    places = plan.num_channels * (2 * plan.num_branches + 2)
    out.arrays(plan, np.int32, slow=plan.num_slow, fast=plan.num_fast, first=places + 1)
    out.arrays(plan, np.int32, descriptor=num_features, column=num_features)
    out.arrays(plan, np.uint32, need=places)
    for level in range(num_levels):
        _write_matrix(out, plan.low, level)
        _write_matrix(out, plan.high, level)
        for branch in (2 * level, 2 * level + 1):
            _write_matrix(out, plan.out, branch)
            _write_matrix(out, plan.lines, branch)
    num_lines = plan.num_lines
    num_points = plan.num_points
    out.arrays(plan, cosines=num_points // 4 * 5, line_gains=num_points and num_lines)
    out.arrays(plan, ones=2 * num_lines, frequency_hz=num_lines)
    out.arrays(plan, gain_time=plan.num_samples, gain_lines=num_lines)


def _write_matrix(out: _Writer, address: int, place: int) -> None:
    """The matrix of a place; none where nobody reads it."""
    matrix = (native._Matrix * (place + 1)).from_address(address)[place]
    num_blocks = matrix.num_blocks if matrix.values else 0
    shape = (num_blocks, matrix.num_columns, matrix.width) if num_blocks else (0, 0, 0)
    out.numbers(*shape)
    out.arrays(matrix, np.int32, first=num_blocks)
    out.arrays(matrix, values=num_blocks * shape[2] * native._ROWS)


def _write_machine(out: _Writer, machine: ctypes.Structure) -> None:
    out.fields(machine, "num_columns", "num_scaled", "num_singles", "num_pools")
    num = machine.num_singles
    out.arrays(machine, np.int32, single_inputs=num, single_columns=num)
    pools = (native._Pool * machine.num_pools).from_address(machine.pools)
    for pool in pools:
        out.fields(pool, "num_channels", "num_families", "num_statistics")
        num, num_families = pool.num_statistics, _filled(pool.num_families)
        num_inputs = pool.num_channels * num_families
        out.arrays(pool, np.int32, channels=pool.num_channels, inputs=num_inputs)
        out.arrays(pool, np.int32, statistics=num, columns=num * num_families)
        out.arrays(pool, fractions=num, scales=num_families)
    if pools:
        out.arrays(machine, fill=machine.num_columns)
    num, num_scaled = _filled(machine.num_scaled), machine.num_scaled
    out.arrays(machine, np.int32, sources=num)
    out.arrays(machine, minimum=num, width=num)
    for name in ("compression", "centre"):
        out.numbers(bool(getattr(machine, name)))
        if getattr(machine, name):
            out.arrays(machine, **{name: num})
    out.arrays(machine, imputation=num_scaled)
    out.arrays(machine, np.int32, channels=num_scaled)
    out.arrays(machine, linear=num)
    out.real(machine.constant)
    num_factors = machine.num_factors if machine.signs else 0
    out.numbers(num_factors, machine.num_quadratic)
    if num_factors:
        out.arrays(machine, signs=_filled(num_factors))
    rows = num_factors or machine.num_quadratic
    if machine.num_quadratic:
        out.arrays(machine, quadratic=_filled(rows) * machine.num_quadratic)


def _filled(num: int) -> int:
    return -(-num // native._WHOLE) * native._WHOLE


def _write_onset(out: _Writer, classifier: OnsetClassifier, most_lost: int) -> None:
    engine = engine_of(classifier, most_lost)  # has a name, or its tables are gone
    of = engine.of
    out.fields(
        of, *("num_fast", "num_slow", "num_filters", "num_windows", "num_pairs", "num_steps"),
        *("num_lags", "num_columns", "num_layers", "hop", "context", "delay", "step_length"),
        *("blind", "min_alive", "most_lost"),
    )  # fmt: skip
    num_widths = of.num_layers and of.num_layers + 1
    out.arrays(of, np.int32, fast=of.num_fast, slow=of.num_slow, windows=of.num_windows)
    out.arrays(of, np.int32, first=of.num_pairs, second=of.num_pairs, lags=of.num_lags)
    out.arrays(of, np.int32, widths=num_widths)
    num, num_logs = of.num_columns, of.num_filters * of.num_fast
    out.arrays(of, filters=(of.context + of.hop) * of.num_filters * of.hop)
    out.arrays(of, steps=of.step_length * of.num_steps, rounding=num_logs, silence=num_logs)
    out.arrays(of, least_step=of.num_slow, rates=len(FLOORS_S), slope=num, offset=num)
    if of.num_layers:
        widths = _pointed(of.widths, num_widths, np.int32).tolist()
        out.arrays(of, weights=sum(a * b for a, b in pairwise(widths)), biases=sum(widths[1:]))
    else:
        out.numbers(bool(of.quadratic))
        if of.quadratic:
            out.arrays(of, quadratic=num * num)
        out.arrays(of, linear=num)
        out.real(of.constant)
    out.arrays(of, np.uint8, is_still=of.num_fast)


# The library, by ctypes -------------------------------------------------------------------------


class _Info(ctypes.Structure):
    _fields_ = (
        ("state_bytes", ctypes.c_size_t),
        *((n, ctypes.c_uint32) for n in (
            "num_channels", "hop_samples", "first_samples", "bin_samples")),
        ("sample_rate_hz", ctypes.c_double),
        *((n, ctypes.c_int) for n in ("is_double", "has_onset")),
        ("unit", ctypes.c_char_p),
    )  # fmt: skip


class _Decision(ctypes.Structure):
    _fields_ = (
        ("number", ctypes.c_uint64),
        *((n, ctypes.c_double) for n in (
            "time_s", "onset_s", "score", "probability", "statistic", "onset_score")),
        *((n, ctypes.c_uint8) for n in (
            "valid", "in_range", "alarm", "on", "by_onset", "hint")),
        ("channels_lost", ctypes.c_void_p),
    )  # fmt: skip


class _NativeStream:
    """``tactslip.h`` by ctypes.

    Attributes:
        channels: names, in the order of samples.
    """

    def __init__(self, content: bytes) -> None:
        self._library, self._info = native._library(), _Info()
        self._content = np.frombuffer(content + bytes(-len(content) % 8), np.uint64).copy()
        file = ctypes.c_void_p(self._content.ctypes.data), ctypes.c_size_t(len(content))
        self._check(self._library.tactslip_open(*file, ctypes.byref(self._info)))
        self._state = np.empty(-(-self._info.state_bytes // 8), np.uint64)
        state = ctypes.c_void_p(self._state.ctypes.data), ctypes.c_size_t(self._state.nbytes)
        self._handle = ctypes.c_void_p()
        self._check(self._library.tactslip_init(*file, *state, ctypes.byref(self._handle)))
        self._library.tactslip_channel.restype = ctypes.c_char_p
        self.channels = tuple(
            self._library.tactslip_channel(self._handle, place).decode()
            for place in range(self._info.num_channels)
        )

    @property
    def has_onset(self) -> bool:
        """Whether alarms come from an onset classifier."""
        return bool(self._info.has_onset)

    def _check(self, code: int) -> None:
        self._library.tactslip_error.restype = ctypes.c_char_p
        if code:
            raise ValueError(self._library.tactslip_error(code).decode())

    def push(self, samples: Array) -> dict[str, Array]:
        """The decisions that samples make possible, in columns (``HOST_COLUMNS``).

        Shape:
            - samples: ``[n, C]``, float32, float64, or int16 or int32 for counts of a converter
        """
        kinds = {"float32": "", "float64": "_double", "int16": "_int16", "int32": "_int32"}
        push = getattr(self._library, f"tactslip_push{kinds[samples.dtype.name]}")
        push.restype, samples, at = ctypes.c_size_t, np.ascontiguousarray(samples), 0
        rows, lost = list[list[float]](), list[Array]()
        made, names = _Decision(), [name for name, *_ in _Decision._fields_[:-1]]
        while at < len(samples) or not at:
            address, num = samples[at:].ctypes.data, len(samples) - at
            at += push(self._handle, ctypes.c_void_p(address), ctypes.c_size_t(num)) if num else 1
            while self._library.tactslip_next(self._handle, ctypes.byref(made)):
                rows.append([getattr(made, name) for name in names])
                flags = ctypes.string_at(made.channels_lost, self._info.num_channels)
                lost.append(np.frombuffer(flags, np.bool_))
        table = dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T, strict=True))
        is_flag = ("valid", "in_range", "alarm", "on", "by_onset", "hint")
        table |= {name: table[name].astype(bool) for name in is_flag}
        table["channels_lost"] = np.array(lost, bool).reshape(-1, self._info.num_channels)
        return table

    def set_threshold(self, value: float) -> None:
        """Another threshold of the alarm."""
        self._library.tactslip_set_threshold(self._handle, ctypes.c_double(value))

    def reset(self) -> None:
        """Forget the stream."""
        self._library.tactslip_reset(self._handle)


def _runner(made: NativeFile) -> Run:
    """The file as ``compare`` runs a graph: a stream begins where no state is given."""
    streams: list[_NativeStream] = []

    def run(inputs: Mapping[str, Array]) -> dict[str, Array]:
        if not len(inputs["state"]):
            streams[:] = [made.stream()]
            if len(inputs["threshold"]):
                streams[0].set_threshold(float(inputs["threshold"][0]))
        found = streams[0].push(inputs["samples"])
        if not streams[0].has_onset:
            found = {name: found[name] for name in HOST_COLUMNS}
        else:
            found["onset_score"] = np.nan_to_num(found["onset_score"], nan=NOTHING_YET)
            found.pop("number")
        return {**found, "next_tail": inputs["samples"][:0], "next_state": np.ones(1)}

    return run
