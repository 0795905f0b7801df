"""The figure of ``benchmarks.streaming``: real-time factors by push and by hop, and memory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from benchmarks.drawing import GREY, LIGHT, SECOND, colour_of, finish, plain_decades
from benchmarks.streaming.measure import NAIVE, STREAM
from benchmarks.streaming.report import TIMES_REAL_TIME, real_time_factor
from benchmarks.streaming.sizes import CHUNK, HOP
from benchmarks.streaming.ways import RATE_HZ


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw a line an engine, quartiles as bars; the memory over time.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    rows = report["sections"]["speed"]["rows"]
    drawing = Figure(figsize=(11, 3.8), layout="constrained")
    by_push, by_hop, memory = drawing.subplots(1, 3)
    engines = list(dict.fromkeys(row["engine"] for row in rows))
    for engine in engines:
        own = [row for row in rows if row["engine"] == engine]
        streams = [row for row in own if row["kind"] == STREAM]
        naive = [row for row in own if row["kind"] == NAIVE]
        _line(by_push, [row for row in streams if row["hop"] == HOP], "chunk", engine, "-")
        _line(by_hop, [row for row in streams if row["chunk"] == CHUNK], "hop", engine, "-")
        _line(by_hop, naive, "hop", f"{engine}, naive", ":")
    for axes, name in (
        (by_push, f"ms a push (hop {1000 * HOP / RATE_HZ:g} ms)"),
        (by_hop, f"hop, ms (pushes of {1000 * CHUNK / RATE_HZ:g} ms)"),
    ):
        axes.set_xscale("log")
        axes.set_yscale("log")
        values = sorted({x for line in axes.get_lines() for x in line.get_xdata()})
        axes.set_xticks(values, [f"{x:g}" for x in values])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        plain_decades(axes.yaxis)
        axes.axhline(TIMES_REAL_TIME, color=GREY, ls="--", lw=1, zorder=0)
        axes.grid(color=LIGHT)
        axes.set_xlabel(name)
        axes.legend(fontsize=7.5, frameon=False)
    by_push.set_ylabel("real-time factor, 1 thread\ndashed: limit, eager at 100 ms a push")
    _memory(memory, report["sections"]["memory"])
    finish(drawing, report, "What a stream costs", path)


def _line(axes: Axes, rows: list[Mapping[str, Any]], by: str, label: str, style: str) -> None:
    rows = sorted(rows, key=lambda row: int(row[by]))
    factors = [real_time_factor(row) for row in rows]
    x = [1000 * row[by] / RATE_HZ for row in rows]
    y = [factor.median for factor in factors]
    bars = [[f.median - f.low for f in factors], [f.high - f.median for f in factors]]
    axes.errorbar(x, y, bars, color=colour_of(label), ls=style, marker="o", ms=4, label=label)


def _memory(axes: Axes, section: Mapping[str, Any]) -> None:
    minutes = [at_s / 60 for at_s in section["at_s"]]
    mib = [held / 2**20 for held in section["resident_bytes"]]
    axes.plot(minutes, mib, color=SECOND, lw=1.5)
    if mib:
        axes.set_ylim(0, 1.3 * max(mib))
    axes.axvline(section["settled_s"] / 60, color=GREY, ls="--", lw=1, zorder=0)
    axes.grid(color=LIGHT)
    axes.set_xlabel("minutes of stream\n(dashed: must stay from here)")
    axes.set_ylabel("resident memory, MiB")
