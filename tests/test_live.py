"""Samples as they come: frames, sources that break off, the pump, and the page's server."""

import binascii
import json
import os
import pty
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
import torch
from extremes import slip_samples
from small_detector import HAND, alarming_detector
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tactslip_torch import SlipDetector
from tactslip_torch.data.formats import Reading
from tactslip_torch.live import (
    Block,
    Callback,
    Counts,
    Event,
    FileInTime,
    Frames,
    JsonLines,
    LineServer,
    PageServer,
    SerialPort,
    StandardInput,
    TcpClient,
    TcpListener,
    page_metadata,
    source_of,
    watch,
)
from tactslip_torch.live.sinks import decision_columns
from tactslip_torch.onset.decisions import joined_decisions
from tactslip_torch.onset.streaming import StreamingDetector
from tactslip_torch.pretrained import sample_recording

ROOT = Path(__file__).parents[1]
RATE, NAN = 2000.0, np.nan
NAMES = HAND.names
HEADER = "AA 55"
START = bytes.fromhex(HEADER)


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


@pytest.fixture(scope="module")
def samples():
    return slip_samples(HAND).T.numpy().copy()


class Kept:
    """A sink that keeps all it is given."""

    def __init__(self, wait_s=0.0):
        self.blocks, self.made, self.events, self.is_closed = [], [], [], False
        self._wait_s, self.changed = wait_s, threading.Event()

    def samples(self, first, block):
        self.blocks.append((first, block.samples))
        time.sleep(self._wait_s)
        self.changed.set()

    def decisions(self, decisions):
        self.made.append(decisions)

    def event(self, kind, text):
        self.events.append((kind, text))
        self.changed.set()

    def close(self):
        self.is_closed = True

    def column(self, name):
        return torch.cat([getattr(each, name) for each in self.made])

    def told(self, kind):
        return [text for each, text in self.events if each == kind]

    def until(self, is_there):
        end = time.monotonic() + 20
        while not is_there():
            assert time.monotonic() < end, self.events
            self.changed.wait(0.02)
            self.changed.clear()


def expected(detector, samples, dtype=torch.float64):
    stream = StreamingDetector(detector, dtype=dtype)
    parts = stream.push(samples.astype(np.float64)), stream.flush()
    return joined_decisions(parts)._asdict()


def decided_on(source, detector, *sinks, wait_s=0.0, **options):
    """What a sink is given of a source to its end."""
    kept, stream = Kept(wait_s), StreamingDetector(detector, dtype=torch.float64)
    watch(source, stream, [kept, *sinks], **options)
    return kept


def assert_decided(kept, wanted):
    for name, values in wanted.items():
        if name != "channels":
            found = kept.column(name)
            torch.testing.assert_close(
                found, values, rtol=1e-9, atol=1e-9, equal_nan=True, msg=name
            )


# Frames ------------------------------------------------------------------------------------------


SUMS = {
    None: (0, lambda content: 0),
    "sum8": (1, lambda content: sum(content) % 256),
    "xor8": (1, lambda content: reduce(xor, content)),
    "crc16": (2, lambda content: binascii.crc_hqx(content, 0xFFFF)),  # CCITT
    "crc32": (4, zlib.crc32),
}
"""By check sum its bytes and its value."""


