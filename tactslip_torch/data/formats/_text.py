"""Recordings as text tables: ``.csv``, ``.tsv``, ``.txt``, ``.dat`` and LabVIEW's ``.lvm``.

A file of ours is a comment with the header, a line of column names, and a row an instant: its time
and a column a channel, separated by commas in ``.csv`` and by tabs elsewhere. Of others most is
found out from the first lines: delimiter, names, units, comments, a preamble, decimal commas,
LabVIEW's headings. A ``#`` begins a comment at the start of a line or behind a blank. UTF-8,
Latin-1 and UTF-16 with its mark are read. Every row is looked at when a file is opened; the numbers
are kept in a temporary file (``TMPDIR``). A column that holds words is read as long as nobody asks
for it.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import opened_columns
from tactslip_torch.data.formats._names import (
    NUMBER,
    UNIT_CELL,
    number_in,
    time_unit_in,
)
from tactslip_torch.data.formats._reading import (
    FORM,
    MOST_HEADER,
    Opened,
    Reading,
    Refused,
    Samples,
    Spool,
    header_in,
    opened_from,
    shape_of,
    text_of,
)

_HEAD = 2**20  # characters in which the first row must be found, and the most of a line
_TO_WRITE = 4096  # rows at a time
_TO_COUNT = 1024  # rows that show whether a column is their number
_NO_THOUSANDS = re.compile(r",\d{0,2}(?!\d)|,\d{4}|(?<!\d)0,|\d{4},|(?<!\d),")
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*")
_WHOLE = re.compile(r"[+-]?\d+")
_BLANKS = " "
_WITH_COMMAS = ("\t", ";")  # between columns whose decimals may stand behind a comma


class _Layout(NamedTuple):
    """How to read the rows of a table.

    Args:
        first_line: the number of the first row's line, from 1.
        delimiter: between columns; a blank stands for any number of blanks and tabs.
        num_columns: of each row.
        names: of the columns, if the file says.
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


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write numbers with as few digits as give the same bits; of a NaN only that it is one."""
    mark = "," if path.suffix.lower() == ".csv" else "\t"
    names = [" ".join(row["name"].split()) for row in header["channels"]]  # whole in the header
    with path.open("w", encoding="utf-8", errors="replace", newline="\n") as file:
        file.write(f"# {FORM} {text_of(header)}\n")
        csv.writer(file, delimiter=mark, lineterminator="\n").writerow(["time_s", *names])
        for first in range(0, samples.shape[1], _TO_WRITE):
            rows = samples[:, first : first + _TO_WRITE]
            times = np.arange(first, first + rows.shape[1]) / header["sample_rate_hz"]
            texts = [map(repr, times.tolist()), *(_texts(row) for row in rows)]
            file.writelines(mark.join(row) + "\n" for row in zip(*texts, strict=True))


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A table whose rows were all looked at once.

    Raises:
        Refused: if it is no table of numbers, naming the line; or lacks a column of ``how``.
    """
    with _text_of(path) as file:
        own = _header(file)
        if own is not None:
            line_of_names = file.readline(MOST_HEADER)
            mark = "\t" if line_of_names.startswith("time_s\t") else ","
            if not line_of_names.startswith(f"time_s{mark}"):
                raise ValueError("no names of columns behind its header")
            layout = _Layout(3, mark, shape_of(own)[0] + 1)
        else:
            file.seek(0)
            layout = _layout_of(file.read(_HEAD), how)
            file.seek(0)
            for _ in range(layout.first_line - 1):
                file.readline(_HEAD)
        spool = Spool(layout.num_columns, np.float64, stack)
        words: dict[int, tuple[int, str]] = {}
        for line, lines in _blocks(file, layout.first_line):
            spool.add(_rows_of(lines, layout, line, words))
    table = spool.array()
    if own is not None:
        _refuse_words(words, range(layout.num_columns), layout)
        return opened_from(own, path, table[:, 1:])
    names, first_rows = layout.names, table[:_TO_COUNT]
    is_unnamed = names is None or names == _numbering(layout.num_columns)
    if is_unnamed and how.time == "auto" and how.sample_rate_hz is None:
        how = replace(how, time=0 if layout.num_columns > 1 else None)
    is_count = (first_rows[1:] == first_rows[:-1] + 1).all(0) & (len(first_rows) > 2)
    numbers = [
        n for n, name in enumerate(names or ()) if name in ("", f"column {n}", f"Unnamed: {n}")
    ]
    others = [n for n in numbers if is_count[n]]  # of the rows, which some libraries write first
    if layout.is_time_empty:
        others.append(0)
        how = replace(how, time=None) if how.time == "auto" else how

    def columns(places: list[int]) -> Samples:
        _refuse_words(words, places, layout)
        return Samples(path, table, 0, places)

    units = {n: unit for n, cell in enumerate(layout.units) if (unit := time_unit_in(cell))}
    opened = opened_columns(names, layout.num_columns, how, columns, others, units=units)
    return opened._replace(sample_rate_hz=layout.sample_rate_hz)


