"""Slips found and false alarms: the table and the figure of ``metrics.json``'s events.

Each role has rules, and each rule what ``onset.events`` counts. Rates are by the hour where at
least an hour without slip was watched, else by the minute.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

Events = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Numbers of events by role and rule."""

_HEADER = ["events", "rule", "slips", "found %", "early %", "missed %", "delay ms", "p95 ms"]
_HEADER += ["false alarms", "slip-free", "alarms a slip"]
_COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#56B4E9", "#222222", "#A6761D")
_LINES = ("-", "--", ":")  # of the first colours, the next, and so on
_OUTCOMES = {"found": "#009E73", "early": "#E69F00", "missed": "#999999"}
_REFLEX_MS = (60.0, 90.0)
_INK, _GREY, _GRID = "#222222", "#666666", "#DDDDDD"


def events_table(metrics: Mapping[str, Any]) -> str:
    """One row for each role and rule; brackets hold intervals.

    ``delay`` is the median from the exact onset to the alarm, look-ahead within; ``slip-free`` is
    how long an alarm would have been false. Where compute was measured, the parts of the mean delay
    follow in a second table. The first line says SIMULATED where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[list[str]] = []
    parts: list[list[str]] = []
    reasons: dict[str, None] = {}
    for role, by_rule in metrics["events"].items():
        for place, (rule, numbers) in enumerate(by_rule.items()):
            first = [role if place == 0 else "", _words(rule)]
            rows.append([*first, *_cells(numbers)])
            parts.append([*first, *_latency_cells(numbers)])
            if reason := numbers.get("reason"):
                reasons[reason] = None
    lines = [SIMULATED_LINE] if metrics["simulated"] else []
    lines.append(aligned(_HEADER, rows, num_left=2))
    if reasons:
        lines.append(f"no events: {'; '.join(reasons)}")
    if any(row[-1] != "-" for row in parts):
        header = ["mean delay, ms", "rule", "look-ahead", "bin fill", "decision", "all"]
        lines += ["", aligned([*header, "compute beside"], parts, num_left=2)]
    return "\n".join(lines)


def has_events(metrics: Mapping[str, Any]) -> bool:
    """Whether any rule was judged on a recording: something to draw.

    Args:
        metrics: the content of ``metrics.json``.
    """
    return any(_drawn(by_rule) for by_rule in metrics.get("events", {}).values())


def events_figure(metrics: Mapping[str, Any], path: str | Path) -> None:
    """Write slips found by time since the onset, and what became of all, as a PNG.

    A row for each role: to the left the share of slips that were found so many ms behind the onset,
    a line for each rule, of which the latest 5 % may leave the picture; to the right found, early
    and missed, with the false alarms.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there is nothing to draw.
    """
    events = {
        role: drawn for role, of in metrics.get("events", {}).items() if (drawn := _drawn(of))
    }
    if not events:
        raise ValueError("metrics has no events to draw")
    rules = list(dict.fromkeys(_words(rule) for by_rule in events.values() for rule in by_rule))
    styles = {
        rule: {"color": _COLOURS[place % len(_COLOURS)], "ls": _LINES[place // len(_COLOURS) % 3]}
        for place, rule in enumerate(rules)
    }
    heights = [1.3 + 0.3 * max(2, len(by_rule)) for by_rule in events.values()]
    figure = Figure(figsize=(11.0, 1.3 + sum(heights)), layout="constrained")
    kind = " (SIMULATED hand)" if metrics["simulated"] else ""
    figure.suptitle(f"Which slips are found, how late, and at what price{kind}", fontsize=13)
    panels = figure.subplots(
        len(events), 2, sharex="col", squeeze=False,
        gridspec_kw={"width_ratios": [1.25, 1.0], "height_ratios": heights},
    )  # fmt: skip
    for (role, by_rule), (left, right) in zip(events.items(), panels, strict=True):
        _delays(left, by_rule, styles)
        _bars(right, by_rule, styles)
        left.set_title(role, loc="left", fontsize=11, fontweight="bold")
    late = [
        numbers["delay_ms"]["p95"]["value"]
        for by_rule in events.values()
        for numbers in by_rule.values()
        if numbers["delay_ms"]
    ]
    panels[-1][0].set_xlim(0, 1.5 * max([_REFLEX_MS[1], *late]))  # the last 5 % may leave
    panels[-1][0].set_xlabel("time since the exact onset, ms (look-ahead within)", fontsize=9.5)
    panels[-1][1].set_xlabel("of all slips, %", fontsize=9.5)
    _legend(figure, styles)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _words(rule: str) -> str:
    return rule.replace("_", " ")


def _drawn(by_rule: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {rule: numbers for rule, numbers in by_rule.items() if numbers["num_recordings"]}


def _delays(
    axes: Axes, by_rule: Mapping[str, Mapping[str, Any]], styles: Mapping[str, Mapping[str, Any]]
) -> None:
    """The share of slips found by then, from the kept quantiles of the delays."""
    axes.axvspan(*_REFLEX_MS, color="#F0E6C8", zorder=0, lw=0)
    for rule, numbers in by_rule.items():
        if numbers["delay_ms"] is None:
            continue
        quantiles = numbers["delay_ms"]["quantiles"]
        found = 100 * numbers["found"]["value"]
        shares = [found * place / (len(quantiles) - 1) for place in range(len(quantiles))]
        axes.plot(quantiles, shares, lw=2, zorder=3, **styles[_words(rule)])
        median = numbers["delay_ms"]["median"]["value"]
        axes.plot(median, found / 2, "o", color=styles[_words(rule)]["color"], ms=6, zorder=4)
    axes.set_ylim(0, 102)
    axes.set_ylabel("slips found, %", fontsize=9.5)
    _tidy(axes)


def _bars(
    axes: Axes, by_rule: Mapping[str, Mapping[str, Any]], styles: Mapping[str, Mapping[str, Any]]
) -> None:
    """Found, early and missed of each rule in one bar, the false alarms behind it."""
    rules = list(by_rule)[::-1]  # the first one on top
    for place, rule in enumerate(rules):
        numbers = by_rule[rule]
        reached = 0.0
        for outcome, colour in _OUTCOMES.items():
            share = 100 * (numbers[outcome] or {"value": 0.0})["value"]
            axes.barh(place, share, 0.6, left=reached, color=colour)
            if share >= 7:
                style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9}
                axes.text(reached + share / 2, place, f"{share:.1f}", color="white", **style)
            reached += share
        at = (1.02, place)
        words = f"false alarms {_false_alarms(numbers)}"
        place_of = axes.get_yaxis_transform()
        axes.annotate(words, at, xycoords=place_of, va="center", fontsize=9, annotation_clip=False)
    axes.set_yticks(range(len(rules)), map(_words, rules), fontsize=9.5)
    for label, rule in zip(axes.get_yticklabels(), rules, strict=True):
        label.set_color(styles[_words(rule)]["color"])
    axes.set_ylim(-0.6, max(2, len(rules)) - 0.4)
    axes.set_xlim(0, 100)
    _tidy(axes)
    axes.grid(visible=False, axis="y")


def _tidy(axes: Axes) -> None:
    axes.grid(color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelcolor=_INK)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, styles: Mapping[str, Mapping[str, Any]]) -> None:
    handles: list[Any] = [
        Line2D([], [], lw=2, label=rule, **style) for rule, style in styles.items()
    ]
    handles.append(Line2D([], [], color=_GREY, marker="o", ls="", label="median"))
    handles.append(Patch(color="#F0E6C8", label="grip reflex of people, 60 to 90 ms"))
    handles += [Patch(color=colour, label=outcome) for outcome, colour in _OUTCOMES.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, fontsize=9)


def _cells(numbers: Mapping[str, Any]) -> list[str]:
    delay = numbers["delay_ms"] or {"median": None, "p95": None}
    return [
        str(numbers["num_onsets"]),
        *(_number(numbers[outcome], "{:.1f}", 100) for outcome in _OUTCOMES),
        _number(delay["median"], "{:.1f}"),
        _number(delay["p95"], "{:.1f}"),
        _false_alarms(numbers),
        _watched(numbers["quiet_hours"]),
        _number(numbers["alarms_per_slip"], "{:.2f}"),
    ]


def _latency_cells(numbers: Mapping[str, Any]) -> list[str]:
    parts = numbers["latency_ms"] or {}
    names = ("look_ahead", "bin_fill", "decision", "delay", "compute")
    return ["-" if parts.get(name) is None else f"{parts[name]:.1f}" for name in names]


def _false_alarms(numbers: Mapping[str, Any]) -> str:
    """A rate with its interval, such as ``74.2 /min [70.1, 78.0]``."""
    is_long = numbers["quiet_hours"] >= 1
    rate = numbers["false_alarms_per_hour" if is_long else "false_alarms_per_minute"]
    if rate is None:
        return "-"
    ends = f"[{rate['low']:.1f}, {rate['high']:.1f}]"
    return f"{rate['value']:.1f} /{'h' if is_long else 'min'} {ends}"


def _watched(hours: float) -> str:
    if not hours:
        return "-"
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"


def _number(number: Mapping[str, float] | None, form: str, scale: float = 1.0) -> str:
    return "-" if number is None else form.format(scale * number["value"])
