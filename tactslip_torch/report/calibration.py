"""Table and figure of a calibration: before and after, on recordings that were left out."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from tactslip_torch.report import style

Rows = Sequence[Mapping[str, Any]]
"""Of each recording ``group``, and the counts ``before`` and ``after``."""

_LEAST_H = 0.01  # of which a rate is shown
_COUNTS = (
    "slip_bins",
    "slip_right",
    "other_bins",
    "other_right",
    "hours",
    "false_alarms",
    "slips",
    "found",
    "early",
)


def pooled_outcome(outcomes: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts of several recordings, their balanced accuracy, rate and delay; None of nothing."""
    rows = list(outcomes)
    total: dict[str, Any] = {name: sum(row[name] for row in rows) for name in _COUNTS}
    balanced = None
    if total["slip_bins"] and total["other_bins"]:
        of_slip = total["slip_right"] / total["slip_bins"]
        balanced = (of_slip + total["other_right"] / total["other_bins"]) / 2
    delays = [delay for row in rows for delay in row["delays_s"]]
    return total | {
        "balanced_accuracy": balanced,
        "per_hour": total["false_alarms"] / total["hours"] if total["hours"] else None,
        "delay_ms": 1000 * statistics.median(delays) if delays else None,
    }


def calibration_table(rows: Rows, *, simulated: bool) -> str:
    """Before and after, of all recordings and, where there are several, of each group.

    Args:
        rows: of recordings that were left out.
        simulated: whether any is.
    """
    groups = list(dict.fromkeys(row["group"] for row in rows))
    lines = []
    for name in [None, *(groups if len(groups) > 1 else ())]:
        own = [row for row in rows if name in (None, row["group"])]
        before, after = (
            _cells(pooled_outcome(row[when] for row in own)) for when in ("before", "after")
        )
        lines += [
            {"left out": name or "all", "": what, "before": old, "after": new, "of": of}
            for (what, (_, old)), (of, new) in zip(before.items(), after.values(), strict=True)
            if {old, new} != {"-"}
        ]
    return style.marked(simulated, style.table(lines, num_left=2, merged=1))


def _cells(of: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Of a pooled outcome by row of the table: what it is of, and its value."""
    bins = f"{style.grouped(of['slip_bins'])} slip, {style.grouped(of['other_bins'])} other bins"
    slips, is_any = f"{of['slips']} slips", bool(of["slips"])
    rate = of["per_hour"] if of["hours"] > _LEAST_H else None
    delay = of["delay_ms"]
    return {
        "balanced accuracy, %": (bins, style.percent(of["balanced_accuracy"], 1)),
        "false alarms an hour": (f"{of['hours']:.2f} h", "-" if rate is None else f"{rate:.1f}"),
        "slips found": (slips, str(of["found"]) if is_any else "-"),
        "too early": (slips, str(of["early"]) if is_any else "-"),
        "delay, ms (median)": (f"{of['found']} slips", "-" if delay is None else f"{delay:.0f}"),
    }


@style.styled
def calibration_figure(report: Mapping[str, Any], path: str | Path) -> None:
    """Write scores of bins and false alarms over thresholds as a PNG.

    Args:
        report: the content of ``calibration.json``, with ``bins`` where the decision threshold
            was looked for, ``alarm`` where the alarm was, and ``refit`` where that was tried.
        path: the PNG to write, replaced as a whole if it exists.
    """
    panels = {name: report[name] for name in ("refit", "bins", "alarm") if report.get(name)}
    title = "Calibration: before (dashed) and after (solid)"
    figure = style.new_figure(5.6 * len(panels), 3.9, title, simulated=report["simulated"])
    grid = np.ravel(figure.subplots(1, len(panels)))
    for axes, (name, found) in zip(grid, panels.items(), strict=True):
        ends: tuple[float, ...] = ()
        if name == "refit":
            title = "Refit, tried on what was left out"
            _draw_refit(axes, found["groups"])
        elif name == "bins":
            title, ends = "Decision threshold", (0.0, found["threshold"])
            edges, colours = found["histogram"]["edges"], (style.PALETTE[1], style.PALETTE[0])
            for kind, label, colour in zip(
                ("slip", "other"), ("slip", "no slip"), colours, strict=True
            ):
                counts = np.asarray(found["histogram"][kind], float)
                fractions = counts / max(counts.sum(), 1)
                look: dict[str, Any] = {"fill": True, "alpha": 0.45}
                axes.stairs(fractions, edges, color=colour, label=label, **look)
            axes.set(xlabel="score of a bin, as it was", ylabel="fraction of bins")
        else:
            title = f"Alarm, {found['hours']:.1f} h without slip"
            ends, colour = (found["before"], found["after"]), style.PALETTE[0]
            places, rates, bounds = np.asarray(found["curve"], float).reshape(-1, 3).T
            axes.plot(places, rates, color=colour, label="counted")
            label = f"up to the {100 * found['confidence']:g} % bound"
            look = {"color": colour, "alpha": 0.2, "linewidth": 0}
            axes.fill_between(places, rates, bounds, label=label, **look)
            axes.axhline(found["per_hour"], color=style.GREY, linewidth=1, label="wanted, at most")
            axes.set(yscale="log", xlabel="threshold of the alarm", ylabel="false alarms an hour")
        for end, dash in zip(ends, ("--", "-"), strict=False):
            axes.axvline(end, color=style.INK, linestyle=dash, linewidth=1.2)
        axes.set_title(title + ("" if found["is_set"] else " (not changed)"))
        axes.legend(loc="best")
    style.save(figure, path)


def _draw_refit(axes: Axes, groups: Rows) -> None:
    """Balanced accuracy on each group before and after a refit."""
    known = [row for row in groups if None not in (row["before"], row["after"])]
    for place, row in enumerate(known):
        ends = [100 * row["before"], 100 * row["after"]]
        axes.plot(ends, [place, place], color=style.GREY, linewidth=1)
    places, colour = range(len(known)), style.PALETTE[0]
    for when, fill in (("before", "none"), ("after", colour)):
        values = [100 * row[when] for row in known]
        axes.scatter(values, places, edgecolors=colour, facecolors=fill, label=when, zorder=2)
    axes.set_yticks(places, [row["group"] for row in known])
    axes.set(xlabel="balanced accuracy, %", ylim=(len(known) - 0.5, -0.5))
