"""What follows from the measurements of ``benchmarks.adapting``: limits and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchmarks.adapting.measure import AUTO, CEILING, ONE, SHIFT, SLIP_FREE
from benchmarks.outcome import heading
from benchmarks.rates import information
from benchmarks.tables import Table, limits, limits_last

SECTIONS = ("adapted", "weights", "step")
LEAST_SHARE = 0.5
MOST_LOSS = 0.005
SHOWN = {
    AUTO: "added, weight chosen",
    ONE: "added, weight 1 (fitted on everything)",
    SHIFT: "threshold moved alone",
    SLIP_FREE: "added, non-slip bins alone",
    CEILING: "ceiling: trained on it",
}
Rows = Sequence[Mapping[str, Any]]


def limit_rows(
    adapted: Mapping[str, Any], step: Mapping[str, Any], judged: int
) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold.

    Args:
        adapted: section.
        step: section.
        judged: recordings added.
    """
    rows = []
    rest = f"{judged} recordings added"
    for material in new_materials(adapted):
        before, most = adapted["before"]["new"][material], ceiling(adapted, material)["new"]
        found = median(scores(adapted, material, AUTO, judged, "new"))
        least = before + LEAST_SHARE * (most - before)
        rows.append(
            {
                "what": f"{material}: balanced accuracy %, {rest}",
                "measured": f"{_percent(found)}, from {_percent(before)}",
                "limit": f">= {_percent(least)}, halfway to {_percent(most)}",
                "ok": found >= least,
            }
        )
    for material in new_materials(adapted):
        falls = [
            adapted["before"]["old"] - value
            for value in scores(adapted, material, AUTO, judged, "old")
        ]
        rows.append(
            {
                "what": f"{material}: points that old materials lose on test, {rest}, worst draw",
                "measured": f"{100 * max(falls):.2f}",
                "limit": f"< {100 * MOST_LOSS:g}",
                "ok": max(falls) < MOST_LOSS,
            }
        )
    rows.append(
        {
            "what": "undo: detector and statistics bit for bit",
            "measured": "the same" if step["restores"] else "others",
            "limit": "the same",
            "ok": bool(step["restores"]),
        }
    )
    seconds = step["seconds"]
    what = f"seconds to add {step['recordings']} recordings, {step['features']} features"
    rows.append(information(what, f"{seconds['add']:.1f}"))
    rows.append(information("seconds to read them, without cache", f"{seconds['read']:.1f}"))
    rows.append(information("seconds to undo", f"{seconds['undo']:.2f}"))
    return rows


def new_materials(adapted: Mapping[str, Any]) -> list[str]:
    """In the order of the report."""
    return list(adapted["before"]["new"])


def scores(
    adapted: Mapping[str, Any], material: str, way: str, count: int, what: str
) -> list[float]:
    """Balanced accuracy of every draw, ``what`` being ``new`` or ``old``."""
    wanted = (material, way, count)
    return [
        row[what]
        for row in adapted["rows"]
        if (row["material"], row["way"], row["count"]) == wanted
    ]


def counts(adapted: Mapping[str, Any], way: str) -> list[int]:
    """That a way was tried with, ascending."""
    return sorted({row["count"] for row in adapted["rows"] if row["way"] == way})


def ceiling(adapted: Mapping[str, Any], material: str) -> Mapping[str, Any]:
    """What training on the material reaches."""
    return next(
        row for row in adapted["rows"] if (row["material"], row["way"]) == (material, CEILING)
    )


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    found = report["sections"]
    return {
        "Limits": [limits(report["limits"])],
        "New material, balanced accuracy %: median of draws (lowest to highest)": [
            _table(found["adapted"], "new")
        ],
        "Old materials' test recordings meanwhile": [_table(found["adapted"], "old")],
        "How the weight was chosen": [_weights(found["weights"]["rows"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report), titled=True))


def about(report: Mapping[str, Any]) -> str:
    """A line on what was measured."""
    settings = report["settings"]
    return (
        f"a few recordings of a new material added in closed form, {settings['draws']} draws from "
        f"{100 * settings['train_share']:g} % of its recordings, judged on the others; no choice "
        "is made on new materials or test recordings"
    )


def _table(adapted: Mapping[str, Any], what: str) -> Table:
    columns = sorted({row["count"] for row in adapted["rows"] if row["way"] != CEILING})
    rows = []
    for material in new_materials(adapted):
        before = adapted["before"]
        start = before["new"][material] if what == "new" else before["old"]
        for way in (AUTO, ONE, SHIFT, SLIP_FREE):
            cells = [_spread(scores(adapted, material, way, n, what)) for n in columns]
            end = _percent(ceiling(adapted, material)[what])
            rows.append([f"{material}, {SHOWN[way]}", _percent(start), *cells, end])
    header = ["material, way", "0", *map(str, columns), "ceiling"]
    return Table(header, rows)


def _weights(rows: Rows) -> Table:
    """Each training material new in turn, by weight."""
    factors = sorted({row["factor"] for row in rows})
    cells = []
    for material in dict.fromkeys(row["material"] for row in rows):
        own = {row["factor"]: row for row in rows if row["material"] == material}
        pairs = [f"{_percent(own[f]['new'])} / {_percent(own[f]['old'])}" for f in factors]
        cells.append([material, *pairs])
    note = (
        "balanced accuracy % of the left-out training material / of the other training materials, "
        "held out in closed form; weights in parts of an average old material"
    )
    return Table(["left out", *(f"{factor:g}" for factor in factors)], cells, note)


def _spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    if len(values) == 1:
        return _percent(values[0])
    return f"{_percent(median(values))} ({_percent(min(values))} to {_percent(max(values))})"


def _percent(value: float) -> str:
    return f"{100 * value:.2f}"
