"""Arrays in an open file, whichever library reads them: which are the samples, which the times."""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats._limits import Refused, guarded
from tactslip_torch.data.formats._reading import SECONDS, Opened, Reading, TimeUnit

LABEL_NAMES = ("channel_name", "channel_names", "channels", "columns", "labels")
_RATE_NAMES = ("sample_rate_hz", "sample_rate", "sampling_rate", "samplingrate", "fs", "rate")
_TIME_NAME = re.compile(  # "Time (ms)", "t_us", "t/s", "timestamps"
    r"(?:time|t|timestamps?|stamp|time_stamp|seconds)(?:[\s_/(\[]+(s|ms|us|ns)[)\]]?)?"
)
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
        leaf: the last part of the name, if it has parts.
        is_turned: whether people of the format see rows and columns exchanged.
        time_unit: of a column that says it holds times.
        labels: words that may name its channels, the likeliest first.
        sample_rate_hz: if the file says it of this array.
    """

    path: str | os.PathLike[str]
    name: str
    values: Any
    leaf: str = ""
    is_turned: bool = False
    time_unit: TimeUnit | None = None
    labels: Sequence[tuple[str, ...]] = ()
    sample_rate_hz: float | None = None

    @property
    def short_name(self) -> str:
        """Without the groups it stands in."""
        return self.leaf or self.name

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


@dataclass(frozen=True)
class ArraySamples:
    """Samples in one array, ``[T, C]`` if ``time_axis`` is 0, or in a column for each channel.

    Of one array, ``rows`` are the channels used; ``None`` for all.
    """

    source: Array | Sequence[Array]
    time_axis: int = 0
    rows: Sequence[int] | None = None
    dtype: torch.dtype = torch.float64

    @property
    def num_channels(self) -> int:
        """Of those used."""
        if self.rows is not None:
            return len(self.rows)
        if isinstance(self.source, Array):
            return self.source.shape[1 - self.time_axis]
        return len(self.source)

    @property
    def num_samples(self) -> int:
        """Along the axis of time."""
        if isinstance(self.source, Array):
            return self.source.shape[self.time_axis]
        return max(self.source[0].shape)

    def stored(self, first: int, stop: int) -> NDArray[Any]:
        """As ``read``, of the dtype that the file has."""
        first = min(first, self.num_samples)
        stop = max(min(stop, self.num_samples), first)
        if isinstance(self.source, Array):
            values = self.source.read(self.time_axis, first, stop)
            values = values if self.time_axis else values.T
            return values if self.rows is None else values[list(self.rows)]
        columns = [array.read(int(np.argmax(array.shape)), first, stop) for array in self.source]
        return np.stack([column.reshape(-1) for column in columns])

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``.

        Raises:
            Refused: if the file was damaged or cut since it was opened.
        """
        wanted = np.float32 if self.dtype == torch.float32 else np.float64
        with np.errstate(over="ignore"):  # a number beyond float32 is infinite in it
            return torch.from_numpy(np.array(self.stored(first, stop), wanted, order="C"))


class ArrayTimes(NamedTuple):
    """Times in the only channel of ``column``."""

    column: ArraySamples
    unit: TimeUnit

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``.

        Whole numbers are subtracted as such: nanoseconds since 1970 are more than a float holds.
        """
        values, start = self.column.stored(first, stop)[0], self.column.stored(0, 1)[0]
        kind = np.int64 if values.dtype.kind in "iu" else np.float64
        since = (values.astype(kind) - start.astype(kind)).astype(np.float64)
        return torch.from_numpy(since * SECONDS[self.unit])


class Spool:
    """Rows of numbers ``[T, C]`` that grow, in a temporary file (``TMPDIR``)."""

    def __init__(self, num_columns: int, dtype: Any, stack: ExitStack) -> None:
        self._num_columns, self._dtype = num_columns, dtype
        self._file = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115

    def add(self, rows: NDArray[Any]) -> None:
        """Put rows ``[n, C]`` behind those that are there."""
        with np.errstate(over="ignore"):
            self._file.write(np.asarray(rows, self._dtype).tobytes())

    def array(self) -> NDArray[Any]:
        """All rows; none can be added behind them."""
        self._file.flush()
        if not self._file.tell():
            return np.empty((0, self._num_columns), self._dtype)
        rows: NDArray[Any] = np.memmap(self._file, self._dtype, "r")
        return rows.reshape(-1, self._num_columns)


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


# Names -------------------------------------------------------------------------------------------


def rate_in(numbers: Mapping[str, float]) -> float | None:
    """The sample rate among numbers by name, if one is called so."""
    lower = {name.lower(): value for name, value in numbers.items()}
    return next((lower[n] for n in _RATE_NAMES if 0 < lower.get(n, 0) < math.inf), None)


def _is_time_name(name: str) -> bool:
    return _TIME_NAME.fullmatch(name.strip().lower()) is not None


def unit_of_time(name: str | None, how: Reading) -> TimeUnit:
    """The unit a time's name ends in, if it has one, else the one that is said."""
    found = _TIME_NAME.fullmatch((name or "").strip().lower())
    unit = found[1] if found else None
    return next((known for known in SECONDS if known == unit), how.time_unit)


