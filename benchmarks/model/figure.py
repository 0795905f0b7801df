"""The figure of ``benchmarks.model``: four panels, from the report it keeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from tactslip_torch.runtime import whole_file

# Okabe and Ito, told apart by the colour-blind
OURS, SECOND, PEER, THIRD, GREY = "#0072b2", "#e69f00", "#d55e00", "#009e73", "#888888"


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw what was measured.

    Args:
        report: with at least one of the sections of ``PANELS``.
        path: of the PNG.
    """
    shown = [name for name in PANELS if name in report["sections"]]
    columns = min(2, len(shown))
    rows = -(-len(shown) // columns)
    drawing = Figure(figsize=(4.8 * columns, 3.6 * rows + 0.5), layout="constrained")
    places = drawing.subplots(rows, columns, squeeze=False).flat
    for place, name in zip(places, shown, strict=False):
        PANELS[name](place, report["sections"][name], report)
        for side in ("top", "right"):
            place.spines[side].set_visible(False)
        place.set_axisbelow(True)
    for place in list(drawing.axes)[len(shown) :]:
        place.set_axis_off()
    settings = report["settings"]
    about = f"Synthetic features, K = {settings['num_features']}, {report['threads']} threads"
    quick = "; QUICK, means nothing" if report["quick"] else ""
    drawing.suptitle(f"{about}{quick}", fontsize=11)
    with whole_file(path) as temporary:
        drawing.savefig(temporary, dpi=160, format="png", facecolor="white")


def _latency(axes: Axes, numbers: Mapping[str, Any], report: Mapping[str, Any]) -> None:
    bins = [row["training_bins"] for row in numbers["rows"]]
    svc = numbers["svc"]
    for num, style, mark in zip(svc["seconds"], ("-", "--"), ("o", "s"), strict=True):
        scored = "1 bin" if num == "1" else f"{num} bins"
        for name, color, label in (("sum_s", SECOND, "kernel sum"), ("head_s", OURS, "head")):
            milliseconds = [1e3 * row[name][num] for row in numbers["rows"]]
            axes.plot(
                bins, milliseconds, style, marker=mark, color=color, label=f"{label}, {scored}"
            )
        at = svc["training_bins"], 1e3 * svc["seconds"][num]
        axes.plot(*at, marker=mark, ls="", ms=8, mfc="none", color=PEER, label=f"SVC, {scored}")
    axes.set(xscale="log", yscale="log", xlabel="training bins", ylabel="latency, ms")
    axes.set_ylim(top=axes.get_ylim()[1] * 50)  # room for the legend
    _plain(axes.xaxis)
    _plain(axes.yaxis)
    axes.set_title("Score latency", fontsize=10)
    axes.grid(color="#dddddd")
    axes.legend(frameon=False, fontsize=7.5, ncols=2)


def _accumulation(axes: Axes, numbers: Mapping[str, Any], report: Mapping[str, Any]) -> None:
    labels, shares = [], report["ratios"]["update"]
    for place, (num, share) in enumerate(shares.items()):
        labels.append(f"batches of {num}")
        for shift, name, color in ((-0.2, "dsyrk", OURS), (0.2, "gemm", THIRD)):
            value = share[f"of_{name}"]
            label = f"bare {name} / update" if place == 0 else None
            bar = axes.bar(place + shift, value, 0.36, color=color, label=label)
            axes.bar_label(bar, fmt="%.2f", fontsize=8)
    axes.axhline(1.0, color=GREY, lw=1, ls=":")
    axes.set_xticks(range(len(labels)), labels)
    axes.set_ylabel("speed relative to bare BLAS")
    axes.set_title("Accumulating the statistics (higher is faster)", fontsize=10)
    axes.margins(y=0.25)
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)


def _fit(axes: Axes, numbers: Mapping[str, Any], report: Mapping[str, Any]) -> None:
    rows = numbers["rows"]
    peers = ("KernelRidge", "SVC")
    colors = [PEER if row["name"] in peers else OURS for row in rows]
    names = [
        f"{row['name']}\n(scikit-learn)" if row["name"] in peers else row["name"] for row in rows
    ]
    seconds = [median(row["seconds"]) for row in rows]
    axes.scatter(seconds, range(len(rows)), s=60, c=colors)
    for place, value in enumerate(seconds):
        axes.annotate(
            f"{value:.3g} s",
            (value, place),
            (8, 0),
            textcoords="offset points",
            va="center",
            size=8,
        )
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set(xscale="log", xlabel="seconds")
    lowest, highest = math.log10(min(seconds)), math.log10(max(seconds))
    axes.set_xlim(10 ** math.floor(lowest), 10 ** math.ceil(highest + 0.15))
    _plain(axes.xaxis)
    axes.grid(axis="x", color="#dddddd")
    axes.set_title(f"Fit of {numbers['num_bins']} bins", fontsize=10)


def _folds(axes: Axes, numbers: Mapping[str, Any], report: Mapping[str, Any]) -> None:
    count = numbers["num_folds"]
    kinds = (
        ("one fit", GREY, ("fit_s",)),
        (f"fit and {count} folds, closed form", OURS, ("closed_s",)),
        (f"fit and {count} refits", PEER, ("fit_s", "refits_s")),
    )
    for place, row in enumerate(numbers["rows"]):
        for shift, (label, color, parts) in zip((-0.27, 0.0, 0.27), kinds, strict=True):
            seconds = sum(median(row[part]) for part in parts)
            first = label if place == 0 else None
            bar = axes.bar(place + shift, seconds, 0.25, color=color, label=first)
            axes.bar_label(bar, fmt="%.3g", fontsize=8)
    axes.set_xticks(
        range(len(numbers["rows"])), [f"{row['num_bins']} bins" for row in numbers["rows"]]
    )
    axes.set_ylabel("seconds")
    axes.margins(y=0.15)
    axes.set_title(f"Leaving out each of {count} groups", fontsize=10)
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _plain(axis: Axis) -> None:
    """Write decades as numbers, and nothing between them."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_formatter(NullFormatter())


PANELS: dict[str, Callable[[Axes, Mapping[str, Any], Mapping[str, Any]], None]] = {
    "size": _latency,
    "accumulation": _accumulation,
    "fit": _fit,
    "folds": _folds,
}
