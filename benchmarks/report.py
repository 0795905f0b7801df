"""BENCHMARKS.md and its figures from kept numbers: ``python -m benchmarks.report``.

Reads the JSON files that the benchmarks leave in ``benchmarks/results``, draws the figures of those
that can be drawn anew beside them, and writes ``BENCHMARKS.md`` in the root of the
repository. No number in it is typed by hand. What was not measured is named with its command.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.outcome import QUICK_LINE, RESULTS
from benchmarks.rates import NOT_MEASURED, not_measured
from benchmarks.sections import SECTIONS, Report, Section
from benchmarks.tables import limits
from tactslip_torch.runtime import whole_file

ROOT = Path(__file__).parents[1]
INTRODUCTION = """# Benchmarks

Written by `python -m benchmarks.report` from the files in `{results}`; no number is typed by hand.
Bins are generated or come from the **simulated** hand: what things cost, nothing about a real hand.
Everything in one table was measured in one run, in turns, in an order of its own in every round;
numbers are medians, brackets hold quartiles, errors stand beside times. To repeat:
`pip install -e ".[bench]"`, then the command of a section (`--quick` to see that it runs,
`--json FILE` to keep the numbers elsewhere)."""

_KEYS = ("machine", "versions", "limits")


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
        except ValueError as error:  # JSON's, and that of bytes that are no text
            raise ValueError(f"{path} is not JSON ({error}); measure it again") from None
        missing = _missing(found[name], SECTIONS[name])
        if missing:
            raise ValueError(f"{path} has no {missing}; python -m benchmarks.{name} measures all")
    if not found:
        names = ", ".join(f"{name}.json" for name in SECTIONS)
        raise FileNotFoundError(f"no numbers in {folder}, expected any of {names}; measure first")
    return found


def _missing(report: Any, section: Section) -> str:
    """What a file lacks, in words; empty if it is whole."""
    if not isinstance(report, dict):
        return "report in it"
    sections = report.get("sections", {})
    lacking = [f"section {name}" for name in section.needs if name not in sections]
    lacking += [f'"{name}"' for name in (*_KEYS, *section.keys) if name not in report]
    return next(iter(lacking), "")


def is_quick(report: Report) -> bool:
    """Whether the numbers of a report mean nothing."""
    return bool(report.get("quick")) or report.get("experiment") == "quick"


def markdown(reports: Mapping[str, Report], images: str) -> str:
    """The content of BENCHMARKS.md.

    Args:
        reports: by name, of ``SECTIONS``.
        images: folder of the figures, as the file refers to it.
    """
    introduction = INTRODUCTION.format(results=images)
    quick = [name for name, report in reports.items() if is_quick(report)]
    if quick:
        introduction = introduction.replace(
            "# Benchmarks\n",
            f"# Benchmarks, QUICK: numbers mean nothing\n\n**QUICK runs: {', '.join(quick)}.**\n",
        )
    parts = [introduction, _limits(reports)]
    for name, section in SECTIONS.items():
        command = f"`python -m benchmarks.{name}`"
        if name in reports:
            parts += [f"## {section.title}", *_section(name, section, reports[name], images)]
        else:
            parts.append(f"## {section.title}\n\nNot measured; {command} does.")
    return "\n\n".join(parts) + "\n"


def _limits(reports: Mapping[str, Report]) -> str:
    """How many limits are met, and every limit of every benchmark that has a table of them.

    A quick run judges nothing, and of a benchmark that has left no numbers nothing is met.
    """
    rows: list[dict[str, Any]] = []
    for name in SECTIONS:
        if name not in reports:
            rows.append(not_measured(f"{name}: every limit", ""))
            continue
        for row in reports[name]["limits"]:
            if "what" in row:
                ok = None if is_quick(reports[name]) else row["ok"]
                rows.append({**row, "what": f"{name}: {row['what']}", "ok": ok})
    judged = [row["ok"] for row in rows if row["ok"] is not None]
    open_ = sum(row["measured"] == NOT_MEASURED for row in rows)
    line = f"{sum(judged)} of {len(judged)} limits that were measured are met; "
    line += f"rows not measured: {open_}."
    if any(is_quick(report) for report in reports.values()):
        line += " QUICK runs judge no limit."
    return "\n\n".join(["## Limits", line, limits(rows).markdown()])


def _section(name: str, section: Section, report: Report, images: str) -> list[str]:
    facts = ", ".join([*report["machine"].values()])
    versions = ", ".join(f"{what} {of}" for what, of in report["versions"].items())
    parts = [f"`python -m benchmarks.{name}`, on {facts}; {versions}."]
    if is_quick(report):
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
