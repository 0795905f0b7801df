"""What names and units in files mean: the one table by which columns, arrays and fields are read.

A name is compared in small letters, without the unit in brackets behind it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Literal

# Times ------------------------------------------------------------------------------------------

TimeUnit = Literal["s", "ms", "us", "ns"]
SECONDS: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SPELLINGS: dict[TimeUnit, str] = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millis millisecond milliseconds",
    "us": "us usec usecs micros microsecond microseconds \N{MICRO SIGN}s",
    "ns": "ns nsec nsecs nanos nanosecond nanoseconds",
}
_UNITS = {word.casefold(): unit for unit, words in _SPELLINGS.items() for word in words.split()}
_LONG = [word for word in _UNITS if len(word) > 5]  # a column of that name is of times
_UNIT_OF_TIME = "|".join(sorted(_UNITS, key=len, reverse=True))
_TIME_NAME = re.compile(  # "Time (ms)", "t_us", "t/s", "timestamps", "%time", "header.stamp"
    r"%?(?:field\.)?(?:header\.)?(?:(?:time|t|timestamps?|stamp|time_stamp|elapsed(?:[ _]time)?)"
    rf"(?:[\s_/(\[]+({_UNIT_OF_TIME})[)\]]?)?|({'|'.join(_LONG)}))"
)
EPOCH_S = 1e9, 4e9
"""Seconds since 1970, of 2001 to 2096: stamps that lie there in a unit are taken as of that unit,
where neither a person nor the file says it."""


def is_time(name: str) -> bool:
    """Whether a column of that name holds times."""
    return _TIME_NAME.fullmatch(name.strip().casefold()) is not None


def time_unit_in(name: str | None) -> TimeUnit | None:
    """The unit that a name of times ends in, or that a cell in a line of units is."""
    word = (name or "").strip().casefold()
    found = _TIME_NAME.fullmatch(word)
    return _UNITS.get((found[1] or found[2] or "") if found else word.strip("()[] "))


def epoch_unit(stamp: float) -> TimeUnit | None:
    """The unit in which a stamp counts from 1970, if it does."""
    least, most = EPOCH_S
    return next((unit for unit, s in SECONDS.items() if least <= stamp * s < most), None)


# What is no channel ------------------------------------------------------------------------------


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


LABELS = _words(
    "label labels slip is_slip slip_label slipping is_slipping contact trial material class "
    "target targets ground_truth annotation speed slip_speed"
)
"""Columns that may be what a detector is to find out."""
BOOK_KEEPING = _words(
    "frame frame_id frame_index frame_number index idx row row_index row_number seq sequence "
    "sequence_number sample sample_index sample_number counter packet packet_number episode "
    "episode_index task_index"
)
"""Columns that count or tell where a row is from."""
_FINGERS = _words("thumb middle ring little pinky")  # beside them "index" is a finger
_PANDAS_INDEX = re.compile(r"__index_level_\d+__")
_BRACKETS = re.compile(r"\s*(?:\([^()]*\)|\[[^\[\]]*\])$")


def bare(name: str) -> str:
    """A name without its case and the unit behind it: ``"G1 (mV)"`` is ``"g1"``."""
    return _BRACKETS.sub("", name.strip()).casefold()


def no_channels(names: Sequence[str], kept: Iterable[str] = ()) -> list[int]:
    """Places of names of times, labels and book-keeping, but for those that are ``kept``."""
    plain = [bare(name) for name in names]
    words = [re.sub(r"[\s_-]+", "_", name.removeprefix("field.header.")) for name in plain]
    beside = LABELS | BOOK_KEEPING - ({"index"} if _FINGERS.intersection(words) else set())
    asked = set(map(bare, kept))

    def is_channel(place: int) -> bool:
        name, word = plain[place], words[place].removeprefix("header.")
        of_times = is_time(names[place]) or (is_time(name) and name != "t")  # T (degC) is none
        return not (of_times or word in beside or _PANDAS_INDEX.fullmatch(name))

    return [n for n, name in enumerate(plain) if name not in asked and not is_channel(n)]


# Other names and numbers --------------------------------------------------------------------------

CHANNEL_LISTS = ("channel_name", "channel_names", "channels", "columns", "labels")
"""Words that name the channels of an array are called so."""
RATES = ("sample_rate_hz", "sample_rate", "sampling_rate", "samplingrate", "fs", "rate")
UNIT_CELL = re.compile(
    rf"[(\[].*[)\]]|-?|{_UNIT_OF_TIME}|[muµk]?V|[mk]?N|[kM]?Pa|mm|counts?|[kM]?Hz", re.IGNORECASE
)
"""A cell in a line of units, below the names of columns."""
NUMBER = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity|\d\.?#(ind|q?s?nan|inf)\d*)",
    re.IGNORECASE | re.ASCII,
)
"""A number as text; Microsoft's libraries write NaN as ``-1.#IND`` and infinity as ``1.#INF``."""


def number_in(cell: str) -> float:
    """The number that ``NUMBER`` matches; of an empty cell NaN."""
    if "#" not in cell:
        return float(cell or "nan")
    return float(f"{cell[0] if cell[0] in '+-' else ''}{'inf' if 'inf' in cell.lower() else 'nan'}")
