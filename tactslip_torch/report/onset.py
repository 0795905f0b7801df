"""Decisions on streams: what is kept while one passes, its figure, table and files.

The figure of a recording follows the paper's last one (section V-D): fast channels over time, blue
where no slip is decided and yellow where slip is; below them the decided and the true status, and
the probability of slip. Everything stands at the time at which it was known, so the delay of a
decision can be seen. Of many recordings there is an overview, a row each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from tactslip_torch.report import style
from tactslip_torch.report.results import few_events
from tactslip_torch.runtime import runs_of, write_json

Array = NDArray[np.float64]
Segments = Sequence[tuple[float, float]]
"""Start and end of each, in seconds."""
Columns = Mapping[str, NDArray[Any]]
"""Of decisions ``[m]``, by the names that ``onset.decisions.Decisions`` has for them."""

REST, SLIP = style.BLUE, style.ORANGE
_QUIET = "#B5D0E4"  # no slip, under marks
COLUMNS = (
    *("file", "alarm_s", "onset_s", "end_s", "score", "probability", "statistic"),
    *("in_range", "channels_lost", "raised_by"),
    *("outcome", "true_onset_s", "delay_s", "simulated"),
)
"""Of ``onsets.csv``."""
_NUM_SEGMENTS = 1500  # of each line, of which the least and the greatest value are kept
_MOST_ROWS = 40
_MOST_DRAWN = 60  # rows of an overview
_SAME_S = 1e-8
_WIDTH, _ROOM = 1.2, 40  # of marks, in points, as long as there are no more of a kind
_INVALID: dict[str, Any] = {
    "facecolor": "none", "edgecolor": "#999999", "hatch": "////", "linewidth": 0, "zorder": 0.5,
}  # fmt: skip
_HIDDEN: dict[str, Any] = {"facecolor": "white", "zorder": 1.5, "gid": "invalid"}
_LANE, _LEAST_LANE, _HIGH = 0.3, 0.15, 7.2  # inches: of a channel, its least, of many together
_MOST_DELAYS = 12  # reported beside their alarms
_ONSET: dict[str, Any] = {"color": style.INK, "linestyle": "-."}
_RELEASE: dict[str, Any] = {"color": style.GREY, "linestyle": ":"}
_ALARM: dict[str, Any] = {"color": style.ALARM, "linestyle": "-"}
_ESTIMATE: dict[str, Any] = {"color": style.ALARM, "linestyle": ":"}


# While a stream passes ---------------------------------------------------------------------------
class Envelope:
    """The least and the greatest sample of each segment of a signal that comes in pieces.

    A line through them looks like the line through all samples, and no burst is lost. Signals of
    at most twice as many samples as segments are kept whole. Samples that are not finite count only
    where a segment has no others, and are NaN then: a gap.

    Args:
        num_channels: ``C``.
        num_samples: that will come in all.
        num_segments: that are kept.
    """

    def __init__(self, num_channels: int, num_samples: int, num_segments: int) -> None:
        self._size = max(1, -(-num_samples // num_segments))
        self._rest: Array = np.empty((num_channels, 0))
        self._kept = [self._rest]

    def add(self, values: NDArray[np.floating]) -> None:
        """Take the next samples, ``[C, n]``; ``n`` may be 0."""
        waiting = np.concatenate([self._rest, values], axis=1)
        whole = waiting.shape[1] // self._size * self._size
        if whole:  # so that the list is no longer than there are segments
            self._kept.append(self._reduced(waiting[:, :whole]))
        self._rest = waiting[:, whole:].copy()

    def points(self) -> tuple[NDArray[np.floating], Array]:
        """Numbers of samples, ``[M]``, and values there, ``[C, M]``; the last segment as it is.

        Of a longer signal two values stand at the first sample of each segment.
        """
        self._kept = [np.concatenate([*self._kept, self._reduced(self._rest)], axis=1)]
        self._rest = self._rest[:, :0]
        (values,) = self._kept
        numbers = np.arange(values.shape[1], dtype=np.float64)
        return (numbers if self._size <= 2 else numbers // 2 * self._size), values

    def _reduced(self, values: Array) -> Array:
        finite = np.where(np.isfinite(values), values, np.nan)
        starts = np.arange(0, values.shape[1], self._size)
        if self._size <= 2 or not len(starts):
            return finite
        ends = [extreme.reduceat(finite, starts, axis=1) for extreme in (np.fmin, np.fmax)]
        return np.stack(ends, axis=2).reshape(len(values), -1)


class Traces:
    """Gathers samples and decisions of a recording; its memory does not grow with the length.

    Args:
        channels: names of the rows of the samples, which are drawn in this order.
        sample_rate_hz: of the samples.
        hop_s: distance of two decisions.
        view: start and end of what is drawn, in seconds.
        units: of the samples.
        kinds: of each channel; those of a kind are drawn to one scale.
    """

    def __init__(
        self,
        channels: Sequence[str],
        sample_rate_hz: float,
        hop_s: float,
        view: tuple[float, float],
        units: str = "V",
        kinds: Sequence[str] = (),
    ) -> None:
        self.channels, self.view, self.units = channels, view, units
        self.kinds = tuple(kinds) or ("",) * len(channels)
        self._sample_rate_hz, self._hop_s = sample_rate_hz, hop_s
        self._first, self._stop = (round(edge * sample_rate_hz) for edge in view)
        length, num_decisions = self._stop - self._first, round((view[1] - view[0]) / hop_s)
        self._samples = Envelope(len(channels), length, _NUM_SEGMENTS)
        self._decisions = Envelope(4, num_decisions, _NUM_SEGMENTS)
        self._num_samples = 0
        self._first_s: float | None = None

    def add_samples(self, samples: NDArray[np.floating]) -> None:
        """Take the next samples, ``[C, n]``."""
        first, stop = (max(edge - self._num_samples, 0) for edge in (self._first, self._stop))
        self._num_samples += samples.shape[1]
        self._samples.add(samples[:, first:stop])

    def add_decisions(self, of: Columns) -> None:
        """Take the next decisions; ``onset_score`` is NaN where there is none."""
        available_s = of["available_s"]
        since_s = self.view[0] - self._hop_s  # the one before the view has the status there
        is_seen = (available_s > since_s) & (available_s <= self.view[1])
        if self._first_s is None and is_seen.any():
            self._first_s = float(available_s[is_seen][0])
        # what is on anywhere stays seen
        columns = (of["probability"], of["is_on"], 1 - of["is_valid"], of["onset_score"])
        self._decisions.add(np.stack(columns)[:, is_seen])

    def samples(self) -> tuple[NDArray[np.floating], Array]:
        """Times in seconds, ``[M]``, and samples of the drawn channels, ``[C, M]``."""
        numbers, values = self._samples.points()
        return (self._first + numbers) / self._sample_rate_hz, values

    def decisions(self) -> tuple[NDArray[np.floating], Array]:
        """Times in seconds, ``[M]``, and ``[4, M]``.

        Probability, slip, not valid and the onset score, NaN where there is none.
        """
        numbers, values = self._decisions.points()
        return (self._first_s or 0.0) + numbers * self._hop_s, values


class DecisionCounts:
    """Adds up decisions on a stream: counts, and alarms with their ends.

    Args:
        onsets_s: when true slips begin, as far as that is known.

    Attributes:
        num_decisions: so far.
        num_invalid: of them, those that do not count: too few channels are alive.
        first_positive_s: of each onset, the first decision from it on that is slip; NaN.
    """

    def __init__(self, onsets_s: Sequence[float] = ()) -> None:
        self.num_decisions = self.num_invalid = 0
        self.first_positive_s = [math.nan] * len(onsets_s)
        self._onsets_s = tuple(onsets_s)
        self._alarms: list[dict[str, Any]] = []
        self._ends_s: list[float] = []
        self._was_on = False

    def add(self, of: Columns, alarms: Sequence[Mapping[str, Any]]) -> None:
        """Take the next decisions, and the alarms that they raised."""
        available_s = of["available_s"]
        self.num_decisions += len(available_s)
        self.num_invalid += int((~of["is_valid"]).sum())
        self._alarms += map(dict, alarms)
        status = np.concatenate([[self._was_on], of["is_on"]])
        self._ends_s += available_s[status[:-1] & ~status[1:]].tolist()
        self._was_on = bool(status[-1])
        positive_s = available_s[of["llr"] > 0]
        for place, onset in enumerate(self._onsets_s):
            after = positive_s[positive_s >= onset]
            if math.isnan(self.first_positive_s[place]) and len(after):
                self.first_positive_s[place] = float(after[0])

    @property
    def alarms(self) -> list[dict[str, Any]]:
        """Those so far, each with its ``end_s``; ``None`` while it stands."""
        ends = [*self._ends_s, *[None] * (len(self._alarms) - len(self._ends_s))]
        return [alarm | {"end_s": end} for alarm, end in zip(self._alarms, ends, strict=True)]


def view_of(given: Any, duration_s: float) -> tuple[float, float]:
    """What is drawn of a recording: all of it, or ``[start, end]`` as far as it goes.

    Raises:
        ValueError: if that is no such pair, or begins behind the recording.
    """
    if given is None:
        return 0.0, duration_s
    edges = list(given) if isinstance(given, Sequence) and not isinstance(given, str) else []
    if len(edges) != 2 or not all(type(edge) in (int, float) for edge in edges):
        raise ValueError(f"view must be [start, end] in seconds, got {given!r}")
    start, end = max(float(edges[0]), 0.0), min(float(edges[1]), duration_s)
    if not start < end:
        raise ValueError(f"view={given!r} shows nothing of {duration_s:g} s")
    return start, end


# Tables and files --------------------------------------------------------------------------------
def alarm_outcome(alarm_s: float, truth: Mapping[str, Any]) -> dict[str, Any]:
    """What an alarm was: its ``outcome`` as in ``_onset_rows``, of which onset, and how late.

    Args:
        alarm_s: when it was raised.
        truth: of an entry of ``onsets.json``.
    """
    if alarm_s in truth["false_alarms_s"]:
        return {"outcome": "false", "true_onset_s": None, "delay_s": None}
    for onset in truth["onsets"]:  # onsets ascend: the last one that has begun stays
        delay_s, first_s = alarm_s - onset["onset_s"], onset.get("first_release_s")
        since_s = delay_s if first_s is None else alarm_s - first_s
        is_found = onset["outcome"] == "found" and abs(delay_s - onset["delay_s"]) < _SAME_S
        if is_found or since_s > -truth["early_s"] - _SAME_S:
            after = "late" if onset["outcome"] == "missed" else "repeated"
            outcome = "found" if is_found else "early" if since_s < 0 else after
            result = {"outcome": outcome, "true_onset_s": onset["onset_s"], "delay_s": delay_s}
        if is_found:
            break
    return result


def _onset_rows(content: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Every alarm, and every onset that was missed, in order of time; each with all ``COLUMNS``.

    ``outcome`` is that of the alarm: it ``found`` a slip, came ``early``, ``repeated`` the alarm of
    a slip, came too ``late`` for one that was missed, or is ``false``; or ``missed``, of an onset.
    ``None`` where the truth is not known.

    Args:
        content: of ``onsets.json``.
    """
    rows: list[dict[str, Any]] = []
    for entry in content["recordings"]:
        events = [alarm | {"at": alarm["alarm_s"]} for alarm in entry["alarms"]]
        events += [
            {"outcome": "missed", "true_onset_s": onset["onset_s"], "at": onset["onset_s"]}
            for onset in (entry["truth"] or {}).get("onsets", ())
            if onset["outcome"] == "missed"
        ]
        named = {"file": entry["file"], "simulated": entry["simulated"]}
        for event in sorted(events, key=lambda event: float(event["at"])):
            rows.append({column: (named | event).get(column) for column in COLUMNS})
    return rows


