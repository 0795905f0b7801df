"""Samples in the messages of one topic, by stretches; in memory is where each message is."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.formats.columns import Columns, chosen_columns
from tactslip_torch.data.formats.decoding import Decoded, Decoder
from tactslip_torch.data.formats.messages import Bag, decoder_of, named
from tactslip_torch.data.formats.reading import Opened, Reading

LOG_TIME = "log_time"
"""What ``reading.time`` calls the time at which a message was recorded."""
_SECOND = 10**9  # in nanoseconds, as all times here
_LONGEST = 2**62  # of a recording
_MOST_KEPT = 64 * 2**20  # bytes of decoded pages; the last page in any case
_GAP = 1.5  # usual spacings between messages; beyond, something is missing


class Index(NamedTuple):
    """Where the messages are, in the order of their times; all ``[M]``.

    Args:
        times: nanoseconds.
        num_rows: samples of each.
        starts: the first sample of each in the recording.
        pages: the page each is in.
        rows: the first sample of each in its page.
    """

    times: NDArray[np.int64]
    num_rows: NDArray[np.int64]
    starts: NDArray[np.int64]
    pages: NDArray[np.int64]
    rows: NDArray[np.int64]


class MessageSamples:
    """Samples ``[C, T]`` in the messages of a topic."""

    def __init__(self, pages: _Pages, index: Index) -> None:
        self._pages, self._index = pages, index
        self._page_rows = np.bincount(index.pages, index.num_rows)
        self.num_channels = pages.num_channels
        self.num_samples = int(index.num_rows.sum())
        self.dtype = torch.float32 if pages.decoder.is_small else torch.float64

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, as far as there are any, ``[C, n]``.

        Raises:
            ValueError: if the file was damaged or cut since it was opened.
        """
        count = max(min(stop, self.num_samples) - first, 0)
        dtype = np.float32 if self.dtype == torch.float32 else np.float64
        samples = np.empty((count, self.num_channels), dtype)
        starts = self._index.starts
        low = max(int(np.searchsorted(starts, first, "right")) - 1, 0)
        high = int(np.searchsorted(starts, first + count, "left"))
        by_page = np.argsort(self._index.pages[low:high], kind="stable") + low
        numbers, begins = np.unique(self._index.pages[by_page], return_index=True)
        for number, at in zip(numbers, np.split(by_page, begins[1:]), strict=False):
            values = self._pages.values(int(number))
            if len(values) != self._page_rows[number]:
                raise ValueError(f"{self._pages.path}: changed while it was read; open it again")
            rows = self._index.num_rows[at]
            inside = np.arange(rows.sum()) - np.repeat(np.cumsum(rows) - rows, rows)
            to = np.repeat(starts[at], rows) + inside - first
            source = np.repeat(self._index.rows[at], rows) + inside
            is_asked = (to >= 0) & (to < count)
            samples[to[is_asked]] = values[source[is_asked]]
        return torch.from_numpy(np.ascontiguousarray(samples.T))


class MessageTimes(NamedTuple):
    """When samples were taken: those of a message spread evenly up to the next.

    Where the next comes later than usual, they are spread as usual, so that the gap shows.
    ``spacing`` is in nanoseconds, ``[M]``.
    """

    messages: Index
    spacing: NDArray[np.float64]

    def read(self, first: int, stop: int) -> Tensor:
        """Seconds since the first sample, ``[n]``, float64, of the samples in that range."""
        end = int(self.messages.num_rows.sum())
        samples = np.arange(first, max(min(stop, end), first))
        at = np.searchsorted(self.messages.starts, samples, "right") - 1
        since = (self.messages.times[at] - self.messages.times[0]).astype(np.float64)
        inside = (samples - self.messages.starts[at]) * self.spacing[at]
        return torch.from_numpy((since + inside) / _SECOND)


def samples_of(path: str, bag: Bag, how: Reading) -> Opened:
    """The samples of a bag and their times, after every message was looked at once.

    A message's time is the number that ``reading.time`` names or, for ``"log_time"``, that of its
    recording. ``"auto"``: its stamp, unless all stamps are zero; else a number that is called a
    time; else that of its recording. Messages go by their times, those of one time in the order of
    the file; nothing is left out, so what was recorded twice shows in the times (``data.clock``
    refuses it). With ``reading.time=null`` messages go by recording and have no times.

    Raises:
        ValueError: if no topic or more than one holds samples, or the messages are damaged or hold
            not the same channels throughout.
    """
    with named(path):
        topic, decoder = decoder_of(bag, how.samples)
    columns = _columns(path, decoder, how)
    pages = _Pages(path, bag, topic, decoder, columns)
    index = _index(pages, how)
    names = decoder.names
    return Opened(
        MessageSamples(pages, index),
        names=None if names is None else tuple(names[place] for place in columns.channels),
        times=None if how.time is None else _times(index, how),
    )


