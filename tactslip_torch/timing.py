"""How long a decision takes here: ``python -m tactslip_torch.timing detector.pt``.

One bin at a time and one thread, as a live loop calls it, from raw samples to the decision. Prints
a line of JSON: p50 and p99 in microseconds. The bins are ordinary ones: one with a NaN goes another
way, which takes longer. The number of calls in each of five runs (1000) and the engine (``auto``)
may follow the name of the file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import NamedTuple, cast

import torch
from torch import Tensor

from tactslip_torch.features.extractor import EngineName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector


class Timing(NamedTuple):
    """Microseconds of a call: of several runs, the median of their medians and of their p99.

    One run that a neighbour on the machine spoils does not decide.
    """

    p50_us: float
    p99_us: float
    calls: int


def time_calls(
    call: Callable[[Tensor], object], inputs: Sequence[Tensor], calls: int, runs: int = 3
) -> Timing:
    """Time a call on one input after the other, each by itself."""
    for given in inputs:
        call(given)
    middles, ends = [], []
    for _ in range(runs):
        taken = []
        for number in range(calls):
            given = inputs[number % len(inputs)]
            started = time.perf_counter_ns()
            call(given)
            taken.append(time.perf_counter_ns() - started)
        taken.sort()
        middles.append(taken[len(taken) // 2] / 1000)
        ends.append(taken[-(-99 * len(taken) // 100) - 1] / 1000)
    return Timing(median(middles), median(ends), calls)


def time_detector(detector: SlipDetector, calls: int, runs: int = 3) -> Timing:
    """Time ``judge_raw`` of one ordinary bin, float32, as a live loop calls it."""
    pool = detector.pool
    inputs = single_bins(pool, pool.bin_samples + 2 * detector.channel_filter.context)
    with torch.inference_mode():
        return time_calls(detector.judge_raw, inputs, calls, runs)


def time_in_fresh_process(
    path: str | os.PathLike[str], calls: int, engine: EngineName = "auto"
) -> Timing:
    """``time_detector`` of a saved detector in a process that has done nothing else.

    Raises:
        ValueError: if that process fails; its last line is named.
    """
    command = [sys.executable, "-m", "tactslip_torch.timing", os.fspath(path), str(calls)]
    command.append(engine)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
        raise ValueError(f"timing {os.fspath(path)} in a fresh process failed: {said}")
    return Timing(**json.loads(done.stdout.splitlines()[-1]))


@contextmanager
def one_thread() -> Iterator[None]:
    """One intra-op thread, as a live loop has."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def single_bins(pool: FeaturePool, num_samples: int) -> list[Tensor]:
    """Single ordinary bins in volts, ``[1, C, num_samples]`` each, float32."""
    generator = torch.Generator().manual_seed(0)
    shape = (32, 1, len(pool.hand), num_samples)
    return list(0.1 * torch.randn(shape, generator=generator) + 1)


def main(arguments: Sequence[str]) -> None:
    """Print the timing of a saved detector as a line of JSON."""
    if not 1 <= len(arguments) <= 3:
        raise SystemExit("usage: python -m tactslip_torch.timing detector.pt [calls [engine]]")
    path, calls, engine = [*arguments, *("1000", "auto")[len(arguments) - 1 :]]
    with one_thread():
        detector = SlipDetector.load(Path(path), cast(EngineName, engine))
        timing = time_detector(detector, int(calls), runs=5)
    print(json.dumps(timing._asdict()))


if __name__ == "__main__":
    main(sys.argv[1:])
