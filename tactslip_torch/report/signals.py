"""Recordings as a figure: gauges left, films right, one recording a row, onsets marked.

What the paper's signal figure shows (section V-A), of any scene and any hand. Gauges, and other
slowly adapting channels, stand overlaid as measured, so that their offsets before the onset can be
read, and again in a lane each, so that their changes can; films, and others that adapt fast, have
lanes, so that every burst is seen. Colours are fingers, of a palette that the colour-blind can tell
apart, paler towards the palm.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image
from torch import Tensor

from tactslip_torch.report.envelope import Array, envelope
from tactslip_torch.runtime import whole_file

Channels = Sequence[Mapping[str, str]]
"""Rows of ``name``, ``kind``, ``finger``, ``segment``, ``adapting`` where the kind does not say it,
as ``HandLayout.to_rows`` gives them."""

_STRETCHES = 1200  # of each line, of which the least and the greatest sample are drawn
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#AA4488", "#E69F00", "#444444", "#56B4E9")
_PALER = {"distal": 0.0, "middle": 0.3, "proximal": 0.5}
_INK, _GREY = "#222222", "#666666"
_SLIDE: dict[str, Any] = {"facecolor": "#E4E4E4", "edgecolor": "none", "zorder": 0}
_HANDLED: dict[str, Any] = {
    "facecolor": "#FFF6D6",
    "edgecolor": "#E6D9A4",
    "hatch": "///",
    "linewidth": 0,
    "zorder": 0,
}
_ONSET: dict[str, Any] = {"color": _INK, "linestyle": "-.", "linewidth": 1.0, "zorder": 1}
_LANE = 0.13  # least height of one, in inches, for its name to be read
_SMALL, _TEXT, _TITLE = 6.5, 9, 12  # font sizes in points
_NUM_COLOURS = 255  # of the PNG: a third of the bytes, and nobody sees it


class _Column(NamedTuple):
    """One column of the figure: the channels of a kind that adapt alike."""

    kind: str
    channels: list[int]
    in_lanes: bool


@dataclass(frozen=True, eq=False)
class SignalRow:
    """One recording, as it is drawn.

    Args:
        title: stands beside the row.
        volts: filtered samples, ``[C, T]``, in ``units``; what is not finite is left out.
        sample_rate_hz: samples per second.
        onsets_s: exact onsets.
        sliding_s: start and end of each slide.
        non_slip_s: stretches without slip in which the hand is handled.
        units: of the samples.
    """

    title: str
    volts: Tensor
    sample_rate_hz: float
    onsets_s: Sequence[float] = ()
    sliding_s: Sequence[tuple[float, float]] = ()
    non_slip_s: Sequence[tuple[float, float]] = ()
    units: str = "V"

    def around(self, stroke: int, before_s: float, after_s: float) -> tuple[float, float]:
        """Where to look for a stroke: around its onset or, where nothing slips, its start.

        Strokes count from 1; the last stands for those that are not there, and the whole
        recording for a stroke where there is none.
        """
        duration_s = self.volts.shape[-1] / self.sample_rate_hz
        begins = self.onsets_s or [start for start, _ in self.non_slip_s]
        if not begins:
            return 0.0, duration_s
        centre_s = begins[min(stroke, len(begins)) - 1]
        return max(0.0, centre_s - before_s), min(duration_s, centre_s + after_s)


def signals_figure(
    rows: Sequence[SignalRow],
    channels: Channels,
    path: str | Path,
    *,
    title: str,
    views: Sequence[tuple[float, float]] | None = None,
) -> None:
    """Write the figure that ``draw_signals`` draws as PNG, replaced as a whole if it exists."""
    figure = draw_signals(rows, channels, title=title, views=views)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120, facecolor="white")
    with whole_file(path) as temporary, Image.open(drawn) as image:
        image.convert("RGB").quantize(_NUM_COLOURS, dither=Image.Dither.NONE).save(
            temporary, format="png", optimize=True
        )


def draw_signals(
    rows: Sequence[SignalRow],
    channels: Channels,
    *,
    title: str,
    views: Sequence[tuple[float, float]] | None = None,
) -> Figure:
    """Draw one recording a row: gauges as measured, gauges in lanes, films in lanes.

    Args:
        rows: at least one, all of the same hand.
        channels: of the hand.
        title: of the figure; says what is simulated.
        views: ``(start, end)`` in seconds of what is shown of each row, ``None`` for all.

    Raises:
        ValueError: if there is no row, or channels or views are fewer or more than wanted.
    """
    if not rows:
        raise ValueError("no recording to draw; give at least one row")
    for row in rows:
        if len(row.volts) != len(channels):
            raise ValueError(f"{row.title} has {len(row.volts)} channels, not {len(channels)}")
    if views is not None and len(views) != len(rows):
        raise ValueError(f"views must be one per row, got {len(views)} for {len(rows)}")
    columns = _columns(channels)
    height = max(1.9, *(_LANE * len(column.channels) for column in columns))
    figure = Figure(figsize=(13.0, height * len(rows) + 1.3), layout="constrained")
    widths = {"width_ratios": [1.0 if column.in_lanes else 0.75 for column in columns]}
    grid = figure.subplots(len(rows), len(columns), squeeze=False, gridspec_kw=widths)
    colours = channel_colours(channels)
    for place, row in enumerate(rows):
        view = (0.0, row.volts.shape[-1] / row.sample_rate_hz) if views is None else views[place]
        for axes, column in zip(grid[place], columns, strict=True):
            own = column.channels
            time_s, volts = _seen(row, own, view)
            names = [channels[i]["name"] for i in own]
            if column.in_lanes:
                _in_lanes(axes, time_s, volts, names, [colours[i] for i in own], row.units)
            else:
                _overlaid(axes, time_s, volts, names, [colours[i] for i in own])
            _mark(axes, row, view)
        unit = "volts" if row.units == "V" else row.units
        grid[place][0].set_ylabel(f"{row.title}\n{unit}", fontsize=_TEXT, color=_INK)
    for axes, column in zip(grid[0], columns, strict=True):
        how = "in lanes, offsets removed" if column.in_lanes else "as measured"
        axes.set_title(f"{column.kind}, {how}", fontsize=_TEXT, color=_GREY)
    for axes in grid[-1]:
        axes.set_xlabel("time, s", fontsize=_TEXT, color=_GREY)
    figure.suptitle(title, fontsize=_TITLE)
    figure.legend(
        handles=_legend(rows, channels),
        loc="outside lower center",
        ncols=9,
        frameon=False,
        fontsize=_TEXT,
    )
    return figure


def _columns(channels: Channels) -> list[_Column]:
    """Of every kind that adapts slowly two, as measured and in lanes; then of every other one."""
    found: dict[tuple[bool, str], list[int]] = {}
    for place, channel in enumerate(channels):
        kind = channel["kind"]
        is_fast = channel.get("adapting", "slow" if kind == "SG" else "fast") == "fast"
        found.setdefault((is_fast, kind), []).append(place)
    return [
        _Column(kind, places, in_lanes)
        for (is_fast, kind), places in sorted(found.items(), key=lambda item: item[0][0])
        for in_lanes in ((True,) if is_fast else (False, True))
    ]


def channel_colours(channels: Channels) -> list[tuple[float, float, float]]:
    """A colour per channel: the hue is its finger's, paler towards the palm."""
    fingers = list(dict.fromkeys(channel["finger"] for channel in channels))
    colours = []
    for channel in channels:
        hue = to_rgb(_COLOURS[fingers.index(channel["finger"]) % len(_COLOURS)])
        pale = _PALER.get(channel["segment"], 0.0)
        red, green, blue = (part + pale * (1.0 - part) for part in hue)
        colours.append((red, green, blue))
    return colours


