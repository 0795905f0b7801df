"""Numbers in CDR messages, the binary form of ROS 2: found once, read of many at a time.

Where a field lies depends on the lengths of all texts and sequences before it. ``form_of`` walks
one message and notes where its numbers are and every length it met; messages of the same size with
the same lengths have their numbers at the same bytes, so NumPy takes them all at once. A message's
definition is data that is walked; nothing is generated from it and nothing executed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

MOST_CHANNELS = 4096
"""Numbers of one instant; a picture is no set of channels."""
_MOST_STEPS = 50_000  # fields of one message that are looked at
_HEAD = 4  # bytes before the first field: the order of bytes, and options
_ORDERS = {b"\0\0": ">", b"\0\1": "<"}
_TIME, _DURATION = "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"
_STAMP = "header.stamp"
_TIME_LABELS = (b"sample", b"time")  # a dimension so called has an entry for each instant


@dataclass(frozen=True)
class Number:
    """A number; ``dtype`` is NumPy's without the order of bytes, such as ``"f8"``."""

    dtype: str


@dataclass(frozen=True)
class Text:
    """A text, its length before it."""


@dataclass(frozen=True)
class Group:
    """Fields one after the other, under the name of a type such as ``std_msgs/msg/Header``."""

    name: str
    fields: tuple[tuple[str, Field], ...]


@dataclass(frozen=True)
class Many:
    """So many of one kind; as many as a length before them says if ``count`` is ``None``."""

    element: Field
    count: int | None


Field: TypeAlias = Number | Text | Group | Many


class Run(NamedTuple):
    """Numbers side by side in a message.

    Args:
        start: the first byte.
        dtype: of each, with the order of bytes.
        size: how many.
        name: of the field.
        is_single: whether the field is one number and no array.
    """

    start: int
    dtype: np.dtype[Any]
    size: int
    name: str
    is_single: bool

    def taken(self, messages: NDArray[np.uint8]) -> NDArray[Any]:
        """These numbers of all messages ``[n, bytes]``, ``[n, size]``."""
        stop = self.start + self.size * self.dtype.itemsize
        return np.ascontiguousarray(messages[:, self.start : stop]).view(self.dtype)


