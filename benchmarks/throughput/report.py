"""What follows from the measurements of ``benchmarks.throughput``: rates, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.engines import FLOAT32
from benchmarks.exported import ORT
from benchmarks.outcome import heading
from benchmarks.rates import at_least, not_measured, rate
from benchmarks.selection import source_text
from benchmarks.tables import Spread, Table, limits, limits_last, number
from benchmarks.throughput.measure import FILTERED, RAW, held_bytes
from benchmarks.throughput.worker import IN_ONE_PIECE

LEAST_EAGER, LEAST_COMPILED = 25_000.0, 60_000.0  # bins a second on two threads
LIMIT_THREADS = 2
MOST_STREAM_GB = 1.5
Rows = Sequence[Mapping[str, Any]]


# -------------------------------------------------------------------------------------- limits
def limit_rows(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold.

    Args:
        sections: name to numbers; any of ``SECTIONS``.
    """
    found = []
    rows = sections.get("bulk", {}).get("rows", ())
    rates = {
        (row["way"], row["stage"]): rate(row) for row in rows if row["threads"] == LIMIT_THREADS
    }
    eager, compiled = (f"{engine}, {FLOAT32}" for engine in ("eager", "compiled"))
    quick = {key: of for key, of in rates.items() if key in ((compiled, FILTERED), (ORT, RAW))}
    best = max(quick, key=lambda key: quick[key].median, default=(compiled, FILTERED))
    limits_of = {(eager, FILTERED): LEAST_EAGER, best: LEAST_COMPILED}
    for key, least in limits_of.items():
        what = f"bins/s on {LIMIT_THREADS} threads, {', '.join(key)}"
        found.append(at_least(what, rates.get(key), least))
    return found + _stream_limits(sections.get("stream", {}).get("rows", ()))


def _stream_limits(rows: Rows) -> list[dict[str, Any]]:
    memory = f"< {MOST_STREAM_GB:g} GB"
    if not rows:
        finite = not_measured("values streamed, every one finite", "yes")
        return [not_measured("peak memory, bins streamed", memory), finite]
    found = []
    for row in rows:
        about = f"{row['bins']:,} bins streamed, {_features(row)}"
        gigabytes, is_finite = row["peak_bytes"] / 1e9, row["is_finite"]
        found += [
            {
                "what": f"peak memory, {about}",
                "measured": f"{gigabytes:.2f} GB",
                "limit": memory,
                "ok": gigabytes < MOST_STREAM_GB,
            },
            {
                "what": f"every value finite, {about}",
                "measured": "yes" if is_finite else "no",
                "limit": "yes",
                "ok": is_finite,
            },
        ]
    return found


# -------------------------------------------------------------------------------------- tables
def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    sections = report["sections"]
    made = {name: [_TABLES[name](of["rows"])] for name, of in sections.items()}
    titles = {_TITLES[name]: of for name, of in made.items()}
    return {"Limits": [limits(report["limits"], "median, quartiles")], **titles}


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report)))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    return f"throughput; the planned detector has {source_text(report['selection'])}"


def _bulk(rows: Rows) -> Table:
    header = ["planned detector, in bulk", "stage", "threads", "bins at once", "bins/s"]
    header += ["us/bin (quartiles)", "core-us/bin"]
    cells = []
    for row in rows:
        per_bin = Spread.of(row["seconds"]).times(1e6 / row["bins"])
        core = Spread.of(row["core_s"]).times(1e6 / row["bins"])
        about = [row["way"], row["stage"], str(row["threads"]), f"{row['bins']:,}"]
        cells.append([*about, number(rate(row).median), per_bin.text(), number(core.median)])
    return Table(header, cells)


def _batch(rows: Rows) -> Table:
    ways = list(dict.fromkeys((row["way"], row["threads"]) for row in rows))
    found = {(row["bins"], row["way"], row["threads"]): rate(row).median for row in rows}
    header = ["bins at once: bins/s, filtered bin to score", *(f"{w}, {t} thr." for w, t in ways)]
    cells = [
        [f"{num:,}", *(number(found[num, *way]) for way in ways)]
        for num in dict.fromkeys(row["bins"] for row in rows)
    ]
    return Table(header, cells)


def _curve(rows: Rows, name: str, title: str) -> Table:
    ways = list(dict.fromkeys((row["way"], row["threads"]) for row in rows))
    found = {(row[name], row["way"], row["threads"]): row for row in rows}
    header = [f"{title}: us/bin", "features", *(f"{way}, {t} thr." for way, t in ways)]
    cells = []
    for value in dict.fromkeys(row[name] for row in rows):
        each = [found[value, *way] for way in ways]
        times = [Spread.of(row["seconds"]).times(1e6 / row["bins"]).text() for row in each]
        cells.append([f"{value:,}", f"{each[0]['features']:,}", *times])
    return Table(header, cells)


def _memory(rows: Rows) -> Table:
    header = ["memory of one batch, planned features", "bins", "process before, MB"]
    header += ["bins and features, MB", "peak, MB", "besides, MB"]
    cells = [
        [
            f"all 2582 by the reference {IN_ONE_PIECE}"
            if row["way"] == IN_ONE_PIECE
            else row["way"],
            f"{row['bins']:,}",
            *(f"{row[name] / 1e6:,.0f}" for name in ("before_bytes", "own_bytes", "peak_bytes")),
            f"{held_bytes(row) / 1e6:,.0f}",
        ]
        for row in rows
    ]
    return Table(
        header, cells, "resident set, each in a fresh process; besides: what the work took"
    )


def _stream(rows: Rows) -> Table:
    header = ["streamed to a consumer", "features", "bins", "chunk", "seconds", "bins/s"]
    header += ["process before, MB", "peak, MB"]
    cells = [
        [
            row["way"],
            _features(row),
            f"{row['bins']:,}",
            f"{row['chunk']:,}",
            f"{row['seconds']:.1f}",
            number(row["bins"] / row["seconds"]),
            f"{row['before_bytes'] / 1e6:,.0f}",
            f"{row['peak_bytes'] / 1e6:,.0f}",
        ]
        for row in rows
    ]
    return Table(header, cells, "seconds include making the chunks and summing what comes")


def _features(row: Mapping[str, Any]) -> str:
    return "whole pool" if row["is_pool"] else "planned"


_TABLES = {
    "bulk": _bulk,
    "batch": _batch,
    "length": lambda rows: _curve(rows, "bin_ms", "whole pool, bin of ms"),
    "channels": lambda rows: _curve(rows, "channels", "whole pool, channels"),
    "memory": _memory,
    "stream": _stream,
}
_TITLES = {
    "bulk": "Bulk",
    "batch": "Batches",
    "length": "Lengths of a bin",
    "channels": "Channels",
    "memory": "Memory",
    "stream": "Streaming",
}