def written(values, how):
    """Frames of ``values [n, C]``, made by the words of the description alone."""
    size, total = SUMS[how.checksum]
    frames = []
    for number, first in enumerate(range(0, len(values), how.samples)):
        content = b""
        if how.counter:
            bits = int(how.counter[4:])
            content += (number % (1 << bits)).to_bytes(bits // 8, how.byte_order)
        content += b"\xee" * how.skip
        for value in values[first : first + how.samples].ravel().tolist():
            if how.dtype == "float32":
                content += struct.pack("<f" if how.byte_order == "little" else ">f", value)
            else:
                num = int(how.dtype.lstrip("uint")) // 8
                content += int(value).to_bytes(num, how.byte_order, signed=how.dtype[0] == "i")
        if how.length:
            content += bytes(how.length - len(content) - size - len(how.start))
        frames.append(how.start + content + total(content).to_bytes(size, how.byte_order))
    return frames


def parted(content, rng):
    """Bytes in pieces of any size."""
    while content:
        num = int(rng.integers(1, 60))
        yield content[:num]
        content = content[num:]


def fed(reader, pieces):
    """Samples and events that a reader makes of pieces of bytes, and of the end."""
    items = [item for piece in pieces for item in reader.feed(piece)] + reader.end()
    blocks = [item.samples for item in items if isinstance(item, Block)]
    return np.concatenate([np.empty((0, 4)), *blocks]), [i for i in items if isinstance(i, Event)]


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"header": HEADER, "byte_order": "big", "counter": "uint8", "checksum": "xor8"},
        {"header": "7E", "dtype": "int24", "samples": 5, "skip": 3, "checksum": "crc16"},
        {"header": HEADER, "dtype": "float32", "length": 40, "checksum": "crc32"},
        {"dtype": "uint8", "checksum": "sum8", "columns": ["t", *reversed(NAMES)], "scale": 2.0},
        {"header": HEADER, "dtype": "int32", "scale": [1.0, 0.5, 2.0, -1.0], "offset": 3.0},
    ],
    ids=str,
)
def test_binary_frames_are_read_as_they_are_described(how, rng):
    frames = Frames(format="binary", **how)
    reader = frames.reader(NAMES, RATE)
    columns = frames.columns or list(NAMES)
    low = 0 if frames.dtype == "uint8" else -120
    values = rng.integers(low, 120, (400, len(columns)))
    found, events = fed(reader, parted(b"".join(written(values, frames)), rng))
    picked = values[:, [columns.index(name) for name in NAMES]]
    wanted = picked * np.asarray(frames.scale) + frames.offset
    np.testing.assert_array_equal(found, wanted)
    assert events == []


@pytest.mark.parametrize("counter", [None, "uint8"])
@pytest.mark.parametrize("checksum", [None, "crc16"])
@pytest.mark.parametrize("fault", ["noise", "short", "long", "absent"])
def test_behind_garbage_frames_are_found_again_in_one_line(fault, checksum, counter, rng):
    frames = Frames("binary", header=HEADER, checksum=checksum, counter=counter)
    values = rng.integers(-9, 9, (300, 4))
    whole = written(values, frames)
    whole[100] = {
        "noise": whole[100] + rng.integers(0, 256, 200, np.uint8).tobytes() + START,
        "short": whole[100][:-3],
        "long": whole[100] + b"\x01\x02",
        "absent": b"",
    }[fault]
    reader = frames.reader(NAMES, RATE, begins_inside=True)
    found, events = fed(reader, [whole[0][5:] + b"".join(whole[1:99]), *whole[99:]])
    kinds = [event.kind for event in events]
    assert kinds == ([] if fault == "absent" else ["garbage"])
    known = found[np.isfinite(found).all(1)]
    np.testing.assert_array_equal(known[:98], values[1:99])
    np.testing.assert_array_equal(known[-190:], values[-190:])
    assert len(known) >= 299 - 3
    if counter:  # time stays right
        assert len(found) == 299


LINES = {
    "ends of lines": ("1,2,3,4\r5,6,7,8\r\n\r\n", [[1, 2, 3, 4], [5, 6, 7, 8]], ""),
    "an empty value": (
        "1,,3,4\n1;2; ;4\n1\t2\t3\t\n",
        [[1, NAN, 3, 4], [1, 2, NAN, 4], [1, 2, 3, NAN]],
        "",
    ),
    "no number": (
        "1,2,3,4\n1_0,2,2..1,4\n",
        [[1, 2, 3, 4], [NAN, 2, NAN, 4]],
        "'1_0', '2..1'",
    ),
    "too few or many": (
        "1,2,3,4\n1,2,3\n1,2,3,4,5\n",
        [[1, 2, 3, 4], NAN, NAN],
        "3 values, expected 4",
    ),
    "a header": ("pvdf2, PVDF1 (mV),SG2 [V],sg1\n4,3,2,1\n", [[1, 2, 3, 4]], ""),
    "a header in quotes": ("'SG2';'SG1';'PVDF1';'PVDF2'\n2;1;3;4\n", [[1, 2, 3, 4]], ""),
    "a header behind a restart": (
        "1,2,3,4\nboot 7\nPVDF2,PVDF1,SG2,SG1\n4,3,2,1\n",
        [[1, 2, 3, 4], NAN, [1, 2, 3, 4]],
        "anew, with the columns PVDF2",
    ),
    **{
        f"a boot message of {len(line)} letters": (f"{line}\n1,2,3,4\n", [[1, 2, 3, 4]], "line")
        for line in (
            "rst:0x1 (POWERON_RESET),boot:0x13 (SPI_FAST_FLASH_BOOT)",
            "E (123) adc, timeout",
            "rst:0x1,boot:0x13,mode:DIO,load:0x3f",
            "Ready, all of it",
        )
    },
    "no names": ("Booting from flash now\n1,2,3,4\n", [[1, 2, 3, 4]], "no number: 'Booting"),
    "names twice": ("SG1,SG1,SG2,PVDF1,PVDF2\n1,2,3,4\n", [[1, 2, 3, 4]], "has 5 values"),
}
"""What a device writes, the rows that it is, and a part of what is told."""


