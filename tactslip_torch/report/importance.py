"""Sensor importance: tables, CSV and a figure of ``sensors.json``.

The figure draws a hand of any layout: fingers stand side by side on a palm, tips up; a finger
called thumb leans out from its side. In each segment slowly adapting channels are squares and fast
ones discs, in the colour of their kind, the deeper the larger the number.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Patch
from matplotlib.transforms import Affine2D, Transform

from tactslip_torch.report.style import (
    GREEN,
    GREY,
    INK,
    SMALL,
    VERMILION,
    clean,
    kind_colours,
    lanes,
    marked,
    percent,
    save,
    table,
    words,
)
from tactslip_torch.runtime import whole_file

Row = Mapping[str, str]
"""A channel as ``HandLayout.to_rows`` has it."""
ROLE_WORDS = {"held_out": "held-out", "test": "test", "unseen": "unseen"}
"""What the roles are called; ``held_out`` bins are training bins of groups left out in turn."""
RESELECT_WORDS = {
    "ranked": "by the recipe's ranking, in which strong channels leave no room for others",
    "shared": "as many of each channel",
}
BEST_LINE = (
    "best few, greedily by held-out accuracy (which is optimistic for it; test and unseen choose "
    "nothing):"
)
_ROLE_COLOURS = {"held_out": GREY, "test": GREEN, "unseen": VERMILION}
_MOST_CHANNELS = 24  # whose absence is drawn, the most important first


# Tables ------------------------------------------------------------------------------------------
def sensors_table(content: Mapping[str, Any]) -> str:
    """One row per channel, finger and kind: gradients, what its absence costs, it alone.

    Args:
        content: of ``sensors.json``.
    """
    tables = [table(unit_rows(content, unit)) for unit in content["best"]]
    head = [*lines_about(content), with_all_line(content)]
    return marked(content["simulated"], *head, "", "\n\n".join(tables))


def lines_about(content: Mapping[str, Any]) -> list[str]:
    """What the columns mean."""
    return [
        f"balanced accuracy, mean over groups; machines of {content['num_bins']['held_out']} "
        "training bins; held-out: each of the groups "
        f"{', '.join(content['groups']['held_out'])} left out",
        "moves score: root mean square of gradient times own spread, in sd of the score, at "
        "non-slip / slip bins",
        "lost: points of balanced accuracy without it, [95 % of draws of recordings]; reselected: "
        "features selected again among the others, "
        + RESELECT_WORDS[content["settings"]["reselect"]],
    ]


def unit_rows(content: Mapping[str, Any], unit: str) -> list[list[str]]:
    """A header, and a row for each channel, finger or kind."""
    roles = list(content["num_bins"])
    rows = [[unit, "in use", "moves score"]]
    rows[0] += [f"{what} {ROLE_WORDS[role]}" for what in ("lost", "reselected") for role in roles]
    rows[0].append("alone, held-out %")
    for row in content["units"]:
        if row["unit"] == unit:
            by_class = row["gradient"] or {}
            moved = " / ".join(f"{value:.2f}" for value in by_class.values()) or "-"
            cells = [row["name"], str(row["features_in_use"]), moved]
            cells += [
                _interval(row[key][role]) for key in ("lost", "lost_reselected") for role in roles
            ]
            rows.append([*cells, percent(row["alone"]["held_out"])])
    return rows


def with_all_line(content: Mapping[str, Any]) -> str:
    """What is reached with all sensors, in words."""
    reached = []
    for name, result in content["with_all"].items():
        scores = result["balanced_accuracy"].items()
        listed = ", ".join(f"{ROLE_WORDS[role]} {percent(score)}" for role, score in scores)
        reached.append(f"{words(name)}: {listed} %")
    return "all sensors, features " + "; ".join(reached)


def best_table(content: Mapping[str, Any]) -> str:
    """Accuracy kept with the best few, in the order in which they join; of all units."""
    tables = [table(best_rows(content, unit), num_left=2) for unit in content["best"]]
    return f"{BEST_LINE}\n\n" + "\n\n".join(tables)


def best_rows(content: Mapping[str, Any], unit: str) -> list[list[str]]:
    """A header, and a row for each step of the best few."""
    roles = list(content["num_bins"])
    rows = [[f"{unit}s", "joins", "features", *(f"{ROLE_WORDS[role]} %" for role in roles)]]
    rows[0] += [f"lost {ROLE_WORDS[role]}" for role in roles]
    for number, step in enumerate(content["best"][unit], 1):
        scores = [percent(step["balanced_accuracy"][role]) for role in roles]
        cells = [str(number), step["joins"], str(step["num_features"])]
        rows.append([*cells, *scores, *(_interval(step["lost"][role]) for role in roles)])
    return rows


def sensors_csv(content: Mapping[str, Any], path: str | Path) -> None:
    """Write one row per channel, finger and kind, all of its numbers in columns.

    Args:
        content: of ``sensors.json``.
        path: of the file, replaced as a whole if it exists.
    """
    order = {
        (unit, step["joins"]): number
        for unit, steps in content["best"].items()
        for number, step in enumerate(steps, 1)
    }
    rows = []
    for row in content["units"]:
        flat = {name: row[name] for name in ("unit", "name", "num_channels", "features_in_use")}
        flat["joins_as"] = order.get((row["unit"], row["name"]))
        for at in ("non_slip", "slip"):
            flat[f"moves_score_{at}"] = (row["gradient"] or {}).get(at)
        for what in ("lost", "lost_reselected"):
            for role, numbers in row[what].items():
                flat |= {f"{what}_{role}_{end}": value for end, value in numbers.items()}
        flat |= {f"alone_{role}": value for role, value in row["alone"].items()}
        rows.append(flat | {"simulated": content["simulated"]})
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _interval(lost: Mapping[str, float]) -> str:
    return "{lost:+.2f} [{low:+.2f}, {high:+.2f}]".format(**{k: 100 * v for k, v in lost.items()})


# Figure ------------------------------------------------------------------------------------------
def sensors_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write the figure: two hands, the cost of absence, and accuracy against how many sensors.

    Args:
        content: of ``sensors.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = Figure(figsize=(13.6, 11.4))
    kind = " (SIMULATED hand and recordings)" if content["simulated"] else ""
    figure.suptitle(f"Which sensors matter{kind}", fontsize=13, x=0.03, ha="left", y=0.98)
    grid = figure.add_gridspec(
        2, 3, width_ratios=[1, 1, 0.62], height_ratios=[1.45, 1],
        left=0.05, right=0.985, top=0.925, bottom=0.09, wspace=0.1, hspace=0.24,
    )  # fmt: skip
    channels = {row["name"]: row for row in content["units"] if row["unit"] == "channel"}
    moved = {}
    for name, row in channels.items():  # root mean square over both classes, which count alike
        moved[name] = math.hypot(row["gradient"]["non_slip"], row["gradient"]["slip"]) / 2**0.5
    alone = {name: 100 * row["alone"]["held_out"] for name, row in channels.items()}
    moves = _Hand(content["channels"], moved, (0.0, max(moved.values()) or 1.0), "{:.1f}")
    tells = _Hand(content["channels"], alone, (50.0, max(*alone.values(), 51.0)), "{:.0f}")
    axes = figure.add_subplot(grid[0, 0])
    axes.set_title("(a) the trained detector moves with it", loc="left", fontsize=11)
    moves.draw(axes, "gradient times own spread, sd of the score; 0: not in use")
    axes = figure.add_subplot(grid[0, 1])
    axes.set_title("(b) with it alone", loc="left", fontsize=11)
    tells.draw(axes, "balanced accuracy with this channel alone, held-out, %")
    _absences(figure.add_subplot(grid[0, 2]), content)
    _best_few(figure.add_subplot(grid[1, :]), content)
    save(figure, path)


def _absences(axes: Axes, content: Mapping[str, Any]) -> None:
    """Points lost without a channel or finger in use, features as selected, with intervals."""
    used = [row for row in content["units"] if row["features_in_use"]]
    used.sort(key=lambda row: -float(row["lost"]["held_out"]["lost"]))
    fingers = [row for row in used if row["unit"] == "finger"]
    rows = [row for row in used if row["unit"] == "channel"][:_MOST_CHANNELS] + fingers
    roles = [role for role in ("held_out", "unseen") if role in content["num_bins"]]
    clean(axes, "x")
    for number, role in enumerate(roles):
        at = np.arange(len(rows)) + 0.3 * (number - (len(roles) - 1) / 2)
        low, lost, high = (
            [100 * row["lost"][role][end] for row in rows] for end in ("low", "lost", "high")
        )
        colour = _ROLE_COLOURS[role]
        axes.hlines(at, low, high, color=colour, linewidth=1.2, alpha=0.6)
        axes.plot(lost, at, "o", color=colour, markersize=4.2, label=ROLE_WORDS[role])
    axes.axvline(0, color=INK, linewidth=0.8)
    lanes(axes, [row["name"] for row in rows])
    axes.tick_params(axis="y", labelsize=SMALL)
    if 0 < len(fingers) < len(rows):
        axes.axhline(len(rows) - len(fingers) - 0.5, color=GREY, linewidth=0.8, linestyle=":")
    axes.set_title("(c) lost without it", loc="left", fontsize=11)
    axes.set_xlabel("points of balanced accuracy, 95 % intervals", fontsize=SMALL, color=GREY)
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.03, 0.995)}
    axes.legend(frameon=False, fontsize=SMALL, handletextpad=0.3, labelspacing=0.2, **place)


def _best_few(axes: Axes, content: Mapping[str, Any]) -> None:
    """Accuracy against the number of channels, their names in the order in which they join."""
    steps, whole = content["best"]["channel"], content["with_all"]["reselected"]
    kinds = {row["name"]: row["kind"] for row in content["channels"]}
    colours = kind_colours(kinds.values())
    at = np.arange(1, len(steps) + 1)
    for role in content["num_bins"]:
        colour, of_all = _ROLE_COLOURS[role], 100 * whole["balanced_accuracy"][role]
        kept = [100 * step["balanced_accuracy"][role] for step in steps]
        low = [of_all - 100 * step["lost"][role]["high"] for step in steps]
        high = [of_all - 100 * step["lost"][role]["low"] for step in steps]
        axes.axhline(of_all, color=colour, linewidth=1, linestyle=":")
        axes.fill_between(at, low, high, color=colour, alpha=0.12, linewidth=0)
        chose = role == "held_out"
        label = "held-out (it chose the order)" if chose else ROLE_WORDS[role]
        line = "o--" if chose else "o-"
        axes.plot(at, kept, line, color=colour, markersize=4.5, label=label)
    axes.plot([], [], ":", color=GREY, label="all sensors")
    clean(axes, "y")
    axes.set_xticks(at, [f"+{step['joins']}" for step in steps], rotation=50, fontsize=SMALL)
    for tick, step in zip(axes.get_xticklabels(), steps, strict=True):
        tick.set(color=colours[kinds[step["joins"]]], fontweight="bold")
    axes.set_xlim(0.5, len(steps) + 0.5)
    how = RESELECT_WORDS[content["settings"]["reselect"]]
    title = f"(d) the best few, in the order in which they serve held-out groups; features {how}"
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_ylabel("balanced accuracy, %", fontsize=SMALL, color=GREY)
    text = "bands: 95 % intervals of the difference to all sensors, over recordings"
    axes.set_xlabel(text, fontsize=SMALL, color=GREY)
    axes.legend(frameon=False, fontsize=SMALL, loc="best", ncols=2)


# The hand ----------------------------------------------------------------------------------------
_SKIN, _EDGE, _PALE = "#F6F1EA", "#C9BEAF", "#FFFFFF"
_FROM_TIP = ("tip", "distal", "intermediate", "middle", "proximal", "base", "palm")
_DROP = {"little": 0.4, "ring": 0.12, "index": 0.1}  # of a root below that of the middle finger
_WIDTH, _HEIGHT = 0.92, 0.94  # of a segment
_MOST_NAMED = 4  # channels of a segment that still have room for name and number


class _Finger(NamedTuple):
    name: str
    segments: list[list[Row]]  # from the tip
    place: Affine2D  # from its own axes, root at 0, to those of the hand
    degrees: float


class _Hand:
    """A hand whose channels are shaded by a number.

    Args:
        channels: of the hand, in order; fingers stand in the order in which they first occur.
        values: by channel.
        limits: values of the palest and of the deepest shade.
        written: how a value is written into its mark, where there is room.
    """

    def __init__(
        self,
        channels: Sequence[Row],
        values: Mapping[str, float],
        limits: tuple[float, float],
        written: str,
    ) -> None:
        self._channels, self._values = channels, values
        self._limits, self._written = limits, written
        self._colours = kind_colours(row["kind"] for row in channels)

    def draw(self, axes: Axes, unit: str) -> None:
        """Draw it, with its shades and the unit of the values below."""
        fingers = _fingers(self._channels)
        straight = max(1, sum(finger.degrees == 0 for finger in fingers))
        left, right = -_WIDTH / 2 - 0.04, straight - 1 + _WIDTH / 2 + 0.04
        depth = 0.5 + 0.31 * straight
        _box(axes, (left, -0.03 - depth), (right - left, depth), axes.transData, 0.3)
        for finger in fingers:
            for number, segment in enumerate(reversed(finger.segments)):
                corner = (-_WIDTH / 2, number + (1 - _HEIGHT) / 2)
                _box(axes, corner, (_WIDTH, _HEIGHT), finger.place + axes.transData, 0.2)
                self._draw_segment(axes, finger, segment, number + 0.5)
            x, y = finger.place.transform((0.0, len(finger.segments) + 0.2))
            axes.text(x, y, finger.name, ha="center", va="center", fontsize=9, color=INK)
        tops = [finger.place.transform((0.0, len(finger.segments) + 0.4)) for finger in fingers]
        axes.set_xlim(-0.75, max(right + 0.2, *(float(x) + 0.55 for x, _ in tops)))
        axes.set_ylim(-0.7 - depth, max(float(y) for _, y in tops))
        axes.set_aspect("equal", anchor="N")
        axes.axis("off")
        self._draw_shades(axes.inset_axes((0.14, 0.0, 0.56, 0.026 * len(self._colours))), unit)

    def _draw_segment(
        self, axes: Axes, finger: _Finger, segment: Sequence[Row], middle: float
    ) -> None:
        """A mark for each channel, in lines; named where there is room."""
        columns = math.ceil(math.sqrt(len(segment)))
        lines = math.ceil(len(segment) / columns)
        pitch = 0.86 / max(columns, lines, 2)
        radius = 0.44 * pitch
        is_named = len(segment) <= _MOST_NAMED
        placed = finger.place + axes.transData
        centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6.5}
        centred["transform"] = placed
        for number, row in enumerate(sorted(segment, key=_is_fast)):
            line, column = divmod(number, columns)
            in_line = min(columns, len(segment) - line * columns)
            x = pitch * (column - (in_line - 1) / 2)
            y = middle - pitch * (line - (lines - 1) / 2) - (0.06 if is_named else 0.0)
            colour, value = self._colours[row["kind"]], self._values[row["name"]]
            low, high = self._limits
            depth = min(max((value - low) / (high - low), 0.0), 1.0) if high > low else 0.0
            fill = _shade(colour, depth)
            mark: Patch = Circle((x, y), radius)
            if not _is_fast(row):
                shape = f"round,pad=0,rounding_size={0.25 * radius}"
                corner, side = (x - 0.9 * radius, y - 0.9 * radius), 1.8 * radius
                mark = FancyBboxPatch(corner, side, side, boxstyle=shape)
            mark.set(facecolor=fill, edgecolor=colour, linewidth=0.9, transform=placed)
            axes.add_patch(mark)
            if is_named:
                ink = _PALE if np.dot(fill, (0.299, 0.587, 0.114)) < 0.55 else INK
                text = self._written.format(value) if value else "0"
                axes.text(x, y, text, color=ink, **centred)
                turned: dict[str, Any] = {"color": GREY, "rotation": finger.degrees}
                axes.text(x, y + radius + 0.1, row["name"], **turned, **centred)

    def _draw_shades(self, axes: Axes, unit: str) -> None:
        """The shades of each kind as strips, with what the palest and the deepest stand for."""
        fast = {row["kind"]: _is_fast(row) for row in self._channels}
        depths = np.linspace(0, 1, 128)
        strips = [[_shade(colour, depth) for depth in depths] for colour in self._colours.values()]
        axes.imshow(strips, aspect="auto", extent=(*self._limits, len(strips), 0))
        names = [f"{kind} {'●' if fast[kind] else '■'}" for kind in self._colours]
        axes.set_yticks(np.arange(len(strips)) + 0.5, names, fontsize=8)
        axes.tick_params(length=0, labelsize=8)
        axes.set_xlabel(unit, fontsize=8, color=GREY, labelpad=2)
        axes.spines[:].set_visible(False)


def _fingers(channels: Sequence[Row]) -> list[_Finger]:
    """The fingers with their segments from the tip: known ones in their order, others behind."""
    by_finger: dict[str, dict[str, list[Row]]] = {}
    for row in channels:
        by_finger.setdefault(row["finger"], {}).setdefault(row["segment"], []).append(row)
    straight = [name for name in by_finger if name != "thumb"] or list(by_finger)
    fingers: list[_Finger] = []
    for name in sorted(by_finger, key=lambda name: name not in straight):  # a thumb comes last
        segments = by_finger[name]
        known = [segment for segment in _FROM_TIP if segment in segments]
        order = [*known, *(segment for segment in segments if segment not in known)]
        if name in straight:
            place, degrees = Affine2D().translate(len(fingers), -_DROP.get(name, 0.0)), 0.0
        else:
            degrees = -32.0
            place = Affine2D().rotate_deg(degrees).translate(len(straight) - 0.34, -1.3)
        fingers.append(_Finger(name, [segments[segment] for segment in order], place, degrees))
    return fingers


def _box(
    axes: Axes,
    corner: tuple[float, float],
    size: tuple[float, float],
    placed: Transform,
    rounding: float,
) -> None:
    box = FancyBboxPatch(corner, *size, boxstyle=f"round,pad=0,rounding_size={rounding}")
    box.set(facecolor=_SKIN, edgecolor=_EDGE, linewidth=1.0, transform=placed)
    axes.add_patch(box)


def _shade(colour: str, depth: float) -> tuple[float, float, float]:
    ramp = LinearSegmentedColormap.from_list("shade", [_PALE, colour])
    red, green, blue = to_rgb(ramp(depth))
    return red, green, blue


def _is_fast(row: Row) -> bool:
    return row.get("adapting", "fast" if row["kind"] == "PVDF" else "slow") == "fast"
