"""A first score in a fresh process: imports nothing before its clock runs that a way needs not."""

from __future__ import annotations

import time
from typing import Any


def first_score(path: str, bin_path: str) -> dict[str, float]:
    """Seconds to import, to load, and to the first score of a bin.

    Args:
        path: of a bin graph, which onnxruntime runs, or of a detector for the package.
        bin_path: of a raw bin with all its context, ``.npy``.
    """
    started = time.perf_counter()
    import numpy as np

    if path.endswith(".onnx"):
        import onnxruntime

        imported = time.perf_counter()
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        bins: Any = np.load(bin_path)
        num = session.get_inputs()[0].shape[-1]
        first = (bins.shape[-1] - num) // 2
        loaded = time.perf_counter()
        session.run(["score"], {"samples": bins[..., first : first + num]})
    else:
        import torch

        from tactslip_torch import SlipDetector

        imported = time.perf_counter()
        detector = SlipDetector.load(path)
        bins = torch.from_numpy(np.load(bin_path))
        loaded = time.perf_counter()
        with torch.inference_mode():
            detector.score_raw(bins)
    done = time.perf_counter()
    return {"import": imported - started, "load": loaded - imported, "first": done - loaded}
