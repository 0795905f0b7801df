"""Where HDF5 keeps texts of any length: heaps that, damaged, keep HDF5 busy or eat the memory.

A free object of no bytes sends HDF5 2.0 round in a circle, and a text that claims gigabytes gets
them. So heaps and what refers to them are looked through here first, and texts are read only if
all is sound. Format: "HDF5 File Format Specification 3.0", III.E and IV.B.
"""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from pathlib import Path

MOST_BYTES = 64 * 2**20
"""Of a file that is looked through; the texts of larger ones are not read."""
_FILE, _HEAP = b"\x89HDF\r\n\x1a\n", b"GCOL"
_HEAD = struct.Struct("<4sB3xQ")  # signature, version, bytes
_OBJECT = struct.Struct("<HH4xQ")  # number, references, bytes
_REFERENCE = struct.Struct("<IQI")  # bytes, address of the heap, number of the object


def has_sound_heaps(path: str | os.PathLike[str]) -> bool:
    """Whether texts of any length can be read from a file."""
    with Path(path).open("rb") as file:
        if not 0 < file.seek(0, os.SEEK_END) <= MOST_BYTES:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            base = max(content.find(_FILE), 0)
            starts = list(_places(content, _HEAP))
            try:
                return bool(starts) and all(_is_sound(content, at, at - base) for at in starts)
            except struct.error:
                return False


def _is_sound(content: mmap.mmap, start: int, address: int) -> bool:
    """Whether a heap ends, and nothing claims more of its objects than they have."""
    sizes: dict[int, int] = {}
    _, version, size = _HEAD.unpack_from(content, start)
    at, end = start + _HEAD.size, start + size
    if version != 1 or address % 8 or end > len(content):
        return False
    while at + _OBJECT.size <= end:
        number, _, num_bytes = _OBJECT.unpack_from(content, at)
        step = _OBJECT.size + num_bytes + -num_bytes % 8 if number else num_bytes
        if step < _OBJECT.size:
            return False
        sizes[number] = num_bytes
        at += step
    for place in _places(content, struct.pack("<Q", address)):
        if 4 <= place <= len(content) - 12:
            claimed, _, number = _REFERENCE.unpack_from(content, place - 4)
            if claimed > sizes.get(number, claimed):
                return False
    return bool(at <= end)


def _places(content: mmap.mmap, wanted: bytes) -> Iterator[int]:
    """Where some bytes stand."""
    place = content.find(wanted)
    while place >= 0:
        yield place
        place = content.find(wanted, place + 1)
