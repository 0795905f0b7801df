"""Which tick of an even clock each sample is, told by the phase that all before it have.

A sample is moved on only if all of the next few allow it, so one that comes late is no gap.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tactslip_torch.data.clock_step import WINDOW, Step, width_of

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