def _seen(row: SignalRow, own: list[int], view: tuple[float, float]) -> tuple[Array, Array]:
    """Times and volts of some channels in the view, as few as the figure can show."""
    first, last = (round(t * row.sample_rate_hz) for t in view)
    values = row.volts[own, first:last].double().cpu().numpy()
    indices, seen = envelope(values, _STRETCHES)
    return (first + indices) / row.sample_rate_hz, seen


def _overlaid(
    axes: Axes, time_s: Array, volts: Array, names: list[str], colours: list[Any]
) -> None:
    """All channels on one axis, as measured."""
    for t, v, name, colour in zip(time_s, volts, names, colours, strict=True):
        axes.plot(t, v, color=colour, linewidth=0.7, label=name)


def _in_lanes(
    axes: Axes, time_s: Array, volts: Array, names: list[str], colours: list[Any], units: str
) -> None:
    """A lane per channel around its median, the first at the top, and a bar of so many units."""
    known = [v[np.isfinite(v)] for v in volts]
    rest = np.array([np.median(v) if v.size else 0.0 for v in known])
    lane_v = _lane_height([v for v in known if v.size])
    middles = -lane_v * np.arange(len(names))
    for t, v, name, colour in zip(
        time_s, volts + (middles - rest)[:, None], names, colours, strict=True
    ):
        axes.plot(t, v, color=colour, linewidth=0.5, label=name)
    axes.set_yticks(middles, names, fontsize=_SMALL)
    for label, colour in zip(axes.get_yticklabels(), colours, strict=True):
        label.set_color(colour)
    bar_v = _round_number(2 * lane_v)
    axes.plot(
        [1.012, 1.012],
        [middles[-1], middles[-1] + bar_v],
        color=_INK,
        linewidth=2,
        transform=axes.get_yaxis_transform(),
        clip_on=False,
    )
    axes.annotate(
        f"{bar_v:g} {units}",
        (1.02, middles[-1] + bar_v / 2),
        xycoords=("axes fraction", "data"),
        fontsize=_SMALL + 1,
        color=_INK,
        va="center",
        annotation_clip=False,
    )


