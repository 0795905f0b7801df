"""Tables of a Markdown page, numbers in them, and charts of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from statistics import mean, median, quantiles, stdev
from typing import Any, NamedTuple

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tactslip_torch.report import style

percent = style.percent
Report = Mapping[str, Any]
"""What a benchmark keeps: ``numbers`` that it measured, and what they were measured on."""
ROLES = {"test": "test cycles", "unseen": "held-out materials"}
"""Of a split, in words."""
MOST_BARS = 24
"""In a chart; more values are dots."""
_UNIT = re.compile(r"[ ,](%|us|ms|s|kB|MB)(?: |$)")
_DASHES = ("-", "--", ":")


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
    def of(cls, values: Sequence[float]) -> Spread:
        """Median and quartiles.

        Example:
            >>> Spread.of([3.0, 1.0, 2.0])
            Spread(median=2.0, low=1.5, high=2.5)
        """
        if len(values) < 2:
            return cls(*[*values] * 3)
        low, _, high = quantiles(values, n=4, method="inclusive")
        return cls(median(values), low, high)

    def text(self, digits: int = 3) -> str:
        """``median (low to high)``."""
        middle, low, high = (number(value, digits) for value in self)
        return f"{middle} ({low} to {high})"


class Table(NamedTuple):
    """A table of a Markdown page.

    Attributes:
        rows: cells by column, the same columns in each; the first names the row. A fraction is
            written as ``number`` does, several as their ``Spread``, ``None`` as ``-``.
        note: a line below it.
    """

    rows: Sequence[Mapping[str, object]]
    note: str = ""

    def _shown(self) -> list[dict[str, object]]:
        return [{name: _cell(value) for name, value in row.items()} for row in self.rows]

    def columns(
        self, starts: str | tuple[str, ...]
    ) -> tuple[list[str], dict[str, list[float | None]]]:
        """What names the rows, and the first number of each cell in columns that begin like this.

        Names are the words before those columns, of the first three, without results (``mean ±
        sd``) and words that all rows have.
        """
        chosen = [name for name in list(self.rows[0])[1:] if name.startswith(starts)]
        found = {name: [_first_number(row[name]) for row in self.rows] for name in chosen}
        before = list(self.rows[0])[: min(3, list(self.rows[0]).index(chosen[0]))]
        cells = {name: [row[name] for row in self.rows] for name in before}
        words = [
            name
            for place, (name, own) in enumerate(cells.items())
            if isinstance(own[0], str) and not any("±" in str(cell) for cell in own)
            if not place or len(set(own)) > 1
        ]
        of = {
            name: name if all(re.match(r"[+-]?\d", str(cell)) for cell in cells[name]) else ""
            for name in words
        }
        names = [", ".join(f"{of[n]} {row[n]}".strip() for n in words) for row in self.rows]
        return names, found

    def curves(self, y: str, x: str) -> dict[str, tuple[list[float], list[float]]]:
        """By the first column the numbers of column ``x``, and those of ``y``."""
        found: dict[str, tuple[list[float], list[float]]] = {}
        for row in self.rows:
            points = found.setdefault(str(next(iter(row.values()))), ([], []))
            for values, name in zip(points, (x, y), strict=True):
                value = _first_number(row[name])
                values.append(math.nan if value is None else value)  # nothing is drawn of NaN
        return found

    def markdown(self) -> str:
        """A table of Markdown, columns of numbers to the right and of words to the left."""
        header, *rows = ([c.replace("|", "\\|") for c in row] for row in style.cells(self._shown()))
        rule = [
            "---:" if place and all(re.match(r"[+-]?\d|-?$", cell) for cell in column) else "---"
            for place, column in enumerate(zip(*rows, strict=True))
        ]
        lines = [f"| {' | '.join(cells)} |" for cells in (header, rule, *rows)]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


def _first_number(value: Any) -> float | None:
    """Such as the mean of ``mean ± sd``; of several numbers the median."""
    if isinstance(value, str):
        found = re.match(r"[+-]?[\d,]*\.?\d+(e[+-]?\d+)?", value)
        return float(found[0].replace(",", "")) if found else None
    middle: float | None = median(value) if isinstance(value, list) else value
    return middle


def _cell(value: object) -> object:
    if isinstance(value, list):
        return Spread.of(value).text()
    return number(value) if isinstance(value, float) else value


def times(values: Iterable[float], factor: float) -> list[float]:
    """The values in another unit."""
    return [factor * value for value in values]


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
                "measured": f"{number(measured, 4)} {unit}".strip(),
                "limit": f"<= {number(limit, 4)} {unit}".strip(),
                "": "met" if measured <= limit else "MISSED",
            }
            for what, measured, limit, unit in rows
        ]
    )


def by_unit(columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Columns by the unit in their names, or ``""``.

    Example:
        >>> by_unit({"median ms": 1, "size, kB": 2, "p95 ms of all": 3})
        {'ms': {'median ms': 1, 'p95 ms of all': 3}, 'kB': {'size, kB': 2}}
    """
    found: dict[str, dict[str, Any]] = {}
    for name, values in columns.items():
        unit = _UNIT.search(name)
        found.setdefault(unit[1] if unit else "", {})[name] = values
    return found


