"""Arrays in an open file, whichever library reads them: which are the samples, which the times."""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats._faults import FREE_BYTES, Refused, guarded
from tactslip_torch.data.formats._reading import SECONDS, Opened, Reading, TimeUnit

RATE_NAMES = ("sample_rate_hz", "sample_rate", "sampling_rate", "samplingrate", "fs", "rate")
LABEL_NAMES = ("channel_name", "channel_names", "channels", "columns", "labels")
TIME_NAMES = ("time", "time_s", "t", "timestamp", "timestamps", "stamp", "time_stamp", "seconds")
_NAME_AND_UNIT = re.compile(r"(.*?)[\s_/(\[]+(s|ms|us|ns)[)\]]?")  # "Time (ms)", "t_us", "t/s"
_MOST_NAMED = 8  # in a message
_NOT_NUMBERS = {"b": "true or false", "c": "complex numbers", "V": "compound values"}
_NOT_NUMBERS |= {"O": "objects or text", "S": "text", "U": "text"}


@dataclass(frozen=True)
class Array:
    """Numbers of no more than two dimensions.

    Args:
        path: of the file, for messages.
        name: in full, as people of the format write it: ``/group/volts``, ``trial.volts``.
        values: have ``shape`` and ``dtype`` and are sliced as NumPy's are.
        is_turned: whether people of the format see rows and columns exchanged.
        time_unit: of a column that says it holds times.
        leaf: the last part of the name, if it has parts.
    """

    path: str | os.PathLike[str]
    name: str
    values: Any
    is_turned: bool = False
    time_unit: TimeUnit | None = None
    leaf: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """As people of the format see it."""
        shape = tuple(self.values.shape)
        return shape[::-1] if self.is_turned else shape

    @property
    def is_column(self) -> bool:
        """Whether no more than one axis is longer than 1."""
        return sum(length > 1 for length in self.shape) < 2

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """What stands from ``first`` to before ``stop`` along that axis, all of the other.

        Raises:
            Refused: if the file was damaged or cut since it was opened.
        """
        place = len(self.shape) - 1 - axis if self.is_turned else axis
        with guarded(self.path):
            index = (*[slice(None)] * place, slice(first, stop)) if self.shape else ()
            values = np.asarray(self.values[index])
        return values.T if self.is_turned else values


class Contents(NamedTuple):
    """What was found in a file of arrays.

    Args:
        arrays: that can be read.
        refused: names of what cannot, each with the reason.
        labels: words that may name channels of the array of that name, nearest first.
        numbers: numbers said about the array of that name, nearest first.
        columns: names by which columns are counted, where the file is one table.
    """

    arrays: Sequence[Array]
    refused: Mapping[str, str] = {}
    labels: Callable[[str], Iterable[tuple[str, ...]]] = lambda name: ()
    numbers: Callable[[str], Iterable[Mapping[str, float]]] = lambda name: ()
    columns: Sequence[str] | None = None


def why_not_numbers(dtype: np.dtype[Any], shape: Sequence[int] | None) -> str | None:
    """The reason why values are no samples, if there is one."""
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        return f"holds {_NOT_NUMBERS.get(dtype.kind, str(dtype))}"
    if shape is None or len(shape) > 2:
        return "is empty" if shape is None else f"has {len(shape)} dimensions"
    return None


def float_for(*stored: np.dtype[Any]) -> torch.dtype:
    """``float32`` if it holds every number of these dtypes exactly, else ``float64``.

    Whole numbers beyond 2**53 are rounded.
    """
    small = all(dtype.itemsize <= (4 if dtype.kind == "f" else 2) for dtype in stored)
    return torch.float32 if small else torch.float64


class Vector(NamedTuple):
    """One row of an array along time: a column that stands alone, or one of a matrix."""

    array: Array
    number: int | None = None
    time_axis: int = 0

    def read(self, first: int, stop: int) -> NDArray[Any]:
        """Its numbers from ``first`` to before ``stop``, ``[n]``."""
        if self.number is None:
            axis = int(np.argmax(self.array.shape))
            return self.array.read(axis, first, stop).reshape(-1)
        part = self.array.read(self.time_axis, first, stop)
        found: NDArray[Any] = np.take(part, self.number, axis=1 - self.time_axis)
        return found


