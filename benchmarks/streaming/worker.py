"""A process of its own that watches a long stream and looks at its resident memory."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.bins import WINDOW_LENGTHS
from benchmarks.engines import FLOAT64, pool_of
from benchmarks.model.worker import WorkerFailedError
from benchmarks.streaming.ways import RATE_HZ, Endless, ours, stream_samples
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

_STATM = Path("/proc/self/statm")


def watched(**job: Any) -> dict[str, Any]:
    """Watch in a fresh process.

    Args:
        job: arguments of ``watch``.

    Raises:
        WorkerFailedError: if it ends without an answer.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.streaming.worker"],
        input=json.dumps(job),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    if done.returncode:
        raise WorkerFailedError("the worker of the stream ended without an answer; see above")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def resident_bytes() -> int | None:
    """Memory of this process; ``None`` where the system does not tell."""
    if not _STATM.exists():
        return None
    return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def watch(
    names: Sequence[str],
    engine: Any,
    hop: int,
    chunk: int,
    streamed: int,
    watched_s: float,
    sample_s: float,
) -> dict[str, Any]:
    """Watch a stream, with a look at the memory every so often.

    Args:
        names: of the features; the head on them is any.
        engine: that makes them.
        hop: samples between decisions.
        chunk: samples of a push.
        streamed: recordings that are the stream, over and over.
        watched_s: how much of it.
        sample_s: between two looks.

    Returns:
        ``at_s`` and ``resident_bytes`` of every look, empty where the system does not tell; what a
        stream holds; seconds, pushes, decisions.
    """
    pool = pool_of(FLOAT64)
    place = {str(name): index for index, name in enumerate(pool.names)}
    num = len(names)
    head = QuadraticForm(torch.eye(num), torch.ones(num), torch.zeros(())).double()
    scaler = FeatureScaler(-torch.ones(num).double(), torch.ones(num).double())
    selected = [place[name] for name in names]
    detector = SlipDetector(
        pool, ChannelFilter(WINDOW_LENGTHS), selected, scaler, head, engine=engine
    )
    detector.extractor.warm_up()
    stream, samples = ours(detector, hop), Endless(stream_samples(streamed))
    at_s, resident, held, decisions = [], [], 0, 0
    gc.collect()
    started, pushes = time.perf_counter(), round(watched_s * RATE_HZ / chunk)
    every = max(1, round(sample_s * RATE_HZ / chunk))
    for number in range(pushes + 1):
        if number % every == 0 and (now := resident_bytes()) is not None:
            at_s.append(number * chunk / RATE_HZ)
            resident.append(now)
        decisions += len(stream.push(samples.next(chunk)).number)
        held = max(held, stream.state_bytes)
    return {
        "at_s": at_s,
        "resident_bytes": resident,
        "state_bytes": held,
        "seconds": time.perf_counter() - started,
        "decisions": decisions,
        "engine": str(engine),
    }


def main() -> None:
    """Entry point of the worker."""
    job = json.load(sys.stdin)
    torch.set_num_threads(1)
    print(json.dumps(watch(**job)))


if __name__ == "__main__":
    main()
