"""From features to a score, as nodes: scaling, missing channels, and the machine."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.pooling import over_channels
from tactslip_torch.graph.form import Form
from tactslip_torch.graph.value import BOOL, F32, F64, I64, Nodes, Value
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import Head, KernelSum, Polynomial
from tactslip_torch.model.scaling import FeatureScaler

_LARGEST = float(np.finfo(np.float64).max)


def pooled(graph: Graph, features: Value, is_missing: Value, detector: SlipDetector) -> Value:
    """Columns for the scaler, ``[B, K]``, float64: ``ChannelPooling``; without one as they are.

    Args:
        graph: to which nodes are added.
        features: of channels, ``[B, M]``, float64.
        is_missing: ``[B, channels in use]``, bool.
        detector: whose columns.
    """
    layer = detector.pooling
    if layer is None:
        return features
    used = detector.extractor.plan.channels
    parts, is_some = list[Any](), list[Value]()
    if layer.singles:
        parts.append(features.take(layer.singles, 1))
    for index, group in enumerate(layer.groups):
        num = len(group.channels)
        least = float(layer.least_range[index])
        is_lost = is_missing.take([used.index(channel) for channel in group.channels], 1)
        in_use = ~((features.take(group.ranges, 1) < least) | is_lost)
        is_some.append(in_use.cast(I64).amax(1, True).cast(BOOL))
        values = features.take(group.columns, 1).reshape(0, len(group.families), num)
        knee = layer.knee[list(group.families), None]
        size = (values.abs() * graph.constant(_of(1 / knee), F64) + 1.0).log()
        bent: Any = size * graph.op("Sign", values) * graph.constant(_of(knee), F64)
        in_rows: Any = in_use.unsqueeze(1)
        parts += over_channels(bent, in_rows, group.statistics, num)
    columns = graph.concat(*parts, axis=1).take(layer.order, 1)
    always = is_some[0] | ~is_some[0]
    known = graph.concat(*is_some, always, axis=1).cast(F32).take(layer.kind_of, 1) > 0.0
    return graph.where(known, columns, matrix(graph, layer.fill))


def scaled(graph: Graph, features: Value, scaler: FeatureScaler) -> Value:
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
        bent = (features.abs() * graph.constant(_of(1 / knee), F64) + 1.0).log()
        features = bent * graph.op("Sign", features)
    z = features * graph.constant(_of(slope), F64) + graph.constant(_of(offset), F64)
    return z.clamp(-1.0, 1.0)


def lost_features(is_missing: Value, detector: SlipDetector) -> Value:
    """Which columns are of missing channels in use: ``[B, channels] -> [B, K]``, bool.

    Those that are pooled are of no channel.
    """
    used = detector.extractor.plan.channels
    of_channel = np.equal.outer(np.array(used), detector.channel_index.numpy())
    found: Value = (
        is_missing.cast(F32) @ of_channel > 0.0
    )  # a product is quicker than to pick flags
    return found


def with_typical(graph: Graph, z: Value, is_lost: Value, detector: SlipDetector) -> Value:
    """Scaled features ``[B, K]``, those that are lost replaced by imputation values."""
    return graph.where(is_lost, matrix(graph, detector.imputation), z)


def matrix(graph: Nodes, x: Tensor) -> Value:
    """A tensor as a constant in float64."""
    return graph.constant(_of(x), F64)


def machine(graph: Graph, z: Value, head: Head, form: Form) -> Value:
    """The score of scaled features: ``[B, K] -> [B]``, in the precision of the form.

    A quadratic form is computed in that precision. The sum over training bins of a kernel that does
    not fold cancels, so it is float64 in either.
    """
    if isinstance(head, KernelSum):
        score = _kernel_sum(graph, z, head)
    else:
        z = z.cast(form.dtype)
        pull = graph.constant(_of(head.linear), form.dtype)
        if not head.is_linear:
            pull = z @ _of(head.quadratic) + pull
        score = (pull * z).sum(1) + float(head.constant)
    largest = float(np.finfo(form.dtype).max)
    return score.clamp(-largest, largest).cast(form.dtype)


def _kernel_sum(graph: Graph, z: Value, head: KernelSum) -> Value:
    support = head.support.double()
    kernel = head.kernel
    gram = z @ _of(support.T)
    if isinstance(kernel, Polynomial):
        base = gram + kernel.offset
        values = base
        for _ in range(kernel.degree - 1):
            values = values * base
    else:
        norms = graph.constant(_of(support.square().sum(-1)), F64)
        squares = (z * z).sum(1, keepdim=True) + norms - gram * 2.0
        values = (squares.clamp(min=0.0) * -kernel.gamma).exp()
    return (values @ _of(head.beta[:, None])).squeeze(1)


def _of(x: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.ascontiguousarray(x.double().numpy())