def chosen_columns(
    names: Sequence[str] | None, num_columns: int, how: Reading, counts: Iterable[int] = ()
) -> tuple[int | None, list[int]]:
    """The place of the column of times, if there is one, and those of the channels.

    If ``how`` does not say which hold samples, all do but times, further times, and the number of
    the row that some libraries write before the others without a name.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        counts: the columns that rise by one from row to row.

    Raises:
        Refused: if there is no such column, or none is left for samples.
    """
    time: int | None = None
    if how.time is not None and how.time != "auto":
        time = _position(names, num_columns, how.time, "time")
    elif how.time == "auto" and names is not None:
        time = next((place for place, name in enumerate(names) if _is_time_name(name)), None)
    if how.channels is not None:
        return time, [_position(names, num_columns, one, "channels") for one in how.channels]
    beside = {time}
    if names is not None:
        beside |= {n for n in counts if names[n] in ("", f"column {n}", f"Unnamed: {n}")}
        if time is not None:
            beside |= {place for place, name in enumerate(names) if _is_time_name(name)}
    channels = [place for place in range(num_columns) if place not in beside]
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


def choose(
    arrays: Sequence[Array],
    refused: Mapping[str, str],
    how: Reading,
    columns: Sequence[str] | None = None,
) -> Opened:
    """The samples of a file: its only array of two dimensions, or all columns of one length.

    What ``how`` names goes first: ``samples`` an array or a group, ``channels`` columns, ``time``
    an array or a column. Single numbers are no samples.

    Args:
        arrays: that can be read.
        refused: names of what cannot, each with the reason.
        how: what a person says of the file.
        columns: names by which columns are counted, where the file is one table.

    Raises:
        Refused: in one line that names what could be meant, if that is none or several.
    """
    several = [array for array in arrays if math.prod(array.shape) > 1]
    within = several if how.samples is None else _named(how.samples, several, refused)
    singles = [array for array in within if array.is_column and not _is_time(array, how)]
    matrices = [array for array in within if not array.is_column]
    known = {name for single in singles for name in (single.name, single.leaf)}
    is_of_columns = how.channels is not None and known.issuperset(how.channels)
    if matrices and not is_of_columns:
        if len(matrices) > 1:
            raise Refused(f"holds several arrays, {_listed(matrices)}; say reading.samples")
        opened = _of_matrix(matrices[0], several, refused, how)
        near = matrices[0]
    else:
        if not singles:
            said = "; ".join([f"{name!r} {why}" for name, why in refused.items()][:3])
            reasons = f" ({said})" if said else ""
            raise Refused(f"holds no samples{reasons}; say reading.samples if it does")
        counted = columns or [array.name for array in several if array.is_column]
        opened, near = _of_columns(singles, several, refused, counted, how)
    rate = near.sample_rate_hz or _single_rate(arrays, near.name)
    return opened._replace(sample_rate_hz=rate)


def _single_rate(arrays: Sequence[Array], name: str) -> float | None:
    """A rate that is an array of one number, the nearest to the samples by its name."""
    single = [a for a in arrays if math.prod(a.shape) == 1 and a.short_name.lower() in _RATE_NAMES]
    single.sort(key=lambda one: len(os.path.commonprefix([one.name, name])))
    return rate_in({one.short_name: float(one.read(0, 0, 1).reshape(-1)[0]) for one in single})