def onsets_title(entry: Mapping[str, Any], *, of_simulated: bool) -> str:
    """A line about one recording, which says what of it is simulated.

    Args:
        entry: of ``onsets.json``.
        of_simulated: whether the detector was trained on simulated data.
    """
    of = f" of {entry['material']}" if entry["material"] else ""
    title = [f"{'SIMULATED recording' if entry['simulated'] else 'Recording'} {entry['file']}{of}"]
    count = len(entry["alarms"])
    title += [f"{count} alarm{'s' * (count != 1)}"]
    if truth := entry["truth"]:
        num_found = sum(onset["outcome"] == "found" for onset in truth["onsets"])
        title += [f"{num_found} of {len(truth['onsets'])} slips found"]
        title += [f"{len(truth['false_alarms_s'])} false"]
    title += ["detector trained on simulated data"] if of_simulated else []
    return ", ".join(title)


def onsets_table(content: Mapping[str, Any]) -> str:
    """The first rows of ``_onset_rows`` as text; the first line says whether any is simulated.

    Args:
        content: of ``onsets.json``.
    """
    rows = _onset_rows(content)
    shown = []
    for row in rows[:_MOST_ROWS]:
        cells: dict[str, object] = {"file": row["file"], "alarm s": _seconds(row["alarm_s"])}
        cells |= {"onset s": _seconds(row["onset_s"]), "P(slip)": _seconds(row["probability"], 2)}
        in_range = "NO" if row["in_range"] is False else row["in_range"]
        cells |= {"by": row["raised_by"], "in range": in_range}
        cells |= {"true onset s": _seconds(row["true_onset_s"])}
        cells |= {"delay s": _seconds(row["delay_s"]), "outcome": row["outcome"]}
        shown.append(cells)
    is_known = any(entry["truth"] for entry in content["recordings"])
    nothing = "no alarm" + ", and no slip missed" * is_known
    lines = [style.table(shown, merged=1, kept=1) if rows else nothing]
    if len(rows) > _MOST_ROWS:
        lines.append(f"and {len(rows) - _MOST_ROWS} more, see onsets.csv")
    return style.marked(content["simulated"], *lines)


