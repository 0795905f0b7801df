"""The figure of ``benchmarks.simulation``: the front of cost against error, and of accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.drawing import LIGHT, OURS, PEER, THIRD, finish, plain_decades

COLORS = {"kinematic": PEER, "lugre": OURS, "patch": THIRD}


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw friction error, onset error and accuracy over seconds per simulated minute.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    found = report["sections"]
    errors = {(row["rung"], row["step_us"]): row for row in found["errors"]}
    accuracy = {(row["rung"], row["step_us"]): row["accuracy"] for row in found["accuracy"]}
    drawing = Figure(figsize=(10.5, 3.9), layout="constrained")
    panels = drawing.subplots(1, 3)
    axes: Axes
    values = {
        "friction error, % of static friction": {
            place: 100 * row["friction_error"] for place, row in errors.items()
        },
        "onset error, ms": {place: 1e3 * row["onset_error_s"] for place, row in errors.items()},
        "balanced test accuracy, %": {
            place: 100 * value for place, value in accuracy.items() if value is not None
        },
    }
    for axes, (title, of) in zip(panels, values.items(), strict=True):
        for rung, color in COLORS.items():
            rows = [
                row
                for row in found["cost"]
                if row["rung"] == rung and row["engine"] != "eager" and (rung, row["step_us"]) in of
            ]
            if not rows:
                continue
            x = [row["seconds_per_minute"] for row in rows]
            y = [of[rung, row["step_us"]] for row in rows]
            axes.plot(x, y, "o-", color=color, label=rung, ms=5)
            for row, left, high in zip(rows, x, y, strict=True):
                text = "" if row["step_us"] is None else f"{row['step_us']:g}"
                axes.annotate(text, (left, high), (4, 3), textcoords="offset points", size=7)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("s per simulated minute of 24 channels")
        axes.set_title(title, fontsize=9)
        axes.grid(color=LIGHT)
        if "error" in title and any(value > 0 for value in of.values()):
            axes.set_yscale("log")
            plain_decades(axes.yaxis)
    panels[0].legend(fontsize=8, frameon=False)
    finish(drawing, report, "Rungs and steps (us) of the hand", path)
