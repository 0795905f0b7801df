"""What follows from the measurements of ``benchmarks.dead_sensors``: limits and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from benchmarks.dead_sensors.measure import MEAN, OURS, REFIT, VOLTS, ZERO
from benchmarks.dead_sensors.subject import ROLES
from benchmarks.outcome import heading
from benchmarks.tables import Table, limits, limits_last

SECTIONS = ("losses",)
WAYS = (OURS, MEAN, ZERO, VOLTS, REFIT)
GROUPS = {"channel": "one channel", "finger": "one finger", "half": "a random half"}
MOST_ECE = 0.05

Rows = Sequence[Mapping[str, Any]]


def rows_of(rows: Rows, role: str, group: str, way: str) -> list[Mapping[str, Any]]:
    """Those of a role, a kind of loss and a way, in order."""
    return [r for r in rows if (r["role"], r["group"], r["way"]) == (role, group, way)]


def limit_rows(rows: Rows) -> list[dict[str, Any]]:
    """What is asked with any one finger dead; calibration where the whole hand is calibrated."""
    found = []
    for role in ROLES:
        ours, means = (rows_of(rows, role, "finger", way) for way in (OURS, MEAN))
        if not ours:
            continue
        gaps = [
            one["balanced_accuracy"] - other["balanced_accuracy"]
            for one, other in zip(ours, means, strict=True)
        ]
        errors = [row["ours_gap_se"] for row in means]
        gain, worst = fmean(gaps), min(g + e for g, e in zip(gaps, errors, strict=True))
        what = f"{role}, a finger dead: {OURS} less {MEAN}, balanced accuracy, points"
        found += [
            _limit(f"{what}, mean of fingers", 100 * gain, "> 0", gain > 0),
            _limit(
                f"{what}, worst finger plus its standard error", 100 * worst, ">= 0", worst >= 0
            ),
        ]
    if ours := rows_of(rows, "test", "finger", OURS):
        ece = max(row["ece"] for row in ours)
        what = f"test, a finger dead: calibration error of the {OURS}, worst finger, %"
        found.append(_limit(what, 100 * ece, f"< {100 * MOST_ECE:g}", ece < MOST_ECE))
    return found


def _limit(what: str, measured: float, limit: str, ok: bool) -> dict[str, Any]:
    return {"what": what, "measured": f"{measured:.2f}", "limit": limit, "ok": ok}


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    rows = report["sections"]["losses"]
    found = {"Limits": [limits(report["limits"])]}
    for role, words in ROLES.items():
        if any(row["role"] == role for row in rows):
            found[f"{role}: {words}"] = [_table(rows, role)]
    return found


def _table(rows: Rows, role: str) -> Table:
    cells = []
    for group, words in GROUPS.items():
        own = rows_of(rows, role, group, OURS)
        names = [row["dead"] for row in own] if group == "finger" else []
        for name in [*names, None]:
            cells.append([words if name is None else name, *_cells(rows, role, group, name)])
    header = ["dead"] + [f"{way}, {part}" for way in WAYS for part in ("balanced %", "ECE %")]
    note = (
        "Means over losses that take a feature in use and leave one. The refit is what training "
        "again for each loss would give."
    )
    return Table(header, cells, note)


def _cells(rows: Rows, role: str, group: str, name: str | None) -> list[str]:
    cells = []
    for way in WAYS:
        own = [r for r in rows_of(rows, role, group, way) if name in (None, r["dead"])]
        for part in ("balanced_accuracy", "ece"):
            cells.append(f"{100 * fmean(row[part] for row in own):.2f}" if own else "")
    return cells


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in words."""
    return (
        f"the simulated hand as `train +exp=unseen4` fits it, {report['num_features']} features; "
        f"{report['settings']['halves']} random halves"
    )


def report_text(report: Mapping[str, Any]) -> str:
    """All of it, the limits last."""
    return heading(report, about(report), limits_last(tables(report), titled=True))