@pytest.mark.parametrize("line", ["a,b,c,d", "SG1;SG2;PVDF1;x", "'a'\t'b'\t'c'\t'd'"])
def test_names_of_other_columns_are_refused(line):
    reader = Frames().reader(NAMES, RATE)
    with pytest.raises(ValueError, match=r"names its columns .*PVDF2 of the detector; .*frame.col"):
        reader.feed(f"{line}\n1,2,3,4\n".encode())
    for names, frames in ((NAMES, Frames(columns=NAMES)), (("ch1", "ch2", "ch3", "ch4"), Frames())):
        found, _ = fed(frames.reader(names, RATE), [f"{line}\n1,2,3,4\n".encode()])
        np.testing.assert_array_equal(found, [[1, 2, 3, 4]])


@pytest.mark.parametrize("case", LINES)
def test_a_line_is_read_as_a_file_would_be_and_loses_no_more_than_it_must(case, rng):
    text, rows, told = LINES[case]
    for pieces in ([text.encode()], parted(text.encode(), rng)):
        found, events = fed(Frames().reader(NAMES, RATE), pieces)
        np.testing.assert_array_equal(found, [np.broadcast_to(row, 4) for row in rows])
        assert told in " ".join(event.text for event in events)
        assert told or not events


def test_a_header_counts_where_a_stream_is_joined_and_what_is_cut_is_told():
    for first, row, told in (
        (b"PVDF2,PVDF1,SG2,SG1\n", [1, 2, 3, 4], ""),
        (b"DF2,PVDF1,SG2,SG1\n", [4, 3, 2, 1], "the first line may be cut: 'DF2,"),
        (b"3,2,1\n", [4, 3, 2, 1], ""),
    ):
        reader = Frames().reader(NAMES, RATE, begins_inside=True)
        found, events = fed(reader, [first + b"4,3,2,1\n"])
        np.testing.assert_array_equal(found, [row])
        assert told in "".join(event.text for event in events)
        assert bool(told) is bool(events)


def test_garbage_without_end_is_told_ever_less_often():
    now = [0.0]
    frames = Frames("binary", header=HEADER)
    reader = frames.reader(NAMES, RATE, now=lambda: now[0])
    told = []
    for second in range(300):
        now[0] = float(second)
        told += [second for _ in reader.feed((START + bytes(20)) * 50)]
    assert 3 <= len(told) <= 12
    (event,) = reader.end()
    assert "10 bytes that begins with aa 55 (two such headers are 22 apart)" in event.text


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"format": "csv"}, "frame.format text, binary 'csv'"),
        ({"format": "binary", "header": "zz"}, "frame.header hexadecimal AA 55"),
        ({"format": "binary", "header": 5555}, "frame.header quotes 5555"),
        ({"format": "binary", "length": 7}, "frame.length 7 8"),
        ({"columns": ["SG1", "SG2", "PVDF1"]}, "frame.columns PVDF2"),
        ({"columns": ["SG1", "SG1"]}, "frame.columns different"),
        ({"scale": [1.0, 2.0]}, "frame.scale 4"),
        ({"samples": 0}, "frame.samples 0"),
        ({"skip": -1}, "frame.skip -1"),
        ({"lenght": 3}, "frame 'lenght'"),
    ],
)
def test_a_description_that_cannot_be_is_refused(how, words):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the words are below
        Frames.of(how).reader(NAMES, RATE)
    assert [word for word in words.split() if word not in str(caught.value)] == []


# Sources -----------------------------------------------------------------------------------------

BINARY = Frames("binary", header=HEADER, dtype="int16", counter="uint16", scale=2**-12)


