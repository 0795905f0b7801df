"""Timing of calls in turns, in processes of their own, on so many threads; and peak memory."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

from benchmarks import ROOT
from benchmarks.tables import Spread


def interleaved(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    seed: int = 0,
    *,
    block_s: float = 2e-3,
    most_calls: int = 1000,
) -> dict[str, dict[str, Any]]:
    """Time several calls in turns, so that drift of the machine and of its caches hits all alike.

    Every round makes a block of each call in a new random order, after one that is not timed.

    Returns:
        By name: ``seconds``, the mean of a call in each round; ``p50_s`` and ``p99_s`` of single
        calls, and how many ``calls`` there were; JSON-able.

    Args:
        calls: by name.
        rounds: of every call.
        seed: of the orders.
        block_s: a short call is repeated for about so long in a round.
        most_calls: in a round.
    """
    shuffle = random.Random(seed)
    repeats = {}
    for name, call in calls.items():
        least = min(timed(call)[0] for _ in range(3 if block_s else 1))
        repeats[name] = max(1, min(most_calls, round(block_s / max(least, 1e-9))))
    found: dict[str, list[list[float]]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name in shuffle.sample(list(calls), len(calls)):
            if repeats[name] > 1:
                calls[name]()
            found[name].append([timed(calls[name])[0] for _ in range(repeats[name])])
    timings = {}
    for name, of in found.items():
        p50, p99 = np.percentile(np.concatenate(of), [50, 99]).tolist()
        seconds = list(map(mean, of))
        calls_made = sum(map(len, of))
        timings[name] = {"seconds": seconds, "p50_s": p50, "p99_s": p99, "calls": calls_made}
    return timings


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it returned."""
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def paired_ratio(seconds: Sequence[float], others: Sequence[float]) -> Spread:
    """What ``seconds`` are of ``others``, round by round: drift between rounds cancels.

    Example:
        >>> paired_ratio([1.0, 6.0, 3.0], [1.0, 3.0, 2.0])
        Spread(median=1.5, low=1.25, high=1.75)
    """
    return Spread.of([a / b for a, b in zip(seconds, others, strict=True)])


@contextmanager
def on_threads(number: int) -> Iterator[None]:
    """So many threads for PyTorch and every BLAS."""
    before = torch.get_num_threads()
    with threadpool_limits(number):
        torch.set_num_threads(number)
        try:
            yield
        finally:
            torch.set_num_threads(before)


def in_fresh_process(function: str, **arguments: Any) -> Any:
    """The result of ``module:function`` in a process of its own; arguments and result as JSON.

    Raises:
        RuntimeError: if the process ends without a result.
    """
    module, _, name = function.partition(":")
    code = f"import json, sys\nfrom {module} import {name} as call\n"
    code += "print(json.dumps(call(**json.load(sys.stdin))))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(arguments),
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        cwd=ROOT,
    )
    if done.returncode:
        raise RuntimeError(f"{function} failed in a process of its own; see above")
    return json.loads(done.stdout.splitlines()[-1])


def growth_mb(memory: Mapping[str, Any], settled_s: float) -> float:
    """How much ``resident_bytes``, looked at ``at_s``, grow after they have settled, in MB."""
    looks = zip(memory["at_s"], memory["resident_bytes"], strict=True)
    settled: list[float] = [resident for at_s, resident in looks if at_s >= settled_s]
    return (max(settled) - settled[0]) / 1e6


def peak_bytes() -> int:
    """Most memory that this process has had resident."""
    path = Path("/proc/self/status")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for line in lines:
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    import resource  # not on Windows; on Linux it would count the parent before exec

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
