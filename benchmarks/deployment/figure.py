"""The figure of ``benchmarks.deployment``: what speed costs in accuracy, and speed by chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import log10
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from benchmarks.deployment.files import EXPORTS
from benchmarks.deployment.report import LEAST_RATE, MOST_ERROR, RATE_THREADS, row_of
from benchmarks.deployment.ways import REFERENCE, at_once
from benchmarks.drawing import GREY, LIGHT, OURS, PEER, SECOND, THIRD, finish, plain_decades
from benchmarks.rates import rate

_FLOOR = 1e-16  # where what errors are held against is drawn
_APART = 0.12  # decades between two labels, at least
_CLUSTER = 2.0  # decades of error within which labels keep apart
_ROOM = 3e4  # up to here labels reach, beyond the largest error
_ENGINES = {"compiled": SECOND, "eager": THIRD, "reference": GREY}
Rows = Sequence[Mapping[str, Any]]


def figure(report: Mapping[str, Any], path: Path) -> None:
    """Draw error against latency, every way a mark, and throughput over chunks.

    Args:
        report: as ``--json`` keeps it.
        path: of the PNG.
    """
    sections = {name: of["rows"] for name, of in report["sections"].items()}
    drawing = Figure(figsize=(11, 9.5), layout="constrained")
    trade, bulk = drawing.subplots(2, 1, height_ratios=(1.2, 1))
    _trade(trade, sections)
    _bulk(bulk, sections["bulk"])
    finish(drawing, report, "What a deployed detector costs", path)


def colour(way: str) -> str:
    """Of our export, of an engine, or of anybody else."""
    first = way.split(",")[0].split()[0]
    return OURS if first == "export" else _ENGINES.get(first, PEER)


class Mark(NamedTuple):
    """A way in the panel of error and latency."""

    way: str
    error: float
    p50_us: float


def label_heights(marks: Sequence[Mark]) -> dict[str, float]:
    """Where the labels of marks one above the other stand, in us: none covers another.

    Example:
        >>> heights = label_heights([Mark("a", 1.0, 10.0), Mark("b", 1.0, 10.0)])
        >>> heights["b"] > 1.2 * heights["a"]
        True
    """
    ordered = sorted(marks, key=lambda mark: mark.p50_us)
    heights = [log10(mark.p50_us) for mark in ordered]
    for place in range(1, len(heights)):
        heights[place] = max(heights[place], heights[place - 1] + _APART)
    return {mark.way: 10**height for mark, height in zip(ordered, heights, strict=True)}


def clusters(marks: Sequence[Mark]) -> list[list[Mark]]:
    """Marks of about the same error, from left to right."""
    found: list[list[Mark]] = []
    for mark in sorted(marks, key=lambda each: each.error):
        if found and log10(mark.error / found[-1][0].error) < _CLUSTER:
            found[-1].append(mark)
        else:
            found.append([mark])
    return found


def _marks(sections: Mapping[str, Rows]) -> list[Mark]:
    found = []
    for row in sections["single"]:
        error = row_of(sections["errors"], way=row["way"])
        if row["threads"] == 1 and (error or row["way"] == REFERENCE):
            worst = max(error["worst"], _FLOOR) if error else _FLOOR
            found.append(Mark(row["way"], worst, 1e6 * row["p50_s"]))
    return found


def _trade(axes: Axes, sections: Mapping[str, Rows]) -> None:
    for cluster in clusters(_marks(sections)):
        heights = label_heights(cluster)
        edge = 3 * max(mark.error for mark in cluster)
        for way, error, p50_us in cluster:
            axes.plot(error, p50_us, "o", color=colour(way), ms=6)
            axes.plot([error, edge], [p50_us, heights[way]], color=colour(way), lw=0.6)
            axes.annotate(
                way,
                (edge, heights[way]),
                (2, 0),
                textcoords="offset points",
                va="center",
                size=7.5,
            )
    for precision, most in MOST_ERROR.items():
        axes.axvline(most, color=GREY, ls="--", lw=1, zorder=0)
        axes.annotate(
            f"limit, {precision}",
            (most, 0.99),
            (3, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            size=7.5,
            color="#555555",
            va="top",
        )
    axes.set(xscale="log", yscale="log", xlim=(_FLOOR / 3, _ROOM))
    low, high = axes.get_ylim()
    axes.set_ylim(low / 1.3, high * 2)
    axes.set_xticks([10.0**power for power in range(-16, 1, 2)])
    axes.xaxis.set_minor_locator(NullLocator())
    plain_decades(axes.yaxis)
    axes.grid(color=LIGHT)
    axes.set_xlabel(
        "largest score error on held-out bins, standard deviations of the score\n"
        "(against the float64 reference, which stands at the left)"
    )
    axes.set_ylabel("us from the raw samples of a bin to a score\n(p50, 1 thread)")
    axes.set_title("Accuracy for speed: down and to the left is better", fontsize=10)


def _bulk(axes: Axes, rows: Rows) -> None:
    threads = RATE_THREADS if any(row["threads"] == RATE_THREADS for row in rows) else 1
    own = [row for row in rows if row["threads"] == threads]
    shared = {at_once(way) for way in EXPORTS}
    peers = [way for way in dict.fromkeys(row["way"] for row in own) if colour(way) == PEER]
    for way in dict.fromkeys(row["way"] for row in own):
        mine = [row for row in own if row["way"] == way]
        rates = [rate(row) for row in mine]
        style = ":" if way in peers else ("--" if "float64" in way else "-")
        shade = "#56b4e9" if way in shared else colour(way)
        marker = "v^DX"[peers.index(way) % 4] if way in peers else "o"
        chunks = [row["chunk"] for row in mine]
        middles = [of.median for of in rates]
        axes.plot(chunks, middles, style, marker=marker, ms=4, color=shade, label=way)
    axes.set(xscale="log", yscale="log")
    chunks = sorted({row["chunk"] for row in own})
    axes.set_xticks(chunks, [f"{chunk:,}" for chunk in chunks])
    axes.xaxis.set_minor_locator(NullLocator())
    plain_decades(axes.yaxis)
    axes.axhline(LEAST_RATE, color=GREY, ls="--", lw=1, zorder=0)
    axes.annotate(
        "limit, float32",
        (0.01, LEAST_RATE),
        (0, 3),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        size=7.5,
        color="#555555",
    )
    axes.grid(color=LIGHT)
    axes.set_xlabel("bins at once")
    axes.set_ylabel(f"bins a second, {threads} threads")
    axes.set_title("Many bins", fontsize=10)
    axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
