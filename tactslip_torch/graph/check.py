"""The self-check behind every export: a model that is wrong anywhere here is not left.

Structure first (operators, free axes, guards as onnxruntime runs them), then numbers against the
detector in float64, then a fresh process without torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from tactslip_torch.graph.bin_check import check_bins
from tactslip_torch.graph.facts import GraphKind, in_file
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.runs import Arrays, run_alone, runner, session_of
from tactslip_torch.graph.stream_check import check_stream
from tactslip_torch.graph.structure import (
    check_free_axes,
    check_guards,
    check_operators,
    size_limit,
)
from tactslip_torch.graph.trials import noise_bins, simulated_stream
from tactslip_torch.model.detector import SlipDetector

_FREE_AXES: dict[GraphKind, tuple[str, ...]] = {
    "bin": ("samples", "score", "probability", "valid"),
    "stream": ("samples", "tail", "state", "threshold", "score", "alarm", "time_s"),
}


def check_model(
    model: onnx.ModelProto, detector: SlipDetector, form: Form, kind: GraphKind
) -> dict[str, Any]:
    """Hold a model against its detector.

    Args:
        model: as written.
        detector: that it was made of.
        form: of its graph.
        kind: of its graph.

    Returns:
        What was measured, in JSON types.

    Raises:
        ValueError: for the first thing that is wrong, in one line.
    """
    check_operators(model)
    check_free_axes(model, dict.fromkeys(_FREE_AXES[kind], 0))
    facts: dict[str, Any] = {
        "against": "torch float64",
        "torch": torch.__version__,
        "onnxruntime": onnxruntime.__version__,
        "guards": check_guards(model),
    }
    run = runner(session_of(model))
    check = check_bins if kind == "bin" else check_stream
    return facts | check(run, detector, form)


def check_file(
    path: Path,
    facts: dict[str, Any],
    model: onnx.ModelProto,
    detector: SlipDetector,
    form: Form,
    *,
    alone: bool = True,
) -> None:
    """Hold the file of a checked model against it: its size, its metadata, and a fresh process.

    Args:
        path: of the file.
        facts: that stand in it.
        model: that it holds.
        detector: that it was made of.
        form: of its graph.
        alone: whether to start the fresh process, which takes a second.

    Raises:
        ValueError: for the first thing that is wrong, in one line.
    """
    size = path.stat().st_size
    plan, lengths = detector.extractor.plan, detector.channel_filter.window_lengths
    limit = size_limit(
        form.precision,
        sum(buffer.numel() for buffer in detector.head.buffers()),
        len({lengths[channel] for channel in plan.channels}),
        len(plan.share_channels),
        len({(row.branch, row.kind) for row in plan.rows}),
        detector.pool.bin_samples,
        0 if detector.gaussians is None else 4 * detector.head.num_features**2,
    )
    if size > limit:
        raise ValueError(f"its file has {size} bytes, more than {limit}")
    session = session_of(onnx.load(path))
    if session.get_modelmeta().custom_metadata_map != in_file(facts):
        raise ValueError("its metadata do not come back from the file")
    if alone:
        inputs = _inputs(facts["graph"], detector, form)
        here, there = runner(session_of(model))(inputs), run_alone(path, inputs)
        for name, array in here.items():
            if not np.array_equal(array, there[name], equal_nan=array.dtype != bool):
                raise ValueError(f"in a fresh process {name} is another")


def _inputs(kind: GraphKind, detector: SlipDetector, form: Form) -> Arrays:
    """What a model is run on once."""
    hand, rate = detector.pool.hand, detector.pool.sample_rate_hz
    dtype = torch.float32 if form.precision == "float32" else torch.float64
    if kind == "bin":
        bins = noise_bins(hand, 7, Window.of(detector).length, 0, dtype)
        return {"samples": bins.numpy()}
    first = 2 * Window.of(detector).length  # enough for a decision at any rate
    samples = simulated_stream(hand, rate, dtype, first).T[: max(round(rate / 2), first)]
    return {
        "samples": np.ascontiguousarray(samples.numpy()),
        "tail": np.empty((0, len(hand)), form.dtype),
        "state": np.empty(0),
        "threshold": np.empty(0),
    }
