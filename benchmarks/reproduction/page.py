"""REPRODUCTION.md and the short table of README.md, from stored results."""

from __future__ import annotations

import re
import shlex
from collections.abc import Collection, Mapping
from typing import Any

from benchmarks.reproduction.beside import (
    CALIBRATED,
    NOT_COMPARABLE,
    PREDICTED,
    beside,
    is_calibrated,
    signals_table,
)
from benchmarks.reproduction.beyond import (
    ablations_table,
    baselines_table,
    leak_table,
    places_table,
    strokes_table,
    validation_table,
)
from benchmarks.reproduction.confound import conclusion, confound_tables
from benchmarks.reproduction.experiments import EXPERIMENTS, SEEDS
from benchmarks.reproduction.reasons import reasons
from benchmarks.reproduction.results import (
    Report,
    baseline_percent,
    percent,
    runs_of,
    seeds_text,
    text,
)
from benchmarks.reproduction.selected import selected_table
from benchmarks.tables import Table
from tactslip_torch.report import published

COMMAND = "python -m benchmarks.reproduction"
KEPT_NAME = "reproduction.json"
FIGURES = {
    "seeds": "reproduction.png",
    "places": "reproduction_places.png",
    "confound": "reproduction_confound.png",
}
"""Files of the figures, beside the results."""

QUICK_LINE = "**QUICK: a few recordings, to see that it runs. The numbers mean nothing.**"


def page(report: Report, images: str) -> str:
    """The content of REPRODUCTION.md.

    Args:
        report: as it is stored.
        images: folder of the figures and of the JSON, as the file refers to it.
    """
    parts = [_introduction(report, images), *_first(report), *_second(report, images)]
    parts += _third(report, images)
    found = reasons(report)
    if found:
        parts += ["## Where ours differs, and why we think so", *found]
    return "\n\n".join([*parts, _knobs(report), _runs(report)]) + "\n"


def is_part(names: Collection[str]) -> bool:
    """Whether experiments are missing among these."""
    return not set(EXPERIMENTS) <= set(names)


def few_seeds(report: Report) -> list[str]:
    """A line that names experiments of fewer seeds than is the rule; none where there are none."""
    by_num: dict[int, list[str]] = {}
    for name, runs in report["runs"].items():
        if len(runs) < EXPERIMENTS[name].num_seeds(SEEDS):
            by_num.setdefault(len(runs), []).append(name)
    parts = [f"{seeds_text(num)} of {', '.join(names)}" for num, names in by_num.items()]
    if not parts:
        return []
    return [f"**Fewer seeds than is the rule ({SEEDS}):** {'; '.join(parts)}."]


def _introduction(report: Report, images: str) -> str:
    settings = f" --seeds {report['seeds']}" + (" --quick" if report["quick"] else "")
    if is_part(report["runs"]):
        settings += f" --experiments {shlex.join(report['runs'])}"
    quick = f"\n\n{QUICK_LINE}" if report["quick"] else ""
    parts = [
        "# Reproduction, on a SIMULATED hand",
        "**Every number of ours below is SIMULATED; the paper's are of a real hand, whose "
        f"recordings are private.** Written by `{COMMAND}{settings}`, which trains the experiments "
        f"listed at the end and keeps what they count in `{images}/{KEPT_NAME}`; no "
        "result is typed by hand. A seed is another simulated set and another split; numbers are "
        f"mean ± standard deviation over seeds.{quick}",
        *few_seeds(report),
        f"The paper is {published.PAPER}. Every row that stands beside it is marked: {CALIBRATED}, "
        f"the simulation was set by it; {PREDICTED}, it was not, and whatever came out is shown; "
        f"{NOT_COMPARABLE}, something else was measured. Of unseen materials calibration looked at "
        "none; the starting values of all other knobs come from an exploration that did.",
    ]
    return "\n\n".join(parts)


def shown(table: Table) -> str:
    """A table of Markdown with columns of numbers to the right and words to the left."""
    columns = list(zip(*table.rows, strict=True))
    is_number = [
        place > 0 and all(re.match(r"[+-]?\d|-?$", cell) for cell in column)
        for place, column in enumerate(columns)
    ]
    lines = table.markdown().split("\n")
    lines[1] = f"| {' | '.join('---:' if of else '---' for of in is_number)} |"
    return "\n".join(lines)


def _first(report: Report) -> list[str]:
    parts = ["## 1. What was published, and ours beside", "### Scores"]
    for title, table in beside(report).items():
        parts += [f"**{title}.**", shown(table)]
    if runs_of(report, "random_bins"):
        parts += ["### Selected features", shown(selected_table(report))]
    onset = (
        f"Of the onset the paper shows one figure and states no metric: {NOT_COMPARABLE}; recall "
        "beside the onset is in part 2."
    )
    return [*parts, "### Onset", onset, "### Signals", shown(signals_table(report))]


