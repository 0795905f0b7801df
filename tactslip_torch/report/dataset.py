"""A set of recordings as a table and a figure: what of, how long, how much of it is slip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tactslip_torch.report.envelope import Array, envelope
from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_SLIP, _QUIET, _REST = "#D55E00", "#0072B2", "#D9D9D9"  # Okabe and Ito's; grey: nothing is said
_INK, _GREY = "#222222", "#666666"
_SMALL, _TEXT, _TITLE = 7, 9, 12  # font sizes in points
_STRETCHES = 1500  # of a trace, of which the least and the greatest sample are drawn
_MOST_LANES = 24


@dataclass(frozen=True)
class Trial:
    """What is told of one recording.

    Args:
        material: of it.
        scene: of it.
        duration_s: of it.
        slip_s: seconds that are told to be slip.
        non_slip_s: seconds that are told not to be.
        num_onsets: that are known.
    """

    material: str
    scene: str
    duration_s: float
    slip_s: float
    non_slip_s: float
    num_onsets: int


@dataclass(frozen=True, eq=False)
class Example:
    """One recording to draw.

    Args:
        title: says which.
        samples: ``[C, T]``.
        names: of the channels.
        sample_rate_hz: of the samples.
        units: of the samples.
        onsets_s: known onsets.
        slip_s: stretches of slip.
        non_slip_s: stretches without.
    """

    title: str
    samples: Array
    names: Sequence[str]
    sample_rate_hz: float
    units: str
    onsets_s: Sequence[float]
    slip_s: Sequence[tuple[float, float]]
    non_slip_s: Sequence[tuple[float, float]]


def trials_table(trials: Sequence[Trial], *, simulated: bool) -> str:
    """How many recordings of each material there are, how long, and what is told of them.

    Of several scenes the same follows for each scene.
    """
    tables = [_grouped("material", trials, [trial.material for trial in trials])]
    scenes = [trial.scene for trial in trials]
    if len(set(scenes)) > 1:
        tables.append(_grouped("scene", trials, scenes))
    return "\n".join([*([SIMULATED_LINE] if simulated else []), "\n\n".join(tables)])


def _grouped(what: str, trials: Sequence[Trial], groups: Sequence[str]) -> str:
    """A row a group, in the order in which they come, and of several one of all."""
    rows = []
    for name in dict.fromkeys(groups):
        own = [trial for trial, group in zip(trials, groups, strict=True) if group == name]
        rows.append([name, *_cells(own)])
    if len(rows) > 1:
        rows.append(["all", *_cells(trials)])
    header = [what, "recordings", "shortest s", "longest s", "seconds"]
    return aligned([*header, "onsets", "slip s", "non-slip s"], rows)


def _cells(own: Sequence[Trial]) -> list[str]:
    durations = [trial.duration_s for trial in own]
    return [
        str(len(own)),
        f"{min(durations):.2f}",
        f"{max(durations):.2f}",
        f"{sum(durations):.1f}",
        str(sum(trial.num_onsets for trial in own)),
        f"{sum(trial.slip_s for trial in own):.1f}",
        f"{sum(trial.non_slip_s for trial in own):.1f}",
    ]


def ranges_table(channels: Sequence[Mapping[str, str]], ranges: Array, units: str) -> str:
    """The least and the greatest sample of the channels of each kind.

    Shape:
        - ranges: ``[C, 2]``, NaN where nothing is finite
    """
    kinds = list(dict.fromkeys(channel["kind"] for channel in channels))
    rows = []
    for kind in kinds:
        own = [place for place, channel in enumerate(channels) if channel["kind"] == kind]
        known = ranges[own][np.isfinite(ranges[own]).all(-1)]
        least, greatest = (known[:, 0].min(), known[:, 1].max()) if len(known) else (np.nan,) * 2
        rows.append([kind, str(len(own)), f"{least:.6g}", f"{greatest:.6g}"])
    return aligned(["kind", "channels", f"least, {units}", f"greatest, {units}"], rows)


def dataset_figure(trials: Sequence[Trial], example: Example, path: Path, *, title: str) -> None:
    """Write the figure that ``draw_dataset`` draws as PNG, replaced as a whole if it exists."""
    figure = draw_dataset(trials, example, title=title)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, facecolor="white", format="png")


def draw_dataset(trials: Sequence[Trial], example: Example, *, title: str) -> Figure:
    """Seconds of each material by what is told of them, and below the traces of one recording.

    Of more channels than fit, so many are drawn, evenly chosen.

    Args:
        trials: at least one.
        example: drawn in lanes, slip and non-slip shaded.
        title: of the figure; says what is simulated.

    Raises:
        ValueError: if there is no recording.
    """
    if not trials:
        raise ValueError("no recording to draw; give at least one")
    materials = list(dict.fromkeys(trial.material for trial in trials))
    num_lanes = min(len(example.names), _MOST_LANES)
    heights = [0.28 * len(materials) + 0.8, 0.2 * num_lanes + 0.9]
    figure = Figure(figsize=(11.0, sum(heights) + 0.9), layout="constrained")
    bars, traces = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
    _draw_bars(bars, trials, materials)
    _draw_traces(traces, example)
    figure.suptitle(title, fontsize=_TITLE)
    handles: list[Any] = [
        Patch(color=_SLIP, label="slip"),
        Patch(color=_QUIET, label="non-slip"),
        Patch(color=_REST, label="nothing is said"),
    ]
    if example.onsets_s:
        handles.append(Line2D([], [], color=_INK, linestyle="-.", linewidth=1, label="onset"))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=_TEXT
    )
    return figure


def _draw_bars(axes: Axes, trials: Sequence[Trial], materials: Sequence[str]) -> None:
    """A bar a material: seconds of slip, of non-slip, and of what nothing is said."""
    for place, material in enumerate(materials):
        own = [trial for trial in trials if trial.material == material]
        slip = sum(trial.slip_s for trial in own)
        quiet = sum(trial.non_slip_s for trial in own)
        whole = sum(trial.duration_s for trial in own)
        rest = max(whole - slip - quiet, 0.0)
        left = 0.0
        for width, colour in ((slip, _SLIP), (quiet, _QUIET), (rest, _REST)):
            axes.barh(place, width, left=left, color=colour, height=0.72)
            left += width
        axes.annotate(
            f"{len(own)} recording{'s' * (len(own) != 1)}",
            (left, place),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=_SMALL,
            color=_GREY,
        )
    axes.set_yticks(range(len(materials)), materials, fontsize=_TEXT)
    axes.set_ylim(len(materials) - 0.4, -0.6)
    axes.margins(x=0.12)
    axes.set_xlabel("seconds of signal", fontsize=_TEXT, color=_GREY)
    _plain(axes)


def _draw_traces(axes: Axes, example: Example) -> None:
    """Channels in lanes, each on a scale of its own, over shaded stretches."""
    num = len(example.names)
    chosen = sorted({round(place) for place in np.linspace(0, num - 1, min(num, _MOST_LANES))})
    duration_s = example.samples.shape[-1] / example.sample_rate_hz
    for stretches, colour in ((example.slip_s, _SLIP), (example.non_slip_s, _QUIET)):
        for start, end in stretches:
            axes.axvspan(start, end, facecolor=colour, alpha=0.16, linewidth=0, zorder=0)
    for onset in example.onsets_s:
        axes.axvline(onset, color=_INK, linestyle="-.", linewidth=0.9, zorder=1)
    indices, seen = envelope(example.samples[chosen], _STRETCHES)
    heights = []
    for lane, (places, values) in enumerate(zip(indices, seen, strict=True)):
        known = values[np.isfinite(values)]
        low, high = np.quantile(known, [0.01, 0.99]) if known.size else (0.0, 0.0)
        height = float(high - low) or 1.0
        heights.append(height)
        drawn = np.clip(0.8 * (values - (low + high) / 2) / height, -1.2, 1.2)
        axes.plot(places / example.sample_rate_hz, drawn - lane, color=_INK, linewidth=0.45)
    labels = [
        f"{example.names[i]}  {height:.3g} {example.units}"
        for i, height in zip(chosen, heights, strict=True)
    ]
    axes.set_yticks(-np.arange(len(chosen)), labels, fontsize=_SMALL)
    axes.set_ylim(-len(chosen) + 0.2, 0.8)
    axes.set_xlim(0.0, duration_s)
    axes.set_xlabel("time, s", fontsize=_TEXT, color=_GREY)
    some = "" if len(chosen) == num else f", {len(chosen)} of {num} channels"
    what = f"{example.title}{some}; beside each name the span of all but 2 % of it"
    axes.set_title(what, fontsize=_TEXT, color=_GREY)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.tick_params(color="#BBBBBB", labelsize=_SMALL + 0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[:].set_color("#BBBBBB")
