"""What follows from the measurements of ``benchmarks.abstaining``: limits and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from benchmarks.abstaining.splits import ROLES
from benchmarks.abstaining.ways import WAYS
from benchmarks.outcome import heading
from benchmarks.tables import Table, limits, limits_last
from tactslip_torch.report.metrics import CLASSES

SECTIONS = ("answers",)
OURS = next(iter(WAYS))
WORDS = {"slip": "slip", "non_slip": "non-slip"}

Rows = Sequence[Mapping[str, Any]]


def mean_of(rows: Rows, way: str, asked: float, role: str) -> dict[str, float] | None:
    """Means over splits; None where nothing was measured.

    Returns ``unsure``, ``wrong`` (of the sure answers; 0 where there are none), and for each class
    ``coverage`` and ``reached`` of recordings, and the ``worst`` coverage of a split.
    """
    own = [r for r in rows if (r["way"], r["asked"], r["role"]) == (way, asked, role)]
    if not own:
        return None
    found = {
        "unsure": fmean(row["unsure"] for row in own),
        "wrong": fmean(_wrong(row) for row in own),
    }
    for name in CLASSES:
        found[f"{name}_coverage"] = fmean(row[name]["coverage"] for row in own)
        found[f"{name}_reached"] = fmean(row[name]["reached"] for row in own)
        found[f"{name}_worst"] = min(row[name]["coverage"] for row in own)
    return found


def limit_rows(rows: Rows) -> list[dict[str, Any]]:
    """What was promised of ours, on the recordings it was promised of."""
    found = []
    for asked in sorted({row["asked"] for row in rows}):
        means = mean_of(rows, OURS, asked, "test")
        if means is None:
            continue
        for name in CLASSES[::-1]:
            covered = means[f"{name}_coverage"]
            found.append(
                {
                    "what": f"{WORDS[name]} covered on test where {100 * asked:g} % are asked, "
                    "mean over recordings and splits, %",
                    "measured": f"{100 * covered:.2f}",
                    "limit": f">= {100 * asked:g}",
                    "ok": covered >= asked,
                }
            )
    return found


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    rows = report["sections"]["answers"]
    return {"Limits": [limits(report["limits"])]} | {
        f"{role}: {what}": [_table(rows, role)] for role, what in ROLES.items()
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report), titled=True))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    settings = report["settings"]
    splits = {tuple(row["unseen"]) for row in report["sections"]["answers"]}
    return (
        f"answers of slip, non-slip or unsure: {len(splits)} choices of {settings['num_unseen']} "
        f"unseen materials of the simulated hand, machines of {settings['num_features']} features "
        f"fitted and calibrated on {settings['train_bins']} bins of each seen material and class"
    )


def _table(rows: Rows, role: str) -> Table:
    header = ["asked, %", "way", "unsure, %", "wrong of the sure, %"]
    for name in CLASSES[::-1]:
        header += [f"{WORDS[name]} covered, %", "worst split", "recordings that reach it, %"]
    cells = []
    for asked in sorted({row["asked"] for row in rows}):
        for way in WAYS:
            means = mean_of(rows, way, asked, role)
            if means is None:
                continue
            shares = [means["unsure"], means["wrong"]]
            for name in CLASSES[::-1]:
                shares += [means[f"{name}_{part}"] for part in ("coverage", "worst", "reached")]
            cells.append([f"{100 * asked:g}", way, *(f"{100 * share:.2f}" for share in shares)])
    note = (
        "Means over splits of means over recordings: a bin is covered unless it is answered with "
        "the other class. Promised is the mean alone, by recordings as units, on test."
    )
    if role == "unseen":
        note = "Nothing is promised of materials never met, by any of the ways."
    return Table(header, cells, note)


def _wrong(row: Mapping[str, Any]) -> float:
    return 0.0 if row["sure_accuracy"] is None else 1 - row["sure_accuracy"]
