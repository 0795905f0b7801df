"""What a detector heard in a recording, as the paper's last figure.

The films over time, blue where the status decided is no slip and yellow where it is slip
(paper section V-D); below them the decided and the true status, and the probability of slip.
Behind it stand the decisions that are unsure, where the detector may be. Everything stands at the
time at which it was known, so the delay of a decision can be seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tactslip_torch.report.envelope import Array
from tactslip_torch.report.onset_traces import Heard, Stretches, spans, status_at
from tactslip_torch.runtime import whole_file

REST, SLIP, ALARM = "#0072B2", "#E69F00", "#C6361B"
_PALE_SLIP = "#FFF0CC"
_INK, _GREY = "#222222", "#666666"
_INVALID: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": "#999999",
    "hatch": "////",
    "linewidth": 0,
    "zorder": 0.5,
}
_UNSURE: dict[str, Any] = {"facecolor": "#DDD6E8", "edgecolor": "none", "zorder": 0.2}
_ONSET: dict[str, Any] = {"color": _INK, "linestyle": "-."}
_ALARM: dict[str, Any] = {"color": ALARM, "linestyle": "-"}
_ESTIMATE: dict[str, Any] = {"color": ALARM, "linestyle": ":"}
_WIDTH, _ROOM = 1.2, 40  # of marks, in points, as long as there are no more of a kind
_MOST_LINES = 250


def onset_figure(heard: Heard, path: str | Path, *, title: str) -> None:
    """Write the figure that ``draw_onsets`` draws as PNG, replaced as a whole if it exists."""
    figure = draw_onsets(heard, title=title)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120, facecolor="white")


def draw_onsets(heard: Heard, *, title: str) -> Figure:
    """Draw the films in lanes, the decided and the true status, and the probability of slip.

    Args:
        heard: what is drawn.
        title: of the figure; says what is simulated.
    """
    heights = [max(1.2, 0.42 * len(heard.films)), 0.55, 1.3]
    figure = Figure(figsize=(12.0, sum(heights) + 1.3), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": heights})
    slips = spans(heard.is_slip, heard.view[1])
    invalid = spans((heard.is_valid[0], 1 - heard.is_valid[1]), heard.view[1])
    _draw_films(panels[0], heard, slips)
    _draw_status(panels[1], heard, slips)
    _draw_probability(panels[2], heard)
    unsure = spans(heard.is_unsure, heard.view[1])
    _shade(panels[2], unsure, "unsure", **_UNSURE)
    for axes in panels:
        _shade(axes, invalid, "invalid", **_INVALID)
        axes.tick_params(color="#BBBBBB", labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[:].set_color("#BBBBBB")
    panels[0].set_xlim(*heard.view)
    panels[2].set_xlabel("time, s", fontsize=9, color=_GREY)
    figure.suptitle(title, fontsize=11)
    handles = _legend(heard, bool(invalid), bool(unsure))
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8
    )
    return figure


def _draw_films(axes: Axes, heard: Heard, slips: Stretches) -> None:
    """A lane per film around its median, in the colours of the status; bursts may cross lanes."""
    known = [v[np.isfinite(v)] for _, v in heard.films.values()]
    lane_v = _lane_height([v for v in known if v.size])
    middles = -lane_v * np.arange(len(heard.films))
    lanes = zip(heard.films.values(), known, middles, strict=True)
    for place, ((times, volts), v, middle) in enumerate(lanes):
        shown = volts - (float(np.median(v)) if v.size else 0.0) + middle
        is_slip = status_at(heard.is_slip, times)
        for colour, own in ((REST, ~is_slip), (SLIP, is_slip)):
            reaching = own.copy()
            reaching[1:] |= own[:-1]  # to the first point of the other colour: no hole
            line = np.where(reaching, shown, np.nan)
            axes.plot(times, line, color=colour, linewidth=0.6, gid=f"film {place}")
    _shade(axes, slips, "slip", facecolor=_PALE_SLIP, edgecolor="none", zorder=0)
    _mark(axes, heard, heard.onsets_s, "onset", **_ONSET)
    alarms = [alarm for alarm, _ in heard.alarms]
    _mark(axes, heard, alarms, "alarm", **_ALARM)
    if 0 < len(seen := _seen(heard, alarms)) <= _MOST_LINES:
        above = axes.get_xaxis_transform()
        axes.plot(seen, [1.0] * len(seen), "v", color=ALARM, transform=above, clip_on=False)
    axes.set_yticks(middles, list(heard.films), fontsize=7)
    axes.set_ylim(middles[-1] - 0.8 * lane_v, 0.8 * lane_v)
    axes.set_ylabel(f"channels, lanes {lane_v:.2g} {heard.units} apart", fontsize=8)


def _lane_height(known: Sequence[Array]) -> float:
    """Volts between lanes: room for what is usual, while a burst may cross its neighbours."""
    usual = [float(np.subtract(*np.quantile(v, [0.95, 0.05]))) for v in known]
    bursts = [float(np.ptp(v)) for v in known]
    height_v = max([0.0, *(1.5 * v for v in usual), *(0.25 * v for v in bursts)])
    return height_v if height_v > 0 else 1.0


def _draw_status(axes: Axes, heard: Heard, slips: Stretches) -> None:
    """The decided status as a bar, and the true one below it where it is known."""
    known_s = heard.is_slip[0][0] if len(heard.is_slip[0]) else heard.view[1]
    bars = [("decided", 1, max(known_s, heard.view[0]), slips)]
    if heard.is_known:
        bars.append(("truth", 0, heard.view[0], heard.sliding_s))
    for name, level, start_s, stretches in bars:
        whole = [(start_s, heard.view[1])]
        for colour, own in ((REST, whole), (SLIP, _clipped(heard, stretches))):
            if beams := [(start, end - start) for start, end in own]:
                spot: dict[str, Any] = {"facecolor": colour, "gid": f"{name} {colour}"}
                axes.broken_barh(beams, (level - 0.35, 0.7), **spot)
    axes.set_yticks([bar[1] for bar in bars], [bar[0] for bar in bars], fontsize=8)
    axes.set_ylim(0.5 - 0.5 * len(bars) + 0.5 * (len(bars) == 1), 1.5)


def _draw_probability(axes: Axes, heard: Heard) -> None:
    times, probability = heard.probability
    axes.plot(times, probability, color=_INK, linewidth=0.8, drawstyle="steps-post")
    _mark(axes, heard, heard.onsets_s, "onset", **_ONSET)
    _mark(axes, heard, [estimate for _, estimate in heard.alarms], "estimate", **_ESTIMATE)
    axes.set_ylim(-0.04, 1.04)
    axes.set_yticks([0, 0.5, 1])
    axes.grid(axis="y", color="#E4E4E4", linewidth=0.6)
    axes.set_ylabel("P(slip)", fontsize=8)


def _legend(heard: Heard, has_invalid: bool, has_unsure: bool) -> list[Any]:
    handles: list[Any] = [
        Line2D([], [], color=REST, linewidth=2, label="decided: no slip"),
        Line2D([], [], color=SLIP, linewidth=2, label="decided: slip"),
        Line2D([], [], marker="v", label="alarm", **_ALARM),
        Line2D([], [], label="onset, detected", **_ESTIMATE),
    ]
    if heard.onsets_s:
        handles.append(Line2D([], [], label="onset, true", **_ONSET))
    if has_unsure:
        handles.append(Patch(label="unsure", **_UNSURE))
    if has_invalid:
        handles.append(Patch(label="not to be relied on", **_INVALID))
    return handles


def _mark(axes: Axes, heard: Heard, times: Sequence[float], name: str, **style: Any) -> None:
    """Lines from top to bottom, the finer the more there are; of too many their upper ends."""
    if not (seen := _seen(heard, times)):
        return  # a collection of nothing has no layout
    width = _WIDTH * min(1.0, _ROOM / len(seen)) ** 0.5
    through = axes.get_xaxis_transform()
    bottom = 0.0 if len(seen) <= _MOST_LINES else 0.97
    axes.vlines(seen, bottom, 1, transform=through, linewidth=max(width, 0.2), gid=name, **style)


def _shade(axes: Axes, stretches: Stretches, name: str, **style: Any) -> None:
    if beams := [(start, end - start) for start, end in stretches]:
        axes.broken_barh(beams, (0, 1), transform=axes.get_xaxis_transform(), gid=name, **style)


def _seen(heard: Heard, times: Sequence[float]) -> list[float]:
    return [time for time in times if heard.view[0] <= time <= heard.view[1]]


def _clipped(heard: Heard, stretches: Stretches) -> Stretches:
    first, last = heard.view
    cut = [(max(start, first), min(end, last)) for start, end in stretches]
    return [(start, end) for start, end in cut if end > start]
