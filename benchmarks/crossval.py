"""Recipes on every choice of four held-out materials: ``python -m benchmarks.crossval``.

Runs ``python -m tactslip_torch crossval`` unless this code has, keeps its numbers and its figure in
``benchmarks/results``, and puts the tables between the markers in README.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.outcome import RESULTS, ROOT, between_markers
from tactslip_torch.features.cache import source_digest
from tactslip_torch.report.crossval import crossval_figure, material_rows, split_rows
from tactslip_torch.runtime import whole_file

COMMAND = "python -m benchmarks.crossval"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table of a header and rows."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--run", type=Path, default=ROOT / "outputs" / "crossval" / "0")
    text = "of the markers in README.md and of the files in benchmarks/results"
    parser.add_argument("--name", default="crossval", help=text)
    parser.add_argument("overrides", nargs="*", help="passed on, such as num_unseen=1")
    options = parser.parse_args(arguments)
    made_by = options.run / "code.txt"
    code = " ".join([source_digest(ROOT / "tactslip_torch"), *options.overrides])
    if not made_by.exists() or made_by.read_text() != code:
        command = [sys.executable, "-m", "tactslip_torch", "crossval", *options.overrides]
        done = subprocess.run([*command, f"hydra.run.dir={options.run}"], check=False)
        if done.returncode:
            raise SystemExit(done.returncode)
        made_by.write_text(code)
    found = json.loads((options.run / "crossval.json").read_text())
    with whole_file(RESULTS / f"{options.name}.json") as temporary:
        temporary.write_text(json.dumps(found) + "\n")
    crossval_figure(found, RESULTS / f"{options.name}.png")
    named = [] if options.name == "crossval" else [f"--name {options.name}"]
    shown = " ".join([COMMAND, *named, *(f"'{each}'" for each in options.overrides)])
    kind = "simulated" if found["simulated"] else "recorded"
    note = (
        f"Balanced accuracy, %, {kind}, seed {found['seed']}; machines fitted on "
        f"{found['train_bins']} bins of each material and class (`{shown}`, code "
        f"{code.split()[0]}):"
    )
    text = "\n\n".join([note, markdown(split_rows(found)), markdown(material_rows(found))])
    readme = ROOT / "README.md"
    with whole_file(readme) as temporary:
        temporary.write_text(between_markers(readme.read_text(), options.name, text))


if __name__ == "__main__":
    main()
