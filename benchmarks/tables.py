"""Tables that a terminal and a Markdown page show alike, numbers in them, and bars in figures."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from statistics import mean, median, quantiles, stdev
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tactslip_torch.report import style

percent = style.percent
Report = Mapping[str, Any]
"""What a benchmark keeps: ``numbers`` that it measured, and what they were measured on."""
# Okabe and Ito, told apart by the colour-blind
OURS, SECOND, THIRD, PEER, GREY = "#0072b2", "#e69f00", "#009e73", "#d55e00", "#888888"
COLORS = (OURS, PEER, THIRD, SECOND, "#cc79a7", "#56b4e9", GREY)
LIGHT = "#dddddd"


def number(value: float | None, digits: int = 3) -> str:
    """A number to some significant digits, without an exponent where it is short; or ``-``.

    Example:
        >>> [number(value) for value in (0.01234, 12.345, 123456.0, 1.2e-11)]
        ['0.0123', '12.3', '123,456', '1.2e-11']
    """
    if value is None:
        return "-"
    if value and abs(value) < 1e-4:
        return f"{value:.1e}"
    if abs(value) >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def mean_sd(values: Iterable[float], digits: int = 2, sign: str = "") -> str:
    """``mean ± sd`` over seeds, the mean alone of one, or ``-`` of nothing.

    Example:
        >>> mean_sd([1.0, 2.0, 3.0])
        '2.00 ± 1.00'
    """
    every = list(values)
    if not every:
        return "-"
    spread = f" ± {stdev(every):.{digits}f}" if len(every) > 1 else ""
    return f"{mean(every):{sign}.{digits}f}{spread}"


def by(rows: Iterable[Report], *keys: str) -> dict[tuple[Any, ...], list[Report]]:
    """Rows by the values of these keys, in order of appearance.

    Example:
        >>> by([{"a": 1, "b": 2}, {"a": 1, "b": 3}], "a")
        {(1,): [{'a': 1, 'b': 2}, {'a': 1, 'b': 3}]}
    """
    found: dict[tuple[Any, ...], list[Report]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


class Spread(NamedTuple):
    """The median of some numbers and their quartiles."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float], factor: float = 1.0) -> Spread:
        """Median and quartiles, in another unit by a factor.

        Example:
            >>> Spread.of([3.0, 1.0, 2.0])
            Spread(median=2.0, low=1.5, high=2.5)
        """
        scaled = [factor * value for value in values]
        if len(scaled) < 2:
            return cls(*scaled * 3)
        low, _, high = quantiles(scaled, n=4, method="inclusive")
        return cls(median(scaled), low, high)

    def text(self, digits: int = 3) -> str:
        """``median (low to high)``."""
        middle, low, high = (number(value, digits) for value in self)
        return f"{middle} ({low} to {high})"


class Table(NamedTuple):
    """A table that a terminal and a Markdown file show alike.

    Attributes:
        rows: cells by column, the same columns in each; the first names the row. A fraction is
            written as ``number`` does, a ``Spread`` as its ``text``, ``None`` as ``-``.
        note: a line below it.
    """

    rows: Sequence[Mapping[str, object]]
    note: str = ""

    def _shown(self) -> list[dict[str, object]]:
        return [{name: _cell(value) for name, value in row.items()} for row in self.rows]

    def columns(
        self, starts: str | tuple[str, ...]
    ) -> tuple[list[str], dict[str, list[float | None]]]:
        """What names the rows, and by column the numbers of those whose names begin like this."""
        first, *others = self.rows[0]
        found = {n: [_middle(row[n]) for row in self.rows] for n in others if n.startswith(starts)}
        return [str(row[first]) for row in self.rows], found

    def text(self) -> str:
        """Aligned columns."""
        return "\n".join(filter(None, [style.table(self._shown()), self.note]))

    def markdown(self) -> str:
        """A table of Markdown, columns of numbers to the right and of words to the left."""
        header, *rows = style.cells(self._shown())
        rule = [
            "---:" if place and all(re.match(r"[+-]?\d|-?$", cell) for cell in column) else "---"
            for place, column in enumerate(zip(*rows, strict=True))
        ]
        lines = [f"| {' | '.join(cells)} |" for cells in (header, rule, *rows)]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


def _middle(value: Any) -> float | None:
    return value.median if isinstance(value, Spread) else value


def _cell(value: object) -> object:
    if isinstance(value, Spread):
        return value.text()
    return number(value) if isinstance(value, float) else value


def listed(about: str, values: Mapping[str, object]) -> Table:
    """Values below each other, a row each."""
    return Table([{about: name, "": value} for name, value in values.items()])


def limits(rows: Iterable[tuple[str, float, float, str]]) -> Table:
    """Every limit beside what was measured, met or missed.

    Args:
        rows: what was measured, its value, the most that was set for it, and their unit.
    """
    return Table(
        [
            {
                "limits": what,
                "measured": f"{number(measured)} {unit}".strip(),
                "limit": f"<= {number(most)} {unit}".strip(),
                "": "met" if measured <= most else "MISSED",
            }
            for what, measured, most, unit in rows
        ]
    )


def bars(
    axes: Axes,
    names: Sequence[str],
    series: Mapping[str, Sequence[float | None]],
    about: str,
    *,
    is_log: bool = True,
) -> None:
    """Horizontal bars, the first on top, each with its value; a colour and a legend by series.

    Args:
        axes: to draw on.
        names: of the groups of bars.
        series: values by their meaning, one a name; ``None`` leaves a bar out.
        about: labels the axis of values.
        is_log: whether that axis is logarithmic where values differ by more than a factor of 20.
    """
    height = 0.8 / len(series)
    for step, (label, values) in enumerate(series.items()):
        places = [place + height * (step - (len(series) - 1) / 2) for place in range(len(names))]
        shown = [(place, of) for place, of in zip(places, values, strict=True) if of is not None]
        color = COLORS[step % len(COLORS)]
        at, widths = [place for place, _ in shown], [value for _, value in shown]
        axes.barh(at, widths, color=color, height=0.9 * height, label=label)
        for place, value in shown:
            axes.annotate(
                number(value), (value, place), (3, 0), textcoords="offset points", va="center",
                size=7,
            )  # fmt: skip
    style.lanes(axes, names)
    every = [of for values in series.values() for of in values if of]
    is_log &= bool(every) and max(every) > 20 * min(every)
    if is_log:
        axes.set_xscale("log")
        is_narrow = max(every) < 100 * min(every)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if is_narrow else (1,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(x=0.12)
    axes.set_xlabel(f"{about} (logarithmic axis)" if is_log else about)
    if len(series) > 1:
        axes.legend()
