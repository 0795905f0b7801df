"""The one number that sets a detector: how many false alarms an hour, and what was achieved.

Neighbouring decisions are correlated and alarms come in clusters, so nothing is derived from
single decisions: alarms are counted on whole recordings in which nothing slips, by the latch that
a stream will use, and recordings are what the bootstrap draws.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from scipy.special import gammainccinv, gammaincinv
from torch import Tensor

from tactslip_torch.onset.rules import Rule, count_alarms

_NUM_RESAMPLES = 2000
_WORK = 2**26  # threshold times decision, at most, in one stage of the search
_FEWEST = 32  # thresholds tried of a piece, whatever the work


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


@dataclass(frozen=True)
class Threshold:
    """A threshold for a target rate, and what it gave on the recordings it was chosen on.

    Attributes:
        value: at which the statistic raises an alarm.
        target_per_hour: false alarms an hour that were asked for.
        rate: what the calibration recordings had at ``value``.
        reached: whether they had at most as many as asked for; False only if ``value`` is the
            ceiling, and even that too low.
    """

    value: float
    target_per_hour: float
    rate: AlarmRate
    reached: bool


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
    seed: int = 0,
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
        seed: of the resampling.

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
        size = max(1.0, float(surplus) * len(alarms) / (len(alarms) - 1))  # alarms a cluster
        low, high = poisson_interval(total / size, level)
        ends.append((low * size, high * size))
        tails = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
        rates = torch.cat(list(_resampled(alarms, watched, seed)))
        low, high = (rates.quantile(tails) * length).tolist()
        ends.append((low, high))
    low, high = min(end[0] for end in ends) / length, max(end[1] for end in ends) / length
    return AlarmRate(total, length, total / length, low, high, level)


def _resampled(alarms: Tensor, watched: Tensor, seed: int) -> Iterator[Tensor]:
    """Rates of recordings drawn with replacement, as many as there are; those watched at all."""
    alarms, watched = alarms[watched > 0], watched[watched > 0]
    generator = torch.Generator().manual_seed(seed)
    size = len(alarms)
    rows = max(1, 2**20 // size)
    for first in range(0, _NUM_RESAMPLES, rows):
        shape = (min(rows, _NUM_RESAMPLES - first), size)
        drawn = torch.randint(size, shape, generator=generator)
        yield alarms[drawn].sum(-1) / watched[drawn].sum(-1)


def alarm_counts(
    statistics: Sequence[Tensor],
    thresholds: Tensor | Sequence[float],
    *,
    rearm: int,
    refractory: int,
) -> Tensor:
    """How many alarms each recording has at each threshold: ``[G, R]``, int64.

    Exactly what ``latch`` raises from its start in recordings ``[T_r]``, all of one dtype, at
    thresholds ``[G]``; made of the few decisions at or above the threshold.

    Raises:
        ValueError: if there is no decision, a statistic is not a row of finite numbers, or
            rearm or refractory is negative.
    """
    flat, recording = _joined(statistics)
    counts = []
    for threshold in torch.as_tensor(thresholds, dtype=flat.dtype, device=flat.device):
        count = torch.zeros(len(statistics), dtype=torch.int64, device=flat.device)
        for piece in _segments(flat, recording, threshold, rearm, refractory):
            alarms = count_alarms(
                piece.values,
                threshold,
                rearm=rearm,
                refractory=refractory,
                skipped=piece.skipped,
            )
            count.index_add_(0, piece.recording, alarms)
        counts.append(count)
    return torch.stack(counts) if counts else recording.new_zeros(0, len(statistics))


def choose_threshold(
    statistics: Sequence[Tensor],
    rule: Rule,
    hop_s: float,
    false_alarms_per_hour: float,
    *,
    rearm: int,
    refractory: int,
    ceiling: float = math.inf,
    level: float = 0.95,
    seed: int = 0,
) -> Threshold:
    """The lowest threshold that keeps recordings without slip at or below a target rate.

    It and every higher one tried raise at most ``floor(target * hours)`` alarms; fewer need not
    follow from higher, as a lower threshold may join two alarms into one. Tried are the values at
    which the count can change: those of the statistic. Of the thresholds between two of them, which
    raise the same alarms, the upper one is taken: then fresh recordings have about as many in the
    mean, and not one more. Where none is allowed it is the next number above all. Only where
    recordings are so busy that the work would grow without bound, evenly spaced ranks are tried.

    With too few hours for the target (less than one alarm allowed) none is allowed; ``rate.high``
    tells what that proves.

    Args:
        statistics: of each recording ``[T_r]``, all of one dtype; nothing slips in them.
        rule: that made them; its ceiling counts.
        hop_s: distance of two decisions.
        false_alarms_per_hour: the target.
        rearm: decisions in a row below the threshold that re-arm.
        refractory: shortest distance of two alarms, in decisions.
        ceiling: what the statistic cannot exceed, where calibration bounds it but not the rule.
        level: of the interval of the rate.
        seed: of its resampling.

    Raises:
        ValueError: if there is no decision, a statistic is not a row of finite numbers, or the hop
            or the target is not positive.
    """
    if not 0 < false_alarms_per_hour < math.inf:
        raise ValueError(f"false_alarms_per_hour must be positive, got {false_alarms_per_hour}")
    hours = _hours(statistics, hop_s)
    flat, recording = _joined(statistics)
    allowed = math.floor(false_alarms_per_hour * float(hours.sum()) * (1 + 1e-9))
    highest = float(torch.tensor(min(rule.ceiling, ceiling), dtype=flat.dtype))
    for value in _candidates(flat, recording, rearm, refractory, allowed):
        value = min(value, highest)
        counts = alarm_counts(statistics, [value], rearm=rearm, refractory=refractory)[0]
        reached = int(counts.sum()) <= allowed
        if reached or value == highest:
            break
    rate = alarm_rate(counts, hours, level, seed)
    return Threshold(value, false_alarms_per_hour, rate, reached)


def _candidates(
    flat: Tensor, recording: Tensor, rearm: int, refractory: int, allowed: int
) -> Iterator[float]:
    """The threshold sought; should rounding or untried ones have misled, higher and higher ones."""
    num = max(1024, 8 * (allowed + 1))
    while True:
        floor = flat.new_tensor(-math.inf)
        if num < len(flat):
            floor = flat.kthvalue(len(flat) - num + 1).values
        tried, alarms = _curve(flat, recording, floor, rearm, refractory)  # downwards
        too_many = (alarms > allowed).nonzero()
        if len(too_many) or num >= len(flat):
            break
        num *= 2
    num_fit = int(too_many[0]) if len(too_many) else len(tried)
    step = 1
    while num_fit > 0:
        yield float(tried[num_fit - 1])
        num_fit, step = num_fit - step, 2 * step
    yield float(torch.nextafter(flat.max(), flat.new_tensor(math.inf)))


def _curve(
    flat: Tensor, recording: Tensor, floor: Tensor, rearm: int, refractory: int
) -> tuple[Tensor, Tensor]:
    """Thresholds at which the count of alarms changes, downwards, and the count at each.

    All thresholds that are not below ``floor``. The total changes with one piece at a time, and
    that piece at its own values alone: so each is counted at these, and changes add up.
    """
    values, changes = [], []
    pieces = list(_segments(flat, recording, floor, rearm, refractory))
    work = sum(piece.values.numel() for piece in pieces)
    for piece in pieces:
        tried = piece.values.sort(dim=-1, descending=True).values
        tried = tried[:, :: math.ceil(tried.shape[-1] / max(_FEWEST, _WORK // work))]
        alarms = count_alarms(
            piece.values[:, None, :],
            tried,
            rearm=rearm,
            refractory=refractory,
            skipped=piece.skipped[:, None, :],
        )
        is_meant = (tried >= floor) & tried.isfinite()  # a row's first ones
        values.append(tried[is_meant])
        changes.append(alarms.diff(dim=-1, prepend=torch.zeros_like(alarms[:, :1]))[is_meant])
    tried, order = torch.cat(values).sort(descending=True)
    alarms = torch.cat(changes)[order].cumsum(0)
    is_last = torch.ones_like(tried, dtype=torch.bool)
    is_last[:-1] = tried[1:] < tried[:-1]
    is_last &= tried <= flat.max()
    return tried[is_last], alarms[is_last]


class _Segments(NamedTuple):
    """Parts of recordings, of about one length, that no latch's memory links to the rest.

    Attributes:
        values: the decisions at or above a level, ``[S, E]``; where there are fewer, -inf behind.
        skipped: how many lower ones were left out before each, ``[S, E]``.
        recording: which recording each is of, ``[S]``.
    """

    values: Tensor
    skipped: Tensor
    recording: Tensor


def _segments(
    flat: Tensor, recording: Tensor, floor: Tensor, rearm: int, refractory: int
) -> Iterator[_Segments]:
    """What any threshold of at least ``floor`` has to look at, by length.

    Recordings are cut wherever so many decisions in a row lie below that a latch is as at its
    start again. ``flat`` and ``recording`` are those of ``_joined``.
    """
    where = (flat >= floor).nonzero().squeeze(-1)
    if not len(where):
        return
    gaps = where.diff() - 1
    owner = recording[where]
    is_first = torch.ones_like(where, dtype=torch.bool)
    is_first[1:] = (gaps >= max(rearm, 1, refractory - 1)) | (owner.diff() != 0)
    skipped = torch.zeros_like(where)
    skipped[1:] = gaps
    skipped[is_first] = 0
    first = is_first.nonzero().squeeze(-1)
    sizes = torch.cat([first, first.new_tensor([len(where)])]).diff()
    power = (sizes - 1).double().add(1).log2().ceil().long()
    for exponent in power.unique().tolist():
        begin, size = first[power == exponent], sizes[power == exponent]
        steps = torch.arange(int(size.max()), device=flat.device)
        is_real = steps < size[:, None]
        index = (begin[:, None] + steps).clamp(max=len(where) - 1)
        values = flat[where[index]].masked_fill(~is_real, -math.inf)
        yield _Segments(values, skipped[index].masked_fill(~is_real, 0), owner[begin])


def _joined(statistics: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """All decisions of recordings ``[T_r]`` in one row, and the number of each one's recording.

    Raises:
        ValueError: if there is none, or a statistic is not a row of finite numbers.
    """
    if not sum(statistic.numel() for statistic in statistics):
        raise ValueError("no decision to count alarms in; give at least one recording without slip")
    for number, statistic in enumerate(statistics):
        if statistic.ndim != 1 or not bool(statistic.isfinite().all()):
            raise ValueError(
                f"the statistic of recording {number} must be a row of finite numbers, "
                f"got shape {tuple(statistic.shape)}; invalid decisions enter a rule as NEUTRAL"
            )
    flat = torch.cat([statistic.detach() for statistic in statistics])
    sizes = torch.tensor([len(statistic) for statistic in statistics], device=flat.device)
    return flat, torch.arange(len(sizes), device=flat.device).repeat_interleave(sizes)


def _hours(statistics: Sequence[Tensor], hop_s: float) -> Tensor:
    if not 0 < hop_s < math.inf:
        raise ValueError(f"hop_s must be positive, got {hop_s}")
    return torch.tensor([s.numel() * hop_s / 3600 for s in statistics], dtype=torch.float64)
