"""The files that are deployed, made in a folder that is thrown away."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.bins import WINDOW_LENGTHS, raw_bins
from benchmarks.clocks import say, timed
from benchmarks.deployment.naive import NaivePipeline, export_naive
from benchmarks.deployment.sizes import Sizes
from benchmarks.deployment.subject import Subject
from benchmarks.engines import FLOAT64, pool_of
from tactslip_torch.graph.export import export_detector
from tactslip_torch.graph.facts import GraphKind
from tactslip_torch.graph.form import Precision
from tactslip_torch.signals.filtering import ChannelFilter

PRECISIONS: tuple[Precision, ...] = ("float32", "float64")
BIN: GraphKind = "bin"
STREAM: GraphKind = "stream"
DETECTOR = "detector.pt"
NAIVE = {True: "naive export, all features", False: "naive export, needed features"}
"""By whether the whole pool is made."""


def exported(precision: str) -> str:
    """The name of a way by our export."""
    return f"export, {precision}"


EXPORTS = {exported(precision): precision for precision in PRECISIONS}
"""Every way by our export, with its precision."""


class Files(NamedTuple):
    """What was written.

    Attributes:
        paths: by ``of_way``, of the naive exports by their names, and of the ``DETECTOR``.
        seconds: that an export took, by way; of ours with its self-checks.
    """

    paths: dict[str, Path]
    seconds: dict[str, float]


def naive_of(subject: Subject, is_whole: bool) -> NaivePipeline:
    """The naive pipeline with the kernel sum, in float64."""
    of = subject.timed
    parts = (pool_of(FLOAT64), ChannelFilter(WINDOW_LENGTHS), of.selected, of.scaler)
    return NaivePipeline(*parts, subject.machine, is_whole)


def of_way(way: str, graph: str) -> str:
    """What the file of a graph of ours is called."""
    return f"{way}, {graph}"


def make_files(subject: Subject, sizes: Sizes, folder: Path) -> Files:
    """Write every file."""
    files = Files({DETECTOR: folder / DETECTOR}, {})
    detector = subject.detector("eager", FLOAT64)  # in its check the reference takes long
    detector.save(files.paths[DETECTOR])
    for way, precision in EXPORTS.items():
        say(f"deployment: {way}")
        own = folder / precision
        own.mkdir()
        write = partial(
            export_detector, detector, own, (BIN, STREAM), precision, alone=sizes.has_starts
        )
        files.seconds[way], _ = timed(write)
        for graph, name in ((BIN, "model.onnx"), (STREAM, "stream.onnx")):
            files.paths[of_way(way, graph)] = own / name
    for is_whole, way in NAIVE.items() if sizes.has_naive else ():
        say(f"deployment: {way}, which takes PyTorch a while")
        files.paths[way] = folder / f"naive-{is_whole}.onnx"
        slow = partial(export_naive, naive_of(subject, is_whole), raw_bins(3), files.paths[way])
        files.seconds[way], _ = timed(slow)
    return files


def file_rows(files: Files) -> list[dict[str, Any]]:
    """Rows of sizes, and of the seconds that making took; of what leaves no file these alone."""
    found: list[dict[str, Any]] = []
    for name, path in files.paths.items():
        way = name if name in files.seconds else name.rpartition(", ")[0]
        row = {"file": name, "bytes": path.stat().st_size, "seconds": files.seconds.get(way)}
        found.append(row)
    named = [row["file"] for row in found]
    for way, seconds in files.seconds.items():
        if not any(name.startswith(way) for name in named):
            found.append({"file": way, "bytes": None, "seconds": seconds})
    return found
