"""What unsure answers buy: ``python -m benchmarks.abstaining [--quick] [--json FILE]``.

Machines of the simulated hand on several choices of unseen materials. Thresholds for unsure answers
are set on held-out scores of their training bins for several coverages, with recordings as units
(ours), with bins as units, and by a threshold of the probability; they are judged on held-out
cycles and on the unseen materials. Prints tables and keeps numbers and figure in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.abstaining.figure import figure
from benchmarks.abstaining.report import limit_rows, report_text
from benchmarks.abstaining.sizes import QUICK, Sizes
from benchmarks.abstaining.splits import load_splits
from benchmarks.abstaining.ways import measure_split
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import EXIT_INTERRUPTED, add_paths, keep_by_default, refuse_paths, told


def measure(sizes: Sizes, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    splits, is_simulated = load_splits(sizes)
    rows = [row for split in splits for row in measure_split(split, sizes.coverages)]
    return {
        "simulated": is_simulated,
        "quick": quick,
        "machine": machine,
        "versions": versions(),
        "settings": asdict(sizes),
        "sections": {"answers": rows},
        "limits": limit_rows(rows),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.abstaining",
        description="Coverage, unsure answers and errors of several ways to abstain.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "abstaining")
    try:
        report = measure(QUICK if parsed.quick else Sizes(), parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
