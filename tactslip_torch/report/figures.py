"""Figures of a run as PNG files: confusion matrices, and the pipeline itself.

Drawn on matplotlib's ``Figure`` objects, so that no window opens and no global state changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyBboxPatch

from tactslip_torch.report import published
from tactslip_torch.runtime import whole_file

_INK, _GREY = "#222222", "#666666"
_TITLE, _TEXT, _SMALL = 13, 10, 9  # font sizes in points


def confusion_figure(metrics: Mapping[str, Any], path: str | Path) -> None:
    """Write one confusion matrix per split: bins counted, and percent of each true class.

    The paper's recalls are the caption of a panel where it states them, of scenes of its own.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there is no split.
    """
    splits = metrics["splits"]
    if not splits:
        raise ValueError("metrics has no split to draw")
    num_columns = min(4, len(splits))
    num_rows = -(-len(splits) // num_columns)
    spacing = ConstrainedLayoutEngine(w_pad=0.15, h_pad=0.1, wspace=0.04, hspace=0.06)
    size = (max(4.6, 3.4 * num_columns), 3.8 * num_rows + 0.6)
    figure = Figure(figsize=size, layout=spacing)
    figure.suptitle(_titled("Contact status per bin", metrics["simulated"]), fontsize=_TITLE)
    grid = figure.add_gridspec(num_rows, num_columns)
    for place, name in enumerate(splits):
        panel = figure.add_subplot(grid[place // num_columns, place % num_columns])
        _confusion_panel(panel, name, metrics)
    _save(figure, path)


def _confusion_panel(axes: Axes, name: str, metrics: Mapping[str, Any]) -> None:
    """One split's 2 x 2 cells, coloured by the percentage of their row."""
    scores = metrics["splits"][name]
    counts = np.asarray(scores["confusion"], dtype=float)
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1.15)
    for row, column in np.ndindex(2, 2):
        ink = "white" if shares[row, column] > 0.6 else _INK
        share = _percent(shares[row, column] if counts[row].sum() else None)
        place: dict[str, Any] = {"ha": "center", "color": ink}
        axes.text(column, row - 0.06, share, va="center", fontsize=_TITLE, **place)
        count = f"{counts[row, column]:,.0f} bins".replace(",", "\N{THIN SPACE}")
        axes.text(column, row + 0.16, count, va="center", fontsize=_SMALL, **place)
    axes.set_xticks([0, 1], ["non-slip", "slip"], fontsize=_TEXT)
    axes.set_yticks([0, 1], ["non-slip", "slip"], fontsize=_TEXT, rotation=90, va="center")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.axhline(0.5, color="white", linewidth=2)
    axes.axvline(0.5, color="white", linewidth=2)
    axes.set_ylabel("truth", fontsize=_TEXT, color=_GREY)
    axes.set_title(name, fontsize=_TEXT + 1, fontweight="bold", pad=21)
    axes.text(0.5, -0.545, _accuracies(scores), ha="center", fontsize=_SMALL)  # below the title
    axes.set_xlabel(f"prediction\n{_caption(metrics, name)}", fontsize=_SMALL, color=_GREY)


def _caption(metrics: Mapping[str, Any], split: str) -> str:
    """The paper's numbers beside a split's, in two short lines; empty where it has none."""
    paper = published.beside(metrics, split)
    if paper is None:
        return "\n"
    if paper.non_slip_recall is None or paper.slip_recall is None:
        return f"paper: accuracy {_percent(paper.accuracy)}\n"
    recalls = f"non-slip {paper.non_slip_recall:.1%}, slip {paper.slip_recall:.1%}"
    return f"paper: {recalls.replace('%', ' %')}\n{_accuracies(vars(paper))}"


def _accuracies(scores: Mapping[str, Any]) -> str:
    balanced = _percent(scores["balanced_accuracy"])
    return f"accuracy {_percent(scores['accuracy'])}, balanced {balanced}"


