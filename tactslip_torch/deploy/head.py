"""From features to scores, as nodes: pooling, scaling, head, missing channels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.deploy.value import F32, F64, I64, Value
from tactslip_torch.features.pooling import over_channels
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import Head, KernelSum, Polynomial, QuadraticForm
from tactslip_torch.model.missing_channels import (
    ClassGaussians,
    added_by_missing,
    score_of_mixture,
)
from tactslip_torch.model.scaling import FeatureScaler

_LARGEST = float(np.finfo(np.float64).max)


def scored(
    features: Value, is_missing: Value, detector: SlipDetector, dtype: np.dtype[Any]
) -> tuple[Value, Value | None]:
    """Scores, and their variance: None of a detector that knows of none.

    Args:
        features: of channels, float64; anything where missing.
        is_missing: which channels in use are, bool.
        detector: whose columns, scaler and head.
        dtype: of scores.

    Shape:
        - features: ``[B, M]``; is_missing: ``[B, channels in use]``
        - scores: ``[B]``; variance: ``[B]``, float64
    """
    head, gaussians = detector.head, detector.gaussians
    channels = detector.extractor.plan.channels
    z = scaled(_pooled(features, is_missing, detector), detector.scaler)
    # a column that is pooled is of no channel; a product is quicker than to pick flags
    of_channel = np.equal.outer(np.array(channels), detector.channel_index.numpy())
    is_lost = is_missing.cast(F32) @ of_channel > 0.0  # [B, K]
    score = machine(is_lost.graph.where(is_lost, _float64(z, detector.imputation), z), head, dtype)
    if gaussians is None or not isinstance(head, QuadraticForm):
        return score, None
    return _expected_scores(score, z, is_lost, head, gaussians)


def _pooled(features: Value, is_missing: Value, detector: SlipDetector) -> Value:
    """Columns for the scaler, ``[B, K]``, float64: ``ChannelPooling``; without one as they are."""
    layer, graph = detector.pooling, features.graph
    if layer is None:
        return features
    used = detector.extractor.plan.channels
    columns, is_some = list[Any](), list[Value]()
    if layer.singles:
        columns.append(features.take(layer.singles, 1))
    for index, group in enumerate(layer.groups):
        num = len(group.channels)
        least = float(layer.least_range[index])
        is_lost = is_missing.take([used.index(channel) for channel in group.channels], 1)
        in_use: Any = ~((features.take(group.ranges, 1) < least) | is_lost)
        is_some.append(in_use.any(1, keepdim=True))
        values = features.take(group.columns, 1).reshape(0, len(group.families), num)
        knee = layer.knee[list(group.families), None].double()
        bent: Any = (values.abs() * (1 / knee) + 1.0).log() * values.sign() * knee
        columns += over_channels(bent, in_use.unsqueeze(1), group.statistics, num)
    always = is_some[0] | ~is_some[0]
    known = graph.concat(*is_some, always, axis=1).cast(F32).take(layer.kind_of, 1) > 0.0
    made = graph.concat(*columns, axis=1).take(layer.order, 1)
    return graph.where(known, made, _float64(made, layer.fill))


def scaled(features: Value, scaler: FeatureScaler) -> Value:
    """Features in [-1, 1], ``[B, K]``, float64: ``FeatureScaler``.

    ONNX has no ``log1p``: the knee becomes ``Log(1 + x)``, off by some eps of the knee.
    """
    least, width = scaler.minimum.double(), (scaler.maximum - scaler.minimum).double()
    is_point = width == 0
    slope = torch.where(is_point, 0.0, 2 / width.masked_fill(is_point, 1.0))
    offset = torch.where(is_point, 0.0, -1 - slope * least)
    if bool(is_point.any()):  # 0 times Inf
        features = features.clamp(-_LARGEST, _LARGEST)
    if scaler.knee is not None:
        knee = scaler.knee.double()
        slope = slope * knee
        features = (features.abs() * (1 / knee) + 1.0).log() * features.sign()
    return (features * slope + _float64(features, offset)).clamp(-1.0, 1.0)


def machine(z: Value, head: Head, dtype: np.dtype[Any]) -> Value:
    """The score of scaled features: ``[B, K] -> [B]``.

    A quadratic form is computed in the dtype of scores. The sum over training bins of a kernel that
    does not fold cancels, so it is float64 always.
    """
    if isinstance(head, KernelSum):
        score = _kernel_sum(z, head)
    else:
        z = z.cast(dtype)
        pull: Value = z.graph.constant(head.linear.double(), dtype)
        if not head.is_linear:
            pull = z @ head.quadratic.double() + pull
        score = (pull * z).sum(1) + float(head.constant)
    largest = float(np.finfo(dtype).max)
    return score.clamp(-largest, largest).cast(dtype)


def _kernel_sum(z: Value, head: KernelSum) -> Value:
    support, kernel = head.support.double(), head.kernel
    gram = z @ support.T.double()
    if isinstance(kernel, Polynomial):
        base = gram + kernel.offset
        values = base
        for _ in range(kernel.degree - 1):
            values = values * base
    else:
        norms = _float64(z, support.square().sum(-1))
        squares = (z * z).sum(1, keepdim=True) + norms - gram * 2.0
        values = (squares.clamp(min=0.0) * -kernel.gamma).exp()
    return (values @ head.beta[:, None].double()).squeeze(1)


# Missing channels ------------------------------------------------------------------------------


def _expected_scores(
    score: Value, z: Value, is_lost: Value, head: QuadraticForm, gaussians: ClassGaussians
) -> tuple[Value, Value]:
    """Expected scores and variances (``model.missing_channels``); 0 of bins that miss nothing.

    ONNX has no solver. The precision of the features is swept on those that are missing, one after
    the other (``Scan``): a step is one term of rank one, so all of it is exact, of as many steps as
    features are missing, and of the memory of one mask however many bins come. Bins that miss the
    same as the one before share its matrices. Where nothing is missing, none of it is run.
    """
    graph, num = score.graph, head.num_features

    def bin_by_bin() -> list[Value]:
        rows = [graph.where(is_lost, 0.0, z), is_lost.cast(F64), score.cast(F64)]
        no_mask = graph.constant([-1.0] * num, F64)  # no bin has it
        zeros = graph.constant([0.0, 0.0], F64)
        start = [no_mask, graph.constant(np.zeros((2, num, num)), F64), zeros, zeros, zeros]
        shapes = [(num,), (2, num, num), (2,), (2,), (2,), (num,), (num,), ()]
        _, (mean, variance) = graph.scan(one_bin, start, rows, shapes)
        largest = float(np.finfo(score.dtype).max)
        return [mean.clamp(-largest, largest).cast(score.dtype), variance]

    def one_bin(before: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        own_z, own_lost, own_score = row

        def missing() -> list[Value]:
            is_same = (own_lost - before[0]).abs().amax(0) <= 0.0
            mask = graph.if_(is_same, lambda: before, lambda: _swept(own_lost, head, gaussians))
            of_mask: list[Any] = [mask[1:3], mask[3:]]
            bins: list[Any] = [own_z.unsqueeze(0), own_lost > 0.0]  # [1, K] and [K]
            found: list[Any] = list(score_of_mixture(head, gaussians, *bins, *of_mask))
            return [*mask, *(each.squeeze(0) for each in found)]

        def whole() -> list[Value]:
            return [*before, own_score, graph.constant(0.0, F64)]

        made = graph.if_(own_lost.amax(0) > 0.0, missing, whole)
        return made[:-2], made[-2:]

    is_any = is_lost.cast(I64).amax(1).amax(0) > 0
    mean, variance = graph.if_(is_any, bin_by_bin, lambda: [score, score.cast(F64) * 0.0])
    return mean, variance


def _swept(is_lost: Value, head: QuadraticForm, gaussians: ClassGaussians) -> list[Value]:
    """What a mask makes of both classes, behind the mask itself ``[K]``, 1 or 0.

    The swept precision ``[2, K, K]``, the log determinant of the observed covariance ``[2]``, and
    what the missing features add to the mean and to the variance of a score, ``[2]`` each.
    """
    graph, (precision, log_det_of_all) = is_lost.graph, gaussians.precision()
    count = np.arange(head.num_features)
    places = graph.op("NonZero", is_lost > 0.0, dtype=I64).squeeze(0)

    def on_one(state: list[Value], row: list[Value]) -> tuple[list[Value], list[Value]]:
        swept, log_det = state
        unit = graph.constant(count, I64).eq(row[0]).cast(F64)  # [K]
        column = graph.op("Gather", swept, row[0], axis=2)  # [2, K]
        pivot = (column * unit).sum(1, keepdim=True)
        away = column - unit
        corner = unit.unsqueeze(1) * unit.unsqueeze(0) * 2.0
        after = swept - (away / pivot).unsqueeze(2) * away.unsqueeze(1) - corner
        return [after, log_det + pivot.log().squeeze(1)], []

    start = [_float64(is_lost, precision), _float64(is_lost, -log_det_of_all)]
    shapes = [(2, len(count), len(count)), (2,), ()]
    (swept, log_det), _ = graph.scan(on_one, start, [places], shapes)
    pair: list[Any] = [is_lost.unsqueeze(1) * is_lost, swept]
    added: list[Any] = list(added_by_missing(head, *pair))
    return [is_lost, swept, log_det, *added]


def _float64(like: Value, x: Tensor) -> Value:
    """A tensor as a constant in float64, in the graph of a value."""
    return like.graph.constant(x.double(), F64)
