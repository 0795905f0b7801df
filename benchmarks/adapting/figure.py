"""The figure of ``benchmarks.adapting``: accuracy against recordings, new above and old below."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.adapting.measure import AUTO, ONE, SHIFT, SLIP_FREE
from benchmarks.adapting.report import SHOWN, ceiling, counts, new_materials, scores
from benchmarks.drawing import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish

_COLOURS = {AUTO: OURS, ONE: THIRD, SLIP_FREE: SECOND, SHIFT: PEER}


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw a column for every new material.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    adapted = report["sections"]["adapted"]
    materials = new_materials(adapted)
    drawing = Figure(figsize=(2.6 * max(len(materials), 2) + 1.0, 5.4), layout="constrained")
    rows = drawing.subplots(2, len(materials), sharex=True, sharey="row", squeeze=False)
    for place, material in enumerate(materials):
        starts = adapted["before"]["new"][material], adapted["before"]["old"]
        for axes, what, start in zip(rows[:, place], ("new", "old"), starts, strict=True):
            _lines(axes, adapted, material, what, start)
        rows[0, place].set_title(material, fontsize=10)
        rows[1, place].set_xlabel("recordings added")
    rows[0, 0].set_ylabel("new material,\nbalanced accuracy %")
    rows[1, 0].set_ylabel("old materials on test,\nbalanced accuracy %")
    handles, labels = rows[0, 0].get_legend_handles_labels()
    drawing.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    finish(drawing, report, "A new material from a few recordings", path)


def _lines(axes: Axes, adapted: Mapping[str, Any], material: str, what: str, start: float) -> None:
    """The medians of every way, and all draws of the first as dots."""
    most = 100 * ceiling(adapted, material)[what]
    axes.axhline(most, color=GREY, ls="--", lw=1, label="trained on it (ceiling)")
    if what == "new":
        axes.axhline((100 * start + most) / 2, color=GREY, ls=":", lw=1, label="halfway")
    for way, colour in _COLOURS.items():
        known = counts(adapted, way)
        draws = [[100 * value for value in scores(adapted, material, way, n, what)] for n in known]
        middle = [100 * start, *map(median, draws)]
        axes.plot([0, *known], middle, "o-", color=colour, ms=4, label=SHOWN[way])
        if way == AUTO:
            for count, values in zip(known, draws, strict=True):
                axes.scatter([count] * len(values), values, s=7, color=colour, alpha=0.5)
    axes.set_xticks([0, *counts(adapted, AUTO)])
    axes.grid(color=LIGHT)
    axes.tick_params(labelsize=8)
