"""What is kept without some sensors: ``python -m benchmarks.dead_sensors [--quick] [--json FILE]``.

The detector of the main job on held-out cycles and unseen materials, without each channel, each
finger and random halves of the channels: the expected score in closed form beside features filled
in, and beside a machine refitted for each loss. Prints tables and keeps numbers and figure in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.dead_sensors.figure import figure
from benchmarks.dead_sensors.measure import losses
from benchmarks.dead_sensors.report import limit_rows, report_text
from benchmarks.dead_sensors.sizes import QUICK, Sizes
from benchmarks.dead_sensors.subject import fitted_subject
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import EXIT_INTERRUPTED, add_paths, keep_by_default, refuse_paths, told


def measure(sizes: Sizes, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    subject = fitted_subject(sizes)
    rows = losses(subject, sizes)
    return {
        "simulated": subject.is_simulated,
        "quick": quick,
        "machine": machine,
        "versions": versions(),
        "settings": asdict(sizes),
        "num_features": subject.detector.head.num_features,
        "sections": {"losses": rows},
        "limits": limit_rows(rows),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.dead_sensors",
        description="Accuracy and calibration without some sensors, by every way to go on.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "dead_sensors")
    try:
        report = measure(QUICK if parsed.quick else Sizes(), parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