def is_barred(names: Sequence[str], series: Mapping[str, object]) -> bool:
    """Whether a chart has bars: they are few enough."""
    return len(names) * len(series) <= MOST_BARS


def chart(
    axes: Axes, names: Sequence[str], series: Mapping[str, Sequence[float | None]], about: str
) -> None:
    """Horizontal bars, each with its value, or dots where they are many; the first row on top.

    Dots of later series are smaller, so that all are seen where they meet.

    The axis of values is logarithmic where bars differ by more than a factor of 20 and are no
    percentages.

    Args:
        axes: to draw on.
        names: of the rows.
        series: values by their meaning, one a name, a colour each; ``None`` leaves one out.
        about: labels the axis of values.
    """
    is_bars, height = is_barred(names, series), 0.8 / len(series)
    looks, look = product("osD", style.PALETTE), dict[str, Any]()
    for step, (label, (marker, color)) in enumerate(zip(series, looks, strict=False)):
        shift = height * (step - (len(series) - 1) / 2) if is_bars else 0.0
        shown = {place + shift: of for place, of in enumerate(series[label]) if of is not None}
        if not is_bars:
            size = 3 + 6 * (len(series) - step) / len(series)
            look = {"color": color, "markersize": size}
            axes.plot(list(shown.values()), list(shown), marker, label=label, **look)
            continue
        axes.barh(list(shown), list(shown.values()), color=color, height=0.9 * height, label=label)
        for place, value in shown.items():
            look = {"textcoords": "offset points", "va": "center", "size": 7}
            axes.annotate(number(value), (value, place), (3, 0), **look)
    style.lanes(axes, names)
    every = [of for values in series.values() for of in values if of]
    is_percent = "%" in about or any("%" in label for label in series)
    if is_bars and not is_percent and every and max(every) > 20 * min(every) > 0:
        axes.set_xscale("log")
        is_narrow = max(every) < 100 * min(every)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if is_narrow else (1,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        about += " (logarithmic axis)"
    axes.margins(x=0.12)
    axes.set_xlabel(about)
    if len(series) > 1:
        axes.legend(**style.UPPER_LEFT_OUTSIDE)


def lines(
    axes: Axes, series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x: str, y: str
) -> None:
    """Lines by their meaning, each its places and its values, and what these are."""
    looks = product(_DASHES, style.PALETTE)
    for (label, points), (dash, color) in zip(series.items(), looks, strict=False):
        marker = "o" if len(points[0]) <= MOST_BARS else ""
        axes.plot(*points, marker + dash, color=color, label=label, markersize=4)
    axes.set_xlabel(x)
    axes.set_title(y)
    if len(series) > 1:
        axes.legend(**style.UPPER_LEFT_OUTSIDE)
