"""Published numbers beside ours: ``python -m benchmarks.reproduction [--seeds 5] [--quick]``.

Trains every experiment on every seed. Runs in ``--runs`` that this very code, configuration and
calibration finished are kept, so it resumes; seeds come one after the other, and experiments that
share features stand together, so that most are made once. Keeps ``benchmarks/results/
reproduction.json`` and draws the figures beside it, writes ``REPRODUCTION.md`` and the table
between the markers in ``README.md``. ``--report`` does the latter from what is kept. With
``--quick``, or with a part of the experiments, all of it but README.md goes to a folder in
``outputs``, and no tracked file is touched.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks.machine import machine_facts
from benchmarks.outcome import EXIT_INTERRUPTED, RESULTS, ROOT, between_markers
from benchmarks.reproduction.experiments import EXPERIMENTS, SEEDS, overrides_of
from benchmarks.reproduction.figure import confound_figure, places_figure, seeds_figure
from benchmarks.reproduction.page import (
    COMMAND,
    FIGURES,
    KEPT_NAME,
    is_part,
    page,
    short_table,
)
from benchmarks.reproduction.results import Report, runs_of
from benchmarks.reproduction.runs import kept, run
from tactslip_torch.analysis.signal_checks import filtered, judge_facts
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.report.figures import pipeline_figure
from tactslip_torch.runtime import whole_file
from tactslip_torch.simulation.parameters import CALIBRATED_PATH, SEEN_MATERIALS
from tactslip_torch.simulation.source import SimulatedRecordings

KEPT = RESULTS / KEPT_NAME
OUTPUTS = ROOT / "outputs"


class Place(NamedTuple):
    """Where results go.

    Attributes:
        folder: of the JSON and the figures.
        page: REPRODUCTION.md.
        readme: whose block is replaced, or none.
    """

    folder: Path
    page: Path
    readme: Path | None

    @classmethod
    def of(cls, quick: bool, names: Collection[str]) -> Place:
        """The tracked files for all experiments in earnest, else a folder of its own."""
        if not quick and not is_part(names):
            return cls(RESULTS, ROOT / "REPRODUCTION.md", ROOT / "README.md")
        folder = OUTPUTS / ("reproduction-quick" if quick else "reproduction-part")
        return cls(folder, folder / "REPRODUCTION.md", None)


def measure(
    seeds: int, names: Sequence[str], folder: Path, quick: bool, all_seeds: bool = False
) -> dict[str, Any]:
    """The report: every experiment on every seed, JSON-able.

    Args:
        seeds: how many, from 0.
        names: of the experiments.
        folder: of runs and of the cache of features.
        quick: whether few recordings are enough.
        all_seeds: for every experiment, also for those that take fewer.

    Raises:
        RuntimeError: if a training fails.
    """
    machine = machine_facts()
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    versions: dict[str, str] = {}
    started = time.perf_counter()
    for seed in range(seeds):
        for name in names:
            if seed >= EXPERIMENTS[name].num_seeds(seeds) and not all_seeds:
                continue
            overrides = [*overrides_of(name, quick), f"seed={seed}"]
            place = folder / f"{name.replace(' ', '-')}-{seed}"
            metrics = run(f"{name}, seed {seed}", overrides, place, folder / "cache")
            runs[name].append(kept(metrics, place))
            versions = {of: metrics["versions"][of] for of in ("tactslip_torch", "torch")}
        minutes = (time.perf_counter() - started) / 60
        print(f"seed {seed} of {seeds}: {minutes:.1f} min so far", file=sys.stderr, flush=True)
    return {
        "simulated": True,
        "quick": quick,
        "seeds": seeds,
        "machine": machine,
        "versions": versions,
        "commands": {name: overrides_of(name, quick) for name in names},
        "calibrated": json.loads(CALIBRATED_PATH.read_text(encoding="utf-8")),
        "signals": [signals(seed, 1 if quick else 3) for seed in range(seeds)],
        "runs": runs,
    }


def signals(seed: int, cycles: int) -> list[dict[str, Any]]:
    """What the paper says of its signals, judged on recordings of seen materials of a seed."""
    source = SimulatedRecordings(seed=seed, cycles=cycles, materials=list(SEEN_MATERIALS))
    recordings = {
        material: [
            filtered(source.load(RecordingId(material, cycle)), source.hand)
            for cycle in range(cycles)
        ]
        for material in SEEN_MATERIALS
    }
    return judge_facts(recordings)


def write(report: Report, place: Place) -> None:
    """Figures, REPRODUCTION.md and perhaps the block in README.md, of what is kept."""
    if runs_of(report, "unseen4"):
        places_figure(report, place.folder / FIGURES["places"])
    if runs_of(report, "confound"):
        confound_figure(report, place.folder / FIGURES["confound"])
    seeds_figure(report, place.folder / FIGURES["seeds"])
    pipeline_figure(place.folder / "pipeline.png")
    texts = {place.page: page(report, place.folder.relative_to(place.page.parent).as_posix())}
    if place.readme is not None:
        before = place.readme.read_text(encoding="utf-8")
        texts[place.readme] = between_markers(before, "reproduction", short_table(report))
    for path, content in texts.items():
        with whole_file(path) as temporary:
            temporary.write_text(content, encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    parser = argparse.ArgumentParser(
        prog=COMMAND, description="Train the published experiments and write REPRODUCTION.md."
    )
    parser.add_argument(
        "--seeds", type=int, default=SEEDS, metavar="N", help="how many (%(default)s)"
    )
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="of runs and cached features")
    parser.add_argument("--experiments", nargs="+", default=list(EXPERIMENTS), choices=EXPERIMENTS)
    parser.add_argument("--quick", action="store_true", help="few recordings, to see that it runs")
    parser.add_argument("--all-seeds", action="store_true", help="for every experiment")
    parser.add_argument("--report", action="store_true", help="write from what is kept, train none")
    parsed = parser.parse_args(arguments)
    if parsed.seeds < 1:
        parser.error(f"--seeds must be at least 1, got {parsed.seeds}")
    names = [name for name in EXPERIMENTS if name in parsed.experiments]
    place = Place.of(parsed.quick, names)
    path = place.folder / KEPT_NAME
    if parsed.report and not path.exists():
        parser.error(f"--report needs {path}; leave --report out, which trains and writes it")
    if not parsed.report:
        torch.set_num_threads(1)  # trainings use the processors
        folder = parsed.runs or OUTPUTS / f"reproduction{'-quick' * parsed.quick}"
        try:
            report = measure(parsed.seeds, names, folder.resolve(), parsed.quick, parsed.all_seeds)
        except RuntimeError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            return EXIT_INTERRUPTED
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as temporary:
            temporary.write_text(json.dumps(report, allow_nan=False) + "\n", encoding="utf-8")
    write(json.loads(path.read_text(encoding="utf-8")), place)
    print(f"{place.page} from {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
