"""Recordings as tables and figures: what a set holds, and signals with their onsets.

``signals_figure`` shows what the paper's signal figure does (section V-A), of any scene and hand.
Slowly adapting channels stand overlaid as measured, so that their offsets before the onset can be
read, and again in a lane each, so that their changes can; channels that adapt fast have lanes, so
that every burst is seen. Colours are fingers, paler towards the palm.
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

from tactslip_torch.report.onset import Array, Segments, envelope, lane_height
from tactslip_torch.report.style import (
    BLUE,
    GREY,
    INK,
    TEXT,
    VERMILION,
    clean,
    colours_of,
    lanes,
    legend_below,
    marked,
    new_figure,
    save,
    stack,
    table,
)
from tactslip_torch.runtime import whole_file

Channels = Sequence[Mapping[str, str]]
"""Rows of ``name``, ``kind``, ``finger``, ``segment``, ``adapting`` where the kind does not say it,
as ``HandLayout.to_rows`` gives them."""

_UNKNOWN = "#D9D9D9"
_PALER = {"distal": 0.0, "middle": 0.3, "proximal": 0.5}
_SLIP: dict[str, Any] = {"facecolor": VERMILION, "alpha": 0.14, "linewidth": 0, "zorder": 0}
_NON_SLIP: dict[str, Any] = {"facecolor": BLUE, "alpha": 0.12, "linewidth": 0, "zorder": 0}
_ONSET: dict[str, Any] = {"color": INK, "linestyle": "-.", "linewidth": 1.0, "zorder": 1}
_NUM_SEGMENTS = 1200  # of each line, of which the least and the greatest sample are drawn
_LANE = 0.13  # least height of one, in inches, for its name to be read
_MOST_LANES = 24
_NAMES = 6.5  # font size of channels in points
_NUM_COLOURS = 255  # of the PNG: a third of the bytes, and nobody sees it


@dataclass(frozen=True)
class Trial:
    """What is known of one recording.

    Args:
        material: of it.
        scene: of it.
        duration_s: of it.
        slip_s: seconds that are labelled slip.
        non_slip_s: seconds that are labelled non-slip.
        num_onsets: that are known.
    """

    material: str
    scene: str
    duration_s: float
    slip_s: float
    non_slip_s: float
    num_onsets: int


@dataclass(frozen=True, eq=False)
class DrawnRecording:
    """One recording, as it is drawn.

    Args:
        title: stands beside it.
        samples: ``[C, T]``, in ``units``; what is not finite is left out.
        sample_rate_hz: samples per second.
        onsets_s: exact onsets.
        slip_s: start and end of each segment of slip.
        non_slip_s: those of segments that are known to be without.
        units: of the samples.
    """

    title: str
    samples: Tensor
    sample_rate_hz: float
    onsets_s: Sequence[float] = ()
    slip_s: Segments = ()
    non_slip_s: Segments = ()
    units: str = "V"

    @property
    def duration_s(self) -> float:
        """Of the whole recording."""
        return self.samples.shape[-1] / self.sample_rate_hz

    def around(self, stroke: int, before_s: float, after_s: float) -> tuple[float, float]:
        """Where to look for a stroke: around its onset or, where nothing slips, its start.

        Strokes count from 1; the last stands for those that are not there, and the whole
        recording for a stroke where there is none.
        """
        begins = self.onsets_s or [start for start, _ in self.non_slip_s]
        if not begins:
            return 0.0, self.duration_s
        centre_s = begins[min(stroke, len(begins)) - 1]
        return max(0.0, centre_s - before_s), min(self.duration_s, centre_s + after_s)


# What a set holds --------------------------------------------------------------------------------
def trials_table(trials: Sequence[Trial], *, simulated: bool) -> str:
    """How many recordings of each material there are, how long, and what is known of them.

    Of several scenes the same follows for each scene.
    """
    tables = [_grouped("material", trials)]
    if len({trial.scene for trial in trials}) > 1:
        tables.append(_grouped("scene", trials))
    return marked(simulated, "\n\n".join(tables))


def _grouped(key: str, trials: Sequence[Trial]) -> str:
    """A row a group, in the order in which they come, and of several one of all."""
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(getattr(trial, key), []).append(trial)
    if len(groups) > 1:
        groups["all"] = list(trials)
    rows = [[key, "recordings", "shortest s", "longest s", "seconds", "onsets", "slip s"]]
    rows[0].append("non-slip s")
    for name, group in groups.items():
        durations = [trial.duration_s for trial in group]
        row = [name, str(len(group)), f"{min(durations):.2f}", f"{max(durations):.2f}"]
        row += [f"{sum(durations):.1f}", str(sum(trial.num_onsets for trial in group))]
        row.append(f"{sum(trial.slip_s for trial in group):.1f}")
        rows.append([*row, f"{sum(trial.non_slip_s for trial in group):.1f}"])
    return table(rows)


def ranges_table(channels: Channels, ranges: Array, units: str) -> str:
    """The least and the greatest sample of the channels of each kind.

    Shape:
        - ranges: ``[C, 2]``, NaN where nothing is finite
    """
    rows = [["kind", "channels", f"least, {units}", f"greatest, {units}"]]
    for kind in dict.fromkeys(channel["kind"] for channel in channels):
        places = [place for place, channel in enumerate(channels) if channel["kind"] == kind]
        known = ranges[places][np.isfinite(ranges[places]).all(-1)]
        least, greatest = (known[:, 0].min(), known[:, 1].max()) if len(known) else (np.nan,) * 2
        rows.append([kind, str(len(places)), f"{least:.6g}", f"{greatest:.6g}"])
    return table(rows)


def dataset_figure(
    trials: Sequence[Trial],
    example: DrawnRecording,
    names: Sequence[str],
    path: str | Path,
    *,
    title: str,
) -> None:
    """Write the figure that ``draw_dataset`` draws as PNG, replaced as a whole if it exists."""
    save(draw_dataset(trials, example, names, title=title), path, dpi=120)


def draw_dataset(
    trials: Sequence[Trial], example: DrawnRecording, names: Sequence[str], *, title: str
) -> Figure:
    """Seconds of each material by what is known of them, and below the traces of one recording.

    Of more channels than fit, so many are drawn, evenly chosen.

    Args:
        trials: at least one.
        example: drawn in lanes, slip and non-slip shaded.
        names: of its channels.
        title: of the figure; says what is simulated.

    Raises:
        ValueError: if there is no recording.
    """
    if not trials:
        raise ValueError("no recording to draw; give at least one")
    num_materials = len({trial.material for trial in trials})
    heights = [0.28 * num_materials + 0.8, 0.2 * min(len(names), _MOST_LANES) + 0.9]
    figure = new_figure(11.0, sum(heights) + 0.9, title)
    bars, traces = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
    _draw_seconds(bars, trials)
    _draw_example(traces, example, names)
    colours = {VERMILION: "slip", BLUE: "non-slip", _UNKNOWN: "not labelled"}
    handles: list[Any] = [Patch(color=colour, label=label) for colour, label in colours.items()]
    handles += [Line2D([], [], label="onset", **_ONSET)] if example.onsets_s else []
    legend_below(figure, handles, 4)
    return figure


def _draw_seconds(axes: Axes, trials: Sequence[Trial]) -> None:
    """A bar a material: seconds of slip, of non-slip, and of what is not labelled."""
    materials = list(dict.fromkeys(trial.material for trial in trials))
    style: dict[str, Any] = {"va": "center", "fontsize": 7, "color": GREY}
    for place, material in enumerate(materials):
        group = [trial for trial in trials if trial.material == material]
        slip = sum(trial.slip_s for trial in group)
        quiet = sum(trial.non_slip_s for trial in group)
        whole = max(sum(trial.duration_s for trial in group), slip + quiet)
        stack(axes, place, (slip, quiet, whole - slip - quiet), (VERMILION, BLUE, _UNKNOWN))
        text = f"{len(group)} recording{'s' * (len(group) != 1)}"
        axes.annotate(text, (whole, place), xytext=(4, 0), textcoords="offset points", **style)
    clean(axes, "x")
    lanes(axes, materials)
    axes.margins(x=0.12)
    axes.set_xlabel("seconds of signal", fontsize=TEXT, color=GREY)


def _draw_example(axes: Axes, example: DrawnRecording, names: Sequence[str]) -> None:
    """Channels in lanes, each on a scale of its own, over shaded segments."""
    num_lanes = min(len(names), _MOST_LANES)
    chosen = sorted({round(place) for place in np.linspace(0, len(names) - 1, num_lanes)})
    view = (0.0, example.duration_s)
    times, values = _points(example, chosen, view)
    spans = []
    for line in values:
        known = line[np.isfinite(line)]
        spans.append(float(np.subtract(*np.quantile(known, [0.99, 0.01]))) if known.size else 0.0)
    heights = [1.25 * span or 1.0 for span in spans]
    labels = [
        f"{names[place]}  {span or 1.0:.3g} {example.units}"
        for place, span in zip(chosen, spans, strict=True)
    ]
    _draw_lanes(axes, times, values, labels, [INK] * len(chosen), heights, most=1.2)
    axes.set_ylim(-len(chosen) + 0.2, 0.8)
    _mark(axes, example, view)
    axes.set_xlabel("time, s", fontsize=TEXT, color=GREY)
    some = "" if len(chosen) == len(names) else f", {len(chosen)} of {len(names)} channels"
    what = f"{example.title}{some}; beside each name the span of all but 2 % of it"
    axes.set_title(what, fontsize=TEXT, color=GREY)


# Signals -----------------------------------------------------------------------------------------
class _Column(NamedTuple):
    """One column of the figure: the channels of a kind that adapt alike."""

    kind: str
    channels: list[int]
    in_lanes: bool


def signals_figure(
    rows: Sequence[DrawnRecording],
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
    rows: Sequence[DrawnRecording],
    channels: Channels,
    *,
    title: str,
    views: Sequence[tuple[float, float]] | None = None,
) -> Figure:
    """Draw one recording a row: slow channels as measured and in lanes, fast ones in lanes.

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
        if len(row.samples) != len(channels):
            raise ValueError(f"{row.title} has {len(row.samples)} channels, not {len(channels)}")
    views = [(0.0, row.duration_s) for row in rows] if views is None else views
    if len(views) != len(rows):
        raise ValueError(f"views must be one per row, got {len(views)} for {len(rows)}")
    columns = _columns(channels)
    height = max(1.9, *(_LANE * len(column.channels) for column in columns))
    figure = new_figure(13.0, height * len(rows) + 1.3, title)
    widths = {"width_ratios": [1.0 if column.in_lanes else 0.75 for column in columns]}
    grid = figure.subplots(len(rows), len(columns), squeeze=False, gridspec_kw=widths)
    for panels, row, view in zip(grid, rows, views, strict=True):
        for axes, column in zip(panels, columns, strict=True):
            _draw_column(axes, row, view, column, channels)
        unit = "volts" if row.units == "V" else row.units
        panels[0].set_ylabel(f"{row.title}\n{unit}", fontsize=TEXT, color=INK)
    for axes, column in zip(grid[0], columns, strict=True):
        how = "in lanes, offsets removed" if column.in_lanes else "as measured"
        axes.set_title(f"{column.kind}, {how}", fontsize=TEXT, color=GREY)
    for axes in grid[-1]:
        axes.set_xlabel("time, s", fontsize=TEXT, color=GREY)
    legend_below(figure, _legend(rows, channels), 9)
    return figure


