"""What a method is: rows that know no label, and a fit to those of a fold's training windows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from benchmarks.real.windows import Array

Score = Callable[[Array], Array]
"""Scores ``[N]`` of rows or windows; at least 0 means slip."""


class Training(NamedTuple):
    """The training windows of a fold.

    Shape:
        - rows: ``[n, *]``, of the method
        - is_slip: ``[n]``, bool
        - objects: ``[n]``, text; none of them is the one left out
        - recording: ``[n]``, place in ``Windows.recordings``
    """

    rows: Array
    is_slip: Array
    objects: Array
    recording: Array

    @property
    def fold(self) -> tuple[str, ...]:
        """The training objects, ascending."""
        return tuple(sorted(set(self.objects.tolist())))


class Fitted(NamedTuple):
    """What a fit made.

    Attributes:
        decide: scores of rows.
        judge: scores of windows ``[N, C, n]``, with everything that takes; the clock runs on it.
        chosen: inside the fold, JSON-able.
    """

    decide: Score
    judge: Score
    chosen: Mapping[str, Any]


class Method(NamedTuple):
    """A method.

    Attributes:
        name: for tables.
        rows: of every window ``[N, *]``, for which no label was looked at.
        rows_s: seconds that describing a window took; 0 where ``fit`` does it.
        fit: to a fold.
    """

    name: str
    rows: Array
    rows_s: float
    fit: Callable[[Training], Fitted]
