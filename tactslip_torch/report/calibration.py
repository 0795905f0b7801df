"""Table and figure of a calibration: before and after, on recordings that were left out."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

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
    names = [None, *(groups if len(groups) > 1 else ())]
    lines = []
    for name in names:
        own = [row for row in rows if name in (None, row["group"])]
        before, after = (pooled_outcome(row[when] for row in own) for when in ("before", "after"))
        known = [
            (
                "balanced accuracy, %",
                f"{style.grouped(after['slip_bins'])} slip, "
                f"{style.grouped(after['other_bins'])} other bins",
                *(style.percent(of["balanced_accuracy"], 1) for of in (before, after)),
            ),
            ("false alarms an hour", f"{after['hours']:.2f} h", *_rates(before, after)),
            (
                "slips found",
                f"{after['slips']} slips",
                *(str(of["found"]) for of in (before, after)),
            ),
            (
                "too early",
                f"{after['slips']} slips",
                *(str(of["early"]) for of in (before, after)),
            ),
            (
                "delay, ms (median)",
                f"{after['found']} slips",
                *(
                    "-" if of["delay_ms"] is None else f"{of['delay_ms']:.0f}"
                    for of in (before, after)
                ),
            ),
        ]
        is_known = (
            after["balanced_accuracy"] is not None,
            after["hours"] > _LEAST_H,
            *[bool(after["slips"])] * 3,
        )
        lines += [
            {"left out": name or "all", "": what, "before": old, "after": new, "of": of}
            for (what, of, old, new), shown in zip(known, is_known, strict=True)
            if shown
        ]
    return style.marked(simulated, style.table(lines, num_left=2, merged=1))


def _rates(*outcomes: Mapping[str, Any]) -> list[str]:
    return ["-" if of["per_hour"] is None else f"{of['per_hour']:.1f}" for of in outcomes]


@style.styled
def calibration_figure(report: Mapping[str, Any], path: str | Path) -> None:
    """Write scores of bins and false alarms over thresholds as a PNG.

    Args:
        report: the content of ``calibration.json``, with ``bins`` where the decision threshold
            was looked for, and ``alarm`` where the alarm was.
        path: the PNG to write, replaced as a whole if it exists.
    """
    bins, alarm = report.get("bins"), report.get("alarm")
    panels = [name for name, given in (("bins", bins), ("alarm", alarm)) if given]
    title = "Calibration: before (dashed) and after (solid)"
    width = 5.6 * len(panels)
    figure = style.new_figure(width, 3.9, title, simulated=report["simulated"])
    for axes, name in zip(np.ravel(figure.subplots(1, len(panels))), panels, strict=True):
        if name == "bins" and bins:
            edges = np.asarray(bins["histogram"]["edges"])
            for kind, colour in (("slip", style.PALETTE[1]), ("other", style.PALETTE[0])):
                counts = np.asarray(bins["histogram"][kind], float)
                label = "slip" if kind == "slip" else "no slip"
                axes.stairs(
                    counts / max(counts.sum(), 1),
                    edges,
                    fill=True,
                    alpha=0.45,
                    color=colour,
                    label=label,
                )
            axes.axvline(0.0, color=style.INK, linestyle="--", linewidth=1.2)
            axes.axvline(bins["threshold"], color=style.INK, linewidth=1.2)
            axes.set(xlabel="score of a bin, as it was", ylabel="fraction of bins")
            axes.set_title("Decision threshold" + ("" if bins["is_set"] else " (not changed)"))
            axes.legend(loc="best")
        elif alarm:
            curve = np.asarray(alarm["curve"], float).reshape(-1, 3)
            axes.plot(curve[:, 0], curve[:, 1], color=style.PALETTE[0], label="counted")
            confidence = f"{100 * alarm['confidence']:g} %"
            axes.fill_between(
                curve[:, 0],
                curve[:, 1],
                curve[:, 2],
                color=style.PALETTE[0],
                alpha=0.2,
                linewidth=0,
                label=f"up to the {confidence} bound",
            )
            axes.axhline(alarm["per_hour"], color=style.GREY, linewidth=1, label="wanted, at most")
            axes.axvline(alarm["before"], color=style.INK, linestyle="--", linewidth=1.2)
            axes.axvline(alarm["after"], color=style.INK, linewidth=1.2)
            axes.set(yscale="log", xlabel="threshold of the alarm", ylabel="false alarms an hour")
            axes.set_title(
                f"Alarm, {alarm['hours']:.1f} h without slip"
                + ("" if alarm["is_set"] else " (not changed)")
            )
            axes.legend(loc="best")
    style.save(figure, path)
