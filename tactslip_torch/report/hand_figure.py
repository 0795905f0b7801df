"""The figure of sensors that matter: the hand shaded, what absence costs, and the best few."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.report.hand_drawing import draw_hand, draw_shades, kind_colours
from tactslip_torch.report.sensors import ANEW_WORDS, ROLE_WORDS
from tactslip_torch.runtime import whole_file

_ROLE_COLOURS = {"held_out": "#666666", "test": "#009E73", "unseen": "#D55E00"}
_GREY, _GRID, _INK = "#666666", "#DDDDDD", "#222222"
_TITLE, _TEXT, _SMALL = 13, 10, 8.5  # points
_MOST_CHANNELS = 24  # whose absence is drawn, the dearest first


def sensors_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write the figure: two hands, the cost of absence, and accuracy against how many sensors.

    Args:
        content: of ``sensors.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = Figure(figsize=(13.6, 11.4))
    kind = " (simulated hand and recordings)" if content["simulated"] else ""
    figure.suptitle(f"Which sensors matter{kind}", fontsize=_TITLE, x=0.03, ha="left", y=0.98)
    grid = figure.add_gridspec(
        2, 3, width_ratios=[1, 1, 0.62], height_ratios=[1.45, 1],
        left=0.05, right=0.985, top=0.925, bottom=0.09, wspace=0.1, hspace=0.24,
    )  # fmt: skip
    channels = {row["name"]: row for row in content["units"] if row["unit"] == "channel"}
    moved = {name: _both(row["gradient"]) for name, row in channels.items()}
    alone = {name: 100 * row["alone"]["held_out"] for name, row in channels.items()}
    most, num_kinds = max(moved.values()), len(kind_colours(content["channels"]))
    panels = (
        ("(a) the trained detector moves with it", moved, (0.0, most or 1.0), "{:.1f}",
         "gradient times own spread, sd of the score; 0: not in use"),
        ("(b) what it tells alone", alone, (50.0, max(*alone.values(), 51.0)), "{:.0f}",
         "balanced accuracy with this channel alone, held-out, %"),
    )  # fmt: skip
    for column, (title, values, limits, written, unit) in enumerate(panels):
        axes = figure.add_subplot(grid[0, column])
        axes.set_title(title, loc="left", fontsize=_TEXT + 1)
        draw_hand(axes, content["channels"], values, limits, written)
        strips = axes.inset_axes((0.14, 0.0, 0.56, 0.026 * num_kinds))
        draw_shades(strips, content["channels"], limits, unit)
    _absences(figure.add_subplot(grid[0, 2]), content)
    _best_few(figure.add_subplot(grid[1, :]), content)
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, format="png", dpi=160, facecolor="white")


def _both(gradient: Mapping[str, float]) -> float:
    """Root mean square over both classes, which count alike."""
    return float(np.sqrt((gradient["non_slip"] ** 2 + gradient["slip"] ** 2) / 2))


def _absences(axes: Axes, content: Mapping[str, Any]) -> None:
    """Points lost without a channel or finger in use, features as selected, with intervals."""
    rows = [
        row
        for row in content["units"]
        if row["features_in_use"] and row["unit"] in ("channel", "finger")
    ]
    rows.sort(key=lambda row: -row["lost"]["held_out"]["lost"])
    of_fingers = [row for row in rows if row["unit"] == "finger"]
    rows = [row for row in rows if row["unit"] == "channel"][:_MOST_CHANNELS] + of_fingers
    roles = [role for role in ("held_out", "unseen") if role in content["num_bins"]]
    for number, role in enumerate(roles):
        at = np.arange(len(rows)) + 0.3 * (number - (len(roles) - 1) / 2)
        numbers = [row["lost"][role] for row in rows]
        lost = np.array([100 * one["lost"] for one in numbers])
        ends = [(100 * one["low"], 100 * one["high"]) for one in numbers]
        colour = _ROLE_COLOURS[role]
        axes.hlines(at, *np.array(ends).T, color=colour, linewidth=1.2, alpha=0.6)
        axes.plot(lost, at, "o", color=colour, markersize=4.2, label=ROLE_WORDS[role])
    axes.axvline(0, color=_INK, linewidth=0.8)
    axes.set_yticks(range(len(rows)), [row["name"] for row in rows], fontsize=_SMALL)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    if 0 < len(of_fingers) < len(rows):
        axes.axhline(len(rows) - len(of_fingers) - 0.5, color=_GREY, linewidth=0.8, linestyle=":")
    axes.set_title("(c) lost without it", loc="left", fontsize=_TEXT + 1)
    axes.set_xlabel("points of balanced accuracy, 95 % intervals", fontsize=_SMALL, color=_GREY)
    _tidy(axes, "x")
    axes.legend(
        frameon=False, fontsize=_SMALL, loc="lower right", bbox_to_anchor=(1.03, 0.995),
        handletextpad=0.3, borderaxespad=0.3, labelspacing=0.2,
    )  # fmt: skip


def _best_few(axes: Axes, content: Mapping[str, Any]) -> None:
    """Accuracy against the number of channels, their names in the order in which they join."""
    steps, whole = content["best"]["channel"], content["with_all"]["selected_anew"]
    kinds = {row["name"]: row["kind"] for row in content["channels"]}
    colours = kind_colours(content["channels"])
    at = np.arange(1, len(steps) + 1)
    for role in content["num_bins"]:
        colour, of_all = _ROLE_COLOURS[role], 100 * whole["balanced_accuracy"][role]
        kept = np.array([100 * step["balanced_accuracy"][role] for step in steps])
        low = [of_all - 100 * step["lost"][role]["high"] for step in steps]
        high = [of_all - 100 * step["lost"][role]["low"] for step in steps]
        axes.axhline(of_all, color=colour, linewidth=1, linestyle=":")
        axes.fill_between(at, low, high, color=colour, alpha=0.12, linewidth=0)
        style = "--" if role == "held_out" else "-"
        word = "held-out (it chose the order)" if role == "held_out" else ROLE_WORDS[role]
        axes.plot(at, kept, style, color=colour, marker="o", markersize=4.5, label=word)
    axes.plot([], [], ":", color=_GREY, label="all sensors")
    axes.set_xticks(at, [f"+{step['joins']}" for step in steps], rotation=50, fontsize=_SMALL)
    for label, step in zip(axes.get_xticklabels(), steps, strict=True):
        label.set_color(colours[kinds[step["joins"]]])
        label.set_fontweight("bold")
    axes.set_xlim(0.5, len(steps) + 0.5)
    way = ANEW_WORDS[content["settings"]["anew"]]
    title = f"(d) the best few, in the order in which they serve held-out groups; features {way}"
    axes.set_title(title, loc="left", fontsize=_TEXT + 1)
    axes.set_ylabel("balanced accuracy, %", fontsize=_SMALL, color=_GREY)
    words = "bands: 95 % intervals of the difference to all sensors, over recordings"
    axes.set_xlabel(words, fontsize=_SMALL, color=_GREY)
    _tidy(axes, "y")
    axes.legend(frameon=False, fontsize=_SMALL, loc="best", ncols=2)


def _tidy(axes: Axes, gridded: Any) -> None:
    axes.grid(axis=gridded, color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=_SMALL)
    axes.spines[["top", "right"]].set_visible(False)
