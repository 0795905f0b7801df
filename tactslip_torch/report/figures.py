"""Figures of a run as PNG files: confusion matrices, selected features, and the pipeline itself.

Drawn on matplotlib's ``Figure`` objects, so that no window opens and no global state changes.
Blue is PVDF and orange is SG throughout (Okabe and Ito's colour-blind-safe palette); what the
paper published is hatched.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from tactslip_torch.files import whole_file
from tactslip_torch.report import published

_KIND_COLOURS = {"SG": "#E69F00", "PVDF": "#0072B2"}
_DOMAIN_COLOURS = {"time": "#CC79A7", "freq": "#009E73"}
_DOMAIN_WORDS = {"time": "time domain", "freq": "frequency domain"}
_COMPONENTS = ("raw", "A1", "A2", "A3", "A4", "D1", "D2", "D3", "D4")
_INK, _GREY, _GRID = "#222222", "#666666", "#DDDDDD"
_TITLE, _TEXT, _SMALL = 13, 10, 9  # font sizes in points
_COUNT_STYLE: dict[str, Any] = {"padding": 2, "fontsize": _SMALL, "color": _GREY}


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
    for place, (name, scores) in enumerate(splits.items()):
        panel = figure.add_subplot(grid[place // num_columns, place % num_columns])
        _confusion_panel(panel, name, scores)
    _save(figure, path)


def _confusion_panel(axes: Axes, name: str, scores: Mapping[str, Any]) -> None:
    """One split's 2 x 2 cells, coloured by the percentage of their row."""
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
    axes.set_xlabel(f"prediction\n{_caption(name, scores)}", fontsize=_SMALL, color=_GREY)


def _caption(split: str, scores: Mapping[str, Any]) -> str:
    """The paper's numbers beside a split's, in two short lines; empty where it has none."""
    paper = published.beside(split, scores)
    if paper is None:
        return "\n"
    if paper.non_slip_recall is None or paper.slip_recall is None:
        return f"paper: accuracy {_percent(paper.accuracy)}\n"
    recalls = f"non-slip {paper.non_slip_recall:.1%}, slip {paper.slip_recall:.1%}"
    return f"paper: {recalls.replace('%', ' %')}\n{_accuracies(vars(paper))}"


def _accuracies(scores: Mapping[str, Any]) -> str:
    balanced = _percent(scores["balanced_accuracy"])
    return f"accuracy {_percent(scores['accuracy'])}, balanced {balanced}"


def selected_features_figure(
    selected: Sequence[Mapping[str, str]], path: str | Path, *, simulated: bool
) -> None:
    """Write where the selected features come from: four panels, the paper's counts beside.

    By sensor kind, by signal component, by finger, and by descriptor. For components and
    descriptors the paper prints no counts, so words and the order of its ranking stand in.

    Args:
        selected: one mapping per feature with ``channel``, ``component``, ``domain``,
            ``descriptor``, ``kind`` and ``finger``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the bins they were ranked on are.

    Raises:
        ValueError: if nothing is selected.
    """
    if not selected:
        raise ValueError("there is no selected feature to draw")
    spacing = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.1, wspace=0.03, hspace=0.04)
    figure = Figure(figsize=(12.0, 8.4), layout=spacing)
    title = f"Where the {len(selected)} selected features come from"
    figure.suptitle(_titled(title, simulated), fontsize=_TITLE)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.15, 1])
    kind, component, finger = (figure.add_subplot(grid[row, 0]) for row in range(3))

    pairs = [(feature["kind"], feature["kind"]) for feature in selected]
    by_kind = {name: {name: count} for name, count in published.SELECTED_BY_KIND.items()}
    _stacked_bars(kind, pairs, list(_KIND_COLOURS), _KIND_COLOURS, by_kind)
    _tidy(kind, "y", "(a) sensor kind")

    pairs = [(feature["domain"], feature["component"]) for feature in selected]
    _stacked_bars(component, pairs, list(_COMPONENTS), _DOMAIN_COLOURS, {})
    _tidy(component, "y", "(b) signal component")
    words = f"paper: {published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
    component.set_xlabel(words, fontsize=_SMALL, color=_GREY)

    pairs = [(feature["kind"], feature["finger"]) for feature in selected]
    by_finger = published.SELECTED_BY_FINGER
    _stacked_bars(finger, pairs, list(by_finger["SG"]), _KIND_COLOURS, by_finger)
    _tidy(finger, "y", "(c) finger")
    _descriptor_bars(figure.add_subplot(grid[:, 1]), selected)
    _save(figure, path)


