"""Where the samples of a live stream come from: serial port, socket, standard input, file.

A source connects again by itself; what happens to it comes as events among the blocks.
"""

from __future__ import annotations

import os
import selectors
import socket
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tactslip_torch.data.file_recordings import hand_file
from tactslip_torch.data.formats import Reading, pieces
from tactslip_torch.data.formats._reading import needs
from tactslip_torch.live.frames import FrameReader, Frames
from tactslip_torch.live.sinks import Block, Event, Source, listener_at
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.runtime import check_number

RETRY_S = 0.5
"""Between two tries to connect."""
SILENT_S = 2.0
"""Without a byte, after which a source is reported as waiting."""
_POLL_S = 0.1  # in which a source notices that it is closed
_MOST_BYTES = 1 << 16  # of a read
_PIECE_S, _BLOCK_S = 1.0, 0.005  # of a file: what is read at once, and what is handed on at once
_AGAIN = f"tries again every {RETRY_S:g} s"
KINDS = "serial:PORT, tcp:HOST:PORT, listen:PORT, ros2:TOPIC, stdin, or a file"


def address_of(text: str, what: str) -> tuple[str, int]:
    """Host and port of ``[HOST:]PORT``.

    Raises:
        ValueError: if it is none.

    Example:
        >>> address_of("9000", "listen"), address_of("[::1]:80", "tcp")
        (('127.0.0.1', 9000), ('::1', 80))
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not int(port) < 1 << 16:
        raise ValueError(f"{what} needs [HOST:]PORT with a port from 0 to 65535, got {text!r}")
    return host.strip("[]") or "127.0.0.1", int(port)


# Bytes -------------------------------------------------------------------------------------------


class _Connection(NamedTuple):
    """An open one.

    Attributes:
        read: what came, after at most ``_POLL_S``; ``b""``: nothing; ``None``: it has ended.
        close: gives it back.
    """

    read: Callable[[], bytes | None]
    close: Callable[[], object]


class _ByteSource(ABC):
    """Frames out of connections that may break off.

    Args:
        name: for people.
        frames: how samples are written.
        detector: whose channels and rate they have.
    """

    is_live = True
    simulated = False
    _begins_inside = False
    _ends = False  # with the connection
    _is_mistake = False  # whether what cannot be opened at first is refused

    def __init__(self, name: str, frames: Frames, detector: SlipDetector) -> None:
        pool = detector.pool
        self.name = name
        self._reader: FrameReader = frames.reader(
            pool.hand.names, pool.sample_rate_hz, begins_inside=self._begins_inside
        )
        self._stopped = threading.Event()

    def close(self) -> None:
        """End the iteration."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Block | Event]:
        """Connect, read, and again."""
        is_reported, is_first = False, True
        while not self._stopped.is_set():
            try:
                connection = self._connect()
            except OSError as error:
                if is_first and self._is_mistake:
                    raise
                if not is_reported:
                    yield Event("waiting", f"{self.name}: {_reason(error)}; {_AGAIN}")
                is_reported = True
                self._stopped.wait(RETRY_S)
                continue
            if connection is None:
                continue
            is_reported = is_first = False
            yield Event("connected", self._connected())
            reason = yield from self._read(connection)
            yield from self._reader.end()
            if self._ends:
                break
            if not self._stopped.is_set():
                yield Event("lost", f"{self.name}: {reason}; {_AGAIN}")
                is_reported = True

    def _read(self, connection: _Connection) -> Generator[Block | Event, None, str]:
        came_s, is_silent = time.monotonic(), False
        try:
            while not self._stopped.is_set():
                data = connection.read()
                if data is None:
                    return "the other side has closed the connection"
                if data:
                    came_s = time.monotonic()
                    if is_silent:
                        is_silent = False
                        yield Event("connected", f"{self.name}: samples come again")
                    yield from self._reader.feed(data)
                elif not is_silent and time.monotonic() - came_s > SILENT_S:
                    is_silent = True
                    self._reader.forget()
                    yield Event("waiting", f"{self.name}: connected, no sample for {SILENT_S:g} s")
        except OSError as error:
            return _reason(error)
        finally:
            with suppress(OSError):
                connection.close()
        return ""

    def _connected(self) -> str:
        return f"{self.name}: connected"

    @abstractmethod
    def _connect(self) -> _Connection | None:
        """The next connection; ``None``: not yet, ask again.

        Raises:
            OSError: if there is none now.
        """


def _reason(error: OSError) -> str:
    return " ".join(str(error.strerror or error).split()) or type(error).__name__


