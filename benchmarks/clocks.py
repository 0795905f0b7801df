"""Seconds of calls that are compared, made in turns: drift of the machine hits all alike."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median
from typing import Any

import torch
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

_BLOCK_S = 2e-3  # short calls are timed in blocks of about so long
_MOST_CALLS = 1000


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and what it returned."""
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def in_turns(
    calls: Mapping[str, Callable[[], object]], repeats: int, what: str
) -> dict[str, tuple[list[float], Any]]:
    """Seconds of every repeat of several long calls, made in turns, and the last result of each."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    results: dict[str, Any] = {}
    for repeat in range(repeats):
        for name, call in calls.items():
            results.pop(name, None)
            taken, results[name] = timed(call)
            seconds[name].append(taken)
            say(f"{what}, {repeat + 1} of {repeats}: {name} {taken:.2f} s")
    return {name: (seconds[name], results[name]) for name in calls}


def in_shuffled_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, seed: int
) -> dict[str, float]:
    """Median seconds of each of several short calls.

    Every round times a block of each, in an order of its own and after one call that is not
    timed: a neighbour that sweeps the caches must not cost always the same one.
    """
    shuffle = random.Random(seed)
    repeats = {name: _calls_in_block(call) for name, call in calls.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name in shuffle.sample(list(calls), len(calls)):
            call = calls[name]
            call()
            started = time.perf_counter()
            for _ in range(repeats[name]):
                call()
            seconds[name].append((time.perf_counter() - started) / repeats[name])
    return {name: median(values) for name, values in seconds.items()}


def _calls_in_block(call: Callable[[], object]) -> int:
    call()
    least = min(timed(call)[0] for _ in range(3))
    return max(1, min(_MOST_CALLS, round(_BLOCK_S / max(least, _BLOCK_S / _MOST_CALLS))))


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


def say(text: str) -> None:
    """A progress line on standard error."""
    print(text, file=sys.stderr, flush=True)
