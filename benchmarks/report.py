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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import sensors, train, tuning
from benchmarks.abstaining import figure as abstaining_figure
from benchmarks.abstaining import report as abstaining
from benchmarks.adapting import figure as adapting_figure
from benchmarks.adapting import report as adapting
from benchmarks.dead_sensors import figure as dead_sensors_figure
from benchmarks.dead_sensors import report as dead_sensors
from benchmarks.deployment import figure as deployment_figure
from benchmarks.deployment import report as deployment
from benchmarks.features import figure as features_figure
from benchmarks.features import report as features
from benchmarks.features.guards import measure as guards
from benchmarks.formats import figure as formats_figure
from benchmarks.formats import report as formats
from benchmarks.gradients import figure as gradients_figure
from benchmarks.gradients import report as gradients
from benchmarks.latency import figure as latency_figure
from benchmarks.latency import report as latency
from benchmarks.model import measure as model_measure
from benchmarks.model import report as model
from benchmarks.onset import figure as onset_figure
from benchmarks.onset import report as onset
from benchmarks.outcome import QUICK_LINE, RESULTS
from benchmarks.precision import report as precision
from benchmarks.rates import NOT_MEASURED, not_measured
from benchmarks.simulation import figure as simulation_figure
from benchmarks.simulation import report as simulation
from benchmarks.streaming import figure as streaming_figure
from benchmarks.streaming import measure as streaming_measure
from benchmarks.streaming import report as streaming
from benchmarks.tables import Table, limits
from benchmarks.throughput import figure as throughput_figure
from benchmarks.throughput import measure as throughput_measure
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
        needs: every section of its report.
        keys: what its report has besides ``_KEYS``.
    """

    title: str
    tables: Callable[[Report], Mapping[str, Sequence[Table]]] | None
    text: Callable[[Report], str]
    draw: Callable[[Report, Path], None] | None = None
    about: Callable[[Report], str] | None = None
    needs: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()


SECTIONS = {
    "features": Section(
        "Features",
        features.tables,
        features.report_text,
        features_figure.figure,
        needs=("pool", "roofline", *guards.SECTIONS),
    ),
    "latency": Section(
        "Latency",
        latency.tables,
        latency.report_text,
        latency_figure.figure,
        latency.about,
        needs=("latency",),
    ),
    "throughput": Section(
        "Throughput",
        throughput.tables,
        throughput.report_text,
        throughput_figure.figure,
        throughput.about,
        needs=tuple(throughput_measure.SECTIONS),
    ),
    "streaming": Section(
        "Streams",
        streaming.tables,
        streaming.report_text,
        streaming_figure.figure,
        streaming.about,
        needs=streaming_measure.SECTIONS,
    ),
    "deployment": Section(
        "Deployed: files in onnxruntime",
        deployment.tables,
        deployment.report_text,
        deployment_figure.figure,
        deployment.about,
        needs=deployment.SECTIONS,
    ),
    "onset": Section(
        "Alarms: hops, filters and rivals",
        onset.tables,
        onset.report_text,
        onset_figure.figure,
        onset.about,
        needs=onset.SECTIONS,
    ),
    "formats": Section(
        "Files",
        formats.tables,
        formats.report_text,
        formats_figure.figure,
        formats.about,
        needs=("formats",),
    ),
    "abstaining": Section(
        "Answers that may be unsure",
        abstaining.tables,
        abstaining.report_text,
        abstaining_figure.figure,
        abstaining.about,
        needs=abstaining.SECTIONS,
    ),
    "dead_sensors": Section(
        "Dead sensors",
        dead_sensors.tables,
        dead_sensors.report_text,
        dead_sensors_figure.figure,
        dead_sensors.about,
        needs=dead_sensors.SECTIONS,
    ),
    "adapting": Section(
        "A new material from a few recordings",
        adapting.tables,
        adapting.report_text,
        adapting_figure.figure,
        adapting.about,
        needs=adapting.SECTIONS,
    ),
    "tuning": Section(
        "Tuned by gradient",
        tuning.tables,
        tuning.report_text,
        tuning.figure,
        tuning.about,
        needs=tuning.SECTIONS,
    ),
    "train": Section("Training", None, train.report_text, keys=("experiment", "stages", "wholes")),
    "model": Section(
        "Kernel machine at any size", None, model.report_text, needs=tuple(model_measure.SECTIONS)
    ),
    "gradients": Section(
        "Gradients through the fit",
        gradients.tables,
        gradients.report_text,
        gradients_figure.figure,
        gradients.about,
        needs=("gradients",),
    ),
    "precision": Section(
        "Precision", None, precision.report_text, keys=("variants", "solves", "ratios")
    ),
    "simulation": Section(
        "The simulated hand",
        simulation.tables,
        simulation.report_text,
        simulation_figure.figure,
        simulation.about,
        needs=simulation.SECTIONS,
    ),
    "sensors": Section(
        "Which sensors matter",
        sensors.tables,
        sensors.report_text,
        sensors.figure,
        sensors.about,
        needs=sensors.SECTIONS,
    ),
}
"""By the name of the benchmark and of its file."""
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
