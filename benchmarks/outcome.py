"""What every benchmark does with its report: limits as a table, numbers in a file."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactslip_torch.files import whole_file
from tactslip_torch.report.tables import aligned

RESULTS = Path(__file__).parent / "results"
EXIT_INTERRUPTED = 130


def refuse_folders(
    parser: argparse.ArgumentParser, parsed: argparse.Namespace, *names: str
) -> None:
    """End the program with the parser's error if one of these options names a folder."""
    for name in names:
        path = getattr(parsed, name)
        if path and path.is_dir():
            parser.error(f"--{name} needs a file, {path} is a folder")


def limits_table(rows: Sequence[Mapping[str, Any]], measured: str = "measured") -> str:
    """Every limit beside what was measured, met or missed.

    Args:
        rows: with ``what``, ``measured``, ``limit`` and ``ok``.
        measured: heads the second column.
    """
    cells = [
        [row["what"], row["measured"], row["limit"], "met" if row["ok"] else "MISSED"]
        for row in rows
    ]
    return aligned(["limits", measured, "limit", ""], cells)


def keep_numbers(report: Mapping[str, Any], path: Path | None) -> None:
    """Write a report as JSON, whole or not at all, and say where; nothing without a path."""
    if path is None:
        return
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    print(f"\nnumbers in {path}")