def onsets_summary(content: Mapping[str, Any], seconds: float) -> str:
    """What was detected in all, in a few lines.

    Args:
        content: of ``onsets.json``.
        seconds: that it took.
    """
    entries = content["recordings"]
    duration_s = sum(entry["duration_s"] for entry in entries)
    alarms = sum(len(entry["alarms"]) for entry in entries)
    invalid = sum(entry["decisions"]["invalid"] for entry in entries)
    number = sum(entry["decisions"]["number"] for entry in entries)
    lines = [
        f"alarms: {alarms} in {duration_s:.1f} s (recordings: {len(entries)}); "
        f"took {seconds:.1f} s, {duration_s / seconds:.0f} times real time"
    ]
    if invalid:
        lines.append(
            f"NOTE: {100 * invalid / number:.1f} % of the decisions are not valid: samples "
            "are missing, or too few channels are alive; such decisions raise no alarm"
        )
    if events := content["events"]:
        delay = events["delay_ms"]
        median = f", median delay {delay['median']['value']:.1f} ms" if delay else ""
        if slid := events["slid_mm"]:
            median += f" ({slid['median']['value']:.1f} mm slid)"
        lines.append(
            f"slips found: {events['num_found']} of {events['num_onsets']}{median}; "
            f"early: {events['num_early']}, missed: {events['num_missed']}; "
            f"false alarms: {events['num_false_alarms']} in {60 * events['quiet_hours']:.2f} "
            "minutes without slip"
        )
        lines += [few] if (few := few_events(events)) else []
    return "\n".join(lines)


