"""What hops and filters buy and cost, and rivals: ``python -m benchmarks.onset [--quick]``.

On the **simulated** hand. A detector is trained behind each filter; at every hop a threshold is set
for the same rate of false alarms, and other recordings tell delay, slips found, the rate achieved
and compute: a front. Then the detector, the methods that the paper argues against and MiniRocket
with ridge stand side by side, with one rule, hop and target. Trainings in ``--runs`` that this very
code finished are taken. Prints tables, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks.machine import machine_facts, versions
from benchmarks.onset.figure import figure
from benchmarks.onset.front import front_of
from benchmarks.onset.report import limit_rows, report_text
from benchmarks.onset.rivals import rivals_of
from benchmarks.onset.sizes import QUICK, Sizes
from benchmarks.onset.trained import train_all
from benchmarks.outcome import (
    EXIT_INTERRUPTED,
    ROOT,
    add_paths,
    keep_by_default,
    refuse_paths,
    told,
)


def measure(
    sizes: Sizes,
    trained: Mapping[str, Mapping[str, Any]],
    machine: Mapping[str, str],
    quick: bool,
) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        trained: of ``train_all``.
        machine: as it was before.
        quick: whether the sizes are too small to mean anything.
    """
    front = front_of(sizes, trained)
    rivals = rivals_of(sizes, trained)
    return {
        "simulated": True,
        "quick": quick,
        "machine": dict(machine),
        "threads": 1,
        "versions": versions(("numba", "aeon")),
        "settings": asdict(sizes),
        "sections": {
            "trained": {
                align: {name: fact for name, fact in of.items() if name != "file"}
                for align, of in trained.items()
            },
            "front": front,
            "rivals": rivals,
        },
        "limits": limit_rows(front["rows"], rivals["rows"]),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.onset",
        description="Hops and filters of the simulated hand's alarms as a front, and rivals.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="of trainings (outputs/onset)")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "onset")
    folder = parsed.runs or ROOT / "outputs" / f"onset-bench{'-quick' * parsed.quick}"
    torch.set_num_threads(1)  # watching and training use the processors
    machine = machine_facts()
    sizes = QUICK if parsed.quick else Sizes()
    try:
        trained = train_all(sizes, folder.resolve())
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    try:
        report = measure(sizes, trained, machine, parsed.quick)
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
