"""Recordings as messages: MCAP files, and the folders of rosbag2, without ROS.

Ours have one topic, ``/tactile``, of ``std_msgs/msg/Float32MultiArray`` or ``Float64MultiArray`` in
CDR: a block of up to 0.1 s a message, ``[samples, channels]``, logged at the time of its first
sample on the clock of the recording; metadata hold the rest. Of others are read ``std_msgs``
arrays, any numbers of ROS 2 in CDR, and JSON (MCAP alone), on one topic. Every message is looked
at when a file is opened; samples beyond 64 MiB are kept in a temporary file (``TMPDIR``).
"""

from __future__ import annotations

import json
import keyword
import os
import re
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats._arrays import (
    Array,
    ArraySamples,
    Spool,
    chosen_columns,
    float_for,
    unit_of_time,
)
from tactslip_torch.data.formats._faults import (
    MOST_MEMBERS,
    Refused,
    check_plausible,
    needs,
)
from tactslip_torch.data.formats._header import DTYPES, MOST_HEADER, facts_in, ours, text_of
from tactslip_torch.data.formats._reading import SECONDS, Opened, Reading

_TOPIC = "/tactile"
_NOT_OURS = ("/rosout", "/parameter_events", "/tf", "/tf_static", "/clock", "/diagnostics")
_LOG_TIME = "log_time"
_BLOCK_S = 0.1
_SECOND = 10**9  # in nanoseconds, as all times of messages
_LONGEST = 2**62
_GAP = 1.5  # usual spacings between messages; beyond, something is missing
_MOST_NUMBERS = 4096  # of one instant; a picture is no set of channels
_MOST_CHUNK = 256 * 2**20
_MOST_DEPTH = 16
_STRETCH = 2**16  # rows at a time
_METADATA, _RECORDING = "metadata.yaml", "tactslip_torch recording"
_HEADER, _HEADER_SUM, _SUM = (f"tactslip_torch{e}" for e in ("", "_header_sum", "_message_sum"))
_SAFE = "{}[]:,"  # all else is written as in URLs: YAML writers wrap quoted text, and may err there
_KINDS = {"float32": "Float32MultiArray", "float64": "Float64MultiArray"}
_ARRAY = re.compile(r"std_msgs/msg/(Float|U?Int)(8|16|32|64)MultiArray|std_msgs/msg/ByteMultiArray")


class _Topic(NamedTuple):
    """A topic: its name, the type of its messages, their encoding, and the text that defines it."""

    name: str
    kind: str
    encoding: str
    schema_encoding: str = ""
    schema: str = ""


_Messages = Iterator[tuple[_Topic, int, bytes]]
"""Each message's topic, the time at which it was recorded in nanoseconds, and what it holds."""


# MCAP --------------------------------------------------------------------------------------------


def write_mcap(path: Path, samples: NDArray[Any], facts: Mapping[str, Any]) -> None:
    """Write blocks of samples, and a metadata record with everything else; nothing is packed."""
    writer = needs("mcap.writer", "writing .mcap")
    store = _Store()
    kind = f"std_msgs/msg/{_KINDS[facts['dtype']]}"
    with path.open("wb") as file:
        output = writer.Writer(file, compression=writer.CompressionType.NONE)
        output.start(profile="ros2", library="tactslip_torch")
        output.add_metadata(_RECORDING, _metadata_of(facts))
        schema = output.register_schema(kind, "ros2msg", store.definition(kind).encode())
        channel = output.register_channel(_TOPIC, "cdr", schema)
        for number, (time, message) in enumerate(_blocks(samples, facts, store)):
            output.add_message(channel, time, message, time, number)
        output.finish()


