"""What tuning by gradient buys beside a grid: ``python -m benchmarks.tuning [--quick]``.

Runs ``python -m tactslip_torch.train +exp=tuned`` with more and more to learn: C and c, the scales
of features as well. Each way is judged on training materials held out from it
and, as a detector, on test and unseen materials of the **simulated** hand, beside the grid of its
recipe by balanced accuracy and by loss. Prints a table, and keeps numbers and figure in
``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import add_paths, heading, keep_by_default, refuse_paths, told
from benchmarks.reproduction.runs import run
from benchmarks.tables import Table, limits
from tactslip_torch.report.results import HELD_NOTE, WAYS, held_mean, tuning_figure

LEARNED = {
    "C and c": "[penalty,offset]",
    "C, c and scales": "[penalty,offset,scales]",
}
_QUICK = ["+exp=quick", "tuning=gradient", "tuning.bins=6", "tuning.steps=2"]
_QUICK += ["recipe=robust", "recipe.num_features=8"]
SECTIONS = tuple(LEARNED)


def measure(*, quick: bool) -> dict[str, Any]:
    """The report: facts, and what each way found. JSON-able.

    Args:
        quick: too little to mean anything.

    Raises:
        RuntimeError: if a training fails.
    """
    machine = machine_facts()
    sections: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="tactslip-bench-") as folder:
        cache = Path(folder) / "features"
        for name, learn in LEARNED.items():
            place = Path(folder) / str(len(sections))
            overrides = [*(_QUICK if quick else ["+exp=tuned"]), f"tuning.learn={learn}"]
            metrics = run(f"tuning {name}", overrides, place, cache)
            sections[name] = metrics["tuning"] | {"tuned_splits": metrics["splits"]}
    return {
        "simulated": True,
        "quick": quick,
        "machine": machine,
        "versions": versions(),
        "sections": sections,
        "limits": limit_rows(sections, quick=quick),
    }


def limit_rows(sections: Mapping[str, Any], *, quick: bool = False) -> list[dict[str, Any]]:
    """What the issue asks: a lower held-out loss than the grid's best, of either choice."""
    rows = []
    for name, found in sections.items():
        tuned = held_mean(found, "tuned")
        for way, of_grid in (("by balanced accuracy", "recipe"), ("by loss", "grid")):
            grid = held_mean(found, of_grid)
            rows.append(
                {
                    "what": f"held-out loss, {name} learned, over that of the grid's best {way}",
                    "measured": f"{tuned / grid:.3f}",
                    "limit": "below 1",
                    "ok": None if quick else tuned < grid,
                }
            )
    return rows


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, that of limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    header = ["settings", "held-out loss", "held-out %", "test %", "unseen %", "steps", "seconds"]
    rows = []
    for place, (name, found) in enumerate(report["sections"].items()):
        judged = found["splits"]
        if not place:
            rows.append(_row(WAYS["recipe"], found, "recipe", judged["recipe"], found["fit_s"]))
            rows.append(_row(WAYS["grid"], found, "grid", judged["grid"], None))
        rows.append(_row(f"{name} tuned", found, "tuned", found["tuned_splits"], found["seconds"]))
    note = f"{HELD_NOTE}; seconds: of tuning, and of the whole first fit for the grid"
    return {
        "Limits": [limits(report["limits"])],
        "Beside the grid": [Table(header, rows, note)],
    }


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    first = next(iter(report["sections"].values()))
    return (
        f"+exp=tuned on the simulated hand; each way tuned on {first['bins']} training bins of "
        f"{len(first['held'])} materials"
    )


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    parts = [table.text() for of_title in tables(report).values() for table in of_title]
    return heading(report, about(report), parts)


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Descents and scales of the way that learns most."""
    tuning_figure(report["sections"][SECTIONS[-1]], path, simulated=report["simulated"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.tuning",
        description="Tuning by gradient beside the grid of its recipe, on the simulated hand.",
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    add_paths(parser)
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    if not parsed.quick:
        keep_by_default(parsed, "tuning")
    try:
        report = measure(quick=parsed.quick)
    except RuntimeError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return told(report, report_text, figure, parsed)


def _row(
    name: str,
    found: Mapping[str, Any],
    way: str,
    splits: Mapping[str, Any],
    seconds: float | None,
) -> list[str]:
    return [
        name,
        f"{held_mean(found, way):.4f}",
        f"{100 * held_mean(found, way, 'balanced_accuracy'):.2f}",
        *(f"{100 * splits[role]['balanced_accuracy']:.2f}" for role in ("test", "unseen")),
        str(found["steps"]) if way == "tuned" else "",
        "" if seconds is None else f"{seconds:.0f}",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
