"""A promise of false alarms an hour, and what was kept of it: tables and figure.

All read ``metrics.json``: ``alarm`` as the stage behind the fit left it, and ``events``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.report.tables import SIMULATED_LINE, aligned
from tactslip_torch.runtime import whole_file

_ROLES = {"test stream": "#0072B2", "unseen stream": "#D55E00"}
_NAMES = {"test stream": "seen materials", "unseen stream": "unseen materials"}
_INK, _GREY, _GRID = "#222222", "#666666", "#DDDDDD"
_HEADER = ["materials", "method", "false alarms an hour without slip", "held against", "slips"]
_HEADER += ["found %", "early %", "missed %", "delay ms", "p95 ms"]
_LEAST = 0.1  # an hour: where the figure's axis begins, and rates of 0 are drawn


class _Kept(NamedTuple):
    """What became of a threshold on the quiet of one role."""

    method: str
    role: str
    rate: Mapping[str, float]
    hours: float


def kept_rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """What was kept of the promise: a header, and a row for seen and unseen of every method.

    Rates are false alarms an hour on recordings without slip, in brackets their intervals: *as
    asked* where these hold the target, *more* or *fewer* where not. Slips are the protocol's.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    target = metrics["alarm"]["settings"]["target_per_hour"]
    quiet = {(one.role, one.method): one for one in _kept(metrics)}
    rows = [_HEADER]
    for role, name in _NAMES.items():
        for place, (method, numbers) in enumerate(metrics["events"].get(role, {}).items()):
            one = quiet.get((role, method))
            delay = numbers["delay_ms"]
            rows.append(
                [
                    "" if place else name,
                    method.replace("_", " "),
                    "-" if one is None else _rate(one.rate, "value", one.hours),
                    "-" if one is None else _verdict(one.rate, target),
                    str(numbers["num_onsets"]),
                    *(_share(numbers[outcome]) for outcome in ("found", "early", "missed")),
                    "-" if delay is None else f"{delay['median']['value']:.1f}",
                    "-" if delay is None else f"{delay['p95']['value']:.1f}",
                ]
            )
    return rows


def promise_line(metrics: Mapping[str, Any]) -> str:
    """What was asked for, on what it was set, and what that gave there."""
    alarm = metrics["alarm"]
    settings, set_on = alarm["settings"], alarm["settings"]["facts"]["calibrated"]["rate"]
    return (
        f"asked for: {settings['target_per_hour']:g} false alarms an hour of "
        f"{settings['facts']['slip_free']}; {alarm['rule'].replace('_', ' ')}, which the "
        f"detector's file has, was set on {set_on['hours']:.1f} h with {set_on['alarms']}"
    )


def alarm_table(metrics: Mapping[str, Any]) -> str:
    """``promise_line`` and ``kept_rows`` for the terminal.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    header, *rows = kept_rows(metrics)
    lines = [SIMULATED_LINE] if metrics["simulated"] else []
    return "\n".join([*lines, promise_line(metrics), aligned(header, rows, num_left=2)])


def scene_rows(metrics: Mapping[str, Any]) -> list[list[str]]:
    """False alarms and slips found in scenes that fool, by the detector's own rule.

    Behind it the false alarms of the paper's rule and of the other methods. A header and a row for
    seen and unseen materials of every scene.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    alarm = metrics["alarm"]
    main = alarm["rule"]
    beside = [name for name, one in alarm["methods"].items() if not one["calibrated"]]
    beside += [name for name, one in alarm["methods"].items() if one["scorer"] != "detector"]
    header = ["scene", "materials", "trained on", "quiet min", f"{main.replace('_', ' ')} /h"]
    header += [
        "slips",
        "found %",
        "early %",
        "missed %",
        "delay ms",
        *(f"{name} /h" for name in beside),
    ]
    rows = [header]
    for scene, found in alarm["scenes"].items():
        for role, by_method in found.items():
            if role == "trained":
                continue
            ours = by_method[main]
            delay = ours["delay_ms"]
            cells = [
                "yes" if found["trained"] else "no",
                f"{60 * ours['quiet_hours']:.0f}",
                _bare(ours["false_alarms_per_hour"]),
                str(ours["num_onsets"]),
                *(_share(ours[outcome]) for outcome in ("found", "early", "missed")),
                "-" if delay is None else f"{delay['median']['value']:.0f}",
            ]
            cells += [_bare(by_method[name]["false_alarms_per_hour"]) for name in beside]
            rows.append([scene.replace("_", " "), {"test": "seen"}.get(role, role), *cells])
    return rows


