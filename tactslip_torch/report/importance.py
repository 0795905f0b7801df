"""Sensor importance: tables, CSV and a figure of ``sensors.json``.

The figure draws a hand of any layout: fingers stand side by side, tips up, the thumb last and
lower. In each segment slowly adapting channels are squares and fast ones discs, in the colour of
their kind, the deeper the larger the number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import FancyBboxPatch

from tactslip_torch.report import style

Row = Mapping[str, str]
"""A channel as ``HandLayout.to_rows`` has it."""
ROLE_WORDS = {"held_out": "held-out", "test": "test", "unseen": "unseen"}
"""What the roles are called; ``held_out`` bins are training bins of groups left out in turn."""
RESELECT_WORDS = {
    "ranked": "by the recipe's ranking, in which strong channels leave no place for others",
    "shared": "as many of each channel",
}
BEST_LINE = (
    "best few, greedily by held-out accuracy (which is optimistic for it; test and unseen choose "
    "nothing):"
)
_ROLE_COLOURS = {"held_out": style.GREY, "test": style.GREEN, "unseen": style.VERMILION}
_MOST_CHANNELS = 24  # whose absence is drawn, the most important first


# Tables ------------------------------------------------------------------------------------------
def sensors_table(content: Mapping[str, Any]) -> str:
    """One row per channel, finger and kind: gradients, what its absence costs, it alone.

    Args:
        content: of ``sensors.json``.
    """
    tables = [style.table(unit_rows(content, unit)) for unit in content["best"]]
    head = [*lines_about(content), with_all_line(content)]
    return style.marked(content["simulated"], *head, "", "\n\n".join(tables))


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


def unit_rows(content: Mapping[str, Any], unit: str) -> list[dict[str, object]]:
    """A row for each channel, finger or kind."""
    rows: list[dict[str, object]] = []
    for row in (row for row in content["units"] if row["unit"] == unit):
        moved = " / ".join(f"{value:.2f}" for value in (row["gradient"] or {}).values())
        cells: dict[str, object] = {unit: row["name"], "in use": row["features_in_use"]}
        cells["moves score"] = moved or "-"
        for key, title in (("lost", "lost"), ("lost_reselected", "reselected")):
            for role, lost in row[key].items():
                cells[f"{title} {ROLE_WORDS[role]}"] = _interval(lost)
        rows.append(cells | {"alone, held-out %": style.percent(row["alone"]["held_out"])})
    return rows


def with_all_line(content: Mapping[str, Any]) -> str:
    """What is reached with all sensors, in words."""
    reached = []
    for name, result in content["with_all"].items():
        scores = result["balanced_accuracy"].items()
        listed = ", ".join(f"{ROLE_WORDS[role]} {style.percent(score)}" for role, score in scores)
        reached.append(f"{style.words(name)}: {listed} %")
    return "all sensors, features " + "; ".join(reached)


def best_table(content: Mapping[str, Any]) -> str:
    """Accuracy kept with the best few, in the order in which they join; of all units."""
    tables = [style.table(best_rows(content, unit), num_left=2) for unit in content["best"]]
    return f"{BEST_LINE}\n\n" + "\n\n".join(tables)


def best_rows(content: Mapping[str, Any], unit: str) -> list[dict[str, object]]:
    """A row for each step of the best few."""
    rows: list[dict[str, object]] = []
    for number, step in enumerate(content["best"][unit], 1):
        cells: dict[str, object] = {f"{unit}s": number, "joins": step["joins"]}
        cells["features"] = step["num_features"]
        for role, score in step["balanced_accuracy"].items():
            cells[f"{ROLE_WORDS[role]} %"] = style.percent(score)
        for role, lost in step["lost"].items():
            cells[f"lost {ROLE_WORDS[role]}"] = _interval(lost)
        rows.append(cells)
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
    with style.csv_writer(path, list(rows[0])) as write:
        write(row.values() for row in rows)


def _interval(lost: Mapping[str, float]) -> str:
    return "{lost:+.2f} [{low:+.2f}, {high:+.2f}]".format(**{k: 100 * v for k, v in lost.items()})


# Figure ------------------------------------------------------------------------------------------
@style.styled
def sensors_figure(content: Mapping[str, Any], path: str | Path) -> None:
    """Write the figure: two hands, the cost of absence, and accuracy against how many sensors.

    Args:
        content: of ``sensors.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    figure = style.new_figure(13.6, 11.4, "Which sensors matter", simulated=content["simulated"])
    grid = figure.add_gridspec(2, 3, width_ratios=[1, 1, 0.62], height_ratios=[1.45, 1])
    units = {row["name"]: row for row in content["units"] if row["unit"] == "channel"}
    moved = {}
    for name, row in units.items():  # root mean square over both classes, which count alike
        moved[name] = math.hypot(row["gradient"]["non_slip"], row["gradient"]["slip"]) / 2**0.5
    alone = {name: 100 * row["alone"]["held_out"] for name, row in units.items()}
    axes = figure.add_subplot(grid[0, 0])
    axes.set_title("(a) the trained detector moves with it")
    unit = "gradient times own spread, sd of the score; 0: not in use"
    _hand(axes, content["channels"], moved, (0.0, max(moved.values()) or 1.0), "{:.1f}", unit)
    axes = figure.add_subplot(grid[0, 1])
    axes.set_title("(b) with it alone")
    unit = "balanced accuracy with this channel alone, held-out, %"
    _hand(axes, content["channels"], alone, (50.0, max(*alone.values(), 51.0)), "{:.0f}", unit)
    _absences(figure.add_subplot(grid[0, 2]), content)
    _best_few(figure.add_subplot(grid[1, :]), content)
    style.save(figure, path)


