"""A process of its own, so that its peak of memory is that of one task.

``peak(job)`` starts it, hands it a job as JSON, and returns its answer.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.bins import RANDOM, bins_of
from benchmarks.engines import FLOAT32, FLOAT64, pool_of
from benchmarks.model.worker import WorkerFailedError, peak_bytes
from tactslip_torch.features.extractor import FeatureExtractor

IN_ONE_PIECE = "in one piece"
_PREPARED = 4096  # different bins; more are these in another order


def peak(**job: Any) -> dict[str, Any]:
    """Do a job in a fresh process.

    Args:
        job: ``do``, one of ``JOBS``, and its arguments.

    Returns:
        Its answer, with ``before_bytes``, resident once all is imported and prepared, and
        ``peak_bytes``.

    Raises:
        WorkerFailedError: if it ends without an answer.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.throughput.worker"],
        input=json.dumps(job),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    if done.returncode:
        what = {name: of for name, of in job.items() if name != "names"}  # there are many
        raise WorkerFailedError(f"a worker ended without an answer to {what}; see above")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def hold(engine: str, batch: int, names: Sequence[str] | None) -> dict[str, Any]:
    """Features of one batch that is held in memory with them; the whole pool without names."""
    make = pool_of(FLOAT64) if engine == IN_ONE_PIECE else _extractor(engine, names)
    make(bins_of(RANDOM, 8).float())
    before = peak_bytes()
    bins = torch.randn(batch, 24, 100, generator=torch.Generator().manual_seed(0))
    features = make(bins)
    return {"before_bytes": before, "own_bytes": bins.nbytes + features.nbytes}


def stream(engine: str, num_bins: int, chunk: int, names: Sequence[str] | None) -> dict[str, Any]:
    """Features of many bins, chunk by chunk, to a consumer that keeps their sums.

    The whole pool without names.
    """
    extractor = _extractor(engine, names)
    prepared = bins_of(RANDOM, min(chunk, _PREPARED)).float()
    extractor(prepared[:8])
    before = peak_bytes()

    def chunks() -> Iterator[Tensor]:
        for start in range(0, num_bins, chunk):
            num = min(chunk, num_bins - start)
            place = (torch.arange(num) + start // chunk) % len(prepared)
            yield prepared[place]  # a copy, as a source would make

    started, count = time.perf_counter(), 0
    total = torch.zeros(len(extractor.selected), dtype=torch.float64)
    for features in extractor.stream(chunks()):
        total += features.sum(0, dtype=torch.float64)
        count += len(features)
    seconds = time.perf_counter() - started
    finite = bool(total.isfinite().all())
    return {"before_bytes": before, "seconds": seconds, "bins": count, "is_finite": finite}


JOBS: dict[str, Callable[..., dict[str, Any]]] = {"hold": hold, "stream": stream}


def _extractor(engine: Any, names: Sequence[str] | None) -> FeatureExtractor:
    pool = pool_of(FLOAT32)
    if names is None:
        return FeatureExtractor(pool, engine=engine)
    place = {str(name): index for index, name in enumerate(pool.names)}
    return FeatureExtractor(pool, [place[name] for name in names], engine)


def main() -> None:
    """Entry point of the worker."""
    job = json.load(sys.stdin)
    torch.set_num_threads(job.pop("threads"))
    with torch.inference_mode():
        answer = JOBS[job.pop("do")](**job)
    print(json.dumps(answer | {"peak_bytes": peak_bytes()}))


if __name__ == "__main__":
    main()
