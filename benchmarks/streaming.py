"""How fast a stream is watched, and in what memory: ``python -m benchmarks.streaming``.

Pushes to ``StreamingDetector`` by their size and by the hop of decisions, beside the naive way, a
bin with all its context for every decision; the CPU time of a hop with an onset classifier, a
network of drawn weights, in Python, in the C library and in the host in C on onnxruntime; and the
resident memory along an hour of stream.
"""

from __future__ import annotations

import ctypes
import gc
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import psutil
import torch
from matplotlib.figure import Figure

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import (
    RATE_HZ,
    Array,
    alarm_settings,
    drawn_network,
    loaded,
    onset_settings,
    pushing,
    stream_samples,
)
from benchmarks.tables import Report, Table, chart, limits, lines, listed
from benchmarks.timing import growth_mb, in_fresh_process, interleaved, on_threads
from benchmarks.trainings import main_job_detector
from tactslip_torch import AlarmSettings, SlipDetector, StreamingDetector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.deploy.native import NativeFile
from tactslip_torch.onset.decisions import KEY

SOURCES = ("export/c/*",)
HOP, PUSH = 20, 200
"""The settings that the limit is about: a decision every 10 ms, pushes of 100 ms."""
MOST_LOAD, MOST_GROWTH_MB = 1 / 20, 2.0


@dataclass(frozen=True)
class Streaming(Benchmark):
    """Pushes, and memory along a stream.

    Args:
        recordings: simulated, to whose bins the head is fitted, and which are the stream.
        pushes: samples of a push, at ``HOP``.
        hops: samples between decisions, at ``PUSH`` and of the naive way.
        rounds: of every way.
        watched_s: of the stream, while the memory is looked at.
        settled_s: of the stream, until the memory has to stay where it is.
        onset_hops: pushes of a hop of the onset classifier.
    """

    title = "Streams"
    about = (
        "a simulated stream of 24 channels at 2 kHz in float32, watched by the detector of the "
        "main job (`+exp=unseen4`, the default recipe), on 1 thread. *Times faster*: than real time"
    )
    quick = (
        "recordings=1 pushes=[200] hops=[20] rounds=1 watched_s=4.0 settled_s=2.0 onset_hops=310"
    )
    charts: ClassVar = {"": ()}
    recordings: int = 8
    pushes: tuple[int, ...] = (1, 20, 200, 2000)
    hops: tuple[int, ...] = (10, 20, 50, 100)
    rounds: int = 20
    watched_s: float = 3600.0
    settled_s: float = 300.0
    onset_hops: int = 6000

    def measure(self, job: Job) -> dict[str, Any]:
        """Seconds of pushes by way, and resident memory."""
        path = main_job_detector(job)
        detector = loaded(path)
        samples = stream_samples(self.recordings)
        pairs = [(HOP, push) for push in self.pushes]
        pairs += [(hop, PUSH) for hop in self.hops if (hop, PUSH) not in pairs]
        ways = [("stream", hop, push) for hop, push in pairs]
        ways += [("naive", hop, hop) for hop in self.hops]
        with on_threads(1), torch.no_grad():
            calls: dict[str, Callable[[], Any]] = {}
            for kind, hop, push in ways:
                if kind == "naive":
                    call = _naive(detector, samples, hop)
                else:
                    stream = StreamingDetector(detector, alarm_settings(hop), dtype=torch.float32)
                    call = pushing(stream.push, samples, push)
                    for _ in range(round(RATE_HZ / push)):
                        call()  # until every push makes its decisions
                calls[f"{kind} {hop} {push}"] = call
            say(f"streaming: {self.rounds} rounds of {len(calls)} ways")
            timings = interleaved(calls, self.rounds, block_s=0.1, most_calls=2000)
        speed = [
            {
                "way": f"{kind}, hop {_ms(hop)} ms, pushes of {_ms(push)} ms",
                "times faster": [push / RATE_HZ / seconds for seconds in of["seconds"]],
                "median push, us": 1e6 * of["p50_s"],
                "99th percentile, us": 1e6 * of["p99_s"],
            }
            for (kind, hop, push), of in zip(ways, timings.values(), strict=True)
        ]
        say(f"streaming: {self.onset_hops} hops of an onset classifier")
        with on_threads(1), torch.no_grad():
            hops = _hops(detector, samples, self.onset_hops)
        say(f"streaming: {self.watched_s:g} s of stream in a fresh process")
        memory = in_fresh_process(
            f"benchmarks.{self.name}:watch", seconds=self.watched_s, detector_path=str(path)
        )
        growth = growth_mb(memory, self.settled_s)
        load = 1 / median(speed[pairs.index((HOP, PUSH))]["times faster"])
        goals = [
            (f"load at hop {_ms(HOP)} ms, pushes of {_ms(PUSH)} ms", load, MOST_LOAD, "of a core"),
            ("resident memory, growth after it has settled", growth, MOST_GROWTH_MB, "MB"),
        ]
        for row in hops:
            if row["push"] == "hop":
                about = f"a hop of the onset classifier, {row['host']}, p50"
                goals.append((about, row["p50 us"], _HOP_LIMITS[row["host"]], "us"))
        held = {
            "stream watched, s": memory["at_s"][-1],
            "resident at its end, MB": memory["resident_bytes"][-1] / 1e6,
            "growth since it settled, MB": growth,
            "held by the stream itself, kB": memory["state_bytes"] / 1e3,
        }
        tables = {
            "Limits": limits(goals),
            "Speed": Table(
                speed, "*Naive*: each decision computes its whole bin with all its context again."
            ),
            "Hops of an onset classifier": Table(
                hops,
                "CPU time on one thread. A push is one hop, 5 ms; every fifth push also completes "
                "a bin.",
            ),
            "Memory": listed("memory", held),
        }
        return {"tables": tables, "memory": memory}

    def draw(self, numbers: Report, drawing: Figure, ending: str) -> None:
        """Speed by way, and memory over time."""
        speed, memory = drawing.subplots(2, 1, height_ratios=[2, 1])
        chart(speed, *self.tables(numbers)["Speed"].columns("times"), "times faster")
        of = numbers["memory"]
        held = {"resident": (of["at_s"], np.divide(of["resident_bytes"], 1e6))}
        lines(memory, held, "s of stream", "resident, MB")


