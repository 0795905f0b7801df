"""A hand of any layout, drawn from its fingers and segments, with every channel shaded by a number.

Fingers stand side by side on a palm, tips up; a finger called thumb leans out from its side. In
each segment slowly adapting channels are squares and fast ones discs, in the colour of their kind,
the deeper the larger the number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.patches import Circle, FancyBboxPatch, Patch
from matplotlib.transforms import Affine2D, Transform

_KNOWN_COLOURS = {"SG": "#E69F00", "PVDF": "#0072B2"}
_OTHER_COLOURS = ("#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#666666")
_SKIN, _EDGE, _INK, _GREY, _PALE = "#F6F1EA", "#C9BEAF", "#222222", "#666666", "#FFFFFF"
_FROM_TIP = ("tip", "distal", "intermediate", "middle", "proximal", "base", "palm")
_DROP = {"little": 0.4, "ring": 0.12, "index": 0.1}  # of a root below that of the middle finger
_WIDTH, _HEIGHT = 0.92, 0.94  # of a segment
_MOST_NAMED = 4  # channels of a segment that still have room for name and number
_SMALL = 6.5  # points

Row = Mapping[str, str]
"""A channel as ``HandLayout.to_rows`` has it."""


class _Finger(NamedTuple):
    name: str
    segments: list[list[Row]]  # from the tip
    place: Affine2D  # from its own axes, root at 0, to those of the hand
    degrees: float


def kind_colours(channels: Sequence[Row]) -> dict[str, str]:
    """A colour for every kind of channel, blue for PVDF and orange for SG as everywhere."""
    kinds = list(dict.fromkeys(row["kind"] for row in channels))
    others = cycle(_OTHER_COLOURS)
    return {kind: _KNOWN_COLOURS.get(kind) or next(others) for kind in kinds}


def draw_hand(
    axes: Axes,
    channels: Sequence[Row],
    values: Mapping[str, float],
    limits: tuple[float, float],
    written: str = "{:.2f}",
) -> None:
    """Draw a hand with its channels shaded.

    Args:
        axes: to draw in; its own ticks go.
        channels: of the hand, in order; fingers stand in the order in which they first occur.
        values: by channel.
        limits: values of the palest and of the deepest shade.
        written: how a value is written into its mark, where there is room.
    """
    colours = kind_colours(channels)
    fingers = _fingers(channels)
    straight = sum(finger.degrees == 0 for finger in fingers)
    right = max(straight, 1) - 1 + _WIDTH / 2 + 0.04
    left, depth = -_WIDTH / 2 - 0.04, 0.5 + 0.31 * max(straight, 1)
    _box(axes, (left, -0.03 - depth), right - left, depth, axes.transData, rounding=0.3)
    for finger in fingers:
        moved = finger.place + axes.transData
        for number, segment in enumerate(reversed(finger.segments)):
            bottom = number + (1 - _HEIGHT) / 2
            _box(axes, (-_WIDTH / 2, bottom), _WIDTH, _HEIGHT, moved, rounding=0.2)
            _marks(axes, segment, (0.0, number + 0.5), finger, values, limits, colours, written)
        x, y = finger.place.transform((0.0, len(finger.segments) + 0.2))
        axes.text(x, y, finger.name, ha="center", va="center", fontsize=9, color=_INK)
    tops = [finger.place.transform((0.0, len(finger.segments) + 0.4)) for finger in fingers]
    axes.set_xlim(-0.75, max(right + 0.2, *(float(x) + 0.55 for x, _ in tops)))
    axes.set_ylim(-0.7 - depth, max(float(y) for _, y in tops))
    axes.set_aspect("equal", anchor="N")
    axes.axis("off")


def draw_shades(
    axes: Axes, channels: Sequence[Row], limits: tuple[float, float], unit: str
) -> None:
    """The shades of each kind as strips, with what the palest and the deepest stand for.

    Args:
        axes: to draw in.
        channels: of the hand.
        limits: as ``draw_hand`` has them.
        unit: of the values, in words.
    """
    colours = kind_colours(channels)
    adapting = {row["kind"]: _is_fast(row) for row in channels}
    strips = np.array([[_shade(c, v) for v in np.linspace(0, 1, 128)] for c in colours.values()])
    axes.imshow(strips, aspect="auto", extent=(limits[0], limits[1], len(colours), 0))
    names = [f"{kind} {'●' if adapting[kind] else '■'}" for kind in colours]
    axes.set_yticks(np.arange(len(colours)) + 0.5, names, fontsize=8)
    axes.tick_params(length=0, labelsize=8)
    axes.set_xlabel(unit, fontsize=8, color=_GREY, labelpad=2)
    axes.spines[:].set_visible(False)


def _fingers(channels: Sequence[Row]) -> list[_Finger]:
    by_finger: dict[str, dict[str, list[Row]]] = {}
    for row in channels:
        by_finger.setdefault(row["finger"], {}).setdefault(row["segment"], []).append(row)
    fingers = []
    names = [name for name in by_finger if name != "thumb"] or list(by_finger)
    for x, name in enumerate(names):
        place = Affine2D().translate(x, -_DROP.get(name, 0.0))
        fingers.append(_Finger(name, _from_tip(by_finger[name]), place, 0.0))
    if "thumb" in by_finger and "thumb" not in names:
        place = Affine2D().rotate_deg(-32).translate(len(names) - 0.34, -1.3)
        fingers.append(_Finger("thumb", _from_tip(by_finger["thumb"]), place, -32.0))
    return fingers


def _from_tip(segments: Mapping[str, list[Row]]) -> list[list[Row]]:
    """The known ones in their order, others in that of the hand behind them."""
    known = [name for name in _FROM_TIP if name in segments]
    return [segments[name] for name in (*known, *(n for n in segments if n not in known))]


def _marks(
    axes: Axes,
    segment: Sequence[Row],
    centre: tuple[float, float],
    finger: _Finger,
    values: Mapping[str, float],
    limits: tuple[float, float],
    colours: Mapping[str, str],
    written: str,
) -> None:
    columns = math.ceil(math.sqrt(len(segment)))
    lines = math.ceil(len(segment) / columns)
    pitch = 0.86 / max(columns, lines, 2)
    radius = 0.44 * pitch
    is_named = len(segment) <= _MOST_NAMED
    ordered = sorted(segment, key=_is_fast)
    for number, row in enumerate(ordered):
        line, column = divmod(number, columns)
        in_line = min(columns, len(ordered) - line * columns)
        x = centre[0] + pitch * (column - (in_line - 1) / 2)
        y = centre[1] - pitch * (line - (lines - 1) / 2) - (0.06 if is_named else 0.0)
        low, high = limits
        share = min(max((values[row["name"]] - low) / (high - low), 0.0), 1.0) if high > low else 0
        fill = _shade(colours[row["kind"]], share)
        style: dict[str, Any] = {
            "facecolor": fill,
            "edgecolor": colours[row["kind"]],
            "linewidth": 0.9,
        }
        mark: Patch
        if _is_fast(row):
            mark = Circle((x, y), radius, **style)
        else:
            corner, side = (x - 0.9 * radius, y - 0.9 * radius), 1.8 * radius
            shape = f"round,pad=0,rounding_size={0.25 * radius}"
            mark = FancyBboxPatch(corner, side, side, boxstyle=shape, **style)
        mark.set_transform(finger.place + axes.transData)
        axes.add_patch(mark)
        if is_named:
            ink = _PALE if np.dot(fill, (0.299, 0.587, 0.114)) < 0.55 else _INK
            centred: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": _SMALL}
            centred["transform"] = finger.place + axes.transData
            value = values[row["name"]]
            text = written.format(value) if value else "0"
            axes.text(x, y, text, color=ink, **centred)
            axes.text(
                x, y + radius + 0.1, row["name"], color=_GREY, rotation=finger.degrees, **centred
            )


def _box(
    axes: Axes,
    corner: tuple[float, float],
    width: float,
    height: float,
    placed: Transform,
    *,
    rounding: float,
) -> None:
    shape = f"round,pad=0,rounding_size={rounding}"
    style: dict[str, Any] = {"facecolor": _SKIN, "edgecolor": _EDGE, "linewidth": 1.0}
    box = FancyBboxPatch(corner, width, height, boxstyle=shape, **style)
    box.set_transform(placed)
    axes.add_patch(box)


def _shade(colour: str, share: float) -> tuple[float, float, float]:
    ramp = LinearSegmentedColormap.from_list("shade", [_PALE, colour])
    red, green, blue = to_rgb(ramp(share))
    return red, green, blue


def _is_fast(row: Row) -> bool:
    return row.get("adapting", "fast" if row["kind"] == "PVDF" else "slow") == "fast"
