"""Exported files in onnxruntime beside the package: ``python -m benchmarks.deployment``.

The main job's detector exported to ONNX as single bins and as a stream, in float32 and float64:
error and latency beside the package itself, throughput in bulk, pushes of a stream, sizes of files,
and a first score in a fresh process.
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
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks import ROOT
from benchmarks.harness import (
    Benchmark,
    Job,
    Report,
    Spread,
    Table,
    bars,
    in_fresh_process,
    interleaved,
    number,
    on_threads,
    say,
    timed,
)
from benchmarks.subjects import (
    FLOAT32,
    FLOAT64,
    RATE_HZ,
    WINDOW_LENGTHS,
    Array,
    MainJobDetector,
    endless,
    raw_bins,
    stream_samples,
)
from tactslip_torch import SlipDetector, StreamingDetector
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.signals.filtering import ChannelFilter

Precision = Literal["float32", "float64"]
PRECISIONS: tuple[Precision, ...] = ("float32", "float64")
DTYPES = {"float32": FLOAT32, "float64": FLOAT64}
REFERENCE = "reference, float64"


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Args:
        recordings: simulated, to whose bins the machine is fitted.
        evaluated: bins whose scores are held against the reference.
        rounds: of every way.
        bulk: bins at once.
        push: samples of a push of a stream.
        streamed_s: of stream, whose scores are held against the package.
        starts: of every fresh process.
    """

    recordings: int = 33
    evaluated: int = 2000
    rounds: int = 20
    bulk: tuple[int, ...] = (16, 256)
    push: int = 200
    streamed_s: float = 20.0
    starts: int = 3


def host(module: str) -> Any:
    """A module of ``export/python``, the host that is shipped: onnxruntime on one thread."""
    folder = str(ROOT / "export" / "python")
    if folder not in sys.path:
        sys.path.append(folder)
    return import_module(module)


def bin_scores(path: Path) -> Callable[[torch.Tensor], Array]:
    """What scores raw bins with all context ``[N, C, n + 2 * context]`` by a bin graph."""
    session, facts = host("files").load_model(path, "bin")
    context = ChannelFilter(WINDOW_LENGTHS).context
    first = context - facts["context_before_samples"]  # the file takes no more than it needs
    unused = context - facts["context_after_samples"]

    def scores(samples: torch.Tensor) -> Array:
        cut = samples[..., first : samples.shape[-1] - unused].numpy()
        x = np.ascontiguousarray(cut, facts["precision"])
        found: Array = session.run(["score", "valid"], {"samples": x})[0]
        return found

    return scores


class Deployment(Benchmark[Sizes]):
    """Files of the export beside the package."""

    name = "deployment"
    title = "Deployed: files in onnxruntime"
    about = (
        "the main job's detector exported to ONNX and run by onnxruntime, beside the package, on "
        "1 thread"
    )
    sizes = Sizes()
    quick = Sizes(
        recordings=1, evaluated=16, rounds=2, bulk=(4,), push=100, streamed_s=2.0, starts=1
    )
    libraries = ("onnxruntime", "onnx")

    @torch.inference_mode()
    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """Files, bins, streams and fresh processes."""
        sizes = job.sizes
        main = MainJobDetector.fitted(sizes.recordings)
        with TemporaryDirectory(prefix="tactslip-bench-") as folder, on_threads(1):
            files = []
            main.detector().save(Path(folder) / "detector.pt")
            for precision in PRECISIONS:
                say(f"deployment: export, {precision}")
                place = Path(folder) / precision
                place.mkdir()
                export = partial(export_detector, main.detector(), place, precision=precision)
                seconds, _ = timed(export)
                for name in ("model.onnx", "stream.onnx"):
                    size = (place / name).stat().st_size
                    files.append(
                        {"file": f"{name}, {precision}", "bytes": size, "seconds": seconds}
                    )
            return {
                "files": files,
                "bins": _bins(main, Path(folder), sizes),
                "streams": _streams(main, Path(folder), sizes),
                "starts": _starts(Path(folder), sizes),
                "push": sizes.push,
            }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Bins, streams, files, starts."""
        bins = [
            {"way": row["way"]}
            | {f"us a bin, {of} at once": Spread(*us).text() for of, us in row["us"].items()}
            | {"error": number(row["error"]), "flips": row["flips"]}
            for row in numbers["bins"]
        ]
        streams = [
            {
                "way": row["way"],
                f"us a push of {numbers['push']} samples": Spread.of(row["seconds"], 1e6).text(),
                "error": number(row["error"]),
            }
            for row in numbers["streams"]
        ]
        files = [
            {
                "file": row["file"],
                "kB": f"{row['bytes'] / 1e3:,.0f}",
                "s to make both and check them": f"{row['seconds']:.1f}",
            }
            for row in numbers["files"]
        ]
        starts = [
            {"way": row["way"]}
            | {
                f"{part} s": f"{median(row[f'{part}_s']):.2f}"
                for part in ("import", "load", "first")
            }
            for row in numbers["starts"]
        ]
        note = (
            "Error of scores in standard deviations of the reference's; flips: bins that are "
            "decided otherwise."
        )
        return {
            "Bins": Table(bins, note),
            "A stream": Table(streams),
            "Files": Table(files),
            "A first score in a fresh process": Table(starts),
        }

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Latency of a bin and of a push."""
        bins, streams = drawing.subplots(2, 1)
        rows = numbers["bins"]
        values = {f"{size} at once": [row["us"][size][0] for row in rows] for size in rows[0]["us"]}
        bars(bins, [row["way"] for row in rows], values, "us a bin")
        rows = numbers["streams"]
        pushes = {"push": [Spread.of(row["seconds"], 1e6).median for row in rows]}
        about = f"us a push of {numbers['push']} samples"
        bars(streams, [row["way"] for row in rows], pushes, about)


