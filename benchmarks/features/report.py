"""What ``benchmarks.features`` prints: heading, tables of all sections, limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.features.guards import report as guards
from benchmarks.features.guards.measure import SECTIONS as GUARDED
from benchmarks.features.pool_report import fractions, limit_rows, pool_tables, roofline_tables
from benchmarks.outcome import heading
from benchmarks.tables import Table, limits, limits_last

ABOUT = "features and scores"


def following(sections: Mapping[str, Any]) -> dict[str, Any]:
    """What follows from the sections that were measured: ratios, fractions, limits."""
    guarded = {name: of for name, of in sections.items() if name in GUARDED}
    found: dict[str, Any] = {"ratios": guards.ratios(guarded)}
    if "roofline" in sections:
        found["fractions"] = fractions(sections["roofline"], sections.get("pool"))
    pool = limit_rows(sections["pool"]) if "pool" in sections else []
    return found | {"limits": pool + guards.limit_rows(guarded)}


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    sections = report["sections"]
    guarded = {name: of for name, of in sections.items() if name in GUARDED}
    found = {"Limits": [limits(report["limits"], "median, quartiles")]}
    if "pool" in sections:
        found["The whole pool"] = pool_tables(sections["pool"])
    if "roofline" in sections:
        found["Roofline"] = roofline_tables(sections["roofline"], report["fractions"])
    if guarded:
        found["What guards cost"] = guards.tables(guarded, report["ratios"])
    return found


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    replaced = "guards off replaces " + ", ".join(report["replaced"])
    return heading(report, ABOUT, [*limits_last(tables(report)), replaced])
