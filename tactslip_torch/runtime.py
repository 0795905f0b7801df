"""What all parts use: threads, processes, progress bars, files that are written whole, tensors.

Of tensors: whether their values may be looked at, and operations that are quicker where they may.
"""

from __future__ import annotations

import ctypes
import errno
import glob
import hashlib
import io
import json
import logging
import math
import multiprocessing
import os
import secrets
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import torch.distributed
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad
from tqdm.auto import tqdm

__version__ = "0.3.1.dev0"
PACKAGE = Path(__file__).resolve().parent

log = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")
Value = TypeVar("Value")

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
    thread_map(function, list(items))


def thread_map(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """What ``function`` returns for every item, in their order, called as by ``for_each``.

    Example:
        >>> thread_map(torch.sum, torch.arange(6).split(4))
        [tensor(6), tensor(9)]
    """
    number = torch.get_num_threads()
    if number == 1:
        return [function(item) for item in items]
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def call(item: Item) -> Result:
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return function(item)

    pool = _pool(number)
    futures = [pool.submit(call, item) for item in items]
    try:
        wait(futures, return_when=FIRST_EXCEPTION)
    finally:  # if interrupted, what still runs writes to the caller's memory
        begun = [future for future in futures if not future.cancel()]
        wait(begun)
    return [future.result() for future in begun]


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


def trim_memory() -> None:
    """Hand freed memory back to the system, which glibc keeps for each thread apart."""
    with suppress(OSError, AttributeError, TypeError):  # other C libraries have no such call
        ctypes.CDLL(None).malloc_trim(0)


def is_traced() -> bool:
    """Whether what runs is being written down as a graph, in which no value may be looked at."""
    is_jit = torch.jit.is_tracing()  # type: ignore[attr-defined,no-untyped-call]
    return bool(is_jit or torch.compiler.is_compiling())


def has_values(x: Tensor) -> bool:
    """Whether a decision may be taken on the values, wherever they lie and whatever comes along.

    Not so where a graph is recorded or ``x`` is transformed (vmap, func.grad, jvp).
    """
    if is_traced():
        return False
    try:
        x.detach().flatten()[:0].cpu().numpy()  # of what is transformed not even nothing
    except (RuntimeError, TypeError):  # transformed, or NumPy has no such dtype
        return False
    return True


def is_concrete(x: Tensor) -> bool:
    """Whether only values are asked for, and lie in memory that can be looked at.

    Not so where a gradient or a tangent is carried along, a graph is recorded, ``x`` is transformed
    (vmap), or lies on another device than the CPU.
    """
    if not x.is_cpu or is_traced() or (x.requires_grad and torch.is_grad_enabled()):
        return False
    try:
        x.detach().numpy()  # under vmap and other transforms there is no memory to look at
        return forward_ad.unpack_dual(x).tangent is None
    except (RuntimeError, TypeError):  # transformed, or NumPy has no such dtype
        return False


def stamps_of(tensors: Iterable[Tensor]) -> list[tuple[Tensor, int | Tensor]]:
    """What ``are_unchanged`` compares: tensors, and how often each was changed in place.

    Inference tensors do not count that: of those a copy.
    """
    return [(x, x.clone() if x.is_inference() else x._version) for x in tensors]


def are_unchanged(tensors: Sequence[Tensor], stamps: Sequence[tuple[Tensor, int | Tensor]]) -> bool:
    """Whether tensors are those of the stamps, none of them replaced or changed since."""
    return len(tensors) == len(stamps) and all(
        x is same and (torch.equal(x, was) if isinstance(was, Tensor) else x._version == was)
        for x, (same, was) in zip(tensors, stamps, strict=True)
    )


def runs_of(is_true: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First and stop of each run of true values, ``[T] -> [n, 2]``.

    Example:
        >>> runs_of(np.array([True, False, True, True]))
        array([[0, 1],
               [2, 4]])
    """
    return np.flatnonzero(np.diff(is_true, prepend=False, append=False)).reshape(-1, 2)


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Within it ``torch.autocast`` narrows nothing that is computed on the device of ``x``."""
    kind = x.device.type
    is_on = torch.is_autocast_enabled(kind)
    return torch.autocast(kind, enabled=False) if is_on else nullcontext()


def ascending(x: Tensor, count: int) -> Tensor:
    """The smallest values along the last axis, at least ``count`` of them, in ascending order.

    By NumPy where only values are asked for: it sorts short rows several times as fast.
    """
    if not isinstance(x, Tensor):
        return x.ascending(count)
    if is_concrete(x):
        return torch.from_numpy(np.sort(x.detach().numpy(), axis=-1))
    return x.sort(-1).values


def signed_log(features: Tensor, scale: Tensor) -> Tensor:
    """``sign(f) * scale * log1p(|f| / scale)``: nearly ``f`` below the scale, logarithmic above.

    Monotone, odd, with derivative ``scale / (scale + |f|)``, 1 at 0. Finite for every finite ``f``,
    also where ``|f| / scale`` passes the largest float; NaN stays NaN.

    Shape:
        - features, output: ``[*, K]``
        - scale: broadcasts with ``features``, positive
    """
    dtype_info = torch.finfo(features.dtype)
    if is_concrete(features) and is_concrete(scale):  # the same in fewer passes
        ratio = features.abs() / scale
        if ratio.numel() and bool(ratio.amax().isfinite()):
            bent, is_tiny = ratio.log1p().mul_(scale), ratio < dtype_info.tiny
            if bool(is_tiny.any()):
                bent = torch.where(is_tiny, features.abs(), bent)
            return bent.copysign_(features)
    is_negative = features < 0
    size = torch.where(is_negative, -features, features)  # abs() has derivative 0 at 0
    ratio = size / scale
    bent = scale * ratio.log1p()
    if not has_values(features) or bool(ratio.isinf().any()):
        far = torch.maximum(size, scale).log() - scale.log()
        far = far.clamp(min=math.log(dtype_info.max))  # no step back where log1p ends
        bent = torch.where(ratio.isinf(), scale * far, bent)
    bent = torch.where(ratio < dtype_info.tiny, size, bent)  # a denormal ratio has lost its digits
    return torch.where(is_negative, -bent, bent)


@contextmanager
def one_thread() -> Iterator[None]:
    """One intra-op thread, as a live loop has."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_SECTION: ContextVar[str] = ContextVar("section", default="")


@contextmanager
def settings_in(section: str) -> Iterator[None]:
    """Until it is left, ``setting`` names settings as those of a section, such as ``"data"``."""
    token = _SECTION.set(f"{section}." if section else "")
    try:
        yield
    finally:
        _SECTION.reset(token)


def setting(name: str) -> str:
    """A setting as the user of the running command writes it, for messages.

    Example:
        >>> with settings_in("data"):
        ...     setting("reading.time")
        'data.reading.time'
    """
    return _SECTION.get() + name


def check_number(name: str, value: Any, *, least: float | None = None, whole: bool = False) -> None:
    """Refuse what is no number, is not positive or not at least ``least``, or is not whole.

    Raises:
        ValueError: that names it.

    Example:
        >>> check_number("tries", 0, whole=True)
        Traceback (most recent call last):
        ValueError: tries must be a positive whole number, got 0
    """
    is_number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    is_finite = is_number and abs(value) < (2**63 if whole else math.inf)
    if is_finite and (value > 0 if least is None else value >= least):
        return
    kind = "whole number" if whole else "finite number"
    wanted = f"a positive {kind}" if least is None else f"a {kind} of at least {least:g}"
    raise ValueError(f"{name} must be {wanted}, got {value!r}")


def check_share(name: str, value: Any) -> None:
    """Refuse what does not lie between 0 and 1, these left out.

    Raises:
        ValueError: that names it.
    """
    if not isinstance(value, int | float) or not 0 < value < 1:
        raise ValueError(f"{name} must lie between 0 and 1, got {value!r}")


def check_choice(name: str, value: Any, known: Iterable[Any]) -> None:
    """Refuse a value that is none of those known.

    Raises:
        ValueError: that names it and them.

    Example:
        >>> check_choice("frame.counter", "int8", ("uint8", None))
        Traceback (most recent call last):
        ValueError: frame.counter must be one of uint8, null, got 'int8'
    """
    choices = tuple(known)
    if value not in choices:
        wanted = ", ".join("null" if choice is None else str(choice) for choice in choices)
        raise ValueError(f"{name} must be one of {wanted}, got {value!r}")


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside ``path`` to write to; renamed to ``path`` when all went well.

    A failure leaves what was at ``path`` before, and no temporary file. What a killed process left
    is removed, where Linux reports that it is no more.

    Raises:
        OSError: that names the folder, if its disk is full.

    Example:
        >>> with whole_file(getfixture("tmp_path") / "a.txt") as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> (getfixture("tmp_path") / "a.txt").read_text()
        'all of it'
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if here := _machine():
        for left in path.parent.glob(f".{glob.escape(path.stem)}.{here}-*.tmp{path.suffix}"):
            _, pid, started, _ = left.name.removeprefix(f".{path.stem}.").split("-")
            if _started(pid) != started:
                left.unlink(missing_ok=True)
    unique = "-".join([here, str(os.getpid()), _started("self"), secrets.token_hex(4)])
    temporary = path.with_name(f".{path.stem}.{unique}.tmp{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except Exception as error:  # torch raises others than OSError
        if not isinstance(error, OSError) and shutil.disk_usage(path.parent).free >= _BLOCK:
            raise
        if isinstance(error, OSError) and error.errno != errno.ENOSPC:
            raise
        message = f"no space left on the disk of {path.parent}; {path.name} was not written"
        raise OSError(errno.ENOSPC, message) from error
    finally:
        temporary.unlink(missing_ok=True)


_BLOCK = 2**16


@lru_cache(maxsize=1)
def _machine() -> str:
    """Where process numbers mean the same: this boot, in this container; empty if not known."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_bytes()
        return hashlib.sha256(boot + bytes(Path("/proc/self/ns/pid").readlink())).hexdigest()[:8]
    except OSError:
        return ""


def _started(pid: str) -> str:
    """When a process began, in ticks since the boot; empty if there is none."""
    try:
        return Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return ""


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write JSON, whole or not at all; NaN and infinity, which JSON lacks, become null.

    Example:
        >>> path = getfixture("tmp_path") / "a.json"
        >>> write_json(path, {"score": float("nan"), "names": ("a", "b")})
        >>> json.loads(path.read_text())
        {'score': None, 'names': ['a', 'b']}
    """
    with whole_file(path) as temporary:
        text = json.dumps(plain(content), indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """The same in what JSON has: lists for tuples, ``None`` for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


LEAD = 31
_EVERY_S = 10.0


class _Progress(tqdm):  # type: ignore[misc]
    """A progress bar on a terminal or in a notebook; elsewhere a logged line every ten seconds.

    What takes less than ten seconds leaves no line in a log.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        self._is_drawn = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._told = time.monotonic()
        if not self._is_drawn:
            options["file"] = io.StringIO()
        super().__init__(*args, **options)

    def display(self, *args: Any, **options: Any) -> Any:
        """Draw the bar, or log it where the last line is ten seconds old."""
        if self._is_drawn:
            return super().display(*args, **options)
        if time.monotonic() - self._told >= _EVERY_S:
            self._told = time.monotonic()
            state = self.format_dict
            of = "" if state["total"] is None else f" of {state['total']}"
            what = (self.desc or "").removesuffix(": ").strip()
            left = ""
            if state["rate"] and state["total"] is not None:
                left = f", {(state['total'] - state['n']) / state['rate']:.0f} s left"
            log.info(
                "%s: %s%s%s in %.0f s%s", what, state["n"], of, self.unit, state["elapsed"], left
            )
        return True


def bar(
    items: Iterable[Any],
    what: str,
    unit: str = "step",
    total: int | None = None,
    *,
    show: bool = True,
) -> Iterable[Any]:
    """``items`` with a progress bar on standard error that shows rate and time left."""
    if not show:
        return items
    shown: Iterable[Any] = _Progress(
        items, desc=f"{what:{LEAD}}", total=total, unit=f" {unit}", dynamic_ncols=True
    )
    return shown


def steps(what: str, unit: str, total: int, *, show: bool = True) -> _Progress:
    """A bar of at most so many steps for a ``with``, moved by its ``update``, from any thread."""
    options = {"dynamic_ncols": True, "smoothing": 0, "disable": not show}
    return _Progress(desc=f"{what:{LEAD}}", total=total, unit=f" {unit}", **options)


_function: Callable[[Any], Any] | None = None
"""What the processes of ``in_processes`` call."""


def num_processes(num_workers: int | None) -> int:
    """``num_workers``, or for ``None`` as many as there are processors, at most 8.

    Raises:
        ValueError: if there is no such number of processes.
    """
    if num_workers is None:
        return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1, 8)
    if type(num_workers) is not int or num_workers < 0:
        raise ValueError(f"num_workers must be null or a number from 0, got {num_workers!r}")
    return num_workers


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
    count = min(num_processes(num_workers), len(items))
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        yield from map(function, bar(items, what, unit))
        return
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(count, context, _start, (function,)) as pool:
        try:
            results = pool.map(_call, items)
            yield from bar(results, what, unit, total=len(items))
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


def is_first_process() -> bool:
    """Whether this is the only process of a run, or the one that writes for all."""
    return _process_number() == 0


def _process_number() -> int:
    """The rank of this process in its run, by what torchrun, Lightning or SLURM has set."""
    for name in ("RANK", "SLURM_PROCID", "LOCAL_RANK"):
        if name in os.environ:
            return int(os.environ[name])
    return 0


def _num_ranks() -> int:
    ready = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if ready else 1


def gathered(own: Value) -> list[Value]:
    """The value of every process, in the order of their ranks."""
    values: list[Any] = [own] * _num_ranks()
    if len(values) > 1:
        torch.distributed.all_gather_object(values, own)
    return values


def from_first_process(make: Callable[[], Value]) -> Value:
    """What the first process makes, in every process; its error as well, so that none waits."""
    if _num_ranks() == 1:
        return make()
    box: list[Any] = [None, None]
    if torch.distributed.get_rank() == 0:
        try:
            box[0] = make()
        except Exception as error:
            box[1] = error
    torch.distributed.broadcast_object_list(box)
    if box[1] is not None:
        raise box[1]
    made: Value = box[0]
    return made


def add_over_processes(*totals: Tensor) -> None:
    """Add up tensors of every process, in place; in one process they are the sums already."""
    for total in totals if _num_ranks() > 1 else ():
        torch.distributed.all_reduce(total)
