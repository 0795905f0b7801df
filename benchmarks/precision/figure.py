"""The figure of ``benchmarks.precision``: score error against time, of features and of the head."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy

from benchmarks.arithmetic import WIDE
from benchmarks.machine import threads_text
from benchmarks.model.figure import GREY, OURS, PEER
from tactslip_torch.runtime import whole_file

_DODGE_PT, _CLOSE = 7, 2.0  # points of one time stand side by side; labels nearer than this move


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw one point per variant; the first, without error, is a line.

    Features take so much longer than the head that each has a panel: variants with a head of
    32 bits or more on the left, those that differ from float32 in the head alone on the right.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    first, *others = report["variants"]
    drawn = [row for row in others if row["worst_error"] is not None]  # the table has the others
    drawing = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = drawing.subplots(1, 2, sharey=True)
    errors = [row[name] for row in drawn for name in ("median_error", "worst_error")]
    decades = [math.log10(error) for error in errors if error > 0] or [0.0]
    left.set_yscale("log")
    left.set_ylim(10 ** (math.floor(min(decades))), 10 ** (math.ceil(max(decades) + 0.3)))
    _front(left, first, [row for row in drawn if "16" not in row["head"]], "features")
    _front(right, first, [row for row in drawn if row["features"] == WIDE], "head")
    left.set_title("Features", fontsize=10)
    right.set_title("Scaling and head, many bins at once", fontsize=10)
    left.set_ylabel("score error beside float64, sd of the score:\ndot median, bar worst")
    of = report["experiment"]
    quick = "; QUICK, means nothing" if report["quick"] else ""
    num = sum(of["num_bins"][role] for role in ("test", "unseen"))
    drawing.suptitle(
        f"Precision against time: {num} held-out bins of the simulated hand, "
        f"{threads_text(report['threads'])}{quick}",
        fontsize=11,
    )
    with whole_file(path) as temporary:
        drawing.savefig(temporary, dpi=160, format="png", facecolor="white")


def _front(
    axes: Axes, first: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], part: str
) -> None:
    def microseconds(row: Mapping[str, Any]) -> float:
        value: float = 1e6 * median(row[f"{part}_s"])
        return value

    limit = microseconds(first)
    axes.axvline(limit, color=GREY, ls="--", lw=1)
    axes.annotate(
        f"{_label(first)}: the reference",
        (limit, 1.0),
        (-4, 0),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="right",
        va="top",
        size=8,
        color=GREY,
    )
    most = max([limit, *(microseconds(row) for row in rows)])
    axes.set_xlim(0, 1.4 * most)  # room for the labels
    seen: list[tuple[float, float]] = []
    for row in sorted(rows, key=lambda row: row["median_error"]):
        at, error = microseconds(row), row["median_error"]
        place = sum(time == at for time, _ in seen)
        is_close = any(time == at and error <= _CLOSE * other for time, other in seen)
        is_left = 0.5 * most < at < 0.9 * limit  # room for the label on that side
        seen.append((at, error))
        side = offset_copy(
            axes.transData, axes.get_figure(root=True), x=_DODGE_PT * place, units="points"
        )
        color = PEER if "16" in row["head"] else OURS
        bar = [error, row["worst_error"]]
        axes.plot([at, at], bar, color=color, lw=1, marker="_", markevery=[1], transform=side)
        axes.plot(at, error, "o", color=color, transform=side)
        axes.annotate(
            _label(row),
            (at, error),
            (-_DODGE_PT * (place + 1) if is_left else _DODGE_PT, -10 if is_close else 0),
            xycoords=side,
            textcoords="offset points",
            size=8,
            ha="right" if is_left else "left",
            va="center",
        )
    axes.set_xlabel("µs a bin")
    axes.grid(color="#dddddd")
    axes.set_axisbelow(True)
    for side_name in ("top", "right"):
        axes.spines[side_name].set_visible(False)


def _label(row: Mapping[str, Any]) -> str:
    return f"{row['name']}, {row['bytes']['all'] / 1e3:.0f} kB"