@contextmanager
def watched(source, detector, *sinks, **options):
    """A source that is watched while the block runs; it is closed at its end."""
    kept, stream = Kept(), StreamingDetector(detector, dtype=torch.float64)
    with ThreadPoolExecutor(1) as pool:
        watching = pool.submit(watch, source, stream, [kept, *sinks], **options)
        try:
            yield kept
        finally:
            source.close()
            watching.result(20)
    assert kept.is_closed


class Pty:
    """A serial cable: what is written comes out of a port whose path stays when it is pulled."""

    def __init__(self, folder):
        self.path = folder / "ttyACM0"

    def source(self, detector):
        return SerialPort(str(self.path), BINARY, detector)

    def plug(self):
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path.symlink_to(os.ttyname(self.slave))

    def send(self, content):
        while content:
            content = content[os.write(self.master, content) :]

    def pull(self):
        os.close(self.slave)
        os.close(self.master)
        self.path.unlink()

    close = pull


class Device:
    """A device on a socket, which listens or connects."""

    def __init__(self, listens):
        self._server = socket.create_server(("127.0.0.1", 0)) if listens else None
        self.port = self._server.getsockname()[1] if listens else None

    def source(self, detector):
        if self._server:
            return TcpClient("127.0.0.1", self.port, BINARY, detector)
        source = TcpListener("127.0.0.1", 0, BINARY, detector)
        self.port = source.port
        return source

    def plug(self):
        if self._server:
            self._peer = self._server.accept()[0]
        else:
            self._peer = socket.create_connection(("127.0.0.1", self.port))

    def send(self, content):
        self._peer.sendall(content)

    def close(self):
        self._peer.close()
        if self._server:
            self._server.close()

    def pull(self):
        reset = struct.pack("ii", 1, 0)
        self._peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
        self._peer.close()


@pytest.mark.parametrize("kind", ["serial", "connects", "listens"])
def test_a_stream_is_decided_on_and_recovers_when_the_cable_is_pulled(
    kind, detector, samples, tmp_path
):
    device = Pty(tmp_path) if kind == "serial" else Device(kind == "listens")
    numbers = (samples * 2**12).round().clip(-(2**15), 2**15 - 1).astype(int)
    whole, volts = b"".join(written(numbers, BINARY)), numbers / 2.0**12
    counts, lines = Counts(), []
    to_lines = JsonLines(lines.append, every=True, sample_rate_hz=RATE)
    source = device.source(detector)
    if kind == "serial":  # a port that is not there at first is a mistake
        device.plug()
    with watched(source, detector, to_lines, counts=counts) as kept:
        if kind != "serial":
            device.plug()
        kept.until(lambda: kept.told("connected"))
        first = b"\x01\x02" * 4 if kind == "serial" else b""  # the end of a frame
        device.send(first + whole)
        kept.until(lambda: counts.received == len(samples))
        device.pull()
        kept.until(lambda: kept.told("lost"))
        device.plug()
        kept.until(lambda: len(kept.told("connected")) == 2)
        device.send(whole)
        kept.until(lambda: counts.received == 2 * len(samples))
    device.close()
    kinds = [kind for kind, _ in kept.events if kind != "waiting"]
    assert kinds == ["connected", "lost", "connected", "missing", "ended"]
    assert counts.dropped == 0
    wanted = expected(detector, volts)
    num = len(wanted["number"])
    begins = kept.blocks[-1][0] + len(kept.blocks[-1][1]) - len(samples)
    assert begins > len(samples)
    for own, start_s in ((slice(num), 0.0), (slice(num, None), begins / RATE)):
        for name in ("number", "score", "statistic", "is_alarm", "is_valid"):
            torch.testing.assert_close(kept.column(name)[own], wanted[name], rtol=1e-9, atol=1e-9)
        since_s = kept.column("available_s")[own] - start_s
        torch.testing.assert_close(since_s, wanted["available_s"])
    rows = [json.loads(line) for text in lines for line in text.splitlines()]
    assert [row["score"] for row in rows if "score" in row] == kept.column("score").tolist()
    alarms = int(kept.column("is_alarm").sum())
    assert alarms == counts.alarms > 1
    assert rows[-1] == {"decisions": 2 * num, "alarms": alarms, "seconds": rows[-1]["seconds"]}


