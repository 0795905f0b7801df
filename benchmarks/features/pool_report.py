"""What follows from the whole pool's measurements: rates, ratios, limits, fractions, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.bins import KINDS
from benchmarks.clocks import Ratio, paired_ratio
from benchmarks.engines import FLOAT32, FLOAT64
from benchmarks.features.pool import MINI_ROCKET, ORACLE, REFERENCE
from benchmarks.features.roofline import GEMM, MEMORY, least_seconds
from benchmarks.rates import NOT_MEASURED, at_least, information, not_measured, rate
from benchmarks.tables import Spread, Table, number

LEAST_RATE = {"eager": 6_000.0, "compiled": 10_000.0}
AIM = 15_000.0  # of the compiled engine
LEAST_OVER_ORACLE = 60.0  # times as fast, each engine in float32
LEAST_OVER_ROCKET = 7.0  # the fastest engine
FASTEST = "compiled"
MOST_ERROR = {FLOAT32: 1e-4, FLOAT64: 1e-10}
MOST_ENTROPY_BITS = 0.1
MOST_MODES_ELSEWHERE = 0.03
Rows = Sequence[Mapping[str, Any]]


def times_as_fast(
    rows: Rows, kind: str, way: str, peer: str, clock: str = "seconds"
) -> Ratio | None:
    """How many times as many bins a second, of the same rounds; ``None`` if one is missing.

    Args:
        rows: of ``full_pool``.
        kind: of bins.
        way: whose rate is taken.
        peer: over whose.
        clock: ``"seconds"``, or ``"core_s"`` of all threads together.
    """
    found = {row["way"]: row for row in rows if row["kind"] == kind}
    if way not in found or peer not in found:
        return None
    per_bin = {
        name: [seconds / found[name]["bins"] for seconds in found[name][clock]]
        for name in (way, peer)
    }
    return paired_ratio(per_bin[peer], per_bin[way])


# -------------------------------------------------------------------------------------- limits
def limit_rows(numbers: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Limits on the whole pool beside what was measured, and whether they hold."""
    rows, found = numbers["rows"], []
    rates = {(row["way"], row["kind"]): rate(row) for row in rows}
    for engine, least in LEAST_RATE.items():
        way = f"{engine}, {FLOAT32}"
        for kind in KINDS:
            about, of = f"{way}, {kind} bins", rates.get((way, kind))
            found.append(at_least(f"bins/s, {about}", of, least))
            if engine == "compiled":
                found.append(at_least(f"bins/s, {about}, the aim", of, AIM))
        found += [_over_oracle(rows, kind, way) for kind in KINDS]
        found += [_over_rocket(rows, kind, way) for kind in KINDS]
    return found + _error_limits(numbers)


def _over_oracle(rows: Rows, kind: str, way: str) -> dict[str, Any]:
    """With the ratio of processor time, as the oracle does little on a second thread."""
    by_clock = [times_as_fast(rows, kind, way, ORACLE, clock) for clock in ("seconds", "core_s")]
    of, core = (None if ratio is None else Spread(*ratio) for ratio in by_clock)
    more = "" if core is None else f"; of core-us {number(core.median)}"
    return at_least(f"times {ORACLE}, {way}, {kind} bins", of, LEAST_OVER_ORACLE, more)


def _over_rocket(rows: Rows, kind: str, way: str) -> dict[str, Any]:
    """The limit is on what a user gets, which is the fastest engine."""
    what = f"times {MINI_ROCKET}, {way}, {kind} bins"
    ratio = times_as_fast(rows, kind, way, MINI_ROCKET)
    of = None if ratio is None else Spread(*ratio)
    if way.startswith(FASTEST):
        return at_least(what, of, LEAST_OVER_ROCKET)
    text = NOT_MEASURED if of is None else of.text()
    return information(f"{what} (information: the limit is on the fastest engine)", text)


def _error_limits(numbers: Mapping[str, Any]) -> list[dict[str, Any]]:
    ways = [f"{engine}, {dtype}" for engine in LEAST_RATE for dtype in MOST_ERROR]
    by_way: dict[str, list[Mapping[str, Any]]] = {way: [] for way in ways}
    for row in [*numbers["rows"], *numbers["degenerate"]]:
        if row["way"] in by_way:
            by_way[row["way"]].append(row["errors"])
    found = []
    for way, errors in by_way.items():
        if not errors:
            found.append(not_measured(f"errors, {way}, every kind of bin", ""))
            continue
        dtype = way.split(", ")[1]
        bits = MOST_ENTROPY_BITS if dtype == FLOAT32 else MOST_ERROR[dtype]
        elsewhere = MOST_MODES_ELSEWHERE if dtype == FLOAT32 else 0.0
        limits = (
            ("worst", "error of any feature", MOST_ERROR[dtype], ""),
            ("entropy_bits", "error of entropy", bits, " bit"),
            ("mode_elsewhere", "modes elsewhere, share", elsewhere, ""),
            ("not_finite", "values not finite", 0, ""),
        )
        for name, what, most, unit in limits:
            worst = max(of[name] for of in errors)
            found.append(
                {
                    "what": f"{what}, {way}, every kind of bin",
                    "measured": f"{number(worst)}{unit}",
                    "limit": f"<= {most:g}{unit}",
                    "ok": worst <= most,
                }
            )
    return found


