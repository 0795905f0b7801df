"""Recordings as tables and figures: what a set holds, and signals with their onsets.

``signals_figure`` shows what the paper's signal figure does (section V-A), of any scene and hand.
Slowly adapting channels stand overlaid as measured, so that their offsets before the onset can be
read, and again in a lane each, so that their changes can; channels that adapt fast have lanes, so
that every burst is seen. Colours are fingers, paler towards the palm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tactslip_torch.report import published, style
from tactslip_torch.report.onset import Array, Envelope, Segments, lane_height, median, span
from tactslip_torch.runtime import runs_of

Channels = Sequence[Mapping[str, str]]
"""Rows of ``name``, ``kind``, ``finger``, ``segment``, ``adapting`` where the kind does not say it,
as ``HandLayout.to_rows`` gives them."""

_PALER = {"distal": 0.0, "middle": 0.3, "proximal": 0.5}
_SLIP: dict[str, Any] = {"facecolor": style.VERMILION, "alpha": 0.14, "linewidth": 0, "zorder": 0}
_NON_SLIP: dict[str, Any] = {"facecolor": style.BLUE, "alpha": 0.12, "linewidth": 0, "zorder": 0}
_ONSET: dict[str, Any] = {"color": style.INK, "linestyle": "-.", "linewidth": 1.0, "zorder": 1}
_NUM_SEGMENTS = 1200  # of each line, of which the least and the greatest sample are drawn
_COLUMN = 3.8  # least width of one, in inches, for its titles to stand side by side
_LANE = 0.13  # least height of one, in inches, for its name to be read
_NAMES = 6.5  # font size of channels in points


Rows = Sequence[Mapping[str, Any]]
"""One a recording."""

Recording = Any
"""One of ``tactslip_torch.data``: its ``samples``, in ``units``, of which what is not finite is not
drawn, its exact ``onsets_s``, and start and end of what is slip or known to be without."""


# What a set holds --------------------------------------------------------------------------------
def written_table(written: Sequence[Mapping[str, Any]], seconds: float) -> str:
    """How many recordings of each scene are in files, how long, how large, how many made now.

    Of an own set that names no scenes, of each object.

    Args:
        written: of each recording its ``line`` of the manifest, ``made``, ``duration_s`` and
            ``num_bytes``.
        seconds: that it took.
    """

    def cells(group: Rows) -> Mapping[str, object]:
        return {
            "recordings": len(group),
            "made now": sum(one["made"] for one in group),
            "seconds of signal": f"{sum(one['duration_s'] for one in group):.1f}",
            "MB": f"{sum(one['num_bytes'] for one in group) / 1e6:.1f}",
        }

    simulated = any(one["line"]["simulated"] == "true" for one in written)
    is_named = simulated or {one["line"]["scene"] for one in written} != {published.PAPER_SCENE}
    title, key = ("scene", "scene") if is_named else ("object", "material")
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for one in written:
        groups.setdefault(one["line"][key], []).append(one)
    if len(groups) > 1:
        groups["all"] = list(written)
    table = style.table([{title: name, **cells(group)} for name, group in groups.items()])
    return style.marked(simulated, table, f"took {seconds:.1f} s")


_USES = {
    "slip": style.VERMILION,
    "slip, left out": "#F2BFA0",
    "non-slip": style.BLUE,
    "non-slip, left out": "#A6CBE3",
    "not labelled": "#D9D9D9",
    "missing": style.INK,
}
"""What training may make of a stretch of a recording, and its colour."""


def use_table(rows: Rows, most: int) -> str:
    """What training would use of each file, and the seconds that are left out, by the reason.

    Args:
        rows: of each recording its ``file``, ``duration_s``, ``num_slip`` and ``num_rest`` bins,
            and ``left_s`` by the reason.
        most: rows to show; the last is the sum of all.
    """

    def cells(file: str, group: Rows) -> dict[str, object]:
        left = {reason: sum(row["left_s"][reason] for row in group) for reason in rows[0]["left_s"]}
        return {
            "file": file,
            "seconds": f"{sum(row['duration_s'] for row in group):.2f}",
            "slip bins": sum(row["num_slip"] for row in group),
            "non-slip bins": sum(row["num_rest"] for row in group),
            **{
                f"{reason} s": f"{seconds:.2f}" if seconds else "-"
                for reason, seconds in left.items()
            },
        }

    table = [cells(row["file"], [row]) for row in rows[:most]]
    more = f", {len(rows) - most} of them not shown" if len(rows) > most else ""
    table.append(cells(f"all {len(rows)}{more}", rows))
    return style.table(table)


@style.styled
def use_figure(rows: Rows, num_all: int, path: str | Path, *, title: str) -> None:
    """Write a lane for each file: what of it is slip, non-slip, not labelled or missing over time.

    What is labelled and in no bin is paler.

    Args:
        rows: at least one, as ``use_table`` takes them, and ``spans`` in seconds by what they are.
        num_all: recordings there are; the title says if more than are drawn.
        path: the PNG to write, replaced as a whole if it exists.
        title: of the figure; says what is simulated.
    """
    some = f" (the first {len(rows)} of {num_all} files)" if num_all > len(rows) else ""
    figure = style.new_figure(10.0, 0.19 * len(rows) + 1.6, title + some)
    axes = figure.subplots()
    for lane, row in enumerate(rows):
        for kind, colour in _USES.items():
            bars = [(start, end - start) for start, end in row["spans"][kind]]
            axes.broken_barh(bars, (lane - 0.36, 0.72), facecolors=colour, linewidth=0)
        text = f"  {row['num_slip']} slip, {row['num_rest']} non-slip bins"
        axes.text(row["duration_s"], lane, text, va="center", fontsize=6.5, color=style.GREY)
    style.lanes(axes, [row["file"] for row in rows], least=2)
    axes.tick_params(axis="y", labelsize=6.5)
    axes.set_xlim(0.0, 1.25 * max(row["duration_s"] for row in rows))
    axes.set_xlabel("time, s")
    drawn = {kind for row in rows for kind, spans in row["spans"].items() if spans}
    handles = [Patch(color=colour, label=kind) for kind, colour in _USES.items() if kind in drawn]
    style.legend_below(figure, handles, len(handles))
    style.save(figure, path, dpi=120)


# Signals -----------------------------------------------------------------------------------------
@style.styled
def signals_figure(
    rows: Sequence[tuple[str, Recording]],
    channels: Channels,
    path: str | Path,
    *,
    title: str,
    views: Sequence[tuple[float, float]] | None = None,
) -> None:
    """Write one recording a row: slow channels as measured and in lanes, fast ones in lanes.

    Args:
        rows: title and recording, at least one, all of the same hand.
        channels: of the hand.
        path: the PNG to write, replaced as a whole if it exists.
        title: of the figure; says what is simulated.
        views: ``(start, end)`` in seconds of what is shown of each row, ``None`` for all.
    """
    recordings = [recording for _, recording in rows]
    views = views or [(0.0, recording.duration_s) for recording in recordings]
    columns = _columns(channels)
    colours = _channel_colours(channels)
    height = max(1.9, *(_LANE * len(places) for _, places, _ in columns))
    width = max(13.0, _COLUMN * len(columns))
    figure = style.new_figure(width, height * len(rows) + 1.3, title)
    widths = {"width_ratios": [1.0 if in_lanes else 0.75 for _, _, in_lanes in columns]}
    grid = figure.subplots(len(rows), len(columns), squeeze=False, gridspec_kw=widths)
    for panels, (row_title, row), view in zip(grid, rows, views, strict=True):
        for axes, (_, places, in_lanes) in zip(panels, columns, strict=True):
            names, own = [channels[i]["name"] for i in places], [colours[i] for i in places]
            times, values = _points(row, places, view)
            scale = lane_height(values) if in_lanes else 1.0
            if in_lanes:
                _draw_lanes(axes, times, values, names, own, scale)
                axes.set_title(f"lanes {scale:.2g} {row.units} apart", loc="right", fontsize=_NAMES)
            for line, name, colour in zip(values, names, own, strict=True):
                if not in_lanes:
                    axes.plot(times, line, color=colour, linewidth=0.7, label=name)
            _mark(axes, row, view)
        unit = "volts" if row.units == "V" else row.units
        panels[0].set_ylabel(f"{row_title}\n{unit}", color=style.INK)
    for axes, (kind, _, in_lanes) in zip(grid[0], columns, strict=True):
        how = "offsets removed" if in_lanes else "as measured"
        axes.set_title(f"{kind}, {how}")
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    style.legend_below(figure, _legend(recordings, channels), 9)
    style.save(figure, path, dpi=120)


def _columns(channels: Channels) -> list[tuple[str, list[int], bool]]:
    """Kind, channels and whether in lanes: of every slow kind two columns, of every other one."""
    groups: dict[tuple[bool, str], list[int]] = {}
    for place, channel in enumerate(channels):
        groups.setdefault((style.is_fast(channel), channel["kind"]), []).append(place)
    return [
        (kind, places, in_lanes)
        for (fast, kind), places in sorted(groups.items(), key=lambda item: item[0][0])
        for in_lanes in ((True,) if fast else (False, True))
    ]


def _channel_colours(channels: Channels) -> list[tuple[float, float, float]]:
    """A colour per channel: the hue is its finger's, paler towards the palm."""
    hues = style.colours_of(channel["finger"] for channel in channels)
    colours = []
    for channel in channels:
        pale, own = _PALER.get(channel["segment"], 0.0), to_rgb(hues[channel["finger"]])
        red, green, blue = (part + pale * (1.0 - part) for part in own)
        colours.append((red, green, blue))
    return colours


