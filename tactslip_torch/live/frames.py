"""Samples in bytes: lines of text, or binary frames, as a device sends them.

``Frames`` describes them; a ``FrameReader`` takes bytes as they come, in any pieces, finds the
frames again behind what is none, and reports what it passed over.
"""

from __future__ import annotations

import binascii
import re
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

import numpy as np

from tactslip_torch.data.file_recordings import place_of
from tactslip_torch.data.formats._inference import NUMBER, number_in
from tactslip_torch.live.sinks import Array, Block, Event, Notices, counted
from tactslip_torch.runtime import check_choice, check_number

COUNTER = "counter"
"""The column of a line of text that counts lines."""
Counter = Literal["uint8", "uint16", "uint32"]
Dtype = Literal[
    "int8", "uint8", "int16", "uint16", "int24", "int32", "uint32", "float32", "float64"
]
_CHECKSUMS: Mapping[str, tuple[int, Callable[[bytes], int]]] = {
    "sum8": (1, lambda content: sum(content) & 0xFF),
    "xor8": (1, lambda content: int(np.bitwise_xor.reduce(np.frombuffer(content, np.uint8)))),
    "crc16": (2, lambda content: binascii.crc_hqx(content, 0xFFFF)),
    "crc32": (4, zlib.crc32),
}
_MOST_LINE = 1 << 16  # bytes of a line; what is longer is none
_MOST_OTHERS = 64  # columns of a header beside the channels
_MOST_MISSING_S = 10.0  # by a counter; what lacks more is another stream
_BETWEEN = re.compile(r"[ \t]{0,99}[,;][ \t]{0,99}| *\t *| +")
"""Between the values of a line; what is empty between two of them is missing."""
_NUMBERED = re.compile(r"(ch|C)\d+")  # names of channels of recordings that have none
_NAME = re.compile(r"[^\W\d][\w ./-]*([\[(][^])]*[\])])?")  # of a column, with its unit
_MARKS = re.compile(r"[,;\t]")
"""Between names, which may have blanks within where there are such marks."""


@dataclass(frozen=True)
class Frames:
    """How a device writes samples.

    A line of text is one instant: its values are the columns. A binary frame is ``header``,
    ``counter``, ``skip`` bytes, ``samples`` instants of all columns, bytes up to ``length`` that
    are passed over, ``checksum``.

    Args:
        format: ``"text"`` or ``"binary"``.
        columns: names of the values of an instant, in order; other names than the detector's
            channels are left out, ``"counter"`` counts lines of text. ``None``: the channels in the
            order of the detector, or as a line names them, whatever their case and the unit in
            brackets behind them. Such a line may come again, as when a device restarts; one of
            other names before the first sample is refused.
        scale: from a value to the detector's unit, one for all or one for each of its channels.
        offset: added to that.
        separator: between the values of a line; ``None``: blanks, tabs, commas and semicolons.
        header: bytes that begin a frame, in hexadecimal, such as ``"AA 55"``; ``None``: none, every
            byte counts from the first.
        counter: type of the number that each frame raises by 1, in bytes (also of text, where it
            says when the counter begins anew at 0; ``None`` is ``"uint32"`` there).
        skip: bytes between counter and values.
        dtype: of a value.
        byte_order: ``"little"`` or ``"big"``, of values, counter and checksum.
        samples: instants in a frame.
        checksum: ``"sum8"``, ``"xor8"``, ``"crc16"`` (CCITT, from 0xFFFF) or ``"crc32"`` of all
            bytes between header and checksum.
        length: bytes of a whole frame; ``None``: as many as its parts have.

    Raises:
        ValueError: for a value that cannot be.
    """

    format: Literal["text", "binary"] = "text"
    columns: Sequence[str] | None = None
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0
    separator: str | None = None
    header: str | None = None
    counter: Counter | None = None
    skip: int = 0
    dtype: Dtype = "int16"
    byte_order: Literal["little", "big"] = "little"
    samples: int = 1
    checksum: Literal["sum8", "xor8", "crc16", "crc32"] | None = None
    length: int | None = None

    def __post_init__(self) -> None:
        check_number("frame.samples", self.samples, whole=True)
        choices: dict[str, tuple[Any, ...]] = {
            "format": ("text", "binary"),
            "dtype": get_args(Dtype),
            "byte_order": ("little", "big"),
            "counter": (*get_args(Counter), None),
            "checksum": (*_CHECKSUMS, None),
        }
        for key, known in choices.items():
            check_choice(f"frame.{key}", getattr(self, key), known)
        check_number("frame.skip", self.skip, least=0, whole=True)
        if self.length is not None:
            check_number("frame.length", self.length, whole=True)
        if self.header is not None and not self.start:
            raise ValueError(
                f"frame.header must be bytes in hexadecimal and in quotes, such as 'AA 55', "
                f"got {self.header!r}"
            )
        names = self.columns
        if names is not None and (isinstance(names, str) or len(set(names)) < len(names)):
            raise ValueError(f"frame.columns must be a list of different names, got {names!r}")

    @classmethod
    def of(cls, given: Mapping[str, Any] | None) -> Frames:
        """From a section of a configuration.

        Raises:
            ValueError: for a key or value that is none.
        """
        known = [each.name for each in fields(cls)]
        if given is not None and not set(given) <= set(known):
            raise ValueError(f"frame must be of {', '.join(known)}, got {given!r}")
        return cls(**dict(given or {}))

    @property
    def start(self) -> bytes:
        """The bytes that begin a frame."""
        try:
            return bytes.fromhex(self.header or "")
        except (TypeError, ValueError):
            return b""

    def reader(
        self,
        channels: Sequence[str],
        sample_rate_hz: float,
        *,
        begins_inside: bool = False,
        now: Callable[[], float] = time.monotonic,
    ) -> FrameReader:
        """What finds the frames in bytes.

        Args:
            channels: of the detector, in its order.
            sample_rate_hz: of the detector.
            begins_inside: whether the first byte may be any of a frame, as of a serial port.
            now: seconds of a clock, for how often something is reported.

        Raises:
            ValueError: if the columns lack a channel, a frame has no place in its length, or one
                that begins inside could not be found.
        """
        kind = _LineReader if self.format == "text" else _BinaryReader
        return kind(self, channels, sample_rate_hz, begins_inside, now)


