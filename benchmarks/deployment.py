"""Exported files in onnxruntime beside the package: ``python -m benchmarks.deployment``.

The detector that comes with the package, exported to ONNX as single bins and as a stream, in
float32 and float64: error and latency beside the package itself, throughput in bulk, pushes of a
stream, sizes of files, and a first score in a fresh process.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Literal

import numpy as np
import torch

from benchmarks import ROOT
from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import (
    RATE_HZ,
    WINDOW_LENGTHS,
    Array,
    loaded,
    pushing,
    raw_bins,
    stream_samples,
)
from benchmarks.tables import Table, times
from benchmarks.timing import in_fresh_process, interleaved, on_threads, timed
from benchmarks.trainings import main_job_detector
from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.signals.filtering import ChannelFilter

SOURCES = ("export/python/*.py", "benchmarks/starts.py")
DTYPES: dict[Literal["float32", "float64"], torch.dtype] = {
    "float32": torch.float32,
    "float64": torch.float64,
}
REFERENCE = "reference, float64"


def host(module: str) -> Any:
    """A module of ``export/python``, the host that is shipped: onnxruntime on one thread."""
    folder = str(ROOT / "export" / "python")
    if folder not in sys.path:
        sys.path.append(folder)
    return import_module(module)


def bin_outputs(path: Path) -> Callable[[torch.Tensor], tuple[Array, Array]]:
    """What gives scores and validity of raw bins with all context by a bin graph.

    Shape:
        - bins: ``[N, C, n + 2 * context]``
    """
    session, metadata = host("files").load_model(path, "bin")
    context = ChannelFilter(WINDOW_LENGTHS).context
    first = context - metadata["context_before_samples"]  # the file takes no more than it needs
    unused = context - metadata["context_after_samples"]

    def outputs(samples: torch.Tensor) -> tuple[Array, Array]:
        cut = samples[..., first : samples.shape[-1] - unused].numpy()
        x = np.ascontiguousarray(cut, metadata["precision"])
        score, valid = session.run(["score", "valid"], {"samples": x})
        return score, valid

    return outputs


def bin_scores(path: Path) -> Callable[[torch.Tensor], Array]:
    """The scores of ``bin_outputs`` alone."""
    outputs = bin_outputs(path)
    return lambda samples: outputs(samples)[0]


@dataclass(frozen=True)
class Deployment(Benchmark):
    """Files of the export beside the package.

    Args:
        recordings: simulated, whose bins are scored.
        evaluated: bins whose scores are held against the reference.
        rounds: of every way.
        bulk: bins at once.
        push: samples of a push of a stream.
        streamed_s: of stream, whose scores are held against the package.
        starts: of every fresh process.
    """

    title = "Deployed: files in onnxruntime"
    about = (
        "the detector of the main job (`+exp=unseen4`, the default recipe), exported to ONNX and "
        "run by onnxruntime, beside the package, on 1 thread"
    )
    charts: ClassVar = {"": (("Bins", "us a bin"), ("A stream", "us a push"))}
    quick = "recordings=1 evaluated=16 rounds=2 bulk=[4] push=100 streamed_s=2.0 starts=1"
    libraries = ("onnxruntime", "onnx")
    recordings: int = 33
    evaluated: int = 2000
    rounds: int = 20
    bulk: tuple[int, ...] = (16, 256)
    push: int = 200
    streamed_s: float = 20.0
    starts: int = 3

    @torch.inference_mode()
    def measure(self, job: Job) -> dict[str, Any]:
        """Files, bins, streams and fresh processes."""
        with TemporaryDirectory(prefix="tactslip-bench-") as folder, on_threads(1):
            files = []
            detector = loaded(main_job_detector(job))
            detector.save(Path(folder) / "detector.pt")
            for precision in DTYPES:
                say(f"deployment: export, {precision}")
                place = Path(folder) / precision
                place.mkdir()
                export = partial(export_detector, detector, place, precision=precision)
                seconds, _ = timed(export)
                for name in ("model.onnx", "stream.onnx"):
                    row = {"file": f"{name}, {precision}"}
                    row["kB"] = f"{(place / name).stat().st_size / 1e3:,.0f}"
                    files.append(row | {"s to make both and check them": f"{seconds:.1f}"})
            note = (
                "*Error*: the largest difference to the scores of the reference, in their standard "
                "deviations. *Flips*: bins whose decision differs from the reference."
            )
            tables = {
                "Bins": Table(_bins(Path(folder), self), note),
                "A stream": Table(_streams(Path(folder), self)),
                "Files": Table(files),
                "A first score in a fresh process": Table(_starts(Path(folder), self.starts)),
            }
            return {"tables": tables}


def _bins(folder: Path, sizes: Deployment) -> list[dict[str, Any]]:
    ways: dict[str, Callable[[torch.Tensor], Any]] = {}
    detector = partial(loaded, folder / "detector.pt")
    for precision, dtype in DTYPES.items():
        ways[f"onnxruntime, {precision}"] = bin_scores(folder / precision / "model.onnx")
        ways[f"tactslip_torch, {precision}"] = partial(_score, detector(dtype), dtype)
    ways[REFERENCE] = partial(_score, detector(torch.float64, "torch"), torch.float64)
    rows: dict[str, dict[str, Any]] = {name: {"way": name} for name in ways}
    for size in (1, *sizes.bulk):
        say(f"deployment: {size} bins at once")
        bins = raw_bins(size)
        timings = interleaved({n: partial(way, bins) for n, way in ways.items()}, sizes.rounds)
        for name, timing in timings.items():
            rows[name][f"us a bin, {size} at once"] = times(timing["seconds"], 1e6 / size)
    evaluated = raw_bins(sizes.evaluated, min(sizes.recordings, 12))
    scores = {n: np.asarray(way(evaluated), np.float64).ravel() for n, way in ways.items()}
    exact = scores[REFERENCE]
    for name, own in scores.items():
        rows[name]["error"] = float(np.abs(own - exact).max() / exact.std())
        rows[name]["flips"] = int(((own >= 0) != (exact >= 0)).sum())
    return list(rows.values())


def _score(detector: SlipDetector, dtype: torch.dtype, samples: torch.Tensor) -> Any:
    return detector.predict_raw(samples.to(dtype)).score


def _streams(folder: Path, sizes: Deployment) -> list[dict[str, Any]]:
    samples = stream_samples(1)
    part = samples[: round(sizes.streamed_s * RATE_HZ)]
    pushes: dict[str, Callable[[Array], Any]] = {}
    scores = {}
    for precision, dtype in DTYPES.items():
        file, detector = folder / precision / "stream.onnx", loaded(folder / "detector.pt", dtype)
        ways: dict[str, Callable[[], Any]] = {
            f"onnxruntime, {precision}": partial(host("stream").Stream, file),
            f"tactslip_torch, {precision}": partial(StreamingDetector, detector, dtype=dtype),
        }
        for name, make in ways.items():
            watched = make()
            each = [_scores_of(watched.push(piece)) for piece in np.array_split(part, 20)]
            scores[name] = np.concatenate(each)
            pushes[name] = make().push
    say("deployment: streams")
    calls = {n: pushing(of, samples, sizes.push) for n, of in pushes.items()}
    timings = interleaved(calls, sizes.rounds, block_s=0.02)
    exact = scores["tactslip_torch, float64"]
    push = f"us a push of {sizes.push} samples"
    return [
        {
            "way": name,
            push: times(timings[name]["seconds"], 1e6),
            "error": float(np.abs(of - exact).max() / exact.std()),
        }
        for name, of in scores.items()
    ]


def _scores_of(pushed: Any) -> Array:
    score = [row["score"] for row in pushed] if isinstance(pushed, list) else pushed.score
    return np.asarray(score, np.float64).ravel()


def _starts(folder: Path, num: int) -> list[dict[str, Any]]:
    np.save(folder / "bin.npy", raw_bins(1).numpy())
    rows = []
    for way, file in (
        ("onnxruntime, float32", "float32/model.onnx"),
        ("tactslip_torch", "detector.pt"),
    ):
        say(f"deployment: fresh processes with {way}")
        given = {"path": str(folder / file), "bin_path": str(folder / "bin.npy")}
        found = [in_fresh_process("benchmarks.starts:first_score", **given) for _ in range(num)]
        parts = {part: median(one[part] for one in found) for part in found[0]}
        rows.append({"way": way} | {f"{part} s": f"{of:.2f}" for part, of in parts.items()})
    return rows


if __name__ == "__main__":
    raise SystemExit(Deployment().run())
