"""What a file gives when it is open, what a person says that it does not, and what it may cost.

Of a package file all but the samples is its *header*: plain values that a file of any format can
hold as one line of JSON.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, fields
from types import MappingProxyType, ModuleType
from typing import IO, Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.clock import GapRule
from tactslip_torch.data.formats._inference import (
    SECONDS,
    Refused,
    TimeUnit,
    bare,
    epoch_unit,
    is_time,
    no_channels,
    seconds_and_nanoseconds,
    time_unit_in,
)
from tactslip_torch.data.labels import LabelColumn
from tactslip_torch.data.recording import MOMENTS, STRETCHES, Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import check_choice, check_number, setting

# Limits, and faults in one line -----------------------------------------------------------------

MOST_WHOLE = 4 * 2**30
"""Bytes of numbers in a file of a format that is read whole: MAT of version 5 and Parquet."""
MOST_CHANNELS = 2**16
MOST_MEMBERS = 10_000
"""Arrays, groups, columns or topics of one file that are looked at."""
MOST_RATIO, FREE_BYTES = 100, 64 * 2**20
"""A file may hold so many times its size, and so many bytes in any case."""
_MOST_SHOWN = 200
_BLOCK = 1 << 15  # rows of a table of which some columns are read at a time


@contextmanager
def guarded(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn whatever a library raises of a file into one line.

    Raises:
        FileNotFoundError: if there is no such file.
        Refused: of anything else that is raised inside; it begins with the path.
    """
    name = os.fspath(path)
    try:
        yield
    except Refused as error:
        text = str(error)
        raise (error if text.startswith(name) else Refused(f"{name} {text}")) from None
    except FileNotFoundError:
        raise FileNotFoundError(f"no file at {name}") from None
    except MemoryError as error:
        raise Refused(
            f"{name} needs more memory than there is; convert it to .h5, or cut it"
        ) from error
    except Exception as error:  # HDF5, Arrow, zlib, struct, SQLite and YAML raise many kinds
        text = " ".join(str(error).split())[:_MOST_SHOWN] or type(error).__name__
        raise Refused(f"{name} is damaged or no recording ({text})") from error


def check_plausible(what: str, claimed: int, stored: int, most: int | None = None) -> None:
    """Refuse claims that a file of its size can hardly mean, before anything is allocated.

    Args:
        what: claims it, for the message.
        claimed: bytes of numbers.
        stored: bytes in the file.
        most: bytes that are read at all; ``None`` where a file is read by stretches.

    Raises:
        Refused: in one line with both sizes.
    """
    if claimed > max(FREE_BYTES, MOST_RATIO * stored):
        raise Refused(
            f"{what} claims {claimed} bytes and stores {stored}; at most {MOST_RATIO} times as "
            "many are read; write it again without compression"
        )
    if most is not None and claimed > most:
        raise Refused(
            f"{what} has {claimed} bytes; at most {most} are read in its format; convert it to .h5"
        )


def needs(module: str, what: str) -> ModuleType:
    """A library that is there only if an extra was installed.

    Args:
        module: to import.
        what: it is for, such as ``"reading .h5"``.

    Raises:
        Refused: in one line, if it is absent.
    """
    name = module.partition(".")[0]
    if importlib.util.find_spec(name) is None:
        wanted = {"serial": "pyserial"}.get(name, name)
        raise Refused(f"{what} needs {wanted}, which is not installed; pip install {wanted}")
    return importlib.import_module(module)


# How files are read -----------------------------------------------------------------------------

_RowOrder = Literal["channel", "time"]


