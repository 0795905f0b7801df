"""From one raw bin to its score, beside named peers: ``python -m benchmarks.latency``.

Single calls on one thread: the package, its file in onnxruntime, the obvious loop over SciPy and
PyWavelets, MiniRocket with ridge, and heads of scikit-learn behind our features. Prints seconds and
how far scores are from the reference.
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
from sklearn.kernel_ridge import KernelRidge
from sklearn.svm import SVC

from benchmarks.deployment import bin_scores
from benchmarks.harness import Benchmark, Job, say
from benchmarks.peers import loop, others
from benchmarks.subjects import WINDOW_LENGTHS, MainJobDetector, labelled_bins, raw_bins
from benchmarks.tables import Table, limits, number
from benchmarks.timing import interleaved, on_threads
from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.signals.filtering import ChannelFilter

OURS, REFERENCE, ORT = "tactslip_torch, float32", "reference, float64", "onnxruntime, float32"
OTHER_MACHINES = ("MiniRocket and ridge", "tactslip_torch, float64, SVC head")
MOST_S = 1e-3
Score = Callable[[Any], Any]


@dataclass(frozen=True)
class Latency(Benchmark):
    """One bin at a time on one thread.

    Args:
        recordings: simulated, to whose bins heads are fitted.
        bins: raw bins that calls take in turn, all held against the reference.
        looped: of these, by the loop.
        rounds: of every call.
        block_s: a quick call is repeated for so long in a round.
        num_kernels: of MiniRocket.
    """

    title = "Latency"
    about = (
        "one raw bin of 24 channels with its context to a score, the features that the main job "
        "selects, one bin at a time on 1 thread"
    )
    charts: ClassVar = {"": (("One bin to its score", ("median, us", "99th percentile, us")),)}
    quick = "recordings=1 bins=4 looped=1 rounds=2 block_s=0.002 num_kernels=168"
    libraries = ("PyWavelets", "onnxruntime", "aeon")
    recordings: int = 8
    bins: int = 64
    looped: int = 4
    rounds: int = 40
    block_s: float = 0.02
    num_kernels: int = 10_000

    @torch.inference_mode()
    def measure(self, job: Job) -> dict[str, Any]:
        """Seconds of single calls of every way, and errors of its scores."""
        samples = raw_bins(self.bins)
        with on_threads(1):
            ways = self._ways()
        with on_threads(1):  # of the libraries loaded by now as well
            say(f"latency: {self.rounds} rounds of {len(ways)} ways")
            calls = {name: _in_turn(score, samples) for name, score in ways.items()}
            timings = interleaved(calls, self.rounds, block_s=self.block_s, most_calls=60)
            exact = _scores(ways[REFERENCE], samples)
            ours_s, rows = timings[OURS]["p50_s"], []
            for name, score in ways.items():
                some = samples[: self.looped] if "loop" in name else samples
                found = _scores(score, some)
                error = np.abs(found - exact[: len(found)]).max() / max(exact.std(), 1e-12)
                of = timings[name]
                rows.append(
                    {
                        "way": name,
                        "median, us": 1e6 * of["p50_s"],
                        "99th percentile, us": 1e6 * of["p99_s"],
                        "of ours": f"{number(of['p50_s'] / ours_s)} x",
                        "error": None if name in OTHER_MACHINES else float(error),
                    }
                )
        note = "Error of scores in standard deviations of the reference's; - another machine."
        goal = ("a bin to its score, float32", 1e3 * ours_s, 1e3 * MOST_S, "ms")
        tables = {"Limits": limits([goal]), "One bin to its score": Table(rows, note)}
        return {"tables": tables}

    def _ways(self) -> dict[str, Score]:
        """From one raw bin ``[1, C, n + 2 * context]``, float32, to its score."""
        main = MainJobDetector.fitted(self.recordings)
        fast, exact = main.detector(torch.float32), main.detector(torch.float64)
        slow = main.detector(torch.float64, "torch")
        support, targets = main.z.numpy(), main.training.targets.numpy()
        svc = SVC(kernel="poly", degree=2, gamma=1.0, coef0=main.kernel.offset)
        svc.fit(support, targets)
        ridge = KernelRidge(
            alpha=1 / main.penalty, kernel="poly", degree=2, gamma=1.0, coef0=main.kernel.offset
        ).fit(support, targets)

        def scaled(x: Any) -> Any:
            bins = exact.channel_filter.valid(x.double())
            return exact.scaler(exact.extractor(bins)).numpy()

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
            "SciPy and PyWavelets, a loop, kernel sum": _loop(main),
            "MiniRocket and ridge": self._rocket(),
            "tactslip_torch, float64, SVC head": lambda x: svc.decision_function(scaled(x)),
            "tactslip_torch, float64, KernelRidge head": lambda x: ridge.predict(scaled(x)),
        }

    def _rocket(self) -> Score:
        bins, is_slip = labelled_bins(self.recordings)
        say("latency: MiniRocket")
        scores = others.fit(bins.numpy(), is_slip.numpy(), num_kernels=self.num_kernels).score
        filters = ChannelFilter(WINDOW_LENGTHS)
        return lambda samples: scores(filters.valid(samples.double()).float().numpy())


def _in_turn(score: Score, samples: torch.Tensor) -> Callable[[], Any]:
    """A call that takes the next bin every time."""
    each: Iterator[torch.Tensor] = cycle([one[None].contiguous() for one in samples])
    return lambda: score(next(each))


def _scores(score: Score, samples: torch.Tensor) -> Any:
    return np.array([float(np.ravel(score(one[None]))[0]) for one in samples])


def _loop(main: MainJobDetector) -> Score:
    """The loop over the features in use: filter, features, scaling and kernel sum."""
    pool, machine = FeaturePool(HandLayout.paper24()), main.kernel_sum()
    context = ChannelFilter(WINDOW_LENGTHS).context
    chosen = [pool.names[index] for index in main.selected]
    names = [(n.channel, n.component, n.domain, n.descriptor) for n in chosen]
    channels = list(dict.fromkeys(name.channel for name in chosen))  # the others are not filtered
    rows = [pool.hand.names.index(channel) for channel in channels]
    lengths = [WINDOW_LENGTHS[row] for row in rows]
    support, beta = np.asarray(machine.support), np.asarray(machine.beta)

    def score(samples: Any) -> Any:
        filtered = loop.savgol(samples[0, rows].double().numpy(), lengths, 1, context)
        with others.quiet():
            x = torch.from_numpy(loop.features(filtered, names, channels))
        z = main.scaler(x).numpy()
        return loop.kernel_score(z, support, beta, main.kernel.offset, main.kernel.degree)

    return score


if __name__ == "__main__":
    raise SystemExit(Latency().run())
