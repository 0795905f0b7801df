"""The even clock behind time stamps: its step, gaps, and the rate.

The step is the common slope of the times between pauses. A sample may come late if the next few
make up for it; what stays late is a gap, as many samples as steps. Stamps may be rounded down to a
unit, even one as long as a step or two, as milliseconds are at 2 kHz. Times of hours are gone
through in blocks: beside them one array as long is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_closing, grey_opening

from tactslip_torch.runtime import setting

GapRule = Literal["refuse", "missing", "bridge"]

_Numbers = NDArray[np.float64]
_MOST_FOR_STEP = 1 << 18  # times that the step is found from
_BLOCK = 1 << 17  # times that are gone through together, a multiple of the next
_PHASE_BLOCK = 1024  # samples of which one phase is kept, to see a drift
_MAKES_UP = 8  # so many samples may pass until a late one must have been made up for
_WINDOW = 64  # samples over which neighbours are compared
_COARSE = 0.45  # units of more than so many steps do not tell the ticks of two samples apart
_SAME = 1e-5  # differences of stamps that are this near, by their median, are one
_BEAT, _FEWEST_BEATS = 0.06, 5  # units that near to a step slip against it, seen so often
_MOST_TOGETHER = 4
_RATE_ERR = 0.01
_MOST_LOST, _FREE = 10, 1 << 16  # times as many samples may be missing as are there, and so many
_OSCILLATOR_ERR = 1e-4  # of three digits at most are what people mean
_FIT_ERR = 2e-6
_SAID_ERR = 1e-5


class _Gap(NamedTuple):
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
    gaps: tuple[_Gap, ...] = ()
    jitter_s: float = 0.0

    def times(self, per_row: int) -> Clock:
        """The clock of samples of which each of these stands for so many, one after the other."""
        gaps = tuple(_Gap(*(number * per_row for number in gap)) for gap in self.gaps)
        rate_hz = self.sample_rate_hz * per_row
        return Clock(rate_hz, self.num_samples * per_row, gaps, self.jitter_s)


def even_clock(times: _Numbers, stated_hz: float | None = None, name: str = "times") -> Clock:
    """The clock of samples, from their time stamps.

    Args:
        times: of the samples, in seconds, ``[T]``, at least 3.
        stated_hz: the rate they are said to have; ``None``: as measured.
        name: of the file, for errors.

    Raises:
        ValueError: if times are not finite, go back, jump by more than gaps can be, come in bursts,
            contradict the rate, or are too coarse to tell it.
    """
    if len(times) < 3:
        raise ValueError(f"{name} has {len(times)} times, too few to tell a rate")
    if not np.isfinite(times).all():
        place = int(np.argmin(np.isfinite(times)))
        raise ValueError(f"{name}: the time of sample {place} is {times[place]}")
    if (is_back := times[1:] < times[:-1]).any():
        place = int(np.argmax(is_back))
        raise ValueError(
            f"{name}: time goes back at sample {place + 1}, from {times[place]:g} to "
            f"{times[place + 1]:g} s; sort the file, or go without: {setting('reading.time')}=null"
        )
    _refuse_jumps(times, name)
    start = times[:_MOST_FOR_STEP] - times[0]
    _refuse_bursts(np.diff(start), name)
    step_s, unit_s = _step_of(start, name)
    late = _Lateness(times, step_s)
    gaps, jitter = _gaps_in(late, step_s, unit_s / step_s, name)
    slope, drift = _drift_in(late, gaps)
    step_s *= 1 + slope
    if stated_hz is not None and abs(stated_hz * step_s - 1) > _RATE_ERR:
        raise ValueError(
            f"{name}: its times are {1 / step_s:.6g} Hz, but {stated_hz:g} Hz is stated; "
            f"{_unit_hint(stated_hz * step_s)}"
            f"correct it where it is stated: in {setting('reading.sample_rate_hz')} (null takes "
            "the rate of the times), the manifest or the file"
        )
    rate_hz = stated_hz if stated_hz is not None else 1 / step_s
    num_samples = len(times) + sum(gap.missing for gap in gaps)
    return Clock(rate_hz, num_samples, gaps, step_s * max(jitter, drift if drift > 1 else 0.0))


class _Lateness(NamedTuple):
    """How many steps times are behind their numbers, by stretches.

    Args:
        times: in seconds, ``[T]``.
        step_s: from a sample to the next.
    """

    times: _Numbers
    step_s: float

    def of(self, first: int, stop: int) -> _Numbers:
        """Of the times from ``first`` to before ``stop``."""
        seconds = self.times[first:stop] - self.times[0]
        return np.asarray(seconds / self.step_s - np.arange(first, first + len(seconds)))

    def calm(self, first: int, stop: int) -> _Numbers:
        """The same without what is made up for by the next few."""
        beside = 4 * (_MAKES_UP + 1)  # as far as four filters reach
        since, until = max(first - beside, 0), min(stop + beside, len(self.times))
        padded = np.pad(self.of(since, until), _MAKES_UP + 1, mode="edge")
        found = grey_closing(grey_opening(padded, _MAKES_UP + 1), _MAKES_UP + 1)
        found = found[_MAKES_UP + 1 : -_MAKES_UP - 1]
        return np.asarray(found[first - since : stop - since])

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Starts and ends of blocks of all times."""
        for first in range(0, len(self.times), _BLOCK):
            yield first, min(first + _BLOCK, len(self.times))