class FrameReader:
    """Bytes in, samples and events out. Made by ``Frames.reader``."""

    def __init__(
        self,
        frames: Frames,
        channels: Sequence[str],
        sample_rate_hz: float,
        begins_inside: bool,
        now: Callable[[], float],
    ) -> None:
        self._frames, self._channels, self._begins_inside = frames, tuple(channels), begins_inside
        self._most_missing = round(_MOST_MISSING_S * sample_rate_hz)
        self._scale, self._offset = (
            _for_each(name, getattr(frames, name), channels) for name in ("scale", "offset")
        )
        self._modulus = 1 << (8 * np.dtype(frames.counter or "uint32").itemsize)
        self._set_columns(frames.columns)
        self._buffer = bytearray()
        self._count: int | None = None  # of the last frame
        self._rows: list[Array] = []
        self._items: list[Block | Event] = []
        self._garbage = Notices("garbage", "byte", now)
        self._is_good = True  # what came last

    def feed(self, data: bytes) -> list[Block | Event]:
        """The samples and events that these bytes complete."""
        self._buffer += data
        self._find()
        self._flush()
        items, self._items = self._items, []
        return [*items, *self._garbage.events(self._is_good)]

    def end(self) -> list[Event]:
        """The stream ended or broke off: what is still to be reported. Then as new."""
        self._buffer.clear()
        self.forget()
        return [*self._garbage.events(True, at_once=True)]

    def forget(self) -> None:
        """The counter may go on anywhere."""
        self._count = None

    def _find(self) -> None:
        """Take what is whole off the buffer."""
        raise NotImplementedError

    def _set_columns(self, columns: Sequence[str] | None) -> None:
        names = list(self._channels if columns is None else columns)
        if missing := [name for name in self._channels if name not in names]:
            raise ValueError(
                f"frame.columns has no {', '.join(missing[:5])}; the detector has channels "
                f"{self._channels[0]} to {self._channels[-1]}, got {', '.join(names[:8])}"
            )
        self._names = names
        self._places = [names.index(name) for name in self._channels]

    def _add(self, values: Array, count: int | None) -> None:
        """Take instants ``[n, columns]`` of a frame, behind those that its counter lacks."""
        if count is not None:
            before, self._count = self._count, count
            lacking = 0 if before is None else (count - before - 1) % self._modulus
            if lacking * len(values) > self._most_missing:
                self._flush()
                text = f"the counter of frames went from {before} to {count}: the sender began anew"
                self._items.append(Event("gap", text))
            elif lacking:
                self._missing(lacking * len(values))
        picked = values[:, self._places].astype(np.float64)
        self._rows.append(picked * self._scale + self._offset)
        self._is_good = True

    def _missing(self, num: int) -> None:
        self._rows.append(np.full((num, len(self._channels)), np.nan))

    def _flush(self) -> None:
        if self._rows:
            self._items.append(Block(np.concatenate(self._rows)))
            self._rows = []

    def _pass_over(self, num_bytes: int, why: str) -> None:
        """Bytes that are no frame."""
        self._garbage.add(num_bytes, f"passed over: {why}")
        self._is_good = False


