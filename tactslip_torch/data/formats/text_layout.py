"""How a text table is laid out: what separates its columns, what they are called, where rows begin.

Read from the first lines, so that people need not say it: a header or none, comments, a preamble,
decimal commas, LabVIEW's ``.lvm`` headings.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from typing import IO, NamedTuple

from tactslip_torch.data.formats.reading import Reading

HEAD = 2**20
"""Bytes in which the first row of numbers must be found, and the most that a line may have."""

_NUMBER = re.compile(
    r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf|infinity)", re.IGNORECASE | re.ASCII
)
_NO_THOUSANDS = re.compile(r",\d{0,2}(?!\d)|,\d{4}|(?<!\d)0,|\d{4},|(?<!\d),")
_UNIT = re.compile(r"[(\[].*[)\]]|-?|[muµn]?s|[muµk]?V|[mk]?N|[kM]?Pa|mm|counts?|[kM]?Hz")
_BLANKS = " "
_WITH_COMMAS = ("\t", ";")  # between columns whose decimals may stand behind a comma


class Layout(NamedTuple):
    """How to read the rows of a text table.

    Args:
        start: byte at which the first row begins.
        first_line: its number, from 1.
        delimiter: between columns; a blank stands for any number of blanks and tabs.
        num_columns: of each row.
        names: of the columns, if the file says.
        has_tail: whether rows end in a delimiter behind their last column.
        has_commas: whether decimals stand behind a comma.
        is_time_empty: whether the first column is for times and holds none, as LabVIEW has it.
        sample_rate_hz: if headings of LabVIEW state it.
    """

    start: int
    first_line: int
    delimiter: str
    num_columns: int
    names: tuple[str, ...] | None = None
    has_tail: bool = False
    has_commas: bool = False
    is_time_empty: bool = False
    sample_rate_hz: float | None = None


class _Line(NamedTuple):
    number: int
    start: int
    text: str


def wrong_line(path: str | os.PathLike[str], line: int, what: str) -> ValueError:
    """What to raise of a line."""
    return ValueError(f"{os.fspath(path)}, line {line}: {what}")


def quoted(cell: str) -> str:
    """A cell for a message: one line, and not a long one."""
    return repr(cell if len(cell) <= 40 else cell[:37] + "...")


def cells_of(line: str, delimiter: str) -> list[str]:
    """The cells of one line, quotes and blanks around them taken off."""
    if delimiter == _BLANKS:
        line = " ".join(line.split())
    if '"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    try:
        found = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])
    except csv.Error:  # a cell of more than 128 KiB
        return [line]
    return [cell.strip() for cell in found]


def is_number(cell: str) -> bool:
    """Whether a cell is a number with a decimal point, or ``nan`` or ``inf``."""
    return _NUMBER.fullmatch(cell) is not None


def bare(line: str) -> str:
    """A line without its comment."""
    return line.partition("#")[0]


def layout_of(path: str | os.PathLike[str], file: IO[bytes], how: Reading) -> Layout:
    """The layout of a text table that begins where the file is.

    Raises:
        ValueError: if it is no text, has no row of numbers, or a header of other columns.
    """
    lines = _first_lines(path, file)
    headings: list[_Line] = []
    for place, line in enumerate(lines):
        if not line.text.strip():
            continue
        is_lvm = bool(headings) and headings[0].text.startswith("LabVIEW Measurement")
        delimiter = _delimiter_of(bare(line.text), how, is_lvm)
        if delimiter is None:
            headings.append(line)
            continue
        layout = _of_rows(path, line, delimiter, [bare(one.text) for one in lines[place:]])
        layout = layout._replace(is_time_empty=not cells_of(line.text, delimiter)[0])
        return _named(path, layout, headings, is_lvm)
    raise ValueError(
        f"{os.fspath(path)} holds no row of numbers in its first {HEAD >> 20} MiB; "
        "it must be a table of numbers, with a decimal point"
    )


def _first_lines(path: str | os.PathLike[str], file: IO[bytes]) -> list[_Line]:
    """The lines of the first stretch of a file; one that is cut off there is left out."""
    start = file.tell()
    head = file.read(HEAD)
    if b"\0" in head:
        raise ValueError(f"{os.fspath(path)} holds NUL bytes, so it is no text; save it as UTF-8")
    lines = head.split(b"\n")
    if len(head) == HEAD:
        lines.pop()
    found = []
    for number, line in enumerate(lines, 1):
        found.append(_Line(number, start, _text(line)))
        start += len(line) + 1
    return found


def _text(line: bytes) -> str:
    try:
        return line.decode("utf-8").rstrip("\r")
    except UnicodeDecodeError:
        return line.decode("latin-1").rstrip("\r")


def _delimiter_of(line: str, how: Reading, is_lvm: bool) -> str | None:
    """What makes a line a row of numbers; None if nothing does."""
    marks = how.delimiter or [mark for mark in "\t;," if mark in line] + [_BLANKS]
    return next((mark for mark in marks if _is_row(cells_of(line, mark), mark, is_lvm)), None)


def _is_row(cells: Sequence[str], delimiter: str, is_lvm: bool) -> bool:
    """Whether cells are numbers, the first of them there; of others some may be missing."""
    if delimiter in _WITH_COMMAS:
        cells = [cell.replace(",", ".", 1) for cell in cells]
    if not cells[0] and not is_lvm:
        return False
    return any(cells) and all(not cell or is_number(cell) for cell in cells)


def _of_rows(
    path: str | os.PathLike[str], first: _Line, delimiter: str, lines: Sequence[str]
) -> Layout:
    """The layout without names, from the first row and those behind it."""
    num_columns = len(cells_of(first.text, delimiter))
    rows = [line.rstrip(" ") for line in lines if line.strip()]
    has_tail = (
        delimiter != _BLANKS
        and num_columns > 1
        and all(row.endswith(delimiter) for row in rows[:100])
    )
    text = "\n".join(rows) if delimiter in _WITH_COMMAS else ""
    has_commas = "," in text and "." not in text
    if has_commas and not _NO_THOUSANDS.search(text):
        raise ValueError(
            f"{os.fspath(path)}: commas in its numbers may stand before decimals or thousands; "
            "write it with decimal points"
        )
    return Layout(
        first.start, first.number, delimiter, num_columns - has_tail, None, has_tail, has_commas
    )


def _named(
    path: str | os.PathLike[str], layout: Layout, headings: Sequence[_Line], is_lvm: bool
) -> Layout:
    """The layout with what the lines above the rows say."""
    words = [line for line in headings if not line.text.lstrip().startswith("#")]
    if is_lvm:
        layout = layout._replace(sample_rate_hz=_rate_of(path, words, layout.delimiter))
    named = _names_line(path, words, layout) if words else _from_comment(headings, layout)
    if named is None:
        return layout
    line, names = named
    if is_lvm and names[-1] == "Comment" and len(names) == layout.num_columns + 1:
        names.pop()
    if layout.has_tail and len(names) == layout.num_columns + 1:
        if names[-1]:  # a column that is empty in the first rows
            layout = layout._replace(has_tail=False, num_columns=len(names))
        else:
            names.pop()
    if len(names) != layout.num_columns:
        raise wrong_line(
            path,
            line,
            f"{len(names)} columns are named, the row at line {layout.first_line} has "
            f"{layout.num_columns}; begin lines that are no header with # (and write decimals "
            "with a point)",
        )
    if is_lvm and names[0] == "X_Value":
        names[0] = "time_s"
    names = [name or f"column {place}" for place, name in enumerate(names)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise wrong_line(path, line, f"two columns are called {quoted(twice)}; rename one")
    return layout._replace(names=tuple(names))


def _names_line(
    path: str | os.PathLike[str], words: Sequence[_Line], layout: Layout
) -> tuple[int, list[str]] | None:
    """The nearest line of words that is no line of units; None if it is a title of one cell.

    Raises:
        ValueError: if it is a row of which a number is none.
    """
    for line in reversed(words):
        cells = cells_of(line.text, layout.delimiter)
        if len(cells) >= layout.num_columns and all(map(_UNIT.fullmatch, cells)):
            continue
        broken = is_number(cells[0]) or any(is_number(c) and not c.isdigit() for c in cells)
        if broken and len(cells) > 1:
            wrong = next(cell for cell in cells if not is_number(cell))
            raise wrong_line(path, line.number, f"{quoted(wrong)} is no number")
        return (line.number, cells) if len(cells) > 1 or layout.num_columns == 1 else None
    return None


def _from_comment(headings: Sequence[_Line], layout: Layout) -> tuple[int, list[str]] | None:
    """Names in the last comment, where ``numpy.savetxt`` puts them."""
    if not headings:
        return None
    cells = cells_of(headings[-1].text.lstrip("# "), layout.delimiter)
    is_header = len(cells) == layout.num_columns > 1 and not any(map(is_number, cells))
    return (headings[-1].number, cells) if is_header and all(cells) else None


def _rate_of(path: str | os.PathLike[str], words: Sequence[_Line], delimiter: str) -> float | None:
    """The rate that LabVIEW's headings state.

    Raises:
        ValueError: if every column has times of its own.
    """
    rate = None
    for line in words:
        first, *rest = cells_of(line.text, delimiter)
        if first == "X_Columns" and rest[:1] == ["Multi"]:
            raise wrong_line(path, line.number, "times for each column; write X_Columns One or No")
        steps = {cell.replace(",", ".") for cell in rest if cell} if first == "Delta_X" else set()
        step = steps.pop() if len(steps) == 1 else ""
        if is_number(step) and float(step) > 0:
            rate = 1 / float(step)
    return rate
