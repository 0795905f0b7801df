"""A table that a terminal and a Markdown file show alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median, quantiles
from typing import Any, NamedTuple

from tactslip_torch.report.style import table


class Table(NamedTuple):
    """What is shown of some rows.

    Attributes:
        header: of the columns; the first heads the names of the rows.
        rows: cells.
        note: a line below it.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def text(self) -> str:
        """Aligned columns."""
        return "\n".join(filter(None, [table([self.header, *self.rows]), self.note]))

    def markdown(self) -> str:
        """A table of Markdown, numbers to the right."""
        rule = ["---", *["---:"] * (len(self.header) - 1)]
        lines = [f"| {' | '.join(cells)} |" for cells in (self.header, rule, *self.rows)]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


def limits(rows: Sequence[Mapping[str, Any]], measured: str = "measured") -> Table:
    """Every limit beside what was measured, met or missed.

    Args:
        rows: with ``what``, ``measured``, ``limit`` and ``ok``, which is ``None`` where there is
            nothing to judge.
        measured: heads the second column.
    """
    verdicts = {True: "met", False: "MISSED", None: "-"}
    cells = [[row["what"], row["measured"], row["limit"], verdicts[row["ok"]]] for row in rows]
    return Table(["limits", measured, "limit", ""], cells)


class Spread(NamedTuple):
    """The middle of some numbers, and half of them between."""

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
            return cls(*[float(value) for value in values] * 3)
        low, _, high = quantiles(values, n=4, method="inclusive")
        return cls(median(values), low, high)

    def times(self, factor: float) -> Spread:
        """In another unit."""
        return Spread(*(factor * value for value in self))

    def text(self, digits: int = 3) -> str:
        """``median (low to high)``."""
        middle, low, high = (number(value, digits) for value in self)
        return f"{middle} ({low} to {high})"


def number(value: float, digits: int = 3) -> str:
    """A number to some significant digits, without an exponent where it is short.

    Example:
        >>> [number(value) for value in (0.01234, 12.345, 123456.0, 1.2e-11)]
        ['0.0123', '12.3', '123,456', '1.2e-11']
    """
    if value and abs(value) < 1e-4:
        return f"{value:.1e}"
    if abs(value) >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def limits_last(by_title: Mapping[str, Sequence[Table]], *, titled: bool = False) -> list[str]:
    """Tables as text, each under its title if ``titled``; those of ``"Limits"`` last, without."""
    others = {title: of for title, of in by_title.items() if title != "Limits"}
    texts = [
        f"{title}\n{table.text()}" if titled else table.text()
        for title, of in others.items()
        for table in of
    ]
    return [*texts, *(table.text() for table in by_title["Limits"])]
