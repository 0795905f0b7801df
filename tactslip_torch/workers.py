"""One function over many items, in as many processes as there are processors; results in order."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

import torch

from tactslip_torch.progress import bar

Item = TypeVar("Item")
Result = TypeVar("Result")

_function: Callable[[Any], Any] | None = None
"""What the processes of ``in_processes`` call."""


def in_processes(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    what: str,
    unit: str,
    num_workers: int | None = None,
) -> Iterator[Result]:
    """What ``function`` returns for every item, in their order, with a progress bar.

    Processes are forked, so the function may hold anything; each computes on one thread. Where
    nothing can be forked, or one process is enough, the work is done here.

    Args:
        function: of one item; its results are pickled (tensors would each keep a file open: hand
            on arrays).
        items: small things that say what to do.
        what: is done, for the bar.
        unit: of an item, for the bar.
        num_workers: ``None`` for as many as there are processors, at most 8.

    Raises:
        ValueError: if there is no such number of processes.
        Exception: what ``function`` raised; what was not begun is left out.
    """
    if num_workers is not None and (type(num_workers) is not int or num_workers < 0):
        raise ValueError(f"num_workers must be null or a number from 0, got {num_workers!r}")
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    count = min(min(available, 8) if num_workers is None else num_workers, len(items))
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        yield from map(function, bar(items, what, unit))
        return
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(count, context, _start, (function,)) as pool:
        try:
            found = pool.map(_call, items)
            yield from bar(found, what, unit, total=len(items))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _start(function: Callable[[Any], Any]) -> None:
    global _function
    _function = function
    torch.set_num_threads(1)


def _call(item: Any) -> Any:
    assert _function is not None  # _start
    return _function(item)