class SerialPort(_ByteSource):
    """A serial port. One that is unplugged is opened again when it is back.

    Args:
        port: such as ``/dev/ttyACM0`` or ``COM3``.
        frames: how samples are written.
        detector: whose channels and rate they have.
        baud: bits a second; of no meaning to USB devices.

    Raises:
        ValueError: if pyserial is not installed or the frames cannot be found.
    """

    _begins_inside = True
    _is_mistake = True

    def __init__(
        self, port: str, frames: Frames, detector: SlipDetector, baud: int = 115200
    ) -> None:
        check_number("baud", baud, whole=True)
        self._serial = needs("serial", "a serial port")
        self._port, self._baud = port, baud
        super().__init__(f"serial:{port}", frames, detector)

    def _connect(self) -> _Connection:
        try:
            port = self._serial.Serial(self._port, self._baud, timeout=_POLL_S, exclusive=True)
        except self._serial.SerialException as error:
            raise OSError(self._message(error)) from None
        with suppress(Exception):  # only where the driver has it
            port.set_low_latency_mode(True)

        def read() -> bytes:
            """One byte is waited for, what else is there comes with it."""
            try:
                data: bytes = port.read(1)
                return data + port.read(min(port.in_waiting, _MOST_BYTES)) if data else data
            except (OSError, TypeError) as error:  # TypeError: pyserial, of a port that is closed
                raise OSError("the device is gone") from error

        return _Connection(read, port.close)

    def _message(self, error: OSError) -> str:
        there = needs("serial.tools.list_ports", "a serial port").comports()
        names = ", ".join(sorted(each.device for each in there)) or "none"
        if error.errno == 2 or not Path(self._port).exists():
            return f"there is no serial port {self._port}; there are: {names}"
        if "lock" in str(error):
            return f"another program has the serial port {self._port}; end it"
        reason = os.strerror(error.errno) if error.errno else str(error)
        return f"the serial port {self._port} cannot be opened: {reason}"


def _ready(*watched: socket.socket | int) -> list[Any]:
    """Which of these have something to read, after at most ``_POLL_S``."""
    with _Selector() as selector:
        for each in watched:
            selector.register(each, selectors.EVENT_READ)
        return [key.fileobj for key, _ in selector.select(_POLL_S)]


_Selector: type[selectors.BaseSelector] = getattr(
    selectors, "PollSelector", selectors.SelectSelector
)
"""Opens no file of its own, and takes regular files too."""


def _of_socket(connected: socket.socket, listener: socket.socket | None = None) -> _Connection:
    """A socket; ``listener`` says that another sender wants to take its place."""
    options = {"TCP_KEEPIDLE": 5, "TCP_KEEPINTVL": 2, "TCP_KEEPCNT": 3}
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a cable that is pulled
    for name, value in options.items():
        if hasattr(socket, name):
            connected.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

    def read() -> bytes | None:
        watched = [each for each in (connected, listener) if each is not None]
        ready = _ready(*watched)
        if connected in ready:
            return connected.recv(_MOST_BYTES) or None
        if ready:
            raise ConnectionError("another sender has connected")
        return b""

    return _Connection(read, connected.close)


class TcpClient(_ByteSource):
    """A connection to a device that listens; made again when it breaks off.

    Args:
        host: name or address.
        port: of the device.
        frames: how samples are written; a connection begins with a whole frame, or has a header.
        detector: whose channels and rate they have.

    Raises:
        ValueError: if there is no such host.
    """

    def __init__(self, host: str, port: int, frames: Frames, detector: SlipDetector) -> None:
        super().__init__(f"tcp:{host}:{port}", frames, detector)
        try:
            socket.getaddrinfo(host, port)
        except OSError as error:
            raise ValueError(f"there is no host {host}: {_reason(error)}") from None
        self._address = host, port

    def _connect(self) -> _Connection:
        connected = socket.create_connection(self._address, timeout=2.0)
        connected.settimeout(None)
        return _of_socket(connected)


class TcpListener(_ByteSource):
    """A port on which a device connects, one at a time; a new one takes the place of the last.

    Args:
        host: address to listen at; by default of this machine alone.
        port: to listen at, 0 for any that is free.
        frames: how samples are written; a connection begins with a whole frame, or has a header.
        detector: whose channels and rate they have.

    Attributes:
        port: that it listens at.

    Raises:
        OSError: if the port is taken.
    """

    def __init__(self, host: str, port: int, frames: Frames, detector: SlipDetector) -> None:
        self._listener = listener_at(host, port)
        self.port = self._listener.getsockname()[1]
        super().__init__(f"listen:{host}:{self.port}", frames, detector)
        self._peer, self._is_reported = "", False

    def __iter__(self) -> Iterator[Block | Event]:
        """As of all, after a word that it waits."""
        yield Event("waiting", f"{self.name}: waits for a sender")
        with self._listener:
            yield from super().__iter__()

    def _connect(self) -> _Connection | None:
        if not _ready(self._listener):
            return None
        connected, (self._peer, *_) = self._listener.accept()
        return _of_socket(connected, self._listener)

    def _connected(self) -> str:
        return f"{self.name}: connected from {self._peer}"