def _seconds(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def write_onsets(content: Mapping[str, Any], folder: Path) -> None:
    """Write ``onsets.json`` and ``onsets.csv``, each whole or not at all.

    Args:
        content: of ``onsets.json``.
        folder: where they go.
    """
    write_json(folder / "onsets.json", content)
    with style.csv_writer(folder / "onsets.csv", COLUMNS) as write:
        write(row.values() for row in _onset_rows(content))


# Figure ------------------------------------------------------------------------------------------
@style.styled
def onset_figure(
    traces: Traces,
    entry: Mapping[str, Any],
    path: str | Path,
    *,
    onset_threshold: float | None = None,
    title: str,
) -> None:
    """Write channels in lanes, the decided and the true status, and the probability of slip.

    With an onset classifier its score too.

    Args:
        traces: what was gathered of the recording.
        entry: of ``onsets.json``, whose alarms and, where it is known, truth are marked.
        path: the PNG to write, replaced as a whole if it exists.
        onset_threshold: of the onset classifier; ``None``: there is none.
        title: of the figure; says what is simulated.
    """
    lane = min(_LANE, max(_LEAST_LANE, _HIGH / len(traces.channels)))
    heights = [max(1.2, lane * len(traces.channels)), 0.55, 1.3]
    heights += [] if onset_threshold is None else [1.3]
    figure = style.new_figure(12.0, sum(heights) + 1.3, title)
    panels = figure.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights})
    first, last = traces.view
    alarms, truth = entry["alarms"], entry["truth"]
    onsets = truth["onsets"] if truth else []
    onsets_s = [onset["onset_s"] for onset in onsets]
    first_s = [s for onset in onsets if (s := onset.get("first_release_s")) is not None]
    decided_s, (probability, *statuses, onset_score) = traces.decisions()
    slips, invalid = (_spans(decided_s, status, last) for status in statuses)
    for axes in panels:
        _shade(axes, invalid, "invalid", **_INVALID)
    _draw_channels(panels[0], traces, slips)
    bars = {"decided": (max(decided_s[0], first) if len(decided_s) else last, slips)}
    bars |= {"truth": (first, truth["sliding_s"])} if truth else {}
    _draw_status(panels[1], bars, traces.view)
    panels[2].plot(decided_s, probability, color=style.INK, linewidth=0.8, drawstyle="steps-post")
    panels[2].set(ylim=(-0.04, 1.04), yticks=[0, 0.5, 1])
    panels[2].set_ylabel("P(slip)")
    if onset_threshold is not None:
        panels[3].plot(decided_s, onset_score, color=style.INK, linewidth=0.8)
        panels[3].axhline(onset_threshold, color=style.ALARM, linewidth=0.8, linestyle="--")
        panels[3].set_ylabel("onset score")
    panels[0].set_xlim(first, last)
    raised_s, estimates_s = ([alarm[key] for alarm in alarms] for key in ("alarm_s", "onset_s"))
    for axes, times, name, look in (
        (panels[0], first_s, "first release", _RELEASE),
        (panels[0], onsets_s, "onset", _ONSET),
        (panels[0], raised_s, "alarm", _ALARM),
        (panels[2], onsets_s, "onset", _ONSET),
        (panels[2], estimates_s, "estimate", _ESTIMATE),
    ):
        _mark(axes, times, name, **look)
    _tell_delays(panels[0], alarms)
    panels[-1].set_xlabel("time, s")
    handles: list[Any] = [
        Line2D([], [], color=REST, linewidth=2, label="decided: no slip"),
        Line2D([], [], color=SLIP, linewidth=2, label="decided: slip"),
        Line2D([], [], marker="v", label="alarm", **_ALARM),
        Line2D([], [], label="onset, detected", **_ESTIMATE),
    ]
    handles += [Line2D([], [], label="first release, true", **_RELEASE)] if first_s else []
    handles += [Line2D([], [], label="onset, true", **_ONSET)] if onsets_s else []
    handles += [Patch(label="not valid", **_INVALID)] if invalid else []
    style.legend_below(figure, handles, len(handles))
    style.save(figure, path, dpi=120)


