"""The tagged elements that a MAT file of version 5 is made of, with compressed ones unpacked.

Format: "MAT-File Format", The MathWorks, level 5.
"""

from __future__ import annotations

import itertools
import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.arrays import why_not_plausible
from tactslip_torch.data.formats.refusing import Refused

HEADER_BYTES = 128
MOST_VARIABLES = 10_000
MATRIX = 14
STORED = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 9: "d", 12: "q", 13: "Q"}
"""NumPy's code of what numbers are written as, by the element's type."""
_COMPRESSED = 15
_TAG = 8
_TAG_PACKED = 4096  # a tag and the tables of its coding fit
_SLACK = 8  # of padding, which not every writer counts
_STEP = 2**20


class Element(NamedTuple):
    """A tagged piece of a file: its type, and where its content stands."""

    kind: int
    start: int
    num_bytes: int


class Flat(NamedTuple):
    """A file with nothing compressed in it, and how its numbers are written (``<`` or ``>``)."""

    file: IO[bytes]
    order: str

    def inside(self, element: Element) -> Iterator[Element]:
        """The elements that another is made of."""
        return _elements(self.file, element.start, element.start + element.num_bytes, self.order)

    def content(self, element: Element) -> bytes:
        """The bytes of an element."""
        self.file.seek(element.start)
        return self.file.read(element.num_bytes)

    def numbers(self, element: Element) -> NDArray[Any]:
        """The numbers of an element."""
        return np.frombuffer(self.content(element), self.order + STORED[element.kind])


def is_mat5(head: bytes) -> bool:
    """Whether a file that begins so is one of version 5."""
    return head[124:HEADER_BYTES] in (b"\x00\x01IM", b"\x01\x00MI")


def unpacked(file: IO[bytes], stack: ExitStack) -> tuple[Flat, list[Element]]:
    """A file of version 5 and its variables; compressed ones in a temporary file (``TMPDIR``).

    Args:
        file: to be read.
        stack: closes the temporary file.

    Raises:
        Refused: if there are more than ``MOST_VARIABLES``, or compressed ones claim more than
            ``why_not_plausible`` believes.
        ValueError: if the file is damaged.
    """
    file.seek(HEADER_BYTES - 2)
    order = "<" if file.read(2) == b"IM" else ">"
    size = file.seek(0, os.SEEK_END)
    found = _elements(file, HEADER_BYTES, size, order)
    elements = list(itertools.islice(found, MOST_VARIABLES + 1))
    if len(elements) > MOST_VARIABLES:  # eight zeros are an element, in a sparse file too
        raise Refused(f"{file.name} holds more than {MOST_VARIABLES} variables")
    packed = [element for element in elements if element.kind == _COMPRESSED]
    if not packed:
        return Flat(file, order), [element for element in elements if element.kind == MATRIX]
    claims = [_claim(file, element, order) for element in packed]
    why = why_not_plausible(sum(claims), size)
    if why is not None:
        raise Refused(f"{file.name} {why}; save it by MATLAB's -v7.3 or as .h5, read by slices")
    flat = stack.enter_context(tempfile.TemporaryFile())  # noqa: SIM115  # by the stack
    for element, claim in zip(packed, claims, strict=True):
        _unpack(file, element, claim, flat)
    for element in elements:
        if element.kind == MATRIX:
            _copy(file, element, flat)
    found = _elements(flat, 0, flat.tell(), order)
    return Flat(flat, order), [element for element in found if element.kind == MATRIX]


def _elements(file: IO[bytes], start: int, end: int, order: str) -> Iterator[Element]:
    """The elements between two places, each held against what there is."""
    while start + _TAG <= end:
        file.seek(start)
        kind, num_bytes = struct.unpack(f"{order}II", file.read(_TAG))
        is_small = kind >> 16 > 0  # all in eight bytes
        if is_small:
            kind, num_bytes = kind & 0xFFFF, kind >> 16
        start += 4 if is_small else _TAG
        if num_bytes > (4 if is_small else end - start):
            raise ValueError("an element is longer than what it stands in")
        yield Element(kind, start, num_bytes)
        start += 4 if is_small else num_bytes + (0 if kind == _COMPRESSED else -num_bytes % 8)


def _claim(file: IO[bytes], element: Element, order: str) -> int:
    """The number of bytes that a compressed variable says it has, with its tag."""
    file.seek(element.start)
    packed = file.read(min(element.num_bytes, _TAG_PACKED))
    (num_bytes,) = struct.unpack(f"{order}4xI", zlib.decompressobj().decompress(packed, _TAG))
    return _TAG + int(num_bytes)


def _unpack(file: IO[bytes], element: Element, claim: int, flat: IO[bytes]) -> None:
    """Append a compressed variable, stretch by stretch, until its check sum."""
    unpacker, left, room = zlib.decompressobj(), element.num_bytes, claim + _SLACK
    file.seek(element.start)
    while not unpacker.eof:
        packed = unpacker.unconsumed_tail
        if not packed:
            packed = file.read(min(left, _STEP))
            left -= len(packed)
        content = unpacker.decompress(packed, _STEP)
        room -= len(content)
        if room < 0 or not (packed or content):
            raise ValueError("a compressed variable is not what it claims to be")
        flat.write(content[: max(room + len(content) - _SLACK, 0)])
    if room > _SLACK:
        raise ValueError("a compressed variable is cut")
    flat.write(bytes(-flat.tell() % 8))


def _copy(file: IO[bytes], element: Element, flat: IO[bytes]) -> None:
    """Append a variable that is not compressed."""
    start, end = element.start - _TAG, element.start + element.num_bytes
    for first in range(start, end, _STEP):
        file.seek(first)
        flat.write(file.read(min(_STEP, end - first)))
    flat.write(bytes(-flat.tell() % 8))