def _absences(axes: Axes, content: Mapping[str, Any]) -> None:
    """Points lost without a channel or finger in use, features as selected, with intervals."""
    used = [row for row in content["units"] if row["features_in_use"]]
    used.sort(key=lambda row: -float(row["lost"]["held_out"]["lost"]))
    fingers = [row for row in used if row["unit"] == "finger"]
    rows = [row for row in used if row["unit"] == "channel"][:_MOST_CHANNELS] + fingers
    roles = [role for role in ("held_out", "unseen") if role in content["num_bins"]]
    for number, role in enumerate(roles):
        at = np.arange(len(rows)) + 0.3 * (number - (len(roles) - 1) / 2)
        low, lost, high = (
            [100 * row["lost"][role][end] for row in rows] for end in ("low", "lost", "high")
        )
        colour = _ROLE_COLOURS[role]
        axes.hlines(at, low, high, color=colour, linewidth=1.2, alpha=0.6)
        axes.plot(lost, at, "o", color=colour, markersize=4.2, label=ROLE_WORDS[role])
    axes.axvline(0, color=style.INK, linewidth=0.8)
    style.lanes(axes, [row["name"] for row in rows])
    if 0 < len(fingers) < len(rows):
        axes.axhline(len(rows) - len(fingers) - 0.5, color=style.GREY, linewidth=0.8, linestyle=":")
    axes.set(title="(c) lost without it", xlabel="points of balanced accuracy, 95 % intervals")
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.03, 0.995)}
    axes.legend(handletextpad=0.3, labelspacing=0.2, **place)


def _best_few(axes: Axes, content: Mapping[str, Any]) -> None:
    """Accuracy against the number of channels, their names in the order in which they join."""
    steps, whole = content["best"]["channel"], content["with_all"]["reselected"]
    kinds = {row["name"]: row["kind"] for row in content["channels"]}
    colours = style.kind_colours(kinds.values())
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
    axes.plot([], [], ":", color=style.GREY, label="all sensors")
    axes.set_xticks(at, [f"+{step['joins']}" for step in steps], rotation=50)
    for tick, step in zip(axes.get_xticklabels(), steps, strict=True):
        tick.set(color=colours[kinds[step["joins"]]], fontweight="bold")
    axes.set_xlim(0.5, len(steps) + 0.5)
    how = RESELECT_WORDS[content["settings"]["reselect"]]
    title = f"(d) the best few, in the order in which they serve held-out groups; features {how}"
    axes.set(title=title, ylabel="balanced accuracy, %")
    axes.set_xlabel("bands: 95 % intervals of the difference to all sensors, over recordings")
    axes.legend(loc="best", ncols=2)


