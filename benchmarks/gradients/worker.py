"""A process of its own for one loss and the way back from it: seconds, and memory it took."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.gradients.sizes import Kind
from benchmarks.gradients.ways import BASE, Subject, way_of
from benchmarks.model.worker import WorkerFailedError, peak_bytes

_WARM_BINS = 300


def measured(**job: Any) -> dict[str, Any]:
    """Measure in a fresh process.

    Args:
        job: arguments of ``measure``.

    Raises:
        WorkerFailedError: if it ends without an answer.
    """
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.gradients.worker"],
        input=json.dumps(job),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    if done.returncode:
        what = f"{job['kind']} of {job['num_bins']} bins, {job['way']}"
        raise WorkerFailedError(f"the worker of {what} ended without an answer; see above")
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def measure(
    kind: Kind,
    way: str,
    num_bins: int,
    num_features: int,
    threads: int,
    groups: int,
    scored: int,
    penalty: float,
    offset: float,
) -> dict[str, Any]:
    """One loss and its gradient, after a small one that loads and starts what there is.

    Args:
        kind: of the problem.
        way: one of those in ``ways``.
        num_bins: of the problem.
        num_features: likewise.
        threads: to compute on.
        groups: as ``Sizes`` has them.
        scored: likewise.
        penalty: likewise.
        offset: likewise.

    Returns:
        ``forward_s`` and ``backward_s``; ``forward_bytes`` and ``whole_bytes``, the most beyond
        what was held before; ``loss``, and what its gradient comes to along a few directions. No
        ``backward_s`` and no gradient of the way that has none.
    """
    torch.set_num_threads(threads)
    others = groups, scored, penalty, offset
    call = way_of(kind, way)
    small = Subject.made(min(_WARM_BINS, num_bins), num_features, *others)
    loss = call(small)
    if way != BASE:
        torch.autograd.grad(loss, small.learned)
    subject = Subject.made(num_bins, num_features, *others)
    before = peak_bytes()
    started = time.perf_counter()
    loss = call(subject)
    answer: dict[str, Any] = {
        "forward_s": time.perf_counter() - started,
        "forward_bytes": peak_bytes() - before,
        "loss": loss.item(),
    }
    if way != BASE:
        started = time.perf_counter()
        slopes = torch.autograd.grad(loss, subject.learned)
        answer["backward_s"] = time.perf_counter() - started
        answer["gradient"] = along(slopes)
    return answer | {"whole_bytes": peak_bytes() - before}


def along(slopes: Sequence[Tensor]) -> list[float]:
    """What a gradient comes to along one drawn direction in each of its tensors."""
    generator = torch.Generator().manual_seed(0)
    draws = [torch.randn(slope.shape, generator=generator, dtype=slope.dtype) for slope in slopes]
    return [float((slope * draw).sum()) for slope, draw in zip(slopes, draws, strict=True)]


def main() -> None:
    """Entry point of the worker."""
    print(json.dumps(measure(**json.load(sys.stdin))))


if __name__ == "__main__":
    main()
