"""What follows from the measurements of ``benchmarks.deployment``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchmarks.clocks import paired_ratio
from benchmarks.deployment.files import BIN, EXPORTS, NAIVE, STREAM, exported, of_way
from benchmarks.deployment.sizes import PUSHES
from benchmarks.deployment.start import PARTS
from benchmarks.deployment.ways import LOOP, PRUNED_LOOP, at_once, engine_way
from benchmarks.engines import FLOAT32
from benchmarks.outcome import heading
from benchmarks.rates import NOT_MEASURED, at_least, information, not_measured, rate
from benchmarks.selection import source_text
from benchmarks.tables import Spread, Table, limits, limits_last, number

SECTIONS = ("single", "bulk", "errors", "stream", "files", "starts")
TIMES_NAIVE, TIMES_LOOP = 4.0, 300.0  # p50 of one bin on one thread
LEAST_RATE, RATE_THREADS = 80_000.0, 2  # bins a second
MOST_BYTES = 700_000
MOST_ERROR = {"float32": 1e-3, "float64": 1e-9}  # standard deviations of the score
DEPLOYED = exported("float32")
Rows = Sequence[Mapping[str, Any]]


# -------------------------------------------------------------------------------------- finding
def row_of(rows: Rows, **wanted: Any) -> Mapping[str, Any] | None:
    """The first row with these values, if there is one."""
    return next((row for row in rows if all(row[k] == of for k, of in wanted.items())), None)


def times(rows: Rows, peer: str, way: str = DEPLOYED, threads: int = 1) -> Spread | None:
    """How many times as long as a way a peer takes for one bin, median of the rounds."""
    found = [row_of(rows, way=name, threads=threads) for name in (peer, way)]
    if None in found:
        return None
    return Spread(*paired_ratio(*(row["round_medians_s"] for row in found if row)))


def best_chunk(rows: Rows, way: str, threads: int) -> Mapping[str, Any] | None:
    """The row of the chunk with which a way is fastest."""
    own = [row for row in rows if (row["way"], row["threads"]) == (way, threads)]
    return max(own, key=lambda row: rate(row).median, default=None)


# --------------------------------------------------------------------------------------- limits
def limit_rows(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Limits beside what was measured, and whether they hold."""
    single = sections["single"]["rows"]
    found = []
    for peer, least in ((NAIVE[True], TIMES_NAIVE), (LOOP, TIMES_LOOP)):
        what = f"p50 of a bin, 1 thread, {peer} / {DEPLOYED}"
        found.append(at_least(what, times(single, peer), least))
    for peer in (NAIVE[False], PRUNED_LOOP, engine_way("compiled", FLOAT32)):
        ratio = times(single, peer)
        measured = NOT_MEASURED if ratio is None else ratio.text()
        found.append(information(f"the same, {peer} / {DEPLOYED}", measured))
    return found + _rate_limit(sections) + _file_limits(sections) + _error_limits(sections)


