"""Recordings as MCAP files, and rosbag2 folders to read: messages as samples, without ROS.

Package files have one topic, ``/tactile``, of ``std_msgs/msg/Float32MultiArray`` or
``Float64MultiArray`` in CDR: a block of up to 0.1 s a message, ``[samples, channels]``, logged at
the time of its first sample on the clock of the recording; a metadata record holds the rest. Of
foreign ones are read ``std_msgs`` arrays, any numbers of ROS 2 in CDR, and JSON (MCAP alone), on
one topic. Every message is looked at when a file is opened; the samples are kept in a temporary
file (``TMPDIR``).
"""

from __future__ import annotations

import json
import keyword
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.data.formats._inference import SECONDS, Refused, epoch_unit, time_unit_in
from tactslip_torch.data.formats._reading import (
    MOST_MEMBERS,
    Opened,
    Reading,
    Samples,
    Spool,
    StoredArray,
    check_plausible,
    chosen_columns,
    header_in,
    needs,
    opened_from,
    text_of,
)
from tactslip_torch.runtime import setting

TOPIC = "/tactile"
HEADER = "tactslip_torch"
"""Under which metadata have the header."""
_NOT_SAMPLES = ("/rosout", "/parameter_events", "/tf", "/tf_static", "/clock", "/diagnostics")
_NAMES = ("name", "names", "joint_names")
_LOG_TIME = "log_time"
_BLOCK_S = 0.1
RECORDING = "tactslip_torch recording"
_MOST_CHUNK = 256 * 2**20
_SECOND = 10**9  # in nanoseconds, as all times of messages
_GAP = 1.5  # usual spacings between messages; beyond, something is missing
_MOST_NUMBERS = 4096  # of one instant; a picture is no set of channels
_STRETCH = 2**16  # rows at a time
_ARRAY = re.compile(r"std_msgs/msg/(Float|U?Int)(8|16|32|64)MultiArray|std_msgs/msg/ByteMultiArray")


class Topic(NamedTuple):
    """A topic: its name, the type of its messages, their encoding, and the text that defines it."""

    name: str
    kind: str
    encoding: str = "cdr"
    schema_encoding: str = ""
    schema: str = ""


class Message(NamedTuple):
    """A message: its topic, the time at which it was recorded in nanoseconds, and its bytes."""

    topic: Topic
    log_time: int
    content: bytes


# Types -------------------------------------------------------------------------------------------


class Types:
    """The types of ROS, and those that files define beside their messages.

    ``rosbags`` makes Python code of definitions. They come from a file that anybody may have
    written, so no more of one than plain names and small sizes is handed on.
    """

    def __init__(self) -> None:
        self._typesys = needs("rosbags.typesys", "reading and writing messages of ROS")
        self.store = self._typesys.get_typestore(self._typesys.Stores.ROS2_JAZZY)

    def definition(self, kind: str) -> str:
        """The text that defines a type of ROS."""
        return str(self.store.generate_msgdef(kind, ros_version=2)[0])

    def known_name(self, topic: Topic) -> str:
        """The full name of a topic's type, of which messages can be read then.

        Raises:
            Refused: if there is no definition that can be used.
        """
        name = topic.kind if "/msg/" in topic.kind else topic.kind.replace("/", "/msg/", 1)
        known = self.store.fielddefs
        if name in known:
            return name
        if topic.schema_encoding != "ros2msg" or len(topic.schema) > 2**17:
            raise Refused(f"no definition of {name[:80]} as ros2msg, and ROS brings none")
        try:
            found = self._typesys.get_types_from_msg(topic.schema, name)
        except Exception as error:  # the parser raises many kinds
            raise Refused(f"a definition of {name[:80]} that is no ros2msg") from error
        types: dict[str, Any] = {}
        for one, (_, fields) in found.items():  # constants are left out: they may be any text
            words = [*one.split("/"), *(field for field, _ in fields)]
            sizes = [size for _, kind in fields for size in _sizes(kind)]
            if not all(map(_is_plain, words)) or max(sizes, default=0) > _MOST_NUMBERS:
                raise Refused(f"a definition of {name[:80]} with unusual names or sizes")
            types[one] = ([], fields)
        self.store.register({one: of for one, of in types.items() if one not in known})
        return name


