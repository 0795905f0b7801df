"""``tactslip stream`` fed as by a device, for minutes: ``python -m benchmarks.live``.

A process of its own watches a pseudo-terminal, then a socket, which get frames at the rate of the
hand. When each frame was sent and when each line came is on one clock: from a sample to the line of
the first decision on it, whether one was lost, and the memory and load of the process.
"""

from __future__ import annotations

import json
import os
import pty
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import psutil
import torch
from matplotlib.figure import Figure

from benchmarks import ROOT
from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import RATE_HZ, Array
from benchmarks.tables import Report, Table, limits, lines
from benchmarks.timing import growth_mb
from benchmarks.trainings import main_job_detector
from tactslip_torch import SlipDetector, StreamingDetector, sample_recording

SOURCES = ("tactslip_torch/commands/stream.py", "tactslip_torch/data/formats/*.py")
HEADER, FRAME_SAMPLES = "AA55", 2
MARGIN_MS, MOST_GROWTH_MB = 5.0, 5.0
_FRAME = (
    f'frame.format=binary frame.header="{HEADER}" frame.counter=uint32 frame.dtype=float32 '
    f"frame.samples={FRAME_SAMPLES}"
)


@dataclass(frozen=True)
class Live(Benchmark):
    """From a sample to its line, over minutes.

    Args:
        seconds: of stream, of each source.
        settled_s: of them, until the memory has to stay where it is.
        checked_s: of them, whose decisions are held against ``StreamingDetector``.
    """

    title = "Live"
    about = (
        "`tactslip stream` in a process of its own with the detector of the main job "
        "(`+exp=unseen4`, the default recipe), fed the sample recording again and again: 24 "
        f"channels at 2 kHz, {FRAME_SAMPLES} samples a frame, a line for each decision. "
        "Measured: the time from sending a sample until the line of the first decision on it can "
        "be read"
    )
    quick = "seconds=2.0 settled_s=0.5 checked_s=2.0"
    charts: ClassVar = {"": ()}
    seconds: float = 600.0
    settled_s: float = 60.0
    checked_s: float = 60.0

    def measure(self, job: Job) -> dict[str, Any]:
        """Latencies, memory and what was lost, by source."""
        with TemporaryDirectory(prefix="tactslip-live-") as name:
            folder = Path(name)
            shutil.copy(main_job_detector(job), folder / "detector.pt")
            rows = [_fed(kind, folder, self) for kind in ("pseudo-terminal", "socket")]
        goals, shown = [], []
        for row in rows:
            kind, ms, late_ms = row["source"], row["latency_ms"], row["late_ms"]
            bound_ms = row["look_ahead_ms"] + row["hop_ms"] + MARGIN_MS
            memory = f"{kind}: resident memory, growth after it has settled"
            goals += [
                (f"{kind}: sample to line, 99th percentile", ms["99"], bound_ms, "ms"),
                (f"{kind}: samples lost", row["sent"] - row["received"], 0, ""),
                (memory, growth_mb(row, self.settled_s), MOST_GROWTH_MB, "MB"),
                (f"{kind}: decisions unlike those of StreamingDetector", row["unlike"], 0, ""),
            ]
            shown.append(
                {
                    "source": kind,
                    "samples": f"{row['sent']:,}",
                    "median, ms": ms["50"],
                    "99 %, ms": ms["99"],
                    "longest, ms": ms["100"],
                    "of it computing and waiting, median, ms": late_ms["50"],
                    "99 %, us": 1e3 * late_ms["99"],
                    "of a core": row["cpu_s"] / self.seconds,
                    "resident, MB": row["resident_bytes"][-1] / 1e6,
                    "machine's load": f"{os.getloadavg()[0]:.1f}",
                }
            )
        parts = f"{row['look_ahead_ms']:g} ms of look-ahead, {row['hop_ms']:g} ms of hop"
        note = f"The limit is the sum of {parts} and {MARGIN_MS:g} ms of margin."
        tables = {"Limits": limits(goals), "From a sample to its line": Table(shown, note)}
        return {"tables": tables, "rows": rows}

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Latency by part of samples, and memory over time."""
        latency, memory = drawing.subplots(2, 1)
        rows = {row["source"]: row for row in numbers["rows"]}
        shown = {n: (list(of["latency_ms"].values()), of["latency_ms"]) for n, of in rows.items()}
        parts = {name: (ms, list(map(float, at))) for name, (ms, at) in shown.items()}
        lines(latency, parts, "ms from a sample to its line", "% of samples")
        held = {n: (of["at_s"], np.divide(of["resident_bytes"], 1e6)) for n, of in rows.items()}
        lines(memory, held, "s of stream", "resident, MB")


def _fed(kind: str, folder: Path, sizes: Live) -> dict[str, Any]:
    """Feed one source, and what came of it."""
    say(f"live: {sizes.seconds:g} s of stream into a {kind}")
    samples = sample_recording().samples.T.contiguous().numpy().astype("<f4")
    samples = samples[: len(samples) // FRAME_SAMPLES * FRAME_SAMPLES]
    frames = cycle([of.tobytes() for of in np.split(samples, len(samples) // FRAME_SAMPLES)])
    came: list[tuple[float, dict[str, Any]]] = []
    with ExitStack() as stack:
        source, send = _terminal(stack) if kind == "pseudo-terminal" else _socket(stack)
        command = [sys.executable, "-m", "tactslip_torch", "stream", "model=detector.pt"]
        command += [f"source={source}", "decisions=true", *_FRAME.split()]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        pipe: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        run = stack.enter_context(subprocess.Popen(command, cwd=folder, env=environment, **pipe))
        stack.callback(run.kill)
        is_ready = threading.Event()

        def read() -> None:
            assert run.stdout is not None
            for line in run.stdout:
                came.append((time.monotonic(), json.loads(line)))
                if b"connected" in line:
                    is_ready.set()

        reading = threading.Thread(target=read)
        reading.start()
        send(None)
        if not is_ready.wait(120):
            run.kill()
            raise RuntimeError(f"tactslip stream does not begin: {run.communicate()[1].decode()}")
        process, at_s, resident = psutil.Process(run.pid), list[float](), list[int]()
        sent_s = np.empty(round(sizes.seconds * RATE_HZ / FRAME_SAMPLES))
        started_s, cpu_s = time.monotonic(), sum(process.cpu_times()[:2])
        for place in range(len(sent_s)):
            due_s = place * FRAME_SAMPLES / RATE_HZ
            time.sleep(max(0.0, started_s + due_s - time.monotonic()))
            body = struct.pack("<I", place) + next(frames)
            sent_s[place] = time.monotonic()
            send(bytes.fromhex(HEADER) + body)
            if due_s >= len(at_s):
                at_s.append(due_s)
                resident.append(int(process.memory_info().rss))
        time.sleep(1.0)
        cpu_s = sum(process.cpu_times()[:2]) - cpu_s
        run.terminate()
        run.wait(30)
        reading.join(30)
    stream = StreamingDetector(SlipDetector.load(folder / "detector.pt"), dtype=torch.float64)
    decided = [(came_s, row) for came_s, row in came if "score" in row]
    end = np.rint([row["time_s"] * RATE_HZ for _, row in decided]).astype(int)  # behind the last
    in_time = end <= len(sent_s) * FRAME_SAMPLES  # those that are flushed wait for what never came
    came_s, end = np.array([came_s for came_s, _ in decided])[in_time], end[in_time]
    late_s = came_s - sent_s[(end - 1) // FRAME_SAMPLES]
    ahead = round(stream.look_ahead_s * RATE_HZ)
    # a sample's first decision is that on the first bin that ends with it or later
    which = np.arange(end[0] - ahead, end[-1] - ahead)
    first = np.searchsorted(end - ahead, which, side="right")
    latency_s = came_s[first] - np.repeat(sent_s, FRAME_SAMPLES)[which]
    checked = round(min(sizes.checked_s, sizes.seconds) * RATE_HZ)
    expected = stream.push(np.resize(samples, (checked, samples.shape[1])).astype(np.float64))
    pairs = zip(expected.score.tolist(), expected.is_alarm.tolist(), decided, strict=False)
    unlike = [
        alarm != row["alarm"] or not abs(score - row["score"]) < 1e-9
        for score, alarm, (_, row) in pairs
    ]

    def percentiles_ms(seconds: Array, parts: list[float]) -> dict[str, float]:
        return {f"{part:g}": 1e3 * float(np.percentile(seconds, part)) for part in parts}

    last = came[-1][1]
    return {
        "source": kind,
        "sent": len(sent_s) * FRAME_SAMPLES,
        "received": round(last["seconds"] * RATE_HZ) if "decisions" in last else 0,
        "unlike": sum(unlike) + max(0, len(expected.score) - len(decided)),
        "look_ahead_ms": 1e3 * stream.look_ahead_s,
        "hop_ms": 1e3 * stream.hop_s,
        "latency_ms": percentiles_ms(latency_s, [*range(0, 99, 2), 99, 99.9, 100]),
        "late_ms": percentiles_ms(late_s, [50, 99, 100]),
        "cpu_s": cpu_s,
        "at_s": at_s,
        "resident_bytes": resident,
    }


def _terminal(stack: ExitStack) -> tuple[str, Callable[[bytes | None], object]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    for each in (master, slave):
        stack.callback(os.close, each)

    def send(data: bytes | None) -> None:
        while data:
            data = data[os.write(master, data) :]

    return f"serial:{os.ttyname(slave)}", send


def _socket(stack: ExitStack) -> tuple[str, Callable[[bytes | None], object]]:
    server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    peers: list[socket.socket] = []

    def send(data: bytes | None) -> None:
        if data is None:
            peers.append(stack.enter_context(server.accept()[0]))
            peers[0].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        else:
            peers[0].sendall(data)

    return f"tcp:127.0.0.1:{server.getsockname()[1]}", send


if __name__ == "__main__":
    raise SystemExit(Live().run())
