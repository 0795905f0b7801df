"""Every choice of unseen materials: ``python -m tactslip_torch crossval``.

The paper evaluates one choice of four unseen materials; out of ten there are 210. For each of them
and for each recipe, features are ranked and scaled, K and C chosen, and a machine fitted on the
other materials alone; then it is evaluated on the unseen ones and on held-out cycles of the seen
ones. Fits take a bounded sample of bins (``train_bins`` of each material and class), so that all
splits take minutes; sampled bins are weighted by how many they represent, so the balance of a
recipe enters as weights only. Validation groups are the materials. Leaves ``crossval.json``,
``crossval.png`` and the resolved configuration.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.analysis.old.bin_sample import BinSample, SampledBins
from tactslip_torch.analysis.old.plan import plan_detector
from tactslip_torch.analysis.old.recipe import Recipe, balanced_accuracy, of_recipe
from tactslip_torch.analysis.old.statistics import TrainingStatistics
from tactslip_torch.commands.entry import entry_point, leave_results, save_config
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import seen6
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.fit import fit_machine
from tactslip_torch.report.crossval import crossval_figure, crossval_table
from tactslip_torch.runtime import in_processes, one_thread
from tactslip_torch.training.datamodule import SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_maker


class Materials:
    """What one pass over all recordings keeps of each material.

    Args:
        pool: the features.
        train_bins: bins of each material and class to fit on.
        scored_bins: and to evaluate on.

    Attributes:
        training_statistics: of the training cycles, by material.
    """

    def __init__(self, pool: FeaturePool, train_bins: int, scored_bins: int) -> None:
        self.pool = pool
        self.training_statistics: dict[str, TrainingStatistics] = {}
        self._train_bins, self._scored_bins = train_bins, scored_bins
        self._samples: dict[tuple[str, str], BinSample] = {}  # by material and role

    def update(self, batch: Any, role: str) -> None:
        """Add a recording whose cycle is for ``"train"`` or for ``"test"``."""
        name, material = str(batch.recording), batch.recording.material
        if role == "train":
            statistics = self.training_statistics.setdefault(material, self._statistics())
            statistics.update(name, material, batch.features, batch.is_slip)
        sample = self._samples.setdefault((material, role), BinSample(self._scored_bins))
        sample.update(name, material, batch.features, batch.is_slip)

    def statistics_of(self, materials: Iterable[str]) -> TrainingStatistics:
        """One statistics of the training cycles of several materials."""
        merged = self._statistics()
        for material in sorted(materials):
            merged.merge(self.training_statistics[material])
        return merged

    def bins_of(self, materials: Iterable[str], roles: Sequence[str]) -> SampledBins:
        """The bins to evaluate on."""
        merged = BinSample(self._scored_bins)
        for key in itertools.product(sorted(materials), roles):
            if key in self._samples:
                merged.merge(self._samples[key])
        return merged.bins()

    def _statistics(self) -> TrainingStatistics:
        return TrainingStatistics(len(self.pool.names), self._train_bins)


def evaluate_split(materials: Materials, recipe: Recipe, unseen: Sequence[str]) -> dict[str, Any]:
    """Fit on all materials but the unseen ones, and evaluate.

    Returns:
        ``unseen``, ``test`` (balanced accuracies), ``per_material`` (of the unseen ones),
        ``num_features``, ``penalty``, and ``materials``, the unseen ones.
    """
    seen = sorted(set(materials.training_statistics) - set(unseen))
    statistics = materials.statistics_of(seen)
    plan = plan_detector(recipe, statistics, materials.pool, is_nested=False)
    training = plan.training_bins(statistics.sample.bins())
    head = fit_machine(training, plan.penalty, plan.kernel)

    def score(names: Sequence[str], roles: Sequence[str]) -> tuple[float | None, dict[str, Any]]:
        bins = materials.bins_of(names, roles)
        says_slip = head(plan.selection(bins.features)) >= 0
        by_material = {
            name: balanced_accuracy(says_slip[mine], bins.is_slip[mine], bins.sample_weight[mine])
            for index, name in enumerate(bins.group_names)
            for mine in [bins.group == index]
        }
        return balanced_accuracy(says_slip, bins.is_slip, bins.sample_weight), by_material

    of_unseen, by_material = score(unseen, ("train", "test"))
    return {
        "materials": list(unseen),
        "unseen": of_unseen,
        "test": score(seen, ("test",))[0],
        "per_material": by_material,
        "num_features": plan.selection.size,
        "penalty": plan.penalty,
    }


def crossval(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Evaluate every recipe on every choice of unseen materials and write the results.

    Args:
        config: composed from ``conf/crossval.yaml``.
        folder: where results go.

    Returns:
        The content of ``crossval.json``.

    Raises:
        ValueError: for bad input, in one line.
    """
    started = time.perf_counter()
    source: RecordingSource = instantiate(config.data, _convert_="all")
    names = list(config.materials or sorted({r.material for r in source.ids}))
    num_unseen = config.num_unseen
    if not 1 <= num_unseen <= len(names) - 2:
        raise ValueError(
            f"num_unseen must leave two of {len(names)} materials to train on, got {num_unseen}"
        )
    recipes: dict[str, Recipe] = {
        name: replace(of_recipe(recipe), sample_bins=config.train_bins)
        for name, recipe in instantiate(config.recipes, _convert_="all").items()
    }
    save_config(config, folder)
    materials = read_materials(config, source, names, recipes.values())
    choices = list(itertools.combinations(names, num_unseen))

    def work(job: tuple[str, Sequence[str]]) -> dict[str, Any]:
        return evaluate_split(materials, recipes[job[0]], job[1])

    jobs = list(itertools.product(recipes, choices))
    results = list(in_processes(work, jobs, "splits", "split", config.num_workers))
    content = {
        "simulated": source.is_simulated,
        "seed": config.seed,
        "num_unseen": num_unseen,
        "train_bins": config.train_bins,
        "materials": names,
        "splits": {
            name: [result for job, result in zip(jobs, results, strict=True) if job[0] == name]
            for name in recipes
        },
        "seconds": time.perf_counter() - started,
    }
    leave_results(folder, "crossval", content, crossval_figure, crossval_table(content))
    return content


def read_materials(
    config: DictConfig, source: RecordingSource, names: Sequence[str], recipes: Iterable[Recipe]
) -> Materials:
    """One pass over all recordings, split by cycle.

    Args:
        config: composed from ``conf/crossval.yaml``.
        source: of the recordings.
        names: of the materials.
        recipes: that will be fitted.

    Raises:
        ValueError: if a recipe allows no feature of the pool.
    """
    rule = instantiate(config.labels)
    fraction = config.train_fraction
    by_cycle = seen6(source.ids, seen=names, train_fraction=fraction, seed=config.seed)[0]
    maker = feature_maker(source, rule, **config.features)
    for recipe in recipes:
        recipe.allowed(maker.pool)  # refuses before any work
    materials = Materials(maker.pool, config.train_bins, config.scored_bins)
    with feature_cache(config.cache) as maker.cache, one_thread():  # workers need the processors
        data = SlipDataModule(maker, [by_cycle], config.num_workers)
        data.setup()
        for batch in data.features("train", "test"):
            materials.update(batch, by_cycle.roles[batch.recording])
    return materials


main = entry_point("crossval", crossval)
