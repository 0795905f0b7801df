"""An even clock laid through timestamps: the rate, and where samples were dropped.

A sample that comes late is no gap if one of the next few makes up for it; what stays late by at
least half a step is one. What to do with a gap is the caller's rule: refuse the file, let the
missing samples be NaN, or draw a straight line across it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from tactslip_torch.data.formats.reading import Samples, Times

GapRule = Literal["refuse", "missing", "bridge"]
GAP_RULES: tuple[str, ...] = get_args(GapRule)
MAKES_UP = 8
"""So many samples may pass until a late one must have been made up for."""
_MOST_TOGETHER = 4
_SPAN = 64
_SHARE_ROUNDED = 0.05
_RATE_ERR = 0.01
_PIECE = 1 << 18


class Gap(NamedTuple):
    """Samples that are missing.

    Args:
        start: number of the first on the even clock.
        missing: how many.
        place: how many samples of the file come before.
    """

    start: int
    missing: int
    place: int


class Clock(NamedTuple):
    """An even clock.

    Args:
        sample_rate_hz: measured, unless it was stated.
        num_samples: on the clock, missing ones included.
        gaps: in order.
        jitter_s: the most by which a sample came later or earlier than its neighbours allow, gaps
            apart.
    """

    sample_rate_hz: float
    num_samples: int
    gaps: tuple[Gap, ...] = ()
    jitter_s: float = 0.0

    @property
    def missing_s(self) -> tuple[tuple[float, float], ...]:
        """Start and end of each gap, seconds from the first sample."""
        rate = self.sample_rate_hz
        return tuple((gap.start / rate, (gap.start + gap.missing) / rate) for gap in self.gaps)


def even_clock(
    times: Times, num_samples: int, stated_hz: float | None = None, name: str = "times"
) -> Clock:
    """The clock of a file's samples, from their timestamps read once by stretches.

    Args:
        times: of the samples.
        num_samples: how many there are, at least 3.
        stated_hz: the rate they are said to have; ``None``: as measured.
        name: of the file, for errors.

    Raises:
        ValueError: if times are not finite, go back, come in bursts, or contradict the rate.
    """
    if num_samples < 3:
        raise ValueError(f"{name} has {num_samples} times, too few to tell a rate")
    step, least = _step(times, num_samples, name)
    if stated_hz is not None and abs(stated_hz * step - 1) > _RATE_ERR:
        raise ValueError(
            f"{name}: its times are {1 / step:.6g} Hz, but {stated_hz:g} Hz is stated; correct "
            "it, or go without the times: reading.time=null"
        )
    gaps: list[Gap] = []
    missing, jitter = 0, 0.0
    for first, steps, seconds in _overlapping(times, num_samples, name):
        late = seconds - step * torch.arange(len(seconds), dtype=torch.float64)
        settled = _settled(late)
        jitter = max(jitter, float((late - settled).abs().max()))
        jumps = settled.diff()[steps]
        jumps = torch.where(jumps.abs() > least, (jumps / step).round(), 0).long()
        for place in jumps.nonzero().flatten().tolist():
            count, before = int(jumps[place]), first + place + 1
            if count < 0:
                raise ValueError(
                    f"{name}: samples {before} and before come {-count} steps closer than "
                    f"{1 / step:.6g} Hz; remove what is there twice, or state the rate and go "
                    "without the times: reading.sample_rate_hz=..., reading.time=null"
                )
            gaps.append(Gap(before + missing, count, before))
            missing += count
    rate = stated_hz if stated_hz is not None else 1 / step
    return Clock(rate, num_samples + missing, tuple(gaps), jitter)


def nominal_rate(measured_hz: float) -> float:
    """The roundest rate within half a percent of a measured one.

    Example:
        >>> nominal_rate(1999.7), nominal_rate(92.31), nominal_rate(0.5)
        (2000.0, 92.0, 0.5)
    """
    for digits in range(6):
        rounded = float(f"{measured_hz:.{digits}e}")
        if abs(rounded / measured_hz - 1) <= 0.005:
            return rounded
    return measured_hz


class EvenSamples:
    """Samples of a file on an even clock; a ``Samples`` itself.

    Args:
        samples: of the file.
        clock: of its times.
        most_bridged: gaps of at most so many samples are crossed by a straight line; others are
            NaN.
    """

    def __init__(self, samples: Samples, clock: Clock, most_bridged: int = 0) -> None:
        self.num_channels, self.num_samples = samples.num_channels, clock.num_samples
        self.dtype = samples.dtype
        self._samples, self._gaps, self._most = samples, clock.gaps, most_bridged
        self._starts = [gap.start for gap in clock.gaps]

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop`` on the clock, ``[C, n]``."""
        first, stop = max(first, 0), min(stop, self.num_samples)
        found = torch.full((self.num_channels, max(stop - first, 0)), torch.nan, dtype=self.dtype)
        place = bisect_right(self._starts, first) - 1
        low = first
        while low < stop:
            gap = self._gaps[place] if place >= 0 else Gap(0, 0, 0)
            inside = min(gap.start + gap.missing, stop)
            if low < inside:
                if gap.missing <= self._most:
                    found[:, low - first : inside - first] = self._line(gap, low, inside)
                low = inside
            high = self._starts[place + 1] if place + 1 < len(self._starts) else self.num_samples
            high = min(high, stop)
            if low < high:
                behind = gap.place - gap.start - gap.missing  # file's number less the clock's
                found[:, low - first : high - first] = self._samples.read(
                    low + behind, high + behind
                )
            low, place = max(low, high), place + 1
        return found

    def _line(self, gap: Gap, low: int, high: int) -> Tensor:
        """The straight line across a gap, at samples ``low`` to before ``high``."""
        ends = self._samples.read(gap.place - 1, gap.place + 1).double()
        share = torch.arange(low, high, dtype=torch.float64) - (gap.start - 1)
        share /= gap.missing + 1
        return (ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * share).to(self.dtype)


