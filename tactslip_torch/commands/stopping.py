"""How a command ends early: by a signal or by bad input, in one line, with its exit status.

Nothing here imports torch, so that a mistake in a command line is told at once.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from inspect import signature
from types import FrameType
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import get_object
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_EXIT_BAD_INPUT = 2
BAD_INPUT = (
    ValueError,
    LookupError,
    OverflowError,
    EOFError,
    TypeError,
    OSError,
    InstantiationException,
    OmegaConfBaseException,
)
"""What bad input raises, here or in the libraries that read it."""


class Stopped(BaseException):
    """A signal asked for the end; raised where the program was, so that all is tidied up.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number, self.text = number, ""

    def saying(self, text: str) -> Stopped:
        """The same, with what is saved and how to go on."""
        self.text = text
        return self


@contextmanager
def stopping() -> Iterator[None]:
    """Within it SIGINT and SIGTERM raise ``Stopped``, and that ends the program in one line.

    Processes that are forked leave SIGINT, which the terminal sends to all, to the first.

    Raises:
        SystemExit: with status 128 and the number of the signal, as shells have it.
    """
    first = os.getpid()

    def stop(number: int, _: FrameType | None) -> None:
        if os.getpid() == first:
            for each in _SIGNALS:  # what tidies up is not to be stopped
                signal.signal(each, signal.SIG_IGN)
            # torch's would raise, as its workers end by the same signal
            before[signal.SIGCHLD] = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            raise Stopped(number)
        if number != signal.SIGINT:
            os._exit(128 + number)

    before: dict[int, Any] = {}
    try:
        for each in _SIGNALS:
            before[each] = signal.signal(each, stop)
    except ValueError:  # not the main thread: whoever started it has the signals
        yield
        return
    try:
        yield
    except Stopped as end:
        name = signal.Signals(end.number).name
        told = f"; {end.text}" if end.text else " before anything was written; start it again"
        if _rank() == 0:
            print(f"\nstopped by {name}{told}", file=sys.stderr, flush=True)
        raise SystemExit(128 + end.number) from None
    finally:
        if os.getpid() == first:
            for own, handler in before.items():
                signal.signal(own, handler)


def _rank() -> int:
    """``runtime._process_number``, without torch."""
    names = ("RANK", "SLURM_PROCID", "LOCAL_RANK")
    return int(next((os.environ[name] for name in names if name in os.environ), 0))


@contextmanager
def errors_in_one_line() -> Iterator[None]:
    """Turn what bad input raises into one line and exit status 2; other errors keep their trace.

    Raises:
        SystemExit: instead of the error.
    """
    try:
        yield
    except BrokenPipeError:  # whoever reads has seen enough: no bad input
        raise
    except BAD_INPUT as error:
        if os.environ.get("TACTSLIP_TRACEBACK"):
            raise
        fail(one_line(error))


def fail(message: str) -> None:
    """Print one line, with the number of the process if there are several, exit with status 2.

    Raises:
        SystemExit: always.
    """
    who = f" in process {rank}" if (rank := _rank()) else ""
    print(f"error{who}: {' '.join(message.split())}", file=sys.stderr, flush=True)
    raise SystemExit(_EXIT_BAD_INPUT)


def one_line(error: BaseException) -> str:
    """What went wrong, without Hydra's wrapping, behind the section of the configuration."""
    section = ""
    while isinstance(error, InstantiationException) and error.__cause__ is not None:
        place = re.search(r"full_key: (\S+)", str(error))
        section = f"{place[1]}: " if place else ""
        target = re.search(r"call to target '(\S+)'", str(error))
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error.__cause__))
        if target and unknown:
            near = get_close_matches(unknown[1], signature(get_object(target[1])).parameters, 1)
            return f"{section}no key {unknown[1]}" + (f"; did you mean {near[0]}?" if near else "")
        error = error.__cause__
    if isinstance(error, MissingMandatoryValue):
        return f"no value for {error.full_key}; give {error.full_key}=..."
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error).strip()
    if "Original Traceback" in text:  # from a worker: the last line is what was raised there
        text = text.splitlines()[-1].partition(": ")[2]
    return section + (text or type(error).__name__)
