"""Scores where channels are missing, as nodes: ``ExpectedScore``, bin by bin.

ONNX has no solver. The precision of the features is swept on those that are missing, one after the
other (``Scan``): a step is one term of rank one, so all of it is exact, of as many steps as
features are missing, and of the memory of one mask however many bins come. Bins that miss the same
as the one before share its matrices, as all do under ``dead``. Where nothing is missing, none of it
is run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tactslip_torch.graph.head import matrix
from tactslip_torch.graph.sequence import llr_of
from tactslip_torch.graph.value import F64, I64, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import Calibration
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.missing_channels import ClassGaussians, Precision


class _Mask(NamedTuple):
    """What a mask makes of both classes (``expected_score.Swept``), behind the mask itself."""

    is_lost: Value  # [K], 1 or 0
    swept: Value  # [2, K, K]
    log_det: Value  # [2]
    lift: Value  # [2]
    spread: Value  # [2]


def expected_scores(
    graph: Graph,
    score: Value,
    z: Value,
    is_lost: Value,
    head: QuadraticForm,
    gaussians: ClassGaussians,
) -> tuple[Value, Value]:
    """Expected scores and their variances; those of bins that miss nothing as they came, and 0.

    Args:
        graph: to which nodes are added; may be a body.
        score: of all features, ``[B]``, in the precision of the form, which the result has too.
        z: scaled features, ``[B, K]``, float64; anything where missing.
        is_lost: which features are missing, ``[B, K]``, bool.
        head: the machine.
        gaussians: of its features.
    """
    num = head.num_features

    def some(body: Graph) -> list[Value]:
        lost = is_lost.at(body)
        rows = [body.where(lost, 0.0, z.at(body)), lost.cast(F64), score.at(body).cast(F64)]
        none = body.constant([-1.0] * num, F64)  # a mask that no bin has
        zeros = body.constant([0.0, 0.0], F64)
        start = _Mask(none, body.constant(np.zeros((2, num, num)), F64), zeros, zeros, zeros)
        shapes = [(num,), (2, num, num), (2,), (2,), (2,), (num,), (num,), ()]
        step = _Bin(head, gaussians)
        _, (mean, variance) = body.scan(step, start, rows, shapes)
        largest = float(np.finfo(score.dtype).max)
        return [mean.clamp(-largest, largest).cast(score.dtype), variance]

    def nothing(body: Graph) -> list[Value]:
        own = score.at(body)
        return [own, body.op("Expand", body.constant(0.0, F64), body.op("Shape", own, dtype=I64))]

    found = graph.if_(is_lost.cast(I64).amax(1).amax(0) > 0, some, nothing)
    return found[0], found[1]


class _Bin:
    """The step from one bin to the next: the mask that was, then features, mask and score."""

    def __init__(self, head: QuadraticForm, gaussians: ClassGaussians) -> None:
        self._head = head
        self._gaussians = gaussians

    def __call__(
        self, graph: Graph, state: Sequence[Value], rows: Sequence[Value]
    ) -> tuple[list[Value], list[Value]]:
        before = _Mask(*state)
        z, is_lost, score = rows

        def missing(body: Graph) -> list[Value]:
            own = is_lost.at(body)
            is_same = (own - before.is_lost.at(body)).abs().amax(0) <= 0.0
            mask = _Mask(
                *body.if_(
                    is_same,
                    lambda inner: [part.at(inner) for part in before],
                    lambda inner: list(self._swept(inner, own.at(inner))),
                )
            )
            return [*mask, *self._expected(z.at(body), mask)]

        def whole(body: Graph) -> list[Value]:
            kept = [part.at(body) for part in before]
            return [*kept, score.at(body), body.constant(0.0, F64)]

        made = graph.if_(is_lost.amax(0) > 0.0, missing, whole)
        return list(made[:-2]), list(made[-2:])

    def _swept(self, graph: Graph, is_lost: Value) -> _Mask:
        """The precision swept on a mask, a feature at a time."""
        precision = Precision.of(self._gaussians)
        places = graph.op("NonZero", is_lost > 0.0, dtype=I64).squeeze(0)
        count = np.arange(self._head.num_features)

        def step(
            body: Graph, state: Sequence[Value], rows: Sequence[Value]
        ) -> tuple[list[Value], list[Value]]:
            swept, log_det = state
            unit = body.constant(count, I64).eq(rows[0]).cast(F64)  # [K]
            column = body.op("Gather", swept, rows[0], axis=2)  # [2, K]
            pivot = (column * unit).sum(1, keepdim=True)
            away = column - unit
            corner = unit.unsqueeze(1) * unit.unsqueeze(0) * 2.0
            after = swept - (away / pivot).unsqueeze(2) * away.unsqueeze(1) - corner
            return [after, log_det + pivot.log().squeeze(1)], []

        shapes = [(2, len(count), len(count)), (2,), ()]
        start = [matrix(graph, precision.matrix), matrix(graph, -precision.log_det)]
        (swept, log_det), _ = graph.scan(step, start, [places], shapes)
        bend = matrix(graph, self._head.dense_quadratic) * is_lost.unsqueeze(1) * is_lost
        bent = bend @ swept
        spread = (bent * bent.transpose(0, 2, 1)).sum(2).sum(1) * 2.0
        return _Mask(is_lost, swept, log_det, -(bend * swept).sum(2).sum(1), spread)

    def _expected(self, z: Value, mask: _Mask) -> list[Value]:
        """Mean and variance of the score of one bin, both ``[]``."""
        graph, head = z.graph, self._head
        is_seen = 1.0 - mask.is_lost
        middle = matrix(graph, self._gaussians.mean)
        quadratic, linear = matrix(graph, head.dense_quadratic), matrix(graph, head.linear)
        away = (z - middle) * is_seen  # [2, K]
        turned = (mask.swept @ away.unsqueeze(2)).squeeze(2)
        filled = z * is_seen + (middle - turned) * mask.is_lost
        evidence = ((turned * away).sum(1) + mask.log_det) * -0.5
        pull = filled @ quadratic
        mean = ((pull + linear) * filled).sum(1) + float(head.constant) + mask.lift
        slope = (pull * 2.0 + linear) * mask.is_lost
        variance = mask.spread - ((mask.swept @ slope.unsqueeze(2)).squeeze(2) * slope).sum(1)
        weight = graph.op("Softmax", evidence, axis=0)
        total = (weight * mean).sum(0)
        apart = mean - total
        return [total, (weight * (variance + apart * apart)).sum(0)]


def widened_llr_of(score: Value, variance: Value, calibration: Calibration) -> Value:
    """Log likelihood ratios of uncertain scores, ``[B] -> [B]``: ``widening.widened_llr``.

    Args:
        score: expected, in the precision of the form.
        variance: of the score, float64.
        calibration: from a score to its ratio.
    """
    llr, wide, away = llr_of(score, calibration), score.cast(F64), variance.sqrt()
    spread = (llr_of(wide + away, calibration) - llr_of(wide - away, calibration)) * 0.5
    widened = llr.cast(F64) / (spread * spread * (math.pi / 8) + 1.0).sqrt()
    return widened.cast(score.dtype)