class Form(NamedTuple):
    """Where the numbers of all messages of one form lie.

    Args:
        runs: the numbers, in order.
        fixed_at: bytes that decide the form.
        fixed: what stands there.
        stamp: whole seconds and nanoseconds of the message's time stamp, if it has one.
        num_rows: samples in a message.
        is_time_first: whether the numbers of a sample stand together, or those of a channel.
        is_array: of numbers that have no names.
    """

    runs: tuple[Run, ...]
    fixed_at: NDArray[np.intp]
    fixed: NDArray[np.uint8]
    stamp: Run | None = None
    num_rows: int = 1
    is_time_first: bool = True
    is_array: bool = False

    @property
    def num_channels(self) -> int:
        """Numbers of a sample."""
        return sum(run.size for run in self.runs) // max(self.num_rows, 1)

    @property
    def names(self) -> tuple[str, ...] | None:
        """Of the channels, such as ``"wrench.force.x"`` or ``"position[2]"``, if they have any."""
        if self.is_array:
            return None
        return tuple(
            run.name if run.is_single else f"{run.name}[{place}]"
            for run in self.runs
            for place in range(run.size)
        )

    @property
    def is_small(self) -> bool:
        """Whether float32 holds every one of the numbers exactly."""
        return all(run.dtype.itemsize <= (4 if run.dtype.kind == "f" else 2) for run in self.runs)

    def fits(self, messages: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which of the messages ``[n, size]`` are of this form, ``[n]``."""
        is_fit: NDArray[np.bool_] = (messages[:, self.fixed_at] == self.fixed).all(1)
        return is_fit

    def samples(self, messages: NDArray[np.uint8]) -> NDArray[Any]:
        """Messages of this form ``[n, size]`` as samples ``[n, rows, C]``, the first dtype's."""
        parts = [run.taken(messages) for run in self.runs]
        flat = parts[0] if len(parts) == 1 else np.concatenate(parts, 1)
        if self.is_time_first:
            return flat.reshape(len(messages), self.num_rows, self.num_channels)
        return flat.reshape(len(messages), self.num_channels, self.num_rows).swapaxes(1, 2)

    def column(self, messages: NDArray[np.uint8], column: int) -> NDArray[Any]:
        """One number of each message, as it stands there, ``[n]``."""
        for run in self.runs:
            if column < run.size:
                return run.taken(messages)[:, column]
            column -= run.size
        raise ValueError("a message without that number")

    def stamps(self, messages: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Time stamps in nanoseconds, ``[n]``.

        Raises:
            ValueError: if messages of this form have none.
        """
        if self.stamp is None:
            raise ValueError("messages without a time stamp")
        parts = self.stamp.taken(messages).astype(np.int64)
        return parts[:, 0] * 10**9 + parts[:, 1]


def form_of(definition: Group, message: bytes) -> Form:
    """Where the numbers of a message lie.

    Its stamp is that of its header, or a time that is a field of its own. Texts, durations and
    other times are no numbers. An array of ``std_msgs`` holds several samples if a dimension of its
    layout is called ``samples`` or ``time``, as many as that says; else it is one sample.

    Raises:
        ValueError: if the message does not match the definition, or has no or too many numbers.
    """
    walk = _Walk(message)
    if definition.name.startswith("std_msgs/msg/") and definition.name.endswith("MultiArray"):
        form = walk.array(definition)
    else:
        walk.field(definition, "")
        form = walk.form()
    if len(message) - walk.place > 3:  # some pad a message to whole words
        raise ValueError(f"{len(message)} bytes, where {definition.name} has {walk.place}")
    if form.num_channels > MOST_CHANNELS:
        raise ValueError(f"{form.num_channels} numbers an instant, at most {MOST_CHANNELS}")
    return form


class _Walk:
    """A place in a message that moves on field by field, and what it passed."""

    def __init__(self, message: bytes) -> None:
        if message[:2] not in _ORDERS:
            raise ValueError("not the plain CDR of ROS 2")
        self.message = message
        self.order = _ORDERS[message[:2]]
        self.place = _HEAD
        self.steps = 0
        self.runs: list[Run] = []
        self.fixed = [(0, 2)]
        self.stamp: Run | None = None

    def field(self, kind: Field, name: str) -> None:
        self.steps += 1
        if self.steps > _MOST_STEPS:
            raise ValueError(f"more than {_MOST_STEPS} fields")
        if isinstance(kind, Number):
            self.numbers(kind, 1, name, is_single=True)
        elif isinstance(kind, Text):
            self.text()
        elif isinstance(kind, Many):
            self.many(kind, name)
        elif kind.name in (_TIME, _DURATION):
            self.clock(kind, name)
        else:
            for inner, field in kind.fields:
                self.field(field, f"{name}.{inner}" if name else inner)
            if not kind.fields:
                self.skip(1, 1)  # C has no empty structure, so there is one byte

    def many(self, kind: Many, name: str) -> None:
        count = self.length() if kind.count is None else kind.count
        if isinstance(kind.element, Number):
            self.numbers(kind.element, count, name)
            return
        for place in range(count):  # each takes a byte at least, or is a step
            self.field(kind.element, f"{name}[{place}]")

    def numbers(self, kind: Number, count: int, name: str, *, is_single: bool = False) -> None:
        dtype = np.dtype(self.order + kind.dtype)
        if count:  # none need no alignment either
            start = self.skip(dtype.itemsize, count * dtype.itemsize)
            self.runs.append(Run(start, dtype, count, name, is_single))

    def clock(self, kind: Group, name: str) -> None:
        start = self.skip(4, 8)
        if kind.name == _TIME and self.stamp is None and ("." not in name or name == _STAMP):
            self.stamp = Run(start, np.dtype(f"{self.order}i4"), 2, name, False)

    def skip(self, alignment: int, size: int) -> int:
        """The first byte of the next field, past which the place is then."""
        start = self.place + -(self.place - _HEAD) % alignment
        self.place = start + size
        if self.place > len(self.message):
            raise ValueError(f"{len(self.message)} bytes, too few for what it should hold")
        return start

    def length(self) -> int:
        """A length or size; messages of the same form have the same."""
        start = self.skip(4, 4)
        self.fixed.append((start, start + 4))
        return int.from_bytes(
            self.message[start : start + 4], "little" if self.order == "<" else "big"
        )

    def text(self) -> tuple[int, int]:
        """First byte of a text and the byte behind it."""
        size = self.length()
        start = self.skip(1, size)
        return start, start + size

    def array(self, definition: Group) -> Form:
        """An array of ``std_msgs``: dimensions with labels, and what is skipped, then numbers."""
        data = dict(definition.fields).get("data")
        if not (isinstance(data, Many) and isinstance(data.element, Number)):
            raise ValueError(f"a {definition.name} without data")
        sizes: list[int] = []
        time: int | None = None
        for axis in range(self.length()):
            start, stop = self.text()
            self.fixed.append((start, stop))
            label = self.message[start:stop].lower()
            if time is None and label.startswith(_TIME_LABELS):
                time = axis
            sizes.append(self.length())
            self.length()  # strides follow from the sizes
        if skipped := self.length():
            raise ValueError(f"a data_offset of {skipped}, only 0 is read")
        count = self.length()
        self.numbers(data.element, count, "data")
        if time is None:
            return self.form(is_array=True)
        if math.prod(sizes) != count or time not in (0, len(sizes) - 1):
            raise ValueError(f"{count} numbers in a layout of {sizes}, time is axis {time}")
        return self.form(num_rows=sizes[time], is_time_first=time == 0, is_array=True)

    def form(
        self, *, num_rows: int = 1, is_time_first: bool = True, is_array: bool = False
    ) -> Form:
        if not self.runs:
            raise ValueError("no numbers")
        at = np.concatenate([np.arange(start, stop) for start, stop in self.fixed])
        fixed = np.frombuffer(self.message, np.uint8)[at]
        return Form(tuple(self.runs), at, fixed, self.stamp, num_rows, is_time_first, is_array)