@pytest.mark.parametrize("written_as", ["npz", "csv"])
def test_a_file_is_decided_on_as_it_is(written_as, detector, samples, tmp_path):
    path = tmp_path / f"recording.{written_as}"
    if written_as == "npz":
        np.savez(path, samples=samples)
    else:
        np.savetxt(path, samples, delimiter=",", header=",".join(NAMES), comments="")
    reading = Reading(sample_rate_hz=RATE, time_first=True)
    source = source_of(str(path), detector, Frames(), reading=reading, speed=None)
    kept = decided_on(source, detector)
    assert source.dtype == torch.float64
    assert_decided(kept, expected(detector, samples))
    np.testing.assert_array_equal(np.concatenate([x for _, x in kept.blocks]), samples)
    fast = FileInTime(path, detector, reading, speed=40.0, repeat=True)
    started_s = time.monotonic()
    with watched(fast, detector, queue_s=0.5) as kept:
        kept.until(lambda: len(kept.told("gap")) == 2)
        assert time.monotonic() - started_s >= 2 * len(samples) / RATE / 40
    assert kept.column("number").eq(0).sum() >= 2


def test_standard_input_is_read_to_its_end(detector, samples):
    text = "".join(f"{' '.join(map(repr, row))}\n" for row in samples.tolist()).encode()
    ours, theirs = os.pipe()
    before = os.dup(0)
    os.dup2(ours, 0)
    writer = threading.Thread(target=lambda: (os.write(theirs, text), os.close(theirs)))
    try:
        writer.start()
        kept = decided_on(StandardInput(Frames(), detector), detector, queue_s=0.05)
    finally:
        os.dup2(before, 0)
        for each in (ours, before):
            os.close(each)
        writer.join()
    assert_decided(kept, expected(detector, samples))


# The pump ----------------------------------------------------------------------------------------


class Sent:
    """A source of blocks that are there."""

    name, is_live, simulated = "sent", True, False

    def __init__(self, items, is_live=True):
        self.items, self.is_live = items, is_live

    def __iter__(self):
        return iter(self.items)

    def close(self):
        self.items = []


def blocks_of(samples, size, time_s=None):
    """Samples in blocks, each with its times if there are any."""
    parts = [slice(first, first + size) for first in range(0, len(samples), size)]
    return [Block(samples[part], None if time_s is None else time_s[part]) for part in parts]


def test_what_waits_too_long_is_dropped_and_counted_and_times_stay_right(detector, samples):
    for is_live in (True, False):
        counts, source = Counts(), Sent(blocks_of(samples, 50), is_live)
        kept = decided_on(source, detector, wait_s=0.002, queue_s=0.2, counts=counts)
        num = sum(len(block) for _, block in kept.blocks)
        assert counts.received == len(samples)
        assert num + counts.dropped == counts.received
        assert (counts.dropped > 0) is is_live
        assert bool(kept.told("dropped")) is is_live
        for first, block in kept.blocks:
            np.testing.assert_array_equal(block, samples[first : first + len(block)])
        assert (kept.column("available_s").diff() > 0).all()


def lost_of(detector, samples, size=50, **options):
    """What a stream of samples says it lost."""
    kept = decided_on(Sent(blocks_of(samples, size), is_live=False), detector, **options)
    return kept.told("missing")


@pytest.mark.parametrize("size", [1, 50, 10_000])
def test_a_stream_says_what_it_lost(size, detector, samples):
    holed = np.tile(samples, (3, 1))
    holed[100] = NAN
    holed[1000:1003, 1:3] = NAN
    holed[1001:1010, 0] = np.inf
    holed[2000:5000, 3] = NAN
    holed[-4:] = NAN
    lost = lost_of(detector, holed, size, queue_s=0.05)
    at_end = f"4 samples of all 4 channels from {(len(holed) - 4) / RATE:.4f} s on"
    assert [text for text in lost if "since" not in text] == [
        "1 sample of all 4 channels from 0.0500 s on",
        "3 samples of SG2, PVDF1 from 0.5000 s on",
        "9 samples of SG1 from 0.5005 s on",
        "3000 samples of PVDF2 from 1.0000 s on",
        at_end,
    ]
    since = [text for text in lost if "since" in text]
    assert since == (["samples of PVDF2 since 1.0000 s"] if size < 3000 else [])


def test_samples_lost_without_end_are_told_in_few_lines(detector, samples):
    holed = np.tile(samples, (8, 1))
    holed[::3, 0] = NAN
    lost = lost_of(detector, holed)
    assert 10 < len(lost) < 20
    assert "SG1 in " in lost[-1]
    assert sum(int(text.split()[0]) for text in lost) == len(holed[::3])


