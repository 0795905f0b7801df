"""From scores to alarms, as a graph: what ``Decider`` does.

What one decision hands to the next, and no more, is walked by a ``Scan``, an iteration of which
costs as much as several nodes do on all decisions together. While nothing speaks for slip, nothing
is walked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tactslip_torch.graph.value import END, F64, I64, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import (
    LARGEST_LLR,
    LARGEST_SCORE,
    Calibration,
    Isotonic,
    Platt,
)
from tactslip_torch.onset.rules import NOTHING_YET, Cusum, KOfN, Rule

LATCH_START = (0.0, 0.0, 2.0**52)
"""Armed, with no alarm before; the last number counts on exactly in float64."""

Walk = tuple[Value, Value]
"""What is made of ``k`` decisions, ``[k]``, and what is remembered of them, float64."""

Steps = tuple[list[Value], list[Value]]
"""What the body of a ``scan`` gives."""


def llr_of(score: Value, calibration: Calibration) -> Value:
    """Log likelihood ratios of finite scores: ``[*] -> [*]``, in float64 and rounded once.

    Raises:
        ValueError: for a calibration other than ``Platt`` and ``Isotonic``.
    """
    wide = score.cast(F64)
    match calibration:
        case Platt(slope, offset):
            line = wide.clamp(-LARGEST_SCORE, LARGEST_SCORE) * slope + offset
            return line.clamp(-LARGEST_LLR, LARGEST_LLR).cast(score.dtype)
        case Isotonic(scores, llrs):
            return _between_knots(wide, scores, llrs).cast(score.dtype)
    raise ValueError(f"expected a calibration Platt or Isotonic, got {calibration!r}")


def probability_of(llr: Value, slip_share: float) -> Value:
    """How probable slip is where this share of all bins is slip: ``[*] -> [*]``."""
    odds = math.log(slip_share) - math.log1p(-slip_share)
    return (llr + odds if odds else llr).sigmoid()


def count_up(num: Value) -> Value:
    """The whole numbers from 0 to before ``num`` ``[1]``, int64."""
    graph = num.graph
    return graph.op("Range", graph.constant(0, I64), num.squeeze(0), graph.constant(1, I64))


def latest(mask: Value, start: Value, values: Value) -> Value:
    """The value where the mask held last, ``start`` where it did not yet.

    Shape:
        - mask, values, output: ``[k]``, k at least 1
        - start: ``[1]``
    """
    graph = values.graph
    held = graph.concat(start, graph.op("Compress", values, mask, axis=0), axis=0)
    count = graph.op("CumSum", mask.cast(I64), graph.constant(0, I64))
    return graph.op("Gather", held, count, axis=0)


def rule_start(rule: Rule) -> list[float]:
    """What is remembered before the first decision."""
    return [NOTHING_YET] * (rule.n - 1) if isinstance(rule, KOfN) else [0.0]


def statistic_of(graph: Graph, rule: Rule, llr: Value, memory: Value) -> Walk:
    """The statistic of each decision, in the dtype of the ratios, and the memory behind the last.

    To the bit what the rule's ``scan`` makes of them.

    Args:
        graph: to which nodes are added.
        rule: whose statistic.
        llr: finite ratios.
        memory: of ``rule_start`` or the call before.

    Shape:
        - llr, statistic: ``[k]``, k at least 1
        - memory: as many as ``rule_start`` gives, float64
    """
    if isinstance(rule, KOfN):
        return _k_th_largest(rule, llr, memory)
    return _sum(graph, rule, llr, memory)


class Latched(NamedTuple):
    """Which decisions raise an alarm.

    Attributes:
        alarm: whether it raises one, ``[k]``, bool.
        on: whether one stands after it, ``[k]``, bool.
        memory: what ``latched`` is given for the next decisions, ``[3]``.
    """

    alarm: Value
    on: Value
    memory: Value


def latched(
    graph: Graph,
    statistic: Value,
    level: Value,
    number: Value,
    memory: Value,
    *,
    rearm: int,
    refractory: int,
) -> Latched:
    """Alarms as ``onset.rules`` raises them.

    Args:
        graph: to which nodes are added.
        statistic: finite.
        level: from which on an alarm is raised.
        number: of the decisions in their stream, float64.
        memory: whether an alarm stands, for how many decisions then the statistic was low, and
            decisions since the last alarm (``LATCH_START``); float64.
        rearm: decisions in a row that must be low.
        refractory: shortest distance of two alarms, in decisions.

    Shape:
        - statistic, number: ``[k]``, k at least 1
        - level: ``[1]``
        - memory: ``[3]``
    """
    is_awake = (statistic.amax(0, keepdim=True) >= level) | (memory.slice(0, 1, 0) > 0.0)

    def watch(body: Graph) -> Latched:
        given = (x.at(body) for x in (statistic, level, number, memory))
        return _watched(body, *given, rearm=rearm, refractory=refractory)

    def sleep(body: Graph) -> Latched:
        is_high = statistic.at(body) >= level.at(body)  # nowhere
        num = number.at(body).length(0).cast(F64)
        return Latched(is_high, is_high, (memory.at(body) + num) * body.constant([0, 0, 1], F64))

    return Latched(*graph.if_(is_awake, watch, sleep))


def _watched(
    graph: Graph,
    statistic: Value,
    level: Value,
    number: Value,
    memory: Value,
    *,
    rearm: int,
    refractory: int,
) -> Latched:
    """Where the statistic is high, or an alarm stands.

    One is raised where it is high and the last alarm is no later than the last re-arming, and than
    ``refractory`` decisions back. So only the number of the last alarm is walked.
    """
    on, below, since = graph.ops("Split", memory, dtypes=(F64,) * 3, axis=0, num_outputs=3)
    before = number.slice(0, 1, 0) - 1.0
    last = before - since
    high = latest(statistic >= level, before - below, number)  # the last one that was not low
    rearmed = latest(number - high >= float(max(rearm, 1)), last - on, number)
    allowed = rearmed.minimum(number - float(refractory))
    allowed = graph.where(statistic >= level, allowed, -math.inf)
    (end,), (alarms,) = graph.scan(_raise, [last.squeeze(0)], [allowed, number])
    is_on = alarms > rearmed
    now = _last(number)
    after = _last(is_on).cast(F64), now - _last(high), now - end
    return Latched(alarms.eq(number), is_on, graph.concat(*after, axis=0))


def _raise(body: Graph, state: Sequence[Value], rows: Sequence[Value]) -> Steps:
    (last,), (allowed, number) = state, rows
    last = body.where(last <= allowed, number, last)
    return [last], [last]


def _k_th_largest(rule: KOfN, llr: Value, memory: Value) -> Walk:
    if rule.n == 1:
        return llr, memory
    graph = llr.graph
    known = graph.concat(memory.cast(llr.dtype), llr, axis=0)  # [n - 1 + k]
    places = count_up(llr.length(0)).unsqueeze(1) + graph.axes(*range(rule.n))
    window = graph.op("Gather", known, places, axis=0)  # [k, n]
    largest, _ = graph.ops("TopK", window, graph.axes(rule.k), dtypes=(llr.dtype, I64))
    kept = known.slice(1 - rule.n, END, 0).cast(F64)
    return largest.slice(rule.k - 1, rule.k, 1).squeeze(1), kept


def _sum(graph: Graph, rule: Cusum, llr: Value, memory: Value) -> Walk:
    step = llr - rule.drift if rule.drift else llr
    step = step * rule.evidence if rule.evidence != 1 else step
    start = memory.cast(llr.dtype)

    def add(body: Graph, state: Sequence[Value], rows: Sequence[Value]) -> Steps:
        total = state[0] + rows[0]
        return [total.clamp(0.0, rule.ceiling)], [total]

    def walk(body: Graph) -> list[Value]:
        return body.scan(add, [start.at(body).squeeze(0)], [step.at(body)])[1]

    # Where every step takes away at least what is there, the sum is 0 without a walk.
    is_quiet = start + step.amax(0, keepdim=True) <= 0.0
    total = graph.if_(is_quiet, lambda body: [step.at(body)], walk)[0].clamp(0.0, rule.ceiling)
    return total, _last(total).cast(F64)


def _between_knots(score: Value, scores: Sequence[float], llrs: Sequence[float]) -> Value:
    graph, num = score.graph, len(scores)
    inside = score.clamp(scores[0], scores[-1])
    if num == 1:
        return inside * 0.0 + llrs[0]
    is_right = inside.unsqueeze(-1) > graph.constant(scores, F64)  # [k, knots]
    place = (is_right.cast(I64).sum(-1) - 1).clamp(0, num - 2)  # of the knot to the left
    tables = scores[:-1], np.diff(scores), llrs[:-1], llrs[1:]
    x, width, left, right = (
        graph.op("Gather", graph.constant(table, F64), place, axis=0) for table in tables
    )
    share, rise = (inside - x) / width, right - left
    return graph.where(share < 0.5, left + share * rise, right - rise * (1.0 - share))


def _last(value: Value) -> Value:
    return value.slice(-1, END, 0)
