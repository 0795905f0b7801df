"""Published numbers beside ours: ``python -m benchmarks.reproduction [key=value ...]``.

Trains every experiment on every seed. Runs that this very code finished are kept, so it resumes.
Writes the tables of REPRODUCTION.md and of README.md between their markers, and the figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from matplotlib.figure import Figure
from omegaconf import OmegaConf

from benchmarks import ROOT
from benchmarks.harness import (
    GREY,
    LIGHT,
    OURS,
    PEER,
    Benchmark,
    Job,
    Report,
    Table,
    between_markers,
    finish,
    write_text,
)
from benchmarks.reproduction.page import (
    FOLDS,
    all_tables,
    scene_recalls,
    scenes_of,
    short_table,
)
from benchmarks.reproduction.results import POOLED, percent, recall_beside_onset, roles_of
from benchmarks.reproduction.runs import kept, run
from tactslip_torch.analysis.signal_checks import filtered, judge_facts
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.report import published
from tactslip_torch.report.pipeline import pipeline_figure
from tactslip_torch.simulation.parameters import CALIBRATED_PATH, SEEN_MATERIALS
from tactslip_torch.simulation.source import SimulatedRecordings

_PAPER = "recipe=paper"
EXPERIMENTS: Mapping[str, tuple[tuple[str, ...], int]] = {
    # these use the features of one set of recordings ...
    "unseen4": (("+exp=unseen4", _PAPER), 5),
    "unseen4 robust": (("+exp=unseen4", "recipe=robust"), 5),
    "random_bins": (("+exp=random_bins", _PAPER), 5),
    "shuffled": (("+exp=seen6", _PAPER, "labels.shuffle_seed=1"), 1),
    "SG means only": (
        ("+exp=unseen4", _PAPER, "recipe.among={kind:SG,descriptor:mean}"),
        3,
    ),
    "PVDF only": (("+exp=unseen4", _PAPER, "recipe.among={kind:PVDF}"), 2),
    # ... these of another ...
    "half_second": (("+exp=unseen4", _PAPER, "labels=half_second"), 5),
    "half_second random_bins": (("+exp=random_bins", _PAPER, "labels=half_second"), 5),
    # ... and each of these its own
    "motor_off": (("+exp=unseen4", _PAPER, "scene=motor_off"), 2),
    "motor_only": (("+exp=unseen4", _PAPER, "scene=motor_only"), 2),
    "confound": (("+exp=confound",), 2),
}
"""Overrides and seeds of each, in the order that shares most features."""


@dataclass(frozen=True)
class Sizes:
    """Seeds at most, experiments, and overrides of every run."""

    seeds: int = 5
    experiments: tuple[str, ...] = tuple(EXPERIMENTS)
    overrides: tuple[str, ...] = ()
    cycles: int = 3


class Reproduction(Benchmark[Sizes]):
    """Every experiment on every seed."""

    name = "reproduction"
    title = "Published numbers beside ours"
    about = "every number of ours is SIMULATED, the paper's are of a real hand"
    page, markers = "REPRODUCTION.md", "results"
    sizes = Sizes()
    quick = Sizes(
        1,
        ("random_bins", "unseen4", "confound"),
        ("data.cycles=2", "split.train_share=0.5", "recipe.sample_bins=60"),
        1,
    )

    def measure(self, job: Job[Sizes]) -> dict[str, Any]:
        """Trainings, one after the other, and checks of the signals."""
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in job.sizes.experiments}
        commands = {}
        for seed in range(job.sizes.seeds):
            for name in runs:
                overrides, seeds = EXPERIMENTS[name]
                given = [*overrides, *job.sizes.overrides, *job.overrides]
                if job.is_quick and name == "confound":
                    others = OmegaConf.load(ROOT / "conf" / "others" / "confound.yaml")
                    given += [f"others.{o}.cycles=2" for o in map(str, others) if o != "defaults"]
                commands[name] = " ".join(given)
                if seed < seeds:
                    folder = job.folder / f"{name.replace(' ', '-')}-{seed}"
                    cache = job.folder / "cache"
                    metrics = run(f"{name}, seed {seed}", [*given, f"seed={seed}"], folder, cache)
                    runs[name].append(kept(metrics, folder))
        return {
            "runs": runs,
            "commands": commands,
            "calibrated": json.loads(CALIBRATED_PATH.read_text(encoding="utf-8")),
            "signals": [_signals(seed, job.sizes.cycles) for seed in range(job.sizes.seeds)],
        }

    def tables(self, numbers: Report) -> dict[str, Table]:
        """All of REPRODUCTION.md, and what was run."""
        rows = [
            [
                name,
                f"`train {numbers['commands'][name]}`",
                str(len(of)),
                f"{sum(run['seconds'] for run in of) / 60:.1f}",
            ]
            for name, of in numbers["runs"].items()
        ]
        ran = Table(["experiment", "command", "seeds", "minutes"], rows)
        return {**all_tables(numbers), "What was run": ran}

    def publish(self, report: Report, folder: Path) -> None:
        """The page, and the table between the markers of README.md."""
        super().publish(report, folder)
        if not report["quick"]:
            path, table = ROOT / "README.md", short_table(report["numbers"]["runs"]).markdown()
            text = path.read_text(encoding="utf-8")
            write_text(path, between_markers(text, "reproduction", table))

    def draw(self, numbers: Report, drawing: Figure) -> None:
        """Balanced accuracy of every seed, the paper's as a bar."""
        runs, axes = numbers["runs"], drawing.subplots()
        names = [(name, role) for name in runs for role in roles_of(runs, name)]
        beside = {("random_bins", "test"), ("unseen4", "unseen")}
        for place, (name, role) in enumerate(names):
            for baseline, marker, color in ((POOLED, "|", PEER), (None, "o", OURS)):
                values = percent(runs, name, role, "balanced_accuracy", baseline=baseline)
                axes.plot(values, [place] * len(values), marker, color=color, alpha=0.7, ms=5)
            if (name, role) in beside:
                x = 100 * (published.SPLITS[role].balanced_accuracy or 0)
                axes.plot([x, x], [place - 0.4, place + 0.4], color="black", lw=2)
        for marker, color, label in (
            ("o", OURS, "ours, a dot a seed"),
            ("|", PEER, "best pooled number"),
        ):
            axes.plot([], [], marker, color=color, label=label)
        axes.plot([], [], color="black", lw=2, label="paper, real hand")
        axes.set_yticks(range(len(names)), [", ".join(of) for of in names], fontsize=6)
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlabel("balanced accuracy, %")
        axes.grid(axis="x", color=LIGHT)
        drawing.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)

    def figures(self, report: Report, path: Path) -> None:
        """Every seed, recall beside the onset, scenes, and the pipeline."""
        super().figures(report, path)
        runs = report["numbers"]["runs"]
        drawing = Figure(figsize=(8.4, 3.6), layout="constrained")
        axes = drawing.subplots()
        for name, color in (("unseen4", OURS), ("unseen4 robust", PEER)):
            for role, style in (("test", "o-"), ("unseen", "s--")):
                found = {
                    place: recall_beside_onset(
                        runs, name, role, [str(place) if place < 20 else "20+"]
                    )
                    for place in range(-20, 21)
                }
                means = {place: mean(values) for place, values in found.items() if values}
                label = f"{name}, {role}"
                axes.plot(list(means), list(means.values()), style, color=color, ms=3, label=label)
        axes.axvline(-0.5, color=GREY, ls="--", lw=1)
        axes.set_xlabel("bins of 50 ms beside the labelled onset: non-slip before 0, slip from 0")
        axes.set_ylabel("recall, %, mean of seeds")
        axes.legend(frameon=False, fontsize=8)
        finish(drawing, report, "Recall beside the onset", path.with_stem(f"{path.stem}_places"))
        if "confound" in runs:
            drawing = Figure(figsize=(9.2, 4.4), layout="constrained")
            panels, scenes = drawing.subplots(1, 2, sharey=True), scenes_of(runs)
            for axes, role in zip(panels, ("test", "unseen"), strict=True):
                for fold, color in zip(FOLDS, (PEER, OURS), strict=True):
                    for place, scene in enumerate(scenes):
                        values = list(scene_recalls(runs, fold, role, scene).values())
                        words = f"trained on {FOLDS[fold]}" if place == 0 else None
                        axes.plot(values, [place] * len(values), "o", color=color, label=words)
                axes.set_xlabel(f"mean recall of the classes there are, %, {role}")
                axes.grid(axis="x", color=LIGHT)
            panels[0].set_yticks(range(len(scenes)), scenes, fontsize=8)
            panels[0].legend(frameon=False, fontsize=8)
            finish(drawing, report, "Slip or the arm", path.with_stem(f"{path.stem}_confound"))
        pipeline_figure(path.with_name("pipeline.png"))


def _signals(seed: int, cycles: int) -> list[dict[str, Any]]:
    """What the paper says of its signals, checked on recordings of seen materials of a seed."""
    source = SimulatedRecordings(seed=seed, cycles=cycles, materials=list(SEEN_MATERIALS))
    recordings = {
        material: [
            filtered(source.load(RecordingId(material, cycle)), source.hand)
            for cycle in range(cycles)
        ]
        for material in SEEN_MATERIALS
    }
    return judge_facts(recordings)


if __name__ == "__main__":
    raise SystemExit(Reproduction().run())
