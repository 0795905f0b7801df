"""Recordings as folders of rosbag2, by the library ``rosbags``, without ROS."""

from __future__ import annotations

import re
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from numpy.typing import NDArray

from tactslip_torch.data.formats._messages import (
    HEADER,
    TOPIC,
    Message,
    Topic,
    Types,
    blocks,
    checksum_text,
    kind_of,
    opened_messages,
)
from tactslip_torch.data.formats._reading import (
    MOST_HEADER,
    Opened,
    Reading,
    Refused,
    header_in,
    needs,
    text_of,
)

_METADATA = "metadata.yaml"
_CHECKSUM = "tactslip_torch_message_sum"
_SAFE = "{}[]:,"  # all else is written as in URLs: YAML writers wrap quoted text, and may err there


def write(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write a ``.db3`` file and ``metadata.yaml`` into a folder that is not there yet."""
    library = needs("rosbags.rosbag2", "writing folders of rosbag2")
    types, kind = Types(), kind_of(header)
    with tempfile.TemporaryDirectory() as elsewhere:
        plain = Path(elsewhere, "recording")  # "#" and "?" in a path are parts of URLs to SQLite
        with library.Writer(plain, version=8) as writer:
            definition, digest = types.definition(kind), types.store.hash_rihs01(kind)
            channel = writer.add_connection(TOPIC, kind, msgdef=definition, rihs01=digest)
            total = 0
            for time, message in blocks(samples, header, types):
                writer.write(channel, time, message)
                total = zlib.crc32(message, total)
            custom = {HEADER: text_of(header), _CHECKSUM: checksum_text(total)}
            for name, text in custom.items():
                writer.set_custom_data(name, quote(text, safe=_SAFE))
        shutil.copytree(plain, path)


def read(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A folder of ours or of others, every message looked at once; several files are one."""
    reader = _reader(path, stack)
    custom = _custom_of(reader)
    own = header_in(custom.get(HEADER))
    checksum = None if own is None else custom.get(_CHECKSUM, "")
    return opened_messages(path, _messages(reader), own, how, stack, checksum)


def _reader(path: Path, stack: ExitStack) -> Any:
    """An open bag; its files lie in the folder itself, whatever it says."""
    library = needs("rosbags.rosbag2", "reading folders of rosbag2")
    for file in path.iterdir():
        if file.is_symlink() and not file.resolve().is_relative_to(path.resolve()):
            raise Refused(f"holds {file.name!r}, which leads out of the folder")
    size = (path / _METADATA).stat().st_size
    if size > 4 * MOST_HEADER:
        raise Refused(f"has {_METADATA} of {size} bytes, at most {4 * MOST_HEADER} are read")
    if re.search(rb"compression_mode:\W*file", (path / _METADATA).read_bytes(), re.IGNORECASE):
        raise Refused("has packed files; unpack them first: ros2 bag convert")
    if re.search(r"[?#%]", str(path)):
        link = Path(stack.enter_context(tempfile.TemporaryDirectory()), "bag")
        link.symlink_to(path.resolve(), target_is_directory=True)
        path = link
    return stack.enter_context(library.Reader(path))


def _custom_of(reader: Any) -> dict[str, str]:
    """What the writer of a bag added, as text."""
    custom = reader.storage.metadata.custom
    pairs = custom.items() if isinstance(custom, dict) else ()
    return {name: unquote(text) for name, text in pairs if isinstance(text, str)}


def _messages(reader: Any) -> Iterator[Message]:
    topics = {}
    for one in reader.connections:
        encoding = "ros2msg" if one.msgdef.format.name == "MSG" else ""
        topics[one.id] = Topic(one.topic, one.msgtype, "cdr", encoding, one.msgdef.data)
    for connection, time, content in reader.messages():
        yield Message(topics[connection.id], time, bytes(content))
