"""The numbers that rearranging must not move: by recipe, the confusion of each split.

    PYTHONPATH=tests python -m contract.unmoved default     # or paper, or real: minutes

measures one anew, prints it, and what moved.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from .names import CONFUSION, METRICS, SPLITS, UNSEEN_EXPERIMENT, settings
from .running import ROOT, arguments_of, environment

FILE = Path(__file__).with_name("unmoved.json")
REAL_DATA = Path(os.environ.get("BIOTACSP", ROOT.parent / "shared" / "data" / "biotacsp-dos"))
MOST_MOVED = 2
"""Bins of any cell of a confusion."""
_REAL = """data=biotacsp_dos labels.bin_ms=640 labels.hop_ms=320 +features.frames.electrode=null
features.level=3 features.spectrum=clean features.pooling=sorted split.seen=[case,hd,sponge,pen]
split.unseen=[bottle,cardboard,brush,screw,striped,bubbles,plate] split.train_fraction=0.5"""
EXPERIMENTS = {
    "paper": settings(experiment=UNSEEN_EXPERIMENT, recipe="paper", seed=0),
    "default": settings(experiment=UNSEEN_EXPERIMENT, seed=0),
    "real": [*_REAL.split(), *settings(root=REAL_DATA, seed=0)],
}


def measured(name: str, folder: Path, cache: Path) -> dict[str, Any]:
    """Run an experiment in a folder of its own; its confusions by split, and what made them."""
    folder.mkdir()
    more = settings(cache=cache, export=False, baselines=False, folder=folder / "run")
    command = [sys.executable, *arguments_of("train", *EXPERIMENTS[name], *more)]
    threads = str(os.cpu_count() or 1)
    subprocess.run(
        command,
        cwd=folder,
        env=environment(OMP_NUM_THREADS=threads),
        stdout=subprocess.DEVNULL,
        check=True,
    )
    metrics = json.loads((folder / "run" / METRICS).read_text())
    confusions = {split: scores[CONFUSION] for split, scores in metrics[SPLITS].items()}
    return {"command": EXPERIMENTS[name], "splits": confusions, "versions": metrics["versions"]}


def moved(expected: dict[str, Any], found: dict[str, Any]) -> dict[str, list[int]]:
    """By split the difference of each cell, where one is more than ``MOST_MOVED``."""
    assert expected["splits"].keys() <= found["splits"].keys()
    differences = {}
    for split, confusion in expected["splits"].items():
        rows = zip(confusion, found["splits"][split], strict=True)
        cells = [b - a for left, right in rows for a, b in zip(left, right, strict=True)]
        if max(map(abs, cells)) > MOST_MOVED:
            differences[split] = cells
    return differences


def main() -> None:
    """Measure what was asked for, and print it."""
    (name,) = sys.argv[1:] or ["default"]
    with tempfile.TemporaryDirectory() as folder:
        found = measured(name, Path(folder) / name, Path(folder) / "cache")
    print(json.dumps(found, indent=1))
    noted = json.loads(FILE.read_text())[name]
    print("moved by more than two bins:", moved(noted, found) or "nothing")


if __name__ == "__main__":
    main()
