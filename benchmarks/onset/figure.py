"""The figure of ``benchmarks.onset``: the front of hops and filters, and rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from benchmarks.drawing import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish
from benchmarks.onset.front import compute, median_ms, not_found
from benchmarks.onset.report import SHOWN
from benchmarks.tables import number

COLORS = {"centred": OURS, "causal": PEER, "trailing": THIRD}
_BESIDE = {"centred": (9, 6), "causal": (-9, 6), "trailing": (9, -6)}
"""Where labels stand, in points."""
_ROLES = {"test": "seen", "unseen": "unseen"}


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw delay against compute and against slips not found, and the delays of every method.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    found, settings = report["sections"], report["settings"]
    rows = [row for row in found["front"]["rows"] if median_ms(row, "test") < float("inf")]
    drawing = Figure(figsize=(11.0, 7.2), layout="constrained")
    places = drawing.subplot_mosaic([["compute", "test", "unseen"], ["rivals"] * 3])
    if rows:
        engine = next(iter(rows[0]["push_s"]))
        costs = [1e3 * compute(row, engine) for row in rows]
        _points(places["compute"], rows, "test", "compute", costs)
        places["compute"].set_ylabel(f"compute, ms a second of stream\n(one thread, {engine})")
        places["compute"].set_yscale("log")
        places["compute"].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        places["compute"].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        places["compute"].yaxis.set_minor_formatter(NullFormatter())
        for role, name in _ROLES.items():
            kept = [row for row in rows if median_ms(row, role) < float("inf")]
            _points(places[role], kept, role, role, [100 * not_found(row[role]) for row in kept])
            places[role].set_ylabel("slips not found within 500 ms, %")
            places[role].set_title(f"{name} materials", fontsize=9)
    places["compute"].set_title("seen materials", fontsize=9)
    _legend(places["compute"], found["trained"], rows)
    _rivals(places["rivals"], found["rivals"]["rows"])
    hop = f"{settings['rival_hop_ms']:g}"
    places["rivals"].set_title(f"methods at one target, a decision every {hop} ms", fontsize=9)
    target = f"{settings['target_per_hour']:g} false alarms an hour"
    finish(
        drawing, report, f"Alarms on the simulated hand: delay and what it costs at {target}", path
    )


def _points(
    axes: Axes, rows: Sequence[Mapping[str, Any]], role: str, front: str, values: Sequence[float]
) -> None:
    """A point for each filter and hop, in milliseconds; filled and joined those on a front."""
    best = []
    for row, value in zip(rows, values, strict=True):
        x, color, is_on = median_ms(row, role), COLORS[row["align"]], front in row["on"]
        best += [(x, value)] if is_on else []
        face = color if is_on else "white"
        axes.plot(x, value, "o", color=color, mfc=face, ms=7, clip_on=False, zorder=3 + is_on)
        axes.annotate(
            f"{row['hop_ms']:g}",
            (x, value),
            _BESIDE[row["align"]],
            textcoords="offset points",
            ha="center",
            va="center",
            size=8,
            color=color,
            zorder=5,
        )
    best.sort()
    axes.plot([x for x, _ in best], [y for _, y in best], color=GREY, lw=1.2, zorder=1)
    axes.set_xlabel("median delay, ms")
    axes.grid(color=LIGHT)
    axes.margins(0.12)


def _legend(
    axes: Axes, trained: Mapping[str, Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]
) -> None:
    ahead = {row["align"]: f"{row['look_ahead_ms']:g} ms ahead" for row in rows}
    for align, of in trained.items():
        right = of["balanced_accuracy"]
        text = f"{align}: {ahead.get(align, '-')}; bins right {100 * right['test']:.1f} % seen, "
        text += f"{100 * right['unseen']:.1f} % unseen"
        axes.plot([], [], "o", color=COLORS[align], label=text)
    axes.plot([], [], "-", color=GREY, label="front; numbers: hop, ms")
    figure_ = axes.get_figure()
    assert figure_ is not None
    figure_.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)


def _rivals(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """A line for every method and kind of materials, from the median of delays to their p95."""
    names = []
    for place, row in enumerate(rows):
        names.append(f"{SHOWN.get(row['method'], row['method'])}\n{number(1e3 * row['push_s'])} ms")
        for role, shift, color in (("test", -0.17, OURS), ("unseen", 0.17, SECOND)):
            events, height = row[role], place + shift
            said = f"found {100 * events['found']['value']:.1f} %, "
            said += f"early {100 * events['early']['value']:.1f} %, "
            said += f"{number(events['false_alarms_per_hour']['value'])} false alarms/h"
            right = 0.0
            if events["delay_ms"] is not None:
                middle = events["delay_ms"]["median"]["value"]
                right = events["delay_ms"]["p95"]["value"]
                axes.plot([middle, right], [height, height], color=color, lw=1.2)
                axes.plot(right, height, "|", color=color, ms=7)
                axes.plot(middle, height, "o", color=color, ms=6)
            axes.annotate(
                said, (right, height), (8, 0), textcoords="offset points", va="center", size=8
            )
    for role, color in (("test", OURS), ("unseen", SECOND)):
        axes.plot([], [], "o", color=color, label=f"{_ROLES[role]} materials")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 0.98), ncols=2, fontsize=8, frameon=False)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0, 1.45 * max(axes.get_xlim()[1], 1.0))
    axes.set_xlabel("delay, ms: dot median, bar p95; below a method: time of a decision")
    axes.grid(axis="x", color=LIGHT)