def _stacked_bars(
    axes: Axes,
    pairs: Sequence[tuple[str, str]],
    order: Sequence[str],
    colours: Mapping[str, str],
    of_paper: Mapping[str, Mapping[str, int]],
) -> None:
    """Counts of (layer, column) pairs as stacked bars, the paper's hatched beside them."""
    columns = [*order, *sorted({column for _, column in pairs} - set(order))]
    counts = Counter(pairs)
    width = 0.36 if of_paper else 0.6
    at = np.arange(len(columns)) - (0.2 if of_paper else 0.0)
    ours, paper = np.zeros(len(columns)), np.zeros(len(columns))
    for layer, colour in colours.items():
        heights = np.array([counts[layer, column] for column in columns])
        label = _DOMAIN_WORDS.get(layer, layer)
        bars = axes.bar(at, heights, width, bottom=ours, color=colour, label=label)
        ours += heights
    axes.bar_label(bars, [f"{count:.0f}" for count in ours], **_COUNT_STYLE)
    for layer, colour in colours.items() if of_paper else ():
        heights = np.array([of_paper[layer].get(column, 0) for column in columns])
        style: dict[str, Any] = {"facecolor": "white", "edgecolor": colour, "hatch": "////"}
        has = heights > 0  # an empty bar would still draw its outline
        style |= {"bottom": paper[has], "label": f"{layer}, paper"}
        axes.bar(at[has] + 0.4, heights[has], width, **style)
        paper += heights
    if of_paper:
        tops = axes.bar(at + 0.4, 0.0, width, bottom=paper, color="none")
        axes.bar_label(tops, [f"{count:.0f}" for count in paper], **_COUNT_STYLE)
    axes.set_xticks(range(len(columns)), columns, fontsize=_TEXT)
    axes.set_ylim(0, 1.16 * max(ours.max(), paper.max()))
    axes.set_ylabel("features", fontsize=_SMALL, color=_GREY)


def _descriptor_bars(axes: Axes, selected: Sequence[Mapping[str, str]]) -> None:
    """Counts by descriptor, from top to bottom in the order in which the paper ranks them."""
    counts = Counter((feature["kind"], feature["descriptor"]) for feature in selected)
    names = [*published.DESCRIPTORS_RANKED, *published.DESCRIPTORS_NEVER]
    names += sorted({descriptor for _, descriptor in counts} - set(names))
    ranks = {name: f"{rank}" for rank, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    at, ours = np.arange(len(names)), np.zeros(len(names))
    for kind, colour in _KIND_COLOURS.items():
        lengths = np.array([counts[kind, name] for name in names])
        bars = axes.barh(at, lengths, 0.66, left=ours, color=colour, label=kind)
        ours += lengths
    axes.bar_label(bars, [f"{count:.0f}" for count in ours], **_COUNT_STYLE)
    labels = [f"{name.replace('_', ' ')}  [{ranks.get(name, '-')}]" for name in names]
    axes.set_yticks(at, labels, fontsize=_TEXT)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(0, 1.1 * ours.max())
    axes.set_xlabel("features; the paper never selects [-]", fontsize=_SMALL, color=_GREY)
    _tidy(axes, "x", "(d) descriptor  [rank in the paper]")


def _tidy(axes: Axes, counted: Literal["x", "y"], title: str) -> None:
    """Title, legend beside it, whole numbers on the counted axis, a light grid, no box."""
    axes.set_title(title, loc="left", fontsize=_TEXT + 1)
    axis = axes.yaxis if counted == "y" else axes.xaxis
    axis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    axes.grid(axis=counted, color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=0)
    axes.tick_params(axis=counted, labelsize=_SMALL, labelcolor=_GREY)
    axes.spines[["top", "right", "left" if counted == "y" else "bottom"]].set_visible(False)
    axes.legend(
        frameon=False, fontsize=_SMALL, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.3, columnspacing=1.2, handlelength=1.4, handletextpad=0.5,
    )  # fmt: skip


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
