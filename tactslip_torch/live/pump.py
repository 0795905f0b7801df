"""From a source through a queue and a detector to sinks, without holding up whoever sends."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack
from queue import SimpleQueue

import numpy as np

from tactslip_torch.live.sinks import Block, Counts, Event, Placed, Sink, Source, counted, merged
from tactslip_torch.onset.decisions import Decisions
from tactslip_torch.onset.streaming import StreamingDetector, listed
from tactslip_torch.runtime import one_thread

_LONGER_S = 0.01  # than what StreamingDetector fills: begins a stream anew
_PATIENCE_S = 10.0  # for sinks, when all is to end
_LONG_S = 1.0  # a stretch of lost samples that lasts longer is reported before it ends
_AT_ONCE, _EACH_S = 10, 6.0  # stretches that are reported one by one, and when there is one more
_MOST_NAMES = 24
_BREAKS = ("lost", "waiting", "gap", "dropped")
"""Events behind which samples are lacking."""


def watch(
    source: Source,
    stream: StreamingDetector,
    sinks: Sequence[Sink],
    *,
    queue_s: float = 2.0,
    counts: Counts | None = None,
    events: SimpleQueue[Event] | None = None,
) -> Counts:
    """Watch a source until it ends: each sample through the detector, decisions to all sinks.

    One thread reads, one decides and calls the sinks; this one waits. Where the source is live and
    ``queue_s`` of samples wait to be decided on, all of them are dropped, counted and reported
    (``"dropped"``): decisions are late by no more than that. Behind samples that are lacking
    (dropped, or a connection that was lost) times go on as the clock of this machine did, and a new
    stream of decisions begins, if it is more than ``AlarmSettings.hold_s``.

    What is lost is reported (``"missing"``): for each stretch of samples that the same channels
    lack an event with time, number and channels when it ends, and one before if it lasts over 1 s.
    Of many stretches some are reported together.

    However it ends (a signal, or an exception of a sink), the last decisions are flushed and
    all sinks are closed.

    Args:
        source: of samples.
        stream: of a detector; nothing was pushed yet.
        sinks: called in their order.
        queue_s: most that waits.
        counts: to be kept up to date, for others to see.
        events: of others than the source, such as servers, which are put there while it goes on.

    Returns:
        The counts.

    Raises:
        Exception: what the source or a sink raised.
        ValueError: if a block is not of this hand.
    """
    state = _State(source, stream, sinks, queue_s, counts or Counts())
    reader = threading.Thread(target=state.read, name="tactslip-read", daemon=True)
    decider = threading.Thread(target=state.decide, name="tactslip-decide", daemon=True)
    decider.start()
    reader.start()
    try:
        while not state.is_done.wait(0.2):  # signals come in between
            while events is not None and not events.empty():
                state.put(events.get())
    except BaseException:  # Thread.join would take a thread for ended now (CPython, bpo-45274)
        state.stop()
        state.is_done.wait(_PATIENCE_S)
        raise
    if state.error is not None:
        raise state.error
    return state.counts


class _State:
    """What both threads share."""

    def __init__(
        self,
        source: Source,
        stream: StreamingDetector,
        sinks: Sequence[Sink],
        queue_s: float,
        counts: Counts,
    ) -> None:
        self._source, self._stream, self._sinks, self.counts = source, stream, sinks, counts
        self._rate = stream.detector.pool.sample_rate_hz
        self._most = max(1, round(queue_s * self._rate))
        self._queue: deque[Placed | Event] = deque()
        self._waiting = 0  # samples in it
        self._changed = threading.Condition()
        self._is_over = False
        self._next: int | None = None  # index of the sample that would go on
        self._is_break_reported = False
        pool = stream.detector.pool
        self._losses = _Losses(pool.hand.names, pool.sample_rate_hz)
        self.error: BaseException | None = None
        self.is_done = threading.Event()

    def stop(self) -> None:
        """End soon: what waits is still decided on."""
        self._source.close()
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    # Reading --------------------------------------------------------------------------------------

    def read(self) -> None:
        """Blocks from the source into the queue, each with the index of its first sample."""
        position, came_s, next_s = 0, time.monotonic(), 0.0
        is_broken, items = False, iter(self._source)
        try:
            for item in items:
                if isinstance(item, Event):
                    is_broken |= item.kind in _BREAKS
                    self.put(item)
                    continue
                num, now_s = len(item.samples), time.monotonic()
                if item.time_s is not None and num:
                    lacking = round((item.time_s[0] - next_s) * self._rate) if position else 0
                    position += max(0, lacking)
                    num = num if lacking >= 0 else 0  # goes back: not to be decided on
                    next_s = max(next_s, item.time_s[-1] + 1 / self._rate)
                elif is_broken and position:
                    lacking = round((now_s - came_s) * self._rate) - num
                    longer_s = self._stream.settings.hold_s + _LONGER_S
                    position += max(lacking, math.ceil(longer_s * self._rate))
                is_broken, came_s = False, now_s
                self.counts.received += len(item.samples)
                self.put(Placed(position, item))
                position += num
                if self._is_over:
                    break
        except BaseException as error:
            self.error = self.error or error
        if isinstance(items, Generator):
            items.close()  # gives back what it holds
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def put(self, item: Placed | Event) -> None:
        """Behind all that waits; of too much the oldest is dropped, or the source waits."""
        with self._changed:
            if isinstance(item, Event):
                self._queue.append(item)
                self._changed.notify_all()
                return
            num = len(item.block.samples)
            while not self._source.is_live and self._waiting >= self._most and not self._is_over:
                self._changed.wait(0.2)
            if self._source.is_live and self._waiting and self._waiting + num > self._most:
                lost, self._waiting = self._waiting, 0
                self.counts.dropped += lost
                events = [each for each in self._queue if isinstance(each, Event)]
                self._queue = deque(events)
                text = f"{lost} samples dropped: the detector was {lost / self._rate:.2f} s behind"
                self._queue.append(Event("dropped", text))
            self._queue.append(item)
            self._waiting += num
            self._changed.notify_all()

    # Deciding -------------------------------------------------------------------------------------

    def decide(self) -> None:
        """All that waits, at once, until nothing more can come."""
        with one_thread(), ExitStack() as closing:
            closing.callback(self.is_done.set)
            for sink in reversed(self._sinks):
                closing.callback(self._close, sink)
            try:
                while items := self._get():
                    for item in merged(items):
                        if isinstance(item, Event):
                            self._report(*(self._losses.end() if item.kind == "gap" else ()), item)
                        else:
                            self._push(*item)
                self._hand_on(self._stream.flush())
                self._report(*self._losses.end())
                if self.error is None:
                    self._report(Event("ended", f"{self._source.name}: ended"))
            except BaseException as error:
                self.error = error
                self.stop()

    def _get(self) -> list[Placed | Event]:
        with self._changed:
            while not self._queue and not self._is_over:
                self._changed.wait()
            items = list(self._queue)
            self._queue.clear()
            self._waiting = 0
            self._changed.notify_all()
            return items

    def _push(self, first: int, block: Block) -> None:
        if not len(block.samples):
            return
        time_s = block.time_s
        if time_s is None and first != self._next:
            time_s = np.array(first / self._rate)
        gaps = self._stream.num_gaps
        try:
            decisions = self._stream.push(block.samples, time_s)
        except ValueError as error:
            if block.time_s is None:
                raise
            self._report(Event("garbage", f"{len(block.samples)} samples passed over: {error}"))
            return
        self._next = first + len(block.samples)
        if self._stream.num_gaps > gaps and not self._is_break_reported:
            self._report(Event("gap", f"a gap at {first / self._rate:.3f} s: decisions begin anew"))
        self._is_break_reported = False
        self._report(*self._losses.take(first, block))
        of_hand = self._stream.take_events()
        self._report(*(Event("hand", f"{event.time_s:.3f} s: {event.text}") for event in of_hand))
        for sink in self._sinks:
            sink.samples(first, block)
        self._hand_on(decisions)

    def _hand_on(self, decisions: Decisions) -> None:
        if len(decisions.number):
            self.counts.alarms += int(decisions.is_alarm.sum())
            for sink in self._sinks:
                sink.decisions(decisions)

    def _report(self, *events: Event) -> None:
        for event in events:
            self._is_break_reported |= event.kind in _BREAKS
            for sink in self._sinks:
                sink.event(*event)

    def _close(self, sink: Sink) -> None:
        try:
            sink.close()
        except Exception as error:
            self.error = self.error or error


class _Losses:
    """Finds the stretches in samples as they come.

    Times are those of the decisions: of the sender's clock, or from the first sample on.

    Args:
        names: of the channels.
        sample_rate_hz: of the stream.
    """

    def __init__(self, names: Sequence[str], sample_rate_hz: float) -> None:
        self._names, self._rate = names, sample_rate_hz
        self._start = np.full(len(names), -1)  # where the stretch begins that a channel is in
        self._is_reported = np.zeros(len(names), bool)
        self._next = 0
        self._shift_s = 0.0  # from the sender's clock to that of the stream
        self._ended: dict[tuple[int, int], list[int]] = {}  # unreported: start, stop, channels
        self._room, self._since = float(_AT_ONCE), 0

    def take(self, first: int, block: Block) -> Iterator[Event]:
        """Events that come with these samples.

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
            yield from self._reported()

    def end(self) -> Iterator[Event]:
        """What is left at the end of the stream; another may begin."""
        for channel in np.flatnonzero(self._start >= 0).tolist():
            self._change(self._next, channel)
        self._room += 1
        yield from self._reported()
        self._next = 0  # and nothing lies between

    def _change(self, place: int, channel: int) -> None:
        start, self._is_reported[channel] = int(self._start[channel]), False
        self._start[channel] = -1 if start >= 0 else place
        if start >= 0:
            self._ended.setdefault((start, place), []).append(channel)

    def _long(self) -> Iterator[Event]:
        is_long = (self._start >= 0) & (self._next - self._start > _LONG_S * self._rate)
        for start in np.unique(self._start[is_long & ~self._is_reported]).tolist():
            mine = self._start == start
            self._is_reported |= mine
            channels = listed(self._names, mine, _MOST_NAMES)
            yield Event("missing", f"samples of {channels} since {self._time(start)}")

    def _reported(self) -> Iterator[Event]:
        """Each stretch that has ended, or all at once where there are many."""
        gained = (self._next - self._since) / self._rate / _EACH_S
        self._room, self._since = min(self._room + gained, _AT_ONCE), self._next
        while self._ended and self._room >= 1:
            self._room -= 1
            several = list(self._ended.items())[: None if self._room < 1 else 1]
            (start, _), _ = several[0]
            stop = max(stop for (_, stop), _ in several)
            num = sum(stop - start for (start, stop), _ in several)
            lacking = [one for _, each in several for one in each]
            is_lacking = np.isin(np.arange(len(self._names)), lacking)
            channels = listed(self._names, is_lacking, _MOST_NAMES)
            where, num_parts = f"from {self._time(start)} on", len(several)
            if num_parts > 1:
                where = f"in {num_parts} stretches from {self._time(start)} to {self._time(stop)}"
            yield Event("missing", f"{counted(num, 'sample')} of {channels} {where}")
            for key, _ in several:
                del self._ended[key]

    def _time(self, place: int) -> str:
        return f"{place / self._rate + self._shift_s:.4f} s"