def test_times_of_a_sender_count_and_what_goes_back_is_passed_over(detector, samples):
    time_s = 1e5 + np.arange(len(samples)) / RATE
    before, behind = slice(1000), slice(1040, 2040)
    blocks = blocks_of(samples[before], 100, time_s[before])
    blocks += [blocks[0], *blocks_of(samples[behind], 100, time_s[behind])]
    kept = decided_on(Sent(blocks), detector)
    padded = samples[:2040].copy()
    padded[1000:1040] = np.nan
    wanted = expected(detector, padded)
    torch.testing.assert_close(kept.column("score"), wanted["score"], equal_nan=True)
    torch.testing.assert_close(kept.column("available_s"), wanted["available_s"] + 1e5)
    (line,) = kept.told("garbage")
    assert "time_s goes back" in line
    assert kept.blocks[-1][0] == 1940


def test_an_error_of_a_sink_ends_the_stream_and_closes_the_others(detector, samples):
    def fail(alarm):
        raise RuntimeError("no place left")

    kept = Kept()
    with pytest.raises(RuntimeError, match="no place left"):
        decided_on(Sent([Block(samples)]), detector, kept, Callback(fail))
    assert kept.is_closed


def test_lines_go_to_all_who_connect_and_one_that_does_not_read_is_cut_off():
    server = LineServer("127.0.0.1", 0)
    reader, idle = (socket.create_connection((server.host, server.port)) for _ in range(2))
    lines = reader.makefile("rb")
    text = "x" * 99_999 + "\n"
    for _ in range(200):  # more than a connection and its queue hold
        server.write(text)
        assert lines.readline() == text.encode()
    idle.settimeout(20)
    unread = 0
    with suppress(ConnectionError):
        while got := idle.recv(1 << 20):
            unread += len(got)
    assert unread < 150 * len(text)
    server.write("last\n")
    assert lines.readline() == b"last\n"
    other = LineServer("127.0.0.1", 0)
    with pytest.raises(OSError, match="cannot listen"):
        LineServer("127.0.0.1", other.port)
    for each in (server, reader, idle, other):
        each.close()


def idle(port, num):
    """Connections that say nothing."""
    made = []
    for _ in range(num):
        made.append(socket.create_connection(("127.0.0.1", port)))
        time.sleep(0.005)  # else some wait for a second try
    return made


def is_closed(peer):
    """Whether the other side has closed a connection, by now or soon."""
    peer.settimeout(0.2)
    try:
        return not peer.recv(1)
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_more_readers_of_lines_than_there_is_room_for_are_refused_and_the_others_read_on():
    told = []
    server = LineServer("127.0.0.1", 0, told.append)
    reader, *others = idle(server.port, 1)
    server.write("1\n")
    others = idle(server.port, 60)
    server.write("2\n")
    assert sum(not is_closed(peer) for peer in others) == 15
    assert reader.recv(100) == b"1\n2\n"
    (event,) = told
    assert event == ("refused", "45 programs refused: 16 read lines already")
    for each in (server, reader, *others):
        each.close()