def read_mcap(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A file of ours or of others, every message looked at once.

    Of another's, ``reading.samples`` names the topic; else it is the only one that holds samples.
    A file without its end is refused, not read up to there.
    """
    reader = _mcap_reader(path, stack)
    return _opened(path, _in_mcap(reader), _facts_of_mcap(reader), how, stack)


def facts_mcap(path: Path) -> dict[str, Any] | None:
    """All of a file of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return _facts_of_mcap(_mcap_reader(path, stack))


def _mcap_reader(path: Path, stack: ExitStack) -> Any:
    """The reader of a file that has its end, and claims no more than is plausible."""
    reader = needs("mcap.reader", "reading .mcap")
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
    found = reader.SeekingReader(file, validate_crcs=True, record_size_limit=_MOST_CHUNK)
    summary = found.get_summary()
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes] if summary else []
    check_plausible("its largest chunk", max(sizes, default=0), size, _MOST_CHUNK)
    check_plausible("it", sum(sizes), size)
    return found


def _facts_of_mcap(reader: Any) -> dict[str, Any] | None:
    summary = reader.get_summary()
    if summary is None or all(one.name != _RECORDING for one in summary.metadata_indexes):
        return None
    return _header_in(
        next(one.metadata for one in reader.iter_metadata() if one.name == _RECORDING)
    )


def _in_mcap(reader: Any) -> _Messages:
    """The messages of a file in the order in which they stand there."""
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        said = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        definition = said[2].decode(errors="replace")
        topic = _Topic(channel.topic, said[0], channel.message_encoding, said[1], definition)
        yield topic, message.log_time, message.data


# rosbag2 -----------------------------------------------------------------------------------------


def write_rosbag2(path: Path, samples: NDArray[Any], facts: Mapping[str, Any]) -> None:
    """Write a ``.db3`` file and ``metadata.yaml`` into a folder that is not there yet."""
    bags, store = needs("rosbags.rosbag2", "writing folders of rosbag2"), _Store()
    kind = f"std_msgs/msg/{_KINDS[facts['dtype']]}"
    with tempfile.TemporaryDirectory() as elsewhere:
        plain = Path(elsewhere, "recording")  # "#" and "?" in a path are parts of URLs to SQLite
        with bags.Writer(plain, version=8) as writer:
            channel = writer.add_connection(
                _TOPIC, kind, msgdef=store.definition(kind), rihs01=store.hash_of(kind)
            )
            total = 0
            for time, message in _blocks(samples, facts, store):
                writer.write(channel, time, message)
                total = zlib.crc32(message, total)
            for name, text in (_metadata_of(facts) | {_SUM: _sum(total)}).items():
                writer.set_custom_data(name, quote(text, safe=_SAFE))
        shutil.copytree(plain, path)