@dataclass(frozen=True)
class Reading:
    """How files are read; package files need none of it but what is done with their samples.

    Args:
        sample_rate_hz: of files without times: samples a second of each channel.
        time: the column, dataset, variable or field of times, by name or by number from 0.
            ``"auto"``: what is called ``time``, ``t``, ``timestamp`` or the like; of a table
            without names the first column, unless the rate is given. ``None``: there is none.
        time_unit: of those times; ``None``: as their name or a line of units says, else by the
            size of stamps that count from 1970, else seconds.
        channels: columns by name or number, in the order of the hand; ``None``: all but those that
            are called as times, labels or book-keeping are (``no_channels``).
        samples: the dataset, variable, topic or feature (of LeRobot) that holds samples; ``None``:
            the only one that can.
        time_first: whether arrays are ``[T, C]``; ``None``: the longer axis is time.
        delimiter: between columns of text; ``None``: found from the first lines.
        samples_per_row: how many samples of each channel, one behind the other in time, a row of
            the table or array holds. Its time is that of the first.
        row_order: of the columns of such a row. ``"channel"``: all samples of the first channel,
            then those of the second; ``"time"``: the first sample of all channels, then the second.
            ``None``: as names such as ``a_0, a_1, b_0, b_1`` tell.
        gaps: ``"refuse"`` files in which samples are missing (rows, or cells that are empty or not
            finite), let them be ``"missing"`` (bins that need them are left out), or ``"bridge"``
            short gaps by a straight line.
        bridge_ms: the longest gap that is bridged; longer ones are missing.
        resample_hz: the rate that all files of a set are brought to; ``None`` for their own.
        tare_s: start and end of the stretch whose mean is taken off each channel.
        hand: names of channels that are wanted: a column of such a name is a channel, whatever it
            is called, and if all are there, no other is. Set by who knows the hand.
        label: the column of labels, which is no channel. Set by who knows the labels.

    Raises:
        ValueError: for a value that cannot be.
    """

    sample_rate_hz: float | None = None
    time: str | int | None = "auto"
    time_unit: TimeUnit | None = None
    channels: Sequence[str | int] | None = None
    samples: str | None = None
    time_first: bool | None = None
    delimiter: str | None = None
    samples_per_row: int = 1
    row_order: _RowOrder | None = None
    gaps: GapRule = "refuse"
    bridge_ms: float = 10.0
    resample_hz: float | None = None
    tare_s: tuple[float, float] | None = None
    hand: Sequence[str] = ()
    label: LabelColumn | None = None

    def __post_init__(self) -> None:
        for name in ("sample_rate_hz", "bridge_ms", "resample_hz"):
            if (value := getattr(self, name)) is not None:
                check_number(setting(f"reading.{name}"), value)
        check_number(setting("reading.samples_per_row"), self.samples_per_row, whole=True)
        for name, known in (
            ("time_unit", (*SECONDS, None)),
            ("row_order", (*get_args(_RowOrder), None)),
            ("gaps", get_args(GapRule)),
        ):
            check_choice(setting(f"reading.{name}"), getattr(self, name), known)
        columns, mark, tare = (
            _listed(getattr(self, n)) for n in ("channels", "delimiter", "tare_s")
        )
        is_tare = (
            isinstance(tare, tuple) and len(tare) == 2 and set(map(type, tare)) <= {int, float}
        )
        for name, is_right, wanted in (
            ("samples", isinstance(self.samples, str | None), "the name of an array or topic"),
            ("time_first", self.time_first in (True, False, None), "true, false or null"),
            ("time", self.time is None or _is_column(self.time), "a name, a number or null"),
            (
                "delimiter",
                mark is None or (isinstance(mark, str) and len(mark) == 1),
                "a character",
            ),
            (
                "channels",
                columns is None or (isinstance(columns, tuple) and all(map(_is_column, columns))),
                "a list of columns, by name or number",
            ),
            (
                "tare_s",
                tare is None or (is_tare and 0 <= tare[0] < tare[1] < math.inf),
                "[start, end] in seconds",
            ),
        ):
            if not is_right:
                key = setting(f"reading.{name}")
                raise ValueError(f"{key} must be {wanted}, got {getattr(self, name)!r}")
        if columns and len(set(columns)) < len(columns):
            key = setting("reading.channels")
            raise ValueError(f"{key} names a column twice: {list(columns)}")
        object.__setattr__(self, "channels", columns)
        object.__setattr__(self, "tare_s", tare and (float(tare[0]), float(tare[1])))

    @classmethod
    def of(cls, given: object) -> Reading:
        """From what a configuration says; nothing if it is ``None``.

        Raises:
            ValueError: for a key or value that is none.
        """
        known = [one.name for one in fields(cls) if one.name not in _SET_BY_OTHERS]
        if given is not None and not (isinstance(given, Mapping) and set(given) <= set(known)):
            raise ValueError(f"{setting('reading')} must be of {', '.join(known)}, got {given!r}")
        return cls(**dict(given or {}))

    def key(self) -> dict[str, Any]:
        """What decides the samples that are read, as plain values."""
        return {name: value for name, value in asdict(self).items() if name not in _SET_BY_OTHERS}


