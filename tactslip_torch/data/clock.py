"""The even clock behind time stamps: its step, gaps, and the rate.

The step is the common slope of the times between pauses. A sample may come late if the next few
make up for it; what stays late is a gap, as many samples as steps. Stamps may be rounded down to a
unit, even one as long as a step or two, as milliseconds are at 2 kHz.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import grey_closing, grey_opening
from torch import Tensor

from tactslip_torch.data.formats import Samples, Times

GapRule = Literal["refuse", "missing", "bridge"]
GAP_RULES: tuple[str, ...] = get_args(GapRule)

_Numbers = NDArray[np.float64]
_BLOCK = 1 << 18  # times at a time
_PHASE_BLOCK = 1024  # samples of which one phase is kept, to see a drift
_MAKES_UP = 8  # so many samples may pass until a late one must have been made up for
_WINDOW = 64  # samples over which neighbours are compared
_COARSE = 0.45  # units of more than so many steps do not tell the ticks of two samples apart
_SAME = 1e-5  # differences of stamps that are this near, by their median, are one
_BEAT, _FEWEST_BEATS = 0.06, 5  # units that near to a step slip against it, seen so often
_MOST_TOGETHER = 4
_RATE_ERR = 0.01
_OSCILLATOR_ERR = 1e-4  # of three digits at most are what people mean
_FIT_ERR = 2e-6
_SAID_ERR = 1e-5


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
    start = _checked(times, 0, min(num_samples, _BLOCK), name)
    _refuse_bursts(np.diff(start), name)
    step_s, unit_s = _step_of(start - start[0], name)
    if stated_hz is not None and abs(stated_hz * step_s - 1) > _RATE_ERR:
        raise ValueError(
            f"{name}: its times are {1 / step_s:.6g} Hz, but {stated_hz:g} Hz is stated; "
            f"{_unit_hint(stated_hz * step_s)}"
            "correct it, or go without the times: reading.time=null"
        )
    ticks = _Ticks(step_s, unit_s, name)
    for first in range(0, num_samples, _BLOCK):
        low, stop = max(first - 2 * _MAKES_UP, 0), min(first + _BLOCK, num_samples)
        seconds = _checked(times, low, min(stop + 2 * _MAKES_UP, num_samples), name) - start[0]
        ticks.add(seconds, low, first, stop)
    step_s, jitter_s = ticks.fitted()
    rate = stated_hz if stated_hz is not None else 1 / step_s
    return Clock(rate, num_samples + ticks.missing, tuple(ticks.gaps), jitter_s)


def _checked(times: Times, first: int, stop: int, name: str) -> _Numbers:
    """Times in that range.

    Raises:
        ValueError: if one is not finite, or is before the last.
    """
    seconds = times.read(first, stop).double().numpy()
    if not np.isfinite(seconds).all():
        place = int(np.argmin(np.isfinite(seconds)))
        raise ValueError(f"{name}: the time of sample {first + place} is {seconds[place]}")
    steps = np.diff(seconds)
    if (steps < 0).any():
        place = int(np.argmax(steps < 0))
        raise ValueError(
            f"{name}: time goes back at sample {first + place + 1}, from {seconds[place]:g} "
            f"to {seconds[place + 1]:g} s; sort the file, or go without: reading.time=null"
        )
    return seconds


def _refuse_bursts(steps: _Numbers, name: str) -> None:
    forward = steps[steps > 0]
    is_together = steps < np.median(forward) / 4 if len(forward) else steps == 0
    edges = np.diff(is_together.astype(int), prepend=0, append=0)
    longest = max((edges == -1).nonzero()[0] - (edges == 1).nonzero()[0], default=0)
    if longest >= _MOST_TOGETHER or not len(forward):
        raise ValueError(
            f"{name}: {longest + 1} samples share a time, as if they came in "
            "bursts; state the rate and go without the times: reading.sample_rate_hz=..., "
            "reading.time=null"
        )


def _unit_hint(off: float) -> str:
    """What to try if a rate is off by about a unit of time."""
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if abs(off / factor - 1) <= 0.05:
            return f"as if times were in {unit}: reading.time_unit={unit}; or "
    return ""


# The step ----------------------------------------------------------------------------------------


def _unit_of(steps: _Numbers, last: float) -> float:
    """The unit of rounded stamps, seconds: all differences are multiples, and some differ by one.

    0 if there is none. Even times with gaps are multiples too, of their step.
    """
    values = np.sort(steps)
    same = max(_SAME * float(np.median(values[values > 0])), 8 * np.finfo(float).eps * last)
    apart = np.diff(values)
    if not (apart > same).any():
        return 0.0
    unit = float(apart[apart > same].min())
    multiples = steps / unit
    number = np.rint(multiples)
    if (np.abs(multiples - number) * unit > 4 * same).any():
        return 0.0
    near = number < 1e4  # of others rounding in the file weighs too much
    weight = (number[near] ** 2).sum()
    return float((steps[near] * number[near]).sum() / weight) if weight else unit


def _step_of(seconds: _Numbers, name: str) -> tuple[float, float]:
    """From a sample to the next, and the unit if stamps are rounded to one as long; seconds.

    Raises:
        ValueError: if stamps are so coarse that they do not tell what is missing.
    """
    steps = np.diff(seconds)
    unit = _unit_of(steps, float(seconds[-1]))
    step = float(np.median(steps[steps > 0]))
    if unit > _COARSE * float(np.median(steps)):
        whole = _step_between_pauses(seconds, unit)
        if whole is not None:
            return whole, unit
        if _is_regular(steps, unit):
            raise ValueError(
                f"{name}: its times are rounded so coarsely that they do not tell which samples "
                "are missing; state the rate and go without the times: "
                "reading.sample_rate_hz=..., reading.time=null"
            )
        step = unit  # losses come at random, and stamps are not rounded
    for _ in range(3):
        ticks = np.append(0.0, np.rint(steps / step).cumsum())
        step = float(np.polyfit(ticks, seconds, 1)[0])
    return step, 0.0


def _step_between_pauses(seconds: _Numbers, unit_s: float) -> float | None:
    """The common slope between pauses, if nothing but rounding is left around it."""
    steps = np.diff(seconds)
    is_pause = steps > np.quantile(steps, 0.5, method="lower") + 1.5 * unit_s
    run = np.append(0, is_pause.cumsum())
    counts = np.bincount(run)

    def centred(values: _Numbers) -> _Numbers:
        return np.asarray(values - (np.bincount(run, values) / counts)[run])

    number, since = centred(np.arange(len(seconds), dtype=np.float64)), centred(seconds)
    if not (number * number).sum() > 0:
        return None
    step = float((number * since).sum() / (number * number).sum())
    rest = since - step * number
    starts = np.append(0, is_pause.nonzero()[0] + 1)
    spread = float((np.maximum.reduceat(rest, starts) - np.minimum.reduceat(rest, starts)).max())
    slip = abs(step / unit_s - 1)
    is_slipping = slip * counts.max() >= _FEWEST_BEATS or _are_rounded(steps, unit_s)
    is_beat = slip < _BEAT and is_slipping and spread <= 1.2 * unit_s
    width = _width_of(rest)
    is_even = spread <= width + 0.15 * unit_s or (width > 0.3 * unit_s and spread <= 1.2 * unit_s)
    return step if step > 0 and (is_beat or is_even) else None


def _are_rounded(steps: _Numbers, unit_s: float) -> bool:
    """Whether times that are the same show that they are rounded to a unit people use."""
    return _is_decimal(unit_s) and bool((steps < 0.5 * unit_s).any())


def _is_decimal(unit_s: float) -> bool:
    return abs(math.log10(unit_s) - round(math.log10(unit_s))) < 1e-3


def _is_regular(steps: _Numbers, unit_s: float) -> bool:
    """Whether steps of another number of units than most come at regular distances."""
    if not _is_decimal(unit_s) and not (steps < 0.5 * unit_s).any():
        return False
    units = np.rint(steps / unit_s).astype(int)
    apart = np.diff((units != np.bincount(units).argmax()).nonzero()[0])
    return len(apart) >= 2 * _FEWEST_BEATS and bool(apart.std() < 0.6 * apart.mean())


def _width_of(late: _Numbers) -> float:
    """How far apart the lateness of neighbours is where nothing is missing."""
    size = min(_WINDOW, max(len(late) // 8, 2), len(late))
    windows = np.lib.stride_tricks.sliding_window_view(late, size)[::8]
    return float(np.ptp(windows, axis=-1).min())


# Ticks and gaps ----------------------------------------------------------------------------------


class _Ticks:
    """Which tick each sample belongs to, block after block.

    Lateness is how many steps a time is behind its number. Where it changes and stays so, samples
    are missing: as many as the mean behind that place is above the mean before it.
    """

    def __init__(self, step_s: float, unit_s: float, name: str) -> None:
        self.gaps: list[Gap] = []
        self.missing = 0
        self._step_s, self._name = step_s, name
        self._unit = unit_s / step_s
        slip = abs(self._unit - round(self._unit))
        beat = 1 / slip if slip > 2 / _BLOCK else 0.0  # samples until rounding repeats
        self._reach = max(_WINDOW, round(2 * beat))
        self._before = np.empty(0)  # lateness of the samples before, missing ones taken off
        self._jitter, self._sums = 0.0, np.zeros(5)
        self._phases: list[tuple[float, float]] = []

    def add(self, seconds: _Numbers, low: int, first: int, stop: int) -> None:
        """Go on with samples ``first`` to before ``stop``.

        Args:
            seconds: from sample ``low``, with a margin on both sides where there are any.
            low: number of the first of them.
            first: the first sample that is new.
            stop: the first that is left for later.
        """
        late = seconds / self._step_s - np.arange(low, low + len(seconds))
        padded = np.pad(late, _MAKES_UP + 1, mode="edge")
        calm = grey_closing(grey_opening(padded, _MAKES_UP + 1), _MAKES_UP + 1)
        calm = calm[_MAKES_UP + 1 : -_MAKES_UP - 1]
        spread = _width_of(calm)
        if spread > 1 + self._unit:
            raise ValueError(
                f"{self._name}: its times come so unevenly, by up to "
                f"{spread * self._step_s:.3g} s, that missing samples cannot be told from late "
                "ones; state the rate and go without the times: reading.sample_rate_hz=..., "
                "reading.time=null"
            )
        is_change = np.abs(np.diff(calm, prepend=calm[0])) > 0.5 + spread + self._unit
        late, calm, is_change = (x[first - low : stop - low] for x in (late, calm, is_change))
        self._jitter = max(self._jitter, float(np.abs(late - calm).max()))
        missing = np.zeros(len(late))
        corrected = np.append(self._before, calm)
        num_before = len(self._before)
        edges = [0, *is_change.nonzero()[0].tolist(), len(late)]
        for place, until in pairwise(edges):
            at = num_before + place
            if at and is_change[place]:
                level = corrected[max(at - self._reach, 0) : at].mean()
                behind = calm[place : min(until, place + self._reach)].mean()
                self._change(first + place, math.floor(behind - level + 0.4))
            missing[place:until] = self.missing
            corrected[at : num_before + until] -= self.missing
        self._before = corrected[-self._reach :]
        rest, tick = late - missing, np.arange(first, stop) + missing
        self._sums += len(tick), tick.sum(), rest.sum(), (tick * tick).sum(), (tick * rest).sum()
        for place in range(0, len(tick) - _PHASE_BLOCK // 2, _PHASE_BLOCK):
            part = slice(place, place + _PHASE_BLOCK)
            self._phases.append((float(tick[part].mean()), float(rest[part].mean())))

    def _change(self, place: int, missing: int) -> None:
        """From that sample on so many are missing in all.

        Raises:
            ValueError: if these are fewer than before.
        """
        if missing < self.missing:
            raise ValueError(
                f"{self._name}: samples {place} and before come {self.missing - missing} steps "
                f"closer than {1 / self._step_s:.6g} Hz; remove what is there twice, or "
                "state the rate and go without the times: reading.sample_rate_hz=..., "
                "reading.time=null"
            )
        if missing > self.missing:
            self.gaps.append(Gap(place + self.missing, missing - self.missing, place))
            self.missing = missing

    def fitted(self) -> tuple[float, float]:
        """The step by least squares of all times against their ticks, and the jitter, seconds."""
        num, tick, late, tick2, both = self._sums.tolist()
        slope = (both - tick * late / num) / (tick2 - tick * tick / num)
        drift = 0.0
        if self._phases:
            at, phase = np.array(self._phases).T
            rest = phase - slope * at
            drift = float(np.abs(rest - np.median(rest)).max())
        jitter = max(self._jitter, drift if drift > 1 else 0.0)
        return self._step_s * (1 + slope), self._step_s * jitter


# Rates and samples -------------------------------------------------------------------------------


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
        self._samples, self._most = samples, most_bridged
        self._gaps = (Gap(0, 0, 0), *clock.gaps)
        self._starts = [gap.start for gap in self._gaps]

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop`` on the clock, ``[C, n]``."""
        first, stop = max(first, 0), min(stop, self.num_samples)
        found = torch.full((self.num_channels, max(stop - first, 0)), torch.nan, dtype=self.dtype)
        for place in range(bisect_right(self._starts, first) - 1, len(self._gaps)):
            gap = self._gaps[place]
            behind = gap.start + gap.missing  # the first sample that is there again
            following = [*self._starts, self.num_samples][place + 1]
            low, high = max(gap.start, first), min(behind, stop)
            if low < high and gap.missing <= self._most:
                found[:, low - first : high - first] = self._line(gap, low, high)
            low, high = max(behind, first), min(following, stop)
            if low < high:
                shift = gap.place - behind  # file's number less the clock's
                read = self._samples.read(low + shift, high + shift)
                found[:, low - first : high - first] = read
            if following >= stop:
                break
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
