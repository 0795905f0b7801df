"""A first score in a fresh process: what is imported, what is loaded, and what it takes.

``python -m benchmarks.deployment.start HOW MODEL BIN`` is that process; it imports nothing before
its clock runs that the way does not need.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
ONNXRUNTIME, PACKAGE = "onnxruntime", "tactslip_torch"
PARTS = ("import_s", "load_s", "first_s")


class StartFailedError(RuntimeError):
    """A process ended without a score."""


def started(how: str, model: Path, samples: Path) -> dict[str, Any]:
    """Start a process and wait for its first score.

    Args:
        how: ``ONNXRUNTIME``, or ``PACKAGE:engine``.
        model: the file it loads.
        samples: a raw bin in an ``.npy`` file, as the file takes it.

    Returns:
        ``seconds`` from the start of the process to its score, its ``PARTS``, and the ``score``.

    Raises:
        StartFailedError: if it ends without one.
    """
    command = [sys.executable, "-m", "benchmarks.deployment.start", how, str(model), str(samples)]
    begun = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None  # it was asked for
        line = process.stdout.readline()
        seconds = time.perf_counter() - begun
    if process.returncode or not line:
        raise StartFailedError(f"a process with {how} ended without a score; see above")
    *parts, score = map(float, line.split())
    return {"seconds": seconds, "score": score} | dict(zip(PARTS, parts, strict=True))


def starts(
    jobs: Mapping[str, tuple[str, Path, Path]], rounds: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Rows of several processes, started in turns.

    Args:
        jobs: arguments of ``started`` by way.
        rounds: how often.
        say: told what is going on.
    """
    found: dict[str, list[dict[str, Any]]] = {way: [] for way in jobs}
    for number in range(rounds):
        say(f"deployment: fresh processes, round {number + 1} of {rounds}")
        for way, job in jobs.items():
            found[way].append(started(*job))
    keys = ("seconds", *PARTS, "score")
    return [
        {"way": way, **{key: [o[key] for o in of] for key in keys}} for way, of in found.items()
    ]


def main(arguments: Sequence[str]) -> None:
    """Entry point of the process."""
    how, model, samples = arguments
    times = [time.perf_counter()]
    import numpy as np

    if how == ONNXRUNTIME:
        import onnxruntime

        times.append(time.perf_counter())
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        made = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        x = np.load(samples)
        times.append(time.perf_counter())
        value = float(made.run(["score"], {"samples": x})[0][0])
    else:
        import torch

        from tactslip_torch.model.detector import SlipDetector

        times.append(time.perf_counter())
        engine: Any = how.partition(":")[2]
        detector = SlipDetector.load(model, engine)
        bins = torch.from_numpy(np.load(samples))
        times.append(time.perf_counter())
        with torch.inference_mode():
            value = float(detector.judge_raw(bins).score[0])
    times.append(time.perf_counter())
    print(*(after - before for before, after in pairwise(times)), value)


if __name__ == "__main__":
    main(sys.argv[1:])
