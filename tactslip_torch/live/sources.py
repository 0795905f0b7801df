"""Where the samples of a live stream come from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from tactslip_torch.live.sinks import Block, Event


class Source(Protocol):
    """Blocks of samples as they come, and events between them.

    Attributes:
        name: for people, such as ``"serial:/dev/ttyACM0"``.
        is_live: whether samples come whether or not they are taken: what waits too long is then
            dropped; else the source waits.
    """

    name: str
    is_live: bool

    def __iter__(self) -> Iterator[Block | Event]:
        """Blocks and events in order, from one thread; ends with the stream."""

    def close(self) -> None:
        """End the iteration within a fraction of a second; from any thread."""
