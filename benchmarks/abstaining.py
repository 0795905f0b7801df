"""What abstaining buys: ``python -m benchmarks.abstaining``.

Machines of the simulated hand on several choices of held-out materials. Thresholds of abstention
are set on held-out scores of their training bins for several coverages: with recordings as units
(ours), with bins as units, and by a threshold of the probability.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any, ClassVar

import torch
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import SEEN_ROLE, FittedMachine, small_crossval
from benchmarks.tables import Report, Table, by, percent
from tactslip_torch.commands.crossval import read_materials
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.model.calibration import ABSTAIN, NON_SLIP, SLIP, Abstention, fit_platt
from tactslip_torch.model.fit import HeldOut
from tactslip_torch.report.metrics import CLASSES, answer_counts, answer_metrics
from tactslip_torch.simulation import SEEN_MATERIALS

MEASURES = {
    "covered": "coverage %",
    "abstained": "abstained %",
    "right": "balanced accuracy of the others %",
}


@dataclass(frozen=True)
class Abstaining(Benchmark):
    """Ways to abstain.

    Args:
        overrides: of the configuration of ``crossval``: materials and cycles.
        num_held_out: materials left out of a split.
        splits: how many choices of them, the paper's first.
        train_bins: of each seen material and class to fit and calibrate on.
        scored_bins: of each material and class, at most, to evaluate on.
        num_features: K.
        penalties: to choose C from.
        coverages: that are asked for.
    """

    title = "Abstaining"
    about = (
        "bins of recordings whose truth is in the answer, and bins without an answer, by how the "
        "thresholds of abstention were set"
    )
    quick = (
        'overrides=[num_workers=0,data.cycles=3,"data.materials=[M1,M4,iron]"] num_held_out=1 '
        "splits=1 train_bins=30 scored_bins=40 num_features=20 penalties=[0.001] "
        "coverages=[0.5,0.8]"
    )
    charts: ClassVar = {
        "": [(f"{role}: {of}", "coverage %", "asked %") for role, of in SEEN_ROLE.items()]
    }
    overrides: tuple[str, ...] = ()
    num_held_out: int = 4
    splits: int = 8
    train_bins: int = 200
    scored_bins: int = 600
    num_features: int = 60
    penalties: tuple[float, ...] = (1e-4, 1e-3, 1e-2)
    coverages: tuple[float, ...] = (0.8, 0.9, 0.95, 0.97, 0.99)

    def measure(self, job: Job) -> dict[str, Any]:
        """A row for each split, way, coverage and role."""
        given = [f"scored_bins={self.scored_bins}", f"cache={job.folder / 'cache'}"]
        given += [f"recipes.robust.penalties={list(self.penalties)}"]
        given += [*self.overrides, *job.overrides]
        config, recipe = small_crossval(given, self.train_bins, self.num_features)
        source = instantiate(config.data, _convert_="all")
        names = sorted({recording.material for recording in source.ids})
        materials = read_materials(config, source, names, [recipe])
        rows = []
        for held_out in _choices(names, self):
            say(f"abstaining: without {', '.join(held_out)}")
            seen = [name for name in names if name not in held_out]
            machine = FittedMachine.of(materials.statistics_of(seen), recipe)
            evaluated = {
                "test": materials.bins_of(seen, ("test",)),
                "unseen": materials.bins_of(held_out, ("train", "test")),
            }
            scores = {role: machine.scores(of.features) for role, of in evaluated.items()}
            for way, coverage, low, high in _thresholds(machine, self.coverages):
                for role, of in evaluated.items():
                    row = {"way": way, "asked": coverage, "role": role, "held_out": held_out}
                    rows.append(row | _evaluated(of, scores[role], low, high, coverage))
        return {"rows": rows}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Means over splits by role."""
        num = len({tuple(row["held_out"]) for row in numbers["rows"]})
        found: dict[str, list[dict[str, object]]] = {}
        for (role, way, asked), of in by(numbers["rows"], "role", "way", "asked").items():
            row: dict[str, object] = {"thresholds by": way, "asked %": f"{100 * asked:g}"}
            row |= {title: percent(mean(one[n] for one in of)) for n, title in MEASURES.items()}
            row["least coverage %"] = percent(min(one["covered"] for one in of))
            found.setdefault(f"{role}: {SEEN_ROLE[role]}", []).append(row)
        note = f"Means over {num} choices of held-out materials."
        return {title: Table(rows, note) for title, rows in found.items()}


def _choices(names: Sequence[str], sizes: Abstaining) -> list[tuple[str, ...]]:
    """The paper's held-out materials where they are as many, then others by a seed."""
    every = list(itertools.combinations(sorted(names), sizes.num_held_out))
    papers = tuple(sorted(set(names) - set(SEEN_MATERIALS)))
    first = [papers] if papers in every else []
    others = [choice for choice in every if choice not in first]
    return [*first, *random.Random(0).sample(others, len(others))][: sizes.splits]


def _thresholds(
    machine: FittedMachine, coverages: Sequence[float]
) -> Iterator[tuple[str, float, float, float]]:
    """Way, coverage, and the scores below and above which a bin has an answer."""
    sample = machine.statistics.sample.bins()
    every = torch.arange(len(sample.is_slip))
    bins = machine.plan.training_bins(sample)

    def without(groups: Tensor) -> Tensor:
        return HeldOut(bins, groups, machine.plan.kernel).at(machine.plan.penalty).scores

    by_bin, by_recording, by_material = map(without, (every, sample.recording, sample.group))
    platt = fit_platt(by_material, sample.is_slip, machine.weights)
    for coverage in coverages:
        for way, scores, unit in (
            ("recordings as units, ours", by_recording, sample.recording),
            ("the same, material left out", by_material, sample.recording),
            ("bins as units", by_bin, every),
        ):
            try:
                found = Abstention.fit(scores, sample.is_slip, unit, coverage)
                yield way, coverage, found.low, found.high
            except ValueError:  # too few recordings for any answer
                yield way, coverage, -math.inf, math.inf
        reach = math.log(coverage / (1 - coverage))
        low, high = -math.inf, math.inf
        if platt.slope:
            low, high = ((side * reach - platt.offset) / platt.slope for side in (-1, 1))
        yield "probability threshold", coverage, low, high
        yield "never abstaining", coverage, 0.0, 0.0


def _evaluated(
    bins: SampledBins, score: Tensor, low: float, high: float, coverage: float
) -> dict[str, Any]:
    given = torch.full_like(score, ABSTAIN, dtype=torch.int8)
    given = given.masked_fill(score < low, NON_SLIP).masked_fill(score >= high, SLIP)
    counts = {
        str(name): answer_counts(bins.is_slip[mine], given[mine])
        for name in bins.recording.unique().tolist()
        for mine in [bins.recording == name]
    }
    found = answer_metrics(counts, coverage)
    return {
        "covered": mean(found[name]["coverage"] or 0.0 for name in CLASSES),
        "abstained": found["abstained"],
        "right": found["decided_balanced"] or 0.0,
    }


if __name__ == "__main__":
    raise SystemExit(Abstaining().run())
