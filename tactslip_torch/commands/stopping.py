"""Stopped by a signal: one line that says what is saved and how to go on, and the exit status."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


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
        if int(os.environ.get("RANK", os.environ.get("LOCAL_RANK", "0"))) == 0:
            print(f"\nstopped by {name}{told}", file=sys.stderr, flush=True)
        raise SystemExit(128 + end.number) from None
    finally:
        if os.getpid() == first:
            for own, handler in before.items():
                signal.signal(own, handler)
