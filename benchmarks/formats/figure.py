"""The figure of ``benchmarks.formats``: how long every format takes to be read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.figure import Figure

from benchmarks.drawing import LIGHT, OURS, PEER, THIRD, finish, limit_line, plain_decades
from benchmarks.formats.measure import LOAD, STREAM
from benchmarks.formats.measure import PEER as OTHER
from benchmarks.formats.report import MOST_S
from benchmarks.tables import number

_SHOWN = {LOAD: (OURS, "whole"), STREAM: (THIRD, "in pieces"), OTHER: (PEER, "another tool")}


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw three bars a format.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["formats"]["rows"]
    drawing = Figure(figsize=(8.2, 0.62 * len(rows) + 1.6), layout="constrained")
    axes = drawing.subplots()
    for step, (what, (color, label)) in enumerate(_SHOWN.items()):
        values = [1e3 * median(row["seconds"][what]) for row in rows]
        places = [place + 0.27 * (step - 1) for place in range(len(rows))]
        axes.barh(places, values, color=color, height=0.25, label=label)
        for place, value in zip(places, values, strict=True):
            axes.annotate(
                number(value),
                (value, place),
                (4, 0),
                textcoords="offset points",
                va="center",
                size=7,
            )
    axes.set_yticks(range(len(rows)), [f".{row['ending']}" for row in rows], fontsize=9)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(left=0.3)
    limit_line(axes, 1e3 * MOST_S, "npz, h5, mcap: 100 ms", 0.97)
    plain_decades(axes.xaxis)
    axes.grid(axis="x", color=LIGHT)
    axes.set_xlabel("ms to read all samples")
    axes.legend(loc="lower right", fontsize=8, frameon=False)
    settings = report["settings"]
    finish(drawing, report, f"Reading {settings['duration_s']:g} s of 24 channels, 1 thread", path)
