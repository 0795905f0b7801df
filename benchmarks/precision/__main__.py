"""What precision costs and buys: ``python -m benchmarks.precision [--quick] [--json FILE]``.

Simulated recordings of the main experiment, one plan fitted once in float64, and variants of it:
float32 bins computed in float64, float32 throughout, fitted and solved so, heads in half
precision. For each: time of features and head, memory, score error beside float64, decisions that
flip, balanced accuracy. Prints tables and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import torch

from benchmarks.clocks import on_threads
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import (
    EXIT_INTERRUPTED,
    add_paths,
    keep_by_default,
    keep_numbers,
    refuse_paths,
)
from benchmarks.precision.data import load_experiment
from benchmarks.precision.figure import figure
from benchmarks.precision.measure import measure_variants
from benchmarks.precision.report import limit_rows, ratios, report_text
from benchmarks.precision.sizes import QUICK, Sizes


def measure(sizes: Sizes, threads: int, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        threads: for PyTorch and every BLAS.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    with on_threads(threads):
        experiment = load_experiment(sizes)
        measured = measure_variants(experiment, sizes)
    return {
        "simulated": experiment.facts["simulated"],
        "quick": quick,
        "machine": machine,
        "threads": threads,
        "versions": versions(),
        "settings": asdict(sizes),
        "experiment": experiment.facts,
        **measured,
        "ratios": ratios(measured["variants"]),
        "limits": limit_rows(measured["variants"]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.precision",
        description="Time and judge the pipeline in several precisions, on simulated recordings.",
    )
    parser.add_argument("--quick", action="store_true", help="few bins, to see that it runs")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    if parsed.threads < 1:
        parser.error(f"--threads must be at least 1, got {parsed.threads}")
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "precision")
    try:
        report = measure(QUICK if parsed.quick else Sizes(), parsed.threads, parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    print(report_text(report))
    keep_numbers(report, parsed.json)
    if parsed.figure:
        figure(report, parsed.figure)
        print(f"\nfigure in {parsed.figure}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
