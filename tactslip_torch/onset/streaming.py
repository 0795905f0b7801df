"""``StreamingDetector``: samples in as they come, decisions and alarms out as soon as they can be.

The same mathematics as ``score_stream`` and ``Decider`` on the whole recording, at the look-ahead
of the detector and with a memory of fixed size: raw samples of one bin and its context. From them
to the scores it is one call of the native engine, where that can be used.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tactslip_torch.features.sensing import StuckChannels, level_message, level_ratio
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.prediction import ChannelMask, Prediction, masked_names
from tactslip_torch.onset.decisions import AlarmSettings, Decider, Decisions, joined_decisions
from tactslip_torch.onset.evidence import OnsetStream
from tactslip_torch.signals.filtering import past_of

_LOG = logging.getLogger(__name__)
_NUMPY = {torch.float32: np.float32, torch.float64: np.float64}
Array = NDArray[Any]


_LEVELS_S = 2.0  # of stream, from which levels at rest are taken
_MOST_EVENTS = 1000  # that wait


class StreamEvent(NamedTuple):
    """Something that happened to a hand.

    Attributes:
        time_s: when it was known.
        text: one line for people.
    """

    time_s: float
    text: str


class StreamingDetector:
    """A detector that watches a stream without end.

    All pushes and the final ``flush`` together return the decisions that ``score_stream`` and a
    ``Decider`` make of the whole recording; scores are equal to rounding, whatever the size of the
    pushes. A decision needs the samples of its bin and ``look_ahead`` more, and is returned by the
    push that brings the last of them. Not for several threads at once.

    **Missing samples** are NaN, or masked (``numpy.ma``). Two more count as missing: a gap in the
    times of samples, up to ``settings.hold_s``, and a channel that keeps one value for too long.
    Decisions that need missing samples of a channel are made without it. With too few channels they
    are not valid, and do not change the rule (``features.sensing``). A longer gap ends the stream,
    as ``flush`` does, and begins another, from decision number 0; ``num_gaps`` counts them, and the
    log warns, but not again before a decision.

    Args:
        detector: fitted on this hand.
        settings: hop, calibration, rule and threshold; by default those in the detector's file.
        dtype: of the samples, float32 or float64, and of the scores; what is pushed is converted.
        masked_channels: names of channels to leave out.

    Attributes:
        num_gaps: longer gaps since it was made or reset.
        masked_channels: channels that count as missing whatever they say, in the order of the
            hand; may be set at any time, for all decisions that are still to be made.

    Raises:
        ValueError: if the detector has no settings, the dtype is another or the hand has no such
            channel.

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
    ) -> None:
        if dtype not in _NUMPY:
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        pool = detector.pool
        self.detector = detector
        self.settings = AlarmSettings.of(detector) if settings is None else settings
        self.dtype = dtype
        self.num_gaps = 0
        self._events = deque[StreamEvent](maxlen=_MOST_EVENTS)
        self.masked_channels = masked_names(masked_channels, pool.hand.names)
        self._clock = _SampleClock(pool.sample_rate_hz)
        self._max_gap = round(self.settings.hold_s * pool.sample_rate_hz)
        self._wide = pool.widen(torch.empty(0, dtype=dtype)).dtype
        lengths = detector.channel_filter.window_lengths
        self._frame = max(lengths[channel] for channel in detector.needed_index.tolist())
        self._before = detector.context_before
        self._whole = self._before + pool.bin_samples + detector.context_after
        self._first = pool.bin_samples + detector.look_ahead
        self._sensing = self.settings.sensing(detector.sensing)
        reaches = detector.channel_filter.reaches
        self._decider = Decider(
            self.settings,
            pool.sample_rate_hz,
            pool.bin_samples,
            detector.look_ahead,
            self._frame,
            context_before=max(reaches[c][0] for c in detector.needed_index.tolist()),
            channels=pool.hand.names,
            end_s=self._clock.end_s,
        )
        self._start()

    def __repr__(self) -> str:
        seen_s = self._clock.num_samples / self._clock.sample_rate_hz
        return (
            f"StreamingDetector({seen_s:.3f} s of {len(self.detector.pool.hand)} channels so far, "
            f"look-ahead {1e3 * self.look_ahead_s:g} ms, {self.settings!r})"
        )

    @property
    def masked_channels(self) -> tuple[str, ...]:
        """Channels that are left out, in the order of the hand."""
        return self._masked_channels

    @masked_channels.setter
    def masked_channels(self, masked_channels: ChannelMask) -> None:
        names = self.detector.pool.hand.names
        self._masked_channels = masked_names(masked_channels, names)
        is_masked = torch.tensor([name in self._masked_channels for name in names])
        self._mask = is_masked if self._masked_channels else None

    @property
    def look_ahead_s(self) -> float:
        """Time from the end of a bin to its decision."""
        return self.detector.look_ahead / self._clock.sample_rate_hz

    @property
    def bin_s(self) -> float:
        """Length of a bin."""
        return self.detector.pool.bin_samples / self._clock.sample_rate_hz

    @property
    def hop_s(self) -> float:
        """Time between two decisions."""
        return self.settings.decision_samples / self._clock.sample_rate_hz

    @property
    def state_bytes(self) -> int:
        """Memory of the samples that are remembered."""
        return int(self._held.nbytes) + (self._onset.state_bytes if self._onset else 0)

    def push(
        self, samples: ArrayLike | Tensor, time_s: ArrayLike | Tensor | None = None
    ) -> Decisions:
        """The decisions that these samples make possible; copied, so their memory may be reused.

        Args:
            samples: what came next, in volts.
            time_s: when the first sample was taken, or each, in seconds; on one clock, good to a
                quarter of a sample. Without, samples follow the last ones, and the first of all is
                at 0.

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
        return joined_decisions(parts)

    def flush(self) -> Decisions:
        """The decisions still waiting for their look-ahead, as at the end of a recording.

        Then as ``reset``. ``available_s`` is when they would have been there, had it gone on.
        """
        detector, num_samples = self.detector, self._clock.num_samples
        decisions = self._nothing
        last_start = num_samples - detector.pool.bin_samples
        if num_samples >= self._frame and last_start >= self._number * self.settings.hop_samples:
            ends = torch.from_numpy(self._held[:, -self._frame :]).flip(-1)
            future = past_of(ends, detector.channel_filter, detector.needed_index.tolist())
            if self._onset is None:  # else every decision is there with its last sample
                self._append(future.flip(-1)[:, : detector.context_after].numpy())
                decisions = self._decide(last_start)
        self._start()
        return decisions

    def take_events(self) -> list[StreamEvent]:
        """What happened to the hand since the last call, for people to read.

        Decisions that are not valid for longer than ``settings.hold_s``, and valid again; channels
        that are lost for longer than that, and back; levels that are far from those of training.
        """
        events = list(self._events)
        self._events.clear()
        return events

    def reset(self) -> None:
        """Forget the stream; the next sample is the first of another, at 0 unless it has a time."""
        self.num_gaps = 0
        self._start()

    def _start(self) -> None:
        self._clock.reset()
        self._decider.reset()
        self._held = np.empty((len(self.detector.pool.hand), 0), _NUMPY[self._wide])
        self._stuck = StuckChannels(self.detector.sensing.stuck_samples)
        self._hand_events = _HandEvents(self.detector, self.settings, self._events)
        self._start_of_held = 0  # its first sample's place in the stream
        self._number = 0  # of the next decision on a bin
        onset, backend = self.settings.onset, self.detector.extractor.backend
        self._onset = None if onset is None else OnsetStream(onset, self._max_gap, backend)
        self._no_bins = self._nothing = self._decide(-1)
        if self._onset is not None:
            self._nothing = self._decider.join(self._no_bins, torch.empty(0, dtype=torch.float64))

    def _read(self, samples: ArrayLike | Tensor) -> Array:
        """Samples ``[n, C]`` as a copy ``[C, n]`` in the stream's dtype."""
        if isinstance(samples, Tensor):  # NumPy does not know all of their dtypes
            kind = self.dtype if samples.is_floating_point() else samples.dtype
            samples = samples.detach().to("cpu", kind).numpy()
        elif isinstance(samples, np.ma.MaskedArray) and samples.dtype.kind == "f":
            samples = samples.filled(np.nan)
        array, names = np.asarray(samples), self.detector.pool.hand.names
        if array.ndim != 2 or array.shape[1] != len(names):
            raise ValueError(
                f"expected samples [n, {len(names)}] (instants, channels {names[0]} to "
                f"{names[-1]}), got {array.shape}"
            )
        if array.dtype.kind != "f":
            raise ValueError(f"expected samples in volts, floating numbers, got {array.dtype}")
        with np.errstate(over="ignore"):  # beyond float32 is Inf, which is flagged
            return np.array(array.T, _NUMPY[self.dtype], order="C")

    def _begin_anew(self, time_s: float) -> Decisions:
        """Another stream behind a gap."""
        if self._number or not self.num_gaps:  # not of each sample, where times are no seconds
            text = "the stream begins anew at %.4f s, behind a gap (time_s is in seconds)"
            _LOG.warning(text, time_s)
        decisions = self.flush()
        self.num_gaps += 1
        return decisions

    def _fill(self, x: Array, missing: Array, times_s: Array) -> Decisions:
        """Take samples, the first of which have times, with NaN for those missing before each."""
        places = np.arange(x.shape[-1])
        places[: len(missing)] += missing.cumsum()
        places[len(missing) :] += missing.sum()
        if missing.any():
            full = np.full((len(x), int(places[-1]) + 1), np.nan, x.dtype)
            full[:, places] = x
            x = full
        return self._take(x, places[: len(missing)], times_s)

    def _take(self, x: Array, places: Array, times_s: Array) -> Decisions:
        """Filter and decide, once the next decision has all its samples."""
        x = self._stuck(x)
        self._clock.take(x.shape[-1], places, times_s)
        self._append(x)
        num_samples, start = self._clock.num_samples, self._number * self.settings.hop_samples
        bins = self._no_bins
        if num_samples >= max(start + self._first, self._frame):
            bins = self._decide(num_samples - self._first)
        if self._onset is None:
            return bins
        with torch.no_grad():
            score = self._onset.push(torch.from_numpy(x), self._mask)
        if not len(score) and not len(bins.number):
            return self._nothing
        return self._decider.join(bins, score)

    def _append(self, x: Array) -> None:
        self._held = np.concatenate([self._held, x], -1, dtype=self._held.dtype)

    def _drop(self) -> None:
        """Forget what is before the next bin and is no longer needed."""
        kept = max(self._before, self._frame)
        start = self._number * self.settings.hop_samples - kept
        surplus = min(start - self._start_of_held, self._held.shape[-1])
        if surplus > 0:
            self._held = self._held[:, surplus:].copy()  # a view would keep all of it
            self._start_of_held += surplus

    def _decide(self, last_start: int) -> Decisions:
        """The decisions on bins that begin no later than this sample."""
        detector, hop, whole = self.detector, self.settings.hop_samples, self._whole
        count = last_start // hop + 1 - self._number
        if count <= 0:
            none = torch.empty(0, dtype=self.dtype)
            lost = none.new_zeros(0, len(detector.pool.hand)).bool()
            return self._decider.decide(none, none.bool(), none.bool(), lost)
        with torch.no_grad():
            if self._number == 0 and self._start_of_held == 0:
                first = torch.from_numpy(self._held)
                past = past_of(first, detector.channel_filter, detector.needed_index.tolist())
                self._held = np.concatenate([past.numpy(), self._held], -1)
                self._start_of_held = -self._before
            start = self._number * hop - self._before - self._start_of_held
            stop = start + (count - 1) * hop + whole
            held = self._held[:, start:stop]
            padded = np.zeros((len(held), stop - start), held.dtype)
            padded[:, : held.shape[-1]] = held  # behind it no channel in use looks
            windows = torch.from_numpy(padded).unfold(-1, whole, hop).transpose(0, 1)
            found = detector.predict_raw(
                windows, given=self.dtype, masked_channels=self._masked_channels or None
            )
            if self.settings.levels is not None:
                found = found.in_range_of(self._sensing, detector.counted)
            decisions = self._decider.decide(*found[:-1])
            self._hand_events.take(found, decisions)
        self._number += count
        self._drop()
        return decisions


