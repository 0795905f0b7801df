"""Which sensors matter: ``python -m benchmarks.sensors [RUN/detector.pt]``.

Runs ``tactslip importance`` with features selected anew in both ways, by the recipe's
ranking and as many of each channel, for a detector of ``+exp=unseen4``: one that is given, or one
trained for it. Prints the tables, and keeps numbers and figure in ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import machine_facts, versions
from benchmarks.outcome import add_paths, heading, keep_by_default, refuse_paths, told
from benchmarks.tables import Table
from tactslip_torch.report.importance import (
    BEST_LINE,
    RESELECT_WORDS,
    best_rows,
    lines_about,
    sensors_figure,
    unit_rows,
    with_all_line,
)

SECTIONS = tuple(RESELECT_WORDS)
_COMMAND = [sys.executable, "-m"]


def measure(model: Path | None, overrides: Sequence[str]) -> dict[str, Any]:
    """The report: facts and what ``sensors`` found, by way of selection. JSON-able.

    Args:
        model: a detector in its run's folder; without one it is trained.
        overrides: of ``sensors``.

    Raises:
        SystemExit: if a command fails, which has said why.
    """
    machine = machine_facts()
    sections = {}
    with tempfile.TemporaryDirectory() as folder:
        if model is None:
            run = Path(folder) / "run"
            given = ["+exp=unseen4", "recipe=robust", "export=false"]  # selects among channels
            _run("tactslip_torch.train", *given, f"hydra.run.dir={run}")
            model = run / "detector.pt"
        for name in SECTIONS:
            out = Path(folder) / name
            given = [f"model={model}", f"anew={name}", *overrides]
            _run("tactslip_torch.commands.importance", *given, f"hydra.run.dir={out}")
            sections[name] = json.loads((out / "sensors.json").read_text(encoding="utf-8"))
    return {
        "simulated": sections[SECTIONS[0]]["simulated"],
        "quick": False,
        "machine": machine,
        "versions": versions(),
        "sections": sections,
        "limits": [],
    }


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, that of limits first, which is empty: none was set.

    Args:
        report: as ``--json`` keeps it.
    """
    found: dict[str, list[Table]] = {"Limits": []}
    for name, content in report["sections"].items():
        rows = {unit: unit_rows(content, unit) for unit in content["best"]}
        notes = dict.fromkeys(rows, "") | {"kind": "; ".join([*lines_about(content)])}
        found[f"One by one, features anew {RESELECT_WORDS[name]}"] = [
            Table(cells[0], cells[1:], notes.get(unit, "")) for unit, cells in rows.items()
        ]
        rows = {unit: best_rows(content, unit) for unit in content["best"]}
        found[f"The best few, features {RESELECT_WORDS[name]}"] = [
            Table(cells[0], cells[1:], with_all_line(content) if unit == "kind" else "")
            for unit, cells in rows.items()
        ]
    return found


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    content = report["sections"][SECTIONS[0]]
    kind = "simulated" if content["simulated"] else "recorded"
    return (
        f"a detector of {content['split']}, {kind}, {content['detector']['features']} features of "
        f"{len(content['channels'])} channels; {BEST_LINE.rstrip(':')}"
    )


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    parts = [table.text() for of_title in tables(report).values() for table in of_title]
    return heading(report, about(report), parts)


def figure(report: Mapping[str, Any], path: Path) -> None:
    """The hand and the best few, features by the recipe's ranking."""
    sensors_figure(report["sections"][SECTIONS[0]], path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sensors",
        description="Which sensors of a trained detector matter, in both ways of selection.",
    )
    parser.add_argument("model", type=Path, nargs="?", help="detector.pt in its run's folder")
    parser.add_argument("overrides", nargs="*", help="passed on, such as bins=50")
    add_paths(parser, "by default")
    parsed = parser.parse_args(arguments)
    refuse_paths(parser, parsed, "json", "figure")
    keep_by_default(parsed, "sensors")
    return told(measure(parsed.model, parsed.overrides), report_text, figure, parsed)


def _run(module: str, *arguments: str) -> None:
    done = subprocess.run([*_COMMAND, module, *arguments], stdout=subprocess.DEVNULL, check=False)
    if done.returncode:
        raise SystemExit(done.returncode)


if __name__ == "__main__":
    raise SystemExit(main())