def _second(report: Report, images: str) -> list[str]:
    if not runs_of(report, "unseen4"):
        return []
    baselines = baselines_table(report)
    return [
        "## 2. What the paper's data could not show",
        "### Beside the onset",
        f"![Recall beside the onset]({images}/{FIGURES['places']})",
        shown(places_table(report)),
        "### By stroke",
        shown(strokes_table(report)),
        "### With less",
        shown(ablations_table(report)),
        *([] if baselines is None else ["### Baselines", shown(baselines)]),
        "### Recipes",
        shown(validation_table(report)),
        "### Leakage",
        shown(leak_table(report)),
        f"![Every seed]({images}/{FIGURES['seeds']})",
    ]


def _third(report: Report, images: str) -> list[str]:
    if not runs_of(report, "confound"):
        return []
    parts = [
        "## 3. Does it feel slip, or hear the arm?",
        "In the paper's protocol slip and arm motion are the same thing. Here a detector of the "
        "protocol, and one that was trained on scenes which part the two as well, are judged on "
        "such scenes (`+exp=confound`, default recipe; scenes that no table marks were trained on "
        "by neither).",
    ]
    for title, table in confound_tables(report).items():
        parts += [f"**{title}.**", shown(table)]
    parts.append(f"![Both detectors, scene by scene]({images}/{FIGURES['confound']})")
    return [*parts, *conclusion(report)]


def _knobs(report: Report) -> str:
    known = report["calibrated"]
    values = {name: _value(value) for name, value in known["values"].items()}
    how = known["provenance"].rstrip(".")
    lines = ["## What was calibrated, and how", f"Provenance: {how}."]
    if is_calibrated(report):
        target = known["target"]
        lines.append(
            f"Aim: {100 * target['accuracy']:.2f} % ({target['row']}). Reached: "
            f"{100 * known['accuracy']:.2f} %, mean over seeds "
            f"{', '.join(map(str, known['seeds']))}, none of which is in a table above: "
            f"{known['verdict']}."
        )
    table = Table(["knob", "frozen value"], [list(row) for row in values.items()])
    return "\n\n".join([*lines, shown(table)])


def _value(value: Any) -> str:
    return " to ".join(f"{of:g}" for of in value) if isinstance(value, list) else f"{value:g}"


def _runs(report: Report) -> str:
    rows = []
    for name, runs in report["runs"].items():
        minutes = sum(run["seconds"] for run in runs) / 60
        command = f"`train {' '.join(report['commands'][name])}`"
        rows.append([name, EXPERIMENTS[name].about, command, str(len(runs)), f"{minutes:.1f}"])
    facts = ", ".join([*report["machine"].values()])
    versions = ", ".join(f"{name} {of}" for name, of in report["versions"].items())
    total = sum(float(row[-1]) for row in rows)
    note = f"{total:.0f} minutes in all, on {facts}; {versions}."
    header = ["experiment", "", "command", "seeds", "minutes"]
    return "## What was run\n\n" + shown(Table(header, rows, note))


# ---------------------------------------------------------------------------------- for README.md
SHORT = {
    "random_bins": ("test",),
    "unseen4": ("train", "test", "unseen"),
    "unseen4 robust": ("test", "unseen"),
    "half_second": ("test", "unseen"),
    "shuffled": ("test",),
}
"""Experiments and roles of the short table."""

BELOW: Mapping[tuple[str, str], str] = {
    ("random_bins", "test"): "test",
    ("unseen4", "unseen"): "unseen",
}
"""Rows below which the paper's stands."""

_COLUMNS = {
    "accuracy": "accuracy %",
    "balanced_accuracy": "balanced accuracy %",
    "non_slip_recall": "non-slip recall %",
    "slip_recall": "slip recall %",
}


def short_table(report: Report) -> str:
    """The block between the markers in README.md."""
    rows = []
    for name, roles in SHORT.items():
        for role in roles:
            cells = [text(percent(report, name, role, score)) for score in _COLUMNS]
            pooled = text(baseline_percent(report, name, role, "balanced_accuracy"))
            if runs_of(report, name):
                num = seeds_text(len(runs_of(report, name)))
                rows.append([f"`{name}` {role}, simulated, {num}", *cells, pooled])
                if (name, role) in BELOW:
                    paper = published.SPLITS[BELOW[name, role]]
                    values = [getattr(paper, score) for score in _COLUMNS]
                    of_paper = ["" if value is None else f"{100 * value:.2f}" for value in values]
                    rows.append([f"paper, real hand, {BELOW[name, role]}", *of_paper, ""])
    header = ["experiment", *_COLUMNS.values(), "best pooled number, balanced %"]
    table = shown(Table(header, rows))
    return f"{QUICK_LINE}\n\n{table}" if report["quick"] else table