@dataclass(frozen=True)
class ArraySamples:
    """Samples in one array, ``[T, C]`` if ``time_axis`` is 0, or in a column for each channel."""

    source: Array | Sequence[Array]
    time_axis: int = 0
    rows: Sequence[int] | None = None
    dtype: torch.dtype = torch.float64

    @property
    def _shape(self) -> tuple[int, int]:
        if isinstance(self.source, Array):
            shape = self.source.shape
            return shape[1 - self.time_axis], shape[self.time_axis]
        return len(self.source), max(self.source[0].shape)

    @property
    def num_channels(self) -> int:
        """Of those used."""
        return self._shape[0] if self.rows is None else len(self.rows)

    @property
    def num_samples(self) -> int:
        """Along the axis of time."""
        return self._shape[1]

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``.

        Raises:
            Refused: if the file was damaged or cut since it was opened.
        """
        first = min(first, self.num_samples)
        stop = max(min(stop, self.num_samples), first)
        wanted = np.float32 if self.dtype == torch.float32 else np.float64
        if isinstance(self.source, Array):
            values = self.source.read(self.time_axis, first, stop)
            values = values if self.time_axis else values.T
            values = values if self.rows is None else values[list(self.rows)]
        else:
            values = np.empty((len(self.source), stop - first), wanted)
            for row, array in zip(values, self.source, strict=True):
                row[:] = Vector(array).read(first, stop)
        with np.errstate(over="ignore"):  # a number beyond float32 is infinite in it
            return torch.from_numpy(np.array(values, wanted, order="C"))


@dataclass(frozen=True)
class ArrayTimes:
    """Times in an array, in seconds since its first."""

    vector: Vector
    unit: TimeUnit
    start: Any = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "start", self.vector.read(0, 1)[:1])

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``.

        Whole numbers are subtracted as such: nanoseconds since 1970 are more than a float holds.
        """
        values = self.vector.read(first, max(first, stop))
        kind = np.int64 if values.dtype.kind in "iu" else np.float64
        since = values.astype(kind) - self.start.astype(kind)
        return torch.from_numpy(since.astype(np.float64) * SECONDS[self.unit])


class Spool:
    """Rows of numbers ``[T, C]`` that grow, in memory or, beyond 64 MiB, in a temporary file."""

    def __init__(self, num_columns: int, dtype: type[Any], stack: ExitStack) -> None:
        self._shape, self._dtype, self._stack = num_columns, dtype, stack
        self._kept: list[NDArray[Any]] = []
        self._file: Any = None
        self._num_bytes = self.num_rows = 0

    def add(self, rows: NDArray[Any]) -> None:
        """Put rows ``[n, C]`` behind those that are there."""
        with np.errstate(over="ignore"):
            rows = np.ascontiguousarray(rows, self._dtype)
        self.num_rows += len(rows)
        self._num_bytes += rows.nbytes
        self._kept.append(rows)
        if self._file is None and self._num_bytes > FREE_BYTES:
            self._file = self._stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        if self._file is not None:
            self._file.writelines(part.data for part in self._kept if part.size)
            self._kept.clear()

    def array(self) -> NDArray[Any]:
        """All rows; none can be added behind them."""
        shape = (self.num_rows, self._shape)
        if self._file is None:
            return np.concatenate([np.empty((0, self._shape), self._dtype), *self._kept])
        self._file.flush()
        return np.memmap(self._file, self._dtype, "r", shape=shape)


# Names -------------------------------------------------------------------------------------------


def is_time_name(name: str) -> bool:
    """Whether something called so is taken for times: ``t``, ``Timestamp``, ``time (ms)``."""
    plain = name.strip().lower()
    found = _NAME_AND_UNIT.fullmatch(plain)
    return plain in TIME_NAMES or (found is not None and found[1] in TIME_NAMES)


def unit_of_time(name: str | None, how: Reading) -> TimeUnit:
    """The unit a time's name ends in, if it has one, else the one that is said."""
    found = _NAME_AND_UNIT.fullmatch(name.strip().lower()) if name is not None else None
    if found is None or found[1] not in TIME_NAMES:
        return how.time_unit
    return next(unit for unit in SECONDS if unit == found[2])