def _lane_height(known: list[Array]) -> float:
    """Volts between lanes: room for most of the time of most channels; bursts may cross lanes."""
    if not known:
        return 1.0
    bulk = [np.subtract(*np.quantile(v, [0.99, 0.01])) for v in known]
    bursts = [np.ptp(v) for v in known]
    height_v = max(
        np.quantile(bulk, 0.75), 0.35 * np.median(bursts), 1.5 * max(bursts) / len(bursts)
    )
    return float(height_v) if height_v > 0 else 1.0


def _round_number(value: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that does not exceed a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(digit for digit in (1, 2, 5) if digit * power <= value))


def _mark(axes: Axes, row: SignalRow, view: tuple[float, float]) -> None:
    """Onsets, slides and what is no slip, as far as they are in view."""
    for stretches, style in ((row.sliding_s, _SLIDE), (row.non_slip_s, _HANDLED)):
        for start, end in stretches:
            if start < view[1] and end > view[0]:
                axes.axvspan(max(start, view[0]), min(end, view[1]), **style)
    for onset in row.onsets_s:
        if view[0] <= onset <= view[1]:
            axes.axvline(onset, **_ONSET)
    axes.set_xlim(*view)
    axes.tick_params(color="#BBBBBB", labelsize=_SMALL + 0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[:].set_color("#BBBBBB")


def _legend(rows: Sequence[SignalRow], channels: Channels) -> list[Any]:
    """A line per finger, and the marks that there are."""
    fingers = dict.fromkeys(channel["finger"] for channel in channels)
    handles: list[Any] = [
        Line2D([], [], color=_COLOURS[place % len(_COLOURS)], linewidth=2, label=finger)
        for place, finger in enumerate(fingers)
    ]
    if len({channel["segment"] for channel in channels} & set(_PALER)) > 1:
        handles.append(Line2D([], [], color="#CCCCCC", linewidth=2, label="paler: nearer the palm"))
    if any(row.onsets_s for row in rows):
        handles.append(Line2D([], [], label="onset of slip, exact", **_ONSET))
    if any(row.sliding_s for row in rows):
        handles.append(Patch(label="the contact slides", **_SLIDE))
    if any(row.non_slip_s for row in rows):
        handles.append(Patch(label="handled, no slip", **_HANDLED))
    return handles
