"""Which columns of a table are samples and which holds the times, by what a person says of it."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from tactslip_torch.data.formats.reading import SECONDS, TIME_NAMES, Reading, TimeUnit

_NAME_AND_UNIT = re.compile(r"(.*?)[\s_/(\[]+(s|ms|us|ns)[)\]]?")  # "Time (ms)", "t_us", "t/s"
_MOST_NAMED = 20  # in a message


class Columns(NamedTuple):
    """Positions in a table.

    Args:
        time: of the times, if there are any.
        seconds: what one of their units is.
        channels: of the samples, in the order of the hand.
    """

    time: int | None
    seconds: float
    channels: tuple[int, ...]


def chosen_columns(
    path: str | os.PathLike[str],
    names: Sequence[str] | None,
    num_columns: int,
    how: Reading,
    is_count: Callable[[int], bool] = lambda place: False,
) -> Columns:
    """The columns that ``how`` asks for; a name such as ``time_ms`` goes before its unit.

    If it does not say which hold samples, all do but times, further times, and the number of the
    row that some libraries write before the others without a name.

    Args:
        path: of the file, for messages.
        names: of all columns, if the file says.
        num_columns: how many there are.
        how: what a person says of the file.
        is_count: whether the column there rises by one from row to row.

    Raises:
        ValueError: if there is no such column, or none is left for samples.
    """
    if how.time == "auto":
        time = _likely_time(names, num_columns, how)
    else:
        time = None if how.time is None else _position(path, names, num_columns, how.time, "time")
    if how.channels is None:
        channels = tuple(
            place
            for place in range(num_columns)
            if place != time and not _is_beside(names, place, time, is_count)
        )
    else:
        channels = tuple(
            _position(path, names, num_columns, one, "channels") for one in how.channels
        )
    if not channels:
        raise ValueError(
            f"{os.fspath(path)} has one column, and it is taken for times; say reading.time=null "
            "and reading.sample_rate_hz if it holds samples"
        )
    unit = unit_of_time_name(names[time]) if names is not None and time is not None else None
    return Columns(time, SECONDS[unit or how.time_unit], channels)


def _likely_time(names: Sequence[str] | None, num_columns: int, how: Reading) -> int | None:
    if names is None:
        return 0 if how.sample_rate_hz is None and num_columns > 1 else None
    return next((place for place, name in enumerate(names) if is_time_name(name)), None)


def _is_beside(
    names: Sequence[str] | None, place: int, time: int | None, is_count: Callable[[int], bool]
) -> bool:
    """Whether a column is none of samples: times in another unit, or the number of the row."""
    if names is None:
        return False
    is_nameless = names[place] in ("", f"column {place}", f"Unnamed: {place}")
    return (time is not None and is_time_name(names[place])) or (is_nameless and is_count(place))


def is_time_name(name: str) -> bool:
    """Whether something called so is taken for times: ``t``, ``Timestamp``, ``time (ms)``."""
    plain = name.strip().lower()
    found = _NAME_AND_UNIT.fullmatch(plain)
    return plain in TIME_NAMES or (found is not None and found[1] in TIME_NAMES)


def unit_of_time_name(name: str) -> TimeUnit | None:
    """The unit a time's name ends in, if it has one."""
    found = _NAME_AND_UNIT.fullmatch(name.strip().lower())
    if found is None or not is_time_name(name) or found[1] not in TIME_NAMES:
        return None
    return next(unit for unit in SECONDS if unit == found[2])


def _position(
    path: str | os.PathLike[str],
    names: Sequence[str] | None,
    num_columns: int,
    wanted: str | int,
    what: str,
) -> int:
    if isinstance(wanted, int):
        if 0 <= wanted < num_columns:
            return wanted
        there = f"{num_columns} columns, 0 to {num_columns - 1}"
    elif names is None:
        there = f"{num_columns} columns without names, 0 to {num_columns - 1}"
    elif wanted in names:
        return list(names).index(wanted)
    else:
        more = ", ..." if len(names) > _MOST_NAMED else ""
        there = ", ".join(repr(name) for name in names[:_MOST_NAMED]) + more
    raise ValueError(
        f"{os.fspath(path)} has no column {wanted!r} that reading.{what} names; it has {there}"
    )