def _of_matrix(
    matrix: Array, several: Sequence[Array], refused: Mapping[str, str], how: Reading
) -> Opened:
    lengths = {max(array.shape) for array in several if array.is_column and _is_time(array, how)}
    axis = _time_axis(matrix, lengths, how)
    count = matrix.shape[1 - axis]
    fitting = (labels for labels in matrix.labels if len(labels) == len(set(labels)) == count)
    labels = next(fitting, None)
    is_beside = isinstance(how.time, str) and how.time != "auto" and how.time not in (labels or ())
    number, rows = chosen_columns(labels, count, replace(how, time=None) if is_beside else how)
    dtype = float_for(matrix.values.dtype)
    samples = ArraySamples(matrix, axis, None if rows == list(range(count)) else rows, dtype)
    names = None if labels is None else tuple(labels[row] for row in rows)
    if number is None:
        times = _times(several, matrix.shape[axis], refused, how)
    else:
        unit = unit_of_time(labels[number] if labels else None, how)
        times = ArrayTimes(ArraySamples(matrix, axis, [number]), unit)
    return Opened(samples, None, names, times)


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
    singles: Sequence[Array],
    several: Sequence[Array],
    refused: Mapping[str, str],
    counted: Sequence[str],
    how: Reading,
) -> tuple[Opened, Array]:
    """Columns that stand alone, and the first of them; by number they are as in ``counted``."""

    def named(wanted: str | int, arrays: Sequence[Array], what: str) -> Array:
        if isinstance(wanted, int):
            wanted = counted[_position(None, len(counted), wanted, what)]
        return _named(wanted, arrays, refused)[0]

    time = named(how.time, several, "time") if isinstance(how.time, int) else None
    if how.channels is None:
        chosen = [single for single in singles if single is not time]
    else:
        chosen = [named(wanted, singles, "channels") for wanted in how.channels]
    if not chosen:
        raise Refused("holds no column but the times; say reading.time=null if it is none")
    if len({max(column.shape) for column in chosen}) > 1:
        raise Refused(f"holds columns of several lengths, {_listed(chosen)}; say reading.channels")
    names = tuple(column.short_name for column in chosen)
    if len(set(names)) < len(names):
        names = tuple(column.name for column in chosen)
    length = max(chosen[0].shape)
    times = _times(several, length, refused, how) if time is None else _time(time, length, how)
    samples = ArraySamples(chosen, dtype=float_for(*(array.values.dtype for array in chosen)))
    return Opened(samples, None, names, times), chosen[0]


def _times(
    several: Sequence[Array], length: int, refused: Mapping[str, str], how: Reading
) -> ArrayTimes | None:
    """The times that were named, or what is called so and has this length."""
    if how.time is None or isinstance(how.time, int):
        return None
    if how.time != "auto":
        return _time(_named(how.time, several, refused)[0], length, how)
    called = [array for array in several if _is_time(array, how) and max(array.shape) == length]
    return _time(called[0], length, how) if called else None


def _time(array: Array, length: int, how: Reading) -> ArrayTimes:
    if not array.is_column or max(array.shape) != length:
        raise Refused(f"has times {_listed([array])} for {length} samples; say reading.time")
    return ArrayTimes(ArraySamples([array]), array.time_unit or unit_of_time(array.short_name, how))


def _is_time(array: Array, how: Reading) -> bool:
    """Whether these are times: named so by somebody, or by name or type."""
    if array.time_unit is not None or how.time is None or isinstance(how.time, int):
        return array.time_unit is not None
    if how.time == "auto":
        return _is_time_name(array.short_name)
    return how.time.strip("/") in (array.name.strip("/"), array.short_name)


def _named(wanted: str, arrays: Sequence[Array], refused: Mapping[str, str]) -> list[Array]:
    """The array of that name, or those of that group; else what is only called so at its end."""
    plain = wanted.strip("/")
    for exact in (True, False):
        found = [a for a in arrays if plain == (a.name.strip("/") if exact else a.leaf)]
        if len(found) == 1:
            return found
    groups = (f"{plain}/", f"{plain}.")
    if inside := [array for array in arrays if array.name.strip("/").startswith(groups)]:
        return inside
    for name, why in refused.items():
        if name.strip("/") == plain:
            raise Refused(f"cannot be read at {name!r}: it {why}")
    raise Refused(f"has no {wanted!r} of numbers; it has {_listed(arrays) or 'none'}")
