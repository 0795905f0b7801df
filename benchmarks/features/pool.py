"""The whole pool by every engine, beside what else there is: seconds of every round, and errors.

One call of everything in every round, in an order of its own. An engine takes many bins at once, a
peer as many as it needs to be timed well. MiniRocket and TSFEL make other features of the same
bins: theirs have no error. The SciPy loop has no rule for constants, so some of its values are NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.bins import DEGENERATE, DESCRIBED, KINDS, bins_of
from benchmarks.clocks import Turns, on_threads, say, shuffled_turns
from benchmarks.engines import ENGINES, FLOAT32, FLOAT64, extractor, pool_of
from benchmarks.errors import feature_errors
from benchmarks.features.sizes import Sizes
from benchmarks.peers import arrays, hard, loop, others

ORACLE, NUMPY, LOOP = "NumPy, slow oracle", "NumPy, vectorised", "SciPy + PyWavelets loop"
MINI_ROCKET, TSFEL = "aeon MiniRocket, transform", "TSFEL, all features"
REFERENCE = "reference"


class Call(NamedTuple):
    """A way to features of some bins.

    Attributes:
        run: makes them.
        num_bins: of how many.
        threads: it may run on; of NumPy only products of matrices do.
        truth: what they should be, of the first bins; ``None`` for other features.
    """

    run: Callable[[], Any]
    num_bins: int
    threads: int
    truth: Tensor | None = None


def full_pool(sizes: Sizes) -> dict[str, Any]:
    """All features of bins of every kind by everything there is."""
    rows: list[dict[str, Any]] = []
    windows = bins_of(KINDS[0], min(64, sizes.pool.windows)).numpy()
    rocket, tsfel = others.mini_rocket(windows, sizes.pool.threads), others.tsfel_features()
    with torch.inference_mode(), on_threads(sizes.pool.threads):  # of all that is loaded by now
        for kind in KINDS:
            calls = _ours(kind, sizes) | _peers(kind, sizes, rocket, tsfel)
            runs = {name: call.run for name, call in calls.items()}
            turns = shuffled_turns(runs, sizes.pool.rounds, sizes.seed, f"pool, {kind} bins")
            rows += [_row(kind, name, calls[name], turns[name]) for name in calls]
            del calls, runs, turns
        say("pool, errors of degenerate bins")
        calls = _ours(DEGENERATE, sizes)
        degenerate = [
            {"way": name, "errors": _errors(call, call.run())}
            for name, call in calls.items()
            if not name.startswith(REFERENCE)
        ]
    return {"rows": rows, "degenerate": degenerate, "kinds": DESCRIBED}


def _ours(kind: str, sizes: Sizes) -> dict[str, Call]:
    of = sizes.pool
    num = of.judged if kind == DEGENERATE else of.bins
    wide = bins_of(kind, num, seed=sizes.seed)
    calls: dict[str, Call] = {}
    for dtype, bins in ((FLOAT32, wide.float()), (FLOAT64, wide)):
        truth = extractor(REFERENCE, FLOAT64)(bins[: of.judged].double())
        for engine in ENGINES:
            run = partial(extractor(engine, dtype), bins)
            calls[f"{engine}, {dtype}"] = Call(run, num, of.threads, truth)
        few = bins[: of.reference_bins]
        name = f"{REFERENCE}, {dtype}"
        calls[name] = Call(partial(extractor(REFERENCE, dtype), few), len(few), of.threads, truth)
    return calls


def _peers(kind: str, sizes: Sizes, rocket: Any, tsfel: Callable[[Any], Any]) -> dict[str, Call]:
    of = sizes.pool
    bins = bins_of(kind, max(of.windows, of.reference_bins, of.oracle_bins), seed=sizes.seed)
    truth = extractor(REFERENCE, FLOAT64)(bins[: of.judged])
    pool = pool_of(FLOAT64)
    names = [(n.channel, n.component, n.domain, n.descriptor) for n in pool.names]
    one, values = bins[0].numpy(), bins.numpy()
    windows = values[: of.windows].astype(np.float32)
    slow = partial(arrays.features, values[: of.oracle_bins], 14, hard.BY_ROW)
    quick = partial(arrays.features, values[: of.reference_bins], 14, hard.VECTORISED)
    return {
        NUMPY: Call(quick, of.reference_bins, of.threads, truth),
        ORACLE: Call(slow, of.oracle_bins, of.threads, truth),
        LOOP: Call(partial(_looped, one, names, pool.hand.names), 1, 1, truth),
        TSFEL: Call(partial(tsfel, one), 1, 1),
        MINI_ROCKET: Call(partial(rocket.transform, windows), of.windows, of.threads),
    }


def _looped(bin_: Any, names: Any, channels: Any) -> Any:
    with others.quiet():
        return loop.features(bin_, names, channels)[None]


def _row(kind: str, name: str, call: Call, turns: Turns) -> dict[str, Any]:
    features = np.atleast_2d(np.asarray(turns.result)).shape[1]
    return {
        "kind": kind,
        "way": name,
        "bins": call.num_bins,
        "threads": call.threads,
        "features": features,
        "seconds": turns.seconds,
        "core_s": turns.core_s,
        "errors": _errors(call, turns.result),
    }


def _errors(call: Call, result: Any) -> Mapping[str, Any] | None:
    if call.truth is None:
        return None
    found = torch.as_tensor(result)[: len(call.truth)]
    return feature_errors(found, call.truth, pool_of(FLOAT64).names)
