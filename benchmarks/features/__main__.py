"""What features and scores cost: ``python -m benchmarks.features [--quick] [--json FILE]``.

Here: what the guards cost that keep extremes from becoming silent numbers. Features and scores of
ordinary bins are timed with them and, in the same rounds, with plain formulas in their place
(``guards_off``); a solve with its report beside a bare factorisation. Prints tables and the limit
the project has set itself, and keeps the numbers in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.features.guards_off import replaced
from benchmarks.features.measure import SECTIONS
from benchmarks.features.report import limit_rows, ratios, report_text
from benchmarks.features.sizes import QUICK, Sizes
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import EXIT_INTERRUPTED, RESULTS, keep_numbers, refuse_folders


def measure(sizes: Sizes, names: Sequence[str], quick: bool) -> dict[str, Any]:
    """The report: facts, the sections named, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        names: of ``SECTIONS``.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    sections = {name: SECTIONS[name](sizes) for name in names}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "versions": versions(),
        "settings": asdict(sizes),
        "replaced": replaced(),
        "sections": sections,
        "ratios": ratios(sections),
        "limits": limit_rows(sections),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.features",
        description="Time features and scores of simulated bins, with guards and without.",
    )
    parser.add_argument("--quick", action="store_true", help="a few rounds, to see that it runs")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="of %(choices)s"
    )
    text = "where the numbers go (benchmarks/results, if all is measured in full)"
    parser.add_argument("--json", type=Path, metavar="FILE", help=text)
    parsed = parser.parse_args(arguments)
    refuse_folders(parser, parsed, "json")
    if not (parsed.quick or parsed.only):
        parsed.json = parsed.json or RESULTS / "features.json"
    names = [name for name in SECTIONS if parsed.only is None or name in parsed.only]
    try:
        report = measure(QUICK if parsed.quick else Sizes(), names, parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    print(report_text(report))
    keep_numbers(report, parsed.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
