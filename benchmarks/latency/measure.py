"""The measurement of ``benchmarks.latency``: seconds of single calls, and errors of scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
import torch

from benchmarks.clocks import on_threads, say, shuffled_singles
from benchmarks.detectors import Timed
from benchmarks.engines import FLOAT64
from benchmarks.errors import score_error
from benchmarks.latency.sizes import Sizes
from benchmarks.latency.ways import REFERENCE, Call, ours, parts, peers


def latencies(timed: Timed, sizes: Sizes) -> dict[str, Any]:
    """One bin at a time on one thread, from raw samples to a score, by everything there is."""
    with torch.inference_mode(), on_threads(1):
        calls = ours(timed, sizes) | peers(timed, sizes) | parts(timed, sizes)
    with torch.inference_mode(), on_threads(1):  # of the libraries loaded by now as well
        say(f"latency: {sizes.rounds} rounds of {len(calls)} calls")
        runs = {name: call.run for name, call in calls.items()}
        seconds = shuffled_singles(
            runs, sizes.rounds, sizes.seed, sizes.block_ms / 1e3, sizes.most_calls
        )
        truth = calls[f"{REFERENCE}, {FLOAT64}"]
        reference = scores_of(truth, sizes.judged)
        rows = [
            {
                "way": name,
                "is_whole": call.is_whole,
                "features": call.features,
                "error": _error(call, reference),
                **summary(seconds[name]),
            }
            for name, call in calls.items()
        ]
    return {"rows": rows}


def summary(rounds: Sequence[Sequence[float]]) -> dict[str, Any]:
    """What is kept of the seconds of every call, by round."""
    every = np.concatenate([np.asarray(taken) for taken in rounds])
    places = {"p25_s": 25, "p50_s": 50, "p75_s": 75, "p99_s": 99, "most_s": 100}
    found: dict[str, Any] = {
        name: float(np.percentile(every, place)) for name, place in places.items()
    }
    return found | {"calls": len(every), "round_medians_s": [median(taken) for taken in rounds]}


def scores_of(call: Call, num: int) -> torch.Tensor:
    """Scores of the first bins, in float64."""
    scores = [float(np.ravel(call.run(number))[0]) for number in range(num)]
    return torch.tensor(scores, dtype=torch.float64)


def _error(call: Call, reference: torch.Tensor) -> float | None:
    """In standard deviations of the reference, which is that of all judged bins."""
    if not (call.is_whole and call.judged):
        return None
    found = reference.clone()
    found[: call.judged] = scores_of(call, call.judged)
    return score_error(found, reference)


def row_of(rows: Sequence[Mapping[str, Any]], way: str) -> Mapping[str, Any] | None:
    """The row of a way, if there is one."""
    return next((row for row in rows if row["way"] == way), None)
