"""Which of the arrays in somebody's file are the samples, and which the times."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence

from tactslip_torch.data.formats.arrays import (
    Array,
    ArrayTimes,
    ColumnSamples,
    Contents,
    MatrixColumn,
    MatrixSamples,
)
from tactslip_torch.data.formats.columns import is_time_name, unit_of_time_name
from tactslip_torch.data.formats.reading import Opened, Reading, is_time_first
from tactslip_torch.data.formats.refusing import Refused

RATE_NAMES = ("sample_rate_hz", "sample_rate", "sampling_rate", "fs", "rate")
LABEL_NAMES = ("channel_name", "channel_names", "channels", "columns", "labels")
_MOST_NAMED = 8


def choose(path: str | os.PathLike[str], contents: Contents, how: Reading) -> Opened:
    """The samples of a file: its only array of two dimensions, or all columns of one length.

    What ``reading`` names goes first: ``samples`` an array or a group, ``channels`` columns,
    ``time`` an array or a column. Single numbers are no samples.

    Raises:
        ValueError: in one line that names what could be meant, if that is none or several.
    """
    try:
        return _choose(path, contents, how)
    except Refused as error:
        raise Refused(f"{os.fspath(path)} {error}") from None


def _choose(path: str | os.PathLike[str], contents: Contents, how: Reading) -> Opened:
    several = [array for array in contents.arrays if math.prod(array.shape) > 1]
    within = several if how.samples is None else _named(how.samples, several, contents)
    columns = [array for array in within if _is_column(array) and not _is_time(array, how)]
    matrices = [array for array in within if not _is_column(array)]
    if _names_columns(how.channels, columns):
        return _of_columns(columns, several, contents, how)
    if len(matrices) == 1:
        return _of_matrix(path, matrices[0], several, contents, how)
    if matrices:
        raise Refused(f"holds several arrays, {_listed(matrices)}; say reading.samples")
    if not columns:
        raise Refused(f"holds no samples{_reasons(contents)}; say reading.samples if it does")
    return _of_columns(columns, several, contents, how)


def _of_matrix(
    path: str | os.PathLike[str],
    matrix: Array,
    several: Sequence[Array],
    contents: Contents,
    how: Reading,
) -> Opened:
    lengths = {max(array.shape) for array in several if _is_column(array) and _is_time(array, how)}
    fitting = [axis for axis in (0, 1) if matrix.shape[axis] in lengths]
    is_told = how.time_first is None and len(fitting) == 1  # by the times, whichever is longer
    axis = fitting[0] if is_told else _time_axis(path, matrix, how)
    labels = _labels(contents, matrix, matrix.shape[1 - axis])
    numbers = range(matrix.shape[1 - axis])
    time_number = _time_number(how, labels, len(numbers))
    if how.channels is None:
        rows = [number for number in numbers if number != time_number]
    else:
        rows = [_number(wanted, labels, len(numbers)) for wanted in how.channels]
    samples = MatrixSamples(matrix, axis, None if rows == list(numbers) else rows)
    names = None if labels is None else tuple(labels[row] for row in rows)
    if time_number is None:
        times = _times(several, matrix.shape[axis], how, contents)
    else:
        unit = unit_of_time_name(labels[time_number]) if labels is not None else None
        times = ArrayTimes(MatrixColumn(matrix, axis, time_number), unit or how.time_unit)
    return Opened(samples, None, names, times, _rate(contents, matrix))


def _time_axis(path: str | os.PathLike[str], matrix: Array, how: Reading) -> int:
    shape = (matrix.shape[0], matrix.shape[1])
    try:
        return 0 if is_time_first(shape, how, path, repr(matrix.name)) else 1
    except ValueError as error:
        raise Refused(str(error).removeprefix(f"{os.fspath(path)}: ")) from None


def _of_columns(
    columns: Sequence[Array], several: Sequence[Array], contents: Contents, how: Reading
) -> Opened:
    """Columns that stand alone; by number they are counted as the file has them."""
    counted = contents.columns or [array.name for array in several if _is_column(array)]
    is_there = isinstance(how.time, int) and 0 <= how.time < len(counted)
    time = counted[how.time] if isinstance(how.time, int) and is_there else None
    if how.channels is None:
        chosen = [column for column in columns if column.name != time]
    else:
        chosen = [_column(wanted, columns, counted, contents) for wanted in how.channels]
    if not chosen:
        raise Refused("holds no column but the times; say reading.time=null if it is none")
    if len({max(column.shape) for column in chosen}) > 1:
        raise Refused(f"holds columns of several lengths, {_listed(chosen)}; say reading.channels")
    leaves = [column.leaf for column in chosen]
    are_unique = len(set(leaves)) == len(leaves)
    names = tuple(leaves if are_unique else [column.name for column in chosen])
    length = max(chosen[0].shape)
    if isinstance(how.time, int):
        there = [array for array in several if array.name == time]
        if not there:
            raise Refused(f"has no column {how.time} of times, it has {len(counted)}")
        times: ArrayTimes | None = _as_times(there[0], length, how)
    else:
        times = _times(several, length, how, contents)
    return Opened(ColumnSamples(chosen), None, names, times, _rate(contents, chosen[0]))


def _times(
    several: Sequence[Array], length: int, how: Reading, contents: Contents
) -> ArrayTimes | None:
    """The times that were named, or what is called so and has this length."""
    if how.time is None or isinstance(how.time, int):
        return None
    if how.time != "auto":
        return _as_times(_named(how.time, several, contents)[0], length, how)
    called = [array for array in several if _is_time(array, how) and max(array.shape) == length]
    return _as_times(called[0], length, how) if called else None


def _as_times(array: Array, length: int, how: Reading) -> ArrayTimes:
    if not _is_column(array) or max(array.shape) != length:
        raise Refused(f"has times {_listed([array])} for {length} samples")
    unit = array.time_unit or unit_of_time_name(array.leaf) or how.time_unit
    return ArrayTimes(array, unit)


def _time_number(how: Reading, labels: Sequence[str] | None, count: int) -> int | None:
    """Of the channel of an array that holds times, if one does."""
    if how.time == "auto":
        called = (place for place, label in enumerate(labels or ()) if is_time_name(label))
        return next(called, None)
    if how.time is None or (isinstance(how.time, str) and how.time not in (labels or ())):
        return None
    return _number(how.time, labels, count)


def _number(wanted: str | int, labels: Sequence[str] | None, count: int) -> int:
    """The place of a channel in an array."""
    if isinstance(wanted, str) and labels is not None and wanted in labels:
        return labels.index(wanted)
    if isinstance(wanted, str) or not 0 <= wanted < count:
        known = f"columns 0 to {count - 1}" if labels is None else ", ".join(map(repr, labels))
        raise Refused(f"has no column {wanted!r} in its samples; it has {known}")
    return wanted


def _column(
    wanted: str | int, columns: Sequence[Array], counted: Sequence[str], contents: Contents
) -> Array:
    if isinstance(wanted, str):
        return _named(wanted, columns, contents)[0]
    if not 0 <= wanted < len(counted):
        raise Refused(f"has no column {wanted}; it has {len(counted)}")
    return _named(counted[wanted], columns, contents)[0]


def _named(wanted: str, arrays: Sequence[Array], contents: Contents) -> list[Array]:
    """The array of that name, or those of that group; else what is only called so at its end."""
    plain = wanted.strip("/")
    for exact in (True, False):
        names = [array.name.strip("/") if exact else array.leaf for array in arrays]
        found = [a for a, name in zip(arrays, names, strict=True) if name == plain]
        if len(found) == 1:
            return found
    groups = (f"{plain}/", f"{plain}.")
    if inside := [array for array in arrays if array.name.strip("/").startswith(groups)]:
        return inside
    for name, why in contents.refused.items():
        if name.strip("/") == plain:
            raise Refused(f"cannot be read at {name!r}: it {why}")
    raise Refused(f"has no {wanted!r} of numbers; it has {_listed(arrays) or 'none'}")


def _names_columns(channels: Sequence[str | int] | None, columns: Iterable[Array]) -> bool:
    known = {name for column in columns for name in (column.name, column.leaf)}
    return channels is not None and all(channel in known for channel in channels)


def _is_column(array: Array) -> bool:
    return sum(length > 1 for length in array.shape) < 2


def _is_time(array: Array, how: Reading) -> bool:
    """Whether these are times: named so by somebody, or by name or type."""
    if how.time == "auto":
        return is_time_name(array.leaf) or array.time_unit is not None
    is_named = isinstance(how.time, str) and how.time.strip("/") in (
        array.name.strip("/"),
        array.leaf,
    )
    return is_named or array.time_unit is not None


def _labels(contents: Contents, array: Array, count: int) -> tuple[str, ...] | None:
    """Names of as many channels, if the file has them."""
    fitting = (labels for labels in contents.labels(array.name) if len(labels) == count)
    return next((labels for labels in fitting if len(set(labels)) == count), None)


def _rate(contents: Contents, array: Array) -> float | None:
    """The rate said nearest to the samples: of them, around them, or by a number of that name."""
    for said in contents.facts(array.name):
        lower = {name.lower(): value for name, value in said.items()}
        for name in RATE_NAMES:
            if 0 < lower.get(name, 0) < math.inf:
                return lower[name]
    single = [one for one in contents.arrays if math.prod(one.shape) == 1]
    single.sort(key=lambda one: -len(os.path.commonprefix([one.name, array.name])))
    for name in RATE_NAMES:
        for one in single:
            value = float(one.read(0, 0, 1).reshape(-1)[0]) if one.leaf.lower() == name else 0.0
            if 0 < value < math.inf:
                return value
    return None


def _listed(arrays: Sequence[Array]) -> str:
    shapes = [f"{a.name!r} {' by '.join(map(str, a.shape))}" for a in arrays]
    more = len(shapes) - _MOST_NAMED
    return ", ".join(shapes[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _reasons(contents: Contents) -> str:
    said = [f"{name!r} {why}" for name, why in contents.refused.items()][:3]
    return f" ({'; '.join(said)})" if said else ""
