"""What a push of a stream costs: the stream graph in onnxruntime beside ``StreamingDetector``."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.clocks import on_threads, say
from benchmarks.deployment.files import EXPORTS, STREAM, Files, of_way
from benchmarks.deployment.measure import error_of
from benchmarks.deployment.sizes import PUSHES, Sizes
from benchmarks.deployment.subject import Subject
from benchmarks.deployment.ways import engine_way
from benchmarks.engines import DTYPES, ENGINES, FLOAT32, FLOAT64
from benchmarks.exported import session_of
from benchmarks.latency.measure import summary
from benchmarks.streaming.ways import RATE_HZ, Endless, stream_samples
from tactslip_torch.features.extractor import EngineName
from tactslip_torch.onset.settings import KEY, AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

Array = NDArray[Any]
_PIECE = 2000  # samples of a push where nothing is timed


class Watcher(Protocol):
    """What takes the next samples of a stream."""

    def push(self, samples: Array, /) -> Array:
        """The scores that samples ``[n, C]`` make possible, ``[k]``."""


class Graph:
    """A stream graph, with what a host keeps between two pushes.

    Args:
        path: of its file.
        threads: it may use.
    """

    _OUTPUTS = ("next_tail", "next_state", "score", "probability", "statistic", "valid")
    _TIMES = ("alarm", "on", "time_s", "onset_s")

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._session = session_of(path, threads)
        shape = next(i.shape for i in self._session.get_inputs() if i.name == "tail")
        kind = next(i.type for i in self._session.get_inputs() if i.name == "samples")
        self.dtype = np.float64 if kind == "tensor(double)" else np.float32
        self._tail = np.zeros((0, shape[1]), self.dtype)
        self._state, self._own = np.zeros(0), np.zeros(0)

    def push(self, samples: Array, /) -> Array:
        """The scores that they make possible; every other output is made as well."""
        given = {"samples": np.asarray(samples, self.dtype), "tail": self._tail}
        given |= {"state": self._state, "threshold": self._own}
        outputs = self._session.run([*self._OUTPUTS, *self._TIMES], given)
        self._tail, self._state = outputs[:2]
        score: Array = outputs[2]
        return score


class Stream:
    """``StreamingDetector`` by its scores."""

    def __init__(self, subject: Subject, engine: EngineName, dtype: str) -> None:
        detector = subject.detector(engine, dtype)
        detector.extractor.warm_up()
        self._stream = StreamingDetector(detector, dtype=DTYPES[dtype].dtype)

    def push(self, samples: Array, /) -> Array:
        """The scores that they make possible."""
        score: Array = self._stream.push(samples).score.numpy()
        return score


def watchers(subject: Subject, files: Files) -> dict[str, Callable[[], Watcher]]:
    """What makes a watcher, by way."""
    found: dict[str, Callable[[], Watcher]] = {}
    for way in EXPORTS:
        found[way] = partial(Graph, files.paths[of_way(way, STREAM)])
    for engine, dtype in product(ENGINES, (FLOAT32, FLOAT64)):
        found[engine_way(engine, dtype)] = partial(Stream, subject, engine, dtype)
    return found


class _Run(NamedTuple):
    """A watcher that is timed."""

    watcher: Watcher
    samples: Endless
    push: int
    decisions: int
    seconds: list[list[float]]


def on_streams(subject: Subject, files: Files, sizes: Sizes) -> list[dict[str, Any]]:
    """Rows of every way and push: seconds of pushes, and errors of scores; on one thread.

    Pushes are told apart by the decisions they bring: those that bring another number than is
    usual, as a first push does, are not counted.
    """
    hop = AlarmSettings.from_dict(subject.info[KEY]).hop_samples
    samples = stream_samples(2)
    with torch.inference_mode(), on_threads(1):
        makers = watchers(subject, files)
        errors = _errors(makers, Stream(subject, "reference", FLOAT64), samples, sizes)
        runs = {
            (way, push): _Run(make(), Endless(samples), push, push // hop, [])
            for way, make in makers.items()
            for push in PUSHES
        }
    with torch.inference_mode(), on_threads(1):
        for run in runs.values():
            _watch(run, 200)
            run.seconds.clear()
        shuffle = random.Random(sizes.seed)
        for number in range(sizes.stream_rounds):
            say(f"deployment: streams, round {number + 1} of {sizes.stream_rounds}")
            for key in shuffle.sample(list(runs), len(runs)):
                _watch(runs[key], sizes.stretch)
    return [
        {
            "way": way,
            "push": push,
            "decisions": run.decisions,
            **summary([taken for taken in run.seconds if taken]),
            **{f"score_{name}": value for name, value in errors[way].items()},
        }
        for (way, push), run in runs.items()
    ]


def _watch(run: _Run, pushes: int) -> None:
    """Push so often, and keep the seconds of the pushes that count."""
    taken = []
    for _ in range(pushes):
        samples = run.samples.next(run.push)
        started = time.perf_counter()
        scores = run.watcher.push(samples)
        seconds = time.perf_counter() - started
        if len(scores) == run.decisions:
            taken.append(seconds)
    run.seconds.append(taken)


def _errors(
    makers: Mapping[str, Callable[[], Watcher]], exact: Watcher, samples: Array, sizes: Sizes
) -> dict[str, dict[str, Any]]:
    """Of the scores of a stretch of stream, by way.

    Raises:
        ValueError: if a way makes another number of decisions.
    """
    say("deployment: streams beside the reference")
    part = samples[: round(sizes.streamed_s * RATE_HZ)]
    expected = _all_scores(exact, part)
    found = {}
    for way, make in makers.items():
        scores = _all_scores(make(), part)
        if len(scores) != len(expected):
            raise ValueError(f"{way} makes {len(scores)} decisions, expected {len(expected)}")
        found[way] = error_of(scores, expected)
    return found


def _all_scores(watcher: Watcher, samples: Array) -> Array:
    places = range(_PIECE, len(samples), _PIECE)
    parts = [watcher.push(piece) for piece in np.split(samples, list(places))]
    return np.concatenate(parts).astype(np.float64)
