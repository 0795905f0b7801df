"""What the way back through a fit costs: ``python -m benchmarks.gradients [--quick]``.

A loss through the closed-form fit, or through groups left out of it, and its gradient: beside the
fit without a way back, and beside autograd through the Gram matrix and its factor. Prints tables
and the limits the project has set itself, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.gradients.figure import figure
from benchmarks.gradients.measure import gradients
from benchmarks.gradients.report import limit_rows, report_text
from benchmarks.gradients.sizes import QUICK, Sizes
from benchmarks.machine import machine_facts, versions
from benchmarks.model.worker import WorkerFailedError
from benchmarks.outcome import add_paths, keep_by_default, outcome, refuse_paths


def measure(sizes: Sizes, quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    section = gradients(sizes)
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": sizes.threads,
        "versions": versions(),
        "settings": asdict(sizes),
        "sections": {"gradients": section},
        "limits": limit_rows(section["rows"]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gradients",
        description="Time a loss through the closed-form fit and its gradient, beside autograd.",
    )
    parser.add_argument("--quick", action="store_true", help="a few bins, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "gradients")
    return outcome(
        lambda: measure(QUICK if parsed.quick else Sizes(), parsed.quick),
        report_text,
        figure,
        parsed,
        None,
        (WorkerFailedError,),
    )


if __name__ == "__main__":
    raise SystemExit(main())
