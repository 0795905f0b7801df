"""What follows from the measurements of ``benchmarks.latency``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.clocks import Ratio, paired_ratio
from benchmarks.engines import FLOAT32
from benchmarks.latency.measure import row_of
from benchmarks.latency.ways import LOOP, PRUNED_LOOP
from benchmarks.outcome import heading
from benchmarks.rates import NOT_MEASURED, at_least, information
from benchmarks.selection import source_text
from benchmarks.tables import Spread, Table, limits, limits_last, number

TIMES_THE_LOOP = 200.0  # p50 of the eager engine and the quadratic head
Rows = Sequence[Mapping[str, Any]]


def loop_over(rows: Rows) -> dict[str, Ratio]:
    """How many times as long the loop takes as every other whole way, median of the rounds."""
    looped = row_of(rows, LOOP)
    if looped is None:
        return {}
    taken = looped["round_medians_s"]
    return {
        row["way"]: paired_ratio(taken, row["round_medians_s"]) for row in rows if row["is_whole"]
    }


def limit_rows(rows: Rows) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold."""
    way = f"eager, {FLOAT32}"
    found = {row["way"]: row for row in rows}
    features = [found[name]["features"] if name in found else "?" for name in (LOOP, way)]
    what = f"p50, {LOOP} (all {features[0]} features) / {way}, quadratic head (its {features[1]})"
    alike = f"p50, {PRUNED_LOOP} / {way} (information: like for like)"
    ratio = _over(rows, PRUNED_LOOP, way)
    return [
        at_least(what, _over(rows, LOOP, way), TIMES_THE_LOOP),
        information(alike, NOT_MEASURED if ratio is None else ratio.text()),
    ]


def _over(rows: Rows, peer: str, way: str) -> Spread | None:
    found = [row_of(rows, name) for name in (peer, way)]
    if None in found:
        return None
    return Spread(*paired_ratio(*(row["round_medians_s"] for row in found if row)))


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    rows = report["sections"]["latency"]["rows"]
    return {
        "Limits": [limits(report["limits"], "median, quartiles")],
        "One bin, from samples to a score": [_whole(rows, report)],
        "Parts": [_parts(rows)],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report)))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    return f"latency of one bin on 1 thread; {source_text(report['selection'])}"


def _whole(rows: Rows, report: Mapping[str, Any]) -> Table:
    over = loop_over(rows)
    header = ["raw bin to score, 1 thread", "features", "p50, us", "quartiles", "p99, us"]
    header += ["calls", "loop / this", "score error, sd"]
    cells = [
        [
            row["way"],
            str(row["features"]),
            *_times(row),
            number(over[row["way"]].median),
            "-" if row["error"] is None else number(row["error"]),
        ]
        for row in sorted(rows, key=lambda row: float(row["p50_s"]))
        if row["is_whole"]
    ]
    note = (
        f"Filter, features, scaling, head. Heads are fitted to {report['training_bins']} simulated "
        "bins; errors are against the float64 reference, - for another machine. Quadratic head "
        "unless another is named."
    )
    return Table(header, cells, note)


def _parts(rows: Rows) -> Table:
    header = ["part, 1 bin, 1 thread", "p50, us", "quartiles", "p99, us", "calls"]
    return Table(header, [[row["way"], *_times(row)] for row in rows if not row["is_whole"]])


def _times(row: Mapping[str, Any]) -> list[str]:
    p25, p50, p75, p99 = (number(1e6 * row[name]) for name in ("p25_s", "p50_s", "p75_s", "p99_s"))
    return [p50, f"{p25} to {p75}", p99, str(row["calls"])]
