"""The figure of ``benchmarks.features``: bins a second of everything, and the roofline."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.bins import KINDS
from benchmarks.drawing import GREY, LIGHT, bars, colour_of, finish, limit_line, plain_decades
from benchmarks.engines import FLOAT32, FLOAT64
from benchmarks.features.pool_report import LEAST_RATE
from benchmarks.features.roofline import GEMM, MEMORY
from benchmarks.machine import threads_text
from benchmarks.rates import rate
from benchmarks.tables import number


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw the whole pool and, if measured, the roofline.

    Args:
        report: as ``--json`` keeps it, with the section ``pool``.
        path: of the PNG.
    """
    sections = report["sections"]
    num = 2 if report.get("fractions") else 1
    drawing = Figure(figsize=(6.4 * num, 4.4), layout="constrained")
    places = drawing.subplots(1, num, squeeze=False)[0]
    _rates(places[0], sections["pool"])
    if num == 2:
        _roofline(places[1], sections["roofline"], report["fractions"])
    finish(drawing, report, "All 2582 features of a bin", path)


def _rates(axes: Axes, numbers: Mapping[str, Any]) -> None:
    rows = [row for row in numbers["rows"] if row["kind"] == KINDS[0]]
    rows.sort(key=lambda row: -rate(row).median)
    names = [f"{row['way']}, {threads_text(row['threads'])}" for row in rows]
    values = [rate(row).median for row in rows]
    bars(axes, names, values, [number(value) for value in values])
    for place, (engine, least) in enumerate(LEAST_RATE.items()):
        limit_line(axes, least, f"{engine}: at least {least:,.0f}", 0.04 + 0.06 * place)
    axes.set_xlabel("bins a second (TSFEL and MiniRocket make other features)")
    axes.set_title("Random bins, medians", fontsize=10)


def _roofline(axes: Axes, numbers: Mapping[str, Any], fractions: Any) -> None:
    threads = str(max(row["threads"] for row in fractions))
    ceilings = numbers["ceilings"][threads]
    intensity = np.logspace(0, 4, 200)
    for dtype, style in ((FLOAT32, "-"), (FLOAT64, "--")):
        roof = np.minimum(intensity * ceilings[MEMORY], ceilings[f"{GEMM} {dtype}"]) / 1e9
        axes.plot(intensity, roof, style, color=GREY, lw=1.2)
        label = f"{dtype} products, {roof[-1]:.0f} GFLOP/s"
        axes.annotate(
            label, (intensity[-1], roof[-1]), (0, 3), textcoords="offset points", size=8, ha="right"
        )
    text = f"memory, {ceilings[MEMORY] / 1e9:.0f} GB/s"
    axes.annotate(
        text, (2, 2 * ceilings[MEMORY] / 1e9), (4, -6), textcoords="offset points", size=8
    )
    for row in fractions:
        at = row["operations_a_byte"], row["operations_a_second"] / 1e9
        marker = "o" if FLOAT32 in row["way"] else "s"
        axes.plot(*at, marker, color=colour_of(row["way"]), ms=6)
        is_wide = FLOAT64 in row["way"]
        axes.annotate(
            f"{row['way']}: {100 * row['fraction']:.0f} %",
            at,
            (-7 if is_wide else 7, 0),
            textcoords="offset points",
            ha="right" if is_wide else "left",
            va="center",
            size=8,
        )
    axes.set(xscale="log", yscale="log", xlabel="operations a byte, by the model", ylabel="Gop/s")
    plain_decades(axes.xaxis)
    plain_decades(axes.yaxis)
    axes.grid(color=LIGHT)
    axes.set_title(
        f"Roofline, {threads_text(threads)}: least time of the model / time taken", fontsize=10
    )
