"""The figure of ``benchmarks.throughput``: curves of time and memory, from the report it keeps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.drawing import GREY, LIGHT, colour_of, finish, plain_decades
from benchmarks.machine import threads_text
from benchmarks.rates import rate
from benchmarks.tables import Spread
from benchmarks.throughput.measure import held_bytes
from benchmarks.throughput.worker import IN_ONE_PIECE

Rows = Sequence[Mapping[str, Any]]


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw a panel for each section of ``PANELS`` that was measured.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    shown = [name for name in PANELS if name in report["sections"]]
    columns = min(2, len(shown))
    lines = -(-len(shown) // columns)
    drawing = Figure(figsize=(5.0 * columns, 3.6 * lines + 0.4), layout="constrained")
    places = drawing.subplots(lines, columns, squeeze=False).flat
    for axes, name in zip(places, shown, strict=False):
        PANELS[name](axes, report["sections"][name]["rows"])
        axes.set(xscale="log", yscale="log")
        plain_decades(axes.xaxis)
        plain_decades(axes.yaxis)
        if name != "batch":
            key = {"length": "bin_ms", "channels": "channels"}.get(name, "bins")
            values = sorted({row[key] for row in report["sections"][name]["rows"]})
            axes.set_xticks(values, [f"{value:,}" for value in values])
        axes.grid(color=LIGHT)
        axes.legend(frameon=False, fontsize=8)
    for axes in list(drawing.axes)[len(shown) :]:
        axes.set_axis_off()
    finish(drawing, report, "Throughput", path)


def _batch(axes: Axes, rows: Rows) -> None:
    for way, threads in dict.fromkeys((row["way"], row["threads"]) for row in rows):
        mine = [row for row in rows if (row["way"], row["threads"]) == (way, threads)]
        rates = [rate(row) for row in mine]
        style = "--o" if threads == 1 else "-o"
        label = f"{way}, {threads_text(threads)}"
        _line(axes, [row["bins"] for row in mine], rates, style, colour_of(way), label)
    axes.set_xlabel("bins at once")
    axes.set_ylabel("bins a second")
    axes.set_title("Planned detector, filtered bins to scores", fontsize=10)


def _over(name: str, label: str, title: str) -> Callable[[Axes, Rows], None]:
    def draw(axes: Axes, rows: Rows) -> None:
        for way, threads in dict.fromkeys((row["way"], row["threads"]) for row in rows):
            mine = [row for row in rows if (row["way"], row["threads"]) == (way, threads)]
            times = [Spread.of(row["seconds"]).times(1e6 / row["bins"]) for row in mine]
            style = "--o" if threads == 1 else "-o"
            whose = f"{way}, {threads_text(threads)}"
            _line(axes, [row[name] for row in mine], times, style, colour_of(way), whose)
        axes.set_xlabel(label)
        axes.set_ylabel("us a bin")
        axes.set_title(title, fontsize=10)

    return draw


def _memory(axes: Axes, rows: Rows) -> None:
    for way in dict.fromkeys(row["way"] for row in rows):
        mine = [row for row in rows if row["way"] == way]
        held = [max(held_bytes(row), 1e5) / 1e6 for row in mine]
        bins = [row["bins"] for row in mine]
        is_whole = way == IN_ONE_PIECE
        label = "all 2582 by the reference in one piece" if is_whole else f"{way}, planned features"
        color = GREY if is_whole else colour_of(way)
        axes.plot(bins, held, "s" if is_whole else "-o", ms=4, color=color, label=label)
    axes.set_xlabel("bins held at once")
    axes.set_ylabel("MB besides bins and features")
    axes.set_title("Memory that the work takes", fontsize=10)


def _line(
    axes: Axes, at: Sequence[float], of: Sequence[Spread], style: str, color: str, label: str
) -> None:
    axes.plot(at, [one.median for one in of], style, ms=4, color=color, label=label)
    axes.fill_between(at, [one.low for one in of], [one.high for one in of], color=color, alpha=0.2)


PANELS: dict[str, Callable[[Axes, Rows], None]] = {
    "batch": _batch,
    "memory": _memory,
    "length": _over("bin_ms", "ms of a bin", "Whole pool, 24 channels"),
    "channels": _over("channels", "channels", "Whole pool, bins of 50 ms"),
}