def _header(file: IO[str]) -> dict[str, Any] | None:
    start = file.read(len(FORM) + 2)
    if not start.startswith(f"# {FORM[:-1]}"):  # without its version
        return None
    rest = file.readline(MOST_HEADER)
    if start != f"# {FORM}":
        raise Refused(f"must be of format {FORM!r}, got {start[2:]!r}")
    header = header_in(rest.strip())
    if header is None or not rest.endswith("\n"):
        raise ValueError("no header behind its name")
    return header


# Lines -------------------------------------------------------------------------------------------


def _text_of(path: Path) -> IO[str]:
    """An open text in the encoding that its first bytes show."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        encoding = "latin-1"
    return path.open(encoding=encoding, errors="replace")


def _blocks(file: IO[str], line: int) -> Iterator[tuple[int, list[str]]]:
    """Whole lines, about a megabyte at a time, and the number of the first."""
    rest = ""
    while more := file.read(_HEAD):
        if "\0" in more:
            wrong = line + (rest + more[: more.index("\0")]).count("\n")
            raise _wrong(wrong, "holds NUL bytes; the file is damaged from there on")
        lines = (rest + more).split("\n")
        rest = lines.pop()
        if len(rest) > _HEAD:
            what = f"has more than {_HEAD} bytes; this is no table of numbers"
            raise _wrong(line + len(lines), what)
        yield line, lines
        line += len(lines)
    yield line, [rest]


def _without_comment(line: str) -> str:
    return _COMMENT.sub("", line) if "#" in line else line


def _rows_of(
    lines: list[str], layout: _Layout, line: int, words: dict[int, tuple[int, str]]
) -> NDArray[np.float64]:
    """The numbers of whole lines, ``[n, columns]``; the first line has the number ``line``.

    Lines without anything and comments are passed over; a cell with nothing in it is NaN, and so is
    one that is no number: the first of each column is noted in ``words`` with its line.

    Raises:
        Refused: naming the first line that has another number of cells.
    """
    lines = plain = list(map(_without_comment, lines))
    blanks = " \r" if layout.delimiter == "\t" else None  # tabs alone are a row of nothing
    numbered = [(number, one) for number, one in enumerate(lines, line) if one.strip(blanks)]
    if not numbered:
        return np.empty((0, layout.num_columns))
    if layout.has_tail:
        plain = [one.rstrip(" ").removesuffix(layout.delimiter) for one in plain]
    if layout.has_commas:  # a point beside them would be one of thousands
        plain = [one.replace(".", "?").replace(",", ".") for one in plain]
    delimiter = None if layout.delimiter == _BLANKS else layout.delimiter
    try:
        rows: NDArray[Any] = np.loadtxt(plain, delimiter=delimiter, comments=None, ndmin=2)
        if rows.shape[1] == layout.num_columns:
            return rows
    except ValueError:  # cell by cell, so that what is empty is NaN and what is wrong has a line
        pass
    found = [_row_of(one, layout, number, words) for number, one in numbered]
    return np.array(found, dtype=np.float64).reshape(-1, layout.num_columns)


def _row_of(
    line: str, layout: _Layout, number: int, words: dict[int, tuple[int, str]]
) -> list[float]:
    cells = _cells(line, layout.delimiter)
    if layout.has_tail and not cells[-1]:
        cells.pop()
    if len(cells) != layout.num_columns:
        wanted = f"the row at line {layout.first_line} has {layout.num_columns}"
        raise _wrong(number, f"{len(cells)} cells, {wanted}; mend the line or take it out")
    row = []
    for place, cell in enumerate(cells):
        plain = cell.replace(".", "?").replace(",", ".", 1) if layout.has_commas else cell
        if plain and not NUMBER.fullmatch(plain):
            words.setdefault(place, (number, cell))
            plain = ""
        row.append(number_in(plain))
    return row


def _refuse_words(
    words: Mapping[int, tuple[int, str]], places: Iterable[int], layout: _Layout
) -> None:
    """Refuse columns that hold what is no number."""
    for place in places:
        if place in words:
            line, cell = words[place]
            name = layout.names[place] if layout.names else place
            raise _wrong(
                line,
                f"{_quoted(cell)} is no number, in column {name!r}; leave empty what is missing, "
                "or list the columns that are channels as reading.channels",
            )


def _wrong(line: int, what: str) -> Refused:
    return Refused(f"is wrong in line {line}: {what}")


def _quoted(cell: str) -> str:
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def _cells(line: str, delimiter: str) -> list[str]:
    """The cells of one line, quotes and blanks around them taken off."""
    if delimiter == _BLANKS:
        line = " ".join(line.split())
    try:
        rows = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
        return [cell.strip() for cell in next(rows, [""])] or [""]
    except csv.Error:  # a cell of more than 128 KiB
        return [line]


# Layout ------------------------------------------------------------------------------------------


def _layout_of(head: str, how: Reading) -> _Layout:
    """The layout of a table, from its first characters.

    Raises:
        Refused: if it has no row of numbers, or a header of other columns.
    """
    if "\0" in head:
        raise Refused("holds NUL bytes, so it is no text; save it as UTF-8")
    lines = head.split("\n")
    if len(head) == _HEAD:
        lines.pop()  # cut
    is_lvm = head.startswith("LabVIEW Measurement")
    bare = list(map(_without_comment, lines))
    marks = [how.delimiter] if how.delimiter else [*"\t;,", _BLANKS]

    def split(place: int) -> Iterator[tuple[str, list[str]]]:
        """The cells of a line by each delimiter that is in it."""
        for mark in marks:
            if mark in bare[place] or mark in (_BLANKS, how.delimiter):
                yield mark, _cells(bare[place], mark)

    rows = (
        (place, mark)
        for place in range(len(lines))
        for mark, cells in split(place)
        if _is_row(cells, mark, is_lvm)
    )
    place, delimiter = next(rows, None) or _with_words(split, len(lines))
    above = [n for n in range(place) if bare[n].strip()]
    num_columns = len(_cells(bare[place], delimiter))
    while above and _has_words(_cells(bare[above[-1]], delimiter), num_columns):
        place = above.pop()  # rows too, some cells of which are no numbers
    below = [n for n in range(place + 1, len(lines)) if bare[n].strip()]
    rest = [_cells(bare[n], delimiter) for n in below[:_TO_COUNT]]
    if not above and _is_numbering(_cells(bare[place], delimiter), rest):
        place = below[0]
    headings = [(n + 1, lines[n]) for n in range(place) if lines[n].strip()]
    return _named(_of_rows(bare[place:], place + 1, delimiter), headings, is_lvm)


def _with_words(
    split: Callable[[int], Iterator[tuple[str, list[str]]]], num_lines: int
) -> tuple[int, str]:
    """The first of two lines that have numbers in the same cells and words in all others."""
    before: dict[str, list[bool]] = {}
    for place in range(num_lines):
        shapes = {mark: [bool(NUMBER.fullmatch(c)) for c in cells] for mark, cells in split(place)}
        for mark, shape in shapes.items():
            if any(shape) and len(shape) > 1 and before.get(mark) == shape:
                return place - 1, mark
        before = shapes
    raise Refused(
        f"holds no row of numbers in its first {_HEAD >> 20} MiB; "
        "it must be a table of numbers, with a decimal point"
    )


def _has_words(cells: Sequence[str], num_columns: int) -> bool:
    """Whether cells above a row are one as well: a number first, and words."""
    return len(cells) == num_columns > 1 and NUMBER.fullmatch(cells[0]) is not None


def _numbering(num_columns: int) -> tuple[str, ...]:
    """Names of columns that have none, as pandas writes them."""
    return tuple(map(str, range(num_columns)))


def _is_numbering(first: Sequence[str], rest: Sequence[Sequence[str]]) -> bool:
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


def _is_row(cells: Sequence[str], delimiter: str, is_lvm: bool) -> bool:
    """Whether cells are numbers, the first of them there; of others some may be missing."""
    if delimiter in _WITH_COMMAS:
        cells = [cell.replace(",", ".", 1) for cell in cells]
    if not cells[0] and not is_lvm:
        return False
    return any(cells) and all(not cell or NUMBER.fullmatch(cell) for cell in cells)


def _of_rows(lines: Sequence[str], number: int, delimiter: str) -> _Layout:
    """The layout without names, from the first row and those behind it."""
    first = _cells(lines[0], delimiter)
    rows = [line.rstrip(" ") for line in lines if line.strip()]
    is_ended = all(row.endswith(delimiter) for row in rows[:100])
    has_tail = delimiter != _BLANKS and len(first) > 1 and is_ended
    text = "\n".join(rows) if delimiter in _WITH_COMMAS else ""
    has_commas = "," in text and "." not in text
    if has_commas and not _NO_THOUSANDS.search(text):
        raise Refused(
            "has commas in its numbers that may stand before decimals or thousands; "
            "write it with decimal points"
        )
    num_columns = len(first) - has_tail
    is_time_empty = not first[0]
    return _Layout(
        number, delimiter, num_columns, None, has_tail, has_commas, is_time_empty=is_time_empty
    )


def _named(layout: _Layout, headings: Sequence[tuple[int, str]], is_lvm: bool) -> _Layout:
    """The layout with what the lines above the rows say."""
    words = [(number, line) for number, line in headings if not line.lstrip().startswith("#")]
    if is_lvm:
        layout = layout._replace(sample_rate_hz=_rate_of(words, layout.delimiter))
    if words and (units := _cells(words[-1][1], layout.delimiter)) and _are_units(units, layout):
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
        raise _wrong(
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
        raise _wrong(line, f"two columns are called {_quoted(twice)}; rename one")
    return layout._replace(names=tuple(names))


def _are_units(cells: Sequence[str], layout: _Layout) -> bool:
    return len(cells) >= layout.num_columns and all(map(UNIT_CELL.fullmatch, cells))


def _names_line(words: Sequence[tuple[int, str]], layout: _Layout) -> tuple[int, list[str]]:
    """The nearest line of words that is no line of units; no names if it is a title of one cell.

    Raises:
        Refused: if it is a row of which a number is none.
    """
    for number, line in reversed(words):
        cells = _cells(line, layout.delimiter)
        if _are_units(cells, layout):
            continue
        numbers = [cell for cell in cells if NUMBER.fullmatch(cell)]
        is_broken = cells[0] in numbers or not all(map(str.isdigit, numbers))
        if is_broken and len(cells) > 1 and tuple(cells) != _numbering(len(cells)):
            wrong = next(cell for cell in cells if cell not in numbers)
            raise _wrong(number, f"{_quoted(wrong)} is no number")
        return number, cells if len(cells) > 1 or layout.num_columns == 1 else []
    return 0, []


def _from_comment(headings: Sequence[tuple[int, str]], layout: _Layout) -> tuple[int, list[str]]:
    """Names in the last comment, where ``numpy.savetxt`` puts them."""
    if not headings:
        return 0, []
    number, line = headings[-1]
    cells = _cells(line.lstrip("# "), layout.delimiter)
    is_header = len(cells) == layout.num_columns > 1 and not any(map(NUMBER.fullmatch, cells))
    return number, cells if is_header and all(cells) else []


def _rate_of(words: Sequence[tuple[int, str]], delimiter: str) -> float | None:
    """The rate that LabVIEW's headings state.

    Raises:
        Refused: if every column has times of its own.
    """
    rate = None
    for number, line in words:
        first, *rest = _cells(line, delimiter)
        if first == "X_Columns" and rest[:1] == ["Multi"]:
            raise _wrong(number, "times for each column; write X_Columns One or No")
        steps = {cell.replace(",", ".") for cell in rest if cell} if first == "Delta_X" else set()
        step = steps.pop() if len(steps) == 1 else ""
        if NUMBER.fullmatch(step) and float(step) > 0:
            rate = 1 / float(step)
    return rate


def _texts(row: NDArray[Any]) -> list[str]:
    """Numbers with as few digits as give the same bits, read as float64 and cast."""
    if row.dtype == np.float64:
        return list(map(repr, row.tolist()))
    texts = list(map(str, row))
    read = np.array(list(map(float, texts))).astype(row.dtype)
    for place in np.flatnonzero((read != row) & ~np.isnan(row)):
        texts[place] = f"{row[place]:.9g}"  # the shortest rounds twice, to a neighbour
    return texts
