"""From a statistic to alarms: threshold, re-arming, refractory time.

An alarm is an event. Once raised it stands until the statistic has been low for a while, and only
then may the next one come; so one slip, of which a rule speaks in every decision, is one alarm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

_LONG_AGO = 2**62  # decisions since an alarm that never was
_FEW = 8  # rows up to which plain numbers are quicker than tensors


class Latch(NamedTuple):
    """What is remembered between two decisions, ``[*]`` each.

    Attributes:
        is_on: in alarm, so no other can be raised.
        below: decisions in a row below the re-arm level.
        since: decisions since the last alarm.
    """

    is_on: Tensor
    below: Tensor
    since: Tensor


def latch_start(like: Tensor) -> Latch:
    """Armed, with no alarm before: ``[*] -> [*]`` each; only shape and device of ``like`` count."""
    return Latch(
        torch.zeros(like.shape, dtype=torch.bool, device=like.device),
        torch.zeros(like.shape, dtype=torch.int64, device=like.device),
        torch.full(like.shape, _LONG_AGO, dtype=torch.int64, device=like.device),
    )


def latch(
    statistic: Tensor,
    threshold: Tensor | float,
    *,
    margin: float,
    rearm: int,
    refractory: int,
    state: Latch,
) -> tuple[Tensor, Tensor, Latch]:
    """Which decisions raise an alarm, and whether one stands after each.

    An alarm is raised where the latch is armed, the statistic is at or above the threshold and the
    last alarm is at least ``refractory`` decisions back. It stands until ``rearm`` decisions in a
    row, at least one, lie below ``threshold - margin``; from that decision on the latch is armed
    again. A statistic that is NaN is neither above nor below. No gradient flows.

    Args:
        statistic: what a rule made of the decisions.
        threshold: in the statistic's unit; taken in its dtype.
        margin: how far below the threshold the statistic must fall to count as low.
        rearm: decisions in a row that must be low.
        refractory: shortest distance of two alarms, in decisions.
        state: of ``latch_start`` or an earlier call.

    Shape:
        - statistic: ``[*, T]``, ``T`` may be 0; threshold and state broadcast against ``[*]``:
          thresholds ``[G, 1]`` and ``R`` streams make everything ``[G, R]``
        - output: is_alarm ``[*, T]``, is_on ``[*, T]``, state ``[*]``

    Raises:
        ValueError: if margin, rearm or refractory is negative.
    """
    level, low, shape = _levels(statistic, threshold, margin, rearm, refractory, state.is_on.shape)
    if statistic.shape[-1] == 0:
        nothing = torch.zeros((*shape, 0), dtype=torch.bool, device=statistic.device)
        return nothing, nothing.clone(), Latch(*(part.expand(shape).clone() for part in state))
    if 0 < math.prod(shape) <= _FEW:
        return _row_by_row(statistic, level, low, rearm, refractory, state)
    rows = (part.expand(shape) for part in state)
    steps = list(_walk(_by_decision(statistic), level, low, rearm, refractory, *rows))
    alarms, standing, *_ = zip(*steps, strict=True)
    return torch.stack(alarms, dim=-1), torch.stack(standing, dim=-1), Latch(*steps[-1][1:])


def count_alarms(
    statistic: Tensor,
    threshold: Tensor | float,
    *,
    margin: float,
    rearm: int,
    refractory: int,
    skipped: Tensor | None = None,
) -> Tensor:
    """How many alarms ``latch`` raises from its start, without keeping which: ``[*]``, int64.

    Takes what ``latch`` takes. ``skipped``, ``[*, T]``, is how many decisions were left out before
    each, all below ``threshold - margin``.

    Raises:
        ValueError: if margin, rearm or refractory is negative.
    """
    level, low, shape = _levels(statistic, threshold, margin, rearm, refractory)
    count = torch.zeros(shape, dtype=torch.int64, device=statistic.device)
    gaps = itertools.repeat(0) if skipped is None else _by_decision(skipped)
    steps = _by_decision(statistic)
    for step in _walk(steps, level, low, rearm, refractory, *latch_start(count), gaps):
        count += step[0]
    return count


class Stretches(NamedTuple):
    """Parts of recordings, of about one length, that no latch's memory links to the rest.

    Attributes:
        values: the decisions at or above a level, ``[S, E]``; where there are fewer, -inf behind.
        skipped: how many lower ones were left out before each, ``[S, E]``.
        recording: which recording each is of, ``[S]``.
    """

    values: Tensor
    skipped: Tensor
    recording: Tensor


def stretches(
    flat: Tensor, recording: Tensor, floor: Tensor, rearm: int, refractory: int
) -> Iterator[Stretches]:
    """What any threshold with a re-arm level of at least ``floor`` has to look at, by length.

    Recordings are cut wherever so many decisions in a row lie below that a latch is as at its
    start again. ``flat`` and ``recording`` are those of ``joined``.
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
        yield Stretches(values, skipped[index].masked_fill(~is_real, 0), owner[begin])


