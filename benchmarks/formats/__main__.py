"""What files cost: ``python -m benchmarks.formats [--quick]``.

A simulated recording is written in every format, loaded whole and read in pieces, in turns; beside
it NumPy, SciPy and the formats' own libraries read the same files. Prints tables and the limit the
project has set itself, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.formats.figure import figure
from benchmarks.formats.measure import formats
from benchmarks.formats.report import limit_rows, report_text
from benchmarks.formats.sizes import QUICK, Sizes
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths

LIBRARIES = ("h5py", "pyarrow", "mcap", "rosbags")


def measure(sizes: Sizes, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    section = formats(sizes)
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": 1,
        "versions": versions(LIBRARIES),
        "settings": asdict(sizes),
        "sections": {"formats": section},
        "limits": limit_rows(section["rows"]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.formats",
        description="Time reading and writing a recording in every format, beside other tools.",
    )
    parser.add_argument("--quick", action="store_true", help="a second of it, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "formats")
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), parsed.quick),
        report_text,
        figure,
        parsed,
        None,
    )


if __name__ == "__main__":
    raise SystemExit(main())
