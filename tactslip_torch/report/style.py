"""Shared form of every report: words and numbers in tables, and colours, axes and files of figures.

Colours are those of Okabe and Ito (2008), which colour-blind readers tell apart. Figures are drawn
on matplotlib's ``Figure`` objects, so that no window opens; its settings are those of ``styled``
while one is drawn, and as they were after it.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tactslip_torch.runtime import whole_file

SIMULATED_LINE = "SIMULATED data: numbers of a simulated hand, not of the paper's"

UNNAMED_SCENE = "unnamed"
"""The scene of recordings of another hand than the paper's that nothing names."""

BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
PALETTE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
INK, GREY, LIGHT = "#222222", "#666666", "#DDDDDD"
ALARM = "#C6361B"
_EMPTY: set[object] = {None, "-"}

UPPER_LEFT_OUTSIDE: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}


# Tables ------------------------------------------------------------------------------------------
def table(
    rows: Sequence[Mapping[str, object]],
    num_left: int = 1,
    merged: int = 0,
    kept: int | None = None,
) -> str:
    """Columns padded to their widest cell: ``num_left`` flush left, the others flush right.

    Args:
        rows: cells by column, the same columns in each; ``-`` stands for ``None``, ``yes`` and
            ``no`` for truth values.
        num_left: number of columns that hold words.
        merged: number of leading columns in which a cell that repeats the one above is left
            blank, as long as those to its left repeat as well.
        kept: number of leading columns that are always there; behind them those are left out in
            which no row has a value. ``None``: all are there.

    Example:
        >>> print(table([{"stage": "solve", "s": "9.50"}, {"stage": "total", "s": None}]))
        stage     s
        solve  9.50
        total     -
    """
    if kept is not None and rows:
        titles = [t for i, t in enumerate(rows[0]) if i < kept or {row[t] for row in rows} - _EMPTY]
        rows = [{title: row[title] for title in titles} for row in rows]
    texts = cells(rows)
    shown = [list(row) for row in texts]
    for above, row, own in zip(texts[1:], texts[2:], shown[2:], strict=False):
        for column in range(merged):
            if above[: column + 1] == row[: column + 1]:
                own[column] = ""
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    lines = []
    for row in shown:
        padded = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        for column in range(num_left):
            padded[column] = row[column].ljust(widths[column])
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def cells(rows: Sequence[Mapping[str, object]]) -> list[list[str]]:
    """The header and the rows as text; no row gives nothing."""
    words_of = {None: "-", True: "yes", False: "no"}
    texts = [list(rows[0])] if rows else []
    for row in rows:
        values = row.values()
        texts.append([words_of[v] if v is None or isinstance(v, bool) else str(v) for v in values])
    return texts


@contextmanager
def csv_writer(
    path: str | Path, columns: Sequence[str]
) -> Iterator[Callable[[Iterable[Iterable[Any]]], None]]:
    """Open a CSV file that is there, whole, when all went well; yields what writes its rows.

    Args:
        path: of the file.
        columns: its header.
    """
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        yield writer.writerows


def marked(simulated: bool, *lines: str) -> str:
    """The lines, under the one without which no simulated number may be printed."""
    return "\n".join([*([SIMULATED_LINE] if simulated else []), *lines])


def percent(fraction: float | None, digits: int = 2) -> str:
    """A fraction in percent, ``-`` where there is none.

    Example:
        >>> percent(0.97531), percent(None)
        ('97.53', '-')
    """
    return "-" if fraction is None else f"{100 * fraction:.{digits}f}"


def interval(
    number: Mapping[str, float] | None, digits: int, unit: str = "", scale: float = 1.0
) -> str:
    """A number with the ends of its interval, ``-`` where there is none.

    Example:
        >>> interval({"value": 74.21, "low": 70.1, "high": 78.0}, 1, " /min")
        '74.2 /min [70.1, 78.0]'
    """
    if number is None:
        return "-"
    value, low, high = (f"{scale * number[end]:.{digits}f}" for end in ("value", "low", "high"))
    return f"{value}{unit} [{low}, {high}]"


def words(name: str) -> str:
    """A name of the code as people write it: spaces in place of underscores."""
    return name.replace("_", " ")


def grouped(count: float) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{count:,.0f}".replace(",", "\N{THIN SPACE}")


# Figures -----------------------------------------------------------------------------------------
styled = rc_context(
    {
        "font.size": 9,
        "figure.titlesize": 12,
        "axes.titlesize": 10.5,
        "axes.titlelocation": "left",
        "axes.labelsize": 9,
        "axes.labelcolor": GREY,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": LIGHT,
        "grid.linewidth": 0.7,
        "xtick.major.size": 0,
        "xtick.minor.size": 0,
        "xtick.labelcolor": INK,
        "ytick.major.size": 0,
        "ytick.minor.size": 0,
        "ytick.labelcolor": INK,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
    }
)
"""Decorates what draws a figure: a light grid behind the data, no ticks, no box, small letters."""


def new_figure(width: float, height: float, title: str = "", *, simulated: bool = False) -> Figure:
    """An empty figure of some inches, its parts laid out by matplotlib, that says SIMULATED."""
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(f"{title} (SIMULATED data)" if simulated else title)
    return figure


def save(figure: Figure, path: str | Path, dpi: int = 160) -> None:
    """Write a figure as PNG, replaced as a whole if it exists."""
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi, facecolor="white")


def lanes(axes: Axes, names: Sequence[str], *, least: int = 1) -> None:
    """Give the y axis a lane for each name, the first on top; space for ``least`` lanes."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(max(least, len(names)) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")


def stack(axes: Axes, lane: float, widths: Sequence[float], colours: Iterable[str]) -> None:
    """One bar in a lane out of parts that follow each other."""
    left = 0.0
    for width, colour in zip(widths, colours, strict=True):
        axes.barh(lane, width, 0.6, left=left, color=colour)
        left += width


def legend_below(figure: Figure, handles: Sequence[Any], ncols: int) -> None:
    """One legend for all panels, below them."""
    place: Any = "outside lower center"  # which matplotlib's types lack
    figure.legend(handles=handles, ncols=ncols, loc=place)


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name, in the order of ``PALETTE``."""
    return dict(zip(dict.fromkeys(names), cycle(PALETTE)))


def is_fast(channel: Mapping[str, str]) -> bool:
    """Whether a channel of ``HandLayout.to_rows`` adapts fast; if it does not say, as its kind."""
    return channel.get("adapting", "fast" if channel["kind"] == "PVDF" else "slow") == "fast"
