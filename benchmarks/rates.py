"""Bins a second, and limits as rows: met, missed, not measured, or for information."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.tables import Spread

NOT_MEASURED = "not measured"


def rate(row: Mapping[str, Any]) -> Spread:
    """Bins a second of a row with ``bins`` and the ``seconds`` of every round."""
    return Spread.of([row["bins"] / seconds for seconds in row["seconds"]])


def at_least(what: str, of: Spread | None, least: float, more: str = "") -> dict[str, Any]:
    """A row of a limit on a median.

    Args:
        what: is limited.
        of: measured; ``None`` if it was not.
        least: the limit.
        more: said beside what was measured.
    """
    limit = f">= {least:,g}"
    if of is None:
        return not_measured(what, limit)
    is_met = of.median >= least
    return {"what": what, "measured": of.text() + more, "limit": limit, "ok": is_met}


def not_measured(what: str, limit: str) -> dict[str, Any]:
    """A row of a limit that nobody can judge."""
    return {"what": what, "measured": NOT_MEASURED, "limit": limit, "ok": None}


def information(what: str, measured: str) -> dict[str, Any]:
    """A row beside the limits that is none."""
    return {"what": what, "measured": measured, "limit": "-", "ok": None}