def chosen_columns(
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    is_count: Callable[[int], bool] = lambda place: False,
    is_time_first: bool = False,
) -> tuple[int | None, list[int]]:
    """The place of the column of times, if there is one, and those of the channels.

    If ``how`` does not say which hold samples, all do but times, further times, and the number of
    the row that some libraries write before the others without a name.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        is_count: whether the column there rises by one from row to row.
        is_time_first: whether the first of columns without names holds times.

    Raises:
        Refused: if there is no such column, or none is left for samples.
    """
    time: int | None = None
    if how.time != "auto":
        time = None if how.time is None else _position(names, num_columns, how.time, "time")
    elif names is not None:
        time = next((place for place, name in enumerate(names) if is_time_name(name)), None)
    elif is_time_first and how.sample_rate_hz is None and num_columns > 1:
        time = 0
    if how.channels is not None:
        return time, [_position(names, num_columns, one, "channels") for one in how.channels]

    def is_beside(place: int) -> bool:
        if names is None:
            return False
        is_nameless = names[place] in ("", f"column {place}", f"Unnamed: {place}")
        is_time = time is not None and is_time_name(names[place])
        return is_time or (is_nameless and is_count(place))

    channels = [place for place in range(num_columns) if place != time and not is_beside(place)]
    if not channels:
        raise Refused(
            "has one column, and it is taken for times; say reading.time=null and "
            "reading.sample_rate_hz if it holds samples"
        )
    return time, channels


def _position(names: Sequence[str] | None, num_columns: int, wanted: str | int, what: str) -> int:
    if isinstance(wanted, int) and 0 <= wanted < num_columns:
        return wanted
    if isinstance(wanted, str) and names is not None and wanted in names:
        return list(names).index(wanted)
    there = f"{num_columns} columns{' without names' * (names is None)}, 0 to {num_columns - 1}"
    if isinstance(wanted, str) and names is not None:
        there = _some(list(map(repr, names)))
    raise Refused(f"has no column {wanted!r} that reading.{what} names; it has {there}")


