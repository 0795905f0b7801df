"""What sets a detector: how many false alarms it may raise, and what was achieved.

A *budget* is a rate of false alarms an hour of a kind of recording, or a share of its knocks, which
is to hold with a stated confidence. How many alarms calibration may have follows from it: as many
as keep the upper confidence bound of a Poisson rate, or of a binomial share, within the budget.

Neighbouring decisions are correlated and alarms come in clusters, so nothing is derived from
single decisions: alarms are counted on whole recordings in which nothing slips, by the latch that
a stream will use, and recordings are what the bootstrap draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv, gammaincinv

_TRIED_ONE_BY_ONE = 500  # thresholds, the highest
_MOST_TRIED = 200_000  # values of a score, the highest
_LEAST_QUIET = 20  # quiet decisions for each that may reach a threshold


def _alarms(above: NDArray[np.int64], rearm: int, refractory: int) -> NDArray[np.int64]:
    """Places of a latch's alarms, from those ``[A]`` of decisions at or above its threshold."""
    # the latch is armed again at the first of each run
    first = np.flatnonzero(np.diff(above, prepend=above[:1] - rearm - 2) > max(rearm, 1))
    if refractory <= max(rearm, 1) + 1 or not len(above):
        return above[first]
    found, place = [0], 0
    while (later := np.searchsorted(first, place, side="right")) < len(first):
        place = max(first[later], np.searchsorted(above, above[place] + refractory))
        if place == len(above):
            break
        found.append(place)
    return above[found]


@dataclass(frozen=True)
class Budget:
    """How many false alarms recordings of a scene may have.

    Args:
        scene: kind of recordings.
        limit: alarms an hour in which nothing slips; of a share, alarms a knock.
        is_share: whether it is a share of knocks.
        confidence: with which the limit is to hold.

    Raises:
        ValueError: if the limit or the confidence is out of range.
    """

    scene: str
    limit: float
    is_share: bool = False
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if not (0 < self.limit < math.inf and (self.limit < 1 or not self.is_share)):
            most = "between 0 and 1" if self.is_share else "positive"
            raise ValueError(f"onset.budget of {self.scene} must be {most}, got {self.limit}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"onset.confidence must lie between 0 and 1, got {self.confidence}")

    def bound(self, alarms: int, amount: float) -> float:
        """The upper confidence bound of what so many alarms in so many hours, or knocks, show.

        Reference:
            Garwood (1936), Biometrika 28, 437-442; Clopper and Pearson (1934), 26, 404-413.
        """
        if not amount > 0:
            return math.inf
        if not self.is_share:
            return float(gammaincinv(alarms + 1, self.confidence)) / amount
        if alarms >= amount:
            return 1.0
        return float(betaincinv(alarms + 1, amount - alarms, self.confidence))

    def interval(self, alarms: int, amount: float, level: float = 0.95) -> tuple[float, float]:
        """The central interval of the rate, or share, that so many alarms show."""
        low, high = (replace(self, confidence=(1 + side * level) / 2) for side in (-1, 1))
        return low.bound(alarms - 1, amount) if alarms else 0.0, high.bound(alarms, amount)

    def allowed(self, amount: float) -> int:
        """Most alarms in so many hours, or knocks, whose bound lies within the limit.

        Raises:
            ValueError: if not even none would show it.
        """
        count = -1
        while count + 1 < max(amount, 1) * 1e3 and self.bound(count + 1, amount) <= self.limit:
            count += 1
        if count < 0:
            what, unit = ("share", "knocks") if self.is_share else ("rate", "h")
            least = math.log(1 - self.confidence) / (
                math.log1p(-self.limit) if self.is_share else -self.limit
            )
            scale = 1 if self.is_share else 1000
            least = math.ceil(least * scale) / scale
            raise ValueError(
                f"{amount:.3g} {unit} of {self.scene} cannot show a {what} of at most "
                f"{self.limit:g} with a confidence of {self.confidence:g}, even without an alarm: "
                f"give at least {least:g} {unit}, or a larger onset.budget"
            )
        return count


def false_alarms(
    is_high: NDArray[np.bool_], is_quiet: NDArray[np.bool_], rearm: int, refractory: int
) -> int:
    """Alarms of a latch, raised where the first mask holds, in which the second does: ``[N]``."""
    return int(is_quiet[_alarms(np.flatnonzero(is_high), rearm, refractory)].sum())


def lowest_threshold(
    scores: Sequence[NDArray[Any]],
    is_quiet: Sequence[NDArray[np.bool_]],
    allowed: int,
    *,
    rearm: int,
    refractory: int,
    is_raised: Sequence[NDArray[np.bool_]] | None = None,
) -> float:
    """The lowest threshold at which quiet stretches of recordings have at most so many alarms.

    So have all higher ones that are tried: the values of the score, from the highest, one by one at
    first. Where even the highest gives more, the next number above all. A score that reaches its
    threshold in more than a twentieth of the quiet decisions is no alarm, however few it raises.

    Args:
        scores: of each recording ``[N_r]``.
        is_quiet: where an alarm is false.
        allowed: alarms.
        rearm: decisions in a row below the threshold that re-arm.
        refractory: shortest distance of two alarms, in decisions.
        is_raised: where another statistic reaches its own threshold, if one does.
    """
    gap = rearm + refractory + 2  # so far apart that no latch remembers
    flat = np.concatenate([np.append(own, np.full(gap, -np.inf, own.dtype)) for own in scores])
    none = np.zeros(gap, bool)
    quiet = np.concatenate([part for own in is_quiet for part in (own, none)])
    ranked = np.sort(flat[quiet])[::-1]
    ranked = ranked[np.isfinite(ranked)]
    if not len(ranked):
        raise ValueError("no decision to count alarms in; give recordings without slip")
    tried = max(1, min(_MOST_TRIED, len(ranked) // _LEAST_QUIET))
    places = np.flatnonzero(flat >= ranked[tried - 1])
    other = np.zeros(0, np.int64)
    if is_raised is not None:
        other = np.flatnonzero(np.concatenate([x for own in is_raised for x in (own, none)]))

    def keeps(threshold: float) -> bool:
        above = np.union1d(places[flat[places] >= threshold], other)
        return bool(quiet[_alarms(above, rearm, refractory)].sum() <= allowed)

    return _lowest(ranked[:tried], float(np.nextafter(ranked[0], np.inf)), keeps)


def _lowest(falling: NDArray[Any], above: float, keeps: Callable[[float], bool]) -> float:
    """The last of falling values that keeps what is asked for, ``above`` if none does.

    One by one among the highest 500, then in steps of a five hundredth, the last one by halves.
    """
    value, num, most = above, 0, len(falling)
    while num < len(falling):
        step = min(num // _TRIED_ONE_BY_ONE, most)
        below = falling[min(num + step, len(falling) - 1)]
        if keeps(below):
            value = float(below)
            num = len(falling) - int(np.searchsorted(falling[::-1], below))
        elif step == 0:
            break
        else:
            most = step // 2
    return value
