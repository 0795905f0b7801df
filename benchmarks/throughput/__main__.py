"""What many bins cost: ``python -m benchmarks.throughput [--quick] [--model detector.pt]``.

Bins a second of the planned detector in bulk, stage by stage; curves over the number of bins at
once, the length of a bin and the number of channels; memory of a batch, and of a million bins that
pass as chunks to a consumer, each in a fresh process. Prints tables and the limits the project has
set itself, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.detectors import timed_detector
from benchmarks.machine import PEERS, machine_facts, versions
from benchmarks.model.worker import WorkerFailedError
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths
from benchmarks.throughput.figure import PANELS, figure
from benchmarks.throughput.measure import SECTIONS
from benchmarks.throughput.report import limit_rows, report_text
from benchmarks.throughput.sizes import QUICK, Sizes


def measure(sizes: Sizes, names: Sequence[str], model: Path | None, quick: bool) -> dict[str, Any]:
    """The report: facts, the sections named, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        names: of ``SECTIONS``.
        model: a trained detector, whose selection is timed; default: the one kept.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    timed = timed_detector(sizes.recordings, model)
    sections = {name: SECTIONS[name](timed, sizes) for name in names}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": max(sizes.threads),
        "versions": versions(PEERS),
        "settings": asdict(sizes),
        "selection": timed.selection,
        "sections": sections,
        "limits": limit_rows(sections),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.throughput",
        description="Time many bins at once, and watch what memory they take.",
    )
    parser.add_argument("--quick", action="store_true", help="few bins, to see that it runs")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="of %(choices)s"
    )
    parser.add_argument("--model", type=Path, metavar="FILE", help="take a trained one's selection")
    add_paths(parser, "if all is measured in full")
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if parsed.figure and parsed.only and not set(parsed.only) & set(PANELS):
        parser.error(f"--figure shows {', '.join(PANELS)}; measure one of them")
    if not (parsed.quick or parsed.only):
        keep_by_default(parsed, "throughput")
    names = [name for name in SECTIONS if parsed.only is None or name in parsed.only]
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), names, parsed.model, parsed.quick),
        report_text,
        figure,
        parsed,
        parsed.model,
        (WorkerFailedError,),
    )


if __name__ == "__main__":
    raise SystemExit(main())
