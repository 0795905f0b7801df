"""The measurements of ``benchmarks.streaming``: how fast a stream is watched, in what memory."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.clocks import on_threads, say
from benchmarks.detectors import Timed
from benchmarks.engines import ENGINES, FLOAT64
from benchmarks.streaming.sizes import CHUNK, HOP, Sizes
from benchmarks.streaming.ways import (
    RATE_HZ,
    Endless,
    Naive,
    Watcher,
    ours,
    settings_of,
    stream_samples,
)
from benchmarks.streaming.worker import watched
from tactslip_torch.features.extractor import EngineName

SECTIONS = ("speed", "memory")
STREAM, NAIVE = "stream", "naive"


class Way(NamedTuple):
    """A watcher, and how it is fed.

    Attributes:
        kind: ``STREAM`` or ``NAIVE``.
        engine: of the features.
        hop: samples between decisions.
        chunk: samples of a push.
        make: of a watcher.
    """

    kind: str
    engine: EngineName
    hop: int
    chunk: int
    make: Callable[[], Watcher]


def ways_of(timed: Timed, sizes: Sizes) -> list[Way]:
    """Every way: the stream by chunk and by hop, the naive one by hop."""
    found = []
    for engine in ENGINES:
        detector = timed.detector(engine, FLOAT64)
        detector.extractor.warm_up()
        pairs = [(HOP, chunk) for chunk in sizes.chunks]
        pairs += [(hop, CHUNK) for hop in sizes.hops if (hop, CHUNK) not in pairs]
        for hop, chunk in pairs:
            found.append(Way(STREAM, engine, hop, chunk, partial(ours, detector, hop)))
        for hop in sizes.hops:
            make = partial(Naive, detector, settings_of(hop))
            found.append(Way(NAIVE, engine, hop, hop, make))
    return found


def speed(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """Seconds of every push, on one thread, each way in every round in an order of its own."""
    with on_threads(1), torch.no_grad():
        ways = ways_of(timed, sizes)
    samples = stream_samples(sizes.streamed)
    with on_threads(1):  # of the libraries loaded by now as well
        watchers = [way.make() for way in ways]
        streams = [Endless(samples) for _ in ways]
        pushes: list[list[list[float]]] = [[] for _ in ways]
        core_s: list[list[float]] = [[] for _ in ways]
        for watcher, stream, way in zip(watchers, streams, ways, strict=True):
            _watch(watcher, stream, way.chunk, max(sizes.short_s, 3 * way.chunk / RATE_HZ))
        shuffle = random.Random(sizes.seed)
        for number in range(sizes.rounds):
            say(f"streaming, round {number + 1} of {sizes.rounds}: {len(ways)} ways")
            for place in shuffle.sample(range(len(ways)), len(ways)):
                chunk = ways[place].chunk
                stretch = sizes.short_s if chunk == 1 else sizes.stretch_s
                busy = time.process_time()
                pushes[place].append(_watch(watchers[place], streams[place], chunk, stretch))
                core_s[place].append(time.process_time() - busy)
    return {"rows": [_row(*of_way) for of_way in zip(ways, pushes, core_s, strict=True)]}


def memory(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """Resident memory along an hour of stream, in a process of its own."""
    say(f"streaming: {sizes.watched_s:g} s of stream in a fresh process")
    job = {key: asdict(sizes)[key] for key in ("streamed", "watched_s", "sample_s")}
    found = watched(
        names=list(timed.selection["names"]), engine=ENGINES[0], hop=HOP, chunk=CHUNK, **job
    )
    return found | {"settled_s": sizes.settled_s}


def _watch(watcher: Watcher, stream: Endless, chunk: int, stretch_s: float) -> list[float]:
    """Seconds of every push of a stretch of the stream."""
    taken = []
    for _ in range(max(1, round(stretch_s * RATE_HZ / chunk))):
        samples = stream.next(chunk)
        started = time.perf_counter()
        watcher.push(samples)
        taken.append(time.perf_counter() - started)
    return taken


def _row(way: Way, rounds: list[list[float]], core_s: list[float]) -> dict[str, Any]:
    every = np.concatenate([np.asarray(taken) for taken in rounds])
    places = {"p50_s": 50, "p99_s": 99}
    return {
        "kind": way.kind,
        "engine": way.engine,
        "hop": way.hop,
        "chunk": way.chunk,
        "pushes": len(every),
        "seconds": [sum(taken) for taken in rounds],
        "core_s": core_s,
        "stream_s": [len(taken) * way.chunk / RATE_HZ for taken in rounds],
        **{name: float(np.percentile(every, place)) for name, place in places.items()},
    }