# The hand ----------------------------------------------------------------------------------------
_FROM_TIP = ("tip", "distal", "intermediate", "middle", "proximal", "base", "palm")
_MOST_NAMED = 4  # channels of a segment that still have room for name and number


def _hand(
    axes: Axes,
    channels: Sequence[Row],
    values: Mapping[str, float],
    limits: tuple[float, float],
    written: str,
    unit: str,
) -> None:
    """A hand whose channels are shaded by a number, the shades of each kind below.

    Args:
        axes: to draw on.
        channels: of the hand, in order; fingers stand in the order in which they first occur.
        values: by channel.
        limits: values of the palest and of the deepest shade.
        written: how a value is written into its mark, where there is space.
        unit: of the values.
    """
    by_finger: dict[str, dict[str, list[Row]]] = {}
    for row in channels:
        by_finger.setdefault(row["finger"], {}).setdefault(row["segment"], []).append(row)
    marks: dict[str, list[tuple[float, float, Row]]] = {row["kind"]: [] for row in channels}
    fingers = sorted(by_finger, key=lambda name: name == "thumb" and len(by_finger) > 1)
    for place, finger in enumerate(fingers):
        segments = by_finger[finger]
        known = [segment for segment in _FROM_TIP if segment in segments]
        order = [*known, *(segment for segment in segments if segment not in known)]
        root = -1.3 if finger == "thumb" and place else 0.0
        axes.text(place, root + len(order) + 0.1, finger, ha="center", color=style.INK)
        for up, segment in enumerate(reversed(order)):
            corner = (place - 0.46, root + up + 0.03)
            box = FancyBboxPatch(corner, 0.92, 0.94, boxstyle="round,pad=0,rounding_size=0.2")
            axes.add_patch(box).set(facecolor="#F6F1EA", edgecolor="#C9BEAF")
            for (x, y), row in _placed(segments[segment]):
                marks[row["kind"]].append((place + x, root + up + 0.5 + y, row))
    most = max(len(rows) for segments in by_finger.values() for rows in segments.values())
    size = 1100 / max(math.ceil(math.sqrt(most)), 2) ** 2 / max(1, len(fingers) / 5)
    for kind, colour in style.kind_colours(marks).items():
        xs, ys, rows = zip(*marks[kind], strict=True)
        ramp = LinearSegmentedColormap.from_list("shade", ["#FFFFFF", colour])
        shown = axes.scatter(
            xs, ys, s=size, c=[values[row["name"]] for row in rows], cmap=ramp, vmin=limits[0],
            vmax=limits[1], marker="o" if style.is_fast(rows[0]) else "s", edgecolors=colour,
        )  # fmt: skip
        bar = axes.figure.colorbar(
            shown, ax=axes, location="bottom", shrink=0.6, aspect=40, pad=0.01
        )
        bar.set_label(f"{kind}: {unit}")
        for x, y, row in marks[kind] if most <= _MOST_NAMED else ():
            value = values[row["name"]]
            is_deep = value > limits[0] + 0.6 * (limits[1] - limits[0])
            look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6.5}
            text = written.format(value) if value else "0"
            axes.text(x, y, text, color="white" if is_deep else style.INK, **look)
            axes.text(x, y + 0.3, row["name"], color=style.GREY, **look)
    axes.set_xlim(-0.6, len(fingers) - 0.4)
    axes.set_ylim(-1.4 if "thumb" in fingers[1:] else -0.1, max(map(len, by_finger.values())) + 0.5)
    axes.set_aspect("equal", anchor="N")
    axes.axis("off")


def _placed(rows: Sequence[Row]) -> list[tuple[tuple[float, float], Row]]:
    """Where channels stand about the middle of their segment, in lines, slow ones first."""
    columns = math.ceil(math.sqrt(len(rows)))
    lines = math.ceil(len(rows) / columns)
    pitch = 0.86 / max(columns, lines, 2)
    placed = []
    for number, row in enumerate(sorted(rows, key=style.is_fast)):
        line, column = divmod(number, columns)
        in_line = min(columns, len(rows) - line * columns)
        at = pitch * (column - (in_line - 1) / 2), -pitch * (line - (lines - 1) / 2)
        placed.append((at, row))
    return placed
