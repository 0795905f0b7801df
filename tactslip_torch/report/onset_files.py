"""The files of what was heard: onsets as JSON and as a table, decisions as they are made."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tactslip_torch.report.onset_table import COLUMNS, onset_rows
from tactslip_torch.runtime import whole_file

Keep = Callable[[Iterable[Sequence[Any]]], None]


def write_onsets(content: Mapping[str, Any], folder: Path) -> None:
    """Write ``onsets.json`` and ``onsets.csv``, each whole or not at all.

    Args:
        content: of ``onsets.json``.
        folder: where they go.
    """
    with whole_file(folder / "onsets.json") as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    with _table(folder / "onsets.csv", COLUMNS) as keep:
        keep(list(row.values()) for row in onset_rows(content))


def plain(value: Any) -> Any:
    """The same with ``None`` for every number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def decisions_file(path: Path, columns: Sequence[str], *, wanted: bool) -> Iterator[Keep]:
    """What rows are given to as they come; a table that is there, whole, when all have.

    Args:
        path: of the CSV file.
        columns: its head.
        wanted: whether there is to be one.
    """
    if not wanted:
        yield lambda rows: None
        return
    with _table(path, columns) as keep:
        yield keep


@contextmanager
def _table(path: Path, columns: Sequence[str]) -> Iterator[Keep]:
    with (
        whole_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        yield table.writerows
