"""The figure of ``benchmarks.latency``: p50 and p99 of every way."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.drawing import LIGHT, colour_of, finish, limit_line, plain_decades
from benchmarks.tables import number

BIN_PERIOD_US = 50_000.0


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw one line a way from p50, a dot, to p99, a bar.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = [row for row in report["sections"]["latency"]["rows"] if row["is_whole"]]
    rows.sort(key=lambda row: float(row["p50_s"]))
    drawing = Figure(figsize=(8.2, 0.32 * len(rows) + 1.6), layout="constrained")
    axes = drawing.subplots()
    for place, row in enumerate(rows):
        color = colour_of(row["way"])
        if "head" in row["way"] or row["way"].startswith("onnx"):
            color = "#555555"
        p50, p99 = 1e6 * row["p50_s"], 1e6 * row["p99_s"]
        axes.plot([p50, p99], [place, place], color=color, lw=1.2)
        axes.plot(p99, place, "|", color=color, ms=8)
        axes.plot(p50, place, "o", color=color, ms=6)
        axes.annotate(
            number(p50),
            (p50, place),
            (-7, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            size=8,
        )
    names = [f"{row['way']} ({row['features']})" for row in rows]
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(min(1e6 * row["p50_s"] for row in rows) / 3)
    limit_line(axes, BIN_PERIOD_US, "a bin every 50 ms", 0.95)
    plain_decades(axes.xaxis)
    axes.grid(axis="x", color=LIGHT)
    axes.set_xlabel("us from raw samples to a score\ndot p50, bar p99; in brackets: features made")
    finish(drawing, report, "Latency of one bin on one thread", path)
