"""How figures of benchmarks look: colours, plain axes, one way to write a PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from tactslip_torch.runtime import whole_file

# Okabe and Ito, told apart by the colour-blind
OURS, SECOND, THIRD, PEER, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#888888"
ENGINE_COLORS = {"compiled": OURS, "eager": THIRD, "reference": SECOND}
LIGHT = "#dddddd"


def colour_of(way: str) -> str:
    """Of one of our engines or of a peer, by the first word of its name."""
    return ENGINE_COLORS.get(way.split(",")[0].split()[0], PEER)


def bars(axes: Axes, names: Sequence[str], values: Sequence[float], labels: Sequence[str]) -> None:
    """Horizontal bars on a logarithmic axis, the first on top, each with its label."""
    places = range(len(names))
    axes.barh(places, values, color=[colour_of(name) for name in names], height=0.65)
    for place, value, label in zip(places, values, labels, strict=True):
        axes.annotate(
            label, (value, place), (4, 0), textcoords="offset points", va="center", size=8
        )
    axes.set_yticks(places, names, fontsize=8)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 2, max(values) * 4)
    plain_decades(axes.xaxis)
    axes.grid(axis="x", color=LIGHT)


def limit_line(axes: Axes, value: float, text: str, place: float) -> None:
    """A dashed vertical line with its meaning beside it, at a height in parts of the axes."""
    axes.axvline(value, color=GREY, ls="--", lw=1, zorder=0)
    low, high = axes.get_xlim()
    axes.set_xlim(low, max(high, 6 * value))  # room for the text
    axes.annotate(
        text,
        (value, place),
        (3, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        size=7.5,
        color="#555555",
        va="center",
    )


def plain_decades(axis: Axis) -> None:
    """Write decades as numbers, and nothing between them."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())


def finish(drawing: Figure, report: Mapping[str, Any], about: str, path: Path) -> None:
    """Title, bare frames, and the file.

    Args:
        drawing: with its axes drawn.
        report: tells whether it was quick, and whether bins are simulated.
        about: the title; that bins are simulated is added.
        path: of the PNG.
    """
    for axes in drawing.axes:
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    quick = "; QUICK, means nothing" if report["quick"] else ""
    simulated = ", simulated bins" if report.get("simulated", True) else ""
    drawing.suptitle(f"{about}{simulated}{quick}", fontsize=11)
    with whole_file(path) as temporary:
        drawing.savefig(temporary, dpi=160, format="png", facecolor="white")
