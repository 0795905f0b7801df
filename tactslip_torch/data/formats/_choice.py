"""Which numbers of other people's files are samples, and which are times."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from tactslip_torch.data.formats._names import (
    CHANNEL_LISTS,
    RATES,
    TimeUnit,
    is_time,
    no_channels,
    time_unit_in,
)
from tactslip_torch.data.formats._reading import Opened, Reading, Refused, Samples

_MOST_NAMED = 8  # in a message
_NOT_NUMBERS = {"b": "true or false", "c": "complex numbers", "V": "compound values"}
_NOT_NUMBERS |= {"O": "objects or text", "S": "text", "U": "text"}


@dataclass(frozen=True)
class Array:
    """Numbers of no more than two dimensions in an open file.

    Args:
        name: in full, as people of the format write it: ``/group/volts``, ``trial.volts``.
        values: have ``shape`` and ``dtype`` and are sliced as NumPy's are.
        leaf: the last part of the name.
        labels: words that may name its channels, the likeliest first.
        sample_rate_hz: if the file says it of this array.
    """

    name: str
    values: Any
    leaf: str
    labels: Sequence[tuple[str, ...]] = ()
    sample_rate_hz: float | None = None

    @property
    def length(self) -> int:
        """Of the longest axis."""
        return int(max(self.values.shape))

    @property
    def is_column(self) -> bool:
        """Whether no more than one axis is longer than 1."""
        return len([length for length in self.values.shape if length > 1]) < 2


def why_not_numbers(dtype: np.dtype[Any], shape: Sequence[int] | None) -> str | None:
    """The reason why values are no samples, if there is one."""
    if dtype.kind not in "iuf" or dtype.itemsize > 8:
        return f"holds {_NOT_NUMBERS.get(dtype.kind, str(dtype))}"
    if shape is None or len(shape) > 2:
        return "is empty" if shape is None else f"has {len(shape)} dimensions"
    return None


def rate_in(numbers: Mapping[str, float]) -> float | None:
    """The sample rate among numbers by name, if one is called so."""
    lower = {name.lower(): value for name, value in numbers.items()}
    return next((lower[n] for n in RATES if 0 < lower.get(n, 0) < math.inf), None)


def unit_of_time(name: str | None, how: Reading) -> TimeUnit:
    """The unit that is said, else the one a time's name ends in, else seconds."""
    return how.time_unit or time_unit_in(name) or "s"


# Columns of one table ---------------------------------------------------------------------------


def chosen_columns(
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    others: Iterable[int] = (),
    stamps: Sequence[int] = (),
) -> tuple[int | None, list[int]]:
    """The place of the column of times, if there is one, and those of the channels.

    If ``how`` does not say which hold samples, all do but ``others`` and those that are called as
    times, labels or book-keeping are.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        others: columns that are no channels unless a person says so.
        stamps: columns that hold times by their type.

    Raises:
        Refused: if there is no such column, or none is left for samples.
    """
    called = [place for place, name in enumerate(names or ()) if is_time(name)]
    called = sorted({*called, *stamps})
    time: int | None = None
    if how.time == "auto":
        time = called[0] if called else None
    elif how.time is not None:
        time = _position(names, num_columns, how.time, "time")
    if how.channels is not None:
        return time, [_position(names, num_columns, one, "channels") for one in how.channels]
    speed = None if how.speed is None else _position(names, num_columns, how.speed, "speed")
    beside = {time, speed, *others, *stamps, *no_channels(names or (), how.hand)}
    channels = [place for place in range(num_columns) if place not in beside]
    if not channels:
        which = f"{_some(list(map(repr, names)))} is" if names else "its only column is"
        raise Refused(
            f"has no column of samples: {which} taken for times, a label or book-keeping; if one "
            "is a channel, list it as reading.channels and say reading.sample_rate_hz"
        )
    return time, channels


