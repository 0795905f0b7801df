"""What a deployed detector costs: ``python -m benchmarks.deployment [--detector detector.pt]``.

The exported files in onnxruntime, beside what else there is to do: the pipeline
exported as it is written, the engines of the package, ``torch.compile``, and the loop of SciPy and
PyWavelets. In one run and in turns: latency of one bin and throughput of many on one and two
threads, pushes of a stream, sizes of files, and a first score in a fresh process; beside every
speed how far the scores are off, on held-out bins. Prints tables and limits, and keeps numbers and
figure in ``benchmarks/results``. ``--quick`` looks whether all of that but the slow peers runs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.bins import WINDOW_LENGTHS, raw_bins
from benchmarks.clocks import say
from benchmarks.deployment.figure import figure
from benchmarks.deployment.files import (
    BIN,
    DETECTOR,
    NAIVE,
    Files,
    exported,
    file_rows,
    make_files,
    of_way,
)
from benchmarks.deployment.measure import on_bins
from benchmarks.deployment.report import DEPLOYED, limit_rows, report_text
from benchmarks.deployment.sizes import QUICK, Sizes
from benchmarks.deployment.start import ONNXRUNTIME, PACKAGE, StartFailedError, starts
from benchmarks.deployment.stream import on_streams
from benchmarks.deployment.subject import subject_of
from benchmarks.engines import ENGINES
from benchmarks.exported import judge_of
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths
from tactslip_torch.signals.filtering import ChannelFilter

_LIBRARIES = ("numba", "PyWavelets", "ptwt", "onnx", "onnxruntime", "onnxscript")


def measure(sizes: Sizes, path: Path | None, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        path: of a trained detector, which is deployed; default: the selection that is kept.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    subject = subject_of(sizes.recordings, path)
    with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as folder:
        files = make_files(subject, sizes, Path(folder))
        rows = on_bins(subject, files, sizes)
        rows["stream"] = on_streams(subject, files, sizes)
        rows["files"] = file_rows(files)
        rows["starts"] = start_rows(files, sizes, Path(folder)) if sizes.has_starts else []
    sections = {name: {"rows": of} for name, of in rows.items()}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": max(sizes.threads),
        "versions": versions(_LIBRARIES),
        "settings": asdict(sizes),
        "selection": dict(subject.timed.selection) | {"trained": dict(subject.source)},
        "training_bins": len(subject.machine.support),
        "sections": sections,
        "limits": limit_rows(sections),
    }


def start_rows(files: Files, sizes: Sizes, folder: Path) -> list[dict[str, Any]]:
    """Rows of fresh processes, each with the bin that its file takes."""
    raw = raw_bins(1)
    whole = folder / "bin.npy"
    np.save(whole, raw.numpy())
    jobs = {}
    for way in (DEPLOYED, exported("float64")):
        model = files.paths[of_way(way, BIN)]
        cut = folder / f"{way.replace(', ', '-')}.npy"
        np.save(cut, judge_of(model, 1, ChannelFilter(WINDOW_LENGTHS).context).cut(raw))
        jobs[f"onnxruntime, {way}"] = (ONNXRUNTIME, model, cut)
    if NAIVE[True] in files.paths:
        jobs[f"onnxruntime, {NAIVE[True]}"] = (ONNXRUNTIME, files.paths[NAIVE[True]], whole)
    for engine in ENGINES:
        jobs[f"tactslip_torch, {engine}"] = (f"{PACKAGE}:{engine}", files.paths[DETECTOR], whole)
    return starts(jobs, sizes.starts, say)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.deployment",
        description="Time exported files beside other ways from samples to a score.",
    )
    parser.add_argument("--quick", action="store_true", help="a few calls, to see that it runs")
    parser.add_argument(
        "--detector", type=Path, metavar="FILE", help="of +exp=onset, say; which is deployed"
    )
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "deployment")
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), parsed.detector, parsed.quick),
        report_text,
        figure,
        parsed,
        parsed.detector,
        (StartFailedError,),
    )


if __name__ == "__main__":
    raise SystemExit(main())
