"""A new material from a few recordings: ``python -m benchmarks.adapting``.

Held-out materials are brought to a trained detector, recording by recording. Ways: ``auto`` (the
weight that old materials allow), ``slip-free`` (the same, of bins without slip alone), ``weight 1``
(what fitting again on everything gives, features and scaling kept), ``threshold`` (the machine
stays, its threshold moves) and ``ceiling`` (trained on the whole training part of the new material
too, features ranked and scaled anew).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from statistics import mean, median
from typing import Any, ClassVar

import torch
from torch import Tensor

from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import FittedMachine, Trained
from benchmarks.tables import Report, Table, by, limits, percent
from benchmarks.timing import timed
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.features.statistics import TrainingStatistics
from tactslip_torch.model.kernels import Head
from tactslip_torch.training.adaptation import (
    FACTORS,
    RecordingBins,
    Solved,
    Statistics,
    add,
    mean_recall,
    recording_bins,
    solve,
    statistics_of,
)
from tactslip_torch.training.recipe import best_threshold

AUTO, SLIP_FREE, ONE, SHIFT, CEILING = "auto", "slip-free", "weight 1", "threshold", "ceiling"
BinsByName = dict[str, RecordingBins]


@dataclass(frozen=True, eq=False)
class _Subject:
    """The trained detector, its statistics, and the bins of every recording by name."""

    trained: Trained
    statistics: Statistics
    before: Solved
    bins: BinsByName

    def of(self, recordings: Sequence[RecordingId]) -> BinsByName:
        return {str(one): self.bins[str(one)] for one in recordings}


_TITLES = {"new": "New material", "old": "Old materials' test recordings"}


@dataclass(frozen=True)
class Adapting(Benchmark):
    """New materials by count, way and draw.

    Args:
        training: overrides of ``tactslip_torch.train``; its held-out materials are the new ones.
        counts: recordings that are added.
        draws: of which recordings.
        train_fraction: of a new material's recordings, from which they are drawn; everything is
            evaluated on the others.
        limited: the count that limits are on.
        margin: that old materials may lose on average.
    """

    title = "A new material from a few recordings"
    about = "balanced accuracy on a new material and on the old ones, by recordings that are added"
    quick = (
        "training=[+exp=quick,recipe=robust,data.cycles=4,recipe.num_features=10,num_workers=0,"
        '"recipe.penalties=[0.0003]",split.train_fraction=0.75,baselines=false] counts=[1,2] '
        "draws=1 train_fraction=0.6 limited=2"
    )
    charts: ClassVar = {"": [(title, "mean", "recordings") for title in _TITLES.values()]}
    training: tuple[str, ...] = ("+exp=unseen4", "recipe=robust")
    counts: tuple[int, ...] = (1, 2, 5, 10)
    draws: int = 3
    train_fraction: float = 0.8
    limited: int = 5
    margin: float = 0.005

    def measure(self, job: Job) -> dict[str, Any]:
        """Every new material, way, count and draw; weights on training materials; one step."""
        overrides = [*self.training, *job.overrides, "statistics=true"]
        trained = Trained.by(overrides, job.folder, job.folder / "cache")
        statistics = statistics_of(job.folder / "detector.pt", trained.detector)
        bins = recording_bins(trained.detector, trained.maker, statistics, is_new=False)
        subject = _Subject(trained, statistics, solve(statistics), bins)
        old = [subject.of(trained.recordings("test", m)) for m in trained.materials("test")]
        rows: list[dict[str, Any]] = []
        for material in trained.materials("unseen"):
            say(f"adapting: {material} is new")
            order = _drawn(trained.recordings("unseen", material), 1000)
            num = round(self.train_fraction * len(order))
            pool, new = order[:num], subject.of(order[num:])
            row = {"material": material, "way": "before", "count": 0}
            rows.append(row | _scores(subject.before.head, new, old))
            ways, draws = (AUTO, ONE, SHIFT, SLIP_FREE), range(self.draws)
            for way, count, draw in product(ways, self.counts, draws):
                chosen = subject.of(_drawn(pool, draw)[:count])
                row = {"material": material, "way": way, "count": len(chosen)}
                rows.append(row | _adapted(subject, way, chosen, new, old, self))
            row = {"material": material, "way": CEILING, "count": len(pool)}
            rows.append(row | _ceiling(trained, pool, order[num:]))
        material = trained.materials("unseen")[0]
        some = subject.of(trained.recordings("unseen", material)[: self.limited])
        add_s, _ = timed(lambda: add(statistics, subject.before, some, None, 1.0))
        weights = list(_weights(subject, self))
        kept = {"add_s": add_s, "limited": self.limited, "margin": self.margin}
        return {"rows": rows, "weights": weights, **kept}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """Limits, new and old materials, and how the weight was chosen."""
        rows, found = numbers["rows"], {}
        for key, title in _TITLES.items():
            cells = []
            for (way, count), of in by(rows, "way", "count").items():
                row = {"way": way, "recordings": f"{count}"}
                for (material,), own in by(of, "material").items():
                    row[material] = _cell([one[key] for one in own])
                row["mean"] = percent(mean(one[key] for one in of))
                cells.append(row)
            note = "Balanced accuracy, %, median of draws (lowest to highest)."
            found[title] = Table(cells, note)
        weights = [
            {"weight of a new bin": f"{factor:g}"}
            | {f"{key} %": percent(mean(row[key] for row in these)) for key in ("new", "old")}
            for (factor,), these in by(numbers["weights"], "factor").items()
        ]
        note = "Where each training material in turn is new; means over them."
        before = mean(row["old"] for row in rows if row["way"] == "before")
        limited = mean(row["old"] for row in by(rows, "way", "count")[AUTO, numbers["limited"]])
        adding = f"old materials lose, points, auto, {numbers['limited']} recordings"
        solving = f"s to add {numbers['limited']} recordings whose features are there"
        goals = [
            (adding, 100 * (before - limited), 100 * numbers["margin"], ""),
            (solving, numbers["add_s"], 10.0, ""),
        ]
        about = {"How the weight was chosen": Table(weights, note)}
        return {"Limits": limits(goals), **found, **about}


def _cell(values: Sequence[float]) -> str:
    spread = f" ({percent(min(values))} to {percent(max(values))})" if len(values) > 1 else ""
    return percent(median(values)) + spread


def _drawn(recordings: Sequence[RecordingId], seed: int) -> list[RecordingId]:
    """The recordings in a random order."""
    generator = torch.Generator().manual_seed(seed)
    return [recordings[at] for at in torch.randperm(len(recordings), generator=generator).tolist()]


def _adapted(
    subject: _Subject,
    way: str,
    chosen: BinsByName,
    new: BinsByName,
    old: Sequence[BinsByName],
    sizes: Adapting,
) -> dict[str, float]:
    """Scores after these recordings are brought to the detector in one way."""
    head = subject.before.head
    if way == SHIFT:
        z, is_slip = _joined(chosen)
        best = best_threshold(head(z)[:, None], is_slip)
        return _scores(head, new, old, best.threshold if best.sign > 0 else 0.0)
    if way == ONE:
        after = subject.statistics.reweighed(dict.fromkeys(chosen, 1.0), chosen)
        machine = after.machine
        solved = after.sums.solve(machine.penalty, machine.offset, balance=machine.balance)
        return _scores(solved, new, old)
    if way == SLIP_FREE:
        chosen = {
            name: replace(own, z=own.z[~own.is_slip], is_slip=own.is_slip[~own.is_slip])
            for name, own in chosen.items()
        }
    change = add(subject.statistics, subject.before, chosen, None, sizes.margin)
    is_accepted = change.problem(sizes.margin) is None
    return _scores(change.solved.head if is_accepted else head, new, old)


def _ceiling(
    trained: Trained, added: Sequence[RecordingId], new: Sequence[RecordingId]
) -> dict[str, float]:
    """Trained on these recordings of the new material too: ranked, scaled and chosen anew."""
    statistics = TrainingStatistics(len(trained.maker.pool.names), trained.recipe.sample_bins)
    for recording in [*trained.recordings("train"), *added]:
        made = trained.maker(recording, trained.split)
        statistics.update(str(recording), recording.material, made.features, made.is_slip)
    num = len(trained.detector.selected)
    machine = FittedMachine.of(statistics, replace(trained.recipe, num_features=num))

    def score(recordings: Sequence[RecordingId]) -> float:
        made = [trained.maker(recording, trained.split) for recording in recordings]
        scores = torch.cat([machine.scores(one.features) for one in made])
        return mean_recall(scores >= 0, torch.cat([one.is_slip for one in made]))

    old = [score(trained.recordings("test", name)) for name in trained.materials("test")]
    return {"new": score(new), "old": mean(old)}


def _weights(subject: _Subject, sizes: Adapting) -> Iterator[dict[str, Any]]:
    """What weights do where each training material in turn is new: ``FACTORS`` rests on this.

    Features and scaling saw the material. No new material, and no test recording, is among it.
    """
    trained = subject.trained
    materials = trained.materials("train")
    total = sum(len(own.z) for own in subject.of(trained.recordings("train")).values())
    for material in materials:
        mine = subject.of(trained.recordings("train", material))
        order = _drawn(trained.recordings("train", material), 0)
        bins, others = subject.of(order[: sizes.limited]), subject.of(order[sizes.limited :])
        without = subject.statistics.reweighed(dict.fromkeys(mine, 0.0), mine)
        average = (total - sum(len(own.z) for own in mine.values())) / (len(materials) - 1)
        unit = average / sum(len(own.z) for own in bins.values())
        for factor in (0.0, *FACTORS):
            solved = solve(without.reweighed(dict.fromkeys(bins, factor * unit), bins))
            old = [
                mean_recall((solved.scores >= 0)[of], solved.known.is_slip[of])
                for place, name in enumerate(solved.known.material_names)
                if name != material and bool((of := solved.known.material == place).any())
            ]
            new = _score(solved.head, others or bins)
            yield {"material": material, "factor": factor, "new": new, "old": mean(old)}


def _joined(bins: BinsByName) -> tuple[Tensor, Tensor]:
    own = list(bins.values())
    return torch.cat([one.z for one in own]), torch.cat([one.is_slip for one in own])


def _score(head: Head, bins: BinsByName, threshold: float = 0.0) -> float:
    z, is_slip = _joined(bins)
    return mean_recall(head(z) >= threshold, is_slip)


def _scores(
    head: Head, new: BinsByName, old: Sequence[BinsByName], threshold: float = 0.0
) -> dict[str, float]:
    """Of the new material, and the mean over old ones."""
    olds = [_score(head, bins, threshold) for bins in old]
    return {"new": _score(head, new, threshold), "old": mean(olds)}


if __name__ == "__main__":
    raise SystemExit(Adapting().run())
