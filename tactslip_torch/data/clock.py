"""The even clock behind time stamps: its step, the unit of the stamps, gaps, and the rate."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from tactslip_torch.data.formats import Samples, Times

COARSE = 0.45
"""Stamps of a unit of more than so many steps do not tell the ticks of two samples apart."""
_LONGEST_SPAN = 256
_MOST_SEEN = 8192
_NEAR, _TURNS, _FEWEST = 0.7, 4, 4  # spans without a gap: how near, found how often, how many
_SAME = 1e-5  # differences of stamps that are this near, by their median, are one
WINDOW = 64
"""Samples over which neighbours are compared."""
_BEAT, _FEWEST_BEATS = 0.06, 5  # stamps that near to a step slip against it, seen so often
_OTHER = 1e-4  # by so much the stated rate is not that of the stamps
_PEAK = 4.0  # a periodic component must exceed chance by so much


class Step(NamedTuple):
    """A step.

    Args:
        seconds: from a sample to the next.
        unit_s: to which stamps are rounded; 0 if they are not.
    """

    seconds: float
    unit_s: float

    @property
    def is_coarse(self) -> bool:
        """Whether stamps alone do not tell neighbouring ticks apart."""
        return self.unit_s > COARSE * self.seconds


def step_of(seconds: Tensor, stated_hz: float | None) -> Step | None:
    """The step of times ``[n]``, n >= 3; ``None`` if stamps are too coarse to tell it.

    Args:
        seconds: in order.
        stated_hz: taken where coarse stamps and losses leave several rates possible.
    """
    last = float(seconds.abs().max())
    unit = max(_unit(part.diff(), last) for part in seconds.split(_MOST_SEEN) if len(part) > 2)
    typical = float(seconds.diff().median()) or unit
    if unit <= COARSE * typical:
        return Step(_climbed(seconds, typical), unit)
    whole = _without_losses(seconds, unit)
    if whole is not None:
        return Step(whole, unit)
    if stated_hz is not None and abs(stated_hz * unit - 1) > _OTHER:
        return Step(1 / stated_hz, unit)
    if not _is_regular(seconds.diff(), unit):  # losses come at random, or stamps are not rounded
        return Step(_climbed(seconds, unit), 0.0)
    periodic = _periodic(seconds, unit)
    return None if periodic is None else Step(periodic, unit)


def _unit(steps: Tensor, last: float) -> float:
    """The unit of rounded stamps: all differences are multiples, and some differ by one."""
    values = steps.sort().values
    positive = values[values > 0]
    if not len(positive):
        return 0.0
    same = max(_SAME * float(positive.median()), 8 * torch.finfo(torch.float64).eps * last)
    apart = values.diff()
    is_apart = apart > same
    if not is_apart.any():
        return 0.0
    unit = float(apart[is_apart].min())
    multiples = steps / unit
    if ((multiples - multiples.round()).abs() * unit > 4 * same).any():
        return 0.0
    near = multiples[multiples < 1e4]
    number = near.round()
    return float((near * unit * number).sum() / (number * number).sum()) if number.any() else unit


def _climbed(seconds: Tensor, typical: float) -> float:
    """From the median difference over longer and longer spans of those that hold no gap."""
    own, step, span = seconds[:_MOST_SEEN], typical, 1
    while span <= min(_LONGEST_SPAN, len(own) - 1):
        spans = own[span:] - own[:-span]
        for _ in range(_TURNS):
            whole = spans[(spans / step - span).abs() < _NEAR]
            if len(whole) < _FEWEST and span > 1:
                return step
            step = float(whole.mean()) / span if len(whole) else step
        span *= 2
    return step


def _without_losses(seconds: Tensor, unit: float) -> float | None:
    """The common slope between pauses, if nothing but rounding is left around it."""
    steps = seconds.diff()
    breaks = (steps > float(steps.median()) + 1.5 * unit).nonzero().flatten() + 1
    run = torch.zeros(len(seconds), dtype=torch.long)
    run[breaks] = 1
    run = run.cumsum(0)
    num_runs = int(run[-1]) + 1
    counts = torch.bincount(run, minlength=num_runs).double()

    def centred(values: Tensor) -> Tensor:
        return values - (torch.bincount(run, values, num_runs) / counts)[run]

    number = centred(torch.arange(len(seconds), dtype=torch.float64))
    lasting = centred(seconds)
    if not (number * number).sum() > 0:
        return None
    step = float((number * lasting).sum() / (number * number).sum())
    rest = lasting - step * number
    most = torch.full((num_runs,), -torch.inf, dtype=torch.float64)
    most = most.scatter_reduce(0, run, rest, "amax")
    least = -torch.full_like(most, -torch.inf).scatter_reduce(0, run, -rest, "amax")
    spread, beats = float((most - least).max()), abs(step / unit - 1) * float(counts.max())
    is_beat = abs(step / unit - 1) < _BEAT and beats >= _FEWEST_BEATS and spread <= 1.2 * unit
    is_even = spread <= width_of(rest) + 0.15 * unit
    return step if step > 0 and (is_beat or is_even) else None


def width_of(late: Tensor) -> float:
    """How far apart the lateness of neighbours is where nothing is missing."""
    windows = late.unfold(0, min(WINDOW, max(len(late) // 8, 2)), 1)[::8]
    return float((windows.amax(-1) - windows.amin(-1)).min())


def _is_regular(steps: Tensor, unit: float) -> bool:
    """Whether steps of another number of units than most come at regular distances."""
    is_decimal = abs(math.log10(unit) - round(math.log10(unit))) < 1e-3
    if not is_decimal and not (steps < 0.5 * unit).any():
        return False
    units = (steps / unit).round()
    apart = (units != units.mode().values).nonzero().flatten().diff().double()
    return len(apart) >= 2 * _FEWEST_BEATS and bool(apart.std() < 0.6 * apart.mean())


def _periodic(seconds: Tensor, unit: float) -> float | None:
    """The rate at which ticks are in phase, whatever is lost; of rates that losses leave open."""
    own = seconds[:_MOST_SEEN]
    span = min(16, len(own) - 1)
    least = float((own[span:] - own[:-span]).min())
    low_hz, high_hz = span / (least + unit), span / max(least - unit, 0.25 * least, 1e-12)
    high_hz = min(high_hz, 4 / unit)
    num, is_clear = 256, False
    best_hz = 0.0
    while num <= len(own):
        part = own[:num]
        apart_hz = 0.2 / float(part[-1] - part[0])
        count = min(int((high_hz - low_hz) / apart_hz) + 2, 4096)
        rates = torch.linspace(low_hz, high_hz, count, dtype=torch.float64)
        power = torch.stack(
            [torch.polar(torch.ones_like(part), 6.283185307179586 * r * part).mean() for r in rates]
        ).abs()
        power[(rates * unit - 1).abs() < 12 * unit / float(part[-1] - part[0])] = 0  # stamps' own
        best = int(power.argmax())
        best_hz = float(rates[best])
        is_clear = float(power[best]) * num**0.5 > _PEAK
        if is_clear:
            low_hz, high_hz = best_hz - 4 * apart_hz, best_hz + 4 * apart_hz
        num *= 2
    return 1 / best_hz if is_clear else None


MAKES_UP = 8
"""So many samples may pass until a late one must have been made up for."""
BLOCK = 1024
"""Samples after which the phase is told anew."""
_BLOCKS = 8  # the phase is expected on a line through that of so many blocks
_BEATS = 0.06  # stamps that are so near to whole steps shift against them slowly
_LEAST_EVEN = 0.3  # the mean resultant length of phases, below which they say nothing
_SLACK = 0.05  # steps, where stamps are as coarse as steps


class Ticks:
    """Ticks of samples that come block by block.

    Args:
        step: of the clock, and the unit of its stamps.
        seconds: the first times, ``[n]``, to tell the phase from.
    """

    def __init__(self, step: Step, seconds: Tensor) -> None:
        self.step, self.missing = step, 0
        late = _lateness(step, seconds, 0)
        width = step.unit_s / step.seconds
        beats = abs(width - max(round(width), 1)) * len(seconds)
        if not (1 < beats < _BEATS * len(seconds)):
            width = min(width, width_of(late))
        self._half = max(0.5, width / 2 + _SLACK)
        start = late[:WINDOW]
        turned = torch.polar(torch.ones_like(start), 2 * math.pi * start).mean()
        if step.is_coarse:
            self._phase = float(start.min()) + width / 2
            if width < 1:
                self._phase = _near(_opposite(late[:BLOCK]), self._phase)
        elif float(turned.abs()) > _LEAST_EVEN:
            self._phase = _near(float(turned.angle()) / (2 * math.pi), float(start[0]))
        else:
            self._phase = float(start.median())
        self._evenness = 0.0
        self.places: list[float] = []
        self.phases: list[float] = []
        self._sums = torch.zeros(5, dtype=torch.float64)

    def take(self, seconds: Tensor, first: int, own: slice) -> tuple[Tensor, Tensor, int]:
        """How many ticks are missing before each of a block's own samples.

        Args:
            seconds: of the block and of up to ``MAKES_UP`` samples on either side, ``[n]``.
            first: number of the first of these.
            own: which are the block's.

        Returns:
            Missing ticks ``[m]``, the lateness of own samples in steps ``[m]``, and the place of
            the first own sample that comes more than a step early and lastingly, or -1.
        """
        late = _lateness(self.step, seconds, first)
        number = torch.arange(first, first + len(seconds), dtype=torch.float64)
        off = late - self._expected(number)
        least = (off - self._half - 1e-9).ceil()
        most = (closed(off) + self._half + 1e-9).floor()
        least = torch.minimum(least, (settled(off) + self._half + 1e-9).floor())[own]
        start = torch.tensor([float(self.missing)], dtype=torch.float64)
        missing = torch.cat([start, least]).cummax(0).values[1:]
        most[len(most) - MAKES_UP + 1 :] = torch.inf  # nothing can make up for the last
        early = (missing > most[own]).nonzero()
        rest = late[own] - missing
        self._follow(number[own], rest, missing)
        self.missing = int(missing[-1])
        return missing.long(), rest, int(early[0]) if len(early) else -1

    def fitted_s(self) -> float:
        """The step by least squares of all times against their ticks."""
        num, tick, late, tick2, both = self._sums.tolist()
        spread = tick2 - tick * tick / num
        return float(self.step.seconds * (1 + (both - tick * late / num) / spread))

    @property
    def is_uneven(self) -> bool:
        """Whether samples come at any phase, so that one tick cannot be told from the next."""
        return not self.step.is_coarse and self._evenness < _LEAST_EVEN * float(self._sums[0])

    def drift(self, step_s: float) -> float:
        """By how many steps the phase leaves a straight line of that step, at the most."""
        places = torch.tensor(self.places, dtype=torch.float64)
        slope = step_s / self.step.seconds - 1
        rest = torch.tensor(self.phases, dtype=torch.float64) - slope * places
        return float((rest - rest.median()).abs().max()) if len(rest) else 0.0

    def _expected(self, number: Tensor) -> Tensor:
        """The phase that the last blocks let expect."""
        places, phases = self.places[-_BLOCKS:], self.phases[-_BLOCKS:]
        if len(places) < 3:
            return torch.full_like(number, phases[-1] if phases else self._phase)
        at = torch.tensor(places, dtype=torch.float64)
        was = torch.tensor(phases, dtype=torch.float64)
        mid = at.mean()
        slope = ((at - mid) * was).sum() / ((at - mid) ** 2).sum()
        return was.mean() + slope * (number - mid)

    def _follow(self, number: Tensor, rest: Tensor, missing: Tensor) -> None:
        tick = number + missing
        self._evenness += float(torch.cos(2 * math.pi * (rest - self._expected(number))).sum())
        self._sums += torch.stack(
            [
                torch.tensor(float(len(tick)), dtype=torch.float64),
                tick.sum(),
                rest.sum(),
                (tick * tick).sum(),
                (tick * rest).sum(),
            ]
        )
        if len(number) >= BLOCK // 2:
            expected = self._expected(number)
            reach = self._half + 0.5
            kept = expected + (rest - expected).clamp(-reach, reach)
            self.places.append(float(number.mean()))
            self.phases.append(float(kept.mean()))


def _opposite(late: Tensor) -> float:
    """The phase opposite to the middle of the longest arc where none is."""
    part = (late - late.floor()).sort().values
    arcs = torch.cat([part, part[:1] + 1]).diff()
    longest = int(arcs.argmax())
    return float(part[longest]) + float(arcs[longest]) / 2 + 0.5


def _near(part: float, value: float) -> float:
    """The phase with that fractional part that is nearest to a value."""
    return part + round(value - part)


def closed(values: Tensor) -> Tensor:
    """Values without dips of less than ``MAKES_UP`` samples (a morphological closing)."""
    return -_most(-_most(values, behind=False), behind=True)


def settled(late: Tensor) -> Tensor:
    """Lateness without what is made up for in time: late samples first, then early ones."""
    return closed(-closed(-late))


def _lateness(step: Step, seconds: Tensor, first: int) -> Tensor:
    """By how many steps each time is later than its number says."""
    number = torch.arange(first, first + len(seconds), dtype=torch.float64)
    return seconds / step.seconds - number


def _most(values: Tensor, *, behind: bool) -> Tensor:
    """The most of each value and the next few, or the few behind it."""
    ends = torch.full((MAKES_UP - 1,), -torch.inf, dtype=values.dtype)
    return torch.cat((ends, values) if behind else (values, ends)).unfold(0, MAKES_UP, 1).amax(-1)


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