class StandardInput(_ByteSource):
    """Standard input; the stream ends with it. Whoever writes waits until samples are taken.

    Args:
        frames: how samples are written.
        detector: whose channels and rate they have.
    """

    is_live = False
    _ends = True

    def __init__(self, frames: Frames, detector: SlipDetector) -> None:
        super().__init__("stdin", frames, detector)

    def _connect(self) -> _Connection:
        def read() -> bytes | None:
            if sys.platform != "win32" and not _ready(0):
                return b""
            return os.read(0, _MOST_BYTES) or None

        return _Connection(read, lambda: None)


# Files -------------------------------------------------------------------------------------------


class FileInTime:
    """A recording in a file, as its samples would have come; read piece by piece.

    Args:
        path: of any format that ``data.formats`` knows.
        detector: whose channels, rate and unit it has.
        reading: what the file does not say, and what was done for training.
        speed: times faster than real time; ``None``: as fast as it is taken.
        repeat: whether it begins again at its end.

    Attributes:
        recording: its truth and origin, around no samples; ``None``: a file of others.
        dtype: of its samples, float32 or float64.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: in one line, if it is damaged or not of this detector.
    """

    is_live = False

    def __init__(
        self,
        path: Path,
        detector: SlipDetector,
        reading: Reading | None = None,
        *,
        speed: float | None = 1.0,
        repeat: bool = False,
    ) -> None:
        if speed is not None:
            check_number("speed", speed)
        pool, self.name = detector.pool, f"file:{path.name}"
        self._rate, self._speed, self._repeat = pool.sample_rate_hz, speed, repeat
        how, units = reading or Reading(), str(detector.info.get("units", "V"))
        self._given = (path, pool.hand, self._rate, how, units)
        self._stopped = threading.Event()
        with hand_file(*self._given) as opened:
            self.recording = opened.archived and opened.archived.recording
            self.dtype = opened.samples.dtype
        known = self.recording.provenance if self.recording else {}
        self.simulated = bool(known.get("simulated"))

    def close(self) -> None:
        """End the iteration."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Block | Event]:
        """Blocks of 5 ms of the recording, each when its last sample would have been taken."""
        yield Event("connected", f"{self.name}: begins")
        while True:
            yield from self._once()
            if not self._repeat or self._stopped.is_set():
                return
            yield Event("gap", f"{self.name}: begins again")

    def _once(self) -> Iterator[Block]:
        started_s, done = time.monotonic(), 0
        step = max(1, round(_BLOCK_S * self._rate * max(1.0, self._speed or 1.0)))
        with hand_file(*self._given) as opened:
            num_piece = round(_PIECE_S * self._rate)
            for piece in pieces(opened.samples, num_piece):
                samples = piece.numpy().astype(np.float64).T
                size = len(samples) if self._speed is None else min(step, len(samples))
                for first in range(0, len(samples), size):
                    block = samples[first : first + size]
                    done += len(block)
                    if self._speed is not None:
                        due_s = started_s + done / self._rate / self._speed
                        self._stopped.wait(max(0.0, due_s - time.monotonic()))
                    if self._stopped.is_set():
                        return
                    yield Block(block)


def source_of(
    text: str,
    detector: SlipDetector,
    frames: Frames,
    *,
    baud: int = 115200,
    reading: Reading | None = None,
    speed: float | None = 1.0,
    repeat: bool = False,
) -> Source:
    """The source that a text names.

    Args:
        text: ``serial:PORT``, ``tcp:HOST:PORT``, ``listen:[HOST:]PORT``, ``ros2:TOPIC``,
            ``stdin``, or a file.
        detector: whose channels and rate it has.
        frames: how samples are written, but of a file.
        baud: of ``SerialPort``.
        reading: of ``FileInTime`` and ``RosTopic``.
        speed: times faster than real time; ``None``: as fast as it is taken.
        repeat: whether the file begins again at its end.

    Raises:
        FileNotFoundError: if it names none.
        ValueError: as of these.
    """
    kind, found, rest = text.partition(":")
    rest = rest.removeprefix("//")
    if text in ("stdin", "-"):
        return StandardInput(frames, detector)
    if found and kind == "serial":
        return SerialPort(rest, frames, detector, baud)
    if found and kind in ("tcp", "listen"):
        host, port = address_of(rest, f"source={kind}:")
        made = TcpClient if kind == "tcp" else TcpListener
        return made(host, port, frames, detector)
    if found and kind == "ros2":
        from tactslip_torch.live.ros2 import RosTopic

        return RosTopic(rest, detector, reading)
    path = Path(text)
    if not path.exists():
        raise FileNotFoundError(f"no file at {text}; source is {KINDS}")
    return FileInTime(path, detector, reading, speed=speed, repeat=repeat)
