"""The figure of ``benchmarks.real``: every object of every method, and ROC curves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.harness import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish

_RIVALS = (
    PEER,
    "#f0a07a",
    THIRD,
    "#cc79a7",
    "#56b4e9",
    "#e69f00",
)  # Okabe and Ito, as the others; the second MiniRocket lighter
_CORNER = 0.3


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw balanced accuracy by object, and the corner of the ROC curves that matters.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["methods"]
    paired = [name for name, row in rows.items() if row["time"] is not None]
    colors = _colors(paired)
    drawing = Figure(figsize=(11.0, 5.2), layout="constrained")
    dots, curves = drawing.subplots(1, 2, width_ratios=(1.25, 1.0))
    _dots(dots, rows, colors)
    for name in paired:
        row, width = rows[name], 2.0 if name == report["ours"] else 1.2
        label = f"{name}: AUC {100 * row['auc']:.1f} %"
        x, y = row["curve"]["false_alarms"], row["curve"]["found"]
        curves.plot(x, y, color=colors[name], lw=width, label=label)
        curves.plot(1 - row["specificity"], row["sensitivity"], "o", color=colors[name], ms=5)
    curves.set_xlim(0, _CORNER)
    curves.set_ylim(1 - _CORNER, 1.0)
    curves.set_xlabel("stable touch called slip")
    curves.set_ylabel("slip found")
    curves.set_title("ROC curves, their corner; dots: at 0, where it decides", fontsize=9)
    drawing.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    curves.grid(color=LIGHT)
    about = "Slip against stable touch on a real BioTac SP, each object left out in turn"
    finish(drawing, report, about, path)


def _colors(names: list[str]) -> dict[str, str]:
    mine = [name for name in names if name.startswith("ours")]
    others = [name for name in names if name not in mine]
    pairs = zip([*mine, *others], [OURS, SECOND, *_RIVALS], strict=False)
    return dict(pairs)


def _dots(axes: Axes, rows: Mapping[str, Any], colors: Mapping[str, str]) -> None:
    """A line for each method: a dot for each object, the worst named, a bar at all windows."""
    for place, (name, row) in enumerate(rows.items()):
        color = colors.get(name, GREY)
        values = [100 * value for value in row["objects"].values()]
        axes.plot(values, [place] * len(values), "o", color=color, ms=5, alpha=0.55, mew=0)
        axes.plot(100 * row["balanced_accuracy"], place, "|", color=color, ms=20, mew=2)
        worst = row["worst"]
        axes.annotate(
            worst["object"],
            (100 * worst["balanced_accuracy"], place),
            (0, -9),
            textcoords="offset points",
            ha="center",
            va="center",
            size=7,
            color="#555555",
        )
    axes.set_yticks(range(len(rows)), list(rows), fontsize=8)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlabel("balanced accuracy, %: dots objects, bar all windows")
    axes.set_title("objects that were left out", fontsize=9)
    axes.grid(axis="x", color=LIGHT)