class _SampleClock:
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
        if not self.is_timed:
            return num_samples / self.sample_rate_hz
        last = np.searchsorted(self._places, num_samples - 1, side="right") - 1
        since = num_samples - self._places[last]
        end_s: Array = self._times_s[last] + since / self.sample_rate_hz
        return end_s


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


class _HandEvents:
    """Reports what happens to the channels of a stream (``StreamingDetector.take_events``)."""

    def __init__(
        self, detector: SlipDetector, settings: AlarmSettings, events: deque[StreamEvent]
    ) -> None:
        rate_hz, hop = detector.pool.sample_rate_hz, settings.hop_samples
        self._detector, self._events = detector, events
        self._hold = max(round(settings.hold_s * rate_hz) // hop, 1)  # decisions
        self._spans: list[Tensor] | None = []
        self._num_spans = max(round(_LEVELS_S * rate_hz) // hop, 1)
        # which channels are lost and, behind them, whether decisions are not valid
        self._reported = np.zeros(len(detector.pool.hand) + 1, bool)
        self._changed = np.zeros(len(self._reported), np.int64)  # decisions in a row

    def take(self, found: Prediction, decisions: Decisions) -> None:
        """What is found of the next bins."""
        time_s = decisions.available_s.tolist()
        if self._spans is not None:
            self._spans.append(found.span)
            if sum(map(len, self._spans)) >= self._num_spans:
                ratio = level_ratio(torch.cat(self._spans), self._detector.sensing)
                text = level_message(ratio, self._detector.info.get("units", "V"))
                self._events.extend([StreamEvent(time_s[-1], text)] if text else [])
                self._spans = None
        if found.is_valid.all() and not found.channels_lost.any() and not self._reported.any():
            self._changed[:] = 0
            return
        states = np.concatenate([found.channels_lost, ~found.is_valid[:, None]], 1)
        for own_s, state in zip(time_s, states, strict=True):
            self._changed = np.where(state != self._reported, self._changed + 1, 0)
            if (is_new := self._changed > self._hold).any():
                self._report(own_s, state, is_new)
                self._reported[is_new], self._changed[is_new] = state[is_new], 0

    def _report(self, time_s: float, state: Array, is_new: Array) -> None:
        names, texts = self._detector.pool.hand.names, []
        if is_new[-1]:
            lost = f"not valid: {listed(names, state[:-1])} lost"
            texts.append(f"decisions are {lost if state[-1] else 'valid again'}")
        for is_lost, what in ((True, "lost"), (False, "back")):
            if (which := is_new[:-1] & (state[:-1] == is_lost)).any():
                texts.append(f"channels {what}: {listed(names, which)}")
        self._events.extend(StreamEvent(time_s, text) for text in texts)


def listed(names: Sequence[str], which: Array, most: int = 6) -> str:
    """Names of the channels in a mask, not too many: ``"A, B and 5 more"``."""
    own = [name for name, is_one in zip(names, which, strict=True) if is_one]
    if len(own) == len(names) > 1:
        return f"all {len(names)} channels"
    rest = f" and {len(own) - most} more" if len(own) > most else ""
    return ", ".join(own[:most]) + rest
