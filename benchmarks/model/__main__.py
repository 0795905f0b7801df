"""What the kernel machine costs at any size: ``python -m benchmarks.model [--quick]``.

Six measurements on synthetic features (``measure``): the size and latency of the head,
accumulating beside bare BLAS, fitting beside scikit-learn, folds in closed form beside refits,
memory at any number of bins, and many workers. Prints tables and the limits the project has set
itself, and keeps numbers and figure in ``benchmarks/results``.

The one run at a million bins: ``python -m benchmarks.model --only any_size --bins 1000000``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import torch

from benchmarks.clocks import on_threads
from benchmarks.machine import machine_facts, versions
from benchmarks.model.figure import PANELS, figure
from benchmarks.model.measure import SECTIONS
from benchmarks.model.report import limit_rows, ratios, report_text
from benchmarks.model.sizes import QUICK, Sizes
from benchmarks.model.worker import WorkerFailedError
from benchmarks.outcome import (
    EXIT_INTERRUPTED,
    add_paths,
    keep_by_default,
    keep_numbers,
    refuse_paths,
)

EXIT_FAILED = 1


def measure(sizes: Sizes, names: Sequence[str], threads: int, quick: bool) -> dict[str, Any]:
    """The report: facts, the sections named, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        names: of ``SECTIONS``.
        threads: for PyTorch and every BLAS.
        quick: whether the sizes are too small to mean anything.
    """
    machine = machine_facts()
    with on_threads(threads):
        sections = {name: SECTIONS[name](sizes) for name in names}
    settings = asdict(sizes)
    return {
        "synthetic": True,
        "quick": quick,
        "machine": machine,
        "threads": threads,
        "versions": versions(),
        "settings": settings,
        "sections": sections,
        "ratios": ratios(sections),
        "limits": limit_rows(sections, settings),
    }


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.model",
        description="Time the kernel machine on synthetic features, beside BLAS and scikit-learn.",
    )
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument(
        "--only", nargs="+", choices=SECTIONS, metavar="SECTION", help="of %(choices)s"
    )
    parser.add_argument("--bins", type=int, metavar="N", help="of any_size")
    parser.add_argument("--repeat", type=int, metavar="N", help="of what takes seconds")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N")
    add_paths(parser, "if all is measured in full")
    parsed = parser.parse_args(arguments)
    for name in ("bins", "repeat", "threads"):
        value = getattr(parsed, name)
        if value is not None and value < 1:
            parser.error(f"--{name} must be at least 1, got {value}")
    refuse_paths(parser, parsed, "json", "figure")
    if parsed.figure and parsed.only and not set(parsed.only) & set(PANELS):
        parser.error(f"--figure shows {', '.join(PANELS)}; measure one of them")
    if not (parsed.quick or parsed.only):
        keep_by_default(parsed, "model")
    return parsed


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parsed = _arguments(arguments)
    sizes = QUICK if parsed.quick else Sizes()
    if parsed.bins:
        sizes = replace(sizes, any_bins=parsed.bins)
    if parsed.repeat:
        sizes = replace(sizes, repeats=parsed.repeat)
    names = [name for name in SECTIONS if parsed.only is None or name in parsed.only]
    try:
        report = measure(sizes, names, parsed.threads, parsed.quick)
    except WorkerFailedError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
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
