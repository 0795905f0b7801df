"""What a few recordings of a new material bring: ``python -m benchmarks.adapting [--quick]``.

On the **simulated** hand. The main job is trained with ``statistics=true``; each of its unseen
materials is then brought to it, by 1 to 10 recordings, labelled or slip-free alone, beside fitting
again on everything, moving the threshold, and training on the material. A training in ``--run``
that this very code finished is taken. Prints tables, and keeps numbers and figure in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks.adapting.figure import figure
from benchmarks.adapting.measure import adapted, chosen_weights, one_step
from benchmarks.adapting.report import limit_rows, report_text
from benchmarks.adapting.sizes import QUICK, Sizes
from benchmarks.adapting.subject import Subject, subject_of
from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import (
    EXIT_INTERRUPTED,
    ROOT,
    add_paths,
    keep_by_default,
    refuse_paths,
    told,
)
from tactslip_torch.features.cache import default_cache_folder


def measure(sizes: Sizes, subject: Subject, machine: dict[str, str], quick: bool) -> dict[str, Any]:
    """The report: facts, measurements, and what follows from them. JSON-able.

    Args:
        sizes: how much.
        subject: of ``subject_of``.
        machine: as it was before.
        quick: whether the sizes are too small to mean anything.
    """
    sections = {
        "adapted": adapted(subject, sizes),
        "weights": chosen_weights(subject, sizes),
        "step": one_step(subject, sizes),
    }
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "threads": torch.get_num_threads(),
        "versions": versions(("numba",)),
        "settings": asdict(sizes),
        "sections": sections,
        "limits": limit_rows(sections["adapted"], sections["step"], sizes.judged),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.adapting",
        description="New materials from a few recordings, and what the old ones lose; simulated.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    parser.add_argument("--run", type=Path, metavar="FOLDER", help="of the training")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "adapting")
    folder = parsed.run or ROOT / "outputs" / f"adapting-bench{'-quick' * parsed.quick}"
    machine = machine_facts()
    sizes = QUICK if parsed.quick else Sizes()
    try:
        if parsed.quick:  # what nobody needs again stays out of the user's cache
            with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as cache:
                subject = subject_of(sizes, folder.resolve(), Path(cache))
                report = measure(sizes, subject, machine, quick=True)
        else:
            subject = subject_of(sizes, folder.resolve(), default_cache_folder())
            report = measure(sizes, subject, machine, quick=False)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return told(report, report_text, figure, parsed)


if __name__ == "__main__":
    raise SystemExit(main())
