"""BENCHMARKS.md and its figures from kept numbers: ``python -m benchmarks.report``.

Reads the JSON files that the benchmarks leave in ``benchmarks/results``, draws the figures of
features, latency and throughput anew beside them, and writes ``BENCHMARKS.md`` in the root of the
repository. No number in it is typed by hand. What was not measured is named with its command.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import train
from benchmarks.features import figure as features_figure
from benchmarks.features import report as features
from benchmarks.latency import figure as latency_figure
from benchmarks.latency import report as latency
from benchmarks.model import report as model
from benchmarks.outcome import QUICK_LINE, RESULTS
from benchmarks.precision import report as precision
from benchmarks.tables import Table, limits
from benchmarks.throughput import figure as throughput_figure
from benchmarks.throughput import report as throughput
from tactslip_torch.files import whole_file

ROOT = Path(__file__).parents[1]
INTRODUCTION = """# Benchmarks

Written by `python -m benchmarks.report` from the files in `{results}`; no number is typed by hand.
Bins are generated or come from the **simulated** hand: what things cost, nothing about a real hand.
Everything in one table was measured in one run, in turns, in an order of its own in every round;
numbers are medians, brackets hold quartiles, errors stand beside times. To repeat:
`pip install -e ".[bench]"`, then the command of a section (`--quick` to see that it runs,
`--json FILE` to keep the numbers elsewhere)."""

Report = Mapping[str, Any]


class Section(NamedTuple):
    """A benchmark in the file.

    Attributes:
        title: heads it.
        tables: of its report, by title, the limits first; ``None`` where it prints text alone.
        text: what it prints.
        draw: draws its figure; ``None`` where the benchmark itself leaves one.
        about: a line on what was measured.
        needs: sections without which there is no figure.
    """

    title: str
    tables: Callable[[Report], Mapping[str, Sequence[Table]]] | None
    text: Callable[[Report], str]
    draw: Callable[[Report, Path], None] | None = None
    about: Callable[[Report], str] | None = None
    needs: tuple[str, ...] = ()


SECTIONS = {
    "features": Section(
        "Features",
        features.tables,
        features.report_text,
        features_figure.figure,
        needs=("pool",),
    ),
    "latency": Section(
        "Latency", latency.tables, latency.report_text, latency_figure.figure, latency.about
    ),
    "throughput": Section(
        "Throughput",
        throughput.tables,
        throughput.report_text,
        throughput_figure.figure,
        throughput.about,
        needs=("batch",),
    ),
    "train": Section("Training", None, train.report_text),
    "model": Section("Kernel machine at any size", None, model.report_text),
    "precision": Section("Precision", None, precision.report_text),
}
"""By the name of the benchmark and of its file."""


def load_reports(folder: Path) -> dict[str, dict[str, Any]]:
    """The reports that are there, by name.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if one is not JSON, or was measured in part.
    """
    found = {}
    for name in SECTIONS:
        path = folder / f"{name}.json"
        if not path.exists():
            continue
        try:
            found[name] = json.loads(path.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise ValueError(f"{path} is not JSON ({error}); measure it again") from None
        missing = [of for of in SECTIONS[name].needs if of not in found[name]["sections"]]
        if missing:
            raise ValueError(
                f"{path} has no section {missing[0]}; python -m benchmarks.{name} measures all"
            )
    if not found:
        names = ", ".join(f"{name}.json" for name in SECTIONS)
        raise FileNotFoundError(f"no numbers in {folder}, expected any of {names}; measure first")
    return found


def markdown(reports: Mapping[str, Report], images: str) -> str:
    """The content of BENCHMARKS.md.

    Args:
        reports: by name, of ``SECTIONS``.
        images: folder of the figures, as the file refers to it.
    """
    parts = [INTRODUCTION.format(results=images), _limits(reports)]
    for name, section in SECTIONS.items():
        command = f"`python -m benchmarks.{name}`"
        if name in reports:
            parts += [f"## {section.title}", *_section(name, section, reports[name], images)]
        else:
            parts.append(f"## {section.title}\n\nNot measured; {command} does.")
    return "\n\n".join(parts) + "\n"


def _limits(reports: Mapping[str, Report]) -> str:
    """How many limits are missed, and every limit of every benchmark that has a table of them."""
    rows = [
        {**row, "what": f"{name}: {row['what']}"}
        for name, report in reports.items()
        for row in report["limits"]
        if "what" in row
    ]
    missed = sum(not row["ok"] for row in rows)
    line = f"{len(rows) - missed} of {len(rows)} limits that the project has set itself are met."
    return "\n\n".join(["## Limits", line, *([limits(rows).markdown()] if rows else [])])


def _section(name: str, section: Section, report: Report, images: str) -> list[str]:
    facts = ", ".join([*report["machine"].values()])
    versions = ", ".join(f"{what} {of}" for what, of in report["versions"].items())
    parts = [f"`python -m benchmarks.{name}`, on {facts}; {versions}."]
    if report.get("quick"):
        parts.append(f"**{QUICK_LINE}.**")
    if section.about:
        parts.append(f"{section.about(report)[:1].upper()}{section.about(report)[1:]}.")
    if name != "train":
        parts.append(f"![{section.title}]({images}/{name}.png)")
    if section.tables is None:
        text = f"```text\n{section.text(report)}\n```"
        return [*parts, f"<details><summary>Tables</summary>\n\n{text}\n\n</details>"]
    for title, tables in list(section.tables(report).items())[1:]:
        parts += [f"### {title}", *(table.markdown() for table in tables)]
    return parts


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.report",
        description="Write BENCHMARKS.md and its figures from the numbers that benchmarks keep.",
    )
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=ROOT / "BENCHMARKS.md", metavar="FILE")
    parsed = parser.parse_args(arguments)
    try:
        reports = load_reports(parsed.results)
    except (FileNotFoundError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for name, report in reports.items():
        draw = SECTIONS[name].draw
        if draw is not None:
            draw(report, parsed.results / f"{name}.png")
    images = Path(os.path.relpath(parsed.results, parsed.out.parent)).as_posix()
    with whole_file(parsed.out) as temporary:
        temporary.write_text(markdown(reports, images), encoding="utf-8")
    print(f"{parsed.out} from {', '.join(f'{name}.json' for name in reports)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