_WINGS = {
    "data | simulation": "#E69F00",
    "signals": "#56B4E9",
    "features": "#009E73",
    "model": "#CC79A7",
    "report": "#888888",
}
_STEPS: tuple[tuple[str, str, str, str], ...] = (
    # wing, what it does, how, shape of what leaves it
    ("signals", "clean and cut", "Savitzky-Golay\nbins of 50 ms", "[N, 24, 100]"),
    ("signals", "branch", "wavelet A1-A4, D1-D4\nand their spectra", "[N, 10, 8, 100]"),
    ("features", "describe", "17 descriptors\npool of 2582", "[N, 2582]"),
    ("features", "select", "ranked by t-test\nbest 120", "[N, 120]"),
    ("model", "judge", "scaling, kernel ELM\nfolded to z'Qz + l'z + a", "[N]"),
    ("report", "tell", "slip score \N{GREATER-THAN OR EQUAL TO} 0: slip\nmetrics, figures", ""),
)


def pipeline_figure(path: str | Path) -> None:
    """Write the way of a signal through the package, with the tensor's shape after each step.

    Args:
        path: the PNG to write, replaced as a whole if it exists.
    """
    width, pitch, bottom, top = 1.8, 2.16, 0.72, 1.82  # inches, as everything here
    lefts = [pitch * step for step in range(len(_STEPS) + 1)]
    figure = Figure(figsize=(lefts[-1] + width + 0.2, 2.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.1, lefts[-1] + width + 0.1), ylim=(0.0, 2.4))
    axes.set_axis_off()
    colour, half = _WINGS["data | simulation"], 0.51
    _box(axes, (0.0, top - half, width, half), colour, "data", "recorded cycles")
    _box(axes, (0.0, bottom, width, half), colour, "simulation", "scene to recording")
    wings = ["data | simulation", *(step[0] for step in _STEPS)]
    for left, (wing, what, how, _) in zip(lefts[1:], _STEPS, strict=True):
        _box(axes, (left, bottom, width, top - bottom), _WINGS[wing], what, how)
        start, end = ((left - away, (bottom + top) / 2) for away in (0.34, 0.02))
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": _GREY})
    for left, shape in zip(lefts, ["[C, T]", *(step[3] for step in _STEPS)], strict=True):
        style: dict[str, Any] = {"ha": "center", "va": "center", "family": "monospace"}
        axes.text(left + width / 2, 0.45, shape, fontsize=_TEXT, **style)
    for wing, colour in _WINGS.items():
        ends = [left for left, name in zip(lefts, wings, strict=True) if name == wing]
        axes.plot([ends[0], ends[-1] + width], [2.0, 2.0], color=colour, linewidth=2.5)
        centre = (ends[0] + ends[-1] + width) / 2
        axes.text(centre, 2.2, wing, ha="center", va="center", fontsize=11, fontweight="bold")
    axes.text(lefts[0], 0.15, "C channels, T samples, N bins", fontsize=_SMALL, color=_GREY)
    _save(figure, path)


def _box(
    axes: Axes, place: tuple[float, float, float, float], colour: str, what: str, how: str
) -> None:
    """A rounded box at (left, bottom, width, height): a bold line above one or two plain ones."""
    left, bottom, width, height = place
    outline = FancyBboxPatch(place[:2], width, height, "round,pad=0,rounding_size=0.07")
    axes.add_patch(outline).set(linewidth=1.3, ec=colour, fc=to_rgba(colour, 0.13))
    centre, middle = left + width / 2, bottom + height / 2
    rise = 0.085 * (1 + how.count("\n"))
    style: dict[str, Any] = {"ha": "center", "va": "center"}
    axes.text(centre, middle + rise, what, fontsize=_TEXT, fontweight="bold", **style)
    axes.text(centre, middle - 0.1, how, fontsize=_SMALL, linespacing=1.25, **style)


def _titled(title: str, simulated: bool) -> str:
    return f"{title} (simulated data)" if simulated else title


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100 * fraction:.2f} %"


def _save(figure: Figure, path: str | Path) -> None:
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=180, facecolor="white")
