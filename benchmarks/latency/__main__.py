"""What one bin costs: ``python -m benchmarks.latency [--quick] [--model detector.pt]``.

From the raw samples of one bin to a score, one call at a time on one thread: p50 and p99 of
detectors by every engine, of the SciPy and PyWavelets loop, of MiniRocket, and of scikit-learn's
heads behind our features; score errors beside them. Prints tables and the limit the project has set
itself, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.detectors import timed_detector
from benchmarks.latency.figure import figure
from benchmarks.latency.measure import latencies
from benchmarks.latency.report import limit_rows, report_text
from benchmarks.latency.sizes import QUICK, Sizes
from benchmarks.machine import PEERS, machine_facts, versions
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths


def measure(sizes: Sizes, model: Path | None, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        model: a trained detector, whose selection is timed; default: the one kept.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    timed = timed_detector(sizes.recordings, model)
    section = latencies(timed, sizes)
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": 1,
        "versions": versions(PEERS),
        "settings": asdict(sizes),
        "selection": timed.selection,
        "training_bins": len(timed.z),
        "sections": {"latency": section},
        "limits": limit_rows(section["rows"]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.latency",
        description="Time single bins from raw samples to a score, beside other tools.",
    )
    parser.add_argument("--quick", action="store_true", help="a few calls, to see that it runs")
    parser.add_argument("--model", type=Path, metavar="FILE", help="take a trained one's selection")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "latency")
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), parsed.model, parsed.quick),
        report_text,
        figure,
        parsed,
        parsed.model,
    )


if __name__ == "__main__":
    raise SystemExit(main())