class OverviewRow(NamedTuple):
    """What an overview shows of a recording.

    Args:
        entry: of ``onsets.json``.
        view: start and end of what is shown, in seconds.
        slips: where slip is decided.
        invalid: where decisions are not valid.
    """

    entry: Mapping[str, Any]
    view: tuple[float, float]
    slips: Segments
    invalid: Segments

    @classmethod
    def of(cls, entry: Mapping[str, Any], traces: Traces) -> OverviewRow:
        """From an entry of ``onsets.json`` and what was gathered of its recording."""
        decided_s, (_, is_slip, is_invalid, _) = traces.decisions()
        end_s = traces.view[1]
        return cls(
            entry,
            traces.view,
            slips=_spans(decided_s, is_slip, end_s),
            invalid=_spans(decided_s, is_invalid, end_s),
        )

    @property
    def is_of_note(self) -> bool:
        """Whether there is an alarm in it, or a slip that none found."""
        onsets = (self.entry["truth"] or {}).get("onsets", ())
        is_missed = any(onset["outcome"] == "missed" for onset in onsets)
        return bool(self.entry["alarms"]) or is_missed


@style.styled
def overview_figure(rows: Sequence[OverviewRow], path: str | Path, *, of_simulated: bool) -> None:
    """Write a picture of many recordings, a row each: decided and true slip, and alarms.

    Of more than 60, those with an alarm or a missed slip come before others; the title says so.

    Args:
        rows: of the recordings, in the order of files.
        path: the PNG to write, replaced as a whole if it exists.
        of_simulated: whether the detector was trained on simulated data.
    """
    order = sorted(range(len(rows)), key=lambda place: (not rows[place].is_of_note, place))
    drawn = [rows[place] for place in sorted(order[:_MOST_DRAWN])]
    has_truth = any(row.entry["truth"] for row in drawn)
    title = _overview_title(rows, len(drawn), of_simulated)
    figure = style.new_figure(12.0, 1.5 + 0.2 * max(len(drawn), 3), title)
    axes = figure.subplots()
    slip_height = 0.4 if has_truth else 0.7
    for place, row in enumerate(drawn):
        truth = row.entry["truth"]
        onsets = truth["onsets"] if truth else ()
        bars: list[tuple[Segments, float, float, dict[str, Any]]] = []
        bars += [([row.view], -0.35, slip_height, {"facecolor": _QUIET, "gid": "recording"})]
        bars += [(row.slips, -0.35, slip_height, {"facecolor": SLIP, "gid": "slip"})]
        bars += [(row.invalid, -0.35, slip_height, _INVALID | _HIDDEN)]
        if truth:
            bars += [([row.view], 0.08, 0.27, {"facecolor": "#EEEEEE", "gid": "known"})]
            bars += [(truth["sliding_s"], 0.08, 0.27, {"facecolor": style.GREEN, "gid": "truth"})]
        for segments, low, height, look in bars:
            if beams := [(start, end - start) for start, end in segments]:
                axes.broken_barh(beams, (place + low, height), **look)
        alarms = [alarm["alarm_s"] for alarm in row.entry["alarms"]]
        starts = [onset["onset_s"] for onset in onsets]
        axes.vlines(starts, place + 0.05, place + 0.38, color=style.INK, linewidth=1.2, gid="onset")
        axes.vlines(alarms, place - 0.4, place + 0.1, color=style.ALARM, linewidth=1, gid="alarm")
        axes.plot(alarms, np.full(len(alarms), place - 0.4), "v", color=style.ALARM, markersize=4)
    names = [row.entry["file"] for row in drawn]
    axes.set_yticks(range(len(drawn)), names, fontsize=7)
    axes.set_ylim(max(len(drawn), 3) - 0.4, -0.8)
    axes.set_xlim(min(row.view[0] for row in drawn), max(row.view[1] for row in drawn))
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("time, s")
    handles: list[Any] = [
        Patch(facecolor=_QUIET, label="decided: no slip"),
        Patch(facecolor=SLIP, label="decided: slip"),
        Line2D([], [], marker="v", label="alarm", **_ALARM),
    ]
    if has_truth:
        handles += [Patch(facecolor=style.GREEN, label="slip, true")]
        handles += [Line2D([], [], color=style.INK, label="onset, true")]
    handles += [Patch(label="not valid", **_INVALID)] if any(row.invalid for row in drawn) else []
    style.legend_below(figure, handles, len(handles))
    style.save(figure, path, dpi=110)