def opened_columns(
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    samples: Callable[[list[int]], Samples],
    others: Iterable[int] = (),
    stamps: Mapping[int, TimeUnit] = MappingProxyType({}),
    units: Mapping[int, TimeUnit] = MappingProxyType({}),
) -> Opened:
    """A table as an open file: its channels, and the columns of times and of speed.

    Args:
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        samples: reads columns by their places.
        others: columns that are no channels unless a person says so.
        stamps: units of columns that hold times by their type.
        units: that a line of units says of columns, if they hold times.

    Raises:
        Refused: as ``chosen_columns``.
    """
    time, rows = chosen_columns(names, num_columns, how, others, tuple(stamps))
    opened = Opened(samples(rows))
    speed = None if how.speed is None else _position(names, num_columns, how.speed, "speed")
    if speed is not None:
        opened = opened._replace(speed=samples([speed]))
    if names is not None:
        rest = [] if how.channels else sorted({*range(num_columns)} - {*rows, *stamps, time, speed})
        chosen, left_out = (tuple(names[place] for place in places) for places in (rows, rest))
        opened = opened._replace(names=chosen, left_out=left_out)
    if time is None:
        return opened
    said = how.time_unit or time_unit_in(names[time] if names else None) or units.get(time)
    return opened._replace(stamps=samples([time]), time_unit=stamps.get(time, said))


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


# Arrays of a file -------------------------------------------------------------------------------


def choose(
    path: str | os.PathLike[str],
    found: Mapping[str, Any],
    how: Reading,
    separator: str = "/",
    said: Callable[[Any], tuple[list[tuple[str, ...]], float | None]] = lambda _: ([], None),
) -> Opened:
    """The samples of a file: its only array of two dimensions, or all columns of one length.

    What ``how`` names goes first: ``samples`` an array or a group, ``channels`` columns, ``time``
    an array or a column. Single numbers are no samples.

    Args:
        path: of the file.
        found: everything in it by name: an array of numbers, a tuple of words, or the text why it
            is neither.
        how: what a person says of the file.
        separator: between the parts of a name.
        said: what attributes say of an array: words that may name its channels, and its rate.

    Raises:
        Refused: in one line that names what could be meant, if that is none or several.
    """
    words = {name: kept for name, kept in found.items() if isinstance(kept, tuple)}
    refused = {name: kept for name, kept in found.items() if isinstance(kept, str)}
    arrays = []
    for name, kept in found.items():
        if not isinstance(kept, tuple | str):
            labels, rate = said(kept)
            labels += _labels_near(name, words, separator)
            arrays.append(Array(name, kept, name.rpartition(separator)[2], labels, rate))
    several = [array for array in arrays if math.prod(array.values.shape) > 1]
    within = several if how.samples is None else _named(how.samples, several, refused)
    columns = [array for array in several if array.is_column]  # which numbers count
    matrices = [array for array in within if not array.is_column]
    called = {word for array in columns if array in within for word in (array.name, array.leaf)}
    is_matrix = bool(matrices) and (how.channels is None or not called.issuperset(how.channels))

    def apart(wanted: str | int, what: str) -> Sequence[Array]:
        """Arrays that are not the samples; none of what is a column of a matrix."""
        if isinstance(wanted, int):
            is_there = columns and not is_matrix
            return [columns[_position(None, len(columns), wanted, what)]] if is_there else []
        if is_matrix and any(wanted in labels for array in several for labels in array.labels):
            return []
        return _named(wanted, several, refused)

    times = [] if how.time in (None, "auto") else apart(how.time, "time")
    if how.time == "auto":
        times = [array for array in columns if is_time(array.leaf)]
    speeds = [] if how.speed is None else apart(how.speed, "speed")
    how = replace(how, speed=None) if speeds else how  # of the columns
    singles = [array for array in columns if array in within]
    passed: list[Array] = []
    if how.channels is None:
        singles = [array for array in singles if array not in (*times, *speeds)]
        if len(within) > 1 or how.samples is None:
            places = no_channels([array.leaf for array in singles], how.hand)
            passed = [singles[place] for place in places]
            singles = [array for array in singles if array not in passed]
    cubes = [name for name, why in refused.items() if why.endswith(" dimensions")]
    if cubes and how.samples is None and how.channels is None:
        raise Refused(
            f"holds {cubes[0]!r}, which {refused[cubes[0]]}; a recording has 2, channels and time: "
            "cut windows are no recording (SlipClassifier takes them), else say reading.samples"
        )
    if is_matrix:
        if len(matrices) > 1:
            raise Refused(f"holds several arrays, {_listed(matrices)}; say reading.samples")
        opened, near = _of_matrix(path, matrices[0], times, how), matrices[0]
    elif singles:
        opened, near = _of_columns(path, singles, columns, how)
    else:
        named = {array.name: "is a label or book-keeping by its name" for array in passed}
        whys = "; ".join([f"{name!r} {why}" for name, why in (refused | named).items()][:3])
        reasons = f" ({whys})" if whys else " but times" if times else ""
        raise Refused(f"holds no samples{reasons}; say reading.samples if it does")
    length = opened.samples.num_samples
    fitting = [a for a in times if a.is_column and a.length == length]
    if opened.stamps is None and fitting:
        unit = how.time_unit or time_unit_in(fitting[0].leaf)
        opened = opened._replace(stamps=Samples(path, [fitting[0].values]), time_unit=unit)
    elif opened.stamps is None and times and how.time != "auto":
        raise Refused(f"has times {_listed(times)} for {length} samples; say reading.time")
    if speeds:
        if not speeds[0].is_column or speeds[0].length != length:
            raise Refused(f"has speeds {_listed(speeds)} for {length} samples; say reading.speed")
        opened = opened._replace(speed=Samples(path, [speeds[0].values]))
    rate = near.sample_rate_hz or _single_rate(arrays, near.name)
    beside = tuple(array.name for array in passed if array.length == length)
    return opened._replace(sample_rate_hz=rate, left_out=(*opened.left_out, *beside))