def _columns(channels: Channels) -> list[_Column]:
    """Of every kind that adapts slowly two, as measured and in lanes; then of every other one."""
    groups: dict[tuple[bool, str], list[int]] = {}
    for place, channel in enumerate(channels):
        kind = channel["kind"]
        is_fast = channel.get("adapting", "slow" if kind == "SG" else "fast") == "fast"
        groups.setdefault((is_fast, kind), []).append(place)
    return [
        _Column(kind, places, in_lanes)
        for (is_fast, kind), places in sorted(groups.items(), key=lambda item: item[0][0])
        for in_lanes in ((True,) if is_fast else (False, True))
    ]


def channel_colours(channels: Channels) -> list[tuple[float, float, float]]:
    """A colour per channel: the hue is its finger's, paler towards the palm."""
    hues = colours_of(channel["finger"] for channel in channels)
    colours = []
    for channel in channels:
        pale = _PALER.get(channel["segment"], 0.0)
        mixed = (part + pale * (1.0 - part) for part in to_rgb(hues[channel["finger"]]))
        red, green, blue = mixed
        colours.append((red, green, blue))
    return colours


def _draw_column(
    axes: Axes,
    row: DrawnRecording,
    view: tuple[float, float],
    column: _Column,
    channels: Channels,
) -> None:
    """The channels of a kind, overlaid as measured or in lanes of one height with its scale."""
    names = [channels[place]["name"] for place in column.channels]
    all_colours = channel_colours(channels)
    colours = [all_colours[place] for place in column.channels]
    times, values = _points(row, column.channels, view)
    if column.in_lanes:
        known = [line[np.isfinite(line)] for line in values]
        height = lane_height([line for line in known if line.size])
        _draw_lanes(axes, times, values, names, colours, [height] * len(names))
        for label, colour in zip(axes.get_yticklabels(), colours, strict=True):
            label.set_color(colour)
        bar = _round_number(2 * height)
        bottom, top = 1 - len(names), 1 - len(names) + bar / height
        style: dict[str, Any] = {"transform": axes.get_yaxis_transform(), "clip_on": False}
        axes.plot([1.012, 1.012], [bottom, top], color=INK, linewidth=2, **style)
        style = {"xycoords": ("axes fraction", "data"), "va": "center", "annotation_clip": False}
        place = (1.02, (bottom + top) / 2)
        axes.annotate(f"{bar:g} {row.units}", place, fontsize=7.5, color=INK, **style)
    else:
        for time_s, line, name, colour in zip(times, values, names, colours, strict=True):
            axes.plot(time_s, line, color=colour, linewidth=0.7, label=name)
    _mark(axes, row, view)