def _is_plain(word: str) -> bool:
    is_word = re.fullmatch(r"[A-Za-z]\w{0,99}", word, re.ASCII) is not None
    return is_word and not keyword.iskeyword(word)


def _sizes(kind: Any) -> Iterator[int]:
    """The numbers of elements that a field's type states."""
    what, of = kind
    while what.name in ("ARRAY", "SEQUENCE"):
        yield of[1] or 0
        what, of = of[0]


# Package files -----------------------------------------------------------------------------------


def kind_of(header: Mapping[str, Any]) -> str:
    """The type of the messages that hold the samples."""
    bits = header["dtype"].removeprefix("float")
    return f"std_msgs/msg/Float{bits}MultiArray"


# Messages as numbers -----------------------------------------------------------------------------


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
    return data.reshape(sizes[0], -1) if time == 0 else data.reshape(-1, sizes[-1]).T


def _numbers(part: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """All numbers in a message by name, such as ``wrench.force.x``; arrays are one list.

    Where a field names as many words as arrays beside it have elements, each has its word:
    ``position[wrist]``. Times and texts are none, ``null`` is NaN.
    """
    if isinstance(part, np.ndarray):
        yield name, part.reshape(-1)[: _MOST_NUMBERS + 1].tolist()
    elif isinstance(part, list):
        for place, value in enumerate(part):
            yield from _numbers(value, f"{name}[{place}]")
    elif part is None or isinstance(part, (int, float)):
        yield name, float("nan") if part is None else part
    elif _clock(part) is None:
        fields = _fields(part)
        words = _words_in(fields)
        for inner, value in fields.items():
            whole = f"{name}.{inner}" if name else inner
            if words and isinstance(value, np.ndarray | list) and len(value) == len(words):
                elements = value if isinstance(value, list) else value.tolist()
                for word, element in zip(words, elements, strict=True):
                    yield from _numbers(element, f"{whole}[{word}]")
            else:
                yield from _numbers(value, whole)


def _words_in(fields: Mapping[str, Any]) -> list[str]:
    """The words of a field that names the elements of those beside it, as those of joints."""
    for name in _NAMES:
        words = fields.get(name)
        if isinstance(words, list) and all(isinstance(word, str) for word in words):
            return words if len(set(words)) == len(words) else []
    return []


@lru_cache(maxsize=64)
def _places(name: str, count: int) -> tuple[str, ...]:
    """Names of an array's numbers, kept: every message of a topic has the same."""
    return tuple(f"{name}[{place}]" for place in range(count))


def _fields(part: Any) -> dict[str, Any]:
    """The fields of a message, if it is one; of a duration none, since it is no time."""
    if isinstance(part, dict):
        return part
    kind = str(getattr(part, "__msgtype__", ""))
    if not kind or kind.endswith("/Duration"):
        return {}
    return {name: value for name, value in vars(part).items() if name != "__msgtype__"}


def _stamp(content: Any) -> int | None:
    """That of the header, or the first time that is a field of its own."""
    fields = _fields(content)
    own = [_fields(fields.get("header")).get("stamp"), *fields.values()]
    return next((stamp for stamp in map(_clock, own) if stamp is not None), None)


def _clock(part: Any) -> int | None:
    """Nanoseconds of what is only whole seconds and nanoseconds."""
    fields = _fields(part)
    seconds = next((fields[name] for name in ("sec", "secs") if name in fields), None)
    rest = next((fields[name] for name in ("nanosec", "nsec", "nsecs") if name in fields), None)
    if len(fields) != 2 or not isinstance(seconds, int) or not isinstance(rest, int):
        return None
    return seconds * _SECOND + rest


# A topic as samples ------------------------------------------------------------------------------


class TopicColumns:
    """Which numbers of the messages on a topic are samples: what its first message shows.

    Args:
        first: message; all others must hold the same channels.
        types: that its messages are of; ``None`` for JSON.
        how: what a person says of the topic.

    Attributes:
        num_channels: of the samples.
        names: of the channels, if messages have names.
        time_name: of the number that is the time, since nothing else is.
        is_paired: whether that is whole seconds, and another the nanoseconds beyond.
        is_small: whether float32 holds all numbers.
        left_out: names of numbers that are no channels by what they are called.

    Raises:
        Refused: if the messages hold no samples.
    """

    def __init__(self, first: Message, types: Types | None, how: Reading) -> None:
        self.topic, self._types = first.topic.name, types
        self._kind = types.known_name(first.topic) if types is not None else ""
        self._is_array = _ARRAY.fullmatch(self._kind) is not None
        rows, names, stamp = self._decoded(first.content)
        num_columns, is_stamped = rows.shape[1], stamp is not None
        self._alike = names, num_columns, is_stamped  # in all messages
        if not 0 < num_columns <= _MOST_NUMBERS:
            what = f"{num_columns}" if num_columns <= _MOST_NUMBERS else f"over {_MOST_NUMBERS}"
            raise Refused(f"{what} numbers an instant, 1 to {_MOST_NUMBERS} are read")
        if names is not None and len(set(names)) < num_columns:
            raise Refused("two numbers of one name")
        if how.time == _LOG_TIME or (how.time == "auto" and (is_stamped or names is None)):
            how = replace(how, time=None)
        self._chosen = chosen_columns(names, num_columns, replace(how, label=None))
        time, named = self._chosen.time, names or ()
        self.names = None if names is None else tuple(named[n] for n in self._chosen.channels)
        self.time_name = named[time] if named and time is not None else None
        self.is_paired = self._chosen.nanoseconds is not None
        self.left_out = tuple(named[n] for n in self._chosen.left_out)
        self.num_channels = len(self._chosen.channels)
        self.is_small = self._is_array and np.can_cast(rows.dtype, np.float32)

    def _decoded(self, message: bytes) -> tuple[NDArray[Any], tuple[str, ...] | None, int | None]:
        """Rows ``[n, C]``, the names of their columns and the stamp, where there are any."""
        if self._types is None:
            content = json.loads(message)
        else:
            content = self._types.store.deserialize_cdr(message, self._kind)
        if self._is_array:
            return _rows_of(content), None, None
        found = list(islice(_numbers(content), _MOST_NUMBERS + 1))
        values: list[Any] = []
        names: list[str] = []
        for name, value in found:
            if isinstance(value, list):
                values += value
                names += _places(name, len(value))
            else:
                values.append(value)
                names.append(name)
        return np.array([values], object), tuple(names), _stamp(content)

    def rows(self, content: bytes) -> tuple[NDArray[Any], int | None, Any]:
        """The samples ``[n, C]`` of a message, its stamp and the time that is one of its numbers.

        Raises:
            Refused: if it holds other channels than the first.
        """
        rows, names, stamp = self._decoded(content)
        first = self._alike[0]
        if names != first and names and first and sorted(names) == sorted(first):
            places = {name: place for place, name in enumerate(names)}
            rows, names = rows[:, [places[name] for name in first]], first
        if (names, rows.shape[1], stamp is not None) != self._alike:
            raise Refused(
                f"holds a message on {self.topic} with other channels than the first: "
                f"{rows.shape[1]} numbers, or other names"
            )
        time = self._chosen.time
        named = None if time is None else rows[0, time]
        if self._chosen.nanoseconds is not None:
            named = int(rows[0, time]) * _SECOND + int(rows[0, self._chosen.nanoseconds])
        return rows[:, self._chosen.channels], stamp, named


class _TopicSamples(TopicColumns):
    """The samples of a topic in the order of the file, and when they were taken.

    Args:
        first: as of ``TopicColumns``, whose errors it raises; like ``types`` and ``how``.
        stack: closes what is kept.
    """

    def __init__(self, first: Message, types: Types | None, how: Reading, stack: ExitStack) -> None:
        super().__init__(first, types, how)
        self._how, self._stack = how, stack
        self.spool = Spool(self.num_channels, "f4" if self.is_small else "f8", stack)
        self._marks: list[tuple[int, int, int]] = []  # when recorded, stamp or 0, samples
        self._named: list[Any] = []  # the times that ``how`` names

    def add(self, message: Message) -> None:
        """Keep a message.

        Raises:
            Refused: if it is damaged or holds other channels than the first.
        """
        rows, stamp, named = self.rows(message.content)
        self.spool.add(rows)
        self._marks.append((message.log_time, stamp or 0, len(rows)))
        if named is not None:
            self._named.append(named)

    def ordered(self) -> tuple[StoredArray, NDArray[np.float64] | None]:
        """All samples ``[T, C]`` in the order of their times, and these in seconds.

        No times if nobody asks for them, or of a single block where nobody gives the rate.
        """
        rows, (logged, stamps, counts) = self.spool.array(), np.array(self._marks, np.int64).T
        times = stamps if self._how.time == "auto" and stamps.any() else logged
        if times is stamps and (stamps == 0).sum() > 1:  # one alone may be where a clock begins
            raise Refused(
                f"has no stamp in message {int(np.argmin(stamps != 0)) + 1} on {self.topic}, and "
                f"one in others; say {setting('reading.time')}=log_time to go by the times of "
                "recording"
            )
        if self._named:
            times = self._named_times()
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            starts = np.cumsum(counts) - counts  # the first row of each message
            place = np.concatenate([np.arange(starts[n], starts[n] + counts[n]) for n in order])
            spool = Spool(rows.shape[1], rows.dtype, self._stack)
            for first in range(0, len(rows), _STRETCH):
                spool.add(rows[place[first : first + _STRETCH]])
            rows, times, counts = spool.array(), times[order], counts[order]
        return rows, None if self._how.time is None else self._seconds(times, counts)

    def _named_times(self) -> NDArray[np.int64]:
        """Nanoseconds since the least of the times that are numbers in messages."""
        times = np.array(self._named)
        if times.dtype.kind not in "iuf" or not np.isfinite(times).all():
            raise Refused(f"holds a time that is no number; say {setting('reading.time')}")
        unit = "ns" if self.is_paired else self._how.time_unit or time_unit_in(self.time_name)
        seconds = SECONDS[unit or epoch_unit(float(times.max())) or "s"]
        return np.asarray(np.round((times - times.min()) * round(seconds * _SECOND)), np.int64)

    def _seconds(
        self, times: NDArray[np.int64], counts: NDArray[np.int64]
    ) -> NDArray[np.float64] | None:
        """When each sample was taken, from the first; those of a message up to the next.

        Where the next message comes later than usual, samples are spread as usual, so that the gap
        shows.
        """
        spacings = np.diff(times) / counts[:-1]
        if self._how.sample_rate_hz is None and not len(spacings) and counts[0] > 1:
            return None
        usual = float(np.median(spacings)) if len(spacings) else 0.0
        if self._how.sample_rate_hz is not None:
            usual = _SECOND / self._how.sample_rate_hz
        spacing = np.append(np.where(spacings > _GAP * usual, usual, spacings), usual)
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        since = np.repeat((times - times[0]).astype(np.float64), counts)
        return np.asarray((since + number * np.repeat(spacing, counts)) / _SECOND)


def _opened_messages(
    path: Path,
    messages: Iterable[Message],
    header: Mapping[str, Any] | None,
    how: Reading,
    stack: ExitStack,
) -> Opened:
    """The samples of the one topic that holds any, and their times.

    A message's time is the number that ``reading.time`` names or, for ``"log_time"``, that of its
    recording. ``"auto"``: its stamp, unless all stamps are zero; else a number that is called a
    time; else that of its recording. Messages go by their times, those of one time in the order of
    the file; nothing is left out, so what was recorded twice shows in the times.

    Args:
        path: of the file or folder.
        messages: in it, of all topics.
        header: of a package file.
        how: what a person says of the file; ``samples`` names the topic.
        stack: closes what is kept.

    Raises:
        Refused: if no topic or more than one holds samples, or the messages are damaged or hold
            not the same channels throughout.
    """
    if header is not None and how.samples in (None, TOPIC):
        topic, _ = _read_topic(messages, Reading(samples=TOPIC, time=None), stack)
        rows = topic.spool.array() if topic else np.empty((0, len(header["channels"])))
        return opened_from(header, path, Samples(path, rows))
    topic, others = _read_topic(messages, how, stack)
    if topic is not None:
        rows, seconds = topic.ordered()
        stamps = None if seconds is None else Samples(path, [seconds])
        return Opened(Samples(path, rows), None, topic.names, stamps, left_out=topic.left_out)
    if how.samples is None:
        reasons = (
            "; ".join(f"{name}: {why}" for name, why in sorted(others.items())) or "no messages"
        )
        raise Refused(f"has no topic with samples ({reasons[:800]})")
    if how.samples in others:
        raise Refused(f"cannot be read at topic {how.samples}: {others[how.samples]}")
    known = ", ".join(sorted(others)) or "none"
    raise Refused(f"has no message on topic {how.samples!r}; its topics are {known}")


def _read_topic(
    messages: Iterable[Message], how: Reading, stack: ExitStack
) -> tuple[_TopicSamples | None, dict[str, str]]:
    """The one topic that holds samples, all messages looked at, and why each other is not read."""
    found: _TopicSamples | None = None
    types: Types | None = None
    others: dict[str, str] = {}
    for message in messages:
        topic = message.topic
        if found is not None and topic.name == found.topic:
            found.add(message)
            continue
        if topic.name in others:
            continue
        if len(others) > MOST_MEMBERS:
            raise Refused(f"has more than {MOST_MEMBERS} topics")
        others[topic.name] = "is none of samples"
        if how.samples != topic.name and (how.samples or topic.name in _NOT_SAMPLES):
            continue
        if topic.encoding not in ("cdr", "json"):
            others[topic.name] = f"messages in {topic.encoding[:40]!r}; cdr and json are read"
            continue
        try:
            if topic.encoding == "cdr":
                types = types or Types()
            one = _TopicSamples(message, types if topic.encoding == "cdr" else None, how, stack)
        except Exception as error:  # rosbags and json raise many kinds
            others[topic.name] = " ".join(str(error).split())[:200] or type(error).__name__
            continue
        if found is not None:
            raise Refused(
                f"has several topics that may hold samples, {found.topic}, "
                f"{topic.name}; say which by {setting('reading.samples')}"
            )
        found = one
        found.add(message)
    return found, others


def _counted(messages: Iterable[Message], stated: int | None) -> Iterator[Message]:
    """The messages, which must be as many as the metadata of their file say, if they do."""
    count = 0
    for message in messages:
        count += 1
        yield message
    if stated is not None and count != stated:
        raise Refused(
            f"holds {count} messages, where its metadata say {stated}: it is damaged or a part; "
            "mcap recover, or ros2 bag reindex, saves what is there"
        )


# MCAP, by the library ``mcap`` ------------------------------------------------------------------


def write_mcap(path: Path, samples: NDArray[Any], header: Mapping[str, Any]) -> None:
    """Write blocks of samples, and a metadata record with everything else; nothing is packed."""
    writer = needs("mcap.writer", "writing .mcap")
    types, kind, rate = Types(), kind_of(header), header["sample_rate_hz"]
    num_channels, num_samples = samples.shape
    if num_channels > _MOST_NUMBERS:
        raise Refused(f"cannot hold {num_channels} channels, at most {_MOST_NUMBERS} are read")
    known = types.store.types
    axis, layout = (known[f"std_msgs/msg/MultiArray{part}"] for part in ("Dimension", "Layout"))
    step = max(int(rate * _BLOCK_S), 1)
    with path.open("wb") as file:
        output = writer.Writer(file, compression=writer.CompressionType.NONE)
        output.start(profile="ros2", library="tactslip_torch")
        output.add_metadata(RECORDING, {HEADER: text_of(header)})
        schema = output.register_schema(kind, "ros2msg", types.definition(kind).encode())
        channel = output.register_channel(TOPIC, "cdr", schema)
        for number, first in enumerate(range(0, num_samples, step)):
            block = np.ascontiguousarray(samples[:, first : first + step].T)
            axes = [axis("samples", len(block), block.size)]
            axes += [axis("channels", num_channels, num_channels)]
            message = known[kind](layout(axes, 0), block.reshape(-1))
            content = bytes(types.store.serialize_cdr(message, kind, little_endian=True))
            time = round(first / rate * _SECOND)
            output.add_message(channel, time, content, time, number)
        output.finish()


def read_mcap(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A native or foreign file, every message looked at once, in the order of the file.

    A file without its end is refused, not read up to there.
    """
    library = needs("mcap.reader", "reading .mcap")
    file = stack.enter_context(path.open("rb"))
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - 37, 0))  # the footer: its kind and length, 20 bytes, and the magic
    footer = file.read()
    if footer[:9] != b"\2\x14\0\0\0\0\0\0\0" or footer[-8:] != b"\x89MCAP0\r\n":
        raise Refused(
            "is damaged or no recording: it is no MCAP file, or ends in the middle; "
            "of such a file mcap recover saves what is there"
        )
    file.seek(0)
    reader = library.SeekingReader(file, validate_crcs=True, record_size_limit=_MOST_CHUNK)
    summary = reader.get_summary()
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes] if summary else []
    check_plausible("its largest chunk", max(sizes, default=0), size, _MOST_CHUNK)
    check_plausible("it", sum(sizes), size)
    header = None
    if summary and any(one.name == RECORDING for one in summary.metadata_indexes):
        own = next(one.metadata for one in reader.iter_metadata() if one.name == RECORDING)
        header = header_in(own.get(HEADER))
    statistics = summary and summary.statistics
    found = map(_mcap_message, reader.iter_messages(log_time_order=False))
    messages = _counted(found, statistics and statistics.message_count)
    return _opened_messages(path, messages, header, how, stack)


def _mcap_message(found: tuple[Any, Any, Any]) -> Message:
    schema, channel, message = found
    topic = Topic(channel.topic, "", channel.message_encoding)
    if schema is not None:
        text = schema.data.decode(errors="replace")
        topic = topic._replace(kind=schema.name, schema_encoding=schema.encoding, schema=text)
    return Message(topic, message.log_time, message.data)


# rosbag2, by the library ``rosbags`` ------------------------------------------------------------


def read_rosbag2(path: Path, how: Reading, stack: ExitStack) -> Opened:
    """A folder, every message looked at once; several files are one recording."""
    library = needs("rosbags.rosbag2", "reading folders of rosbag2")
    for file in path.iterdir():
        if file.is_symlink() and not file.resolve().is_relative_to(path.resolve()):
            raise Refused(f"holds {file.name!r}, which leads out of the folder")
    folder = path
    if re.search(r"[?#%]", str(path)):  # parts of URLs to SQLite
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()), "bag")
        folder.symlink_to(path.resolve(), target_is_directory=True)
    reader = stack.enter_context(library.Reader(folder))
    topics = {}
    for one in reader.connections:
        encoding = "ros2msg" if one.msgdef.format.name == "MSG" else ""
        topics[one.id] = Topic(one.topic, one.msgtype, "cdr", encoding, one.msgdef.data)
    found = (Message(topics[one.id], time, bytes(data)) for one, time, data in reader.messages())
    return _opened_messages(path, _counted(found, reader.message_count), None, how, stack)