def refuse_gaps(clock: Clock, name: str) -> None:
    """Raise if samples are missing.

    Raises:
        ValueError: naming the first gap and the rules that take it.
    """
    if clock.gaps:
        gap, rate = clock.gaps[0], clock.sample_rate_hz
        missing = sum(each.missing for each in clock.gaps)
        raise ValueError(
            f"{name}: {missing} samples are missing in {len(clock.gaps)} gaps, first {gap.missing} "
            f"at {gap.start / rate:.4f} s; give gaps=missing, or gaps=bridge with bridge_ms"
        )


def _step(times: Times, num_samples: int, name: str) -> tuple[float, float]:
    """Seconds from a sample to the next, gaps apart, and what a gap must exceed.

    From at most a piece of the times. Spans of many samples, so that rounded stamps do not round
    the rate; the mean of those near the median span, which hold no gap. Where many samples share
    times, stamps are rounded to some unit, and up to one and a half of it nothing is a gap.
    """
    seconds = times.read(0, min(num_samples, _PIECE)).double()
    steps = _checked_steps(seconds, 0, name)
    forward = steps[steps > 0]
    together = (steps < forward.median() / 4) if len(forward) else steps == 0
    if _longest_run(together) >= _MOST_TOGETHER:
        raise ValueError(
            f"{name}: {_longest_run(together) + 1} samples share a time, as if they came in "
            "bursts; state the rate and go without the times: reading.sample_rate_hz=..., "
            "reading.time=null"
        )
    span = max(min(_SPAN, len(steps) // 8), 1)
    spans = seconds[span:] - seconds[:-span]
    typical = spans.median()
    near = (spans - typical).abs() < 0.5 * typical / span
    step = float(spans[near].mean()) / span
    is_rounded = float((steps == 0).double().mean()) > _SHARE_ROUNDED
    return step, 1.5 * float(forward.min()) if is_rounded else 0.5 * step


def _longest_run(flags: Tensor) -> int:
    """The most flags in a row that are set."""
    edges = torch.nn.functional.pad(flags.int(), (1, 1)).diff()
    starts, stops = (edges == 1).nonzero().flatten(), (edges == -1).nonzero().flatten()
    return int((stops - starts).max()) if len(starts) else 0


def _overlapping(times: Times, num_samples: int, name: str) -> Iterator[tuple[int, slice, Tensor]]:
    """Times in pieces: number of the first own one, which steps are the piece's own, the times.

    On both sides of its own are those that may make up for a late or an early one.
    """
    margin = 2 * MAKES_UP
    for first in range(0, num_samples - 1, _PIECE):
        low = max(first - margin, 0)
        own = min(_PIECE, num_samples - 1 - first)
        seconds = times.read(low, min(first + own + margin, num_samples)).double()
        _checked_steps(seconds, low, name)
        yield first, slice(first - low, first - low + own), seconds


def _settled(late: Tensor) -> Tensor:
    """Lateness without what is made up for in time: late samples first, then early ones.

    A morphological opening and closing, which leave steps that last where they are.
    """
    opened = -_most(-late, behind=False)
    opened = _most(opened, behind=True)
    closed = _most(opened, behind=False)
    return -_most(-closed, behind=True)


def _most(values: Tensor, *, behind: bool) -> Tensor:
    """The most of each value and the next few, or the few behind it."""
    reach = MAKES_UP - 1
    ends = (values[:1].expand(reach), values) if behind else (values, values[-1:].expand(reach))
    return torch.cat(ends).unfold(0, MAKES_UP, 1).amax(-1)


def _checked_steps(seconds: Tensor, first: int, name: str) -> Tensor:
    if not seconds.isfinite().all():
        place = int((~seconds.isfinite()).nonzero()[0])
        raise ValueError(f"{name}: the time of sample {first + place} is {float(seconds[place])}")
    steps = seconds.diff()
    if (steps < 0).any():
        place = int((steps < 0).nonzero()[0])
        raise ValueError(
            f"{name}: time goes back at sample {first + place + 1}, from {float(seconds[place]):g} "
            f"to {float(seconds[place + 1]):g} s; sort the file, or go without: reading.time=null"
        )
    return steps