def _overview_title(rows: Sequence[OverviewRow], num_drawn: int, of_simulated: bool) -> str:
    """How many recordings and alarms there are, which are drawn, and what is simulated."""
    entries = [row.entry for row in rows]
    simulated = "SIMULATED recordings" if any(e["simulated"] for e in entries) else "recordings"
    count = sum(len(entry["alarms"]) for entry in entries)
    title = [f"{len(rows)} {simulated}", f"{count} alarm{'s' * (count != 1)}"]
    if num_drawn < len(rows):
        title += [f"{num_drawn} shown, those with an alarm or a missed slip first"]
    title += ["detector trained on simulated data"] if of_simulated else []
    return ", ".join(title)


def _draw_channels(axes: Axes, traces: Traces, slips: Segments) -> None:
    """A lane per channel around its median, in the colours of the status; bursts may cross."""
    times, samples = traces.samples()
    of_kind = {
        kind: [values for values, own in zip(samples, traces.kinds, strict=True) if own == kind]
        for kind in dict.fromkeys(traces.kinds)
    }
    heights = {kind: lane_height(lines) for kind, lines in of_kind.items()}
    middles = -np.arange(len(samples))
    is_slip = np.searchsorted(np.ravel(slips), times, side="right") % 2 == 1
    for place, values in enumerate(samples):
        lane = (values - median(values)) / heights[traces.kinds[place]] + middles[place]
        for colour, shown in ((REST, ~is_slip), (SLIP, is_slip)):
            reaching = shown.copy()
            reaching[1:] |= shown[:-1]  # to the first point of the other colour: no hole
            line = np.where(reaching, lane, np.nan)
            axes.plot(times, line, color=colour, linewidth=0.6, gid=f"channel {place}")
    _shade(axes, slips, "slip", facecolor="#FFF0CC", edgecolor="none", zorder=0)
    axes.set_yticks(middles, list(traces.channels), fontsize=7)
    axes.set_ylim(middles[-1] - 0.8, 0.8)
    axes.grid(visible=False)
    shown = ", ".join(
        f"{kind} {float(f'{high:.2g}'):g} {traces.units}".strip() for kind, high in heights.items()
    )
    text = f"distance of channels: {shown}"
    axes.set_title(text, loc="right", fontsize=7.5, color=style.GREY, pad=14)  # above the delays


