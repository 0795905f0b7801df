"""What follows from the measurements of ``benchmarks.precision``: ratios, limits, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from benchmarks.clocks import paired_ratio
from benchmarks.machine import threads_text
from benchmarks.outcome import limits_table
from tactslip_torch.report.style import SIMULATED_LINE, table

QUICK_LINE = "QUICK: too few bins and rounds to mean anything, whatever stands under limits"
MOST_ERROR = 1e-3  # of float32, in standard deviations of the score, as the project has set itself
NONE = "-"


# ------------------------------------------------------------------------------------- numbers
def ratios(variants: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds and bytes of every variant over those of the first, timed in the same rounds."""
    first = variants[0]
    return {
        row["name"]: {
            "features": paired_ratio(row["features_s"], first["features_s"])._asdict(),
            "head": paired_ratio(row["head_s"], first["head_s"])._asdict(),
            "bytes": row["bytes"]["all"] / first["bytes"]["all"],
        }
        for row in variants
    }


def limit_rows(variants: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The limit beside what was measured, and whether it holds."""
    return [
        {
            "what": f"{row['name']}, worst score error in sd",
            "measured": _error(row["worst_error"]),
            "limit": f"<= {MOST_ERROR:g}",
            "ok": row["worst_error"] is not None and row["worst_error"] <= MOST_ERROR,
        }
        for row in variants
        if row["name"] == "float32"
    ]


# -------------------------------------------------------------------------------------- tables
def report_text(report: Mapping[str, Any]) -> str:
    """What is printed.

    Args:
        report: as ``--json`` keeps it.
    """
    parts = [_heading(report), _variants(report), _solves(report["solves"])]
    parts += [
        f"{name} bins: the pool refuses, {of!r}" for name, of in report["pool_refuses"].items()
    ]
    parts.append(limits_table(report["limits"]))
    return "\n\n".join(parts + ([QUICK_LINE] if report["quick"] else []))


def _heading(report: Mapping[str, Any]) -> str:
    of = report["experiment"]
    bins = ", ".join(f"{num} {role}" for role, num in of["num_bins"].items())
    lines = [
        f"precision: {of['experiment']}, recipe {of['recipe']}, {of['num_features']} features, "
        f"C = {of['penalty']:g}; bins: {bins}",
        f"machine   {', '.join(report['machine'].values())}, {threads_text(report['threads'])}",
        f"versions  {', '.join(f'{name} {of}' for name, of in report['versions'].items())}",
        SIMULATED_LINE,
    ]
    return "\n".join(lines + ([QUICK_LINE] if report["quick"] else []))


def _variants(report: Mapping[str, Any]) -> str:
    header = ["variant", "features, us/bin", "/ float64", "head, us/bin", "/ float64", "bytes"]
    header += ["median error, sd", "worst", "flipped", "test %", "unseen %"]
    rows = []
    for row in report["variants"]:
        of = report["ratios"][row["name"]]
        cells = [row["name"]]
        for part in ("features", "head"):
            cells += [_us(row[f"{part}_s"]), f"{of[part]['median']:.2f}"]
        cells += [str(row["bytes"]["all"]), _error(row["median_error"]), _error(row["worst_error"])]
        cells += [NONE if row["flipped"] is None else str(row["flipped"])]
        cells += [_percent(row["balanced_accuracy"][role]) for role in ("test", "unseen")]
        rows.append(cells)
    notes = ["errors of scores beside float64, in standard deviations of the score"]
    notes += [f"{row['name']}: {row['refused']}" for row in report["variants"] if row["refused"]]
    return "\n".join([table([header, *rows]), *notes])


def _solves(solves: Sequence[Mapping[str, Any]]) -> str:
    header = ["solve", "seconds", "condition", "median error, sd", "worst", "flipped"]
    rows = []
    for row in solves:
        cells = [row["name"], f"{median(row['seconds']):.2f}", _error(row["condition"])]
        cells += [_error(row["median_error"]), _error(row["worst_error"])]
        rows.append([*cells, NONE if row["flipped"] is None else str(row["flipped"])])
    notes = [f"{row['name']}: {row['refused']}" for row in solves if row["refused"]]
    note = "errors of the solve alone: one set of float32 features, scored in float64"
    return "\n".join([table([header, *rows]), note, *notes])


def _us(seconds: Sequence[float]) -> str:
    return f"{1e6 * median(seconds):.3g}"


def _error(value: float | None) -> str:
    return NONE if value is None else f"{value:.1e}"


def _percent(share: float | None) -> str:
    return NONE if share is None else f"{100 * share:.2f}"
