"""Samples that come in pieces: ``ChannelFilter`` of them, and when they were taken.

A sample is settled, and handed on filtered, once what its frame takes in has come. Channels settle
together, with the longest look-ahead of those in use, so a piece has all channels of an instant.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.signals.filtering import ChannelFilter, Edges, as_index, convolve_valid

Array = NDArray[Any]


class FilterStream:
    """A filter that remembers as many samples as its longest frame holds, and no more.

    The pieces it hands on, put together, are ``channel_filter(samples, channels)`` of the whole,
    bit for bit but at the two ends, where a matrix product may round otherwise.

    Args:
        channel_filter: the frames of all channels.
        dtype: in which to filter, float32 or float64; what is pushed is converted.
        channels: which are wanted, by default all; the others are handed on as they came.

    Attributes:
        look_ahead: samples behind its own that a sample waits for.
        frame: samples that must have come before any is settled.

    Raises:
        ValueError: for another dtype, or if no channel is wanted.
    """

    def __init__(
        self,
        channel_filter: ChannelFilter,
        dtype: torch.dtype = torch.float64,
        channels: Collection[int] | None = None,
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"a stream is filtered in float32 or float64, got {dtype}")
        lengths = channel_filter.window_lengths
        wanted = sorted(range(len(lengths)) if channels is None else set(channels))
        if not wanted:
            raise ValueError("no channel is wanted, expected at least one")
        self.channel_filter = channel_filter
        self.dtype = dtype
        reaches = [channel_filter.reaches[channel] for channel in wanted]
        self.frame = max(lengths[channel] for channel in wanted)
        self.look_ahead = max(after for _, after in reaches)
        self._groups = list[tuple[slice | list[int], Edges]]()
        for length in dict.fromkeys(lengths[channel] for channel in wanted):
            group = [channel for channel in wanted if lengths[channel] == length]
            self._groups.append((as_index(group), channel_filter.edges(group[0])))
        self.reset()

    def reset(self) -> None:
        """Forget the stream; the next sample is the first of another."""
        self._held = torch.empty(len(self.channel_filter.window_lengths), 0, dtype=self.dtype)
        self._num_dropped = 0  # samples before those held
        self._num_settled = 0

    @property
    def num_pushed(self) -> int:
        """Samples that came since the start."""
        return self._num_dropped + self._held.shape[-1]

    @property
    def num_bytes(self) -> int:
        """Memory of the samples that are remembered."""
        return self._held.untyped_storage().nbytes()

    def push(self, samples: Tensor) -> Tensor:
        """Filtered samples that are settled now and were not before.

        Args:
            samples: what came next; remembered as a copy.

        Shape:
            - samples: ``[C, n]``, ``n`` from 0
            - output: ``[C, m]``

        Raises:
            ValueError: if the number of axes or channels is another; nothing is changed then.
        """
        self.check(samples)
        with torch.no_grad():
            self._held = torch.cat([self._held, samples.to(self._held)], dim=-1)
            num = self.num_pushed
            settled = self._filtered(num - self.look_ahead if num >= self.frame else 0)
            surplus = max(num - self.frame - self._num_dropped, 0)
            self._held = self._held[:, surplus:].clone()  # a view would keep all of it
            self._num_dropped += surplus
        return settled

    def flush(self) -> Tensor:
        """The samples still waiting, by the polynomial of the last frame; then as ``reset``.

        Of a stream shorter than ``frame``, which ``ChannelFilter`` refuses, there are none.

        Shape:
            - output: ``[C, m]``
        """
        num = self.num_pushed
        with torch.no_grad():
            settled = self._filtered(num if num >= self.frame else 0)
        self.reset()
        return settled

    def check(self, samples: Tensor) -> None:
        """Refuse what is no piece of a stream of this hand.

        Raises:
            ValueError: if the number of axes or channels is another.
        """
        num_channels = len(self.channel_filter.window_lengths)
        if samples.ndim != 2 or len(samples) != num_channels:
            raise ValueError(
                f"expected samples [{num_channels}, n] (channels, time), got {tuple(samples.shape)}"
            )

    def _filtered(self, stop: int) -> Tensor:
        """Samples from the first that is not settled up to ``stop``, which are so from now on."""
        start, self._num_settled = self._num_settled, max(stop, self._num_settled)
        settled = self._held[:, start - self._num_dropped : self._num_settled - self._num_dropped]
        settled = settled.clone()
        if settled.shape[-1] > 0:
            for chosen, matrices in self._groups:
                settled[chosen] = self._piece(self._held[chosen], start, stop, matrices)
        return settled

    def _piece(self, held: Tensor, start: int, stop: int, matrices: Edges) -> Tensor:
        """Samples from ``start`` up to ``stop`` of channels that share a frame."""
        head, kernel, tail = (matrix.to(held) for matrix in matrices)
        before, length, after = len(head), len(kernel), len(tail)
        if length == 1:
            return held[:, start - self._num_dropped : stop - self._num_dropped]
        first = max(start, before)
        last = min(stop, self.num_pushed - after)
        begin = first - before - self._num_dropped
        pieces = [convolve_valid(held[:, begin : begin + last - first + length - 1], kernel)]
        if start == 0:
            pieces.insert(0, held[:, :length] @ head.T)
        if stop > last:
            pieces.append(held[:, -length:] @ tail[last - self.num_pushed + after :].T)
        return torch.cat(pieces, dim=-1)


class SampleClock:
    """When the samples of a stream were taken, and how many never came.

    Times are those of the last sample that had one and the samples counted since: nothing adds up,
    so a clock that runs a little faster or slower than the nominal rate is followed.

    Args:
        sample_rate_hz: nominal.

    Attributes:
        num_samples: that came or were missing since the start.
        is_timed: whether any had a time; if none, the first is at 0.
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.num_samples = 0  # Python's integers: exact for ever
        self.is_timed = False
        self._places, self._times_s = np.zeros(1, np.int64), np.zeros(1)  # of those with a time

    def missing(self, times_s: Array) -> Array:
        """How many samples are missing before each of those that come next.

        Shape:
            - times_s: ``[k]``, float64, of the first ``k``, good to a quarter of a sample
            - output: ``[k]``, whole float64; the first is 0 if no sample had a time before

        Raises:
            ValueError: if a time is earlier than the last sample's end.
        """
        ahead = np.diff(times_s, prepend=self._times_s[-1]) * self.sample_rate_hz
        since = self.num_samples - self._places[-1]
        ahead -= np.concatenate([[since if self.is_timed else ahead[0]], np.ones(len(ahead) - 1)])
        missing: Array = np.rint(ahead) + 0.0
        if (missing < 0).any():
            first = int(np.argmax(missing < 0))
            raise ValueError(
                f"time_s goes back: sample {first} of these is at {times_s[first]:.6f} s, "
                f"{-missing[first]:g} samples before its turn; leave out what came twice"
            )
        return missing

    def take(self, num: int, places: Array, times_s: Array) -> None:
        """Count samples, some of which have times.

        Args:
            num: how many.
            places: which of them have times, ``[k]``, rising.
            times_s: those, ``[k]``.
        """
        if len(places) or len(self._places) > 1:
            self._places = np.concatenate([self._places[-1:], self.num_samples + places])
            self._times_s = np.concatenate([self._times_s[-1:], times_s])
        self.num_samples += num
        self.is_timed |= len(places) > 0

    def end_s(self, num_samples: Array) -> Array:
        """When so many samples had come: the end of the last of them, ``[m]``, float64.

        It must be one of the samples that the last ``take`` counted, or a later one.
        """
        last = np.searchsorted(self._places, num_samples - 1, side="right") - 1
        since = num_samples - self._places[last]
        end_s: Array = self._times_s[last] + since / self.sample_rate_hz
        return end_s