# -------------------------------------------------------------------------------------- tables
def pool_tables(numbers: Mapping[str, Any]) -> list[Table]:
    """A table for each kind of bin, and one of errors of degenerate bins."""
    tables = [
        _kind_table(kind, [row for row in numbers["rows"] if row["kind"] == kind])
        for kind in dict.fromkeys(row["kind"] for row in numbers["rows"])
    ]
    header = ["degenerate bins", "error", "of", "entropy, bit", "modes elsewhere"]
    cells = [[row["way"], *_error_cells(row["errors"])] for row in numbers["degenerate"]]
    kinds = "; ".join(f"{name}: {text}" for name, text in numbers["kinds"].items())
    note = (
        "Errors are over max(magnitude, standard deviation of the column) of the float64 "
        "reference; entropy in bits; a mode is elsewhere beyond 1e-4 of that size, share of all. "
        "One exemption: of a cv about 1e6, where the floor stands in for a mean that is rounding, "
        "the sign may differ. A cv of 5e5 is known to 1e-10, the rounding of its mean. "
        f"Bins: {kinds}."
    )
    return [*tables, Table(header, cells, note)]


def _kind_table(kind: str, rows: Rows) -> Table:
    header = [f"{kind} bins", "features", "threads", "bins/s", "us/bin (quartiles)"]
    header += ["core-us/bin", "eager / this", "error", "of", "entropy, bit", "modes elsewhere"]
    cells = []
    for row in rows:
        per_bin = Spread.of(row["seconds"]).times(1e6 / row["bins"])
        core = Spread.of(row["core_s"]).times(1e6 / row["bins"])
        ratio = times_as_fast(rows, kind, f"eager, {FLOAT32}", row["way"])
        cells.append(
            [
                row["way"],
                str(row["features"]),
                str(row["threads"]),
                number(rate(row).median),
                per_bin.text(),
                number(core.median),
                "-" if ratio is None else f"{number(ratio.median)}",
                *_error_cells(row["errors"]),
            ]
        )
    note = f"eager / this: how many times as many bins a second eager, {FLOAT32} makes"
    return Table(header, cells, note)


def _error_cells(errors: Mapping[str, Any] | None) -> list[str]:
    if errors is None:
        return ["-"] * 4
    worst = number(errors["worst"])
    if errors["not_finite"]:
        worst += f", {errors['not_finite']} not finite"
    bits, modes = (number(errors[name]) for name in ("entropy_bits", "mode_elsewhere"))
    return [worst, errors["at"], bits, modes]


def fractions(numbers: Mapping[str, Any], pool: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """How near each engine is to the least time of the model, on random bins.

    Args:
        numbers: of ``roofline``.
        pool: of ``full_pool``, if it was measured.
    """
    found = []
    for row in (pool or {"rows": []})["rows"]:
        engine, _, dtype = row["way"].partition(", ")
        if row["kind"] != KINDS[0] or engine not in {*LEAST_RATE, REFERENCE}:
            continue
        ceilings = numbers["ceilings"][str(row["threads"])]
        work = numbers["work"][dtype]
        least = least_seconds(work, ceilings, dtype)
        taken = Spread.of(row["seconds"]).median / row["bins"]
        operations = work["products"] + work["statistics"]
        found.append(
            {
                "way": row["way"],
                "threads": row["threads"],
                **least,
                "seconds": taken,
                "fraction": least["least"] / taken,
                "operations_a_second": operations / taken,
                "operations_a_byte": operations / work["bytes"],
            }
        )
    return found


def roofline_tables(
    numbers: Mapping[str, Any], fractions: Sequence[Mapping[str, Any]]
) -> list[Table]:
    """Ceilings, work of a bin, and the fraction reached."""
    ceilings = Table(
        ["ceilings of the machine", "float32 product", "float64 product", "memory"],
        [
            [
                f"{threads} thread" + ("s" if threads != "1" else ""),
                f"{of[f'{GEMM} {FLOAT32}'] / 1e9:.0f} GFLOP/s",
                f"{of[f'{GEMM} {FLOAT64}'] / 1e9:.0f} GFLOP/s",
                f"{of[MEMORY] / 1e9:.1f} GB/s",
            ]
            for threads, of in numbers["ceilings"].items()
        ],
        "best of the rounds",
    )
    work = Table(
        ["a bin, whole pool", "bytes in and out", "operations of products", "of statistics"],
        [
            [dtype, *(f"{of[name]:,.0f}" for name in ("bytes", "products", "statistics"))]
            for dtype, of in numbers["work"].items()
        ],
        "counted by the model in benchmarks/features/roofline.py",
    )
    header = ["roofline, random bins", "threads", "least by memory, us", "least by arithmetic, us"]
    header += ["taken, us", "fraction reached", "Gop/s"]
    reached = [
        [
            row["way"],
            str(row["threads"]),
            number(1e6 * row["memory"]),
            number(1e6 * row["arithmetic"]),
            number(1e6 * row["seconds"]),
            f"{row['fraction']:.3f}",
            f"{row['operations_a_second'] / 1e9:.1f}",
        ]
        for row in fractions
    ]
    return [ceilings, work, *([Table(header, reached)] if reached else [])]
