"""Onset scores of a stream, as nodes: what ``OnsetStream.push`` does, in float64."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from onnx import numpy_helper

from tactslip_torch.deploy.head import machine, scaled
from tactslip_torch.deploy.value import END, F64, Graph, Value
from tactslip_torch.onset.evidence import MEAN_HOPS, OnsetClassifier, OnsetEvidence
from tactslip_torch.onset.rules import NOTHING_YET


def memory_size(evidence: OnsetEvidence) -> int:
    """Numbers that are kept: scores of hops, half the log power and the means of blocks."""
    return MEAN_HOPS - 1 + sum(rows * width for rows, width in _memory_shapes(evidence))


def _memory_shapes(evidence: OnsetEvidence) -> list[tuple[int, int]]:
    """Of fast and slow channels, a row a block."""
    num_logs = len(evidence.hand.fast) * len(evidence.fast_knee)
    return [
        (evidence.memory - 1, num_logs),
        (len(evidence.step_matrix) - 1, len(evidence.hand.slow)),
    ]


def memory_start(graph: Graph, evidence: OnsetEvidence) -> Value:
    """What is kept before the first block: NaN, on which no score rests."""
    nothing = numpy_helper.from_array(np.array([np.nan]))
    size = graph.axes(memory_size(evidence))
    return graph.op("ConstantOfShape", size, dtype=F64, value=nothing)


def onset_scores(
    samples: Value, places: Value, memory: Value, classifier: OnsetClassifier, masked: Value
) -> tuple[Value, Value]:
    """Scores of hops, ``NOTHING_YET`` where there is no evidence, and what is kept.

    Args:
        samples: from ``context`` samples before the first of these hops on; NaN before a stream.
        places: of the hops, from 0.
        memory: of ``memory_start`` or the call before.
        classifier: that scores.
        masked: channels that are not to be listened to.

    Shape:
        - samples: ``[m, C]``; places: ``[k]``, int64, k at least 1; masked: ``[C]``
        - output: ``[k]``, float64, and as memory
    """
    evidence, graph = classifier.evidence, samples.graph
    fast, slow = evidence.hand.fast, evidence.hand.slow
    hop, context, num_filters = evidence.hop_samples, evidence.context, len(evidence.fast_knee)
    longest, num_windows = evidence.windows[-1], len(evidence.windows)
    first = places.unsqueeze(1)

    def windows(rows: Value, start: Value, places: range) -> Value:
        """Rows at some places behind each start: ``[m, *]`` to ``[k, places, *]``."""
        return graph.op("Gather", rows, start + graph.axes(*places), axis=0)

    frames = windows(samples.take(fast, 1), first * hop, range(context + hop)).cast(F64)
    heard = graph.constant(evidence.filter_matrix.T, F64) @ (frames - frames.slice(0, 1, 1))
    to_power = np.kron(np.eye(num_filters), np.full(hop, 1 / hop))
    square = graph.constant(to_power, F64) @ (heard * heard)  # [k, B, F]
    power = square + np.square(evidence.fast_knee)[:, None]
    made = [power.reshape(0, num_filters * len(fast)).log() * 0.5]
    if slow:
        block = windows(samples.take(slow, 1), first * hop, range(context, context + hop))
        made.append(block.cast(F64).mean(1))
    shapes = _memory_shapes(evidence)[: len(made)]
    sizes = graph.axes(MEAN_HOPS - 1, *(num * width for num, width in shapes))
    dtypes = [F64] * (1 + len(made))
    of_hops, *kept = graph.ops("Split", memory, sizes, dtypes=dtypes, axis=0)
    rows = [
        graph.concat(before.reshape(num, width), own, axis=0)
        for before, own, (num, width) in zip(kept, made, shapes, strict=True)
    ]
    logs, num_floor = rows[0], evidence.memory - longest

    def one_floor() -> list[Value]:  # by a product, which copies nothing
        weights = np.append(np.full(num_floor, 1 / num_floor), np.zeros(longest))
        return [graph.constant(weights[None], F64) @ logs]

    def floors() -> list[Value]:
        return [windows(logs, first, range(num_floor)).mean(1)]

    (floor,) = graph.if_(places.length(0).eq(1), one_floor, floors)
    to_means = np.zeros((num_windows, longest))
    for means, length in zip(to_means, evidence.windows, strict=True):
        means[-length:] = 1 / length
    latest = (windows(logs, first, range(num_floor, evidence.memory)) * 2.0).exp()
    measured: list[Any] = [
        (graph.constant(to_means, F64) @ latest).reshape(0, num_windows, num_filters, len(fast)),
        floor.reshape(0, num_filters, len(fast)),
        None,
        ~masked.take(fast, 0),
        None,
    ]
    if slow:
        latest = windows(rows[1], first, range(len(evidence.step_matrix)))
        measured[2] = graph.constant(evidence.step_matrix.T, F64) @ (latest - latest.slice(0, 1, 1))
        measured[4] = ~masked.take(slow, 0)
    pooled: Any = evidence.pooled(*measured)
    columns, is_usable = pooled
    score = machine(scaled(columns, classifier.scaler), classifier.head, F64)
    scores = graph.concat(of_hops, graph.where(is_usable, score, math.nan), axis=0)
    mean = windows(scores, first, range(MEAN_HOPS)).mean(1)
    after = [x.slice(-num, END, 0).reshape(-1) for x, (num, _) in zip(rows, shapes, strict=True)]
    after = [scores.slice(1 - MEAN_HOPS, END, 0), *after]
    return graph.where(mean.isfinite(), mean, NOTHING_YET), graph.concat(*after, axis=0)
