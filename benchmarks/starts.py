"""A first score in a fresh process: imports nothing before its clock runs that a way needs not."""

from __future__ import annotations

import time


def by_onnxruntime(path: str, bin_path: str) -> dict[str, float]:
    """Seconds to import onnxruntime, to load a bin graph, and to its first score."""
    started = time.perf_counter()
    import numpy as np
    import onnxruntime

    imported = time.perf_counter()
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    bins = np.load(bin_path)
    num = session.get_inputs()[0].shape[-1]
    first = (bins.shape[-1] - num) // 2
    loaded = time.perf_counter()
    session.run(["score"], {"samples": bins[..., first : first + num]})
    return _seconds(started, imported, loaded)


def by_package(path: str, bin_path: str) -> dict[str, float]:
    """Seconds to import the package, to load a detector, and to its first score."""
    started = time.perf_counter()
    import numpy as np
    import torch

    from tactslip_torch import SlipDetector

    imported = time.perf_counter()
    detector = SlipDetector.load(path)
    bins = torch.from_numpy(np.load(bin_path))
    loaded = time.perf_counter()
    with torch.inference_mode():
        detector.score_raw(bins)
    return _seconds(started, imported, loaded)


def _seconds(started: float, imported: float, loaded: float) -> dict[str, float]:
    done = time.perf_counter()
    return {
        "import_s": imported - started,
        "load_s": loaded - imported,
        "first_s": done - loaded,
    }