class _LineReader(FrameReader):
    """Lines of text, which end in LF, CR or both."""

    _is_first = True  # of a connection
    _has_begun = False  # there was a line of numbers

    def end(self) -> list[Event]:
        """As of all; the next line is the first."""
        self._is_first, self._has_begun = True, False
        return super().end()

    def _find(self) -> None:
        *lines, rest = self._buffer.replace(b"\r", b"\n").split(b"\n")
        self._buffer = rest
        if len(rest) > _MOST_LINE:
            self._pass_over(len(rest), f"no end of line in {len(rest)} bytes")
            rest.clear()
        for line in lines:
            text = line.decode("utf-8", "replace").strip(" ")
            if text.startswith("#"):
                self._is_header(text.lstrip("# "))
            elif text.strip():
                self._take(text)

    def _take(self, line: str) -> None:
        is_first, self._is_first = self._is_first, False
        parts, wanted, names = self._parts(line, _BETWEEN), len(self._names), self._names
        wrong = [part for part in parts if part and not NUMBER.fullmatch(part)]
        if wrong and self._is_header(line):
            return
        if is_first and self._begins_inside:  # a part of a line may look like a whole one
            if wrong:
                self._lose(line, "the first line may be cut")
        elif len(parts) != wanted:
            what = f"a line has {counted(len(parts), 'value')}, expected {wanted}"
            self._lose(line, f"{what}, {names[0]} to {names[-1]}; frame.columns says which")
        elif len(wrong) == wanted:
            if not self._has_begun:
                self._refuse_others(line)
            self._lose(line, "a line holds no number")
        else:
            if wrong:
                lost = ", ".join(map(repr, wrong))[:80]
                self._pass_over(sum(map(len, wrong)), f"a line holds what is no number: {lost}")
            row = np.array([np.nan if part in wrong else number_in(part) for part in parts])
            count = row[names.index(COUNTER)] if COUNTER in names else 0.0
            if not np.isfinite(count):
                self._lose(line, "the counter of a line is no number")
                return
            self._has_begun = True
            self._add(row[None], int(count) % self._modulus if COUNTER in names else None)

    def _parts(self, line: str, between: re.Pattern[str]) -> list[str]:
        mark = self._frames.separator
        return [part.strip() for part in (line.split(mark) if mark else between.split(line))]

    def _is_header(self, line: str) -> bool:
        """Whether a line names the columns; then they are as it says, if nobody else did."""
        parts = self._parts(line, _MARKS if _MARKS.search(line) else _BETWEEN)
        if len(parts) > 4 * len(self._channels) + _MOST_OTHERS:  # which would take long
            return False
        cells = [part.strip("\"'") for part in parts]
        places = [place_of(name, cells) for name in self._frames.columns or self._channels]
        if None in places or len(set(cells)) < len(cells):
            return False
        if self._frames.columns is not None:
            return places == [*range(len(cells))]
        for name, place in zip(
            (*self._channels, COUNTER), (*places, place_of(COUNTER, cells)), strict=True
        ):
            if place is not None:
                cells[place] = name
        if cells != self._names:
            if self._has_begun:
                self._flush()
                text = f"the sender began anew, with the columns {', '.join(cells)}"
                self._items.append(Event("gap", text))
            self.forget()
            self._set_columns(cells)
        return True

    def _refuse_others(self, line: str) -> None:
        """Raise ValueError if a line names as many columns as there are, but not the channels.

        Not where somebody says what the columns are, and not of channels that only have numbers.
        """
        is_known = self._frames.columns is not None or all(map(_NUMBERED.fullmatch, self._channels))
        if is_known or not (self._frames.separator or _MARKS.search(line)):  # it may be a sentence
            return
        cells = [part.strip("\"'") for part in self._parts(line, _MARKS)]
        lacking = [name for name in self._channels if place_of(name, cells) is None]
        is_whole = 1 < len(self._names) == len(cells) == len(set(cells))
        if is_whole and lacking and all(map(_NAME.fullmatch, cells)):
            raise ValueError(
                f"the sender names its columns {', '.join(cells[:8])}, but has no "
                f"{', '.join(lacking[:5])} of the detector; name them so, or say by frame.columns "
                "which channel each column is"
            )

    def _lose(self, line: str, why: str) -> None:
        self._pass_over(len(line) + 1, f"{why}: {line[:40]!r}")
        if self._has_begun and COUNTER not in self._names:
            self._missing(1)  # a line is an instant


