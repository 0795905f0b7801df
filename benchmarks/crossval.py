"""Recipes on every choice of held-out materials: ``python -m benchmarks.crossval [key=value ...]``.

The paper evaluates one choice of four held-out materials; out of ten there are 210. For each, and
for each recipe, features are ranked and scaled, K and C chosen, and a machine fitted on the other
materials alone. Fits take a bounded sample of bins of each material and class, weighted by how many
they represent. Arguments are those of ``tactslip train``.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import mean, median, stdev
from typing import Any, ClassVar

import torch
from hydra.utils import instantiate

from benchmarks.harness import Benchmark, Job
from benchmarks.tables import ROLES, Report, Table, percent
from benchmarks.trainings import composed, resumed
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import seen6
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.report.metrics import balanced_accuracy
from tactslip_torch.runtime import in_processes
from tactslip_torch.training.bins import BinSample, RecordingBins, SampledBins
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker
from tactslip_torch.training.recipe import Recipe

PAPERS_UNSEEN = frozenset({"iron", "cloth", "copper", "wood"})
GIVEN = {"general": ("recipe.views=[pooled]",)}
"""What the whole choice of a recipe takes on this set; all of it takes longer."""


@dataclass(frozen=True)
class Materials:
    """What one pass over all recordings keeps of each material.

    Args:
        pool: the features.
        training: by material a sample of the bins of training cycles.
        scored: by material and role, ``"train"`` or ``"test"``, a sample to evaluate on.
    """

    pool: FeaturePool
    training: dict[str, RecordingBins]
    scored: dict[tuple[str, str], SampledBins]


def read_materials(
    maker: FeatureMaker,
    names: Sequence[str],
    train_bins: int,
    scored: int,
    *,
    seed: int = 0,
    num_workers: int | None = None,
) -> Materials:
    """One pass over all recordings, split by cycle.

    Args:
        maker: of the features of their source.
        names: of the materials.
        train_bins: bins of each material and class to fit on.
        scored: and to evaluate on.
        seed: of the split.
        num_workers: processes that make features.
    """
    by_cycle = seen6(maker.source.ids, seen=list(names), seed=seed)[0]
    fitted = {name: BinSample(train_bins) for name in names}
    drawn = {(name, role): BinSample(scored) for name in names for role in ("train", "test")}
    data = SlipDataModule(maker, [by_cycle], num_workers)
    data.setup()
    for made in data.features("train", "test"):
        material, role = made.recording.material, by_cycle.roles[made.recording]
        bins = RecordingBins(str(made.recording), material, made.features, made.is_slip)
        drawn[material, role].update(bins)
        if role == "train":
            fitted[material].update(bins)
    training = {}
    for name, sample in fitted.items():
        own = sample.bins()
        training[name] = RecordingBins(name, name, own.features, own.is_slip)
    return Materials(maker.pool, training, {key: of.bins() for key, of in drawn.items()})


def evaluate_split(materials: Materials, recipe: Recipe, unseen: Sequence[str]) -> dict[str, Any]:
    """Fit on all materials but the unseen ones, and evaluate.

    Returns:
        ``unseen``, ``test`` (balanced accuracies), ``per_material`` (of the unseen ones),
        ``num_features``, ``penalty``, and ``materials``, the unseen ones.
    """
    seen = sorted(set(materials.training) - set(unseen))
    bins = [materials.training[name] for name in seen]
    fit = recipe.fit(bins, materials.pool)

    def score(names: Sequence[str], roles: Sequence[str]) -> tuple[float | None, dict[str, Any]]:
        decided: list[tuple[torch.Tensor, ...]] = []
        for name in names:
            some = [materials.scored[name, role] for role in roles]
            says_slip = torch.cat([fit.head(fit.selection(of.features)) >= 0 for of in some])
            truth, weights = ([getattr(of, n) for of in some] for n in ("is_slip", "weight"))
            decided.append((says_slip, torch.cat(truth), torch.cat(weights)))
        by_material = {n: balanced_accuracy(*own) for n, own in zip(names, decided, strict=True)}
        return balanced_accuracy(*map(torch.cat, zip(*decided, strict=True))), by_material

    of_unseen, by_material = score(unseen, ("train", "test"))
    return {
        "materials": list(unseen),
        "unseen": of_unseen,
        "test": score(seen, ("test",))[0],
        "per_material": by_material,
        "num_features": fit.selection.size,
        "penalty": fit.penalty,
    }


@dataclass(frozen=True)
class Crossval(Benchmark):
    """Every choice of ``num_unseen`` held-out materials, with each recipe and seed."""

    title = "Every choice of held-out materials"
    about = "balanced accuracy, %, on every choice of held-out materials"
    page, has_headings = "docs/recipes.md", False
    quick = (
        "num_unseen=1 train_bins=20 scored_bins=20 recipes=[paper] seeds=[0,1] "
        'given=[data.cycles=4,"data.materials=[M1,M2,iron]",recipe.num_features=10,'
        '"recipe.penalties=[0.001]"]'
    )
    charts: ClassVar = {
        "": [
            ("By choice, seed 0", ("mean", "lowest")),
            ("By material, seed 0", ("paper mean", "general mean")),
        ]
    }
    given: tuple[str, ...] = ()
    recipes: tuple[str, ...] = ("paper", "general")
    seeds: tuple[int, ...] = (0, 4)
    num_unseen: int = 4
    train_bins: int = 100
    scored_bins: int = 2000

    def measure(self, job: Job) -> dict[str, Any]:
        """The scores of every choice with each recipe and seed."""
        runs = []
        for seed in self.seeds:
            overrides = [*self.given, *job.overrides, f"seed={seed}"]
            place = job.folder / f"seed-{seed}.json"
            sizes = f"{self.num_unseen} {self.train_bins} {self.scored_bins} {self.recipes}"
            kept = resumed(place, [*overrides, sizes], partial(self.one, overrides))
            runs.append(kept | {"seed": seed})
        return {"runs": runs, "simulated": runs[0]["simulated"]}

    def one(self, overrides: Sequence[str]) -> dict[str, Any]:
        """The scores of every choice with each recipe."""
        recipes: dict[str, Recipe] = {}
        for name in self.recipes:
            config = composed("train", [f"recipe={name}", *GIVEN.get(name, ()), *overrides])
            made: Recipe = instantiate(config.recipe, _convert_="all")
            recipes[name] = replace(made, sample_bins=self.train_bins)
        source: RecordingSource = instantiate(config.data, _convert_="all")
        names = sorted({recording.material for recording in source.ids})
        maker = feature_maker(source, instantiate(config.labels), **config.features)
        sizes = self.train_bins, self.scored_bins
        with feature_cache(config.cache) as maker.cache:
            materials = read_materials(
                maker, names, *sizes, seed=config.seed, num_workers=config.num_workers
            )

        def work(job: tuple[str, Sequence[str]]) -> dict[str, Any]:
            return evaluate_split(materials, recipes[job[0]], job[1])

        choices = itertools.combinations(names, self.num_unseen)
        jobs = list(itertools.product(recipes, choices))
        results = list(in_processes(work, jobs, "splits", "split", config.num_workers))
        splits: dict[str, list[Any]] = {name: [] for name in recipes}
        for (name, _), result in zip(jobs, results, strict=True):
            splits[name].append(result)
        kept = {"simulated": source.is_simulated, "materials": names, "splits": splits}
        return kept | {"num_unseen": self.num_unseen, "train_bins": self.train_bins}

    def tables(self, numbers: Report) -> dict[str, Table]:
        """By choice and by material with each seed, and the worst of both where seeds are many."""
        runs, found = numbers["runs"], {}
        for run in runs:
            seed = f", seed {run['seed']}" if len(runs) > 1 else ""
            note = (
                f"Seed {run['seed']}. The machines are fitted on {run['train_bins']} bins of each "
                "material and class."
            )
            found[f"By choice{seed}"] = Table(split_rows(run), note)
            found[f"By material{seed}"] = Table(material_rows(run), f"Seed {run['seed']}.")
        if len(runs) > 1:
            found["By seed"] = Table([row for run in runs for row in _worst_rows(run)])
        return found


def split_rows(run: Report) -> list[dict[str, object]]:
    """One row for each recipe and role: the distribution of the scores of all choices."""
    rows: list[dict[str, object]] = []
    for name, splits in run["splits"].items():
        for role in ("test", "unseen"):
            scores = sorted(split[role] for split in splits if split[role] is not None) or [0.0]
            papers = [s[role] for s in splits if frozenset(s["materials"]) == PAPERS_UNSEEN]
            numbers = {
                "mean": mean(scores),
                "sd": _spread(scores),
                "lowest": scores[0],
                "5 % quantile": scores[int(0.05 * len(scores))],
                "median": median(scores),
                "highest": scores[-1],
                "the paper's four": papers[0] if papers else None,
            }
            row = {title: percent(value) for title, value in numbers.items()}
            rows.append(
                {"balanced accuracy, %": f"{name}, {ROLES[role]}", **row, "choices": len(scores)}
            )
    return rows


def material_rows(run: Report) -> list[dict[str, object]]:
    """One row for each material: its scores in the choices where it is unseen."""
    rows: list[dict[str, object]] = []
    for material in run["materials"]:
        row: dict[str, object] = {"held-out material, %": material}
        for name, splits in run["splits"].items():
            found = [split["per_material"].get(material) for split in splits]
            scores = [score for score in found if score is not None]
            row[f"{name} mean"] = percent(mean(scores) if scores else None)
            row[f"{name} sd"] = percent(_spread(scores))
        rows.append(row)
    return rows


def _worst_rows(run: Report) -> list[dict[str, object]]:
    """Mean over choices, the worst choice and the worst single material, of each recipe."""
    rows: list[dict[str, object]] = []
    for recipe, splits in run["splits"].items():
        known = [split for split in splits if split["unseen"] is not None]
        if not known:
            continue
        worst = min(known, key=lambda split: float(split["unseen"]))
        material, score, beside = min(
            (
                (material, score, split["materials"])
                for split in known
                for material, score in split["per_material"].items()
                if score is not None
            ),
            key=lambda of: float(of[1]),
        )
        rows.append(
            {
                "held-out materials": f"{recipe}, seed {run['seed']}",
                "mean %": percent(mean(split["unseen"] for split in known)),
                "lowest choice %": percent(worst["unseen"]),
                "its materials": ", ".join(worst["materials"]),
                "lowest single material %": percent(score),
                "that material, of its choice": f"{material}, of {', '.join(beside)}",
            }
        )
    return rows


def _spread(scores: Sequence[float]) -> float:
    return stdev(scores) if len(scores) > 1 else 0.0


if __name__ == "__main__":
    raise SystemExit(Crossval().run())
