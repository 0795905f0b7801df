"""The records of an MCAP file, read with every length held against the file.

The ``mcap`` library writes ours but does not read: it takes lengths and unpacked sizes as a file
states them, and a short read for a whole one. Here nothing larger than stated is unpacked, and
checksums are checked. Indices are not needed: going from record to record costs a small read a
chunk, and an index may lie. See the format's specification for the layout of records.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from typing import IO, NamedTuple

from tactslip_torch.data.formats.packing import MOST_BYTES, expand

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
METADATA = 12
_FOOTER, _DATA_END = 2, 15
_RECORD = struct.Struct("<BQ")
RECORD_HEAD = _RECORD.size
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")


class Record(NamedTuple):
    """Where a record is in the file: its kind, the first byte of its content, and its length."""

    kind: int
    start: int
    size: int


class Message(NamedTuple):
    """A message: its channel, its time in nanoseconds, and where its bytes are."""

    channel: int
    log_time: int
    start: int
    stop: int


class Fields:
    """Fields of a record one after the other; none beyond its end."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._place = 0

    def take(self, size: int) -> bytes:
        """So many bytes."""
        stop = self._place + size
        if stop > len(self._content):
            raise ValueError("damaged: a record shorter than its fields")
        part = self._content[self._place : stop]
        self._place = stop
        return part

    def number(self, size: int) -> int:
        """A number of so many bytes."""
        return int.from_bytes(self.take(size), "little")

    def text(self) -> str:
        """A text, its length before it."""
        return self.take(self.number(4)).decode()

    def texts(self) -> dict[str, str]:
        """Texts by text, all of their bytes counted before them."""
        inner = Fields(self.take(self.number(4)))
        found = {}
        while not inner.is_empty:
            name = inner.text()
            found[name] = inner.text()
        return found

    @property
    def is_empty(self) -> bool:
        """Whether none is left."""
        return self._place == len(self._content)


def records(file: IO[bytes]) -> Iterator[Record]:
    """The records of the data section in order; nothing but their heads is read.

    Raises:
        ValueError: if this is no MCAP file, or it does not go on to its end.
    """
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise ValueError("no MCAP file")
    file.seek(max(end - len(MAGIC), 0))
    if file.read(len(MAGIC)) != MAGIC or end < 2 * len(MAGIC):
        raise ValueError(
            "ends in the middle: its recorder was stopped or a copy cut short; `mcap recover` "
            "writes a file of what is whole"
        )
    place = len(MAGIC)
    while True:
        file.seek(place)
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise ValueError("damaged: its data have no end")
        kind, size = _RECORD.unpack(head)
        start = place + _RECORD.size
        place = start + size
        if kind == 0 or place > end:
            raise ValueError(f"damaged at byte {start - _RECORD.size}")
        if kind in (_DATA_END, _FOOTER):
            return
        yield Record(kind, start, size)


def content_of(file: IO[bytes], record: Record) -> bytes:
    """All of a record.

    Raises:
        ValueError: if it is too long or the file was cut.
    """
    if record.size > MOST_BYTES:
        raise ValueError(f"a record of {record.size} bytes, at most {MOST_BYTES} are read")
    file.seek(record.start)
    content = file.read(record.size)
    if len(content) < record.size:
        raise ValueError("was cut while it was read")
    return content


def unpacked_size(file: IO[bytes], chunk: Record) -> int:
    """What a chunk says it unpacks to."""
    file.seek(chunk.start)
    head = file.read(_CHUNK.size)
    if len(head) < _CHUNK.size or chunk.size < _CHUNK.size:
        raise ValueError(f"damaged at byte {chunk.start}")
    size: int = _CHUNK.unpack(head)[2]
    return size


def unpacked(file: IO[bytes], chunk: Record) -> bytes:
    """The records in a chunk, checked against its checksum if it has one.

    Raises:
        ValueError: if it is damaged or too large, or packed in a way that is not known.
    """
    fields = Fields(content_of(file, chunk))
    _, _, size, checksum = _CHUNK.unpack(fields.take(_CHUNK.size))
    packing = fields.text()
    content = expand(packing, fields.take(fields.number(8)), size)
    if checksum and zlib.crc32(content) != checksum:
        raise ValueError(f"damaged: the chunk at byte {chunk.start} fails its checksum")
    return content


def inner_records(content: bytes) -> Iterator[Record]:
    """Where the records of a chunk are in it.

    Raises:
        ValueError: if one goes beyond its end.
    """
    place = 0
    while place < len(content):
        if place + _RECORD.size > len(content):
            raise ValueError("damaged: a chunk with an end of a record")
        kind, size = _RECORD.unpack_from(content, place)
        place += _RECORD.size
        if place + size > len(content):
            raise ValueError("damaged: a record larger than its chunk")
        yield Record(kind, place, size)
        place += size


def message_of(content: bytes, record: Record) -> Message:
    """A message that stands in those bytes."""
    if record.size < _MESSAGE.size:
        raise ValueError("damaged: a message without a head")
    channel, _, log_time, _ = _MESSAGE.unpack_from(content, record.start)
    return Message(channel, log_time, record.start + _MESSAGE.size, record.start + record.size)
