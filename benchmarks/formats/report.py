"""What follows from the measurements of ``benchmarks.formats``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.clocks import paired_ratio
from benchmarks.formats.measure import LOAD, PEER, SAVE, STREAM
from benchmarks.outcome import heading
from benchmarks.rates import not_measured
from benchmarks.tables import Spread, Table, limits, limits_last, number

MOST_S = 0.1
LIMITED = ("npz", "hdf5", "mcap")
BASE = "npz"
Rows = Sequence[Mapping[str, Any]]


def limit_rows(rows: Rows) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold."""
    return [_limit(rows, name, what) for name in LIMITED for what in (LOAD, STREAM)]


def _limit(rows: Rows, name: str, what: str) -> dict[str, Any]:
    words = {LOAD: "loaded whole", STREAM: "opened and read in pieces"}[what]
    said, limit = f"ms, .{name} {words}", f"<= {number(1e3 * MOST_S)}"
    row = next((row for row in rows if row["format"] == name), None)
    if row is None:
        return not_measured(said, limit)
    said = f"ms, .{row['ending']} {words}"
    spread = Spread.of(row["seconds"][what])
    is_met = spread.median <= MOST_S
    return {"what": said, "measured": spread.times(1e3).text(), "limit": limit, "ok": is_met}


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    section = report["sections"]["formats"]
    return {
        "Limits": [limits(report["limits"], "median, quartiles")],
        "Reading": [_reading(section["rows"], report["settings"])],
        "Writing": [_writing(section["rows"], section["sample_bytes"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report)))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    settings = report["settings"]
    return (
        f"a simulated recording of {settings['duration_s']:g} s, 24 channels at 2 kHz in float32, "
        "read and written in every format on 1 thread"
    )


def _reading(rows: Rows, settings: Mapping[str, Any]) -> Table:
    header = ["reading", "whole, ms", "/ npz", f"by {settings['piece_ms']:g} ms, ms", "/ npz"]
    header += ["another tool", "its ms", "it / whole"]
    base = next(row["seconds"] for row in rows if row["format"] == BASE)
    cells = [
        [
            f".{row['ending']}",
            _ms(row, LOAD),
            _ratio(row["seconds"][LOAD], base[LOAD]),
            _ms(row, STREAM),
            _ratio(row["seconds"][STREAM], base[STREAM]),
            row["peer"],
            _ms(row, PEER),
            _ratio(row["seconds"][PEER], row["seconds"][LOAD]),
        ]
        for row in rows
    ]
    note = (
        "Whole: samples, truth, hand and key, checked. By pieces: opened, then every sample once. "
        "Another tool: its samples alone, by the lines that anybody would write first. All were "
        "held against what was written, to the bit. Files are in the page cache, libraries loaded."
    )
    return Table(header, cells, note)


def _writing(rows: Rows, sample_bytes: int) -> Table:
    header = ["writing", "ms", "/ npz", "file, MB", "/ samples"]
    base = next(row["seconds"] for row in rows if row["format"] == BASE)
    cells = [
        [
            f".{row['ending']}",
            _ms(row, SAVE),
            _ratio(row["seconds"][SAVE], base[SAVE]),
            number(row["bytes"] / 1e6),
            number(row["bytes"] / sample_bytes),
        ]
        for row in rows
    ]
    return Table(header, cells, f"The samples are {number(sample_bytes / 1e6)} MB.")


def _ms(row: Mapping[str, Any], what: str) -> str:
    return Spread.of(row["seconds"][what]).times(1e3).text()


def _ratio(seconds: Sequence[float], others: Sequence[float]) -> str:
    return number(paired_ratio(seconds, others).median)
