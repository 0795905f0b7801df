"""Recordings as text tables: ``.csv``, ``.tsv``, ``.txt``, ``.dat`` and LabVIEW's ``.lvm``.

A file of ours is a comment with the header, a line of column names, and a row an instant: its time
and a column a channel, separated by commas in ``.csv`` and by tabs elsewhere. Of others most is
found out from the first lines: delimiter, names, comments, a preamble, decimal commas, LabVIEW's
headings. UTF-8, Latin-1 and UTF-16 with its mark are read. Every row is looked at when a file is
opened; the numbers are kept in a temporary file (``TMPDIR``).
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._choice import opened_columns
from tactslip_torch.data.formats._reading import (
    FORM,
    MOST_HEADER,
    Opened,
    Reading,
    Refused,
    Samples,
    Spool,
    TimeUnit,
    header_in,
    opened_from,
    shape_of,
    text_of,
)

_HEAD = 2**20  # characters in which the first row must be found, and the most of a line
_TO_WRITE = 4096  # rows at a time
_TO_COUNT = 1024  # rows that show whether a column is their number
_NUMBER = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.IGNORECASE | re.ASCII
)
_NO_THOUSANDS = re.compile(r",\d{0,2}(?!\d)|,\d{4}|(?<!\d)0,|\d{4},|(?<!\d),")
_UNIT = re.compile(r"[(\[].*[)\]]|-?|[muµn]?s|[muµk]?V|[mk]?N|[kM]?Pa|mm|counts?|[kM]?Hz")
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
        is_time_empty: whether the first column is for times and holds none, as LabVIEW has it.
        sample_rate_hz: if headings of LabVIEW state it.
    """

    first_line: int
    delimiter: str
    num_columns: int
    names: tuple[str, ...] | None = None
    has_tail: bool = False
    has_commas: bool = False
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
        for line, lines in _blocks(file, layout.first_line):
            spool.add(_rows_of(lines, layout, line))
    table = spool.array()
    if own is not None:
        return opened_from(own, path, table[:, 1:])
    names, first_rows = layout.names, table[:_TO_COUNT]
    if names is None and how.time == "auto" and how.sample_rate_hz is None:
        how = replace(how, time=0 if layout.num_columns > 1 else None)
    is_count = (first_rows[1:] == first_rows[:-1] + 1).all(0) & (len(first_rows) > 2)
    numbers = [
        n for n, name in enumerate(names or ()) if name in ("", f"column {n}", f"Unnamed: {n}")
    ]
    counts = [n for n in numbers if is_count[n]]  # of the rows, which some libraries write first
    columns = partial(Samples, path, table, 0)
    empty: dict[int, TimeUnit | None] = {0: None} if layout.is_time_empty else {}
    opened = opened_columns(names, layout.num_columns, how, columns, counts, empty)
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


def _rows_of(lines: list[str], layout: _Layout, line: int) -> NDArray[np.float64]:
    """The numbers of whole lines, ``[n, columns]``; the first line has the number ``line``.

    Lines without anything and comments are passed over; a cell with nothing in it is NaN.

    Raises:
        Refused: naming the first line that is no such row.
    """
    lines = plain = [one.partition("#")[0] for one in lines]
    if not any(map(str.strip, lines)):
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
    found = [_row_of(one, layout, number) for number, one in enumerate(lines, line) if one.strip()]
    return np.array(found, dtype=np.float64).reshape(-1, layout.num_columns)


def _row_of(line: str, layout: _Layout, number: int) -> list[float]:
    cells = _cells(line, layout.delimiter)
    if layout.has_tail and not cells[-1]:
        cells.pop()
    if len(cells) != layout.num_columns:
        wanted = f"the row at line {layout.first_line} has {layout.num_columns}"
        raise _wrong(number, f"{len(cells)} cells, {wanted}; mend the line or take it out")
    row = []
    for cell in cells:
        plain = cell.replace(".", "?").replace(",", ".", 1) if layout.has_commas else cell
        if plain and not _NUMBER.fullmatch(plain):
            raise _wrong(number, f"{_quoted(cell)} is no number; leave empty what is missing")
        row.append(float(plain or "nan"))
    return row


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
    headings: list[tuple[int, str]] = []
    is_lvm = head.startswith("LabVIEW Measurement")
    for number, line in enumerate(lines, 1):
        bare = line.partition("#")[0]
        marks = how.delimiter or [mark for mark in "\t;," if mark in bare] + [_BLANKS]
        delimiter = next((m for m in marks if _is_row(_cells(bare, m), m, is_lvm)), None)
        if delimiter is not None:
            rows = [one.partition("#")[0] for one in lines[number - 1 :]]
            return _named(_of_rows(rows, number, delimiter), headings, is_lvm)
        if line.strip():
            headings.append((number, line))
    raise Refused(
        f"holds no row of numbers in its first {_HEAD >> 20} MiB; "
        "it must be a table of numbers, with a decimal point"
    )


def _is_row(cells: Sequence[str], delimiter: str, is_lvm: bool) -> bool:
    """Whether cells are numbers, the first of them there; of others some may be missing."""
    if delimiter in _WITH_COMMAS:
        cells = [cell.replace(",", ".", 1) for cell in cells]
    if not cells[0] and not is_lvm:
        return False
    return any(cells) and all(not cell or _NUMBER.fullmatch(cell) for cell in cells)


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
    return _Layout(number, delimiter, num_columns, None, has_tail, has_commas, not first[0])


def _named(layout: _Layout, headings: Sequence[tuple[int, str]], is_lvm: bool) -> _Layout:
    """The layout with what the lines above the rows say."""
    words = [(number, line) for number, line in headings if not line.lstrip().startswith("#")]
    if is_lvm:
        layout = layout._replace(sample_rate_hz=_rate_of(words, layout.delimiter))
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


def _names_line(words: Sequence[tuple[int, str]], layout: _Layout) -> tuple[int, list[str]]:
    """The nearest line of words that is no line of units; no names if it is a title of one cell.

    Raises:
        Refused: if it is a row of which a number is none.
    """
    for number, line in reversed(words):
        cells = _cells(line, layout.delimiter)
        if len(cells) >= layout.num_columns and all(map(_UNIT.fullmatch, cells)):
            continue
        numbers = [cell for cell in cells if _NUMBER.fullmatch(cell)]
        is_broken = cells[0] in numbers or not all(map(str.isdigit, numbers))
        if is_broken and len(cells) > 1:
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
    is_header = len(cells) == layout.num_columns > 1 and not any(map(_NUMBER.fullmatch, cells))
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
        if _NUMBER.fullmatch(step) and float(step) > 0:
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
