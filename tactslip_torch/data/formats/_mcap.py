"""Recordings as MCAP files, by the library ``mcap``, without ROS."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from tactslip_torch.data.formats._messages import (
    HEADER,
    TOPIC,
    Message,
    Topic,
    Types,
    blocks,
    kind_of,
    opened_messages,
)
from tactslip_torch.data.formats._reading import (
    Opened,
    Reading,
    Refused,
    check_plausible,
    header_in,
    needs,
    text_of,
)

RECORDING = "tactslip_torch recording"
_MOST_CHUNK = 256 * 2**20


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write blocks of samples, and a metadata record with everything else; nothing is packed."""
    writer = needs("mcap.writer", "writing .mcap")
    types, kind = Types(), kind_of(header)
    with path.open("wb") as file:
        output = writer.Writer(file, compression=writer.CompressionType.NONE)
        output.start(profile="ros2", library="tactslip_torch")
        output.add_metadata(RECORDING, {HEADER: text_of(header)})
        schema = output.register_schema(kind, "ros2msg", types.definition(kind).encode())
        channel = output.register_channel(TOPIC, "cdr", schema)
        for number, (time, message) in enumerate(blocks(samples, header, types)):
            output.add_message(channel, time, message, time, number)
        output.finish()


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A file of ours or of others, every message looked at once.

    A file without its end is refused, not read up to there.
    """
    reader = _reader(path, stack)
    return opened_messages(path, _messages(reader), _header(reader), how, stack)


def _reader(path: Path, stack: ExitStack) -> Any:
    """The reader of a file that has its end, and claims no more than is plausible."""
    library = needs("mcap.reader", "reading .mcap")
    file = stack.enter_context(path.open("rb"))
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 37, 0))  # the footer: its kind and length, 20 bytes, and the magic
    footer = file.read()
    if footer[:9] != b"\2\x14\0\0\0\0\0\0\0" or footer[-8:] != b"\x89MCAP0\r\n":
        raise Refused(
            "is damaged or no recording of ours: it is no MCAP file, or ends in the middle; "
            "of such a file mcap recover saves what is there"
        )
    file.seek(0)
    reader = library.SeekingReader(file, validate_crcs=True, record_size_limit=_MOST_CHUNK)
    summary = reader.get_summary()
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes] if summary else []
    check_plausible("its largest chunk", max(sizes, default=0), size, _MOST_CHUNK)
    check_plausible("it", sum(sizes), size)
    return reader


def _header(reader: Any) -> dict[str, Any] | None:
    summary = reader.get_summary()
    if summary is None or all(one.name != RECORDING for one in summary.metadata_indexes):
        return None
    own = next(one.metadata for one in reader.iter_metadata() if one.name == RECORDING)
    return header_in(own.get(HEADER))


def _messages(reader: Any) -> Iterator[Message]:
    """In the order in which they stand in the file."""
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        topic = Topic(channel.topic, "", channel.message_encoding)
        if schema is not None:
            text = schema.data.decode(errors="replace")
            topic = topic._replace(kind=schema.name, schema_encoding=schema.encoding, schema=text)
        yield Message(topic, message.log_time, message.data)