def read_rosbag2(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A folder of ours or of others, as ``read_mcap``; several files are one recording."""
    reader = _reader(path, stack)
    facts = _facts_of_bag(reader)
    wanted = None if facts is None else _custom_of(reader).get(_SUM, "")
    return _opened(path, _in_bag(reader), facts, how, stack, wanted)


def facts_rosbag2(path: Path) -> dict[str, Any] | None:
    """All of a folder of ours but its samples; ``None`` if it is another's."""
    with ExitStack() as stack:
        return _facts_of_bag(_reader(path, stack))


def is_bag(path: Path) -> bool:
    """Whether a folder is one of rosbag2."""
    return (path / _METADATA).is_file()


def is_only_bag(path: Path) -> bool:
    """Whether a folder holds the files of a bag and nothing else, so that it may be replaced."""
    if not path.is_dir() or path.is_symlink():
        return False
    inside = list(path.iterdir())
    endings = (".db3", ".mcap", ".yaml")
    return not inside or (is_bag(path) and all(file.suffix in endings for file in inside))


def _reader(path: Path, stack: ExitStack) -> Any:
    """An open bag; its files lie in the folder itself, whatever it says."""
    bags = needs("rosbags.rosbag2", "reading folders of rosbag2")
    if not is_bag(path):
        raise FileNotFoundError(path)
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
    return stack.enter_context(bags.Reader(path))


def _facts_of_bag(reader: Any) -> dict[str, Any] | None:
    return _header_in(_custom_of(reader))


def _custom_of(reader: Any) -> dict[str, str]:
    """What the writer of a bag added, as text."""
    custom = reader.storage.metadata.custom
    pairs = custom.items() if isinstance(custom, dict) else ()
    return {name: unquote(text) for name, text in pairs if isinstance(text, str)}


def _in_bag(reader: Any) -> _Messages:
    topics = {
        one.id: _Topic(one.topic, one.msgtype, "cdr", _encoding(one.msgdef), one.msgdef.data)
        for one in reader.connections
    }
    for connection, time, message in reader.messages():
        yield topics[connection.id], time, bytes(message)


def _encoding(definition: Any) -> str:
    return "ros2msg" if definition.format.name == "MSG" else ""


# Ours --------------------------------------------------------------------------------------------


def _metadata_of(facts: Mapping[str, Any]) -> dict[str, str]:
    """A header with its check sum.

    Raises:
        Refused: if it is longer than is read.
    """
    header = text_of(facts)
    if len(header) > MOST_HEADER:
        raise Refused(
            f"cannot hold provenance, key and the rest of {len(header)} characters, at most "
            f"{MOST_HEADER} are read; keep less in them"
        )
    return {_HEADER: header, _HEADER_SUM: _sum(zlib.crc32(header.encode()))}


def _header_in(metadata: Mapping[str, str]) -> dict[str, Any] | None:
    header = metadata.get(_HEADER)
    if header is not None and metadata.get(_HEADER_SUM) != _sum(zlib.crc32(header.encode())):
        raise ValueError("the header of the recording fails its checksum")
    return facts_in(header)


def _sum(checksum: int) -> str:
    """A CRC-32 as words, which no YAML takes for a number."""
    return f"crc32 {checksum:08x}"


def _blocks(
    samples: NDArray[Any], facts: Mapping[str, Any], store: _Store
) -> Iterator[tuple[int, bytes]]:
    """The samples as messages of up to 0.1 s: nanoseconds since the first sample, and bytes."""
    rate, (num_channels, num_samples) = facts["sample_rate_hz"], samples.shape
    if num_samples / rate * 1e9 >= 2**63 or num_channels > _MOST_NUMBERS:
        raise Refused(
            f"cannot hold {num_channels} channels of {num_samples / rate:g} s: too long for "
            f"messages, or more than {_MOST_NUMBERS}"
        )
    step = max(int(rate * _BLOCK_S), 1)
    for first in range(0, num_samples, step):
        block = np.ascontiguousarray(samples[:, first : first + step].T)
        yield round(first / rate * 1e9), store.array_message(block, _KINDS[facts["dtype"]])


# Types -------------------------------------------------------------------------------------------


class _Store:
    """The types of ROS, and those that files define beside their messages.

    ``rosbags`` makes Python code of definitions. They come from a file that anybody may have
    written, so no more of one than plain names and small sizes is handed on.
    """

    def __init__(self) -> None:
        self._typesys = needs("rosbags.typesys", "reading and writing messages of ROS")
        self._store = self._typesys.get_typestore(self._typesys.Stores.ROS2_JAZZY)

    def definition(self, kind: str) -> str:
        """The text that defines a type of ROS."""
        text: str = self._store.generate_msgdef(kind, ros_version=2)[0]
        return text

    def hash_of(self, kind: str) -> str:
        """What ROS knows the version of a type by."""
        found: str = self._store.hash_rihs01(kind)
        return found

    def array_message(self, block: NDArray[Any], kind: str) -> bytes:
        """Samples ``[n, C]`` as an array of ``std_msgs``, bit for bit."""
        types, (num_samples, num_channels) = self._store.types, block.shape
        dimension = types["std_msgs/msg/MultiArrayDimension"]
        dims = [
            dimension("samples", num_samples, block.size),
            dimension("channels", num_channels, num_channels),
        ]
        layout = types["std_msgs/msg/MultiArrayLayout"](dims, 0)
        message = types[f"std_msgs/msg/{kind}"](layout, block.reshape(-1))
        return bytes(self._store.serialize_cdr(message, f"std_msgs/msg/{kind}", little_endian=True))

    def decoder(self, topic: _Topic) -> tuple[str, Callable[[bytes], Any]]:
        """The full name of a topic's type, and what makes a message of its bytes.

        Raises:
            Refused: if there is no definition that can be used.
        """
        name = topic.kind if "/msg/" in topic.kind else topic.kind.replace("/", "/msg/", 1)
        if name not in self._store.fielddefs:
            if topic.schema_encoding != "ros2msg" or len(topic.schema) > 2**17:
                raise Refused(f"no definition of {name[:80]} as ros2msg, and ROS brings none")
            self._register(name, topic.schema)
        return name, lambda message: self._store.deserialize_cdr(message, name)

    def _register(self, name: str, text: str) -> None:
        try:
            found = self._typesys.get_types_from_msg(text, name)
        except Exception as error:  # the parser raises many kinds
            raise Refused(f"a definition of {name[:80]} that is no ros2msg") from error
        types: dict[str, Any] = {}
        for one, (_, fields) in found.items():  # constants are left out: they may be any text
            words = [*one.split("/"), *(field for field, _ in fields)]
            sizes = [size for _, kind in fields for size in _sizes(kind)]
            if not all(map(_is_plain, words)) or max(sizes, default=0) > _MOST_NUMBERS:
                raise Refused(f"a definition of {name[:80]} with unusual names or sizes")
            types[one] = ([], fields)
        known = self._store.fielddefs
        self._store.register({one: of for one, of in types.items() if one not in known})


def _is_plain(word: str) -> bool:
    return re.fullmatch(r"[A-Za-z]\w{0,99}", word, re.ASCII) is not None and not (
        keyword.iskeyword(word)
    )


def _sizes(kind: Any) -> Iterator[int]:
    """The numbers of elements that a field's type states."""
    what, of = kind
    while what.name in ("ARRAY", "SEQUENCE"):
        yield of[1] or 0
        what, of = of[0]


# Messages as numbers -----------------------------------------------------------------------------


class _Decoder:
    """Messages of one topic as rows of numbers; all hold the same channels as the first.

    Raises:
        Refused: if they are of an encoding that is not read, or hold no samples.
    """

    def __init__(self, topic: _Topic, first: bytes, store: Callable[[], _Store]) -> None:
        self.topic, self.is_array = topic.name, False
        self.dtype: type[Any] = np.float64
        if topic.encoding == "cdr":
            name, self._parse = store().decoder(topic)
            self.is_array = _ARRAY.fullmatch(name) is not None
        elif topic.encoding == "json":
            self._parse = json.loads
        else:
            raise Refused(f"messages in {topic.encoding[:40]!r}; cdr and json are read")
        self._keys: list[tuple[str, int | None]] | None = None
        rows, stamp, _ = self(first)
        self.is_stamped, self.num_columns = stamp is not None, rows.shape[1]
        if not 0 < self.num_columns <= _MOST_NUMBERS:
            raise Refused(f"{self.num_columns} numbers an instant, 1 to {_MOST_NUMBERS} are read")

    @property
    def names(self) -> tuple[str, ...] | None:
        """Of the columns, such as ``wrench.force.x`` or ``position[2]``, if they have any."""
        if self.is_array:
            return None
        return tuple(
            name if count is None else f"{name}[{place}]"
            for name, count in self._keys or ()
            for place in range(1 if count is None else count)
        )

    def __call__(self, message: bytes, column: int | None = None) -> tuple[Any, int | None, Any]:
        """Rows ``[n, C]``, the stamp in nanoseconds if there is one, and one number as it is.

        Raises:
            Refused: if the message is damaged or holds other channels than the first.
        """
        content = self._parse(message)
        if self.is_array:
            rows = _rows_of(content)
            keys: list[tuple[str, int | None]] = [("data", rows.shape[1])]
            self.dtype = np.float32 if float_for(rows.dtype) == torch.float32 else np.float64
            stamp, exact = None, None if column is None else rows[0, column]
        else:
            keys, values = [], list[Any]()
            _collect(content, "", keys, values, _MOST_DEPTH)
            exact = None if column is None else values[column]
            rows, stamp = np.array([values], np.float64), _stamp(content)
        if self._keys is None:
            if len({name for name, _ in keys}) < len(keys):
                raise Refused("two numbers of one name")
            self._keys = keys
        elif keys != self._keys or (stamp is not None) != self.is_stamped:
            raise Refused(
                f"holds a message on {self.topic} with other channels than the first: "
                f"{rows.shape[1]} channels after one with {self.num_columns}, or other names"
            )
        return rows, stamp, exact


def _rows_of(message: Any) -> NDArray[Any]:
    """An array of ``std_msgs`` as samples ``[n, C]``.

    It holds several if a dimension of its layout is called ``samples`` or ``time``, as many as
    that says; else it is one sample.

    Raises:
        Refused: if its numbers are others than its layout says.
    """
    layout, data = message.layout, np.asarray(message.data)
    if layout.data_offset:
        raise Refused(f"a data_offset of {layout.data_offset}, only 0 is read")
    sizes = [dim.size for dim in layout.dim]
    labels = [dim.label.lower() for dim in layout.dim]
    time = next((n for n, label in enumerate(labels) if label.startswith(("sample", "time"))), None)
    if time is None:
        return data.reshape(1, -1)
    if time not in (0, len(sizes) - 1) or data.size != np.prod(sizes, dtype=np.float64):
        raise Refused(f"{data.size} numbers in a layout of {sizes}, time is axis {time}")
    if time == 0:
        return data.reshape(sizes[0], -1)
    return data.reshape(-1, sizes[-1]).T


def _collect(
    part: Any, name: str, keys: list[tuple[str, int | None]], values: list[Any], depth: int
) -> None:
    """All numbers in a message, however nested; times and texts are none, ``null`` is NaN."""
    if depth < 0:
        raise Refused(f"messages nested deeper than {_MOST_DEPTH}")
    if isinstance(part, np.ndarray):
        keys.append((name, part.size))
        values.extend(part.reshape(-1).tolist())
    elif isinstance(part, list):
        for place, value in enumerate(part):
            _collect(value, f"{name}[{place}]", keys, values, depth - 1)
    elif part is None or isinstance(part, (int, float)):
        keys.append((name, None))
        values.append(float("nan") if part is None else part)
    elif isinstance(part, dict) or hasattr(part, "__msgtype__"):
        if _clock(part) is None:
            for inner, value in _fields(part).items():
                _collect(value, f"{name}.{inner}" if name else inner, keys, values, depth - 1)


def _fields(part: Any) -> dict[str, Any]:
    if hasattr(part, "__msgtype__"):
        return {name: value for name, value in vars(part).items() if name != "__msgtype__"}
    return part if isinstance(part, dict) else {}


def _stamp(content: Any) -> int | None:
    """That of the header, or the first time that is a field of its own."""
    fields = _fields(content)
    header = _fields(fields.get("header"))
    own = (part for part in [header.get("stamp"), *fields.values()] if not _is_duration(part))
    return next((stamp for stamp in map(_clock, own) if stamp is not None), None)


def _is_duration(part: Any) -> bool:
    return str(getattr(part, "__msgtype__", "")).endswith("/Duration")


def _clock(part: Any) -> int | None:
    """Nanoseconds of what is only whole seconds and nanoseconds."""
    fields = _fields(part)
    if len(fields) != 2:
        return None
    seconds = next((fields[name] for name in ("sec", "secs") if name in fields), None)
    rest = next((fields[name] for name in ("nanosec", "nsec", "nsecs") if name in fields), None)
    if not isinstance(seconds, int) or not isinstance(rest, int):
        return None
    return seconds * _SECOND + rest


# Topics as samples -------------------------------------------------------------------------------


def _opened(
    path: Path,
    messages: _Messages,
    facts: Mapping[str, Any] | None,
    how: Reading,
    stack: ExitStack,
    wanted_sum: str | None = None,
) -> Opened:
    """The samples of the one topic that holds any, and their times.

    A message's time is the number that ``reading.time`` names or, for ``"log_time"``, that of its
    recording. ``"auto"``: its stamp, unless all stamps are zero; else a number that is called a
    time; else that of its recording. Messages go by their times, those of one time in the order of
    the file; nothing is left out, so what was recorded twice shows in the times.

    Raises:
        Refused: if no topic or more than one holds samples, or the messages are damaged or hold
            not the same channels throughout.
    """
    is_ours = facts is not None and how.samples in (None, _TOPIC)
    if is_ours:
        how = Reading(samples=_TOPIC, time=None)
    topic = _Spooled(how, stack)
    met = topic.take(messages)
    if facts is not None and is_ours:
        if wanted_sum is not None and wanted_sum != _sum(topic.total):
            raise ValueError("the messages fail their checksum")
        dtype = DTYPES[facts["dtype"]]
        if topic.decoder is None:
            empty = Array(path, _TOPIC, np.empty((0, facts["shape"][0])))
            return ours(facts, ArraySamples(empty, 0, dtype=dtype))
        return ours(facts, topic.samples(path, dtype))
    if topic.decoder is None:
        raise Refused(_no_topic(met, how.samples))
    small = topic.decoder.dtype == np.float32
    samples = topic.samples(path, torch.float32 if small else torch.float64)
    names = topic.decoder.names
    chosen = None if names is None else tuple(names[place] for place in topic.columns)
    return Opened(samples, None, chosen, topic.times(how))


def _no_topic(met: Mapping[str, str], wanted: str | None) -> str:
    if wanted is None:
        why = "; ".join(f"{name}: {said}" for name, said in sorted(met.items())) or "no messages"
        return f"has no topic with samples ({why[:800]})"
    if wanted in met:
        return f"cannot be read at topic {wanted}: {met[wanted]}"
    return f"has no message on topic {wanted!r}; its topics are {', '.join(sorted(met)) or 'none'}"


class _Spooled:
    """The samples of the one topic with any, in the order of the file, and when they were taken."""

    def __init__(self, how: Reading, stack: ExitStack) -> None:
        self._how, self._stack = how, stack
        self._store: _Store | None = None
        self.decoder: _Decoder | None = None
        self.columns: list[int] = []
        self.total = 0  # check sum of the messages
        self._time: int | None = None  # the column of times
        self._logged: list[int] = []
        self._stamps: list[int] = []
        self._exact: list[Any] = []
        self._counts: list[int] = []

    def take(self, messages: _Messages) -> dict[str, str]:
        """Go through all messages; topics met, each with the reason why it is not read."""
        met: dict[str, str] = {}
        for topic, log_time, message in messages:
            if self.decoder is not None and topic.name == self.decoder.topic:
                self._add(log_time, message)
                continue
            if topic.name in met:
                continue
            if len(met) > MOST_MEMBERS:
                raise Refused(f"has more than {MOST_MEMBERS} topics")
            met[topic.name] = "is none of samples"
            if self._how.samples not in (None, topic.name):
                continue
            if self._how.samples is None and topic.name in _NOT_OURS:
                continue
            try:
                decoder = _Decoder(topic, message, self._types)
            except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
                met[topic.name] = " ".join(str(error).split())[:200]
                continue
            except Exception as error:  # rosbags' own
                met[topic.name] = f"damaged: {error}"[:200]
                continue
            if self.decoder is not None:
                raise Refused(
                    f"has several topics that may hold samples, {self.decoder.topic}, "
                    f"{topic.name}; say which by reading.samples"
                )
            self._begin(decoder)
            self._add(log_time, message)
        return met

    def samples(self, path: Path, dtype: torch.dtype) -> ArraySamples:
        """All samples in the order of their times."""
        rows, order = self._spool.array(), self._order()
        if order is not None:  # written again in that order
            counts = np.array(self._counts)
            before = (np.cumsum(counts) - counts)[order]  # the first row of each message
            shift = before - (np.cumsum(counts[order]) - counts[order])
            place = np.arange(len(rows)) + np.repeat(shift, counts[order])
            spool = Spool(len(self.columns), rows.dtype.type, self._stack)
            for first in range(0, len(rows), _STRETCH):
                spool.add(rows[place[first : first + _STRETCH]])
            rows = spool.array()
        return ArraySamples(Array(path, "messages", rows), 0, dtype=dtype)

    def times(self, how: Reading) -> _Times | None:
        """Those of all samples; of a single block none, where nobody gives the rate."""
        if how.time is None:
            return None
        times, counts = self._message_times(), np.array(self._counts)
        if (order := self._order()) is not None:
            times, counts = times[order], counts[order]
        spacings = np.diff(times) / counts[:-1]
        if how.sample_rate_hz is not None:
            usual = _SECOND / how.sample_rate_hz
        elif len(spacings):
            usual = float(np.median(spacings))
        elif counts[0] > 1:
            return None
        else:
            usual = 0.0
        spacing = np.full(len(times), usual)
        spacing[:-1] = np.where(spacings > _GAP * usual, usual, spacings)
        return _Times(times, np.cumsum(counts) - counts, spacing, int(counts.sum()))

    def _types(self) -> _Store:
        self._store = self._store or _Store()
        return self._store

    def _begin(self, decoder: _Decoder) -> None:
        how, self.decoder = self._how, decoder
        is_other = decoder.is_stamped or decoder.names is None
        if how.time == _LOG_TIME or (how.time == "auto" and is_other):
            how = replace(how, time=None)
        self._time, self.columns = chosen_columns(decoder.names, decoder.num_columns, how)
        self._spool = Spool(len(self.columns), decoder.dtype, self._stack)

    def _add(self, log_time: int, message: bytes) -> None:
        assert self.decoder is not None
        rows, stamp, exact = self.decoder(message, self._time)
        is_all = len(self.columns) == rows.shape[1] and self.columns == sorted(self.columns)
        self._spool.add(rows if is_all else rows[:, self.columns])
        self.total = zlib.crc32(message, self.total)
        self._logged.append(log_time)
        self._counts.append(len(rows))
        if stamp is not None:
            self._stamps.append(stamp)
        if exact is not None:
            self._exact.append(exact)

    def _message_times(self) -> NDArray[np.int64]:
        """In nanoseconds."""
        if self._time is not None:
            assert self.decoder is not None
            names = self.decoder.names
            unit = unit_of_time(names[self._time] if names else None, self._how)
            return _nanoseconds(np.array(self._exact), SECONDS[unit])
        if self._how.time == "auto" and any(self._stamps):
            return np.array(self._stamps, np.int64)
        return np.array(self._logged, np.int64)

    def _order(self) -> NDArray[np.intp] | None:
        """That of the times; ``None`` if it is that of the file."""
        times = self._message_times()
        return None if (np.diff(times) >= 0).all() else np.argsort(times, kind="stable")


class _Times(NamedTuple):
    """When samples were taken: those of a message spread evenly up to the next.

    Where the next comes later than usual, they are spread as usual, so that the gap shows.
    ``times`` and ``spacing`` are in nanoseconds, ``starts`` the first sample of each message.
    """

    times: NDArray[np.int64]
    starts: NDArray[np.int64]
    spacing: NDArray[np.float64]
    num_samples: int

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``, float64, of the samples in that range."""
        samples = np.arange(first, max(min(stop, self.num_samples), first))
        at = np.searchsorted(self.starts, samples, "right") - 1
        since = (self.times[at] - self.times[0]).astype(np.float64)
        return torch.from_numpy((since + (samples - self.starts[at]) * self.spacing[at]) / _SECOND)


def _nanoseconds(times: NDArray[Any], seconds: float) -> NDArray[np.int64]:
    """Times of a unit of so many seconds; of whole numbers nothing is lost."""
    unit = round(seconds * _SECOND)
    if times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        raise Refused("holds a time that is no number; say reading.time")
    first, last = times.min().item(), times.max().item()
    if (last - first) * unit > _LONGEST:
        raise Refused(f"has times {(last - first) * seconds:g} s apart; see reading.time_unit")
    is_real = times.dtype.kind == "f"
    since = (
        np.round((times - first) * unit) if is_real else (times - times.dtype.type(first)) * unit
    )
    return np.asarray(since, np.int64)
