"""What each rung of the simulated hand costs and buys: ``python -m benchmarks.simulation``.

For each rung and step of the integration: seconds per simulated minute of 24 channels, the error
of friction and of onset against scipy's Radau on single elements, and what it does to downstream
accuracy; what parts of a batch cost beside the whole, and how long a training waits for its data.
Prints tables with a recommended default, and keeps numbers and figure in ``benchmarks/results``
(``--quick`` to see that it runs, ``--json FILE`` to keep the numbers elsewhere).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.clocks import on_threads
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import EXIT_INTERRUPTED, add_paths, keep_by_default, refuse_paths, told
from benchmarks.simulation.accuracy import accuracies
from benchmarks.simulation.cost import RUNGS, minute_costs, needed_seconds, parts
from benchmarks.simulation.errors import elements, kinematic_errors, step_errors
from benchmarks.simulation.figure import figure
from benchmarks.simulation.report import SECTIONS, limit_rows, recommended, report_text
from benchmarks.simulation.sizes import QUICK, Sizes


def measure(sizes: Sizes, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    needed = []
    if sizes.whole_cycles:  # first: processes are forked before threads start
        needed = [needed_seconds(rung, sizes) for rung in ("kinematic", "lugre")]
    with on_threads(1):
        cases = {rung: elements(rung, sizes) for rung in RUNGS}
        errors = [kinematic_errors(cases["lugre"])]
        errors += [step_errors(r, cases[r], step) for r in RUNGS for step in sizes.steps_us]
        costs = minute_costs(sizes)
        shares = {rung: parts(rung, sizes) for rung in ("kinematic", "lugre")}
        accurate = accuracies(sizes) if sizes.cycles else []
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": 1,
        "versions": versions(("numba",)),
        "settings": asdict(sizes),
        "sections": dict(zip(SECTIONS, (costs, errors, accurate, shares, needed), strict=True)),
        "recommended": recommended(costs, errors, accurate),
        "limits": limit_rows(shares, needed),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.simulation",
        description="Cost, error and downstream accuracy of each rung of the simulated hand.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "simulation")
    try:
        report = measure(QUICK if parsed.quick else Sizes(), parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
