"""What a stream lost: an event for each stretch of samples that the same channels lack."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tactslip_torch.live.sinks import Block, Event, counted

_LONG_S = 1.0  # a stretch that lasts longer is told before it ends
_AT_ONCE, _EACH_S = 10, 6.0  # stretches that are told one by one, and when there is one more
_MOST_NAMES = 24


class Losses:
    """Finds the stretches in samples as they come.

    Times are those of the decisions: of the sender's clock, or from the first sample on.

    Args:
        names: of the channels.
        sample_rate_hz: of the stream.
    """

    def __init__(self, names: Sequence[str], sample_rate_hz: float) -> None:
        self._names, self._rate = names, sample_rate_hz
        self._start = np.full(len(names), -1)  # where the stretch begins that a channel is in
        self._is_told = np.zeros(len(names), bool)
        self._next = 0
        self._shift_s = 0.0  # from the sender's clock to that of the stream
        self._ended: dict[tuple[int, int], list[int]] = {}  # and not told: start, stop, channels
        self._room, self._since = float(_AT_ONCE), 0

    def take(self, first: int, block: Block) -> Iterator[Event]:
        """What is to be told with these samples.

        Args:
            first: index of the first since the stream's start; what lies before it and behind the
                last block, all channels lack.
            block: the samples.
        """
        is_lost = ~np.isfinite(block.samples)
        if block.time_s is not None:
            self._shift_s = float(block.time_s[0]) - first / self._rate
        if first > self._next > 0:
            self._start[self._start < 0] = self._next
        is_in = self._start >= 0
        self._next = first + len(is_lost)
        if is_in.any() or is_lost.any():
            changes = np.diff(np.vstack([is_in, is_lost]), axis=0)
            for row, channel in np.argwhere(changes).tolist():
                self._change(first + row, channel)
            yield from self._long()
        if self._ended:
            yield from self._told()

    def end(self) -> Iterator[Event]:
        """What is left at the end of the stream; another may begin."""
        for channel in np.flatnonzero(self._start >= 0).tolist():
            self._change(self._next, channel)
        self._room += 1
        yield from self._told()
        self._next = 0  # and nothing lies between

    def _change(self, place: int, channel: int) -> None:
        start, self._is_told[channel] = int(self._start[channel]), False
        self._start[channel] = -1 if start >= 0 else place
        if start >= 0:
            self._ended.setdefault((start, place), []).append(channel)

    def _long(self) -> Iterator[Event]:
        is_long = (self._start >= 0) & (self._next - self._start > _LONG_S * self._rate)
        for start in np.unique(self._start[is_long & ~self._is_told]).tolist():
            mine = self._start == start
            self._is_told |= mine
            channels = self._named(np.flatnonzero(mine).tolist())
            yield Event("missing", f"samples of {channels} since {self._time(start)}")

    def _told(self) -> Iterator[Event]:
        """Each stretch that has ended, or all at once where there are many."""
        gained = (self._next - self._since) / self._rate / _EACH_S
        self._room, self._since = min(self._room + gained, _AT_ONCE), self._next
        while self._ended and self._room >= 1:
            self._room -= 1
            several = list(self._ended.items())[: None if self._room < 1 else 1]
            (start, _), _ = several[0]
            stop = max(stop for (_, stop), _ in several)
            num = sum(stop - start for (start, stop), _ in several)
            channels = self._named(sorted({one for _, each in several for one in each}))
            where, num_parts = f"from {self._time(start)} on", len(several)
            if num_parts > 1:
                where = f"in {num_parts} stretches from {self._time(start)} to {self._time(stop)}"
            yield Event("missing", f"{counted(num, 'sample')} of {channels} {where}")
            for key, _ in several:
                del self._ended[key]

    def _time(self, place: int) -> str:
        return f"{place / self._rate + self._shift_s:.4f} s"

    def _named(self, channels: Sequence[int]) -> str:
        if len(channels) == len(self._names) > 1:
            return f"all {len(channels)} channels"
        more = len(channels) - _MOST_NAMES
        named = ", ".join(self._names[channel] for channel in channels[:_MOST_NAMES])
        return named + (f" and {more} more" if more > 0 else "")