def _tell_delays(axes: Axes, alarms: Sequence[Mapping[str, Any]]) -> None:
    """How late each alarm came, beside its line, where there is place for it."""
    first, last = axes.get_xlim()
    known = [alarm for alarm in alarms if alarm.get("delay_s") is not None]
    inside = [alarm for alarm in known if first <= alarm["alarm_s"] <= last]
    look: dict[str, Any] = {"color": style.ALARM, "fontsize": 8, "va": "bottom"}
    look |= {"xycoords": axes.get_xaxis_transform(), "textcoords": "offset points"}
    for alarm in inside if len(inside) <= _MOST_DELAYS else ():
        text = f"{1000 * alarm['delay_s']:+.0f} ms"
        axes.annotate(text, (alarm["alarm_s"], 1.0), xytext=(4, 2), **look)


def lane_height(lines: Iterable[Array]) -> float:
    """Distance of lanes: enough for what is usual, while a burst may cross its neighbours."""
    return max(max(1.5 * span(line, 0.05), 0.25 * span(line)) for line in lines) or 1.0


def span(line: Array, fraction: float = 0.0) -> float:
    """Of the finite values but so many at either end; 0 of none."""
    known = line[np.isfinite(line)]
    ends = np.quantile(known, [1 - fraction, fraction]) if known.size else (0.0, 0.0)
    return float(np.subtract(*ends))


def median(line: Array) -> float:
    """Of the finite values; 0 of none."""
    known = line[np.isfinite(line)]
    return float(np.median(known)) if known.size else 0.0


def _draw_status(
    axes: Axes, bars: Mapping[str, tuple[float, Segments]], view: tuple[float, float]
) -> None:
    """The decided status as a bar, and the true one below it where it is known."""
    first, last = view
    for level, (name, (start_s, segments)) in enumerate(bars.items()):
        cut = [(max(start, first), min(end, last)) for start, end in segments]
        in_view = [(start, end) for start, end in cut if end > start]
        for colour, drawn in ((REST, [(start_s, last)]), (SLIP, in_view)):
            if beams := [(start, end - start) for start, end in drawn]:
                place = (level - 0.35, 0.7)
                axes.broken_barh(beams, place, facecolor=colour, gid=f"{name} {colour}")
    axes.set_yticks(range(len(bars)), list(bars))
    axes.set_ylim(len(bars) - 0.5, -0.5)
    axes.grid(visible=False)


def _mark(axes: Axes, times: Sequence[float], name: str, **look: Any) -> None:
    """Lines from top to bottom, the finer the more there are; a triangle above an alarm."""
    first, last = axes.get_xlim()
    if seen := [time for time in times if first <= time <= last]:  # of nothing there is no layout
        width = max(0.2, _WIDTH * min(1.0, _ROOM / len(seen)) ** 0.5)
        through = axes.get_xaxis_transform()
        axes.vlines(seen, 0, 1, transform=through, linewidth=width, gid=name, **look)
        if name == "alarm":
            dots: dict[str, Any] = {"color": style.ALARM, "markersize": 4, "clip_on": False}
            axes.plot(seen, np.ones(len(seen)), "v", transform=through, **dots)


def _shade(axes: Axes, segments: Segments, name: str, **look: Any) -> None:
    if beams := [(start, end - start) for start, end in segments]:
        axes.broken_barh(beams, (0, 1), transform=axes.get_xaxis_transform(), gid=name, **look)


def _spans(times: NDArray[np.floating], status: Array, end_s: float) -> list[tuple[float, float]]:
    """Segments in which a status is on; it holds from its time to the next, at last to the end."""
    bounds = np.append(times, end_s)[runs_of(status >= 0.5)]
    return [(float(start), float(end)) for start, end in bounds if end > start]
