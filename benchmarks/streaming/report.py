"""What follows from the measurements of ``benchmarks.streaming``: factors, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.clocks import paired_ratio
from benchmarks.outcome import heading
from benchmarks.rates import at_least, information, not_measured
from benchmarks.selection import source_text
from benchmarks.streaming.measure import NAIVE, STREAM
from benchmarks.streaming.sizes import CHUNK, HOP
from benchmarks.streaming.ways import RATE_HZ
from benchmarks.tables import Spread, Table, limits, limits_last, number

TIMES_REAL_TIME = 50.0
GROWTH_MIB = 1.0  # of resident memory from the settled stream to the end of the hour
_MIB = 2**20
Rows = Sequence[Mapping[str, Any]]


def row_of(rows: Rows, kind: str, engine: str, hop: int, chunk: int) -> Mapping[str, Any] | None:
    """The row of a way, if there is one."""
    wanted = (kind, engine, hop, chunk)
    return next((r for r in rows if (r["kind"], r["engine"], r["hop"], r["chunk"]) == wanted), None)


def real_time_factor(row: Mapping[str, Any], by: str = "seconds") -> Spread:
    """Seconds of stream in a second of computing, of the rounds; ``"core_s"``: of a processor."""
    pairs = zip(row["stream_s"], row[by], strict=True)
    return Spread.of([stream_s / taken for stream_s, taken in pairs])


def over_naive(rows: Rows, row: Mapping[str, Any]) -> Spread | None:
    """How many times as long the naive stream takes for the same stretch, same engine and hop."""
    naive = row_of(rows, NAIVE, row["engine"], row["hop"], row["hop"])
    if naive is None:
        return None
    a_second = [
        [taken / stream_s for taken, stream_s in zip(r["seconds"], r["stream_s"], strict=True)]
        for r in (naive, row)
    ]
    return Spread(*paired_ratio(*a_second))


def growth(section: Mapping[str, Any]) -> dict[str, float] | None:
    """How memory grew once the stream was settled; ``None`` where it was not looked at.

    Returns:
        ``mib``, the most above the first look by then; ``mib_an_hour``, by a line of least squares.
    """
    at_s, resident = np.asarray(section["at_s"]), np.asarray(section["resident_bytes"]) / _MIB
    is_settled = at_s >= section["settled_s"]
    if is_settled.sum() < 2:
        return None
    slope = float(np.polyfit(at_s[is_settled] / 3600, resident[is_settled], 1)[0])
    kept = resident[is_settled]
    return {"mib": float(kept.max() - kept[0]), "mib_an_hour": slope}


def limit_rows(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold."""
    rows = sections["speed"]["rows"]
    what = f"real-time factor, eager, hop {_ms(HOP)} ms, pushes of {_ms(CHUNK)} ms, 1 thread"
    row = row_of(rows, STREAM, "eager", HOP, CHUNK)
    found = [at_least(what, None if row is None else real_time_factor(row), TIMES_REAL_TIME)]
    if row is not None:
        busy = real_time_factor(row, "core_s").text()
        found.append(information("the same, in processor time", busy))
    section = sections["memory"]
    hours = section["at_s"][-1] / 3600 if section["at_s"] else 0.0
    what = f"resident memory, growth over {number(hours)} h of stream, MiB"
    grown, limit = growth(section), f"<= {GROWTH_MIB:g}"
    if grown is None:
        return [*found, not_measured(what, limit)]
    ok = grown["mib"] <= GROWTH_MIB
    found.append({"what": what, "measured": number(grown["mib"]), "limit": limit, "ok": ok})
    slope = f"{grown['mib_an_hour']:+.3f} MiB an hour"
    return [*found, information("the same, by a line of least squares", slope)]


def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    rows = report["sections"]["speed"]["rows"]
    by_chunk = [row for row in rows if row["kind"] == STREAM and row["hop"] == HOP]
    by_hop = [row for row in rows if row["kind"] == STREAM and row["chunk"] == CHUNK]
    naive = [row for row in rows if row["kind"] == NAIVE]
    return {
        "Limits": [limits(report["limits"], "median, quartiles")],
        f"By the size of a push, hop {_ms(HOP)} ms": [_speeds(rows, by_chunk)],
        f"By hop, pushes of {_ms(CHUNK)} ms": [_speeds(rows, by_hop)],
        "A bin with its context for every decision": [_speeds(rows, naive)],
        "Memory": [_memory(report["sections"]["memory"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report), titled=True))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    return (
        "a stream of 24 channels at 2 kHz on 1 thread, from samples to alarms; "
        f"{source_text(report['selection'])}"
    )


def _speeds(rows: Rows, shown: Rows) -> Table:
    header = ["engine", "hop, ms", "push, samples", "real-time factor", "p50 of a push, us"]
    header += ["p99, us", "pushes", "naive / this"]
    cells = []
    for row in sorted(shown, key=lambda row: (row["engine"], row["hop"], row["chunk"])):
        ratio = over_naive(rows, row)
        cells.append(
            [
                row["engine"],
                _ms(row["hop"]),
                str(row["chunk"]),
                real_time_factor(row).text(),
                number(1e6 * row["p50_s"]),
                number(1e6 * row["p99_s"]),
                str(row["pushes"]),
                "-" if ratio is None else ratio.text(),
            ]
        )
    note = "Real-time factor: seconds of stream watched in a second; a decision every hop."
    return Table(header, cells, note)


def _memory(section: Mapping[str, Any]) -> Table:
    header = ["a fresh process", "at the start, MiB", "settled, MiB", "at the end, MiB"]
    header += ["most that a stream holds, KiB", "decisions"]
    looks = dict(zip(section["at_s"], section["resident_bytes"], strict=True))
    settled = [held for at_s, held in looks.items() if at_s >= section["settled_s"]]
    kept = [*list(looks.values())[:1], *settled[:1], *settled[-1:]]
    cells = [number(held / _MIB, 4) for held in kept] if len(kept) == 3 else ["-"] * 3
    row = [f"stream, {section['engine']}", *cells, number(section["state_bytes"] / 1024)]
    return Table(header, [[*row, f"{section['decisions']:,}"]])


def _ms(num_samples: int) -> str:
    return f"{1000 * num_samples / RATE_HZ:g}"
