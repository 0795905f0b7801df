"""An MCAP file as pages of messages: its chunks, or what stands between them."""

from __future__ import annotations

import os
from typing import IO, NamedTuple

import numpy as np

from tactslip_torch.data.formats.header import MOST_HEADER
from tactslip_torch.data.formats.mcap_records import (
    CHANNEL,
    CHUNK,
    MESSAGE,
    METADATA,
    RECORD_HEAD,
    SCHEMA,
    Fields,
    Record,
    content_of,
    inner_records,
    message_of,
    records,
    unpacked,
    unpacked_size,
)
from tactslip_torch.data.formats.messages import Page, Topic
from tactslip_torch.data.formats.packing import MOST_BYTES

MOST_UNPACKED = 100
"""How many times its size a file may unpack to, if that is more than a chunk may."""
_MOST_METADATA = MOST_HEADER + 2**10  # bytes of a record
_PAGE = 2**20  # bytes of messages outside of chunks that make a page


class _Channel(NamedTuple):
    schema: int
    topic: str
    encoding: str


class McapBag:
    """Messages of an open file, and its metadata of one name.

    Raises:
        ValueError: if it is damaged, cut, or would unpack to much more than its size.
    """

    def __init__(self, file: IO[bytes], name: str = "") -> None:
        self._file, self._name = file, name
        self._pages: list[Record] = []
        self._channels: dict[int, _Channel] = {}
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._topics: dict[str, Topic] = {}
        self._met: set[int] = set()  # channels with messages
        self._last: tuple[int, bytes] = (-1, b"")
        self.metadata: dict[str, str] = {}
        self._list_pages()
        self.num_pages = len(self._pages)

    def topics(self) -> dict[str, Topic]:
        """As ``Bag.topics``."""
        return self._topics

    def page(self, number: int, topic: str) -> Page:
        """As ``Bag.page``."""
        content = self._content(number)
        log_times: list[int] = []
        messages: list[bytes] = []
        wanted = self._channels_of(topic)
        for record in inner_records(content):
            if record.kind == MESSAGE:
                message = message_of(content, record)
                if message.channel in wanted:
                    log_times.append(message.log_time)
                    messages.append(content[message.start : message.stop])
                if message.channel not in self._met:
                    self._meet(message.channel, content[message.start : message.stop])
            elif record.kind in (SCHEMA, CHANNEL):
                self._learn(record.kind, content[record.start : record.start + record.size])
                wanted = self._channels_of(topic)
        return Page(np.array(log_times, np.int64), messages)

    def _channels_of(self, topic: str) -> set[int]:
        return {number for number, known in self._channels.items() if known.topic == topic}

    def _list_pages(self) -> None:
        """Chunks are pages; so are messages side by side outside of chunks."""
        size = self._file.seek(0, os.SEEK_END)
        total = 0
        for record in records(self._file):
            if record.kind == CHUNK:
                total += unpacked_size(self._file, record)
                self._pages.append(record)
            elif record.kind in (SCHEMA, CHANNEL, MESSAGE):
                self._extend(record)
            elif record.kind == METADATA and record.size <= _MOST_METADATA:
                fields = Fields(content_of(self._file, record))
                if fields.text() == self._name:
                    self.metadata = fields.texts()
        if total > max(MOST_BYTES, MOST_UNPACKED * size):
            raise ValueError(
                f"{size} bytes that unpack to {total}, more than {MOST_UNPACKED} times as many"
            )

    def _extend(self, record: Record) -> None:
        """Put a record outside of chunks on the last page, if that ends where it begins."""
        whole = Record(MESSAGE, record.start - RECORD_HEAD, record.size + RECORD_HEAD)
        last = self._pages[-1] if self._pages else whole
        is_next = last.kind == MESSAGE and last.start + last.size == whole.start
        if is_next and last.size + whole.size <= _PAGE:
            self._pages[-1] = Record(MESSAGE, last.start, last.size + whole.size)
        else:
            self._pages.append(whole)

    def _content(self, number: int) -> bytes:
        if self._last[0] != number:
            record = self._pages[number]
            is_chunk = record.kind == CHUNK
            content = unpacked(self._file, record) if is_chunk else content_of(self._file, record)
            self._last = (number, content)
        return self._last[1]

    def _learn(self, kind: int, content: bytes) -> None:
        """A schema or channel; what was met before stays."""
        fields = Fields(content)
        number = fields.number(2)
        if kind == SCHEMA:
            name, encoding = fields.text(), fields.text()
            self._schemas.setdefault(number, (name, encoding, fields.take(fields.number(4))))
        else:
            schema, topic, encoding = fields.number(2), fields.text(), fields.text()
            self._channels.setdefault(number, _Channel(schema, topic, encoding))

    def _meet(self, channel: int, message: bytes) -> None:
        """The first message of a topic."""
        known = self._channels.get(channel)
        if known is None:
            raise ValueError(f"damaged: a message of channel {channel}, which is not there")
        self._met.add(channel)
        name, encoding, text = self._schemas.get(known.schema, ("", "", b""))
        schema = text.decode(errors="replace") if encoding == "ros2msg" else ""
        topic = Topic(known.topic, name, known.encoding, encoding, schema, message)
        self._topics.setdefault(known.topic, topic)