def _points(
    row: Recording, places: Sequence[int], view: tuple[float, float]
) -> tuple[NDArray[np.floating], Array]:
    """Times and samples of some channels in the view, as few as the figure can show."""
    first, last = (round(edge * row.sample_rate_hz) for edge in view)
    values = row.samples[list(places), first:last].double().cpu().numpy()
    kept = Envelope(len(places), values.shape[1], _NUM_SEGMENTS)
    kept.add(values)
    numbers, shown = kept.points()
    return (first + numbers) / row.sample_rate_hz, shown


def _draw_lanes(
    axes: Axes,
    times: NDArray[np.floating],
    values: Array,
    names: Sequence[str],
    colours: Sequence[Any],
    scale: float,
) -> None:
    """A lane per channel around its median, the first on top."""
    for lane, line in enumerate(values):
        shown = (line - median(line)) / scale
        axes.plot(times, shown - lane, color=colours[lane], linewidth=0.5, label=names[lane])
    axes.set_yticks(-np.arange(len(names)), names)
    for label, colour in zip(axes.get_yticklabels(), colours, strict=True):
        label.set_color(colour)


def _slips(row: Recording) -> Segments:
    return (*row.sliding_s, *row.slip_s)


def _mark(axes: Axes, row: Recording, view: tuple[float, float]) -> None:
    """Onsets, slip and non-slip, as far as they are in view."""
    for segments, look in ((_slips(row), _SLIP), (row.non_slip_s, _NON_SLIP)):
        for start, end in segments:
            if start < view[1] and end > view[0]:
                axes.axvspan(max(start, view[0]), min(end, view[1]), **look)
    for onset in row.onsets_s:
        if view[0] <= onset <= view[1]:
            axes.axvline(onset, **_ONSET)
    axes.set_xlim(*view)
    axes.grid(visible=False)
    axes.tick_params(labelsize=_NAMES)


