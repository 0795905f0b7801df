"""Variables of MAT files of version 5 (MATLAB's ``-v6`` and ``-v7``), where they stand.

SciPy reads whole variables, and one that is nested deeply enough ends the process. Here a file is
only looked through: numbers stay in it to be read by stretches, structs are entered, words are
read, and the rest is named and left alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.arrays import FREE_BYTES
from tactslip_torch.data.formats.mat5_elements import MATRIX, STORED, Element, Flat
from tactslip_torch.data.formats.reading import TimeUnit

MOST_DEPTH = 8
MOST_WORDS = 10_000
_CELL, _STRUCT, _CHAR = 1, 2, 4
_CLASSES = {
    **{6: "d", 7: "f", 8: "b", 9: "B", 10: "h"},
    **{11: "H", 12: "i", 13: "I", 14: "q", 15: "Q"},
}
_OTHERS = {1: "a cell array", 2: "a struct array", 3: "an object", 5: "sparse", 16: "a function"}
_COMPLEX, _LOGICAL = 0x08, 0x02
_CODECS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}


@dataclass(frozen=True)
class Variable:
    """Numbers of a variable, or of a field of a struct, in an open file.

    ``dtype`` is MATLAB's class; ``stored`` what they were written as, which may be smaller.
    """

    name: str
    leaf: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stored: np.dtype[Any]
    file: IO[bytes]
    start: int
    time_unit: TimeUnit | None = None

    def read(self, axis: int, first: int, stop: int) -> NDArray[Any]:
        """What stands from ``first`` to before ``stop`` along that axis; columns lie together.

        Raises:
            ValueError: if the file was cut since it was opened.
        """
        rows, columns = self.shape
        if axis:
            values = self._stretch(first * rows, (stop - first) * rows).reshape(-1, rows).T
        else:
            starts = range(first, columns * rows + first, rows)
            values = np.stack([self._stretch(start, stop - first) for start in starts], 1)
        return values.astype(self.dtype, copy=False)

    def _stretch(self, first: int, count: int) -> NDArray[Any]:
        self.file.seek(self.start + first * self.stored.itemsize)
        content = bytearray(self.file.read(count * self.stored.itemsize))
        if len(content) < count * self.stored.itemsize:
            raise ValueError(f"{self.file.name} was cut while it was read; make it again")
        return np.frombuffer(content, self.stored)


class Found(NamedTuple):
    """What a file holds: numbers, words by name, and what is left alone with the reason."""

    variables: list[Variable]
    words: dict[str, tuple[str, ...]]
    refused: dict[str, str]


def look_through(flat: Flat, elements: Iterable[Element]) -> Found:
    """Every variable of a file, and every field of its structs.

    Raises:
        ValueError: if it is damaged.
    """
    found = Found([], {}, {})
    for element in elements:
        _sort(flat, element, "", found, 0)
    return found


def _sort(flat: Flat, matrix: Element, name: str, found: Found, depth: int) -> None:
    """Enter one variable, or one field of that name."""
    parts = flat.inside(matrix)
    flags = next(parts, None)
    if flags is None:  # how MATLAB writes an empty field
        return
    dims, own = next(parts), next(parts)
    said = int(flat.numbers(flags)[0])
    kind, shape = said & 0xFF, tuple(flat.numbers(dims).tolist())
    name = name or flat.content(own).decode("latin-1")
    if min(shape, default=0) < 1 and kind not in _CLASSES:
        return
    why = _why_not(kind, said >> 8, shape, depth)
    if why is not None:
        found.refused[name] = why
    elif kind == _STRUCT:
        _sort_fields(flat, parts, name, found, depth)
    elif kind == _CELL:
        _sort_cells(flat, parts, name, found)
    elif kind == _CHAR:
        found.words[name] = _rows(flat, next(parts), shape[0])
    else:
        found.variables.append(_variable(flat, next(parts), name, shape, _CLASSES[kind]))


def _why_not(kind: int, flags: int, shape: tuple[int, ...], depth: int) -> str | None:
    """The reason why such a variable is left alone, if there is one."""
    if len(shape) != 2:
        return f"has {len(shape)} dimensions"
    if kind == _STRUCT and shape == (1, 1):
        return f"is nested more than {MOST_DEPTH} deep" if depth == MOST_DEPTH else None
    if kind == _CELL and min(shape) == 1 and max(shape) <= MOST_WORDS:
        return None
    if kind not in (*_CLASSES, _CHAR):
        return f"is {_OTHERS.get(kind, 'an object')}"
    if flags & _COMPLEX:
        return "holds complex numbers"
    return "holds true or false" if flags & _LOGICAL else None


def _variable(
    flat: Flat, numbers: Element, name: str, shape: tuple[int, ...], code: str
) -> Variable:
    stored = np.dtype(flat.order + STORED[numbers.kind])
    if numbers.num_bytes != shape[0] * shape[1] * stored.itemsize:
        raise ValueError("a variable must have as many numbers as it says")
    leaf = name.rpartition(".")[2]
    return Variable(name, leaf, shape, np.dtype(code), stored, flat.file, numbers.start)


def _sort_fields(flat: Flat, parts: Iterator[Element], name: str, found: Found, depth: int) -> None:
    width, packed = int(flat.numbers(next(parts))[0]), flat.content(next(parts))
    if width < 1:
        raise ValueError("fields must have names")
    starts = range(0, len(packed), width)
    names = [packed[at : at + width].split(b"\0")[0].decode("latin-1") for at in starts]
    for field, element in zip(names, parts, strict=True):
        if element.kind == MATRIX:
            _sort(flat, element, f"{name}.{field}", found, depth + 1)


def _sort_cells(flat: Flat, parts: Iterator[Element], name: str, found: Found) -> None:
    """Cells that hold a word each; cells in cells are not entered."""
    words: list[str] = []
    for cell in parts:
        flags = next(flat.inside(cell), None) if cell.kind == MATRIX else None
        if flags is None or int(flat.numbers(flags)[0]) & 0xFF != _CHAR:
            found.refused[name] = "is a cell array"
            return
        inner = Found([], {}, {})
        _sort(flat, cell, name, inner, 0)
        words += inner.words.get(name, ("",))
    found.words[name] = tuple(words)


def _rows(flat: Flat, text: Element, num_rows: int) -> tuple[str, ...]:
    """The rows of a character array, without the blanks that fill them up."""
    if text.num_bytes > FREE_BYTES:
        raise ValueError(f"a text of {text.num_bytes} bytes is not read")
    if text.kind in _CODECS:
        ending = {"<": "-le", ">": "-be"}[flat.order] if text.kind > 16 else ""
        words = flat.content(text).decode(_CODECS[text.kind] + ending)
    else:
        words = flat.numbers(text).astype("<u2").tobytes().decode("utf-16-le")
    if num_rows > len(words):
        raise ValueError("a text must have as many rows as it says")
    return tuple(words[row::num_rows].rstrip(" \0") for row in range(num_rows))