def joined(statistics: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
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


def alarm_counts(
    statistics: Sequence[Tensor],
    thresholds: Tensor | Sequence[float],
    *,
    margin: float,
    rearm: int,
    refractory: int,
) -> Tensor:
    """How many alarms each recording has at each threshold: ``[G, R]``, int64.

    Exactly what ``latch`` raises from its start in recordings ``[T_r]``, all of one dtype, at
    thresholds ``[G]``; made of the few decisions at or above the re-arm level.

    Raises:
        ValueError: if there is no decision, a statistic is not a row of finite numbers, or margin,
            rearm or refractory is negative.
    """
    _refuse_negative(margin, rearm, refractory)
    flat, recording = joined(statistics)
    counts = []
    for threshold in torch.as_tensor(thresholds, dtype=flat.dtype, device=flat.device):
        count = torch.zeros(len(statistics), dtype=torch.int64, device=flat.device)
        for piece in stretches(flat, recording, threshold - margin, rearm, refractory):
            alarms = count_alarms(
                piece.values,
                threshold,
                margin=margin,
                rearm=rearm,
                refractory=refractory,
                skipped=piece.skipped,
            )
            count.index_add_(0, piece.recording, alarms)
        counts.append(count)
    return torch.stack(counts) if counts else recording.new_zeros(0, len(statistics))


def _levels(
    statistic: Tensor,
    threshold: Tensor | float,
    margin: float,
    rearm: int,
    refractory: int,
    shape: torch.Size | tuple[int, ...] = (),
) -> tuple[Tensor, Tensor, torch.Size]:
    """Threshold and re-arm level in the statistic's dtype, and the shape all broadcast to."""
    _refuse_negative(margin, rearm, refractory)
    level = torch.as_tensor(threshold, dtype=statistic.dtype, device=statistic.device).detach()
    return level, level - margin, torch.broadcast_shapes(statistic.shape[:-1], level.shape, shape)


def _refuse_negative(margin: float, rearm: int, refractory: int) -> None:
    if not margin >= 0 or rearm < 0 or refractory < 0:
        raise ValueError(
            "margin, rearm and refractory must not be negative, "
            f"got {margin}, {rearm} and {refractory}"
        )


def _walk(
    statistic: Iterable[Any],
    level: Any,
    low: Any,
    rearm: int,
    refractory: int,
    is_on: Any,
    below: Any,
    since: Any,
    skipped: Iterable[Any] = itertools.repeat(0),
) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Decision by decision: whether it raises an alarm, and the parts of the state after it.

    The definition, for tensors ``[*]`` and for plain numbers alike. ``skipped`` decisions before
    each were low; re-armed among them is re-armed before the decision, so one look is enough.
    """
    in_a_row = max(rearm, 1)
    for x, gap in zip(statistic, skipped, strict=False):
        is_low = x < low
        run = below + gap + is_low
        is_on = is_on & (run < in_a_row)
        since = since + gap + 1
        is_alarm = (is_on ^ True) & (x >= level) & (since >= refractory)
        is_on, below, since = is_on | is_alarm, run * is_low, since * (is_alarm ^ True)
        yield is_alarm, is_on, below, since


def _row_by_row(
    statistic: Tensor, level: Tensor, low: Tensor, rearm: int, refractory: int, state: Latch
) -> tuple[Tensor, Tensor, Latch]:
    """``latch`` by plain numbers, which for a few rows are quicker than tensors."""
    shape, size = state.is_on.shape, statistic.shape[-1]
    rows = zip(
        statistic.detach().expand(*shape, size).reshape(-1, size).tolist(),
        *(part.expand(shape).flatten().tolist() for part in (level, low, *state)),
        strict=True,
    )
    alarms, standing, ends = [], [], []
    for values, threshold, rearm_level, *before in rows:
        steps = list(_walk(values, threshold, rearm_level, rearm, refractory, *before))
        alarms.append([step[0] for step in steps])
        standing.append([step[1] for step in steps])
        ends.append(steps[-1][1:])
    device = statistic.device
    return (
        torch.tensor(alarms, device=device).view(*shape, size),
        torch.tensor(standing, device=device).view(*shape, size),
        Latch(*(torch.tensor(part, device=device).view(shape) for part in zip(*ends, strict=True))),
    )


def _by_decision(x: Tensor) -> tuple[Tensor, ...]:
    return x.detach().movedim(-1, 0).contiguous().unbind(0)
