"""Benchmarks that are one command of the package: alarms, crossval and sensors share this.

The run of a command is kept with the digest of the code that made it, and taken again if nothing
changed; its figures are those that the command leaves.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import Table, say, write_text
from benchmarks.reproduction.runs import code_digest
from tactslip_torch.runtime import whole_file


def result_of(command: str, overrides: Sequence[str], folder: Path, name: str) -> dict[str, Any]:
    """The JSON file ``name`` that ``tactslip COMMAND`` leaves in the folder.

    Raises:
        RuntimeError: if the command fails, which has said why.
    """
    made_by, note = " ".join([code_digest(), *overrides]), folder / "made_by.txt"
    if not note.exists() or note.read_text(encoding="utf-8") != made_by:
        given = ["-m", "tactslip_torch", command, *overrides, f"hydra.run.dir='{folder}'"]
        say(" ".join(given))
        done = subprocess.run([sys.executable, *given], stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise RuntimeError(f"tactslip {command} failed; see above")
        write_text(note, made_by)
    found: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
    return found


def take_figures(folder: Path, figures: Mapping[str, Path]) -> None:
    """Copy figures of a run's folder, by their name there, to where they go."""
    for name, path in figures.items():
        if (folder / name).exists():
            with whole_file(path) as temporary:
                shutil.copy(folder / name, temporary)


def table_of(rows: Sequence[Sequence[str]], note: str = "") -> Table:
    """A table of a header and rows."""
    return Table(rows[0], rows[1:], note)