_FIRST_TIMED = 300  # hop, when evidence has its floor
_HOP_LIMITS = {"Python": 250.0, "C": 100.0, "onnxruntime": 200.0}  # us, the median
_WIDTHS = (64, 32)  # of the network of +exp=onset


def _hops(detector: SlipDetector, samples: Array, num: int) -> list[dict[str, Any]]:
    """Time on a CPU of pushes of a hop, those that complete a bin apart; by host."""
    settings = onset_settings(detector, samples)
    assert settings.onset is not None
    network = drawn_network(settings.onset.evidence, *_WIDTHS)
    settings = replace(settings, onset=replace(settings.onset, head=network))
    hop = settings.decision_samples
    live = StreamingDetector(detector, settings, dtype=torch.float32)
    first = detector.pool.bin_samples + detector.look_ahead  # samples before the first decision
    hosts: dict[str, Callable[[Array], object]] = {"Python": live.push}
    made = copy(detector)
    made.info = {**detector.info, KEY: settings.to_dict()}
    hosts["C"] = NativeFile.of(made, "float32").stream().push
    with TemporaryDirectory() as folder:
        if push := _on_onnxruntime(made, Path(folder)):
            hosts["onnxruntime"] = push
        seconds: dict[tuple[str, str], list[float]] = {}
        for host, push in hosts.items():  # one after the other: they would share the caches
            call = pushing(push, samples, hop)
            for place in range(num):
                bins = [(x * hop - first) // settings.hop_samples for x in (place, place + 1)]
                started = time.thread_time()
                call()
                spent = time.thread_time() - started
                if place >= _FIRST_TIMED:
                    kind = "hop" if bins[0] == bins[1] else "hop and bin"
                    seconds.setdefault((host, kind), []).append(spent)
    rows = []
    for (host, kind), own in seconds.items():
        p50, p99 = (1e6 * np.quantile(own, (0.5, 0.99))).tolist()
        rows.append({"host": host, "push": kind, "p50 us": p50, "p99 us": p99})
    return rows


def _on_onnxruntime(detector: SlipDetector, folder: Path) -> Callable[[Array], object] | None:
    """Pushes of the host in C on onnxruntime, which is built; None where there is no compiler."""
    if not (shutil.which("cc") and shutil.which("make")):
        return None
    path = export_detector(detector, folder, ["stream"])[0]
    words = [f"BUILD={folder}", f"PYTHON={sys.executable}", f"{folder}/libslip.so"]
    source = Path(__file__).parents[1] / "export" / "c"
    subprocess.run(["make", "-C", source, *words], check=True, stdout=subprocess.DEVNULL)
    library = ctypes.CDLL(f"{folder}/libslip.so")
    library.slip_open.restype = ctypes.c_void_p
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    library.slip_push.argtypes = (pointer, pointer, size, pointer)
    error, found = ctypes.create_string_buffer(1024), ctypes.create_string_buffer(4096)
    hop = AlarmSettings.of(detector).decision_samples
    handle = library.slip_open(str(path).encode(), hop, error)
    if not handle:
        raise RuntimeError(error.value.decode())

    def push(samples: Array) -> None:
        if library.slip_push(handle, samples.ctypes.data, len(samples), found) < 0:
            raise RuntimeError("the host failed")

    return push


def watch(seconds: float, detector_path: str) -> dict[str, Any]:
    """Watch so much of a stream, and look at the resident memory of this process every second."""
    torch.set_num_threads(1)
    detector = loaded(detector_path)
    stream = StreamingDetector(detector, alarm_settings(HOP), dtype=torch.float32)
    push = pushing(stream.push, stream_samples(1), PUSH)
    at_s: list[float] = []
    resident: list[int] = []
    state_bytes, each_s = 0, max(1.0, seconds / 400)
    gc.collect()
    for number_of_push in range(round(seconds * RATE_HZ / PUSH) + 1):
        push()
        now_s = number_of_push * PUSH / RATE_HZ
        if now_s >= len(at_s) * each_s:
            at_s.append(now_s)
            resident.append(int(psutil.Process().memory_info().rss))
            state_bytes = max(state_bytes, stream.state_bytes)
    return {"at_s": at_s, "resident_bytes": resident, "state_bytes": state_bytes}


def _naive(detector: SlipDetector, samples: Array, hop: int) -> Callable[[], Any]:
    """Every bin from the raw samples around it, at a distance of ``hop``."""
    whole = torch.from_numpy(samples.T.copy())
    length = detector.context_before + detector.pool.bin_samples + detector.context_after
    each = cycle(range(0, whole.shape[-1] - length, hop))
    return lambda: detector.predict_raw(whole[None, :, (at := next(each)) : at + length])


def _ms(samples: int) -> str:
    return f"{1e3 * samples / RATE_HZ:g}"


if __name__ == "__main__":
    raise SystemExit(Streaming().run())
