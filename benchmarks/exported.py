"""The exported file in onnxruntime, as a peer of the engines."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import onnxruntime

from benchmarks.clocks import say
from benchmarks.detectors import Timed
from benchmarks.engines import FLOAT64
from tactslip_torch.export import export_onnx

ORT = "onnxruntime, float32 in, float64 inside, with validity"


def session(timed: Timed, threads: int) -> Callable[[Any], Any]:
    """Scores by onnxruntime, of raw bins with their context.

    Args:
        timed: what is exported.
        threads: it may use.

    Shape:
        - samples: ``[N, C, n + 2 * context]``, float32
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    made = onnxruntime.InferenceSession(
        _content(timed), options, providers=["CPUExecutionProvider"]
    )
    return lambda samples: made.run(["score", "valid"], {"samples": samples})[0]


@lru_cache(maxsize=1)
def _content(timed: Timed) -> bytes:
    say("export to ONNX")
    with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as folder:
        path = Path(folder) / "model.onnx"
        export_onnx(timed.detector("reference", FLOAT64), path)
        return path.read_bytes()