def _legend(rows: Sequence[Recording], channels: Channels) -> list[Any]:
    """A line per finger, and the marks that there are."""
    fingers = style.colours_of(channel["finger"] for channel in channels)
    handles: list[Any] = [
        Line2D([], [], color=colour, linewidth=2, label=finger)
        for finger, colour in (fingers.items() if len(fingers) > 1 else ())
    ]
    if len({channel["segment"] for channel in channels} & set(_PALER)) > 1:
        handles.append(Line2D([], [], color="#CCCCCC", linewidth=2, label="paler: nearer the palm"))
    return handles + _marks(rows)


def _marks(rows: Sequence[Recording]) -> list[Any]:
    """What ``_mark`` draws in any recording, for a legend."""
    marks = (
        (any(row.onsets_s for row in rows), Line2D([], [], label="onset of slip", **_ONSET)),
        (any(map(_slips, rows)), Patch(label="slip", **_SLIP)),
        (any(row.non_slip_s for row in rows), Patch(label="non-slip", **_NON_SLIP)),
    )
    return [handle for is_there, handle in marks if is_there]


# How a recording is read ------------------------------------------------------------------------
_MOST_PANELS, _MOST_NAMED = 8, 7
_APART = 5.0  # channels whose levels differ by so many times their span are drawn without them


