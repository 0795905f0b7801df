"""The step of an even clock and the unit of its stamps, before gaps are known."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

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