def _of_matrix(
    path: str | os.PathLike[str], matrix: Array, times: Sequence[Array], how: Reading
) -> Opened:
    axis = _time_axis(matrix, {array.length for array in times}, how)
    count = matrix.values.shape[1 - axis]
    fitting = (labels for labels in matrix.labels if len(labels) == len(set(labels)) == count)
    labels = next(fitting, None)
    is_elsewhere = bool(times) and how.time != "auto"
    how = replace(how, time=None) if is_elsewhere else how

    def samples(rows: list[int]) -> Samples:
        return Samples(path, matrix.values, axis, None if rows == list(range(count)) else rows)

    return opened_columns(labels, count, how, samples)


def _time_axis(matrix: Array, lengths: set[int], how: Reading) -> int:
    """The axis that is said, or as long as the times, or the longer one."""
    if how.time_first is not None:
        return 0 if how.time_first else 1
    rows, columns = matrix.values.shape
    if (rows in lengths) != (columns in lengths):
        return 0 if rows in lengths else 1
    if rows == columns:
        raise Refused(
            f"holds {matrix.name!r} of {rows} by {columns}, so it does not show which axis is "
            "time; say reading.time_first=true or false"
        )
    return 0 if rows > columns else 1


def _of_columns(
    path: str | os.PathLike[str], singles: Sequence[Array], columns: Sequence[Array], how: Reading
) -> tuple[Opened, Array]:
    """Arrays of one column each, and the first of them; numbers count all such of the file."""
    chosen = list(singles)
    if how.channels is not None:
        chosen = [
            columns[_position(None, len(columns), wanted, "channels")]
            if isinstance(wanted, int)
            else _named(wanted, singles, {})[0]
            for wanted in how.channels
        ]
    if len({column.length for column in chosen}) > 1:
        raise Refused(f"holds columns of several lengths, {_listed(chosen)}; say reading.channels")
    names = tuple(column.leaf for column in chosen)
    if len(set(names)) < len(names):
        names = tuple(column.name for column in chosen)
    return Opened(Samples(path, [column.values for column in chosen]), names=names), chosen[0]


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


def _listed(arrays: Sequence[Array]) -> str:
    return _some([f"{a.name!r} {' by '.join(map(str, a.values.shape))}" for a in arrays])


def _single_rate(arrays: Sequence[Array], name: str) -> float | None:
    """A rate that is an array of one number, the nearest to the samples by its name."""
    single = [a for a in arrays if math.prod(a.values.shape) == 1]
    single = [a for a in single if a.leaf.lower() in RATES]
    single.sort(key=lambda one: len(os.path.commonprefix([one.name, name])))
    return rate_in({one.leaf: float(np.ravel(one.values[()])[0]) for one in single})


def _labels_near(
    name: str, words: Mapping[str, tuple[str, ...]], separator: str
) -> list[tuple[str, ...]]:
    """The words of a file that may name the channels of an array, those beside it first."""
    group = name.rpartition(separator)[0]
    called = [at for at in words if at.rpartition(separator)[2].lower() in CHANNEL_LISTS]
    return [words[at] for at in sorted(called, key=lambda at: at.rpartition(separator)[0] != group)]
