"""Recordings as text tables: ``.csv``, ``.tsv``, ``.txt``, ``.dat`` and LabVIEW's ``.lvm``.

Package files are a comment with the header, a line of column names, and a row an instant: its time
and a column a channel, separated by commas in ``.csv`` and by tabs elsewhere. The layout of foreign
ones is inferred (``text_layout``). UTF-8, Latin-1 and UTF-16 with its mark are read. Numbers are
kept in a temporary file (``TMPDIR``); a column that holds words is read as long as nobody asks for
it.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._inference import (
    HEAD,
    NUMBER,
    Refused,
    TextLayout,
    TimeUnit,
    cells_of,
    microseconds_in,
    number_in,
    quoted,
    text_layout,
    time_unit_in,
    without_comment,
    wrong_line,
)
from tactslip_torch.data.formats._reading import (
    FORM,
    MOST_HEADER,
    Opened,
    Reading,
    Samples,
    Spool,
    header_in,
    opened_columns,
    opened_from,
    text_of,
)
from tactslip_torch.data.labels import LabelColumn
from tactslip_torch.runtime import setting

_TO_WRITE = 4096  # rows at a time
_TO_COUNT = 1024  # rows that show whether a column is their number


class _Cells:
    """What stands for cells that are no numbers: labels, dates and NaN.

    Args:
        layout: of the table.
        label: the column of labels, if there is one.

    Attributes:
        words: by column, the first cell of which nothing is known, with its line.
        stamps: columns that hold dates and times.
    """

    def __init__(self, layout: TextLayout, label: LabelColumn | None) -> None:
        self.words: dict[int, tuple[int, str]] = {}
        self.stamps: set[int] = set()
        self._layout, self._label = layout, label
        self._place = None if label is None else label.name
        if isinstance(self._place, str):
            names = layout.names or ()
            self._place = names.index(self._place) if self._place in names else None

    def number(self, place: int, line: int, cell: str) -> float:
        """The number of a cell, NaN if it is empty or not known."""
        plain = cell
        if self._layout.has_commas:  # a point beside them would be one of thousands
            plain = cell.replace(".", "?").replace(",", ".", 1)
        if not plain or NUMBER.fullmatch(plain):
            return number_in(plain)
        if place == self._place and self._label is not None:
            number = self._label.number_of(cell)
        elif (number := microseconds_in(cell)) is not None:
            self.stamps.add(place)
        if number is None:
            self.words.setdefault(place, (line, cell))
            return math.nan
        return number

    def converters(self) -> dict[int | str, Callable[[str], float]]:
        """For ``numpy.loadtxt``, of columns that may hold what is no number.

        They raise a ValueError of a label or stamp that is not known.
        """
        found: dict[int | str, Callable[[str], float]] = dict.fromkeys(self.words, _number_or_nan)
        found |= dict.fromkeys(self.stamps, _stamp_of)
        if self._label is not None and self._place is not None:
            found[int(self._place)] = self._label_of
        return found

    def _label_of(self, cell: str) -> float:
        cell = cell.strip()
        if not cell or NUMBER.fullmatch(cell):
            return number_in(cell)
        number = None if self._label is None else self._label.number_of(cell)
        if number is None:
            raise ValueError(cell)
        return number

    def refuse_words(self, places: Iterable[int]) -> None:
        """Refuse columns that hold what is no number.

        Raises:
            Refused: naming the first such cell.
        """
        for place in places:
            if place not in self.words:
                continue
            line, cell = self.words[place]
            if place == self._place and self._label is not None:
                raise wrong_line(line, self._label.no_label(cell[:40]))
            names = self._layout.names
            name = names[place] if names else place
            raise wrong_line(
                line,
                f"{quoted(cell)} is no number, in column {name!r}; leave empty what is missing, "
                f"list the columns that are channels as {setting('reading.channels')}, or name the "
                "one that has labels as labels.column",
            )


def _stamp_of(cell: str) -> float:
    number = microseconds_in(cell.strip())
    if number is None:
        raise ValueError(cell)
    return number


def _number_or_nan(cell: str) -> float:
    return number_in(cell.strip()) if NUMBER.fullmatch(cell.strip()) else math.nan


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


def _texts(row: NDArray[Any]) -> list[str]:
    """Numbers with as few digits as give the same bits, read as float64 and cast."""
    if row.dtype == np.float64:
        return list(map(repr, row.tolist()))
    texts = list(map(str, row))
    read = np.array(list(map(float, texts))).astype(row.dtype)
    for place in np.flatnonzero((read != row) & ~np.isnan(row)):
        texts[place] = f"{row[place]:.9g}"  # the shortest rounds twice, to a neighbour
    return texts


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A table, all rows of which were read once.

    Raises:
        Refused: if it is no table of numbers, naming the line; or lacks a column of ``how``.
    """
    with _opened_text(path) as file:
        own = _header(file)
        if own is not None:
            line_of_names = file.readline(MOST_HEADER)
            mark = "\t" if line_of_names.startswith("time_s\t") else ","
            layout = TextLayout(3, mark, len(own["channels"]) + 1)
        else:
            file.seek(0)
            layout = text_layout(file.read(HEAD), how.delimiter)
            file.seek(0)
            for _ in range(layout.first_line - 1):
                file.readline(HEAD)
        cells = _Cells(layout, how.label)
        spool = Spool(layout.num_columns, np.float64, stack)
        for line, lines in _blocks(file, layout.first_line):
            spool.add(_rows_of(lines, layout, line, cells))
    table = spool.array()

    def columns(places: Iterable[int]) -> Samples:
        places = list(places)
        cells.refuse_words(places)
        return Samples(path, table, 0, places)

    if own is not None:
        return opened_from(own, path, columns(range(1, layout.num_columns)))
    if layout.is_unnamed and how.time == "auto" and how.sample_rate_hz is None:
        how = replace(how, time=0 if layout.num_columns > 1 else None)
    others = _row_numbers(layout, table[:_TO_COUNT])
    if layout.is_time_empty:
        others.append(0)
        how = replace(how, time=None) if how.time == "auto" else how
    units = {n: unit for n, cell in enumerate(layout.units) if (unit := time_unit_in(cell))}
    stamps: dict[int, TimeUnit] = dict.fromkeys(sorted(cells.stamps), "us")
    opened = opened_columns(
        layout.names, layout.num_columns, how, columns, others, stamps, units=units
    )
    return opened._replace(sample_rate_hz=layout.sample_rate_hz)


