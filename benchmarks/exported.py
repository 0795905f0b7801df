"""Exported files in onnxruntime, as peers of the engines."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.clocks import say
from benchmarks.detectors import Timed
from benchmarks.engines import FLOAT32, FLOAT64
from tactslip_torch.graph.export import export_detector
from tactslip_torch.graph.form import Precision

ORT = "onnxruntime, float32, with validity"
Array = NDArray[Any]


class Judge(NamedTuple):
    """A bin graph that is loaded.

    Attributes:
        cut: raw bins with all context ``[N, C, n + 2 * context]`` to what the file takes.
        run: that to scores ``[N]``; flags are made as well.
    """

    cut: Callable[[Tensor], Array]
    run: Callable[[Array], Array]


def session_of(model: Path | bytes, threads: int) -> onnxruntime.InferenceSession:
    """A file, or its content, loaded to run on so many threads of one operator."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3  # errors alone: it warns of how it rewrites graphs
    source = model if isinstance(model, bytes) else str(model)
    return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])


def judge_of(model: Path | bytes, threads: int, context: int) -> Judge:
    """The judge that a file of ``export_detector`` is.

    Args:
        model: the file or its content.
        threads: it may use.
        context: samples on each side of the bins that will be cut.
    """
    made = session_of(model, threads)
    facts = made.get_modelmeta().custom_metadata_map
    before, after = (json.loads(facts[f"context_{side}_samples"]) for side in ("before", "after"))
    dtype = np.dtype(json.loads(facts["precision"]))

    def cut(samples: Tensor) -> Array:
        kept = samples[..., context - before : samples.shape[-1] - context + after]
        return np.ascontiguousarray(kept.numpy(), dtype)

    return Judge(cut, lambda x: np.asarray(made.run(["score", "valid"], {"samples": x})[0]))


def session(timed: Timed, threads: int) -> Judge:
    """Scores in float32 by onnxruntime.

    Args:
        timed: what is exported.
        threads: it may use.
    """
    context = timed.detector("reference", FLOAT64).channel_filter.context
    return judge_of(_content(timed, FLOAT32), threads, context)


@lru_cache(maxsize=2)
def _content(timed: Timed, precision: Precision) -> bytes:
    say(f"export to ONNX, {precision}")
    with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as folder:
        detector = timed.detector("eager", FLOAT64)  # in its check the reference takes long
        export_detector(detector, Path(folder), ("bin",), precision, alone=False)
        return (Path(folder) / "model.onnx").read_bytes()