def _points(
    row: DrawnRecording, places: Sequence[int], view: tuple[float, float]
) -> tuple[Array, Array]:
    """Times and samples of some channels in the view, as few as the figure can show."""
    first, last = (round(edge * row.sample_rate_hz) for edge in view)
    values = row.samples[list(places), first:last].double().cpu().numpy()
    indices, shown = envelope(values, _NUM_SEGMENTS)
    return (first + indices) / row.sample_rate_hz, shown


def _draw_lanes(
    axes: Axes,
    times: Array,
    values: Array,
    names: Sequence[str],
    colours: Sequence[Any],
    heights: Sequence[float],
    *,
    most: float = np.inf,
) -> None:
    """A lane per channel around its median, the first on top; bursts reach ``most`` lanes."""
    for lane, (time_s, line, height) in enumerate(zip(times, values, heights, strict=True)):
        known = line[np.isfinite(line)]
        centre = np.median(known) if known.size else 0.0
        shown = np.clip((line - centre) / height, -most, most) - lane
        axes.plot(time_s, shown, color=colours[lane], linewidth=0.5, label=names[lane])
    axes.set_yticks(-np.arange(len(names)), names)


def _round_number(value: float) -> float:
    """The greatest of 1, 2 and 5 times a power of ten that does not exceed a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(digit for digit in (1, 2, 5) if digit * power <= value))


def _mark(axes: Axes, row: DrawnRecording, view: tuple[float, float]) -> None:
    """Onsets, slip and non-slip, as far as they are in view."""
    for segments, style in ((row.slip_s, _SLIP), (row.non_slip_s, _NON_SLIP)):
        for start, end in segments:
            if start < view[1] and end > view[0]:
                axes.axvspan(max(start, view[0]), min(end, view[1]), **style)
    for onset in row.onsets_s:
        if view[0] <= onset <= view[1]:
            axes.axvline(onset, **_ONSET)
    axes.set_xlim(*view)
    clean(axes)
    axes.grid(visible=False)
    axes.tick_params(labelsize=_NAMES)


def _legend(rows: Sequence[DrawnRecording], channels: Channels) -> list[Any]:
    """A line per finger, and the marks that there are."""
    fingers = colours_of(channel["finger"] for channel in channels)
    handles: list[Any] = [
        Line2D([], [], color=colour, linewidth=2, label=finger)
        for finger, colour in fingers.items()
    ]
    if len({channel["segment"] for channel in channels} & set(_PALER)) > 1:
        handles.append(Line2D([], [], color="#CCCCCC", linewidth=2, label="paler: nearer the palm"))
    if any(row.onsets_s for row in rows):
        handles.append(Line2D([], [], label="onset of slip", **_ONSET))
    for label, style, is_there in (
        ("slip", _SLIP, any(row.slip_s for row in rows)),
        ("non-slip", _NON_SLIP, any(row.non_slip_s for row in rows)),
    ):
        handles += [Patch(label=label, **style)] if is_there else []
    return handles
