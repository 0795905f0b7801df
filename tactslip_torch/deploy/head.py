"""From features to scores, as nodes: pooling, scaling, head, lost channels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.deploy.value import F32, F64, Value
from tactslip_torch.features.pooling import over_channels
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import Head, KernelSum
from tactslip_torch.model.scaling import FeatureScaler

_LARGEST = float(np.finfo(np.float64).max)


def scored(features: Value, is_lost: Value, detector: SlipDetector, dtype: np.dtype[Any]) -> Value:
    """Scores; columns of lost channels take their imputation values.

    Args:
        features: of channels, float64; anything where lost.
        is_lost: which channels in use are, bool.
        detector: whose columns, scaler and head.
        dtype: of scores.

    Shape:
        - features: ``[B, M]``; is_lost: ``[B, channels in use]``
        - output: ``[B]``
    """
    channels = detector.extractor.plan.channels
    z = scaled(_pooled(features, is_lost, detector), detector.scaler)
    # a column that is pooled is of no channel; a product is quicker than to pick flags
    of_channel = np.equal.outer(np.array(channels), detector.channel_index.numpy())
    if of_channel.any():
        is_filled = is_lost.cast(F32) @ of_channel > 0.0  # [B, K]
        z = z.graph.where(is_filled, _float64(z, detector.imputation), z)
    return machine(z, detector.head, dtype)


def _pooled(features: Value, is_lost: Value, detector: SlipDetector) -> Value:
    """Columns for the scaler, ``[B, K]``, float64: ``ChannelPooling``; without one as they are."""
    layer, graph = detector.pooling, features.graph
    if layer is None:
        return features
    used = detector.extractor.plan.channels
    columns, is_some = list[Any](), list[Value]()
    if layer.singles:
        columns.append(features.take(layer.singles, 1))
    for group in layer.groups:
        num = len(group.channels)
        in_use: Any = ~is_lost.take([used.index(channel) for channel in group.channels], 1)
        is_some.append(in_use.any(1, keepdim=True))
        values = features.take(group.columns, 1).reshape(0, len(group.families), num)
        scale = layer.compression[list(group.families), None].double()
        bent: Any = (values.abs() * (1 / scale) + 1.0).log() * values.sign() * scale
        columns += over_channels(bent, in_use.unsqueeze(1), group.statistics, num)
    always = is_some[0] | ~is_some[0]
    known = graph.concat(*is_some, always, axis=1).cast(F32).take(layer.kind_of, 1) > 0.0
    made = graph.concat(*columns, axis=1).take(layer.order, 1)
    return graph.where(known, made, _float64(made, layer.fill))


def scaled(features: Value, scaler: FeatureScaler) -> Value:
    """Features in [-1, 1], ``[B, K]``, float64: ``FeatureScaler``.

    ONNX has no ``log1p``: the logarithm becomes ``Log(1 + x)``, off by some eps of the scale.
    """
    least, width = scaler.minimum.double(), (scaler.maximum - scaler.minimum).double()
    is_point = width == 0
    slope = torch.where(is_point, 0.0, 2 / width.masked_fill(is_point, 1.0))
    offset = torch.where(is_point, 0.0, -1 - slope * least)
    if bool(is_point.any()):  # 0 times Inf
        features = features.clamp(-_LARGEST, _LARGEST)
    if scaler.compression is not None:
        scale = scaler.compression.double()
        slope = slope * scale
        features = (features.abs() * (1 / scale) + 1.0).log() * features.sign()
    return (features * slope + _float64(features, offset)).clamp(-1.0, 1.0)


def machine(z: Value, head: Head, dtype: np.dtype[Any]) -> Value:
    """The score of scaled features: ``[B, K] -> [B]``.

    A quadratic form is computed in the dtype of scores. The sum over training bins
    cancels, so it is float64 always.
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
    base = z @ head.support.T.double() + head.kernel.offset
    values = base if head.kernel.degree == 1 else base * base
    return (values @ head.beta[:, None].double()).squeeze(1)


def _float64(like: Value, x: Tensor) -> Value:
    """A tensor as a constant in float64, in the graph of a value."""
    return like.graph.constant(x.double(), F64)