def _some(words: Sequence[str]) -> str:
    more = len(words) - _MOST_NAMED
    return ", ".join(words[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _listed(arrays: Sequence[Array]) -> str:
    return _some([f"{a.name!r} {' by '.join(map(str, a.shape))}" for a in arrays])


# What is what ------------------------------------------------------------------------------------


def choose(contents: Contents, how: Reading) -> Opened:
    """The samples of a file: its only array of two dimensions, or all columns of one length.

    What ``reading`` names goes first: ``samples`` an array or a group, ``channels`` columns,
    ``time`` an array or a column. Single numbers are no samples.

    Raises:
        Refused: in one line that names what could be meant, if that is none or several.
    """
    several = [array for array in contents.arrays if math.prod(array.shape) > 1]
    within = several if how.samples is None else _named(how.samples, several, contents)
    columns = [array for array in within if array.is_column and not _is_time(array, how)]
    matrices = [array for array in within if not array.is_column]
    known = {name for column in columns for name in (column.name, column.leaf)}
    if how.channels is not None and known.issuperset(how.channels):
        return _of_columns(columns, several, contents, how)
    if len(matrices) == 1:
        return _of_matrix(matrices[0], several, contents, how)
    if matrices:
        raise Refused(f"holds several arrays, {_listed(matrices)}; say reading.samples")
    if not columns:
        said = [f"{name!r} {why}" for name, why in contents.refused.items()][:3]
        reasons = f" ({'; '.join(said)})" if said else ""
        raise Refused(f"holds no samples{reasons}; say reading.samples if it does")
    return _of_columns(columns, several, contents, how)


def _of_matrix(matrix: Array, several: Sequence[Array], contents: Contents, how: Reading) -> Opened:
    lengths = {max(array.shape) for array in several if array.is_column and _is_time(array, how)}
    axis = _time_axis(matrix, lengths, how)
    count = matrix.shape[1 - axis]
    fitting = (labels for labels in contents.labels(matrix.name) if len(labels) == count)
    labels = next((labels for labels in fitting if len(set(labels)) == count), None)
    is_beside = isinstance(how.time, str) and how.time != "auto" and how.time not in (labels or ())
    within = replace(how, time=None) if is_beside else how
    number, rows = chosen_columns(labels, count, within)
    dtype = float_for(matrix.values.dtype)
    samples = ArraySamples(matrix, axis, None if rows == list(range(count)) else rows, dtype)
    names = None if labels is None else tuple(labels[row] for row in rows)
    if number is None:
        times = _times(several, matrix.shape[axis], how, contents)
    else:
        unit = unit_of_time(labels[number] if labels else None, how)
        times = ArrayTimes(Vector(matrix, number, axis), unit)
    return Opened(samples, None, names, times, _rate(contents, matrix))


def _time_axis(matrix: Array, lengths: set[int], how: Reading) -> int:
    """The axis that is said, or as long as the times, or the longer one."""
    if how.time_first is not None:
        return 0 if how.time_first else 1
    rows, columns = matrix.shape
    if (rows in lengths) != (columns in lengths):
        return 0 if rows in lengths else 1
    if rows == columns:
        raise Refused(
            f"holds {matrix.name!r} of {rows} by {columns}, so it does not show which axis is "
            "time; say reading.time_first=true or false"
        )
    return 0 if rows > columns else 1


def _of_columns(
    columns: Sequence[Array], several: Sequence[Array], contents: Contents, how: Reading
) -> Opened:
    """Columns that stand alone; by number they are counted as the file has them."""
    counted = contents.columns or [array.name for array in several if array.is_column]

    def named(wanted: str | int, arrays: Sequence[Array], what: str) -> Array:
        if isinstance(wanted, int):
            wanted = counted[_position(None, len(counted), wanted, what)]
        return _named(wanted, arrays, contents)[0]

    time = named(how.time, several, "time") if isinstance(how.time, int) else None
    if how.channels is None:
        chosen = [column for column in columns if column is not time]
    else:
        chosen = [named(wanted, columns, "channels") for wanted in how.channels]
    if not chosen:
        raise Refused("holds no column but the times; say reading.time=null if it is none")
    if len({max(column.shape) for column in chosen}) > 1:
        raise Refused(f"holds columns of several lengths, {_listed(chosen)}; say reading.channels")
    leaves = [column.leaf or column.name for column in chosen]
    are_unique = len(set(leaves)) == len(leaves)
    names = tuple(leaves if are_unique else [column.name for column in chosen])
    length = max(chosen[0].shape)
    times = _times(several, length, how, contents) if time is None else _time(time, length, how)
    samples = ArraySamples(chosen, dtype=float_for(*(array.values.dtype for array in chosen)))
    return Opened(samples, None, names, times, _rate(contents, chosen[0]))


def _times(
    several: Sequence[Array], length: int, how: Reading, contents: Contents
) -> ArrayTimes | None:
    """The times that were named, or what is called so and has this length."""
    if how.time is None or isinstance(how.time, int):
        return None
    if how.time != "auto":
        return _time(_named(how.time, several, contents)[0], length, how)
    called = [array for array in several if _is_time(array, how) and max(array.shape) == length]
    return _time(called[0], length, how) if called else None


def _time(array: Array, length: int, how: Reading) -> ArrayTimes:
    if not array.is_column or max(array.shape) != length:
        raise Refused(f"has times {_listed([array])} for {length} samples; say reading.time")
    return ArrayTimes(Vector(array), array.time_unit or unit_of_time(array.leaf or array.name, how))


def _is_time(array: Array, how: Reading) -> bool:
    """Whether these are times: named so by somebody, or by name or type."""
    leaf = array.leaf or array.name
    if how.time == "auto":
        return is_time_name(leaf) or array.time_unit is not None
    is_named = isinstance(how.time, str) and how.time.strip("/") in (array.name.strip("/"), leaf)
    return is_named or array.time_unit is not None


def _named(wanted: str, arrays: Sequence[Array], contents: Contents) -> list[Array]:
    """The array of that name, or those of that group; else what is only called so at its end."""
    plain = wanted.strip("/")
    for exact in (True, False):
        found = [a for a in arrays if plain == (a.name.strip("/") if exact else a.leaf)]
        if len(found) == 1:
            return found
    groups = (f"{plain}/", f"{plain}.")
    if inside := [array for array in arrays if array.name.strip("/").startswith(groups)]:
        return inside
    for name, why in contents.refused.items():
        if name.strip("/") == plain:
            raise Refused(f"cannot be read at {name!r}: it {why}")
    raise Refused(f"has no {wanted!r} of numbers; it has {_listed(arrays) or 'none'}")


def _rate(contents: Contents, array: Array) -> float | None:
    """The rate said nearest to the samples: of them, around them, or by a number of that name."""
    for said in contents.numbers(array.name):
        lower = {name.lower(): value for name, value in said.items()}
        for name in RATE_NAMES:
            if 0 < lower.get(name, 0) < math.inf:
                return lower[name]
    single = [one for one in contents.arrays if math.prod(one.shape) == 1]
    single.sort(key=lambda one: -len(os.path.commonprefix([one.name, array.name])))
    for name in RATE_NAMES:
        for one in single:
            if (one.leaf or one.name).lower() == name:
                value = float(one.read(0, 0, 1).reshape(-1)[0])
                if 0 < value < math.inf:
                    return value
    return None
