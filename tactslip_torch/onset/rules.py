"""Sequential rules: log likelihood ratios of decisions in, one statistic per decision, alarms out.

Every rule is causal, keeps a state of fixed size, and makes the same statistic whatever pieces a
stream comes in. An alarm is raised where the statistic reaches a threshold, stands until the
statistic has been low for a while, and only then may the next one come (``latch``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.runtime import check_number, check_share

HOLD_S = 0.25
"""Lost samples in a row up to which a rule keeps its state; beyond, it begins anew."""

NOTHING_YET = -1e30
"""What ``KOfN`` takes for decisions before the first; finite, and below every real one."""

_LONG_AGO = 2**62  # decisions since an alarm that never was
_TRIED_ONE_BY_ONE = 500  # thresholds, the highest
_MOST_TRIED = 200_000  # values of a score, the highest
_LEAST_QUIET = 20  # quiet decisions for each that may reach a threshold


@dataclass(frozen=True)
class KOfN:
    """The k-th largest of the last n log likelihood ratios.

    It reaches a threshold exactly if k of the last n do: the usual debounce. Among fewer than k
    decisions it is ``NOTHING_YET``.

    Raises:
        ValueError: unless ``1 <= k <= n``.
    """

    k: int
    n: int
    name: ClassVar[str] = "k_of_n"
    ceiling: ClassVar[float] = math.inf

    def __post_init__(self) -> None:
        if not 1 <= self.k <= self.n:
            raise ValueError(f"k must lie between 1 and n, got k={self.k} and n={self.n}")

    def start(self) -> list[float]:
        """The state before the first decision: ``n - 1`` that are none yet."""
        return [NOTHING_YET] * (self.n - 1)

    def scan_row(
        self, llrs: Sequence[float], state: list[float], dtype: type[Any]
    ) -> tuple[list[float], list[float]]:
        """The k-th largest of each decision and the ``n - 1`` before it, and the state behind them.

        In plain numbers of a NumPy dtype. What is not valid the caller leaves out.
        """
        known = [*state, *llrs]
        statistic = [sorted(known[i : i + self.n])[-self.k] for i in range(len(llrs))]
        return statistic, known[len(llrs) :]

    def to_dict(self) -> dict[str, Any]:
        """Name, k and n, as ``rule_from_dict`` reads them."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class Cusum:
    """Evidence for slip since it last seemed certain that there is none.

    ``S = clamp(S + evidence * (llr - drift), 0, ceiling)``, from 0. Page's test is drift 0 and no
    ceiling; a drift lets ratios that are a little positive for long fade, and the ceiling bounds
    how long the sum takes to come down after a slip.

    Args:
        drift: ratio that a decision must exceed to add to the sum.
        evidence: fraction of a ratio that is new, in (0, 1]; overlapping bins tell less than as
            many apart, and hop / bin is the natural value.
        ceiling: largest sum; infinite for none.

    Raises:
        ValueError: if drift is not finite, evidence out of range or the ceiling not positive.

    Reference:
        Page (1954), Biometrika 41, 100-115.
    """

    drift: float = 0.0
    evidence: float = 1.0
    ceiling: float = math.inf
    name: ClassVar[str] = "cusum"

    def __post_init__(self) -> None:
        if not math.isfinite(self.drift):
            raise ValueError(f"drift must be finite, got {self.drift}")
        if not 0 < self.evidence <= 1:
            raise ValueError(f"evidence must lie in (0, 1], got {self.evidence}")
        if not self.ceiling > 0:
            raise ValueError(f"ceiling must be positive, got {self.ceiling}")

    def start(self) -> list[float]:
        """The state before the first decision: a sum of 0."""
        return [0.0]

    def scan_row(
        self, llrs: Sequence[float], state: list[float], dtype: type[Any]
    ) -> tuple[list[float], list[float]]:
        """The sum after each decision, else as ``KOfN.scan_row``."""
        sums = list(state)
        for llr in llrs:
            step = float(dtype(self.evidence) * (dtype(llr) - dtype(self.drift)))
            sums.append(float(dtype(min(max(dtype(sums[-1] + step), 0.0), self.ceiling))))
        return sums[1:], sums[-1:]

    def to_dict(self) -> dict[str, Any]:
        """Name, drift, evidence and ceiling, None for an infinite one."""
        plain = {"name": self.name, **asdict(self)}
        return plain if self.ceiling < math.inf else {**plain, "ceiling": None}


Rule: TypeAlias = KOfN | Cusum
"""From log likelihood ratios to a statistic, which never exceeds ``ceiling``."""

RULES: Mapping[str, type[KOfN | Cusum]] = {rule.name: rule for rule in (KOfN, Cusum)}
"""Every rule by its name."""


def rule_from_dict(plain: Mapping[str, Any]) -> Rule:
    """The rule that ``to_dict`` wrote.

    Raises:
        ValueError: if there is no such rule, or a number of it is missing, unknown or refused.
    """
    numbers = dict(plain)
    name = numbers.pop("name", None)
    if name not in RULES:
        raise ValueError(f"no sequential rule is called {name!r}; there are {', '.join(RULES)}")
    if numbers.get("ceiling", 0) is None:
        numbers["ceiling"] = math.inf
    try:
        return RULES[name](**numbers)
    except TypeError as error:
        raise ValueError(f"numbers of the rule {name!r} do not fit: {error}") from error