_SET_BY_OTHERS = "hand", "label"  # beside the section of a configuration


def _listed(value: Any) -> Any:
    """A list as a tuple, an empty one as it is; all else as it is."""
    is_list = isinstance(value, Sequence) and not isinstance(value, str) and bool(value)
    return tuple(value) if is_list else value


def _is_column(value: object) -> bool:
    """Whether a setting says a column, by name or number."""
    return isinstance(value, (str, int)) and not isinstance(value, bool)


# What a file gives ------------------------------------------------------------------------------


class Samples:
    """Samples ``[C, T]`` that stay in their file until they are asked for.

    Args:
        path: of the file, for messages.
        source: an array of two axes, sliced as NumPy's are, or for each channel one whose other
            axes, if any, have length 1.
        time_axis: of the array.
        rows: of the array, along its other axis, that are channels; ``None`` for all.

    Attributes:
        dtype: in which they are read: the smaller of ``float32`` and ``float64`` that holds all
            numbers exactly (whole numbers beyond 2**53 are rounded), unless it is set.
        may_lack: whether any may be not finite; whole numbers never are.
    """

    path: str | os.PathLike[str]
    num_channels: int
    num_samples: int
    dtype: torch.dtype
    may_lack: bool

    def __init__(
        self,
        path: str | os.PathLike[str],
        source: Any,
        time_axis: int = 0,
        rows: Sequence[int] | None = None,
    ) -> None:
        self.path, self._source, self._axis = path, source, time_axis
        self._rows = None if rows is None else list(rows)
        columns: Sequence[Any] = source if isinstance(source, list) else [source]
        stored = [column.dtype for column in columns]
        self.may_lack = any(kind.kind not in "iu" for kind in stored)
        is_small = all(kind.itemsize <= (4 if kind.kind == "f" else 2) for kind in stored)
        self.dtype = torch.float32 if is_small else torch.float64
        if isinstance(source, list):
            self.num_channels, self.num_samples = len(source), max(source[0].shape)
        else:
            self.num_channels = source.shape[1 - time_axis] if rows is None else len(rows)
            self.num_samples = source.shape[time_axis]

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file was damaged or cut since it was opened.
        """
        wanted = np.float32 if self.dtype == torch.float32 else np.float64
        with np.errstate(over="ignore"):  # a number beyond float32 is infinite in it
            return torch.from_numpy(np.array(self.stored(first, stop), wanted, order="C"))

    def stored(self, first: int, stop: int) -> NDArray[Any]:
        """As ``read``, in the numbers that the file has."""
        first = min(first, self.num_samples)
        part = slice(first, max(min(stop, self.num_samples), first))
        with guarded(self.path):
            if isinstance(self._source, list):
                return np.stack([_along(column, part) for column in self._source])
            if self._rows is not None and not self._axis:
                return self._some_rows(part)
            if self._axis:
                values = np.asarray(self._source[:, part])
            else:
                values = np.asarray(self._source[part]).T
        return values if self._rows is None else values[self._rows]

    def _some_rows(self, part: slice) -> NDArray[Any]:
        """Some columns of a table, a block of its rows after the other; ``[C, n]``."""
        found = np.empty((self.num_channels, part.stop - part.start), self._source.dtype)
        for first in range(part.start, part.stop, _BLOCK):
            stop = min(first + _BLOCK, part.stop)
            rows = np.asarray(self._source[first:stop])
            found[:, first - part.start : stop - part.start] = rows.T[self._rows]
        return found


class StoredArray:
    """An array of numbers in an open file, indexed as NumPy's are; nothing of it stays in memory.

    Args:
        file: that holds it.
        dtype: of its numbers.
        shape: of it.
        offset: bytes before it.
        order: of its axes, ``"C"`` or ``"F"``.

    Raises:
        ValueError: if the file is shorter.
    """

    def __init__(
        self,
        file: IO[bytes],
        dtype: Any,
        shape: tuple[int, ...],
        offset: int = 0,
        order: Literal["C", "F"] = "C",
    ) -> None:
        self._file, self._offset, self._order = file, offset, order
        self.dtype, self.shape, self.ndim = np.dtype(dtype), shape, len(shape)
        _ = self._mapped()

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        return np.array(self._mapped()[key])  # pages of a map that stays would stay as well

    def _mapped(self) -> NDArray[Any]:
        if not math.prod(self.shape):
            return np.empty(self.shape, self.dtype)
        found: NDArray[Any] = np.memmap(
            self._file, self.dtype, "r", self._offset, self.shape, self._order
        )
        return found


_INDEX = re.compile(r"[\s_.\-\[(]*\d+[\])]?$")


def unfolded(opened: Opened, how: Reading) -> Opened:
    """An open file whose rows hold several samples of each channel; times and labels are of rows.

    Raises:
        Refused: if the columns are no such number, or their order is not known.
    """
    k, num = how.samples_per_row, opened.samples.num_channels
    if num % k:
        raise Refused(
            f"has {num} columns of samples, which is no multiple of "
            f"{setting('reading.samples_per_row')}={k}; list the columns that are channels as "
            f"{setting('reading.channels')}"
        )
    stems = [_INDEX.sub("", name) for name in opened.names or ()]
    named: dict[_RowOrder, tuple[str, ...]] = {}
    starts: dict[_RowOrder, list[str]] = {"channel": stems[::k], "time": stems[: num // k]}
    for order, names in starts.items():
        wanted = [n for n in names for _ in range(k)] if order == "channel" else names * k
        if names and all(names) and len(set(names)) == len(names) and stems == wanted:
            named[order] = tuple(names)
    found = how.row_order or next(iter(named), None)
    if found is None and num != k:
        raise Refused(
            f"does not show how its rows hold {k} samples of each channel; say "
            f"{setting('reading.row_order')}=channel (a_0, a_1, b_0, b_1) or time (a_0, b_0, a_1, "
            "b_1)"
        )
    order, samples = found or "channel", opened.samples
    rows = samples.stored(0, samples.num_samples)  # [C * k, T]
    if order == "channel":
        cube = rows.reshape(num // k, k, -1).transpose(0, 2, 1)
    else:
        cube = rows.reshape(k, num // k, -1).transpose(1, 2, 0)
    whole = Samples(samples.path, cube.reshape(num // k, -1), 1)
    return opened._replace(samples=whole, names=named.get(order))


def _along(column: Any, part: slice) -> NDArray[Any]:
    """A stretch of an array along its longest axis, ``[n]``."""
    axis = int(np.argmax(column.shape))
    return np.asarray(column[(*[slice(None)] * axis, part)]).reshape(-1)


def pieces(samples: Any, num_samples: int) -> Iterator[Tensor]:
    """All samples in order, ``num_samples`` at a time and the rest at the end; ``[C, n]`` each."""
    for first in range(0, samples.num_samples, num_samples):
        yield samples.read(first, first + num_samples)


class Archived(NamedTuple):
    """What a package file holds.

    Args:
        recording: samples and truth.
        hand: its channels.
        key: what determined the samples, as plain values.
    """

    recording: Recording
    hand: HandLayout
    key: dict[str, Any]


class Opened(NamedTuple):
    """A recording in a file that is open.

    Args:
        samples: all of them.
        archived: all else of a package file, around no samples; ``None`` for foreign files.
        names: of the channels, if the file says.
        stamps: when the samples were taken, in the only channel, if the file says. Of rows with
            several samples, when the first of each was.
        time_unit: of the stamps, if anybody says it.
        sample_rate_hz: if the file says; what a person says is not here.
        labels: of the column that is asked for, in the only channel, at the same times as
            ``stamps``.
        left_out: names of columns that are taken for no channels, by what they are called or hold.
    """

    samples: Samples
    archived: Archived | None = None
    names: tuple[str, ...] | None = None
    stamps: Samples | None = None
    time_unit: TimeUnit | None = None
    sample_rate_hz: float | None = None
    labels: Samples | None = None
    left_out: tuple[str, ...] = ()

    def times(self) -> NDArray[np.float64] | None:
        """Seconds since the first sample, ``[T]``; ``None`` if the file does not say.

        Whole numbers are subtracted as such: nanoseconds since 1970 are more than a float holds.
        """
        if self.stamps is None:
            return None
        stored = self.stamps.stored(0, self.stamps.num_samples)[0]
        values: NDArray[Any] = np.array(
            stored, np.int64 if stored.dtype.kind in "iu" else np.float64
        )
        del stored
        unit = self.time_unit or epoch_unit(float(np.fmax.reduce(values, initial=0))) or "s"
        values -= values[:1].copy()  # in place: those of hours are large
        seconds = values.astype(np.float64, copy=False)
        seconds *= SECONDS[unit]
        return seconds


class Spool:
    """Rows of numbers ``[T, C]`` that grow, in a temporary file (``TMPDIR``)."""

    def __init__(self, num_columns: int, dtype: Any, stack: ExitStack) -> None:
        self._num_columns, self._dtype = num_columns, dtype
        self._file = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115

    def add(self, rows: NDArray[Any]) -> None:
        """Put rows ``[n, C]`` behind those that are there."""
        with np.errstate(over="ignore"):
            self._file.write(np.asarray(rows, self._dtype).tobytes())

    def array(self) -> StoredArray:
        """All rows; none can be added behind them."""
        self._file.flush()
        dtype = np.dtype(self._dtype)
        num_rows = self._file.tell() // (dtype.itemsize * self._num_columns)
        return StoredArray(self._file, dtype, (num_rows, self._num_columns))


# Columns of a table -----------------------------------------------------------------------------

_MOST_NAMED = 8  # in a message


class Columns(NamedTuple):
    """What the columns of a table are, by their places.

    Args:
        time: of the times, if there is such a column.
        channels: in the order of the samples.
        label: of the labels, if they are asked for.
        left_out: those taken for no channels by what they are called or hold.
        nanoseconds: of what is added to the times, which are whole seconds then.
    """

    time: int | None
    channels: list[int]
    label: int | None = None
    left_out: tuple[int, ...] = ()
    nanoseconds: int | None = None


def chosen_columns(
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    others: Iterable[int] = (),
    stamps: Iterable[int] = (),
) -> Columns:
    """Which columns are times, channels and labels.

    If ``how`` does not say which hold samples, those that are called as channels of its hand do; if
    not all of these are there, all but ``others`` and those that are called as times, labels or
    book-keeping are.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        others: columns that are no channels unless a person says so.
        stamps: columns that hold times by their type.

    Raises:
        Refused: if there is no such column, or none is left for samples.
    """

    def place(wanted: str | int | None, key: str) -> int | None:
        return None if wanted is None else position_of(names, num_columns, wanted, key)

    stamps = set(stamps)
    pair = seconds_and_nanoseconds(names or ())
    if how.time == "auto":
        called = {n for n, name in enumerate(names or ()) if is_time(name)}
        time = min(called | stamps | set(pair[:1]), default=None)
    else:
        time = place(how.time, setting("reading.time"))
    nanoseconds = pair[1] if pair and time == pair[0] else None
    label = place(None if how.label is None else how.label.name, "labels.column")
    if how.channels is not None:
        key = setting("reading.channels")
        places = [position_of(names, num_columns, one, key) for one in how.channels]
        return Columns(time, places, label, (), nanoseconds)
    wanted = set(map(bare, how.hand))
    channels = [n for n, name in enumerate(names or ()) if bare(name) in wanted and n != label]
    if not wanted or {bare(names[n]) for n in channels if names} < wanted:
        own = {time, label, *others, *stamps, *pair}
        beside = own | {*no_channels(names or (), how.hand)}
        channels = [n for n in range(num_columns) if n not in beside]
    if not channels:
        which = f"{some(list(map(repr, names)))} is" if names else "its only column is"
        raise Refused(
            f"has no column of samples: {which} taken for times, a label or book-keeping; if one "
            f"is a channel, list it as {setting('reading.channels')} and say "
            f"{setting('reading.sample_rate_hz')}"
        )
    left = {*range(num_columns)} - {*channels, *stamps, *pair, time, label}
    return Columns(time, channels, label, tuple(sorted(left)) if names else (), nanoseconds)


def opened_columns(
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    samples: Callable[[list[int]], Samples],
    others: Iterable[int] = (),
    stamps: Mapping[int, TimeUnit] = MappingProxyType({}),
    units: Mapping[int, TimeUnit] = MappingProxyType({}),
) -> Opened:
    """A table as an open file; arguments and errors as of ``chosen_columns``.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        samples: reads columns by their places.
        others: columns that are no channels unless a person says so.
        stamps: units of columns that hold times by their type.
        units: that a line of units says of columns, if they hold times.
    """
    chosen = chosen_columns(names, num_columns, how, others, stamps)
    time = chosen.time
    opened = Opened(samples(chosen.channels))
    if chosen.label is not None:
        opened = opened._replace(labels=samples([chosen.label]))
    if names is not None:
        of = tuple(tuple(names[n] for n in places) for places in (chosen.channels, chosen.left_out))
        opened = opened._replace(names=of[0], left_out=of[1])
    if time is None:
        return opened
    if chosen.nanoseconds is not None:
        both = samples([time, chosen.nanoseconds])
        whole = _nanoseconds(*both.stored(0, both.num_samples))
        return opened._replace(stamps=Samples(both.path, [whole]), time_unit="ns")
    unit = how.time_unit or time_unit_in(names[time] if names else None) or units.get(time)
    return opened._replace(stamps=samples([time]), time_unit=stamps.get(time, unit))


def _nanoseconds(seconds: NDArray[Any], rest: NDArray[Any]) -> NDArray[np.int64]:
    """One time of whole seconds and the nanoseconds beyond, which may be the whole time as well.

    Raises:
        Refused: if a number is missing.
    """
    if not (np.isfinite(seconds).all() and np.isfinite(rest).all()):
        raise Refused("has a time without a number, in seconds or nanoseconds")
    whole = rest.astype(np.int64)
    if (whole < 10**9).all():
        whole += seconds.astype(np.int64) * 10**9
    return np.asarray(whole)


def _label_numbers(label: LabelColumn, words: Sequence[str | None]) -> NDArray[np.float64]:
    """What stands for words of a column of labels, ``[T]``; NaN of empty ones.

    Raises:
        Refused: naming the first word that is no label.
    """
    numbers: dict[str | None, float] = {None: math.nan, "": math.nan}
    for word in set(words) - set(numbers):
        number = label.number_of(str(word))
        if number is None:
            raise Refused(f"cannot be labelled: {label.no_label(str(word)[:40])}")
        numbers[word] = number
    return np.array([numbers[word] for word in words], np.float64)


def position_of(names: Sequence[str] | None, num_columns: int, wanted: str | int, key: str) -> int:
    """The place of a column that a setting says by name or number.

    Raises:
        Refused: if there is none.
    """
    if isinstance(wanted, int) and 0 <= wanted < num_columns:
        return wanted
    if isinstance(wanted, str) and names is not None and wanted in names:
        return list(names).index(wanted)
    there = f"{num_columns} columns{' without names' * (names is None)}, 0 to {num_columns - 1}"
    if isinstance(wanted, str) and names is not None:
        there = some(list(map(repr, names)))
    raise Refused(f"has no column {wanted!r} that {key} names; it has {there}")


def some(words: Sequence[str]) -> str:
    """The first few words, and how many more there are."""
    more = len(words) - _MOST_NAMED
    return ", ".join(words[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


# Headers of package files -----------------------------------------------------------------------

FORM = "tactslip_torch recording 1"
MOST_HEADER = 16 * 2**20
"""Bytes of header text; a longer one is none."""
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def header_of(recording: Recording, hand: HandLayout, key: Mapping[str, Any]) -> dict[str, Any]:
    """What ``opened_from`` reads, numbers to the bit, as JSON has it.

    Raises:
        ValueError: if samples are neither float32 nor float64, the hand has another number of
            channels, a word holds a NUL, or provenance or key is not JSON-able.
    """
    samples = recording.samples
    if samples.dtype not in DTYPES.values():
        raise ValueError(f"samples must be float32 or float64 to be saved, got {samples.dtype}")
    if len(hand) != len(samples):
        raise ValueError(f"the hand has {len(hand)} channels, the recording {len(samples)}")
    for word in (recording.units, recording.material, *hand.names):
        if "\0" in word:
            raise ValueError(f"a name must not hold a NUL to be saved, got {word!r}")
    header = {
        "format": FORM,
        "dtype": str(samples.dtype).removeprefix("torch."),
        "shape": list(samples.shape),
        "units": recording.units,
        "sample_rate_hz": float(recording.sample_rate_hz),
        "material": recording.material,
        **{name: list(getattr(recording, name)) for name in (*MOMENTS, *STRETCHES)},
        "channels": hand.to_rows(),
    }
    for name, values in (("provenance", recording.provenance), ("key", key)):
        try:
            header[name] = json.loads(text_of(dict(values)))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name} must be plain JSON values to be saved: {error}") from error
    return header


def text_of(header: Mapping[str, Any]) -> str:
    """One line of JSON, ASCII; equal headers give equal text.

    Raises:
        Refused: if it is longer than is read.
    """
    text = json.dumps(header, sort_keys=True, allow_nan=False)
    if len(text) > MOST_HEADER:
        raise Refused(
            f"cannot hold provenance, key and the rest of {len(text)} characters, at most "
            f"{MOST_HEADER} are read; keep less in them"
        )
    return text


def header_in(kept: object) -> dict[str, Any] | None:
    """What ``text_of`` wrote, whole or as words; ``None`` of anything else.

    Raises:
        Refused: if it is of another version, or too long.
        ValueError: if it is damaged.
    """
    text = "".join(kept) if isinstance(kept, tuple) else kept
    if not isinstance(text, str) or FORM.rpartition(" ")[0] not in text:
        return None
    if len(text) > MOST_HEADER:
        raise Refused(f"has a header of {len(text)} characters, at most {MOST_HEADER} are read")
    header: dict[str, Any] = json.loads(text)
    if (form := header.get("format")) != FORM:
        raise Refused(f"must be of format {FORM!r}, got {str(form)[:80]!r}")
    return header


def opened_from(
    header: Mapping[str, Any], path: str | os.PathLike[str], samples: Samples
) -> Opened:
    """An open package file: its samples, and all else around none of them.

    Raises:
        ValueError: if a part of the header is missing or wrong, or belongs to other samples.
    """
    try:
        samples.dtype = DTYPES[header["dtype"]]
        found = [samples.num_channels, samples.num_samples]
        if list(header["shape"]) != found:
            raise ValueError(f"{found} samples, where its header says {header['shape']}")
        hand = HandLayout.from_rows(header["channels"])
        if len(hand) != samples.num_channels:
            raise ValueError(f"{len(hand)} rows of channels for {samples.num_channels} channels")
        truth: dict[str, Any] = {name: tuple(map(float, header[name])) for name in MOMENTS}
        header = {"slip_s": (), "released_s": (), **header}  # where there is none
        for name in STRETCHES:
            truth[name] = tuple((float(start), float(end)) for start, end in header[name])
        recording = Recording(
            samples.read(0, 0),
            float(header["sample_rate_hz"]),
            str(header["material"]),
            **truth,
            provenance=dict(header["provenance"]),
            units=str(header["units"]),
        )
        archived = Archived(recording, hand, dict(header["key"]))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        raise ValueError(f"a header that lacks a part: {error}") from error
    return Opened(samples, archived, hand.names, sample_rate_hz=recording.sample_rate_hz)
