"""``StreamingDetector``: samples in as they come, decisions and alarms out as soon as they can be.

The same mathematics as ``score_stream`` and ``Decider`` on the whole recording, at the look-ahead
of the detector and with a memory of fixed size: a sample is filtered once, and a bin scored once.
"""

from __future__ import annotations

import logging
import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import ChannelMask, masked_names, without
from tactslip_torch.onset.decisions import Decider, Decisions, is_usable, score_filtered
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.signals.stream import FilterStream, SampleClock

_LOG = logging.getLogger(__name__)
_NUMPY = {torch.float32: np.float32, torch.float64: np.float64}
Array = NDArray[Any]


class StreamingDetector:
    """A detector that watches a stream without end.

    What all pushes and the final ``flush`` return, put together, is what ``score_stream`` and a
    ``Decider`` make of the whole recording, whatever pieces it came in: scores to rounding. A
    decision uses no sample behind its bin's ``look_ahead`` and is returned by the push that brings
    the last one. Not for several threads at once.

    **Missing samples** are NaN; so are the samples of a gap of at most ``max_gap_s`` that the times
    of samples show. A decision that one of them reaches is flagged as not valid. It still counts
    as long as a channel in use is left (``is_usable``), else it says nothing to the rule. A longer
    gap ends the stream as ``flush`` does and begins another, from decision number 0; ``num_gaps``
    counts, and the log warns.

    Args:
        detector: fitted on this hand.
        settings: hop, calibration, rule and threshold; by default those in the detector's file.
        dtype: of the samples, float32 or float64, and of the scores; what is pushed is converted.
        masked_channels: names of channels that are not to be listened to.
        max_gap_s: longest gap that is filled.

    Attributes:
        num_gaps: longer gaps since it was made or reset.
        masked_channels: channels that count as missing whatever they say, in the order of the
            hand; may be set at any time, for all decisions that are still to be made.

    Raises:
        ValueError: if the detector has no settings, the gap is negative, the dtype another or the
            hand has no such channel.

    Example:
        >>> stream = StreamingDetector(SlipDetector.load("detector.pt"))  # doctest: +SKIP
        >>> for samples in daq:  # doctest: +SKIP
        ...     for alarm in stream.push(samples).alarms:
        ...         print(alarm.alarm_s, alarm.probability)
    """

    def __init__(
        self,
        detector: SlipDetector,
        settings: AlarmSettings | None = None,
        *,
        dtype: torch.dtype = torch.float32,
        masked_channels: ChannelMask = (),
        max_gap_s: float = 0.05,
    ) -> None:
        if dtype not in _NUMPY:
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        if not 0 <= max_gap_s < math.inf:
            raise ValueError(f"max_gap_s must be finite and not negative, got {max_gap_s}")
        pool = detector.pool
        self.detector = detector
        self.settings = AlarmSettings.of(detector) if settings is None else settings
        self.dtype = dtype
        self.num_gaps = 0
        self.masked_channels = masked_names(masked_channels, pool.hand.names)
        self._clock = SampleClock(pool.sample_rate_hz)
        self._max_gap = round(max_gap_s * pool.sample_rate_hz)
        wide = pool.widen(torch.empty(0, dtype=dtype)).dtype
        channels = detector.needed_index.tolist()
        self._filter = FilterStream(detector.channel_filter, wide, channels)
        self._first = pool.bin_samples + detector.look_ahead
        parts = (pool.sample_rate_hz, pool.bin_samples, detector.look_ahead)
        self._decider = Decider(self.settings, *parts)
        self._start()

    @property
    def masked_channels(self) -> tuple[str, ...]:
        """Channels that are not listened to, in the order of the hand."""
        return self._masked_channels

    @masked_channels.setter
    def masked_channels(self, masked_channels: ChannelMask) -> None:
        self._masked_channels = masked_names(masked_channels, self.detector.pool.hand.names)

    @property
    def look_ahead_s(self) -> float:
        """From the end of a bin until its decision is made."""
        return self.detector.look_ahead / self._clock.sample_rate_hz

    @property
    def bin_s(self) -> float:
        """What a decision is about."""
        return self.detector.pool.bin_samples / self._clock.sample_rate_hz

    @property
    def hop_s(self) -> float:
        """Between two decisions."""
        return self.settings.hop_samples / self._clock.sample_rate_hz

    @property
    def state_bytes(self) -> int:
        """Memory of the samples that are remembered."""
        held = [self._filtered, *self._pending]
        return self._filter.num_bytes + sum(each.untyped_storage().nbytes() for each in held)

    def push(
        self, samples: ArrayLike | Tensor, time_s: ArrayLike | Tensor | None = None
    ) -> Decisions:
        """The decisions that these samples make possible; copied, so their memory may be reused.

        Args:
            samples: what came next, in volts.
            time_s: when the first sample was taken, or each; on one clock, good to a quarter of a
                sample. Without, samples follow the last ones, and the first of all is at 0.

        Shape:
            - samples: ``[n, C]``, any floating dtype, ``n`` from 0: a row is an instant
            - time_s: none, one, or ``[n]`` in float64

        Raises:
            ValueError: if samples are not of this hand or no floating numbers, times are not finite
                or go back (a sample is there already); nothing is changed then.
        """
        x = self._read(samples)
        times_s = _times(time_s, x.shape[-1])
        if x.shape[-1] == 0:
            return self._nothing
        if len(times_s) == 0:
            return self._take(x, np.zeros(0, np.int64), times_s)
        missing = self._clock.missing(times_s)
        is_first = missing > self._max_gap  # of a stream that begins behind a gap
        missing = np.where(is_first, 0, missing).astype(np.int64)
        cuts = [0, *(1 + np.flatnonzero(is_first[1:])).tolist(), len(missing)]
        parts = []
        for start, stop in pairwise(cuts):
            if is_first[start]:
                parts.append(self._begin_anew(times_s[start]))
            last = stop if stop < len(missing) else x.shape[-1]
            parts.append(self._fill(x[:, start:last], missing[start:stop], times_s[start:stop]))
        return _joined(parts)

    def flush(self) -> Decisions:
        """The decisions still waiting for their look-ahead, as at the end of a recording.

        Then as ``reset``. ``available_s`` is when they would have been there, had it gone on.
        """
        settled = [self._filter.push(samples) for samples in self._pending]
        decisions = self._decide(torch.cat([*settled, self._filter.flush()], dim=-1))
        self._start()
        return decisions

    def reset(self) -> None:
        """Forget the stream; the next sample is the first of another, at 0 unless it has a time."""
        self.num_gaps = 0
        self._start()

    def _start(self) -> None:
        num_channels = len(self.detector.pool.hand)
        for part in (self._filter, self._clock, self._decider):
            part.reset()
        self._pending: list[Tensor] = []
        self._filtered = torch.empty(num_channels, 0, dtype=self._filter.dtype)
        self._dropped = 0  # filtered samples before those held
        self._number = 0  # of the next decision
        self._nothing = self._decide(self._filtered)

    def _samples_for(self, number: Array) -> Array:
        """Samples that must have come before decisions can be made, ``[m]``."""
        samples: Array = number * self.settings.hop_samples + self._first
        return samples.clip(min=self._filter.frame)  # which may be longer than a bin

    def _read(self, samples: ArrayLike | Tensor) -> Tensor:
        """Samples ``[n, C]`` as a copy ``[C, n]`` in the stream's dtype."""
        num_channels = len(self.detector.pool.hand)
        if not isinstance(samples, Tensor):
            array = np.asarray(samples)
            self._check(array.shape, array.dtype, array.dtype.kind == "f")
            with np.errstate(over="ignore"):  # beyond float32 is Inf, which is flagged
                return torch.from_numpy(np.array(array.T, _NUMPY[self.dtype], order="C"))
        self._check(tuple(samples.shape), samples.dtype, samples.is_floating_point())
        return torch.empty(num_channels, len(samples), dtype=self.dtype).copy_(samples.detach().T)

    def _check(self, shape: tuple[int, ...], dtype: object, is_floating: bool) -> None:
        names = self.detector.pool.hand.names
        if len(shape) != 2 or shape[1] != len(names):
            raise ValueError(
                f"expected samples [n, {len(names)}] (instants, channels {names[0]} to "
                f"{names[-1]}), got {shape}"
            )
        if not is_floating:
            raise ValueError(f"expected samples in volts, floating numbers, got {dtype}")

    def _begin_anew(self, time_s: float) -> Decisions:
        """Another stream behind a gap."""
        _LOG.warning("the stream begins anew at %.4f s, behind a gap", time_s)
        decisions = self.flush()
        self.num_gaps += 1
        return decisions

    def _fill(self, x: Tensor, missing: Array, times_s: Array) -> Decisions:
        """Take samples, the first of which have times, with NaN for those missing before each."""
        places = np.arange(x.shape[-1])
        places[: len(missing)] += missing.cumsum()
        places[len(missing) :] += missing.sum()
        if missing.any():
            full = x.new_full((len(x), int(places[-1]) + 1), torch.nan)
            full[:, torch.from_numpy(places)] = x
            x = full
        return self._take(x, places[: len(missing)], times_s)

    def _take(self, x: Tensor, places: Array, times_s: Array) -> Decisions:
        """Filter and decide, once the next decision has all its samples."""
        self._clock.take(x.shape[-1], places, times_s)
        self._pending.append(x)
        if self._clock.num_samples < self._due:
            return self._nothing
        samples, self._pending = torch.cat(self._pending, dim=-1), []
        return self._decide(self._filter.push(samples))

    def _decide(self, filtered: Tensor) -> Decisions:
        """The decisions on bins that are full now."""
        self._filtered = torch.cat([self._filtered, filtered], dim=-1)
        self._drop()
        hop = self.settings.hop_samples
        with torch.no_grad():
            masked = without(self._filtered, self._masked_channels, self.detector.pool.hand.names)
            scores = score_filtered(self.detector, masked, hop, self.dtype)
            tells = is_usable(scores.score, scores.is_missing, self.detector.needed_index)
            decisions = self._decider.decide(scores.score, scores.is_valid, tells, scores.variance)
        self._number += len(decisions.number)
        self._due = int(self._samples_for(np.array(self._number)))
        self._drop()
        return self._timed(decisions)

    def _drop(self) -> None:
        """Let go of filtered samples before the next bin."""
        hop = self.settings.hop_samples
        surplus = min(self._number * hop - self._dropped, self._filtered.shape[-1])
        if surplus > 0:
            self._filtered = self._filtered[:, surplus:].clone()  # a view would keep all of it
            self._dropped += surplus

    def _timed(self, decisions: Decisions) -> Decisions:
        """The same by the times of the samples, and no earlier than the first frame."""
        if not self._clock.is_timed and self._filter.frame <= self._first:
            return decisions
        samples = self._samples_for(decisions.number.numpy())
        available_s = torch.from_numpy(self._clock.end_s(samples))
        onset_s = available_s - (decisions.available_s - decisions.onset_s)
        return decisions._replace(available_s=available_s, onset_s=onset_s)


def _times(time_s: ArrayLike | Tensor | None, num: int) -> Array:
    """Times of the first samples, ``[0]`` to ``[n]``, float64."""
    if time_s is None:
        return np.zeros(0)
    stamps = np.asarray(time_s.detach().cpu() if isinstance(time_s, Tensor) else time_s)
    is_exact = stamps.dtype == np.float64 or stamps.dtype.kind in "iu"
    if not is_exact or stamps.shape not in ((), (num,)):
        raise ValueError(
            f"time_s must be the time of the first sample, or float64 times of all {num}, got "
            f"{stamps.dtype} {stamps.shape}"
        )
    if not np.isfinite(stamps).all():
        raise ValueError("time_s must be finite; leave it out where no time is known")
    return stamps.reshape(-1)[:num].astype(np.float64)


def _joined(parts: list[Decisions]) -> Decisions:
    if len(parts) == 1:
        return parts[0]
    return Decisions(*(torch.cat(entries) for entries in zip(*parts, strict=True)))