@style.styled
def reading_figure(recording: Recording, channels: Channels, path: str | Path, title: str) -> None:
    """Write a recording with a panel for each kind of channel, its labels and what is missing.

    Of more kinds than eight the first eight are drawn.

    Args:
        recording: one of the hand's.
        channels: of the hand.
        path: the PNG to write, replaced as a whole if it exists.
        title: of the figure.
    """
    kinds: dict[str, list[int]] = {}
    for place, channel in enumerate(channels):
        kinds.setdefault(channel["kind"], []).append(place)
    shown = list(kinds.items())[:_MOST_PANELS]
    if len(kinds) > len(shown):
        title += f"\nthe first {len(shown)} of {len(kinds)} kinds"
    figure = style.new_figure(11.0, 1.2 + max(1.5, 3.2 - 0.4 * len(shown)) * len(shown), title)
    panels = figure.subplots(len(shown), 1, squeeze=False, sharex=True)[:, 0]
    view = (0.0, recording.duration_s)
    is_missing = ~np.isfinite(recording.samples.cpu().numpy()).all(axis=0)
    for axes, (kind, places) in zip(panels, shown, strict=True):
        times, values = _points(recording, places, view)
        adapting = "fast" if style.is_fast(channels[places[0]]) else "slow"
        middles = np.array([median(line) for line in values])
        widths = np.array([span(line, 0.01) for line in values])
        note = ""
        if np.ptp(middles) > _APART * max(np.median(widths), 1e-300):
            values, note = values - middles[:, None], ", each about its median"
        colours = _shades(len(places))
        for line, place, colour in zip(values, places, colours, strict=True):
            name = channels[place]["name"]
            axes.plot(times, line, color=colour, linewidth=0.7, alpha=0.85, label=name)
        if len(places) <= _MOST_NAMED:
            axes.legend(**style.UPPER_LEFT_OUTSIDE, fontsize=_NAMES)
        many = f"{len(places)} channel{'s' * (len(places) > 1)}"
        axes.set_title(f"{kind}: {many}, {adapting}{note}")
        axes.set_ylabel(recording.units)
        _mark(axes, recording, view)
        _mark_missing(axes, is_missing, recording.sample_rate_hz)
    panels[-1].set_xlabel("time, s")
    handles = _marks([recording])
    if is_missing.any():
        handles.append(Patch(color=style.INK, label=f"missing: {is_missing.sum()} samples"))
    if handles:
        style.legend_below(figure, handles, 4)
    style.save(figure, path, dpi=120)


def _shades(num: int) -> list[Any]:
    """So many colours: those of ``PALETTE`` or, of more, a range from dark blue to yellow."""
    if num <= len(style.PALETTE):
        return list(style.PALETTE[:num])
    return list(colormaps["viridis"](np.linspace(0, 0.92, num)))


def _mark_missing(axes: Axes, is_missing: NDArray[np.bool_], sample_rate_hz: float) -> None:
    """A bar at the foot of a panel where samples are missing, wide enough to be seen."""
    least = len(is_missing) / 400
    spans = [
        (start / sample_rate_hz, max(stop - start, least) / sample_rate_hz)
        for start, stop in runs_of(is_missing).tolist()
    ]
    axes.broken_barh(
        spans, (0, 0.05), transform=axes.get_xaxis_transform(), color=style.INK, linewidth=0
    )
