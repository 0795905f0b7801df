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
import torch
from numpy.typing import NDArray
from scipy.special import betaincinv, gammainccinv, gammaincinv
from torch import Tensor

_NUM_RESAMPLES = 2000
_TRIED_ONE_BY_ONE = 500  # thresholds, the highest
_MOST_TRIED = 200_000  # values of a score, the highest
_LEAST_QUIET = 20  # quiet decisions for each that may reach a threshold


@dataclass(frozen=True)
class AlarmRate:
    """Alarms of some recordings, and where the rate they were drawn from may lie.

    Attributes:
        alarms: how many there were.
        hours: in how many hours.
        per_hour: their quotient.
        low: lower end of the interval of the rate, an hour.
        high: upper end; finite and positive even without an alarm.
        level: how often such an interval is meant to hold the rate.
    """

    alarms: int
    hours: float
    per_hour: float
    low: float
    high: float
    level: float


def poisson_interval(count: float, level: float = 0.95) -> tuple[float, float]:
    """The exact central interval of a Poisson mean, given one count.

    Raises:
        ValueError: if the count is negative, or the level not between 0 and 1.

    Reference:
        Garwood (1936), Biometrika 28, 437-442: quantiles of chi-square with ``2 count`` and
        ``2 count + 2`` degrees of freedom, halved. They make sense between whole counts too.
    """
    if not 0 <= count < math.inf:
        raise ValueError(f"a count must not be negative, got {count}")
    if not 0 < level < 1:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    tail = (1 - level) / 2
    low = float(gammaincinv(count, tail)) if count else 0.0
    return low, float(gammainccinv(count + 1, tail))


def alarm_rate(
    counts: Tensor | Sequence[int],
    hours: Tensor | Sequence[float],
    level: float = 0.95,
) -> AlarmRate:
    """The rate of alarms over recordings, with an interval that knows of clusters.

    Each end is the farthest of three: the percentile of the rate over resampled recordings, the
    end of the exact interval of a Poisson count, and that of the count of clusters, as many as
    make the variance between recordings, times alarms a cluster. The bootstrap alone falls short
    where few clusters were seen, the Poisson interval wherever there are clusters. Of clusters
    within one recording nothing is seen, nor of those too rare to have occurred.

    Args:
        counts: alarms of each recording, ``[R]``.
        hours: how long each was watched, ``[R]``.
        level: of the interval.

    Raises:
        ValueError: if these are not two rows of equal length, none is longer than 0 hours, or a
            count is negative.
    """
    alarms = torch.as_tensor(counts, dtype=torch.float64).cpu()
    watched = torch.as_tensor(hours, dtype=torch.float64).cpu()
    if alarms.ndim != 1 or alarms.shape != watched.shape:
        raise ValueError(
            "expected one count and one number of hours for each recording, "
            f"got {tuple(alarms.shape)} and {tuple(watched.shape)}"
        )
    if bool((alarms < 0).any() | (watched < 0).any()) or not float(watched.sum()) > 0:
        raise ValueError(
            "counts and hours must not be negative and some time must have been watched, "
            f"got {int(alarms.sum())} alarms in {float(watched.sum()):g} h"
        )
    total, length = int(alarms.sum()), float(watched.sum())
    ends = [poisson_interval(total, level)]
    if total and len(alarms) > 1:
        surplus = (alarms - watched * (total / length)).square().sum() / total
        cluster = max(1.0, float(surplus) * len(alarms) / (len(alarms) - 1))  # alarms in one
        low, high = poisson_interval(total / cluster, level)
        ends.append((low * cluster, high * cluster))
        tails = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
        generator, rates = torch.Generator().manual_seed(0), []
        has_time = watched > 0
        size = int(has_time.sum())
        for first in range(0, _NUM_RESAMPLES, rows := max(1, 2**20 // size)):
            shape = (min(rows, _NUM_RESAMPLES - first), size)
            drawn = has_time.nonzero()[:, 0][torch.randint(size, shape, generator=generator)]
            rates.append(alarms[drawn].sum(-1) / watched[drawn].sum(-1))
        low, high = (torch.cat(rates).quantile(tails) * length).tolist()
        ends.append((low, high))
    low, high = min(end[0] for end in ends) / length, max(end[1] for end in ends) / length
    return AlarmRate(total, length, total / length, low, high, level)


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