def _row_numbers(layout: TextLayout, rows: NDArray[np.float64]) -> list[int]:
    """Columns without a name that count the rows, which some libraries write first."""
    is_count = (rows[1:] == rows[:-1] + 1).all(0) & (len(rows) > 2)
    unnamed = enumerate(layout.names or ())
    return [n for n, name in unnamed if name in (f"column {n}", f"Unnamed: {n}") and is_count[n]]


def _header(file: IO[str]) -> dict[str, Any] | None:
    """The header of a package file."""
    mark = f"# {FORM[:-1]}"  # without its version
    if not file.read(len(mark)).startswith(mark):
        return None
    version, _, rest = file.readline(MOST_HEADER).partition(" ")
    if (form := FORM[:-1] + version) != FORM:
        raise Refused(f"must be of format {FORM!r}, got {form[:80]!r}")
    header = header_in(rest.strip())
    if header is None:
        raise ValueError("no header behind its name")
    return header


# Rows --------------------------------------------------------------------------------------------


def _opened_text(path: Path) -> IO[str]:
    """An open text in the encoding that its first bytes show."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        codecs.getincrementaldecoder(encoding)().decode(head)
    except UnicodeDecodeError:
        encoding = "latin-1"
    return path.open(encoding=encoding, errors="replace")


def _blocks(file: IO[str], line: int) -> Iterator[tuple[int, list[str]]]:
    """Whole lines, about a megabyte at a time, and the number of the first."""
    rest = ""
    while more := file.read(HEAD):
        if "\0" in more:
            place = line + (rest + more[: more.index("\0")]).count("\n")
            raise wrong_line(place, "holds NUL bytes; the file is damaged from there on")
        lines = (rest + more).split("\n")
        rest = lines.pop()
        if len(rest) > HEAD:
            what = f"has more than {HEAD} bytes; this is no table of numbers"
            raise wrong_line(line + len(lines), what)
        yield line, lines
        line += len(lines)
    yield line, [rest]


def _rows_of(lines: list[str], layout: TextLayout, line: int, cells: _Cells) -> NDArray[np.float64]:
    """The numbers of whole lines, ``[n, columns]``; the first line has the number ``line``.

    Lines without anything and comments are passed over; a cell with nothing in it is NaN, and so is
    one that ``cells`` does not know.

    Raises:
        Refused: naming the first line that has another number of cells.
    """
    lines = plain = list(map(without_comment, lines))
    blanks = " \r" if layout.delimiter == "\t" else None  # tabs alone are a row of nothing
    numbered = [(number, one) for number, one in enumerate(lines, line) if one.strip(blanks)]
    if not numbered:
        return np.empty((0, layout.num_columns))
    if layout.has_tail:
        plain = [one.rstrip(" ").removesuffix(layout.delimiter) for one in plain]
    if layout.has_commas:  # a point beside them would be one of thousands
        plain = [one.replace(".", "?").replace(",", ".") for one in plain]
    delimiter = None if layout.delimiter == " " else layout.delimiter
    filled = plain
    for converters in ({}, cells.converters()):
        with suppress(ValueError):
            rows: NDArray[Any] = np.loadtxt(
                filled,
                delimiter=delimiter,
                comments=None,
                ndmin=2,
                converters=converters or None,
                encoding=None,
            )
            if rows.shape[1] == layout.num_columns:
                return rows
        if delimiter is None or any('"' in one for one in plain):
            break
        mark = re.escape(delimiter)
        empty = re.compile(rf"(?:^|(?<={mark})) *(?=$|{mark})")
        filled = [empty.sub("nan", one) for one in plain if one.strip(blanks)]
    # cell by cell, so that what is wrong has a line
    found = [_row_of(one, layout, number, cells) for number, one in numbered]
    return np.array(found, dtype=np.float64).reshape(-1, layout.num_columns)


def _row_of(line: str, layout: TextLayout, number: int, cells: _Cells) -> list[float]:
    texts = cells_of(line, layout.delimiter)
    if layout.has_tail and not texts[-1]:
        texts.pop()
    if len(texts) != layout.num_columns:
        wanted = f"the row at line {layout.first_line} has {layout.num_columns}"
        raise wrong_line(number, f"{len(texts)} cells, {wanted}; mend the line or take it out")
    return [cells.number(place, number, text) for place, text in enumerate(texts)]
