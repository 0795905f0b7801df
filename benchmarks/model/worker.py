"""A process of its own that accumulates synthetic bins, for memory and for many workers.

Reads one job a line from standard input and writes one answer a line to standard output, both
JSON. ``Worker`` is the other end. It imports what accumulating needs and nothing else, so that
its memory is that of the task.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, cast

import torch

from benchmarks.model.synthetic import SyntheticBins, num_batches
from tactslip_torch.model.moments import SufficientStats

_REPORTS = 20  # progress lines of a job that takes long
_LONG_S = 30.0


class WorkerFailedError(RuntimeError):
    """A worker ended before it answered."""


class Worker:
    """A started worker, to be used as a context; ended with it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.model.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[2],
        )
        self._jobs = cast(IO[str], self._process.stdin)
        self._answers = cast(IO[str], self._process.stdout)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        if any(error):
            self._process.kill()
        with suppress(BrokenPipeError):
            self._jobs.close()  # it ends when no more jobs can come
        self._answers.close()
        self._process.wait()

    def start(self, do: str, **arguments: Any) -> None:
        """Hand it a job, one of ``JOBS``; it works while the caller goes on.

        Raises:
            WorkerFailedError: if it has ended.
        """
        try:
            self._jobs.write(json.dumps({"do": do, **arguments}) + "\n")
            self._jobs.flush()
        except BrokenPipeError:
            raise WorkerFailedError(f"a worker ended before its job {do!r}; see above") from None

    def answer(self) -> dict[str, Any]:
        """Wait for the answer to the oldest job.

        Raises:
            WorkerFailedError: if there will be none.
        """
        line = self._answers.readline()
        if not line:
            raise WorkerFailedError("a worker ended without an answer; see above")
        answer: dict[str, Any] = json.loads(line)
        return answer


# ---------------------------------------------------------------------------------------- jobs
def ready(threads: int) -> dict[str, Any]:
    """Answers once everything is imported."""
    torch.set_num_threads(threads)
    return {"resident_bytes": peak_bytes()}


def shard(
    bins: Mapping[str, int], num_bins: int, batch_bins: int, part: int, parts: int, path: str
) -> dict[str, Any]:
    """Accumulate a shard into a file.

    Args:
        bins: arguments of ``SyntheticBins``.
        num_bins: of the whole set.
        batch_bins: of a batch.
        part: of the shard, from 0.
        parts: number of shards.
        path: of the file.
    """
    started = time.perf_counter()
    source = SyntheticBins(**bins)
    stats = SufficientStats(source.num_features)
    for batch in source.batches(num_bins, batch_bins, part, parts):
        stats.update(*batch)
    stats.save(path)
    return {"seconds": time.perf_counter() - started}


def any_size(
    bins: Mapping[str, int],
    num_bins: int,
    batch_bins: int,
    penalty: float,
    offset: float,
    test_bins: int,
) -> dict[str, Any]:
    """Accumulate bins that are never held together, and solve.

    Args:
        bins: arguments of ``SyntheticBins``.
        num_bins: of the set.
        batch_bins: of a batch.
        penalty: the paper's ``C``.
        offset: the paper's ``c``.
        test_bins: held-out bins to score at the end.
    """
    source = SyntheticBins(**bins)
    stats = SufficientStats(source.num_features)
    num = num_batches(num_bins, batch_bins)
    started = time.perf_counter()
    accumulate_s, next_report = 0.0, 0
    for done, batch in enumerate(source.batches(num_bins, batch_bins), start=1):
        before = time.perf_counter()
        stats.update(*batch)
        now = time.perf_counter()
        accumulate_s += now - before
        if done * _REPORTS >= num * next_report:
            next_report = done * _REPORTS // num + 1
            if (now - started) * num / done > _LONG_S:
                print(f"any size: {done} of {num} batches, {now - started:.0f} s", file=sys.stderr)
    generate_s = time.perf_counter() - started - accumulate_s
    before = time.perf_counter()
    head = stats.solve(penalty, offset, balance="none")
    solve_s = time.perf_counter() - before
    z, is_slip = source.held_out(test_bins)
    accuracy = float(((head(z) >= 0) == is_slip).double().mean())
    return {
        "num_bins": num_bins,
        "generate_s": generate_s,
        "accumulate_s": accumulate_s,
        "solve_s": solve_s,
        "peak_bytes": peak_bytes(),
        "accuracy": accuracy,
    }


JOBS: dict[str, Callable[..., dict[str, Any]]] = {
    "ready": ready,
    "shard": shard,
    "any_size": any_size,
}


def peak_bytes() -> int:
    """Most memory that this process has had resident."""
    try:
        content = Path("/proc/self/status").read_text(encoding="utf-8")
        line = next(line for line in content.splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024
    except (OSError, StopIteration):
        import resource  # not on Windows; on Linux it would count the parent before exec

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


def main() -> None:
    """Entry point of the worker."""
    for line in sys.stdin:
        job = json.loads(line)
        print(json.dumps(JOBS[job.pop("do")](**job)), flush=True)


if __name__ == "__main__":
    main()
