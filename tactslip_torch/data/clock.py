"""An even clock laid through timestamps: the rate, and where samples were dropped.

A sample that comes late is no gap if one of the next few makes up for it; what stays late by more
than half a step, or than stamps are rounded, is one. What to do with a gap is the caller's rule:
refuse the file, let the missing samples be NaN, or draw a straight line across it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from tactslip_torch.data.clock_step import step_of
from tactslip_torch.data.clock_ticks import BLOCK, MAKES_UP, Ticks, settled
from tactslip_torch.data.formats import Samples, Times

GapRule = Literal["refuse", "missing", "bridge"]
GAP_RULES: tuple[str, ...] = get_args(GapRule)
_MOST_TOGETHER = 4
_RATE_ERR = 0.01
_FEW_GAPS = 1e-3
_OSCILLATOR_ERR = 1e-4  # of three digits at most are what people mean
_FIT_ERR = 2e-6
_SAID_ERR = 1e-5
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
    """The clock of a file's samples, from their timestamps read by stretches.

    Args:
        times: of the samples.
        num_samples: how many there are, at least 3.
        stated_hz: the rate they are said to have; ``None``: as measured.
        name: of the file, for errors.

    Raises:
        ValueError: if times are not finite, go back, come in bursts, contradict the rate, or are
            too coarse to tell it.
    """
    if num_samples < 3:
        raise ValueError(f"{name} has {num_samples} times, too few to tell a rate")
    start = times.read(0, min(num_samples, _PIECE)).double()
    start = start - start[0]
    _refuse_bursts(_checked_steps(start, 0, name), name)
    step = step_of(start, stated_hz)
    if step is None:
        raise ValueError(
            f"{name}: its times are rounded so coarsely and so many samples are missing that they "
            "tell no rate; state it: reading.sample_rate_hz=..."
        )
    if stated_hz is not None and abs(stated_hz * step.seconds - 1) > _RATE_ERR:
        raise ValueError(
            f"{name}: its times are {1 / step.seconds:.6g} Hz, but {stated_hz:g} Hz is stated; "
            f"{_unit_hint(stated_hz * step.seconds)}"
            "correct it, or go without the times: reading.time=null"
        )
    ticks = Ticks(step, start)
    del start
    gaps: list[Gap] = []
    jitter = 0.0
    for first, own, seconds in _blocks(times, num_samples, name):
        before = ticks.missing
        missing, rest, early = ticks.take(seconds, first, own)
        if early >= 0:
            coarse = "its stamps may be too coarse for its losses: " if step.is_coarse else ""
            raise ValueError(
                f"{name}: samples {first + own.start + early} and before come 1 steps closer than "
                f"{1 / step.seconds:.6g} Hz; {coarse}remove what is there twice, or state the rate "
                "and go without the times: reading.sample_rate_hz=..., reading.time=null"
            )
        jumps = missing.diff(prepend=torch.tensor([before]))
        for place in jumps.nonzero().flatten().tolist():
            count, at = int(jumps[place]), first + own.start + place
            gaps.append(Gap(at + int(missing[place]) - count, count, at))
        jitter = max(jitter, float((rest - settled(rest)).abs().max()))
    if ticks.is_uneven and len(gaps) > num_samples * _FEW_GAPS:
        raise ValueError(
            f"{name}: its times come so unevenly, by up to {jitter * step.seconds:.3g} s, that "
            "missing samples cannot be told from late ones; state the rate and go without the "
            "times: reading.sample_rate_hz=..., reading.time=null"
        )
    step_s = ticks.fitted_s()
    drift = ticks.drift(step_s)
    rate = stated_hz if stated_hz is not None else 1 / step_s
    jitter_s = step.seconds * max(jitter, drift if drift > 1 else 0.0)
    return Clock(rate, num_samples + ticks.missing, tuple(gaps), jitter_s)


def nominal_rate(measured_hz: float, spread: float = 0.0) -> float:
    """The round rate that a measured one is, as far as oscillators and fits are good; or itself.

    Args:
        measured_hz: the rate.
        spread: by what share the rates of files that are of one rate differ from it.

    Example:
        >>> nominal_rate(1999.97), nominal_rate(1024.0), nominal_rate(92.31), nominal_rate(1017.25)
        (2000.0, 1024.0, 92.31, 1017.25)
    """
    coarse = max(_OSCILLATOR_ERR, spread)
    candidates = [(2.0 ** round(math.log2(measured_hz)), coarse)]
    for digits in range(7):
        candidates.append((float(f"{measured_hz:.{digits}e}"), coarse if digits < 3 else _FIT_ERR))
    for rounded, err in candidates:
        if abs(rounded / measured_hz - 1) <= err:
            return rounded
    return measured_hz


def snapped_rate(rate_hz: float) -> float:
    """A rate that is said, without an error of less than 1e-5 that some program left in it.

    Example:
        >>> snapped_rate(24.00000322), snapped_rate(92.31), snapped_rate(1e6 / 3)
        (24.0, 92.31, 333333.3333333333)
    """
    plain = float(f"{rate_hz:.4g}")
    return plain if abs(plain / rate_hz - 1) < _SAID_ERR else rate_hz


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


def _refuse_bursts(steps: Tensor, name: str) -> None:
    forward = steps[steps > 0]
    together = (steps < forward.median() / 4) if len(forward) else steps == 0
    if _longest_run(together) >= _MOST_TOGETHER:
        raise ValueError(
            f"{name}: {_longest_run(together) + 1} samples share a time, as if they came in "
            "bursts; state the rate and go without the times: reading.sample_rate_hz=..., "
            "reading.time=null"
        )


def _unit_hint(off: float) -> str:
    """What to try if a rate is off by about a unit of time."""
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if abs(off / factor - 1) <= 0.05:
            return f"as if times were in {unit}: reading.time_unit={unit}; or "
    return ""


def _longest_run(flags: Tensor) -> int:
    """The most flags in a row that are set."""
    edges = torch.nn.functional.pad(flags.int(), (1, 1)).diff()
    starts, stops = (edges == 1).nonzero().flatten(), (edges == -1).nonzero().flatten()
    return int((stops - starts).max()) if len(starts) else 0


def _blocks(times: Times, num_samples: int, name: str) -> Iterator[tuple[int, slice, Tensor]]:
    """Times by blocks: number of the first time, which are the block's own, times from the first.

    On both sides of its own are those that may make up for a late or an early one.
    """
    margin = 2 * MAKES_UP
    start_s = times.read(0, 1).double()
    for piece in range(0, num_samples, _PIECE):
        low = max(piece - margin, 0)
        stop = min(piece + _PIECE, num_samples)
        seconds = times.read(low, min(stop + margin, num_samples)).double()
        _checked_steps(seconds, low, name)
        seconds = seconds - start_s
        for first in range(piece, stop, BLOCK):
            near = max(first - margin, 0)
            own = slice(first - near, min(first + BLOCK, stop) - near)
            yield near, own, seconds[near - low : near - low + own.stop + margin]


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
