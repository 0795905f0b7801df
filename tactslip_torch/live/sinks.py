"""What a live stream hands on: blocks of samples, events, and the sinks that take decisions.

A sink takes everything in order, from one thread. Whatever it raises ends the stream.
"""

from __future__ import annotations

import json
import math
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.onset.decisions import HOST_COLUMNS, Alarm, Decisions
from tactslip_torch.onset.rules import NOTHING_YET

Array = NDArray[Any]


_MOST_WAITING = 1 << 20
"""Bytes that a program which reads lines may be behind."""
_MOST_READERS, _MOST_TAKEN, _IDLE_S = 16, 256, 10.0
_REPORT_EVERY_S, _REPORT_AT_LEAST_S = 1.0, 60.0


class Block(NamedTuple):
    """Samples that came next, with the channels in the order and units of the detector.

    Attributes:
        samples: ``[n, C]``, float64; NaN for missing ones.
        time_s: when each was taken, by the sender's clock, ``[n]``, float64; ``None``: not known.
    """

    samples: Array
    time_s: Array | None = None


class Placed(NamedTuple):
    """A block and the index of its first sample since the stream's start."""

    first: int
    block: Block


class Event(NamedTuple):
    """What happened to a stream beside its samples.

    Attributes:
        kind: ``"connected"``, ``"waiting"``, ``"lost"``, ``"garbage"``, ``"missing"``,
            ``"dropped"``, ``"gap"``, ``"refused"``, ``"hand"`` or ``"ended"``.
        text: one line for people.
    """

    kind: str
    text: str


class Notices:
    """Counts something and reports it in one line, again only after longer and longer times.

    Args:
        kind: of the event.
        word: what is counted.
        now: seconds of a clock.
    """

    def __init__(self, kind: str, word: str, now: Callable[[], float] = time.monotonic) -> None:
        self._kind, self._word, self._now = kind, word, now
        self._num, self._why, self._since_s = 0, "", 0.0
        self._reported_s, self._every_s = -np.inf, _REPORT_EVERY_S

    def add(self, num: int, why: str) -> None:
        """So many more; the first reason is reported."""
        if not self._num:
            self._why, self._since_s = why, self._now()
        self._num += num

    def events(self, is_over: bool = True, *, at_once: bool = False) -> Iterator[Event]:
        """The line, if it is due: it is over, or has lasted."""
        now = self._now()
        is_due = now - self._reported_s >= self._every_s
        is_due &= is_over or now - self._since_s >= _REPORT_EVERY_S
        if not self._num or not (is_due or at_once):
            return
        is_new = now - self._reported_s > 4 * self._every_s
        self._every_s = _REPORT_EVERY_S if is_new else min(2 * self._every_s, _REPORT_AT_LEAST_S)
        self._reported_s = now
        yield Event(self._kind, f"{counted(self._num, self._word)} {self._why}")
        self._num = 0


def counted(num: int, word: str) -> str:
    """A number and what it counts, such as ``"1 byte"`` and ``"2 bytes"``."""
    return f"{num} {word}{'' if num == 1 else 's'}"


Other = TypeVar("Other")


def merged(items: Iterable[Placed | Other]) -> Iterator[Placed | Other]:
    """Blocks that follow one another without times as one, and what stands between them."""
    run: list[Placed] = []
    for item in [*items, None]:
        follows = False
        if isinstance(item, Placed) and run:
            end = run[-1].first + len(run[-1].block.samples)
            follows = item.first == end and item.block.time_s is run[-1].block.time_s is None
        if run and not follows:
            samples = np.concatenate([block.samples for _, block in run])
            yield Placed(run[0].first, Block(samples, run[0].block.time_s))
            run = []
        if isinstance(item, Placed):
            run.append(item)
        elif item is not None:
            yield item


class Source(Protocol):
    """Blocks of samples as they come, and events between them.

    Attributes:
        name: for people, such as ``"serial:/dev/ttyACM0"``.
        is_live: whether samples come whether or not they are taken: what waits too long is then
            dropped; else the source waits.
        simulated: whether samples are known to be simulated.
    """

    name: str
    is_live: bool
    simulated: bool

    def __iter__(self) -> Iterator[Block | Event]:
        """Blocks and events in order, from one thread; ends with the stream."""

    def close(self) -> None:
        """End the iteration within a fraction of a second; from any thread."""


