"""What is inferred of foreign files: units, times, columns that are no channels, layout of text.

The one table of names and units by which columns, arrays and fields are read, and the separator,
decimal mark, header and first row of a text table. A name is compared in small letters, without
the unit in brackets behind it.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Literal, NamedTuple


class Refused(ValueError):
    """A file that cannot be read as it is meant: a line for people that says all."""


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
_EPOCH_S = 1e9, 4e9
"""Seconds since 1970, of 2001 to 2096: stamps that lie there in a unit are taken as of that unit,
where neither a person nor the file says it."""


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def is_time(name: str) -> bool:
    """Whether a column of that name holds times."""
    return _TIME_NAME.fullmatch(name.strip().casefold()) is not None


def time_unit_in(name: str | None) -> TimeUnit | None:
    """The unit that a name of times ends in, or that a cell in a line of units is."""
    word = (name or "").strip().casefold()
    found = _TIME_NAME.fullmatch(word)
    return _UNITS.get((found[1] or found[2] or "") if found else word.strip("()[] "))


_PAIR = re.compile(r"(.*?)(secs?|seconds)"), re.compile(r"(.*?)(n(?:ano)?secs?|nanoseconds)")


def seconds_and_nanoseconds(names: Sequence[str]) -> tuple[int, ...]:
    """The places of two columns that are one time, whole seconds and the nanoseconds beyond.

    Example:
        >>> seconds_and_nanoseconds(("a", "stamp.sec", "stamp.nanosec"))
        (1, 2)
    """
    words = [name.strip().casefold() for name in names]
    of_seconds, of_rest = (
        {found[1]: n for n, word in enumerate(words) if (found := pattern.fullmatch(word))}
        for pattern in _PAIR
    )
    pairs = ((of_seconds[stem], of_rest[stem]) for stem in of_seconds if stem in of_rest)
    return next(pairs, ())


_STAMP = re.compile(r"\d{4}([-/])\d\d\1\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?(Z|[+-]\d\d:?\d\d)?")


def microseconds_in(cell: str) -> float | None:
    """A date and time as ISO 8601 writes it, in microseconds since 1970; ``None`` of other text.

    Example:
        >>> microseconds_in("1970-01-01T00:00:01.5Z"), microseconds_in("12:00")
        (1500000.0, None)
    """
    if _STAMP.fullmatch(cell) is None:
        return None
    whole, _, fraction = cell.replace(",", ".").replace("/", "-").partition(".")
    digits = re.match(r"\d*", fraction)[0]  # type: ignore[index]  # matches always
    try:
        moment = datetime.fromisoformat(whole + fraction[len(digits) :])
    except ValueError:  # the 31st of February
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    return (moment - _EPOCH) // timedelta(seconds=1) * 1e6 + float(f"0.{digits or 0}") * 1e6


def epoch_unit(stamp: float) -> TimeUnit | None:
    """The unit in which a stamp counts from 1970, if it does."""
    least, most = _EPOCH_S
    return next((unit for unit, s in SECONDS.items() if least <= stamp * s < most), None)


# What is no channel ------------------------------------------------------------------------------


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_LABELS = _words(
    "label labels slip is_slip slip_label slipping is_slipping contact trial material class "
    "target targets ground_truth annotation speed slip_speed"
)
"""Columns that may be what a detector is to find out."""
_BOOK_KEEPING = _words(
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
    beside = _LABELS | _BOOK_KEEPING - ({"index"} if _FINGERS.intersection(words) else set())
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


def rate_in(numbers: Mapping[str, float]) -> float | None:
    """The sample rate among numbers by name, if one is called so."""
    lower = {name.lower(): value for name, value in numbers.items()}
    return next((lower[n] for n in RATES if 0 < lower.get(n, 0) < math.inf), None)


_UNIT_CELL = re.compile(
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


# Layout of text ----------------------------------------------------------------------------------

HEAD = 2**20
"""Characters in which the first row of a table must be found, and the most of a line."""
_TO_COUNT = 1024  # rows that show whether a first line numbers the columns
_NO_THOUSANDS = re.compile(r",\d{0,2}(?!\d)|,\d{4}|(?<!\d)0,|\d{4},|(?<!\d),")
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*")
_WHOLE = re.compile(r"[+-]?\d+")
_DIGITS = re.compile(r"[+-]?[\d.,]*\d[\d.,]*(e[+-]?\d+)?", re.IGNORECASE)
_BLANKS = " "
_WITH_COMMAS = ("\t", ";")  # between columns whose decimals may stand behind a comma


class TextLayout(NamedTuple):
    """How the rows of a text table are written.

    Args:
        first_line: the number of the first row's line, from 1.
        delimiter: between columns; a blank stands for any number of blanks and tabs.
        num_columns: of each row.
        names: of the columns, if the file has them.
        has_tail: whether rows end in a delimiter behind their last column.
        has_commas: whether decimals stand behind a comma.
        units: of the columns, from a line below their names.
        is_time_empty: whether the first column is for times and holds none, as LabVIEW has it.
        sample_rate_hz: if headings of LabVIEW state it.
    """

    first_line: int
    delimiter: str
    num_columns: int
    names: tuple[str, ...] | None = None
    has_tail: bool = False
    has_commas: bool = False
    units: tuple[str, ...] = ()
    is_time_empty: bool = False
    sample_rate_hz: float | None = None

    @property
    def is_unnamed(self) -> bool:
        """Whether columns have no names, or only numbers, as pandas writes them."""
        return self.names is None or self.names == _numbering(self.num_columns)


def text_layout(head: str, delimiter: str | None = None) -> TextLayout:
    """The layout of a table, from its first characters.

    The first line whose cells are all numbers is the first row; where there is none, the first of
    two lines that have numbers in the same cells and words in the others. Names are in the nearest
    line above that is no line of units, or in the last comment, where ``numpy.savetxt`` puts them.

    Args:
        head: the first ``HEAD`` characters, or all.
        delimiter: between columns, if it is known.

    Raises:
        Refused: if it has no row of numbers, or a header of other columns.
    """
    if "\0" in head:
        raise Refused("holds NUL bytes, so it is no text; save it as UTF-8")
    lines = head.split("\n")
    if len(head) == HEAD:
        lines.pop()  # cut
    is_lvm = head.startswith("LabVIEW Measurement")
    bare_lines = list(map(without_comment, lines))
    marks = [delimiter] if delimiter else [*"\t;,", _BLANKS]

    def split(place: int) -> Iterator[tuple[str, list[str]]]:
        """The cells of a line by each delimiter that is in it."""
        for mark in marks:
            if mark in bare_lines[place] or mark in (_BLANKS, delimiter):
                yield mark, cells_of(bare_lines[place], mark)

    rows = (
        (place, mark)
        for place in range(len(lines))
        for mark, cells in split(place)
        if _is_row(cells, mark, is_lvm)
    )
    place, mark = next(rows, None) or _row_with_words(map(split, range(len(lines))))
    above = [n for n in range(place) if bare_lines[n].strip()]
    num_columns = len(cells_of(bare_lines[place], mark))
    while above and _has_words(cells_of(bare_lines[above[-1]], mark), mark, num_columns):
        place = above.pop()  # rows too, some cells of which are no numbers
    below = [n for n in range(place + 1, len(lines)) if bare_lines[n].strip()]
    rest = [cells_of(bare_lines[n], mark) for n in below[:_TO_COUNT]]
    if not above and _numbers_columns(cells_of(bare_lines[place], mark), rest):
        place = below[0]
    headings = [(n + 1, lines[n]) for n in range(place) if lines[n].strip()]
    return _named(_of_rows(bare_lines[place:], place + 1, mark), headings, is_lvm)


def without_comment(line: str) -> str:
    """A line without what a ``#`` at its start or behind a blank begins."""
    return _COMMENT.sub("", line) if "#" in line else line


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line, quotes and blanks around them taken off."""
    if delimiter == _BLANKS:
        line = " ".join(line.split())
    try:
        rows = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
        return [cell.strip() for cell in next(rows, [""])] or [""]
    except csv.Error:  # a cell of more than 128 KiB
        return [line]


def wrong_line(line: int, what: str) -> Refused:
    """What is wrong in a line of a text, counted from 1."""
    return Refused(f"is wrong in line {line}: {what}")


def quoted(cell: str) -> str:
    """A cell as messages show it."""
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def _is_row(cells: Sequence[str], delimiter: str, is_lvm: bool) -> bool:
    """Whether cells are numbers, the first of them there; of others some may be missing."""
    if not cells[0] and not is_lvm:
        return False
    return any(cells) and all(not cell or _is_number(cell, delimiter) for cell in cells)


def _is_number(cell: str, delimiter: str) -> bool:
    """Whether a cell is a number, with a decimal comma where columns are not separated by one."""
    plain = cell.replace(",", ".", 1) if delimiter in _WITH_COMMAS else cell
    return NUMBER.fullmatch(plain) is not None


def _row_with_words(lines: Iterable[Iterable[tuple[str, list[str]]]]) -> tuple[int, str]:
    """The first of two lines that have numbers in the same cells and words in all others."""
    before: dict[str, list[bool]] = {}
    for place, cells_by_mark in enumerate(lines):
        shapes = {mark: [_is_number(c, mark) for c in cells] for mark, cells in cells_by_mark}
        for mark, shape in shapes.items():
            if any(shape) and len(shape) > 1 and before.get(mark) == shape:
                return place - 1, mark
        before = shapes
    raise Refused(
        f"holds no row of numbers in its first {HEAD >> 20} MiB; it must be a table of numbers"
    )


def _has_words(cells: Sequence[str], delimiter: str, num_columns: int) -> bool:
    """Whether cells above a row are one as well: a number or a stamp first, and words."""
    if len(cells) != num_columns or num_columns == 1:
        return False
    return _is_number(cells[0], delimiter) or microseconds_in(cells[0]) is not None


def _numbering(num_columns: int) -> tuple[str, ...]:
    return tuple(map(str, range(num_columns)))


def _numbers_columns(first: Sequence[str], rest: Sequence[Sequence[str]]) -> bool:
    """Whether the first of all lines counts the columns from 0, and is no row.

    It is none if the numbers below are written otherwise, 1.0 where it has 1, or are far from its.
    """
    if len(first) < 2 or tuple(first) != _numbering(len(first)) or len(rest) < 3:
        return False
    if any(len(cells) != len(first) for cells in rest):
        return False
    columns = [[c.replace(",", ".") for c in column if c] for column in zip(*rest, strict=True)]
    are_whole = [{_WHOLE.fullmatch(cell) is not None for cell in column} for column in columns]
    if any(len(kinds) > 1 for kinds in are_whole):
        return False
    for number, (column, kinds) in enumerate(zip(columns, are_whole, strict=True)):
        numbers = map(number_in, filter(NUMBER.fullmatch, column))
        values = [value for value in numbers if math.isfinite(value)] or [number]
        reach = 2 * max(max(values) - min(values), 2.0 * (True in kinds))
        is_far = not min(values) - reach <= number <= max(values) + reach
        if is_far or any(cell.rstrip("0").endswith(".") for cell in column):
            return True
    return False


def _of_rows(lines: Sequence[str], number: int, delimiter: str) -> TextLayout:
    """The layout without names, from the first row and those behind it."""
    first = cells_of(lines[0], delimiter)
    rows = [line.rstrip(" ") for line in lines if line.strip()]
    is_ended = all(row.endswith(delimiter) for row in rows[:100])
    has_tail = delimiter != _BLANKS and len(first) > 1 and is_ended
    text = ""
    if delimiter in _WITH_COMMAS:
        cells = (cell.strip(' "') for row in rows for cell in row.split(delimiter))
        text = "\n".join(filter(_DIGITS.fullmatch, cells))
    has_commas = "," in text and "." not in text
    if has_commas and not _NO_THOUSANDS.search(text):
        raise Refused(
            "has commas in its numbers that may stand before decimals or thousands; "
            "write it with decimal points"
        )
    num = len(first) - has_tail
    return TextLayout(number, delimiter, num, None, has_tail, has_commas, (), not first[0])


def _named(layout: TextLayout, headings: Sequence[tuple[int, str]], is_lvm: bool) -> TextLayout:
    """The layout with what the lines above the rows say; ``headings`` are numbered lines."""
    words = [(number, line) for number, line in headings if not line.lstrip().startswith("#")]
    if is_lvm:
        layout = layout._replace(sample_rate_hz=_labview_rate(words, layout.delimiter))
    if words and _are_units(units := cells_of(words[-1][1], layout.delimiter), layout):
        layout = layout._replace(units=tuple(units))
    line, names = _names_line(words, layout) if words else _from_comment(headings, layout)
    if not names:
        return layout
    if is_lvm and names[-1] == "Comment" and len(names) == layout.num_columns + 1:
        names.pop()
    if layout.has_tail and len(names) == layout.num_columns + 1:
        if names[-1]:  # a column that is empty in the first rows
            layout = layout._replace(has_tail=False, num_columns=len(names))
        else:
            names.pop()
    if len(names) != layout.num_columns:
        raise wrong_line(
            line,
            f"{len(names)} columns are named, the row at line {layout.first_line} has "
            f"{layout.num_columns}; begin lines that are no header with # (and write decimals "
            "with a point)",
        )
    if is_lvm and names[0] == "X_Value":
        names[0] = "time_s"
    names = [name or f"column {place}" for place, name in enumerate(names)]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise wrong_line(line, f"two columns are called {quoted(twice)}; rename one")
    return layout._replace(names=tuple(names))


def _are_units(cells: Sequence[str], layout: TextLayout) -> bool:
    return len(cells) >= layout.num_columns and all(map(_UNIT_CELL.fullmatch, cells))


def _names_line(words: Sequence[tuple[int, str]], layout: TextLayout) -> tuple[int, list[str]]:
    """The nearest line of words that is no line of units; no names if it is a title of one cell.

    Raises:
        Refused: if it is a row of which a number is none.
    """
    for number, line in reversed(words):
        cells = cells_of(line, layout.delimiter)
        if _are_units(cells, layout):
            continue
        numbers = [cell for cell in cells if NUMBER.fullmatch(cell)]
        is_broken = cells[0] in numbers or not all(map(str.isdigit, numbers))
        if is_broken and len(cells) > 1 and tuple(cells) != _numbering(len(cells)):
            wrong = next(cell for cell in cells if cell not in numbers)
            raise wrong_line(number, f"{quoted(wrong)} is no number")
        return number, cells if len(cells) > 1 or layout.num_columns == 1 else []
    return 0, []


def _from_comment(headings: Sequence[tuple[int, str]], layout: TextLayout) -> tuple[int, list[str]]:
    if not headings:
        return 0, []
    number, line = headings[-1]
    cells = cells_of(line.lstrip("# "), layout.delimiter)
    is_header = len(cells) == layout.num_columns > 1 and not any(map(NUMBER.fullmatch, cells))
    return number, cells if is_header and all(cells) else []


def _labview_rate(words: Sequence[tuple[int, str]], delimiter: str) -> float | None:
    """The rate that LabVIEW's headings state.

    Raises:
        Refused: if every column has times of its own.
    """
    rate = None
    for number, line in words:
        first, *rest = cells_of(line, delimiter)
        if first == "X_Columns" and rest[:1] == ["Multi"]:
            raise wrong_line(number, "times for each column; write X_Columns One or No")
        steps = {cell.replace(",", ".") for cell in rest if cell} if first == "Delta_X" else set()
        step = steps.pop() if len(steps) == 1 else ""
        if NUMBER.fullmatch(step) and float(step) > 0:
            rate = 1 / float(step)
    return rate
