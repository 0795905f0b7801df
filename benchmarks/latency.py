"""From one raw bin to its score, beside named peers: ``python -m benchmarks.latency``.

Single calls on one thread: the package, its file in onnxruntime, and MiniRocket with ridge. Prints
seconds and how far scores are from the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import torch

from benchmarks.deployment import bin_scores
from benchmarks.harness import Benchmark, Job, say
from benchmarks.peers import others
from benchmarks.subjects import WINDOW_LENGTHS, labelled_bins, loaded, raw_bins
from benchmarks.tables import Table, limits, number
from benchmarks.timing import interleaved, on_threads
from benchmarks.trainings import main_job_detector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.signals.filtering import ChannelFilter

OURS, REFERENCE, ORT = "tactslip_torch, float32", "reference, float64", "onnxruntime, float32"
ROCKET = "MiniRocket and ridge"
MOST_S = 1e-3
Score = Callable[[Any], Any]


@dataclass(frozen=True)
class Latency(Benchmark):
    """One bin at a time on one thread.

    Args:
        recordings: simulated, to whose bins MiniRocket is fitted.
        bins: raw bins that calls take in turn, all held against the reference.
        rounds: of every call.
        block_s: a quick call is repeated for so long in a round.
        num_kernels: of MiniRocket.
    """

    title = "Latency"
    about = (
        "one raw bin of 24 channels with its context to a score, by the detector of the main job "
        "(`+exp=unseen4`, the default recipe), one bin at a time on 1 thread"
    )
    charts: ClassVar = {"": (("One bin to its score", ("median, us", "99th percentile, us")),)}
    quick = "recordings=1 bins=4 rounds=2 block_s=0.002 num_kernels=168"
    libraries = ("PyWavelets", "onnxruntime", "aeon")
    recordings: int = 8
    bins: int = 64
    rounds: int = 40
    block_s: float = 0.02
    num_kernels: int = 10_000

    @torch.inference_mode()
    def measure(self, job: Job) -> dict[str, Any]:
        """Seconds of single calls of every way, and errors of its scores."""
        samples, detector = raw_bins(self.bins), main_job_detector(job)
        with on_threads(1):
            ways = self._ways(detector)
        with on_threads(1):  # of the libraries loaded by now as well
            say(f"latency: {self.rounds} rounds of {len(ways)} ways")
            calls = {name: _in_turn(score, samples) for name, score in ways.items()}
            timings = interleaved(calls, self.rounds, block_s=self.block_s, most_calls=60)
            exact = _scores(ways[REFERENCE], samples)
            ours_s, rows = timings[OURS]["p50_s"], []
            for name, score in ways.items():
                found = _scores(score, samples)
                error = np.abs(found - exact).max() / max(exact.std(), 1e-12)
                of = timings[name]
                rows.append(
                    {
                        "way": name,
                        "median, us": 1e6 * of["p50_s"],
                        "99th percentile, us": 1e6 * of["p99_s"],
                        "of ours": f"{number(of['p50_s'] / ours_s)} x",
                        "error": None if name == ROCKET else float(error),
                    }
                )
        note = (
            "*Of ours*: the median time divided by that of the first row. *Error*: the largest "
            "difference to the scores of the reference, in their standard deviations; - for "
            "MiniRocket, which is another classifier."
        )
        goal = ("a bin to its score, float32", 1e3 * ours_s, 1e3 * MOST_S, "ms")
        tables = {"Limits": limits([goal]), "One bin to its score": Table(rows, note)}
        return {"tables": tables}

    def _ways(self, path: Path) -> dict[str, Score]:
        """From one raw bin ``[1, C, n + 2 * context]``, float32, to its score."""
        fast, exact = loaded(path, torch.float32), loaded(path)
        slow = loaded(path, backend="torch")
        with TemporaryDirectory(prefix="tactslip-bench-") as folder:
            say("latency: export to ONNX")
            export_detector(exact, Path(folder), ("bin",), "float32")
            exported = bin_scores(Path(folder) / "model.onnx")
        return {
            OURS: fast.score_raw,
            "tactslip_torch, float32, with validity": lambda x: fast.predict_raw(x).score,
            "tactslip_torch, float64": lambda x: exact.score_raw(x.double()),
            REFERENCE: lambda x: slow.score_raw(x.double()),
            ORT: exported,
            ROCKET: self._rocket(),
        }

    def _rocket(self) -> Score:
        bins, is_slip = labelled_bins(self.recordings)
        say("latency: MiniRocket")
        scores = others.fit(bins.numpy(), is_slip.numpy(), num_kernels=self.num_kernels)
        filters = ChannelFilter(WINDOW_LENGTHS)
        return lambda samples: scores(filters.valid(samples.double()).float().numpy())


def _in_turn(score: Score, samples: torch.Tensor) -> Callable[[], Any]:
    """A call that takes the next bin every time."""
    each: Iterator[torch.Tensor] = cycle([one[None].contiguous() for one in samples])
    return lambda: score(next(each))


def _scores(score: Score, samples: torch.Tensor) -> Any:
    return np.array([float(np.ravel(score(one[None]))[0]) for one in samples])


if __name__ == "__main__":
    raise SystemExit(Latency().run())
