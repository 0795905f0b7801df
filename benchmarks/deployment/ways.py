"""Ways from raw bins to scores, each with what it wants to be given."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.bins import raw_bins
from benchmarks.clocks import say, timed
from benchmarks.deployment.files import (
    BIN,
    EXPORTS,
    NAIVE,
    Files,
    naive_of,
    of_way,
)
from benchmarks.deployment.sizes import Sizes
from benchmarks.deployment.subject import Subject
from benchmarks.engines import ENGINES, FLOAT32, FLOAT64, pool_of
from benchmarks.exported import judge_of, session_of
from benchmarks.latency.ways import looped
from tactslip_torch.features.extractor import EngineName
from tactslip_torch.model.detector import SlipDetector

LOOP = "SciPy + PyWavelets loop, all features"
PRUNED_LOOP = "SciPy + PyWavelets loop, needed features"
NAIVE_TORCH = "naive in torch, all features"
NAIVE_COMPILED = "naive by torch.compile, all features"


class Way(NamedTuple):
    """One way.

    Attributes:
        cut: raw bins ``[N, 24, 150]``, float32 volts, to what ``run`` takes.
        run: that to scores ``[N]``.
        features: how many it makes of a bin, or is asked for.
        most: bins that it takes at once; ``None`` for any number.
        calls: chunks of bins that it takes at once, for work in bulk alone if more than one.
    """

    cut: Callable[[Tensor], Any]
    run: Callable[[Any], Any]
    features: int
    most: int | None = None
    calls: int = 1


def engine_way(engine: str, dtype: str) -> str:
    """The name of a way by an engine of the package.

    Example:
        >>> engine_way("eager", "float32")
        'eager engine, float32'
    """
    return f"{engine} engine, {dtype}"


def at_once(way: str) -> str:
    """The name of a way whose threads each run a chunk, instead of sharing one."""
    return f"{way}, a chunk a thread"


REFERENCE = engine_way("reference", FLOAT64)


def ways_of(subject: Subject, files: Files, sizes: Sizes, threads: int) -> dict[str, Way]:
    """Every way by its name, on so many threads; the loop knows one alone."""
    found = _exports(subject, files, threads) | _engines(subject)
    if threads > 1:
        alone = _exports(subject, files, 1)
        found |= {at_once(name): _shared_out(way, threads) for name, way in alone.items()}
    needed, every = len(subject.timed.selected), len(pool_of(FLOAT64).names)
    made = {True: every, False: needed}
    for is_whole, name in NAIVE.items():
        if name in files.paths:
            session = session_of(files.paths[name], threads)
            found[name] = Way(_as_array, partial(_scores, session), made[is_whole])
    if sizes.has_naive:
        module = naive_of(subject, is_whole=True).float().eval()
        found[NAIVE_TORCH] = Way(_as_float32, module, every)
    if sizes.has_loop and threads == 1:
        for name, wanted in {LOOP: range(every), PRUNED_LOOP: subject.timed.selected}.items():
            of_one = looped(subject.timed, subject.machine, wanted)
            score = partial(_one_by_one, of_one)
            found[name] = Way(_as_array, score, len(wanted), most=1)
    return found


def compiled_naive(subject: Subject) -> tuple[Way, float]:
    """The naive pipeline by ``torch.compile`` for one bin at a time, and the seconds that took.

    It is compiled for one batch size on the threads of now. Of the package's own reference
    ``torch.compile`` makes pieces, as it looks at values, compiles some of them until it gives up
    for their number, and is slower than without; the naive pipeline is one graph without such
    looks once ``torch.export`` has written it down.
    """
    say("deployment: torch.compile, which takes a while")
    module, example = naive_of(subject, is_whole=True).float().eval(), raw_bins(1)
    with warnings.catch_warnings(), fresh_compilation():
        warnings.simplefilter("ignore")
        program = torch.export.export(module, (example,), strict=False).module()
        run = torch.compile(program, fullgraph=True, dynamic=False)
        seconds, _ = timed(lambda: run(example))
    return Way(_as_float32, run, len(pool_of(FLOAT64).names), most=1), seconds


def fresh_compilation() -> AbstractContextManager[Any]:
    """Nothing that an earlier run has compiled is taken, and no process is left that compiles."""
    config = import_module("torch._inductor.config")
    patch: AbstractContextManager[Any] = config.patch(
        {"force_disable_caches": True, "compile_threads": 1}
    )
    return patch


def _exports(subject: Subject, files: Files, threads: int) -> dict[str, Way]:
    context = subject.detector("reference", FLOAT64).channel_filter.context
    found = {}
    for name in EXPORTS:
        judge = judge_of(files.paths[of_way(name, BIN)], threads, context)
        found[name] = Way(*judge, len(subject.timed.selected))
    return found


def _shared_out(way: Way, threads: int) -> Way:
    """Two chunks for each thread at a time."""
    pool = ThreadPoolExecutor(threads)
    calls = 2 * threads

    def run(samples: Any) -> Any:
        return np.concatenate(list(pool.map(way.run, np.array_split(samples, calls))))

    return way._replace(run=run, calls=calls)


def _engines(subject: Subject) -> dict[str, Way]:
    found = {}
    each: list[tuple[EngineName, str]] = [*product(ENGINES, (FLOAT32, FLOAT64))]
    for engine, dtype in [*each, ("reference", FLOAT64)]:
        detector = subject.detector(engine, dtype)
        run = partial(_judged, detector)
        cut = _as_float64 if dtype == FLOAT64 else _as_float32
        found[engine_way(engine, dtype)] = Way(cut, run, len(subject.timed.selected))
    return found


def _judged(detector: SlipDetector, samples: Tensor) -> Tensor:
    return detector.judge_raw(samples).score


def _scores(session: Any, samples: Any) -> Any:
    return session.run(["score"], {"samples": samples})[0]


def _one_by_one(of_one: Callable[[Any], float], samples: Any) -> Any:
    return np.array([of_one(each) for each in samples])


def _as_array(samples: Tensor) -> Any:
    return samples.numpy()


def _as_float32(samples: Tensor) -> Tensor:
    return samples


def _as_float64(samples: Tensor) -> Tensor:
    return samples.double()
