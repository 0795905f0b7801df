"""From a statistic to alarms: threshold, re-arming, refractory time.

An alarm is an event. Once raised it stands until the statistic has been low for a while, and only
then may the next one come; so one slip, of which a rule speaks in every decision, is one alarm.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
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

    Args:
        statistic: what a rule made of the decisions.
        threshold: as for ``latch``.
        margin: as for ``latch``.
        rearm: as for ``latch``.
        refractory: as for ``latch``.
        skipped: how many decisions were left out before each, all below ``threshold - margin``.

    Shape:
        - statistic, skipped: ``[*, T]``; threshold broadcasts against ``[*]``
        - output: ``[*]``

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


def _levels(
    statistic: Tensor,
    threshold: Tensor | float,
    margin: float,
    rearm: int,
    refractory: int,
    shape: torch.Size | tuple[int, ...] = (),
) -> tuple[Tensor, Tensor, torch.Size]:
    """Threshold and re-arm level in the statistic's dtype, and the shape all broadcast to."""
    if not margin >= 0 or rearm < 0 or refractory < 0:
        raise ValueError(
            "margin, rearm and refractory must not be negative, "
            f"got {margin}, {rearm} and {refractory}"
        )
    level = torch.as_tensor(threshold, dtype=statistic.dtype, device=statistic.device).detach()
    return level, level - margin, torch.broadcast_shapes(statistic.shape[:-1], level.shape, shape)


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