def _drift_in(late: _Lateness, gaps: Sequence[_Gap]) -> tuple[float, float]:
    """By how much the step is longer, of itself, and the most that phases differ, in steps."""
    places = np.array([gap.place for gap in gaps], dtype=np.int64)
    sums = np.cumsum([0, *(gap.missing for gap in gaps)]).astype(np.float64)

    def ticks_and_rest(first: int, stop: int) -> tuple[_Numbers, _Numbers]:
        numbers = np.arange(first, stop)
        missing: _Numbers = sums[np.searchsorted(places, numbers, side="right")]
        return numbers + missing, late.of(first, stop) - missing

    num = len(late.times)
    totals = np.zeros(2)
    for block in late.blocks():
        totals += [values.sum() for values in ticks_and_rest(*block)]
    mean_tick, mean_rest = totals / num
    products = np.zeros(2)
    for block in late.blocks():
        ticks, rest = ticks_and_rest(*block)
        ticks -= mean_tick
        products += [ticks @ (rest - mean_rest), ticks @ ticks]
    slope = float(products[0] / products[1])
    phases: list[float] = []
    for first, stop in late.blocks():
        ticks, rest = ticks_and_rest(first, stop)
        rest -= slope * ticks
        whole = range(0, min(stop, num - _PHASE_BLOCK // 2) - first, _PHASE_BLOCK)
        phases += [float(rest[place : place + _PHASE_BLOCK].mean()) for place in whole]
    apart = np.abs(np.array(phases) - np.median(phases)) if phases else np.zeros(1)
    return slope, float(apart.max())


def _gaps_in(
    late: _Lateness, step_s: float, unit: float, name: str
) -> tuple[tuple[_Gap, ...], float]:
    """Where samples are missing, and by how many steps one came late that was made up for.

    Where lateness changes and stays so, samples are missing: as many as its mean behind that place
    is above the mean before it.

    Args:
        late: how many steps each time is behind its number.
        step_s: from a sample to the next.
        unit: that stamps are rounded to, in steps.
        name: of the file, for errors.

    Raises:
        ValueError: if late samples cannot be told from missing ones, or samples are there twice.
    """
    level, jitter = np.empty(len(late.times)), 0.0
    for first, stop in late.blocks():
        calm = late.calm(first, stop)
        jitter = max(jitter, float(np.abs(late.of(first, stop) - calm).max()))
        level[first:stop] = calm
    spread = _width_of(level)
    if spread > 1 + unit:
        raise ValueError(
            f"{name}: its times come so unevenly, by up to {spread * step_s:.3g} s, that missing "
            f"samples cannot be told from late ones; {_hint()}"
        )
    slip = abs(unit - round(unit))
    beat = 1 / slip if slip > 2 / _MOST_FOR_STEP else 0.0  # samples until rounding repeats
    reach = max(_WINDOW, round(2 * beat))
    changes: list[int] = []
    for first, stop in late.blocks():
        own = level[max(first - 1, 0) : stop]
        is_change = np.abs(np.diff(own)) > 0.5 + spread + unit
        changes += (is_change.nonzero()[0] + max(first, 1)).tolist()
    gaps: list[_Gap] = []
    total = 0
    for place, until in pairwise([*changes, len(level)]):
        before = level[max(place - reach, 0) : place].mean()  # missing samples taken off
        behind = level[place : min(until, place + reach)].mean()
        missing = math.floor(behind - before + 0.4)
        if missing < total:
            raise ValueError(
                f"{name}: samples {place} and before come {total - missing} steps closer than "
                f"{1 / step_s:.6g} Hz; remove what is there twice, or {_hint()}"
            )
        if missing > total:
            gaps.append(_Gap(place + total, missing - total, place))
            total = missing
        level[place:until] -= total
    return tuple(gaps), jitter


def _refuse_jumps(times: _Numbers, name: str) -> None:
    """Refuse times of which a clock would have mostly missing samples, before it has any."""
    steps = np.diff(times[:_MOST_FOR_STEP])
    forward = steps[steps > 0]
    if not len(forward):
        return  # a burst
    num = (times[-1] - times[0]) / np.median(forward)
    if num > (1 + _MOST_LOST) * len(times) + _FREE:
        place = int(np.argmax(np.diff(times)))
        raise ValueError(
            f"{name}: time jumps at sample {place + 1}, from {times[place]:.9g} to "
            f"{times[place + 1]:.9g} s; cut the file there, or {_hint()}"
        )


def _refuse_bursts(steps: _Numbers, name: str) -> None:
    forward = steps[steps > 0]
    is_together = steps < np.median(forward) / 4 if len(forward) else steps == 0
    edges = np.diff(is_together.astype(int), prepend=0, append=0)
    longest = max((edges == -1).nonzero()[0] - (edges == 1).nonzero()[0], default=0)
    if longest >= _MOST_TOGETHER or not len(forward):
        raise ValueError(
            f"{name}: {longest + 1} samples share a time, as if they came in bursts; {_hint()}"
        )


def _hint() -> str:
    """What to try if the times tell no clock."""
    rate, time = setting("reading.sample_rate_hz"), setting("reading.time")
    return f"state the rate and go without the times: {rate}=..., {time}=null"


def _unit_hint(off: float) -> str:
    """What to try if a rate is off by about a unit of time."""
    for unit, factor in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
        if abs(off / factor - 1) <= 0.05:
            return f"as if times were in {unit}: {setting('reading.time_unit')}={unit}; or "
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
                f"are missing; {_hint()}"
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


# Rates -------------------------------------------------------------------------------------------


def nominal_rate(measured_hz: float, spread: float = 0.0) -> float:
    """The round rate that a measured one is, as far as oscillators and fits are good; or itself.

    Args:
        measured_hz: the rate.
        spread: by what fraction the rates of files that are of one rate differ from it.

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