def _columns(path: str, decoder: Decoder, how: Reading) -> Columns:
    """Which numbers of a message are samples, and which is its time if that is one of them."""
    has_other = decoder.is_stamped or decoder.names is None
    is_other = how.time == LOG_TIME or (how.time == "auto" and has_other)
    asked = replace(how, time=None) if is_other else how
    return chosen_columns(path, decoder.names, decoder.num_channels, asked)


class _Pages:
    """Pages of a bag, decoded; those used last are kept."""

    def __init__(self, path: str, bag: Bag, topic: str, decoder: Decoder, columns: Columns) -> None:
        self.path, self.bag, self.topic, self.decoder = path, bag, topic, decoder
        self.columns = columns
        self.num_channels = len(columns.channels)
        is_all = columns.channels == tuple(range(decoder.num_channels))
        self._channels: Any = slice(None) if is_all else list(columns.channels)
        self._kept: OrderedDict[int, NDArray[Any]] = OrderedDict()

    def values(self, number: int) -> NDArray[Any]:
        """The samples of a page, ``[n, C]``."""
        if number not in self._kept:
            self.decoded(number)
        self._kept.move_to_end(number)
        return self._kept[number]

    def decoded(self, number: int) -> tuple[NDArray[np.int64], Decoded]:
        """When the messages of a page were recorded, and what they hold."""
        with named(self.path):
            page = self.bag.page(number, self.topic)
            found = self.decoder.decode(page.messages, self.columns.time)
        self._kept[number] = found.values[:, self._channels]
        while len(self._kept) > 1 and sum(v.nbytes for v in self._kept.values()) > _MOST_KEPT:
            self._kept.popitem(last=False)
        return page.log_times, found


def _index(pages: _Pages, how: Reading) -> Index:
    """Where all messages are and when they were."""
    logged: list[NDArray[np.int64]] = []
    stamped: list[NDArray[np.int64]] = []
    columns: list[NDArray[Any]] = []
    num_rows: list[NDArray[np.int64]] = []
    for number in range(pages.bag.num_pages):
        log_times, decoded = pages.decoded(number)
        logged.append(log_times)
        num_rows.append(decoded.num_rows)
        if decoded.stamps is not None:
            stamped.append(decoded.stamps)
        if decoded.column is not None:
            columns.append(decoded.column)
    times = np.concatenate(logged)
    if not len(times):  # though one was met before
        raise ValueError(f"{pages.path}: damaged: no page holds a message of {pages.topic}")
    if columns:
        with named(pages.path):
            times = _nanoseconds(np.concatenate(columns), pages.columns.seconds)
    elif stamped and how.time == "auto":
        found = np.concatenate(stamped)
        times = found if found.any() else times
    rows = [np.cumsum(counts) - counts for counts in num_rows]
    page = np.repeat(np.arange(len(logged)), [len(counts) for counts in num_rows])
    order = np.argsort(times, kind="stable")
    counts = np.concatenate(num_rows)[order]
    starts = np.cumsum(counts) - counts
    return Index(times[order], counts, starts, page[order], np.concatenate(rows)[order])


def _nanoseconds(times: NDArray[Any], seconds: float) -> NDArray[np.int64]:
    """Times of a unit of so many seconds; of whole numbers nothing is lost."""
    unit = round(seconds * _SECOND)
    if times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        raise ValueError("a time that is no number")
    first, last = times.min().item(), times.max().item()
    if (last - first) * unit > _LONGEST:
        raise ValueError(f"times {(last - first) * seconds:g} s apart; see reading.time_unit")
    if times.dtype.kind == "f":
        whole: NDArray[Any] = np.round((times.astype(np.float64) - first) * unit)
    else:
        whole = (times - times.dtype.type(first)).astype(np.int64) * unit
    found: NDArray[np.int64] = whole.astype(np.int64)
    return found


def _times(index: Index, how: Reading) -> MessageTimes | None:
    """The times of all samples; of a single block none, where nobody gives the rate."""
    steps = np.diff(index.times)
    spacings = steps / index.num_rows[:-1]
    if how.sample_rate_hz is not None:
        usual = _SECOND / how.sample_rate_hz
    elif len(spacings):
        usual = float(np.median(spacings))
    elif index.num_rows[0] > 1:
        return None
    else:
        usual = 0.0
    spacing = np.full(len(index.times), usual)
    spacing[:-1] = np.where(spacings > _GAP * usual, usual, spacings)
    return MessageTimes(index, spacing)
