"""How long a decision takes here, by itself or in a fresh process.

``python -m tactslip_torch.deadline.timing detector.pt [calls [engine]]`` prints it.

One bin at a time and one thread, as a live loop calls it, from raw samples to the decision. Prints
a line of JSON: p50 and p99 in microseconds. Calls in which the system gave the processor to someone
else (an involuntary context switch, where the system counts them) are left out, and their share is
told, as is the p99 of all calls with them: what they took says how busy the machine was, and a
robot keeps a processor for its loop. The bins are ordinary ones: one with a NaN goes another way,
which takes longer.
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

try:
    from resource import RUSAGE_THREAD, getrusage
except ImportError:  # only Linux counts for each thread
    getrusage = None  # type: ignore[assignment]


class Timing(NamedTuple):
    """Microseconds of a call: of several runs, the median of their medians and of their p99.

    Attributes:
        p50_us: half of the calls take no longer.
        p99_us: 99 of 100 calls take no longer.
        p99_all_us: the same with the calls that were interrupted.
        calls: counted in each run.
        interrupted: share of all calls that were interrupted, and not counted.
    """

    p50_us: float
    p99_us: float
    p99_all_us: float
    calls: int
    interrupted: float = 0.0


def time_calls(
    call: Callable[[Tensor], object], inputs: Sequence[Tensor], calls: int, runs: int = 3
) -> Timing:
    """Time a call on one input after the other, each by itself.

    Of a machine so busy that hardly a call is left alone, interrupted ones count too.
    """
    for given in inputs:
        call(given)
    middles, ends, ends_of_all, lost, made = [], [], [], 0, 0
    for _ in range(runs):
        taken: list[int] = []
        spoilt: list[int] = []
        while len(taken) < calls and len(spoilt) < calls:
            given = inputs[made % len(inputs)]
            switches = _interruptions()
            started = time.perf_counter_ns()
            call(given)
            spent = time.perf_counter_ns() - started
            (taken if _interruptions() == switches else spoilt).append(spent)
            made += 1
        lost += len(spoilt)
        counted = sorted(taken if len(taken) == calls else taken + spoilt)
        middles.append(counted[len(counted) // 2] / 1000)
        ends.append(_p99(counted))
        ends_of_all.append(_p99(sorted(taken + spoilt)))
    return Timing(median(middles), median(ends), median(ends_of_all), calls, lost / made)


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
    command = [sys.executable, "-m", "tactslip_torch.deadline.timing", os.fspath(path), str(calls)]
    command.append(engine)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
        raise ValueError(f"timing {os.fspath(path)} in a fresh process failed: {said}")
    return Timing(**json.loads(done.stdout.splitlines()[-1]))


def _p99(taken_ns: Sequence[int]) -> float:
    """What 99 of 100 sorted calls do not exceed, in microseconds."""
    return taken_ns[-(-99 * len(taken_ns) // 100) - 1] / 1000


def _interruptions() -> int:
    """How often this thread has lost the processor against its will; 0 where nobody counts."""
    return 0 if getrusage is None else getrusage(RUSAGE_THREAD).ru_nivcsw


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
        raise SystemExit(
            "usage: python -m tactslip_torch.deadline.timing detector.pt [calls [engine]]"
        )
    path, calls, engine = [*arguments, *("1000", "auto")[len(arguments) - 1 :]]
    with one_thread():
        detector = SlipDetector.load(Path(path), cast(EngineName, engine))
        timing = time_detector(detector, int(calls), runs=5)
    print(json.dumps(timing._asdict()))


if __name__ == "__main__":
    main(sys.argv[1:])
