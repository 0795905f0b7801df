"""Numbers of a set of recordings, each between what draws of these recordings say of it.

The bootstrap over recordings: draws of as many recordings with replacement, since what happens
within one hangs together. All draws of a number are one matrix product or one search.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypedDict

import torch
from torch import Tensor


class Number(TypedDict):
    """A number and its interval; the ends are None where one recording alone says nothing of it."""

    value: float
    low: float | None
    high: float | None


class Draws(NamedTuple):
    """How recordings are drawn.

    Args:
        level: of the intervals, whose ends are percentiles.
        num: how many draws.
        seed: of the draws.
    """

    level: float = 0.95
    num: int = 1000
    seed: int = 0


class Resampled:
    """A set of recordings and its draws.

    An interval always holds its value. For shares and rates the score interval of independent
    events is taken where it reaches further: no miss among a few slips is no proof of none.

    Args:
        num_recordings: in the set.
        draws: how they are drawn.

    Raises:
        ValueError: if the level is not between 0 and 1, or nothing is to be drawn.

    Reference:
        Efron and Tibshirani (1993), An Introduction to the Bootstrap, chapters 8 and 13. Wilson
        (1927), J. Am. Stat. Assoc. 22, 209-212, and its form for a Poisson count.
    """

    def __init__(self, num_recordings: int, draws: Draws) -> None:
        if not (0 < draws.level < 1 and draws.num >= 1):
            raise ValueError(
                f"an interval needs a level between 0 and 1 and at least one draw, got {draws}"
            )
        generator = torch.Generator().manual_seed(draws.seed)
        shape = (draws.num, num_recordings)
        drawn = torch.randint(max(num_recordings, 1), shape, generator=generator)
        tail = (1 - draws.level) / 2
        self._ends = torch.tensor([tail, 1 - tail], dtype=torch.float64)
        self._z = float(torch.special.ndtri(self._ends[1]))
        self._times = torch.zeros(shape, dtype=torch.float64)  # how often each is in each draw
        self._times.scatter_add_(1, drawn, torch.ones_like(self._times))

    def share(self, parts: Sequence[float], wholes: Sequence[float]) -> Number | None:
        """Sum of parts, of which each is within its whole, by sum of wholes; None of nothing."""
        return self._ratio(parts, wholes, 1.0, _share_end)

    def rate(
        self, counts: Sequence[float], times: Sequence[float], per: float = 1.0
    ) -> Number | None:
        """Counts in so much time, for ``per`` units of it; None of no time."""
        return self._ratio(counts, times, per, _rate_end)

    def mean(self, sums: Sequence[float], numbers: Sequence[float]) -> Number | None:
        """Sum of sums by sum of numbers; None of nothing."""
        return self._ratio(sums, numbers, 1.0, None)

    def quantiles(self, values: Tensor, recording: Tensor, shares: Sequence[float]) -> list[Number]:
        """Quantiles of values, linear between neighbours, each value drawn with its recording.

        Shape:
            - values, recording: ``[N]``, N at least 1; recording is a number below that of the set
        """
        order = values.argsort()
        ordered = values[order]
        reached = self._times[:, recording[order]].cumsum(1)  # [draws, N], values up to each
        last = reached[:, -1:] - 1  # place of the last one drawn, -1 where none is
        numbers = []
        for share in shares:
            place = share * last
            low, high = (
                ordered[torch.searchsorted(reached, at, right=True).clamp(max=len(ordered) - 1)]
                for at in (place.floor(), place.ceil())
            )
            drawn = low + (place - place.floor()) * (high - low)
            drawn = torch.where(last < 0, torch.nan, drawn)[:, 0]
            numbers.append(self._between(float(ordered.quantile(share)), drawn, recording))
        return numbers

    def average(self, values: Tensor, recording: Tensor) -> Number:
        """Mean of values; shapes as of ``quantiles``."""
        times = self._times[:, recording]
        return self._between(float(values.mean()), times @ values / times.sum(1), recording)

    def deviation(self, values: Tensor, recording: Tensor) -> Number:
        """Standard deviation of values, of the population; shapes as of ``quantiles``."""
        away = values - values.mean()
        powers = torch.stack([torch.ones_like(away), away, away**2])  # [3, N]
        count, first, second = (self._times[:, recording] @ powers.T).T
        drawn = (second / count - (first / count) ** 2).clamp(min=0).sqrt()
        return self._between(float(away.square().mean().sqrt()), drawn, recording)

    def _ratio(
        self,
        parts: Sequence[float],
        wholes: Sequence[float],
        per: float,
        end: Callable[[float, float, float], float] | None,
    ) -> Number | None:
        part, whole = math.fsum(parts), math.fsum(wholes)
        if not whole > 0:
            return None
        sums = self._times @ torch.tensor([parts, wholes], dtype=torch.float64).T  # [draws, 2]
        having = torch.tensor(wholes).nonzero()
        number = self._between(per * part / whole, per * sums[:, 0] / sums[:, 1], having)
        if end is not None:
            low, high = (per * end(part, whole, z) for z in (-self._z, self._z))
            number["low"] = low if number["low"] is None else min(low, number["low"])
            number["high"] = high if number["high"] is None else max(high, number["high"])
        return number

    def _between(self, value: float, drawn: Tensor, recording: Tensor) -> Number:
        known = drawn[~drawn.isnan()]  # NaN where a draw says nothing
        if len(recording.unique()) < 2 or not len(known):
            return {"value": value, "low": None, "high": None}
        low, high = known.quantile(self._ends).tolist()
        return {"value": value, "low": min(low, value), "high": max(high, value)}


def _share_end(part: float, whole: float, z: float) -> float:
    spread = z * math.sqrt(part * (whole - part) / whole + z * z / 4)
    return min(max((part + z * z / 2 + spread) / (whole + z * z), 0.0), 1.0)


def _rate_end(count: float, time: float, z: float) -> float:
    return max(count + z * z / 2 + z * math.sqrt(count + z * z / 4), 0.0) / time
