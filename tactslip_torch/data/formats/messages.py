"""Bags of messages: pages of them, by topic; which topic holds samples, and how to decode it."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats.decoding import CdrDecoder, Decoder, JsonDecoder
from tactslip_torch.data.formats.definitions import definition
from tactslip_torch.data.formats.packing import expand_message

OF_ROS = ("/rosout", "/parameter_events", "/tf", "/tf_static", "/clock", "/diagnostics")
"""Topics of the system, which hold no samples though they hold numbers."""


class Topic(NamedTuple):
    """What is known of a topic that has a message.

    Args:
        name: such as ``/tactile``.
        kind: the type of its messages.
        encoding: of the messages: ``cdr``, ``json`` or another.
        schema_encoding: of the text that defines the type, empty if there is none.
        schema: that text.
        first: the first message.
    """

    name: str
    kind: str
    encoding: str
    schema_encoding: str
    schema: str
    first: bytes


class Page(NamedTuple):
    """Messages of one topic: their times of recording in nanoseconds, and what they hold."""

    log_times: NDArray[np.int64]
    messages: list[bytes]


class Bag(Protocol):
    """Messages in files that are open, page by page; a page fits into memory."""

    @property
    def num_pages(self) -> int:
        """How many there are."""

    def page(self, number: int, topic: str) -> Page:
        """The messages of a topic in one page, in the order of the file.

        Raises:
            ValueError: if it is damaged.
        """

    def topics(self) -> dict[str, Topic]:
        """Topics with messages, by name; at least those of the pages read so far."""


class Joined:
    """Several bags as one."""

    def __init__(self, bags: Sequence[Bag]) -> None:
        self._pages = [(bag, number) for bag in bags for number in range(bag.num_pages)]
        self._bags = bags
        self.num_pages = len(self._pages)

    def page(self, number: int, topic: str) -> Page:
        """As ``Bag.page``."""
        bag, inner = self._pages[number]
        return bag.page(inner, topic)

    def topics(self) -> dict[str, Topic]:
        """As ``Bag.topics``."""
        return {name: topic for bag in self._bags for name, topic in bag.topics().items()}


class Packed:
    """A bag in which each message is packed by itself."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self.num_pages = bag.num_pages

    def page(self, number: int, topic: str) -> Page:
        """As ``Bag.page``."""
        page = self._bag.page(number, topic)
        return Page(page.log_times, [expand_message(message) for message in page.messages])

    def topics(self) -> dict[str, Topic]:
        """As ``Bag.topics``."""
        found = self._bag.topics()
        return {
            name: topic._replace(first=expand_message(topic.first)) for name, topic in found.items()
        }


@contextmanager
def named(path: str) -> Iterator[None]:
    """Errors of what is in a file become one line that names it."""
    try:
        yield
    except FileNotFoundError:
        raise
    except ValueError as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path}: {text}") from error
    except (struct.error, OverflowError, OSError, RecursionError, MemoryError) as error:
        raise ValueError(f"{path}: damaged: {error}") from error


def decoder_for(topic: Topic) -> Decoder:
    """What decodes the messages of a topic.

    Raises:
        ValueError: if they are of an encoding that is not read, or hold no samples.
    """
    if topic.encoding == "cdr":
        kind = definition(topic.kind, topic.schema_encoding, topic.schema)
        return CdrDecoder(kind, topic.first)
    if topic.encoding == "json":
        return JsonDecoder(topic.first)
    raise ValueError(f"messages in {topic.encoding!r}; cdr and json are read")


def decoder_of(bag: Bag, wanted: str | None) -> tuple[str, Decoder]:
    """The topic that holds samples and what decodes it: the one wanted, or the only one that can.

    Raises:
        ValueError: if there is no such topic, or more than one.
    """
    topics = _topics(bag, wanted)
    if wanted is not None:
        if wanted not in topics:
            there = ", ".join(sorted(topics)) or "none"
            raise ValueError(f"no message on topic {wanted!r}; its topics are {there}")
        try:
            return wanted, decoder_for(topics[wanted])
        except ValueError as error:
            raise ValueError(f"topic {wanted} cannot be read as samples: {error}") from None
    able: dict[str, Decoder] = {}
    why: list[str] = []
    for name in sorted(topics.keys() - set(OF_ROS)):
        try:
            able[name] = decoder_for(topics[name])
        except ValueError as error:
            why.append(f"{name}: {error}")
    if not able:
        raise ValueError(f"no topic with samples ({'; '.join(why) or 'no messages'})")
    if len(able) > 1:
        raise ValueError(
            f"{len(able)} topics may hold samples, {', '.join(able)}; say which by reading.samples"
        )
    return next(iter(able.items()))


def _topics(bag: Bag, wanted: str | None) -> dict[str, Topic]:
    """Every topic; no page is read beyond the first with the topic that is wanted."""
    for number in range(bag.num_pages):
        if wanted is not None and wanted in bag.topics():
            break
        bag.page(number, "")
    return bag.topics()
