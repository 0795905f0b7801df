"""Real recordings, ours and baselines: ``python -m benchmarks.real data.root=FOLDER [--quick]``.

On the BioTac SP set (``+exp=biotacsp_dos``), with every object left out in turn. In one run, on the
same windows and folds: the machine of three recipes, logistic regression on the features of the
first, logistic regression and a random forest on simple statistics, and MiniRocket and
MultiRocketHydra with ridge. All that is fitted or chosen is so inside the fold. Prints tables and
limits, keeps numbers and figure in ``benchmarks/results``, and writes ``REAL_DATA.md``.
``--report`` writes from what is kept.
``--quick`` looks whether all of it runs, and leaves its results in a folder in ``outputs``.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks import RESULTS, ROOT
from benchmarks.harness import (
    EXIT_INTERRUPTED,
    keep_numbers,
    machine_facts,
    on_threads,
    versions,
)
from benchmarks.real.bootstrap import differences
from benchmarks.real.figure import figure
from benchmarks.real.measure import clocked, methods_of, on_folds
from benchmarks.real.page import page
from benchmarks.real.report import limit_rows, report_text
from benchmarks.real.scores import judged
from benchmarks.real.sizes import QUICK, Sizes
from benchmarks.real.watched import drawn, watched, watched_figure
from benchmarks.real.windows import composed, read_windows, recipe_of
from benchmarks.reproduction.runs import code_digest
from tactslip_torch.commands.entry import errors_in_one_line
from tactslip_torch.runtime import whole_file

RECIPES = ("general", "robust", "paper")
"""Of ours; the first is the one that limits are for."""
LIBRARIES = ("numba", "aeon")


def measure(overrides: Sequence[str], sizes: Sizes, folder: Path, quick: bool) -> dict[str, Any]:
    """The report: facts, scores, times, and what follows from them. JSON-able.

    Args:
        overrides: of the configuration, with ``data.root``.
        sizes: how much.
        folder: of what is kept of a run.
        quick: whether the sizes are too small to mean anything.

    Raises:
        ValueError: for bad input, in one line.
    """
    machine = machine_facts()
    config = composed(overrides, RECIPES[0])
    recipes = [recipe_of(overrides, name) for name in RECIPES]
    windows, folds = read_windows(config, sizes)
    with on_threads(1):
        found = on_folds(windows, folds, methods_of(windows, recipes, sizes))
        rockets = [name for name in found if "Rocket" in name]
        timed = [name for name in found if name not in rockets or name.endswith("seed 0")]
        times = clocked(windows, found, timed, rockets[0], sizes)
        folder.mkdir(parents=True, exist_ok=True)
        scores = {name: of.scores for name, of in found.items()}
        with whole_file(folder / "scores.npz") as temporary, temporary.open("wb") as file:
            table = np.stack(list(scores.values()))
            names = np.array(list(scores))
            np.savez(file, scores=table, methods=names, is_slip=windows.is_slip)
        own = found[next(iter(found))].method.rows
        heard = watched(windows, folds, recipes[0], own, config, folder)
        told = (windows.is_slip, windows.recording, sizes.draws)
        gaps = differences(scores, next(iter(scores)), *told)
    rows = {
        name: judged(of.scores, windows.is_slip, windows.objects, windows.scenes)
        | {"fit_s": median(of.fit_s), "chosen": of.chosen, "time": times.get(name)}
        for name, of in found.items()
    }
    sections = {"methods": rows, "differences": gaps, "watched": heard}
    return {
        "code": code_digest(),
        "simulated": False,  # read_windows refuses those
        "quick": quick,
        "machine": machine,
        "threads": 1,
        "versions": versions(LIBRARIES),
        "command": ["data.root=FOLDER", *(o for o in overrides if not o.startswith("data.root"))],
        "settings": asdict(sizes),
        "data": {
            "recordings": len(windows.recordings),
            "windows": {"slip": int(windows.is_slip.sum()), "all": len(windows.is_slip)},
            "objects": sorted(set(windows.objects.tolist())),
            "channels": int(windows.samples.shape[1]),
            "samples": int(windows.samples.shape[2]),
            "pool": len(windows.maker.pool.names),
        },
        "ours": next(iter(rows)),
        "rockets": rockets,
        "sections": sections,
        "limits": limit_rows(rows, next(iter(rows)), rockets),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.real",
        description="Ours and baselines on real recordings, each object left out in turn.",
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="key=value", help="of train; data.root=FOLDER of the set"
    )
    parser.add_argument("--quick", action="store_true", help="very little, to see that it runs")
    parser.add_argument("--report", action="store_true", help="write from what is kept")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="of kept rows (outputs/real)")
    parser.add_argument("--page", type=Path, metavar="FILE", help="REAL_DATA.md, unless --quick")
    for name in ("json", "figure"):
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help="(benchmarks/results)")
    parsed = parser.parse_intermixed_args(arguments)
    folder = parsed.runs or ROOT / "outputs" / f"real{'-quick' * parsed.quick}"
    place = folder if parsed.quick else RESULTS
    parsed.json = parsed.json or place / "real.json"
    parsed.figure = parsed.figure or place / "real.png"
    parsed.page = parsed.page or (folder if parsed.quick else ROOT) / "REAL_DATA.md"
    for path in (parsed.json, parsed.figure, parsed.page):
        path.parent.mkdir(parents=True, exist_ok=True)
    if wrong := [text for text in parsed.overrides if "=" not in text]:
        parser.error(f"overrides are key=value, got {wrong[0]!r}")
    if parsed.report and not parsed.json.exists():
        parser.error(f"--report needs {parsed.json}; leave --report out, which measures")
    if parsed.report:
        report = json.loads(parsed.json.read_text(encoding="utf-8"))
    else:
        sizes = QUICK if parsed.quick else Sizes()
        try:
            with errors_in_one_line():
                report = measure(parsed.overrides, sizes, folder.resolve(), parsed.quick)
        except KeyboardInterrupt:
            return EXIT_INTERRUPTED
        keep_numbers(report, parsed.json)
        with whole_file(watched_figure(parsed.figure)) as temporary:
            shutil.copy(drawn(report["sections"]["watched"], folder), temporary)
    print(report_text(report))
    figure(report, parsed.figure)
    with whole_file(parsed.page) as temporary:
        temporary.write_text(page(report, parsed.figure, parsed.page), encoding="utf-8")
    print(f"page in {parsed.page}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
