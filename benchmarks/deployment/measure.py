"""The measurements of ``benchmarks.deployment`` on bins: latency, throughput, accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.bins import raw_bins
from benchmarks.clocks import Way as Timed
from benchmarks.clocks import on_threads, say, shuffled_rounds, shuffled_singles, timed
from benchmarks.deployment.files import EXPORTS, Files
from benchmarks.deployment.sizes import Sizes
from benchmarks.deployment.subject import Subject, held_out_bins
from benchmarks.deployment.ways import NAIVE_COMPILED, REFERENCE, Way, compiled_naive, ways_of
from benchmarks.latency.measure import summary
from benchmarks.machine import threads_text

Array = NDArray[Any]
Rows = list[dict[str, Any]]
_CHUNK = 64  # of bins that are judged, not timed


def on_bins(subject: Subject, files: Files, sizes: Sizes) -> dict[str, Rows]:
    """Rows of single bins, of bins in bulk, and of the errors of scores."""
    single: Rows = []
    bulk: Rows = []
    errors: Rows = []
    for threads in sizes.threads:
        with torch.inference_mode(), on_threads(threads):
            ways = ways_of(subject, files, sizes, threads)
            about = {"threads": threads}
            if sizes.has_compile and threads == 1:
                ways[NAIVE_COMPILED], seconds = compiled_naive(subject)
                files.seconds[NAIVE_COMPILED] = seconds
        with torch.inference_mode(), on_threads(threads):  # of the libraries loaded by now as well
            single += [row | about for row in _single(ways, sizes, threads)]
            bulk += [row | about for row in _bulk(ways, sizes, threads)]
            if not errors:
                errors = _errors(ways, held_out_bins(sizes.held_out), sizes)
    return {"single": single, "bulk": bulk, "errors": errors}


def _single(ways: Mapping[str, Way], sizes: Sizes, threads: int) -> Rows:
    """One bin at a time."""
    say(f"deployment: single bins on {threads_text(threads)}, {len(ways)} ways")
    samples = raw_bins(sizes.timed)
    runs = {name: _in_turn(way, samples, 1) for name, way in ways.items() if way.calls == 1}
    block_s = sizes.block_ms / 1e3
    seconds = shuffled_singles(runs, sizes.rounds, sizes.seed, block_s, sizes.most_calls)
    return [
        {"way": name, "features": ways[name].features, **summary(taken)}
        for name, taken in seconds.items()
    ]


def _bulk(ways: Mapping[str, Way], sizes: Sizes, threads: int) -> Rows:
    """Many bins, in chunks of a size."""
    rows: Rows = []
    samples = raw_bins(sizes.timed)
    a_bin_s: dict[str, float] = {}
    for chunk in sizes.chunks:
        say(f"deployment: chunks of {chunk} on {threads_text(threads)}")
        calls = {}
        for name, way in ways.items():
            bins = chunk * way.calls
            is_long = bins * a_bin_s.get(name, 0.0) > sizes.longest_s
            if not is_long and chunk <= (way.most or chunk):
                many = samples[torch.arange(max(bins, sizes.timed)) % len(samples)]
                calls[name] = Timed(_counted(_in_turn(way, many, bins)))
        for name, taken in shuffled_rounds(calls, sizes.bulk_rounds, sizes.seed).items():
            bins = chunk * ways[name].calls
            a_bin_s[name] = min(taken) / bins
            rows.append({"way": name, "chunk": chunk, "bins": bins, "seconds": taken})
    return rows


def _errors(ways: Mapping[str, Way], bins: Tensor, sizes: Sizes) -> Rows:
    """Scores of held-out bins against the reference; of peers of as many as there is time for."""
    say(f"deployment: {len(bins)} held-out bins by {REFERENCE}")
    exact = _scores(ways[REFERENCE], bins, math.inf)
    rows: Rows = []
    for name, way in ways.items():
        if name != REFERENCE:
            say(f"deployment: {name}")
            longest_s = math.inf if name in EXPORTS else sizes.judged_s
            rows.append({"way": name, **error_of(_scores(way, bins, longest_s), exact)})
    return rows


def error_of(found: Array, exact: Array) -> dict[str, Any]:
    """How far scores are off.

    Args:
        found: of the first bins.
        exact: of all.

    Returns:
        ``worst`` and ``p99`` in standard deviations of all exact scores, ``flips``, how many
        decide otherwise, and ``bins``, of how many that is told.
    """
    own = exact[: len(found)]
    error = np.abs(found - own) / exact.std()
    return {
        "bins": len(found),
        "worst": float(error.max()),
        "p99": float(np.percentile(error, 99)),
        "flips": int(((found >= 0) != (own >= 0)).sum()),
    }


def _scores(way: Way, bins: Tensor, longest_s: float) -> Array:
    """Of the first bins, chunk by chunk until the time is over."""
    found, spent, place = [], 0.0, 0
    chunk = way.most or _CHUNK
    while place < len(bins) and spent <= longest_s:
        taken, scores = timed(partial(way.run, way.cut(bins[place : place + chunk])))
        found.append(np.asarray(scores, np.float64))
        spent, place = spent + taken, place + chunk
    return np.concatenate(found)


def _in_turn(way: Way, samples: Tensor, chunk: int) -> Callable[[int], object]:
    """A call of a number, of one chunk after the other."""
    pieces = [way.cut(piece.contiguous()) for piece in samples.split(chunk)]
    return lambda number: way.run(pieces[number % len(pieces)])


def _counted(call: Callable[[int], object]) -> Callable[[], object]:
    """The same, that counts its calls itself."""
    numbers = count()
    return lambda: call(next(numbers))