def test_a_stream_without_one_sample_is_an_error(tmp_path):
    model = tmp_path / "detector.pt"
    alarming_detector().save(model)
    words = [sys.executable, "-m", "tactslip_torch", "stream", f"model={model}", "source=stdin"]
    ended = subprocess.run(words, input="volts\n" * 9, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "ended before a sample came; check that it sends" in ended.stderr.splitlines()[-1]


def test_standard_output_has_json_alone_where_a_run_has_left_its_configuration(detector, tmp_path):
    detector.save(tmp_path / "detector.pt")
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    np.save(tmp_path / "a.npy", slip_samples(HAND)[:, :2000])
    words = [sys.executable, "-m", "tactslip_torch", "stream", "model=detector.pt", "source=a.npy"]
    ended = subprocess.run(
        [*words, f"sample_rate_hz={detector.pool.sample_rate_hz}", "speed=null"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = [json.loads(line) for line in ended.stdout.splitlines()]
    assert lines[0]["event"] == "connected"
    assert "earlier run" not in ended.stderr


# The page ----------------------------------------------------------------------------------------


@pytest.fixture
def folders(tmp_path):
    (tmp_path / "web" / "node_modules").mkdir(parents=True)
    (tmp_path / "node").mkdir()
    (tmp_path / "secret.html").write_text("secret")
    for name in ("web/index.html", "web/page.mjs", "web/node_modules/x.mjs", "node/graph.mjs"):
        (tmp_path / name).write_text(name)
    (tmp_path / "web" / "notes.txt").write_text("secret")
    (tmp_path / "web" / "link.html").symlink_to(tmp_path / "secret.html")
    return {"": tmp_path / "web", "node": tmp_path / "node"}


@pytest.fixture
def serve(detector, folders):
    made = []

    def start(**options):
        stream = StreamingDetector(detector)
        facts = page_metadata(detector, stream.settings)
        options = {"source": "test", "simulated": True, "counts": Counts()} | options
        made.append(PageServer(folders, facts, **options))
        return made[-1]

    yield start
    for server in made:
        server.close()


def asked(server, path, method="GET", host=None):
    """Status and body of a request whose path goes as it is."""
    with socket.create_connection(("127.0.0.1", server.port)) as peer:
        host = host or f"127.0.0.1:{server.port}"
        peer.sendall(f"{method} {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        head, _, body = peer.makefile("rb").read().partition(b"\r\n\r\n")
    return int(head.split()[1]), body.decode()


def upgrade(server):
    """What asks for a socket."""
    key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    host = f"Host: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    return f"GET /ws HTTP/1.1\r\n{host}{key}\r\n".encode()


def test_files_of_the_page_and_no_others_are_read(serve):
    server = serve()
    told = {"socket": "ws", "token_needed": False}
    assert json.loads(asked(server, "/live.json")[1]) == told
    assert asked(server, "/?token=x") == (200, "web/index.html")
    assert asked(server, "/page.mjs") == (200, "web/page.mjs")
    assert asked(server, "/node/graph.mjs") == (200, "node/graph.mjs")
    assert asked(server, "/page.mjs", "HEAD") == (200, "")
    assert asked(server, "/page.mjs", "POST")[0] == 405
    assert asked(server, "/page.mjs", host="evil.example")[0] == 403
    for path in (
        *("/../secret.html", "/%2e%2e/secret.html", "/..%2fsecret.html", "/%252e%252e/secret.html"),
        *("/..\\secret.html", "/..%5csecret.html", "//secret.html", "/node/../../secret.html"),
        *("/link.html", "/notes.txt", "/node_modules/x.mjs", "/page.mjs%00.html", "/./page.mjs"),
        *("/etc/passwd", "/file:///etc/passwd", "/web/index.html", "/node/", "/node"),
    ):
        status, body = asked(server, path)
        assert (status, "secret" in body) == (404, False), path


@pytest.mark.parametrize(
    ("query", "origin", "status"),
    [
        ("?token=a%20token%2Bmore", None, 101),
        ("?token=a%20token%2Bmore", "own", 101),
        ("", "own", 401),
        ("?token=any%20other%20one", None, 401),
        ("?token=a%20token%2Bmor", "own", 401),
        ("?token=a%20token%2Bmore", "http://evil.example", 403),
    ],
)
def test_only_the_right_token_and_origin_open_the_page(serve, query, origin, status):
    server = serve(token="a token+more")
    assert server.address.endswith("/?token=a%20token%2Bmore")
    assert json.loads(asked(server, "/live.json")[1])["token_needed"] is True
    origin = f"http://127.0.0.1:{server.port}" if origin == "own" else origin
    try:
        with connect(f"ws://127.0.0.1:{server.port}/ws{query}", origin=origin):
            found = 101
    except InvalidStatus as refused:
        found = refused.response.status_code
    assert found == status


@pytest.mark.slow
def test_wrong_tokens_are_answered_slowly_and_hold_up_nobody_else(serve):
    server = serve(token="a token+more")
    place = f"ws://127.0.0.1:{server.port}/ws"

    def guess(number):
        with pytest.raises(InvalidStatus, match="401"), connect(f"{place}?token=guess{number}"):
            pass
        return time.monotonic()

    started_s = time.monotonic()
    with ThreadPoolExecutor(4) as pool:
        guesses = [pool.submit(guess, number) for number in range(4)]
        time.sleep(0.1)
        assert asked(server, "/page.mjs") == (200, "web/page.mjs")
        with connect(f"{place}?token=a%20token%2Bmore") as page:
            assert json.loads(page.recv())["type"] == "hello"
        assert time.monotonic() - started_s < 1.5
        took_s = sorted(each.result() - started_s for each in guesses)
    assert took_s[-1] >= 2.0  # one in half a second


@pytest.mark.slow
def test_idle_connections_make_room_for_who_asks(serve):
    server = serve()
    with connect(f"ws://127.0.0.1:{server.port}/ws") as page:
        peers = idle(server.port, 60)
        assert asked(server, "/page.mjs") == (200, "web/page.mjs")
        assert sum(not is_closed(peer) for peer in peers[-16:]) >= 15
        assert all(is_closed(peer) for peer in peers[:40])
        server.event("waiting", "still there")
        while "still there" not in str(page.recv(10)):
            pass
    for peer in peers:
        peer.close()


def test_beyond_this_machine_there_is_always_a_token(serve):
    server = serve(host="0.0.0.0")
    assert len(server.address.partition("?token=")[2]) >= 20
    assert json.loads(asked(server, "/live.json")[1])["token_needed"] is True
    assert server.address != serve(host="0.0.0.0").address
    with pytest.raises(ValueError, match="token must have at least 8 characters, got 3"):
        serve(token="abc")
    with pytest.raises(OSError, match="give another port"):
        serve(port=server.port)


def test_the_page_is_given_the_samples_and_the_decisions(serve, detector, samples):
    counts = Counts()
    server = serve(counts=counts)
    got, is_there = [], threading.Event()

    def read():
        with connect(f"ws://127.0.0.1:{server.port}/ws") as page:
            for message in page:
                got.append(message)
                is_there.set()

    thread = threading.Thread(target=read)
    thread.start()
    is_there.wait(20)
    kept = decided_on(Sent(blocks_of(samples, 7)), detector, server, counts=counts, queue_s=60.0)
    thread.join(20)
    texts = [json.loads(each) for each in got if isinstance(each, str)]
    assert texts[0]["type"] == "hello"
    assert texts[0]["facts"]["channels"] == list(NAMES)
    assert (texts[0]["simulated"], texts[0]["source"]) == (True, "test")
    parts = [each for each in got if isinstance(each, bytes)]
    headers = [struct.unpack("<IId", each[:16]) for each in parts]
    assert [kind for kind, _, _ in headers] == [1] * len(parts)
    firsts = np.cumsum([0, *(rows for _, rows, _ in headers)])
    assert [first for _, _, first in headers] == firsts[:-1].tolist()
    shown = np.concatenate([np.frombuffer(each[16:], "<f4").reshape(-1, 4) for each in parts])
    np.testing.assert_array_equal(shown, samples.astype(np.float32))
    columns = [each["columns"] for each in texts if each["type"] == "decisions"]
    wanted = [decision_columns(made, has_onset=False) for made in kept.made]
    for name in wanted[0]:
        given, made = ([value for each in of for value in each[name]] for of in (columns, wanted))
        assert given == made
    status = [each for each in texts if each["type"] == "status"][-1]
    assert status == {
        **{"type": "status", "state": "ended", "text": "sent: ended"},
        **{"received": len(samples), "dropped": 0, "dropped_to_page": 0},
    }


def test_a_page_that_does_not_read_loses_samples_for_itself_alone(serve, detector):
    server = serve()
    peer = socket.create_connection(("127.0.0.1", server.port))
    peer.sendall(upgrade(server))
    assert b"101" in peer.recv(100)
    block = Block(np.zeros((4000, 4)))
    time.sleep(0.1)
    started_s = time.monotonic()
    for number in range(400):
        server.samples(4000 * number, block)
        time.sleep(0.001)
    assert time.monotonic() - started_s < 20  # nothing waited for the page
    server.event("ended", "no more")
    got, last = b"", None
    peer.settimeout(20)
    while not (last := re.search(rb'"ended".*?"dropped_to_page": (\d+)', got)):
        got = got[-1000:] + peer.recv(1 << 20)
    assert int(last[1]) > 0
    peer.close()


def test_the_line_on_the_page_is_what_a_stream_of_the_demo_prints() -> None:
    page = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```json\n(.*)\n```$", page, re.MULTILINE)
    printed: list[str] = []
    stream = StreamingDetector(SlipDetector.pretrained())
    sink = JsonLines(printed.append, sample_rate_hz=RATE)
    for decisions in (stream.push(sample_recording().samples.T), stream.flush()):
        sink.decisions(decisions)
    (line,) = map(json.loads, printed)
    assert line == {
        name: pytest.approx(value, rel=1e-5) if isinstance(value, float) else value
        for name, value in json.loads(shown).items()
    }, printed
