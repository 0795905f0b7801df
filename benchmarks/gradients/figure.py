"""The figure of ``benchmarks.gradients``: seconds and memory, forward and back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.drawing import GREY, LIGHT, OURS, PEER, finish
from benchmarks.gradients import ways
from benchmarks.tables import number

_COLORS = {ways.BASE: GREY, ways.OURS: OURS, ways.PEER: PEER}
_LABELS = {
    ways.BASE: "the fit alone",
    ways.OURS: "differentiable fit",
    ways.PEER: "autograd through Cholesky",
}
_MIB = 2**20


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw a bar a way, beside each other for every problem.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["gradients"]["rows"]
    problems = list(dict.fromkeys(row["problem"] for row in rows))
    drawing = Figure(figsize=(10.5, 0.72 * len(problems) + 1.9), layout="constrained")
    left, right = drawing.subplots(1, 2, sharey=True)
    for row in rows:
        place = problems.index(row["problem"]) + 0.27 * (list(_COLORS).index(row["way"]) - 1)
        color = _COLORS[row["way"]]
        forward = median(row["forward_s"])
        back = median(row["backward_s"]) if "backward_s" in row else 0.0
        left.barh(place, forward, color=color, height=0.24)
        left.barh(place, back, left=forward, color=color, height=0.24, alpha=0.45, hatch="///")
        text = number(forward) + (f" + {number(back)}" if back else "")
        _label(left, forward + back, place, text)
        memory = median(row["whole_bytes"]) / _MIB
        right.barh(place, memory, color=color, height=0.24)
        _label(right, memory, place, number(memory))
    left.set_yticks(range(len(problems)), problems, fontsize=9)
    left.set_ylim(len(problems) - 0.4, -0.6)
    left.set_xlabel("s, forward + back (hatched)")
    right.set_xlabel("MiB at most, both ways")
    for axes in (left, right):
        axes.set_xlim(0, 1.25 * axes.get_xlim()[1])
        axes.grid(axis="x", color=LIGHT)
    for way, color in _COLORS.items():
        right.barh(0, 0, color=color, label=_LABELS[way])
    right.legend(loc="lower right", fontsize=8, frameon=False)
    finish(drawing, report, "A loss through the closed-form fit, and its gradient", path)


def _label(axes: Axes, value: float, place: float, text: str) -> None:
    axes.annotate(text, (value, place), (4, 0), textcoords="offset points", va="center", size=7)