@dataclass
class Counts:
    """What came of a stream so far.

    Attributes:
        received: samples that came, those included that a source put NaN for.
        dropped: of these, samples that the detector never saw, since it was behind.
        alarms: that were raised.
    """

    received: int = 0
    dropped: int = 0
    alarms: int = 0


class Sink:
    """Where samples, decisions and events of a live stream go; one that does not care does none."""

    def samples(self, first: int, block: Block) -> None:
        """Take samples, before the decisions on them.

        Args:
            first: index of the first since the stream's start; those that were dropped count.
            block: the samples.
        """

    def decisions(self, decisions: Decisions) -> None:
        """Take decisions ``[m]``, as ``StreamingDetector.push`` gives them; ``m`` from 1."""

    def event(self, kind: str, text: str) -> None:
        """Take an ``Event``."""

    def close(self) -> None:
        """The stream has ended: write what is left."""


def decision_columns(decisions: Decisions, *, has_onset: bool) -> dict[str, list[Any]]:
    """Decisions under the names that all hosts give them, as plain JSON values.

    Args:
        decisions: of one stream, ``[m]``.
        has_onset: whether the detector has an onset classifier: only then are there
            ``onset_score``, ``hint`` and ``raised_by``.

    Returns:
        ``time_s``, ``onset_s``, ``score``, ``probability``, ``valid``, ``in_range``,
        ``channels_lost`` (names), ``statistic``, ``alarm`` and ``on`` (``export/README.md``), ``m``
        entries each; ``None`` for what is not finite, and where there is no statistic or score yet.
    """
    is_lost = decisions.channels_lost.any(-1).tolist()
    plain: dict[str, list[Any]] = {
        name: [list(decisions.names_lost(i)) if any_ else [] for i, any_ in enumerate(is_lost)]
        if name == "channels_lost"
        else _known(getattr(decisions, column).tolist())
        for name, column in HOST_COLUMNS.items()
    }
    if has_onset:
        plain["onset_score"] = _known(decisions.onset_score.tolist())
        plain["hint"] = decisions.is_hint.tolist()
        by = zip(plain["alarm"], decisions.by_onset.tolist(), strict=True)
        plain["raised_by"] = [("onset" if o else "status") if alarm else None for alarm, o in by]
    return plain


def _known(values: list[Any]) -> list[Any]:
    """``None`` for what is not finite, or was never."""
    return [value if NOTHING_YET < value < math.inf else None for value in values]


_OF_AN_ALARM = (
    *("time_s", "onset_s", "score", "probability", "valid", "in_range", "channels_lost"),
    "raised_by",
)


class JsonLines(Sink):
    """A JSON line for each alarm, or for each decision, as the hosts of an export print them.

    An event is a line ``{"event": kind, "text": text}``; the last line counts decisions and alarms.

    Args:
        write: takes a text, whole lines; flushes.
        every: whether to write every decision, not alarms alone.
        has_onset: whether the detector has an onset classifier.
        sample_rate_hz: of the stream, for the last line.
    """

    def __init__(
        self,
        write: Callable[[str], object],
        *,
        every: bool = False,
        has_onset: bool = False,
        sample_rate_hz: float,
    ) -> None:
        self._write, self._every, self._has_onset = write, every, has_onset
        self._rate, self._end = sample_rate_hz, 0
        self._num_decisions = self._num_alarms = 0

    def samples(self, first: int, block: Block) -> None:
        """Count them."""
        self._end = first + len(block.samples)

    def decisions(self, decisions: Decisions) -> None:
        """Write their lines at once."""
        is_alarm = decisions.is_alarm.tolist()
        self._num_decisions += len(is_alarm)
        self._num_alarms += sum(is_alarm)
        if not self._every and not any(is_alarm):
            return
        columns = decision_columns(decisions, has_onset=self._has_onset)
        if not self._every:
            columns = {name: columns[name] for name in _OF_AN_ALARM if name in columns}
        rows = zip(*columns.values(), strict=True)
        lines = [
            json.dumps(dict(zip(columns, row, strict=True)))
            for row, alarm in zip(rows, is_alarm, strict=True)
            if self._every or alarm
        ]
        self._write("".join(f"{line}\n" for line in lines))

    def event(self, kind: str, text: str) -> None:
        """Write its line."""
        self._write(json.dumps({"event": kind, "text": text}) + "\n")

    def close(self) -> None:
        """Write the last line."""
        counts = {"decisions": self._num_decisions, "alarms": self._num_alarms}
        self._write(json.dumps({**counts, "seconds": self._end / self._rate}) + "\n")