class Latch(NamedTuple):
    """What is remembered of one stream between two decisions.

    Attributes:
        is_on: in alarm, so no other can be raised.
        below: decisions in a row below the threshold.
        since: decisions since the last alarm.
    """

    is_on: bool = False
    below: int = 0
    since: int = _LONG_AGO


def latch(
    statistic: Iterable[float],
    threshold: float,
    *,
    rearm: int,
    refractory: int,
    state: Latch = Latch(),  # noqa: B008  # a tuple: armed, with no alarm before
) -> tuple[list[bool], list[bool], Latch]:
    """Which decisions of a stream raise an alarm, whether one stands after each, and the state.

    An alarm is raised where the latch is armed, the statistic is at or above the threshold and the
    last alarm is at least ``refractory`` decisions back. It stands until ``rearm`` decisions in a
    row, at least one, lie below the threshold; from that decision on the latch is armed again.
    Where the statistic is NaN all stays as it is. In plain numbers, quicker than small tensors.

    Args:
        statistic: what a rule made of the decisions.
        threshold: in the statistic's unit and its dtype.
        rearm: decisions in a row that must be low.
        refractory: shortest distance of two alarms, in decisions.
        state: after the decisions before these.
    """
    is_on, below, since = state
    alarms, standing = [], []
    for x in statistic:
        since += 1
        if x != x:
            alarms.append(False)
            standing.append(is_on)
            continue
        below = below + 1 if x < threshold else 0
        if below >= max(rearm, 1):
            is_on = False
        is_alarm = not is_on and x >= threshold and since >= refractory
        if is_alarm:
            is_on, since = True, 0
        alarms.append(is_alarm)
        standing.append(is_on)
    return alarms, standing, Latch(is_on, below, since)


def most_lost(window_samples: int, hold_samples: int, hop_samples: int) -> int:
    """Decisions in a row that so many lost samples make invalid, at most.

    Args:
        window_samples: that a decision rests on.
        hold_samples: lost samples in a row.
        hop_samples: distance of two decisions.
    """
    return -(-(window_samples + hold_samples) // hop_samples)


# Thresholds --------------------------------------------------------------------------------------


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
        limit: alarms an hour in which nothing slips.
        confidence: with which the limit is to hold.
        dispersion: variance of the counts of alarms by their mean, at least 1. Alarms that come in
            bunches tell as much as so many fewer that do not.

    Raises:
        ValueError: if the limit, the confidence or the dispersion is out of range.
    """

    scene: str
    limit: float
    confidence: float = 0.95
    dispersion: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.limit < math.inf:
            raise ValueError(f"onset.budget of {self.scene} must be positive, got {self.limit}")
        check_share("onset.confidence", self.confidence)
        check_number("dispersion", self.dispersion, least=1)

    def bound(self, alarms: int, amount: float) -> float:
        """The upper confidence bound of what so many alarms in so many hours show.

        Reference:
            Garwood (1936), Biometrika 28, 437-442.
            Dispersion: McCullagh and Nelder (1989), Generalized Linear Models, 6.2.3.
        """
        from scipy.special import gammaincinv  # of no need for a stream

        if not amount > 0:
            return math.inf
        effective = float(gammaincinv(alarms / self.dispersion + 1, self.confidence))
        return self.dispersion * effective / amount

    def interval(self, alarms: int, amount: float, level: float = 0.95) -> tuple[float, float]:
        """The central interval of the rate that so many alarms show."""
        low, high = (replace(self, confidence=(1 + side * level) / 2) for side in (-1, 1))
        return low.bound(alarms - 1, amount) if alarms else 0.0, high.bound(alarms, amount)

    def allowed(self, amount: float) -> int:
        """Most alarms in so many hours whose bound lies within the limit.

        Raises:
            ValueError: if not even none would show it.
        """
        count = -1
        while count + 1 < max(amount, 1) * 1e3 and self.bound(count + 1, amount) <= self.limit:
            count += 1
        if count < 0:
            least = math.ceil(-1000 * math.log(1 - self.confidence) / self.limit) / 1000
            raise ValueError(
                f"{amount:.3g} h of {self.scene} cannot show a rate of at most "
                f"{self.limit:g} with a confidence of {self.confidence:g}, even without an alarm: "
                f"give at least {least:g} h, or a larger onset.budget"
            )
        return count


def false_alarms(
    is_high: NDArray[np.bool_], is_quiet: NDArray[np.bool_], rearm: int, refractory: int
) -> NDArray[np.int64]:
    """Places of a latch's alarms, raised where the first mask holds, in which the second does.

    Shape:
        - is_high, is_quiet: ``[N]``
        - output: ``[A]``, ascending
    """
    places = _alarms(np.flatnonzero(is_high), rearm, refractory)
    return places[is_quiet[places]]


def lowest_threshold(
    scores: Sequence[NDArray[Any]],
    is_quiet: Sequence[NDArray[np.bool_]],
    allowed: int,
    *,
    rearm: int,
    refractory: int,
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

    def keeps(threshold: float) -> bool:
        above = places[flat[places] >= threshold]
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
