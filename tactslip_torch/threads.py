"""Work spread over threads so that the bits of a result do not depend on how many there are.

A BLAS that splits one product over its threads rounds it differently for each number of them.
Here the caller cuts the work into pieces of fixed shape, and every piece is computed by one Python
thread with one intra-op thread: PyTorch releases the interpreter lock while it computes.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_POOLS: dict[tuple[int, int], ThreadPoolExecutor] = {}  # by process and number of threads
_MAKING = threading.Lock()


def for_each(function: Callable[[Item], object], items: Iterable[Item]) -> None:
    """Call ``function`` on every item, on ``torch.get_num_threads()`` threads at once.

    Inside ``function`` there is one intra-op thread, always: what it computes from its item alone
    has the same bits for any number of threads. Items are begun in order and must not write to
    the same memory. With one thread (so also inside ``function``) the calls are made here, one
    after the other. Grad mode and inference mode are the caller's.

    Args:
        function: of one item; what it returns is dropped.
        items: the pieces of work.

    Raises:
        Exception: what ``function`` raised, once nothing runs any more; items not begun by then
            are left out.

    Example:
        >>> squares = torch.zeros(5)
        >>> for_each(lambda i: squares[i].fill_(i * i), range(5))
        >>> squares
        tensor([ 0.,  1.,  4.,  9., 16.])
    """
    number = torch.get_num_threads()
    if number == 1:
        for item in items:
            function(item)
        return
    queue = deque(items)
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def work() -> None:
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            try:
                while queue:
                    try:
                        item = queue.popleft()  # atomic
                    except IndexError:  # another thread took the last one
                        return
                    function(item)
            finally:
                queue.clear()

    pool = _pool(number)
    futures = [pool.submit(work) for _ in range(min(number, len(queue)))]
    try:
        wait(futures)
    finally:  # if interrupted, what still runs writes to the caller's memory
        queue.clear()
        wait(futures)
    for future in futures:
        future.result()


def in_parts(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """What ``function`` returns for every item, in their order, made by ``for_each``.

    Example:
        >>> in_parts(torch.sum, torch.arange(6).split(4))
        [tensor(6), tensor(9)]
    """
    results: dict[int, Result] = {}

    def call(index: int) -> None:
        results[index] = function(items[index])

    for_each(call, range(len(items)))
    return [results[index] for index in range(len(items))]


def _pool(number: int) -> ThreadPoolExecutor:
    """The pool of this process with ``number`` threads, all of them started and single-threaded.

    ``torch.set_num_threads`` counts for the thread that calls it and for every thread that has not
    asked or computed yet: so each asks before it sets, and the caller's number is set again once
    all have set theirs.
    """
    key = (os.getpid(), number)
    with _MAKING:
        if key not in _POOLS:
            pool = ThreadPoolExecutor(number, thread_name_prefix=f"tactslip-{number}")
            ready = threading.Barrier(number)

            def start() -> None:
                torch.get_num_threads()
                torch.set_num_threads(1)
                ready.wait()  # so that no thread takes the start of another

            try:
                wait([pool.submit(start) for _ in range(number)])
            finally:
                torch.set_num_threads(number)
            _POOLS[key] = pool
        return _POOLS[key]


def _renew_lock() -> None:
    global _MAKING
    _MAKING = threading.Lock()  # a thread of the parent may have held it


os.register_at_fork(after_in_child=_renew_lock)
