"""What was tried on this set while planning, so that nobody takes the best of many for a result.

The figures in ``tried.json`` come from exploration scripts on the same windows and folds. They are
kept as they were logged; ``python -m benchmarks.real`` measures none of them again.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from benchmarks.tables import Table

PATH = Path(__file__).with_name("tried.json")


def tried() -> list[dict[str, Any]]:
    """One row per variant, in the order of the log."""
    rows: list[dict[str, Any]] = json.loads(PATH.read_text(encoding="utf-8"))
    return rows


def tried_table() -> Table:
    """All of them."""
    cells = [
        [
            row["what"],
            f"{100 * row['balanced_accuracy']:.2f}",
            f"{100 * row['auc']:.2f}",
            f"{row['worst']} {100 * row['worst_balanced_accuracy']:.1f}",
        ]
        for row in tried()
    ]
    return Table(["variant", "balanced accuracy %", "AUC %", "worst object %"], cells)
