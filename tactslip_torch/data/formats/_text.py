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
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
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
    cells_of,
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

_TO_WRITE = 4096  # rows at a time
_TO_COUNT = 1024  # rows that show whether a column is their number
_Words = dict[int, tuple[int, str]]
"""The first cell of a column that is no number, with its line."""


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
    words: _Words = {}
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
        spool = Spool(layout.num_columns, np.float64, stack)
        for line, lines in _blocks(file, layout.first_line):
            spool.add(_rows_of(lines, layout, line, words))
    table = spool.array()

    def columns(places: Iterable[int]) -> Samples:
        _refuse_words(words, places, layout)
        return Samples(path, table, 0, list(places))

    if own is not None:
        return opened_from(own, path, columns(range(1, layout.num_columns)))
    if layout.is_unnamed and how.time == "auto" and how.sample_rate_hz is None:
        how = replace(how, time=0 if layout.num_columns > 1 else None)
    others = _row_numbers(layout, table[:_TO_COUNT])
    if layout.is_time_empty:
        others.append(0)
        how = replace(how, time=None) if how.time == "auto" else how
    units = {n: unit for n, cell in enumerate(layout.units) if (unit := time_unit_in(cell))}
    opened = opened_columns(layout.names, layout.num_columns, how, columns, others, units=units)
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


def _rows_of(lines: list[str], layout: TextLayout, line: int, words: _Words) -> NDArray[np.float64]:
    """The numbers of whole lines, ``[n, columns]``; the first line has the number ``line``.

    Lines without anything and comments are passed over; a cell with nothing in it is NaN, and so is
    one that is no number: the first of each column is noted in ``words``.

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
    try:
        rows: NDArray[Any] = np.loadtxt(plain, delimiter=delimiter, comments=None, ndmin=2)
        if rows.shape[1] == layout.num_columns:
            return rows
    except ValueError:  # cell by cell, so that what is empty is NaN and what is wrong has a line
        pass
    found = [_row_of(one, layout, number, words) for number, one in numbered]
    return np.array(found, dtype=np.float64).reshape(-1, layout.num_columns)


def _row_of(line: str, layout: TextLayout, number: int, words: _Words) -> list[float]:
    cells = cells_of(line, layout.delimiter)
    if layout.has_tail and not cells[-1]:
        cells.pop()
    if len(cells) != layout.num_columns:
        wanted = f"the row at line {layout.first_line} has {layout.num_columns}"
        raise wrong_line(number, f"{len(cells)} cells, {wanted}; mend the line or take it out")
    row = []
    for place, cell in enumerate(cells):
        plain = cell.replace(".", "?").replace(",", ".", 1) if layout.has_commas else cell
        if plain and not NUMBER.fullmatch(plain):
            words.setdefault(place, (number, cell))
            plain = ""
        row.append(number_in(plain))
    return row


def _refuse_words(words: _Words, places: Iterable[int], layout: TextLayout) -> None:
    """Refuse columns that hold what is no number."""
    for place in places:
        if place in words:
            line, cell = words[place]
            name = layout.names[place] if layout.names else place
            raise wrong_line(
                line,
                f"{quoted(cell)} is no number, in column {name!r}; leave empty what is missing, "
                "or list the columns that are channels as reading.channels",
            )
