"""Rows of numbers in a text file that stay there until they are asked for.

One pass looks at every row and keeps where each stretch of about a megabyte begins, so a file may
be larger than the memory; what is small is kept as it was read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.text_layout import (
    HEAD,
    Layout,
    bare,
    cells_of,
    is_number,
    quoted,
    wrong_line,
)

MOST_KEPT = 64 * 2**20
"""Bytes of numbers that are kept in memory from the first pass."""

_Rows = NDArray[np.float64]


class _Stretch(NamedTuple):
    """Where some rows stand: bytes, the number of the first line, the number of the first row."""

    start: int
    num_bytes: int
    line: int
    row: int


class TextTable:
    """The rows behind a layout, ``[T, columns]``, read by stretches.

    Args:
        path: of the file, for messages.
        file: open; it stays so as long as rows are read.
        layout: of its rows.

    Raises:
        ValueError: naming the line that is no row of as many numbers as the first.
    """

    def __init__(self, path: str | os.PathLike[str], file: IO[bytes], layout: Layout) -> None:
        self.path, self.file, self.layout = path, file, layout
        self.num_rows = 0
        self._stretches: list[_Stretch] = []
        self._kept: dict[int, _Rows] = {}
        room = MOST_KEPT
        for place, (start, line, content) in enumerate(_contents(path, file, layout)):
            rows = rows_of(path, content, layout, line)
            self._stretches.append(_Stretch(start, len(content), line, self.num_rows))
            self.num_rows += len(rows)
            room -= rows.nbytes
            if room >= 0:
                self._kept[place] = rows
        self._starts = np.array([stretch.row for stretch in self._stretches] + [self.num_rows])
        self._last: tuple[int, _Rows] | None = None

    def read(self, first: int, stop: int) -> _Rows:
        """Rows from ``first`` to before ``stop``, as far as there are any, ``[n, columns]``.

        Raises:
            ValueError: if the file has changed since it was opened.
        """
        starts = self._starts
        behind = int(np.searchsorted(starts[:-1], stop, side="left"))
        places = range(max(int(np.searchsorted(starts, first, side="right")) - 1, 0), behind)
        found = [
            self._rows(place)[max(first - starts[place], 0) : stop - starts[place]]
            for place in places
        ]
        return np.concatenate([np.empty((0, self.layout.num_columns)), *found])

    def _rows(self, place: int) -> _Rows:
        """All rows of one stretch."""
        if place in self._kept:
            return self._kept[place]
        if self._last is None or self._last[0] != place:
            stretch = self._stretches[place]
            self.file.seek(stretch.start)
            rows = rows_of(self.path, self.file.read(stretch.num_bytes), self.layout, stretch.line)
            if len(rows) != self._starts[place + 1] - stretch.row:
                raise ValueError(f"{os.fspath(self.path)} changed while it was read; read it again")
            self._last = place, rows
        return self._last[1]


def all_rows(path: str | os.PathLike[str], file: IO[bytes], layout: Layout) -> Iterator[_Rows]:
    """The rows of a file in order, some at a time; errors as ``TextTable``."""
    for _, line, content in _contents(path, file, layout):
        yield rows_of(path, content, layout, line)


def _contents(
    path: str | os.PathLike[str], file: IO[bytes], layout: Layout
) -> Iterator[tuple[int, int, bytes]]:
    """Stretches of whole lines: where each starts, the number of its first line, its bytes."""
    start, line = layout.start, layout.first_line
    file.seek(start)
    rest = b""
    while more := file.read(HEAD):
        content = rest + more
        end = content.rfind(b"\n") + 1
        if not end and len(content) > HEAD:
            raise wrong_line(path, line, f"has more than {HEAD} bytes; this is no table of numbers")
        content, rest = content[:end], content[end:]
        if content:
            yield start, line, content
        start += end
        line += content.count(b"\n")
        file.seek(start + len(rest))
    if rest:
        yield start, line, rest


def rows_of(path: str | os.PathLike[str], content: bytes, layout: Layout, line: int) -> _Rows:
    """The numbers of whole lines, of which the first has the number ``line``.

    Lines without anything and comments are passed over; a cell with nothing in it is NaN.

    Raises:
        ValueError: naming the first line that is no such row.
    """
    if b"\0" in content:
        line += content[: content.index(b"\0")].count(b"\n")
        raise wrong_line(path, line, "holds NUL bytes; the file is damaged from there on")
    lines = content.decode("latin-1").replace("\r\n", "\n").split("\n")
    if b"#" in content:
        lines = [bare(one) for one in lines]
    rows = _quickly(lines, layout)
    return _carefully(path, lines, layout, line) if rows is None else rows


def _quickly(lines: Sequence[str], layout: Layout) -> _Rows | None:
    """Rows as NumPy reads them; None if it must be looked at closely."""
    if not any(map(str.strip, lines)):
        return np.empty((0, layout.num_columns))
    delimiter = None if layout.delimiter == " " else layout.delimiter
    if layout.has_tail:
        lines = [line.rstrip(" ").removesuffix(layout.delimiter) for line in lines]
    if layout.has_commas:  # a point beside them would be one of thousands
        lines = [line.replace(".", "?").replace(",", ".") for line in lines]
    try:
        rows: NDArray[Any] = np.loadtxt(lines, delimiter=delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return rows if rows.shape[1] == layout.num_columns else None


def _carefully(
    path: str | os.PathLike[str], lines: Sequence[str], layout: Layout, first_line: int
) -> _Rows:
    """Rows cell by cell, so that what is wrong has a line."""
    rows = []
    for number, line in enumerate(lines, first_line):
        if not line.strip():
            continue
        cells = cells_of(line, layout.delimiter)
        if layout.has_tail and not cells[-1]:
            cells.pop()
        if len(cells) != layout.num_columns:
            count = f"{len(cells)} cell" if len(cells) == 1 else f"{len(cells)} cells"
            wanted = f"the row at line {layout.first_line} has {layout.num_columns}"
            raise wrong_line(path, number, f"{count}, {wanted}; mend the line or take it out")
        rows.append([_number(path, number, cell, layout) for cell in cells])
    return np.array(rows, dtype=np.float64).reshape(-1, layout.num_columns)


def _number(path: str | os.PathLike[str], line: int, cell: str, layout: Layout) -> float:
    plain = cell
    if layout.has_commas:
        plain = cell.replace(".", "?").replace(",", ".", 1)
    if not plain:
        return float("nan")
    if is_number(plain):
        return float(plain)
    raise wrong_line(path, line, f"{quoted(cell)} is no number; leave empty what is missing")
