"""Connections of the page's server, few at a time. Imported where websockets is there."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any, ClassVar

from websockets.asyncio.server import ServerConnection
from websockets.protocol import State


class Caller(ServerConnection):
    """A connection; of those that are no open page the oldest makes room for one too many."""

    most: ClassVar[int] = 16
    others: list[Caller]  # all of the server, the oldest first

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count it."""
        super().connection_made(transport)
        self.others.append(self)
        waiting = [each for each in self.others if each.state is not State.OPEN]
        if len(waiting) > self.most:
            waiting[0].transport.abort()
            self.others.remove(waiting[0])

    def connection_lost(self, exc: Exception | None) -> None:
        """It counts no more."""
        if self in self.others:
            self.others.remove(self)
        super().connection_lost(exc)

    def send_data(self) -> None:
        """All at once, and nothing to who is gone: asyncio would log a line for each."""
        parts = self.protocol.data_to_send()
        if self.transport.is_closing():
            return
        if content := b"".join(parts):
            self.transport.write(content)
        if b"" in parts:  # the end
            with suppress(OSError, RuntimeError):
                self.transport.write_eof()


def callers() -> Any:
    """The connections of one server, as what makes them."""
    return type("CallerOfOne", (Caller,), {"others": []})
