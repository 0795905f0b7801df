"""The figure of selected features: how many come from where, the paper's counts beside.

Blue is PVDF and orange is SG throughout (Okabe and Ito's colour-blind-safe palette), other kinds of
channels take the colours left; what the paper published is hatched, and stands beside its own hand
alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from tactslip_torch.report import published
from tactslip_torch.runtime import whole_file

_KIND_COLOURS = {"SG": "#E69F00", "PVDF": "#0072B2"}
_OTHER_COLOURS = ("#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#666666")
_DOMAIN_COLOURS = {"time": "#CC79A7", "freq": "#009E73"}
_DOMAIN_WORDS = {"time": "time domain", "freq": "frequency domain"}
_COMPONENTS = ("raw", "A1", "A2", "A3", "A4", "D1", "D2", "D3", "D4")
_GREY, _GRID = "#666666", "#DDDDDD"
_TITLE, _TEXT, _SMALL = 13, 10, 9  # font sizes in points
_COUNT_STYLE: dict[str, Any] = {"padding": 2, "fontsize": _SMALL, "color": _GREY}


def selected_features_figure(
    selected: Sequence[Mapping[str, str]], path: str | Path, *, simulated: bool
) -> None:
    """Write where the selected features come from: four panels, the paper's counts beside.

    By sensor kind, by signal component, by finger, and by descriptor. For components and
    descriptors the paper prints no counts, so words and the order of its ranking stand in.
    Features of another hand than the paper's stand alone.

    Args:
        selected: one mapping per feature with ``channel``, ``component``, ``domain``,
            ``descriptor``, ``kind`` and ``finger``; of a pooled one ``statistic``, which then
            stands in place of the finger.
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
    figure.suptitle(f"{title} (simulated data)" if simulated else title, fontsize=_TITLE)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.15, 1])
    kind, component, finger = (figure.add_subplot(grid[row, 0]) for row in range(3))

    is_papers = published.is_of_papers_hand(selected)
    colours = _kind_colours(selected)
    by_kind = {name: {name: count} for name, count in published.SELECTED_BY_KIND.items()}
    by_finger = published.SELECTED_BY_FINGER
    if not is_papers:
        by_kind, by_finger = {}, {}

    pairs = [(feature["kind"], feature["kind"]) for feature in selected]
    _stacked_bars(kind, pairs, list(colours), colours, by_kind)
    _tidy(kind, "y", "(a) sensor kind")

    pairs = [(feature["domain"], feature["component"]) for feature in selected]
    _stacked_bars(component, pairs, list(_COMPONENTS), _DOMAIN_COLOURS, {})
    _tidy(component, "y", "(b) signal component")
    if is_papers:
        words = f"paper: {published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
        component.set_xlabel(words, fontsize=_SMALL, color=_GREY)

    is_pooled = any(feature.get("statistic") for feature in selected)
    pairs = [(f["kind"], f.get("statistic") or f["finger"]) for f in selected]
    _stacked_bars(finger, pairs, list(by_finger.get("SG", ())), colours, by_finger)
    _tidy(finger, "y", "(c) statistic over channels" if is_pooled else "(c) finger")
    _descriptor_bars(figure.add_subplot(grid[:, 1]), selected, colours, is_papers)
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=180, facecolor="white")


def _kind_colours(selected: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """A colour for every kind of channel: the paper's two, if one of them is there, and others."""
    kinds = {feature["kind"] for feature in selected}
    colours = dict(_KIND_COLOURS) if kinds & set(_KIND_COLOURS) else {}
    return colours | dict(zip(sorted(kinds - set(colours)), cycle(_OTHER_COLOURS)))


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


def _descriptor_bars(
    axes: Axes,
    selected: Sequence[Mapping[str, str]],
    colours: Mapping[str, str],
    is_papers: bool,
) -> None:
    """Counts by descriptor, from top to bottom in the order in which the paper ranks them."""
    counts = Counter((feature["kind"], feature["descriptor"]) for feature in selected)
    names = [*published.DESCRIPTORS_RANKED, *published.DESCRIPTORS_NEVER]
    names += sorted({descriptor for _, descriptor in counts} - set(names))
    ranks = {name: f"{rank}" for rank, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    at, ours = np.arange(len(names)), np.zeros(len(names))
    for kind, colour in colours.items():
        lengths = np.array([counts[kind, name] for name in names])
        bars = axes.barh(at, lengths, 0.66, left=ours, color=colour, label=kind)
        ours += lengths
    axes.bar_label(bars, [f"{count:.0f}" for count in ours], **_COUNT_STYLE)
    beside = [f"  [{ranks.get(name, '-')}]" if is_papers else "" for name in names]
    labels = [name.replace("_", " ") + rank for name, rank in zip(names, beside, strict=True)]
    axes.set_yticks(at, labels, fontsize=_TEXT)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(0, 1.1 * ours.max())
    unit, title = "features", "(d) descriptor"
    if is_papers:
        unit, title = f"{unit}; the paper never selects [-]", f"{title}  [rank in the paper]"
    axes.set_xlabel(unit, fontsize=_SMALL, color=_GREY)
    _tidy(axes, "x", title)


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
