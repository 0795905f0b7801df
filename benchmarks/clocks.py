"""Seconds of calls that are compared, made in turns: drift of the machine hits all alike."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from statistics import median, quantiles
from typing import Any, NamedTuple

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


class Turns(NamedTuple):
    """What is known of a call that was made in every round.

    Attributes:
        seconds: of every round.
        core_s: processor seconds of all threads, of every round.
        result: of the last.
    """

    seconds: list[float]
    core_s: list[float]
    result: Any


def shuffled_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, seed: int, what: str
) -> dict[str, Turns]:
    """Long calls, each once a round in an order of its own, after one that is not timed."""
    shuffle = random.Random(seed)
    turns = {name: Turns([], [], call()) for name, call in calls.items()}
    for place in range(rounds):
        say(f"{what}, round {place + 1} of {rounds}")
        for name in shuffle.sample(list(calls), len(calls)):
            turns[name] = turns[name]._replace(result=None)
            busy = time.process_time()
            taken, result = timed(calls[name])
            turns[name].seconds.append(taken)
            turns[name].core_s.append(time.process_time() - busy)
            turns[name] = turns[name]._replace(result=result)
    return turns


def shuffled_singles(
    calls: Mapping[str, Callable[[int], object]],
    rounds: int,
    seed: int,
    block_s: float,
    most_calls: int,
) -> dict[str, list[list[float]]]:
    """Seconds of every single call, by round.

    Every round makes some calls of each, about ``block_s`` worth, in an order of its own and after
    one that is not timed.

    Args:
        calls: each takes a number that counts its calls.
        rounds: how many.
        seed: of the order.
        block_s: for so long a call is repeated within a round.
        most_calls: in a round.
    """
    shuffle = random.Random(seed)
    repeats: dict[str, int] = {}
    for name, call in calls.items():
        call(0)
        least = min(timed(partial(call, 0))[0] for _ in range(2))
        repeats[name] = max(1, min(most_calls, round(block_s / least)))
    seconds: dict[str, list[list[float]]] = {name: [] for name in calls}
    count = dict.fromkeys(calls, 0)
    for _ in range(rounds):
        for name in shuffle.sample(list(calls), len(calls)):
            calls[name](count[name])
            taken = []
            for _ in range(repeats[name]):
                count[name] += 1
                started = time.perf_counter()
                calls[name](count[name])
                taken.append(time.perf_counter() - started)
            seconds[name].append(taken)
    return seconds


class Way(NamedTuple):
    """A short call, and what it runs under: entered and left while the clock stands."""

    call: Callable[[], object]
    under: Callable[[], AbstractContextManager[Any]] = nullcontext


def in_shuffled_turns(
    calls: Mapping[str, Callable[[], object]], rounds: int, seed: int
) -> dict[str, float]:
    """Median seconds of each of several short calls, timed as ``shuffled_rounds`` does."""
    ways = {name: Way(call) for name, call in calls.items()}
    return {name: median(taken) for name, taken in shuffled_rounds(ways, rounds, seed).items()}


def shuffled_rounds(ways: Mapping[str, Way], rounds: int, seed: int) -> dict[str, list[float]]:
    """Seconds of each of several short calls in every round.

    Every round times a block of each, in an order of its own and after one call that is not
    timed: a neighbour that sweeps the caches must not cost always the same one.
    """
    shuffle = random.Random(seed)
    repeats: dict[str, int] = {}
    for name, way in ways.items():
        with way.under():
            repeats[name] = _calls_in_block(way.call)
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name in shuffle.sample(list(ways), len(ways)):
            call = ways[name].call
            with ways[name].under():
                call()
                started = time.perf_counter()
                for _ in range(repeats[name]):
                    call()
                taken = time.perf_counter() - started
            seconds[name].append(taken / repeats[name])
    return seconds


class Ratio(NamedTuple):
    """How much one call takes over another: the middle of the rounds, and half of them between.

    Attributes:
        median: of the ratios within each round; drift between rounds cancels.
        low: their first quartile.
        high: their third.
    """

    median: float
    low: float
    high: float


def paired_ratio(seconds: Sequence[float], others: Sequence[float]) -> Ratio:
    """What ``seconds`` are of ``others``, round by round.

    Example:
        >>> paired_ratio([1.0, 6.0, 3.0], [1.0, 3.0, 2.0])
        Ratio(median=1.5, low=1.25, high=1.75)
    """
    ratios = [a / b for a, b in zip(seconds, others, strict=True)]
    if len(ratios) < 2:
        return Ratio(*ratios * 3)
    low, middle, high = quantiles(ratios, n=4, method="inclusive")
    return Ratio(middle, low, high)


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
