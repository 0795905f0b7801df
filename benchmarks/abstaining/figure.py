"""The figure of ``benchmarks.abstaining``: covered over asked, and what being sure costs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.abstaining.report import mean_of
from benchmarks.abstaining.ways import WAYS
from benchmarks.drawing import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish
from tactslip_torch.report.metrics import CLASSES

STYLES = dict(
    zip(WAYS, ((OURS, "o-"), (THIRD, "s-"), (PEER, "^--"), (SECOND, "v--")), strict=False)
)


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw coverage of the worse class over what was asked, and errors over unsure answers.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["answers"]
    asked = sorted({row["asked"] for row in rows})
    drawing = Figure(figsize=(11.5, 4.2), layout="constrained")
    panels = drawing.subplots(1, 4)
    for place, role in enumerate(("test", "unseen")):
        covered, cost = panels[place], panels[2 + place]
        for way, (colour, marks) in STYLES.items():
            means = [mean_of(rows, way, one, role) for one in asked]
            known = [mean for mean in means if mean is not None]
            worse = [100 * min(mean[f"{name}_coverage"] for name in CLASSES) for mean in known]
            covered.plot([100 * one for one in asked], worse, marks, color=colour, ms=5, label=way)
            unsure = [100 * mean["unsure"] for mean in known]
            wrong = [100 * mean["wrong"] for mean in known]
            cost.plot(unsure, wrong, marks, color=colour, ms=5)
        never = mean_of(rows, "never unsure", asked[0], role)
        if never is not None:
            cost.plot(0, 100 * never["wrong"], "*", color=GREY, ms=11, label="never unsure")
        _finish_covered(covered, asked, role)
        _finish_cost(cost, role)
    drawing.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False
    )
    finish(drawing, report, "Answers that may be unsure", path)


def _finish_covered(axes: Axes, asked: list[float], role: str) -> None:
    ends = [100 * asked[0], 100 * asked[-1]]
    axes.plot(ends, ends, color=GREY, ls=":", lw=1.2, label="asked")
    axes.set_xlabel("asked, %")
    axes.set_ylabel("covered, worse class, %")
    axes.set_title(f"{role}: {'promised' if role == 'test' else 'not promised'}", fontsize=10)
    axes.grid(color=LIGHT)


def _finish_cost(axes: Axes, role: str) -> None:
    axes.set_xlabel("unsure, % of bins")
    axes.set_ylabel("wrong, % of the sure")
    axes.set_title(f"{role}: price (\u2605 never unsure)", fontsize=9)
    axes.set_ylim(bottom=0)
    axes.grid(color=LIGHT)
