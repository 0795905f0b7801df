"""What a stream costs: ``python -m benchmarks.streaming [--quick] [--model detector.pt]``.

``StreamingDetector`` on one thread, from samples to alarms: how many times faster than real time by
the size of a push, by hop and by engine, beside the naive stream (every bin with its context by
``judge_raw``, in the same run), and the resident memory along an hour of stream in a process of its
own. Prints tables and limits, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.detectors import timed_detector
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths
from benchmarks.streaming.figure import figure
from benchmarks.streaming.measure import memory, speed
from benchmarks.streaming.report import limit_rows, report_text
from benchmarks.streaming.sizes import QUICK, Sizes


def measure(sizes: Sizes, model: Path | None, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        model: a trained detector, whose selection is timed; default: the one kept.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    timed = timed_detector(sizes.recordings, model)
    sections = {"speed": speed(timed, sizes), "memory": memory(timed, sizes)}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": 1,
        "versions": versions(("numba",)),
        "settings": asdict(sizes),
        "selection": timed.selection,
        "sections": sections,
        "limits": limit_rows(sections),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.streaming",
        description="Time a stream from samples to alarms, and look at its memory for an hour.",
    )
    parser.add_argument("--quick", action="store_true", help="a few pushes, to see that it runs")
    parser.add_argument("--model", type=Path, metavar="FILE", help="take a trained one's selection")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "streaming")
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), parsed.model, parsed.quick),
        report_text,
        figure,
        parsed,
        parsed.model,
    )


if __name__ == "__main__":
    raise SystemExit(main())