class _BinaryReader(FrameReader):
    """Frames of bytes.

    Where frames follow one another a header at its place is enough. To begin, and behind what is no
    frame, there must be a right checksum, or another header where the next frame begins.
    """

    def __init__(self, frames: Frames, *rest: Any) -> None:
        super().__init__(frames, *rest)
        self._start, self._order = frames.start, frames.byte_order
        self._counter_bytes = np.dtype(frames.counter).itemsize if frames.counter else 0
        self._sum_bytes, self._sum = _CHECKSUMS.get(frames.checksum or "", (0, zlib.crc32))
        size = int(frames.dtype.lstrip("uintfloa")) // 8
        self._values = len(self._start) + self._counter_bytes + frames.skip
        self._values_end = self._values + size * len(self._names) * frames.samples
        least = self._values_end + self._sum_bytes
        self._length = least if frames.length is None else frames.length
        if self._length < least:
            raise ValueError(
                f"frame.length is {self._length} bytes, its parts have {least}: header "
                f"{len(self._start)}, counter {self._counter_bytes}, skip {frames.skip}, "
                f"{frames.samples} times {len(self._names)} values of {size}, checksum "
                f"{self._sum_bytes}"
            )
        if self._begins_inside and not self._start:
            raise ValueError(
                "binary frames of a serial port need frame.header, since reading begins anywhere; "
                "let the device send one, such as 'AA 55'"
            )
        self._restart()

    def end(self) -> list[Event]:
        """As of all; frames are to be found anew."""
        self._restart()
        return super().end()

    def _restart(self) -> None:
        self._in_step, self._has_begun = not self._start, False
        self._lost = self._apart = 0  # bytes since the last frame, and from a header to the next

    def _find(self) -> None:
        buffer, length, start = self._buffer, self._length, self._start
        at = 0
        while len(buffer) - at >= length + (0 if self._in_step or self._sum_bytes else len(start)):
            following = buffer[at + length : at + length + len(start)]
            is_followed = start.startswith(following)  # as far as that is there already
            is_frame = self._has_right_sum(at) if self._sum_bytes else is_followed
            is_frame &= buffer.startswith(start, at)
            if is_frame:
                self._in_step = True
                self._take(bytes(buffer[at : at + length]))
                at += length
            elif self._in_step and is_followed and buffer.startswith(start, at):
                self._lose(length, "a frame has a wrong checksum")
                at += length
            else:
                self._in_step = False
                found = buffer.find(start, at + 1)
                if found < 0:
                    found = max(len(buffer) - len(start) + 1, at + 1)
                elif buffer.startswith(start, at):
                    self._apart = found - at
                self._lose(found - at, self._no_frame())
                at = found
        del buffer[:at]

    def _no_frame(self) -> str:
        message = f"no frame of {self._length} bytes that begins with {self._start.hex(' ')}"
        return f"{message} (two such headers are {self._apart} apart)" if self._apart else message

    def _has_right_sum(self, at: int) -> bool:
        end = at + self._length - self._sum_bytes
        sent = self._buffer[end : end + self._sum_bytes]
        content = bytes(self._buffer[at + len(self._start) : end])
        return self._sum(content) == int.from_bytes(sent, self._order)

    def _take(self, frame: bytes) -> None:
        if self._lost and self._has_begun and not self._counter_bytes:
            # without a counter what was passed over is as many frames as have place in it
            num = round(self._lost / self._length) * self._frames.samples
            if 0 < num <= self._most_missing:
                self._missing(num)
        self._lost, self._has_begun, self._apart = 0, True, 0
        count = None
        if self._counter_bytes:
            place = len(self._start)
            count = int.from_bytes(frame[place : place + self._counter_bytes], self._order)
        values = self._numbers(frame[self._values : self._values_end])
        self._add(values.reshape(-1, len(self._names)), count)

    def _lose(self, num_bytes: int, why: str) -> None:
        before, self._lost = self._lost, self._lost + num_bytes
        if self._has_begun:
            self._pass_over(num_bytes, why)
        elif self._lost > 2 * self._length:  # else the rest of a frame that began before
            self._pass_over(num_bytes + (before if before <= 2 * self._length else 0), why)

    def _numbers(self, content: bytes) -> Array:
        order: Literal["<", ">"] = "<" if self._order == "little" else ">"
        if self._frames.dtype != "int24":
            return np.frombuffer(content, np.dtype(self._frames.dtype).newbyteorder(order))
        three = np.frombuffer(content, np.uint8).reshape(-1, 3)
        four = np.zeros((len(three), 4), np.uint8)
        four[:, slice(1, 4) if order == "<" else slice(0, 3)] = three  # the sign is the highest bit
        whole: Array = four.view(f"{order}i4")[:, 0] >> 8
        return whole


def _for_each(name: str, value: float | Sequence[float], channels: Sequence[str]) -> Array:
    try:
        found = np.atleast_1d(np.asarray(value, np.float64))
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape not in ((1,), (len(channels),)) or not np.isfinite(found).all():
        raise ValueError(
            f"frame.{name} must be a finite number, or one for each of {len(channels)} channels, "
            f"got {value!r}"
        )
    return found
