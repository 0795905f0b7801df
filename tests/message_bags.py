"""Bags as other people's programs write them: by the ``mcap`` and ``rosbags`` libraries."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
WRENCH = "geometry_msgs/msg/WrenchStamped"
START_NS = 1_700_000_000_123_456_789
STEP_NS = 500_000
PACKINGS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@dataclass
class Sent:
    """Messages of one topic: what is written of each is ``(log_time, bytes)``."""

    topic: str
    kind: str
    messages: list[tuple[int, bytes]]
    encoding: str = "cdr"
    schema_encoding: str = "ros2msg"
    schema: str | None = None

    def definition(self) -> str:
        if self.schema is not None:
            return self.schema
        return STORE.generate_msgdef(self.kind, ros_version=2)[0]


def write_mcap(
    path: Path, topics: list[Sent], packing: str = "zstd", chunked: bool = True, index: bool = True
) -> Path:
    """All topics, their messages by turns, in the order they are given."""
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=4096,
            compression=PACKINGS[packing],
            use_chunking=chunked,
            index_types=IndexType.ALL if index else IndexType.NONE,
            use_statistics=index,
            repeat_channels=index,
            repeat_schemas=index,
        )
        writer.start()
        channels = []
        for sent in topics:
            text = sent.definition() if sent.schema_encoding else ""
            schema = writer.register_schema(sent.kind, sent.schema_encoding, text.encode())
            channels.append(writer.register_channel(sent.topic, sent.encoding, schema))
        for place in range(max(len(sent.messages) for sent in topics)):
            for sent, channel in zip(topics, channels, strict=True):
                if place < len(sent.messages):
                    log_time, message = sent.messages[place]
                    writer.add_message(channel, log_time, bytes(message), log_time, place)
        writer.finish()
    return path


def write_bag(path: Path, topics: list[Sent], storage: str = "sqlite3", mode: str = "none") -> Path:
    """A folder of rosbag2; ``mode`` is how it is packed."""
    writer = BagWriter(path, version=8, storage_plugin=StoragePlugin[storage.upper()])
    if mode != "none":
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        for sent in topics:
            channel = writer.add_connection(sent.topic, sent.kind, typestore=STORE)
            for log_time, message in sent.messages:
                writer.write(channel, log_time, message)
    return path


def times(count: int) -> list[int]:
    """Of that many samples at 2 kHz, in nanoseconds since 1970."""
    return [START_NS + STEP_NS * place for place in range(count)]


def wrench(values, nanoseconds: int) -> bytes:
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    whole = STORE.types["geometry_msgs/msg/Wrench"](vector(*values[:3]), vector(*values[3:]))
    return stamped(WRENCH, nanoseconds, whole)


def stamped(kind: str, nanoseconds: int, *fields, store=STORE) -> bytes:
    """A message of a type whose first field is a header."""
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))
    header = store.types["std_msgs/msg/Header"](stamp, "hand")
    return bytes(store.serialize_cdr(store.types[kind](header, *fields), kind))


def array(values, labels=(), sizes=()) -> bytes:
    """An array of ``std_msgs`` with a layout."""
    dimension = STORE.types["std_msgs/msg/MultiArrayDimension"]
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]
    name = "std_msgs/msg/Float64MultiArray"
    dims = [dimension(label, size, 0) for label, size in zip(labels, sizes, strict=True)]
    message = STORE.types[name](layout(dims, 0), np.asarray(values))
    return bytes(STORE.serialize_cdr(message, name))


def json_message(content) -> bytes:
    return json.dumps(content).encode()


def noise(*shape: int, seed: int = 0):
    return np.random.default_rng(seed).standard_normal(shape)


def wrenches(count: int, topic: str = "/ft", seed: int = 0) -> tuple[Sent, np.ndarray]:
    """Wrenches at 2 kHz, stamped, logged some time later; and their numbers ``[6, n]``."""
    values = noise(count, 6, seed=seed)
    messages = [
        (time + 10_000_000, wrench(row, time))
        for time, row in zip(times(count), values, strict=True)
    ]
    return Sent(topic, WRENCH, messages), values.T
