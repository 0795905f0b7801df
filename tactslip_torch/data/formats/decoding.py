"""What messages hold: payloads in, samples and time stamps out, many at a time.

Two encodings: CDR (ROS 2) and JSON. All messages of a topic must hold the same channels.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.cdr import MOST_CHANNELS, Form, Group, form_of

_MOST_FORMS = 256  # of one size
_MOST_DEPTH = 16
_SECONDS, _NANOSECONDS = ("sec", "secs"), ("nanosec", "nsec", "nsecs")


class Decoded(NamedTuple):
    """Messages as numbers.

    Args:
        values: samples one below the other, ``[n, C]``.
        num_rows: samples of each message.
        stamps: nanoseconds, one a message, if it is stamped.
        column: one number of each message as it stands there, if one was asked for.
    """

    values: NDArray[Any]
    num_rows: NDArray[np.int64]
    stamps: NDArray[np.int64] | None
    column: NDArray[Any] | None


class Decoder(Protocol):
    """What the messages of one topic hold, learned from the first of them."""

    @property
    def num_channels(self) -> int:
        """Numbers of a sample."""

    @property
    def names(self) -> tuple[str, ...] | None:
        """Of the channels, if they have any."""

    @property
    def is_small(self) -> bool:
        """Whether float32 holds every one of the numbers exactly."""

    @property
    def is_stamped(self) -> bool:
        """Whether messages have a time stamp of their own."""

    def decode(self, messages: Sequence[bytes], column: int | None = None) -> Decoded:
        """Messages as numbers.

        Raises:
            ValueError: if one is damaged or holds other channels than the first.
        """


class CdrDecoder:
    """Messages in CDR."""

    def __init__(self, definition: Group, first: bytes) -> None:
        self._definition = definition
        self._first = form_of(definition, first)
        self._forms: dict[int, list[Form]] = {len(first): [self._first]}
        self.num_channels = self._first.num_channels
        self.names = self._first.names
        self.is_small = self._first.is_small
        self.is_stamped = self._first.stamp is not None

    def decode(self, messages: Sequence[bytes], column: int | None = None) -> Decoded:
        """Messages as numbers; those of one form in one step."""
        if not messages:
            return _nothing(self, column)
        sizes = np.fromiter(map(len, messages), np.int64, len(messages))
        parts: list[tuple[NDArray[np.intp], Form, NDArray[np.uint8]]] = []
        for size in np.unique(sizes):
            which = np.flatnonzero(sizes == size)
            joined = b"".join([messages[place] for place in which])
            table = np.frombuffer(joined, np.uint8).reshape(len(which), int(size))
            parts += [(which[at], form, table[at]) for at, form in self._split(table)]
        order = np.argsort(np.concatenate([which for which, _, _ in parts]))
        num_rows = np.concatenate([np.full(len(w), form.num_rows) for w, form, _ in parts])[order]
        starts = np.cumsum(num_rows) - num_rows
        dtype = np.float32 if self.is_small else np.float64
        values = np.empty((num_rows.sum(), self.num_channels), dtype)
        for which, form, table in parts:
            rows = starts[which][:, None] + np.arange(form.num_rows)
            values[rows] = form.samples(table)
        stamps = [form.stamps(table) for _, form, table in parts if form.stamp is not None]
        columns = [form.column(table, column) for _, form, table in parts if column is not None]
        return Decoded(
            values,
            num_rows,
            np.concatenate(stamps)[order] if stamps else None,
            np.concatenate(columns)[order] if columns else None,
        )

    def _split(self, table: NDArray[np.uint8]) -> Iterator[tuple[NDArray[np.intp], Form]]:
        """Which messages of one size are of which form."""
        forms = iter(tuple(self._forms.setdefault(table.shape[1], [])))
        left = np.arange(len(table))
        while len(left):
            form = next(forms, None) or self._new_form(table[left[0]].tobytes())
            is_fit = form.fits(table)[left]
            if is_fit.any():
                yield left[is_fit], form
                left = left[~is_fit]

    def _new_form(self, message: bytes) -> Form:
        form = form_of(self._definition, message)
        same = (form.num_channels, form.names, form.stamp is None, form.is_small)
        if same != (self.num_channels, self.names, not self.is_stamped, self.is_small):
            raise ValueError(
                f"a message with {form.num_channels} channels after one with {self.num_channels}, "
                "or with others"
            )
        forms = self._forms[len(message)]
        forms.append(form)
        if len(forms) > _MOST_FORMS:
            raise ValueError(f"messages of {len(message)} bytes in more than {_MOST_FORMS} forms")
        return form


class JsonDecoder:
    """Messages in JSON: all numbers in them, however nested; ``null`` is NaN."""

    def __init__(self, first: bytes) -> None:
        _, numbers = _flat(first)
        if not 0 < len(numbers) <= MOST_CHANNELS:
            raise ValueError(f"{len(numbers)} numbers an instant, 1 to {MOST_CHANNELS} are read")
        self.names: tuple[str, ...] = tuple(numbers)
        self.num_channels = len(numbers)
        self.is_small = False
        self.is_stamped = _flat(first)[0] is not None

    def decode(self, messages: Sequence[bytes], column: int | None = None) -> Decoded:
        """Messages as numbers, one sample a message."""
        if not messages:
            return _nothing(self, column)
        values = np.empty((len(messages), self.num_channels))
        stamps, columns = [], []
        for row, message in enumerate(messages):
            stamp, numbers = _flat(message)
            if len(numbers) != self.num_channels or (stamp is not None) != self.is_stamped:
                raise ValueError(
                    f"a message with {len(numbers)} channels after one with {self.num_channels}"
                )
            try:
                values[row] = [numbers[name] for name in self.names]
            except KeyError as error:
                raise ValueError(f"a message without {error}, which the first has") from None
            stamps.append(stamp)
            columns.append(numbers[self.names[column]] if column is not None else 0)
        return Decoded(
            values,
            np.ones(len(messages), np.int64),
            np.array(stamps, np.int64) if self.is_stamped else None,
            np.array(columns) if column is not None else None,
        )


def _nothing(decoder: Decoder, column: int | None) -> Decoded:
    """No messages as numbers."""
    dtype = np.float32 if decoder.is_small else np.float64
    none = np.empty(0, np.int64)
    return Decoded(
        np.empty((0, decoder.num_channels), dtype),
        none,
        none if decoder.is_stamped else None,
        none if column is not None else None,
    )


def _flat(message: bytes) -> tuple[int | None, dict[str, float]]:
    """The time stamp of a message in nanoseconds, if it has one, and its numbers by their path."""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise ValueError("a message that is no JSON") from None
    stamp = _stamp(content)
    numbers: dict[str, float] = {}
    _collect(content, "", numbers, _MOST_DEPTH)
    return stamp, numbers


def _collect(part: Any, name: str, numbers: dict[str, float], depth: int) -> None:
    if depth < 0:
        raise ValueError(f"JSON nested deeper than {_MOST_DEPTH}")
    if isinstance(part, dict):
        if _clock(part) is None:
            for inner, value in part.items():
                _collect(value, f"{name}.{inner}" if name else inner, numbers, depth - 1)
    elif isinstance(part, list):
        for place, value in enumerate(part):
            _collect(value, f"{name}[{place}]", numbers, depth - 1)
    elif part is None or isinstance(part, (int, float)):
        if name in numbers:
            raise ValueError(f"JSON with two numbers called {name}")
        numbers[name] = float("nan") if part is None else part


def _stamp(content: Any) -> int | None:
    """That of the header, or the first time that is a field of its own."""
    if not isinstance(content, dict):
        return None
    header = content.get("header")
    own = [header.get("stamp")] if isinstance(header, dict) else []
    found = (_clock(part) for part in [*own, *content.values()])
    return next((stamp for stamp in found if stamp is not None), None)


def _clock(part: Any) -> int | None:
    """Nanoseconds of what is only whole seconds and nanoseconds."""
    if not isinstance(part, dict) or len(part) != 2:
        return None
    seconds = next((part[name] for name in _SECONDS if name in part), None)
    nanoseconds = next((part[name] for name in _NANOSECONDS if name in part), None)
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        return None
    return seconds * 10**9 + nanoseconds