def scenes_table(metrics: Mapping[str, Any]) -> str:
    """``scene_rows`` for the terminal.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    header, *rows = scene_rows(metrics)
    lines = [SIMULATED_LINE] if metrics["simulated"] else []
    return "\n".join([*lines, aligned(header, rows, num_left=2)])


def alarm_figure(metrics: Mapping[str, Any], path: str | Path) -> None:
    """Write what was kept of the promise, and false alarms of every scene, as a PNG.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    alarm = metrics["alarm"]
    target = alarm["settings"]["target_per_hour"]
    kept = list(_kept(metrics))
    num_rows = max(len(alarm["methods"]), len(alarm["scenes"]))
    figure = Figure(figsize=(12.0, 2.2 + 0.5 * num_rows), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [name for name in alarm["methods"] if any(one.method == name for one in kept)]
    for role, colour in _ROLES.items():
        rates = {one.method: one.rate for one in kept if one.role == role}
        _dots(left, names, rates, role, colour)
    hours = {one.role: one.hours for one in kept}
    spans = " and ".join(
        f"{hours[role]:.1f} h of {_NAMES[role]}" for role in _ROLES if role in hours
    )
    left.set_title(f"Without slip: {spans}", fontsize=10, loc="left")
    scenes = list(alarm["scenes"])
    for role, colour in _ROLES.items():
        rates = {
            scene: rate
            for scene in scenes
            if (rate := _of_scene(alarm, scene, role.removesuffix(" stream")))
        }
        _dots(right, scenes, rates, role, colour)
    trained = [scene for scene in scenes if alarm["scenes"][scene]["trained"]]
    what = f" ({', '.join(trained).replace('_', ' ')}: trained on)" if trained else ""
    right.set_title(f"Scenes that fool, by {alarm['rule']}{what}", fontsize=10, loc="left")
    for axes in (left, right):
        axes.axvline(target, color=_INK, linewidth=1, linestyle="--", zorder=1)
        axes.set_xscale("log")
        axes.set_xlim(left=0.8 * _LEAST)
        axes.set_xlabel("false alarms an hour, with interval (none: at the left edge)", fontsize=9)
        axes.grid(color=_GRID, axis="x")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(length=0, labelcolor=_INK)
    left.legend(frameon=False, fontsize=9, loc="best")
    kind = " (SIMULATED hand)" if metrics["simulated"] else ""
    figure.suptitle(f"Asked for: {target:g} false alarms an hour (dashed){kind}", fontsize=12)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=160, facecolor="white")


def _dots(
    axes: Axes,
    names: list[str],
    rates: Mapping[str, Mapping[str, float]],
    role: str,
    colour: str,
) -> None:
    """A dot with its interval for every name that has a rate."""
    aside = -0.14 if role == next(iter(_ROLES)) else 0.14
    for place, name in enumerate(names):
        if name in rates:
            low, value, high = (max(rates[name][end], _LEAST) for end in ("low", "value", "high"))
            axes.plot([low, high], [place + aside] * 2, color=colour, linewidth=1.6, zorder=2)
            axes.plot(value, place + aside, "o", color=colour, markersize=6, zorder=3)
    axes.plot([], [], "o-", color=colour, label=_NAMES[role])
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=9.5)
    axes.set_ylim(len(names) - 0.5, -0.5)


def _kept(metrics: Mapping[str, Any]) -> Iterator[_Kept]:
    """The false alarms of every method on the scene without slip, by role."""
    quiet = metrics["alarm"]["settings"]["facts"]["slip_free"]
    for role in _ROLES:
        for method, numbers in metrics["events"].get(role, {}).items():
            own = numbers["per_scene"].get(quiet)
            if own and own["false_alarms_per_hour"]:
                rate = own["false_alarms_per_hour"]
                yield _Kept(method, role, rate, own["quiet_hours"])


def _of_scene(alarm: Mapping[str, Any], scene: str, role: str) -> Mapping[str, float] | None:
    by_method = alarm["scenes"][scene].get(role)
    if by_method is None:
        return None
    rate: Mapping[str, float] | None = by_method[alarm["rule"]]["false_alarms_per_hour"]
    return rate


def _rate(rate: Mapping[str, float], value: str, hours: float) -> str:
    """Such as ``1.10 [0.53, 2.00] in 10.0 h``."""
    return f"{rate[value]:.2f} [{rate['low']:.2f}, {rate['high']:.2f}] in {hours:.1f} h"


def _verdict(rate: Mapping[str, float], target: float) -> str:
    """Where the rate's interval lies: around the target, above or below it."""
    if rate["low"] > target:
        return "more"
    return "fewer" if rate["high"] < target else "as asked"


def _bare(rate: Mapping[str, float] | None) -> str:
    return "-" if rate is None else f"{rate['value']:.1f}"


def _share(share: Mapping[str, float] | None) -> str:
    return "-" if share is None else f"{100 * share['value']:.1f}"
