"""Connections of the page's server, few at a time. Imported where websockets is there."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import ClassVar

from websockets.asyncio.server import ServerConnection
from websockets.protocol import State

MOST = 16
"""Connections of a server that are no open page."""


class Caller(ServerConnection):
    """A connection; of those that are no open page the oldest is closed for one too many."""

    made: ClassVar[list[Caller]]  # of the server, the oldest first

    @classmethod
    def drop(cls, most: int) -> None:
        """Close the oldest of those that are no page, until there are no more than ``most``."""
        others = [each for each in cls.made if each.state is not State.OPEN]
        for each in others[: max(0, len(others) - most)]:
            cls.made.remove(each)
            each.transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Count it."""
        super().connection_made(transport)
        self.made.append(self)
        self.drop(MOST)

    def connection_lost(self, exc: Exception | None) -> None:
        """It counts no more."""
        if self in self.made:
            self.made.remove(self)
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


def callers() -> type[Caller]:
    """The connections of one server."""
    return type("CallerOfOne", (Caller,), {"made": []})
