"""The figure of ``benchmarks.dead_sensors``: what each finger and half a hand are worth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.figure import Figure

from benchmarks.dead_sensors.measure import MEAN, REFIT, VOLTS, ZERO
from benchmarks.dead_sensors.measure import OURS as CLOSED
from benchmarks.dead_sensors.report import rows_of
from benchmarks.dead_sensors.subject import ROLES
from benchmarks.drawing import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish

STYLES = {
    CLOSED: (OURS, "o"),
    MEAN: (PEER, "s"),
    ZERO: (SECOND, "^"),
    VOLTS: (THIRD, "v"),
    REFIT: (GREY, "_"),
}
_PARTS = {"balanced_accuracy": "balanced accuracy, %", "ece": "calibration error, %"}


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw accuracy and calibration of every way for each dead finger and for random halves.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["losses"]
    drawing = Figure(figsize=(11.5, 4.6), layout="constrained")
    panels = drawing.subplots(1, 4)
    for place, (role, part) in enumerate((role, part) for part in _PARTS for role in ROLES):
        axes, seen = panels[place], list[float]()
        for way, (colour, mark) in STYLES.items():
            fingers = rows_of(rows, role, "finger", way)
            halves = rows_of(rows, role, "half", way)
            if not fingers:
                continue
            names = [row["dead"] for row in fingers] + ["half"] * bool(halves)
            values = [100 * row[part] for row in fingers]
            values += [100 * fmean(row[part] for row in halves)] * bool(halves)
            seen += values if way != VOLTS else []
            axes.plot(names, values, mark, color=colour, ms=6, mew=2, label=way)
        room = 0.15 * (max(seen) - min(seen)) + 0.2
        axes.set_ylim(min(seen) - room, max(seen) + room)  # 0 V may lie far outside
        axes.set_title(role, fontsize=10)
        axes.set_ylabel(_PARTS[part])
        axes.grid(color=LIGHT)
        axes.tick_params(axis="x", rotation=45)
    drawing.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False
    )
    title = "One finger dead, or a random half of the sensors (0 V: mostly off the scale)"
    finish(drawing, report, title, path)