def _bins(main: MainJobDetector, folder: Path, sizes: Sizes) -> list[dict[str, Any]]:
    ways: dict[str, Callable[[torch.Tensor], Any]] = {}
    for precision in PRECISIONS:
        ways[f"onnxruntime, {precision}"] = bin_scores(folder / precision / "model.onnx")
        detector = main.detector(DTYPES[precision])
        ways[f"tactslip_torch, {precision}"] = partial(_score, detector, DTYPES[precision])
    ways[REFERENCE] = partial(_score, main.detector(FLOAT64, "torch"), FLOAT64)
    us: dict[str, dict[str, Spread]] = {name: {} for name in ways}
    for size in (1, *sizes.bulk):
        say(f"deployment: {size} bins at once")
        bins = raw_bins(size)
        timings = interleaved({n: partial(way, bins) for n, way in ways.items()}, sizes.rounds)
        for name, timing in timings.items():
            us[name][str(size)] = Spread.of(timing.per_round, 1e6 / size)
    evaluated = raw_bins(sizes.evaluated, min(sizes.recordings, 12))
    scores = {n: np.asarray(way(evaluated), np.float64).ravel() for n, way in ways.items()}
    exact = scores[REFERENCE]
    return [
        {
            "way": name,
            "us": us[name],
            "error": float(np.abs(own - exact).max() / exact.std()),
            "flips": int(((own >= 0) != (exact >= 0)).sum()),
        }
        for name, own in scores.items()
    ]


def _score(detector: SlipDetector, dtype: torch.dtype, samples: torch.Tensor) -> Any:
    return detector.predict_raw(samples.to(dtype)).score


def _streams(main: MainJobDetector, folder: Path, sizes: Sizes) -> list[dict[str, Any]]:
    samples = stream_samples(1)
    part = samples[: round(sizes.streamed_s * RATE_HZ)]
    pushes: dict[str, Callable[[Array], Any]] = {}
    scores = {}
    for precision in PRECISIONS:
        dtype = DTYPES[precision]
        file = folder / precision / "stream.onnx"
        ways: dict[str, Callable[[], Any]] = {
            f"onnxruntime, {precision}": partial(host("stream").Stream, file),
            f"tactslip_torch, {precision}": partial(
                StreamingDetector, main.detector(dtype), dtype=dtype
            ),
        }
        for name, make in ways.items():
            watched = make()
            each = [_scores_of(watched.push(piece)) for piece in np.array_split(part, 20)]
            scores[name] = np.concatenate(each)
            pushes[name] = make().push
    say("deployment: streams")
    calls = {
        name: partial(_next_push, push, endless(samples, sizes.push))
        for name, push in pushes.items()
    }
    timings = interleaved(calls, sizes.rounds, block_s=0.02)
    exact = scores["tactslip_torch, float64"]
    return [
        {
            "way": name,
            "seconds": timings[name].per_round,
            "error": float(np.abs(scores[name] - exact).max() / exact.std()),
        }
        for name in pushes
    ]


def _scores_of(pushed: Any) -> Array:
    score = [row["score"] for row in pushed] if isinstance(pushed, list) else pushed.score
    return np.asarray(score, np.float64).ravel()


def _next_push(push: Callable[[Array], Any], samples: Any) -> None:
    push(next(samples))


def _starts(folder: Path, sizes: Sizes) -> list[dict[str, Any]]:
    np.save(folder / "bin.npy", raw_bins(1).numpy())
    ways = {
        "onnxruntime, float32": folder / "float32" / "model.onnx",
        "tactslip_torch": folder / "detector.pt",
    }
    rows = []
    for way, path in ways.items():
        say(f"deployment: fresh processes with {way}")
        given = {"path": str(path), "bin_path": str(folder / "bin.npy")}
        start = "by_package" if path.suffix == ".pt" else "by_onnxruntime"
        found = [
            in_fresh_process(f"benchmarks.starts:{start}", **given) for _ in range(sizes.starts)
        ]
        rows.append({"way": way} | {part: [one[part] for one in found] for part in found[0]})
    return rows


if __name__ == "__main__":
    raise SystemExit(Deployment().run())