class Callback(Sink):
    """A function that is called with each alarm.

    Args:
        function: of an ``Alarm``; it holds up the stream until it returns.
        on_event: of the kind and text of an event.
    """

    def __init__(
        self,
        function: Callable[[Alarm], object],
        on_event: Callable[[str, str], object] = lambda kind, text: None,
    ) -> None:
        self._function, self._on_event = function, on_event

    def decisions(self, decisions: Decisions) -> None:
        """Call the function with each alarm."""
        for alarm in decisions.alarms:
            self._function(alarm)

    def event(self, kind: str, text: str) -> None:
        """Call the other function."""
        self._on_event(kind, text)


def listener_at(host: str, port: int) -> socket.socket:
    """A socket that listens there, at any free port for 0.

    Raises:
        OSError: that names the place, if the port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"cannot listen at {host}:{port}: {reason}; give another port") from None


class LineServer:
    """A port on which programs connect to read lines.

    There are at most 16; others are refused. One that is 1 MiB behind, or takes nothing of what
    waits for it for 10 s, is cut off.

    Args:
        host: address to listen at.
        port: to listen at, 0 for any that is free.
        report: is given an ``Event`` where a program is refused or cannot be taken.

    Attributes:
        host: that it listens at.
        port: so.

    Raises:
        OSError: if the port is taken.
    """

    def __init__(
        self, host: str, port: int, report: Callable[[Event], object] = lambda event: None
    ) -> None:
        self._listener = listener_at(host, port)
        self._listener.setblocking(False)
        self.host, self.port = host, int(self._listener.getsockname()[1])
        self._readers: dict[socket.socket, _Reader] = {}
        self._refused, self._report = Notices("refused", "program"), report

    def write(self, text: str) -> None:
        """Send lines to all that are connected, as far as they take them now."""
        self._take()
        now_s = time.monotonic()
        for reader, waiting in list(self._readers.items()):
            if not waiting.content:
                waiting.since_s = now_s
            waiting.content += text.encode()
            try:
                num = reader.send(waiting.content)
            except BlockingIOError:
                num = 0
            except OSError:
                num, waiting.since_s = 0, -np.inf  # gone
            if num:
                del waiting.content[:num]
                waiting.since_s = now_s
            if len(waiting.content) >= _MOST_WAITING or now_s - waiting.since_s > _IDLE_S:
                del self._readers[reader]
                reader.close()

    def _take(self) -> None:
        """Whoever wants to read."""
        try:
            for _ in range(_MOST_TAKEN):
                reader, _peer = self._listener.accept()
                if len(self._readers) < _MOST_READERS:
                    reader.setblocking(False)
                    self._readers[reader] = _Reader(time.monotonic())
                else:
                    reader.close()
                    self._refused.add(1, f"refused: {_MOST_READERS} read lines already")
        except BlockingIOError:
            pass
        except OSError as error:  # of this one, or there is no room for any; asked again
            self._refused.add(1, f"could not be taken: {error.strerror or error}")
        for event in self._refused.events():
            self._report(event)

    def close(self) -> None:
        """No more lines."""
        for each in (self._listener, *self._readers):
            each.close()


@dataclass
class _Reader:
    """What waits for a program, and since when it has taken nothing."""

    since_s: float
    content: bytearray = field(default_factory=bytearray)