def _rate_limit(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    ways = [DEPLOYED, at_once(DEPLOYED)]
    rows = sections["bulk"]["rows"]
    each = [row for way in ways if (row := best_chunk(rows, way, RATE_THREADS)) is not None]
    best = max(each, key=lambda row: rate(row).median, default=None)
    what = f"bins/s on {RATE_THREADS} threads, the fastest way by float32"
    if best is None:
        return [at_least(what, None, LEAST_RATE)]
    more = f", {best['way']}, chunks of {best['chunk']}"
    return [at_least(what, rate(best), LEAST_RATE, more)]


def _file_limits(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    limit, rows = f"< {MOST_BYTES / 1000:g} kB", sections["files"]["rows"]
    found = []
    for graph in (BIN, STREAM):
        name = of_way(DEPLOYED, graph)
        row = row_of(rows, file=name)
        if row is None:
            found.append(not_measured(f"size, {name}", limit))
            continue
        is_met = row["bytes"] < MOST_BYTES
        measured = f"{row['bytes'] / 1000:.0f} kB"
        what = f"size, {name}"
        found.append({"what": what, "measured": measured, "limit": limit, "ok": is_met})
    return found


def _error_limits(sections: Mapping[str, Any]) -> list[dict[str, Any]]:
    found = []
    for way, precision in EXPORTS.items():
        most, row = MOST_ERROR[precision], row_of(sections["errors"]["rows"], way=way)
        what, limit = f"largest score error, {way}, sd", f"<= {most:g}, no flip"
        if row is None:
            found.append(not_measured(what, limit))
            continue
        measured = f"{number(row['worst'])} of {row['bins']:,} bins, {row['flips']} flips"
        is_met = row["worst"] <= most and row["flips"] == 0
        found.append({"what": what, "measured": measured, "limit": limit, "ok": is_met})
    return found


# --------------------------------------------------------------------------------------- tables
def tables(report: Mapping[str, Any]) -> dict[str, list[Table]]:
    """Tables by title, the limits first.

    Args:
        report: as ``--json`` keeps it.
    """
    sections = {name: of["rows"] for name, of in report["sections"].items()}
    return {
        "Limits": [limits(report["limits"], "median, quartiles")],
        "One bin, from samples to a score, and how right it is": [_single(sections)],
        "Many bins": [_bulk(sections["bulk"])],
        "A stream": [_stream(sections["stream"])],
        "Files": [_files(sections["files"])],
        "A first score in a fresh process": [_starts(sections["starts"])],
    }


def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    return heading(report, about(report), limits_last(tables(report), titled=True))


def about(report: Mapping[str, Any]) -> str:
    """What was measured, in a line."""
    digest = report["selection"]["trained"].get("sha256")
    of_file = f" (SHA-256 {digest[:12]})" if digest else ""
    return (
        f"a deployed detector with {source_text(report['selection'])}{of_file}, its machine fitted "
        f"again to {report['training_bins']:,} simulated bins, which the kernel sums keep"
    )


def _single(sections: Mapping[str, Rows]) -> Table:
    header = ["raw bin to score", "features", "p50, us, 1 thread", "quartiles", "p99, us"]
    header += ["p50, us, 2 threads", "p99, us", "this / export", "error, sd, largest", "p99"]
    header += ["flips", "of bins"]
    rows = [row for row in sections["single"] if row["threads"] == 1]
    cells = []
    for row in sorted(rows, key=lambda row: float(row["p50_s"])):
        way = row["way"]
        other = row_of(sections["single"], way=way, threads=2)
        ratio = times(sections["single"], way)
        error = row_of(sections["errors"], way=way)
        low, middle, high, late = (_us(row, at) for at in ("p25_s", "p50_s", "p75_s", "p99_s"))
        cells.append(
            [
                way,
                f"{row['features']:,}",
                middle,
                f"{low} to {high}",
                late,
                *(["-", "-"] if other is None else [_us(other, "p50_s"), _us(other, "p99_s")]),
                "-" if ratio is None else number(ratio.median),
                *_errors(error),
            ]
        )
    note = (
        "Errors of held-out simulated bins of unseen materials, against the float64 reference, in "
        "standard deviations of its scores; of as many as a way judges within its time. Engines "
        "take float32 samples: native float32 arithmetic, or float64. The naive export, in torch "
        "too, and the loop have the kernel sum; they give no validity. torch.compile: of one bin "
        "on one thread."
    )
    return Table(header, cells, note)


def _errors(row: Mapping[str, Any] | None) -> list[str]:
    if row is None:
        return ["-"] * 4
    return [number(row["worst"]), number(row["p99"]), str(row["flips"]), f"{row['bins']:,}"]


def _bulk(rows: Rows) -> Table:
    threads = sorted({row["threads"] for row in rows})
    header = ["bins/s with the best chunk"]
    for count in threads:
        header += [f"{count} thr.", "chunk"]
    cells = []
    for way in dict.fromkeys(row["way"] for row in rows):
        of_way: list[str] = []
        for count in threads:
            best = best_chunk(rows, way, count)
            of_way += ["-", "-"] if best is None else [rate(best).text(), f"{best['chunk']:,}"]
        cells.append([way, *of_way])
    note = (
        "Raw bins to scores; chunks that would take a way too long are left out. A chunk a thread: "
        "every thread runs the graph on chunks of its own, instead of all sharing its operators."
    )
    return Table(header, cells, note)


def _stream(rows: Rows) -> Table:
    header = ["push of a stream, 1 thread"]
    for push in PUSHES:
        count = next((row["decisions"] for row in rows if row["push"] == push), 0)
        header += [f"{push} samples, {count} decisions: p50, us", "p99, us"]
    header += ["error, sd, largest", "flips", "of decisions"]
    cells = []
    for way in dict.fromkeys(row["way"] for row in rows):
        each = [row_of(rows, way=way, push=push) for push in PUSHES]
        pairs = [[_us(row, "p50_s"), _us(row, "p99_s")] if row else ["-", "-"] for row in each]
        own = next(row for row in each if row)
        tail = [number(own["score_worst"]), str(own["score_flips"]), f"{own['score_bins']:,}"]
        cells.append([way, *(cell for pair in pairs for cell in pair), *tail])
    return Table(header, cells, "Engines by StreamingDetector; both sides make alarms and times.")


def _files(rows: Rows) -> Table:
    header = ["file", "kB", "s to make"]
    cells = [
        [
            row["file"],
            "-" if row["bytes"] is None else f"{row['bytes'] / 1000:,.0f}",
            "-" if row["seconds"] is None else number(row["seconds"]),
        ]
        for row in rows
    ]
    return Table(header, cells, "Ours: the seconds of both graphs with their self-checks.")


def _starts(rows: Rows) -> Table:
    header = ["from nothing to a score", "s (quartiles)", "import, s", "load, s", "score, s"]
    header += ["starts"]
    cells = [
        [
            row["way"],
            Spread.of(row["seconds"]).text(),
            *(number(median(row[part])) for part in PARTS),
            str(len(row["seconds"])),
        ]
        for row in rows
    ]
    return Table(header, cells, "A new Python process each, files and libraries in the page cache.")


def _us(row: Mapping[str, Any], name: str) -> str:
    return number(1e6 * row[name])
