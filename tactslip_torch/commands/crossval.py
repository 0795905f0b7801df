"""Every choice of unseen materials: ``python -m tactslip_torch crossval``.

The paper judges one choice of four unseen materials; out of ten there are 210. For each of them
and for each recipe, features are ranked and scaled, K and C chosen, and a machine fitted on the
other materials alone; then it is judged on the unseen ones and on held-out cycles of the seen ones.
Fits take a bounded sample of bins (``train_bins`` of each material and class), so that all splits
take minutes; each sampled bin weighs what it stands for, so the balance of a recipe enters as
weights only. Validation groups are the materials. Leaves ``crossval.json``, ``crossval.png`` and
the resolved configuration.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.commands.entry import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split, seen6
from tactslip_torch.features.bin_sample import BinSample, SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.fit import fit_machine
from tactslip_torch.report.crossval import crossval_figure, crossval_table
from tactslip_torch.runtime import bar, whole_file
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_parts, save_config
from tactslip_torch.training.recipe import Recipe, balanced_accuracy
from tactslip_torch.training.selection import plan_detector


class Materials:
    """What one pass over all recordings keeps of each material.

    Args:
        pool: the features.
        train_bins: bins of each material and class to fit on.
        judged_bins: and to judge on.

    Attributes:
        surveys: of the training cycles, by material.
        judged: bins by material, of ``"train"`` and of ``"test"`` cycles.
    """

    def __init__(self, pool: FeaturePool, train_bins: int, judged_bins: int) -> None:
        self.pool = pool
        self.num_features = len(pool.names)
        self.train_bins = train_bins
        self.judged_bins = judged_bins
        self.surveys: dict[str, Survey] = {}
        self.judged: dict[str, dict[str, BinSample]] = {}

    def update(self, batch: Any, role: str) -> None:
        """Add a recording whose cycle is for training or for test."""
        name, material = str(batch.recording), batch.recording.material
        if role == "train":
            survey = self.surveys.setdefault(material, Survey(self.num_features, self.train_bins))
            survey.update(name, material, batch.features, batch.is_slip)
        by_role = self.judged.setdefault(
            material, {r: BinSample(self.judged_bins) for r in ("train", "test")}
        )
        by_role[role].update(name, material, batch.features, batch.is_slip)

    def survey_of(self, materials: Iterable[str]) -> Survey:
        """One survey of the training cycles of several materials."""
        merged = Survey(self.num_features, self.train_bins)
        for material in sorted(materials):
            merged.merge(self.surveys[material])
        return merged

    def bins_of(self, materials: Iterable[str], roles: Sequence[str]) -> SampledBins:
        """The bins to judge on."""
        merged = BinSample(self.judged_bins)
        for material in sorted(materials):
            for role in roles:
                merged.merge(self.judged[material][role])
        return merged.bins()


def judge(materials: Materials, recipe: Recipe, unseen: Sequence[str]) -> dict[str, Any]:
    """Fit on all materials but the unseen ones, and judge.

    Returns:
        ``unseen``, ``test`` (balanced accuracies), ``per_material`` (of the unseen ones),
        ``num_features``, ``penalty``, and ``materials``, the unseen ones.
    """
    seen = sorted(set(materials.surveys) - set(unseen))
    survey = materials.survey_of(seen)
    plan = plan_detector(recipe, survey, materials.pool, is_nested=False)
    training = plan.training_bins(survey.sample.bins())
    head = fit_machine(training, plan.penalty, plan.kernel)

    def score(names: Sequence[str], roles: Sequence[str]) -> tuple[float | None, dict[str, Any]]:
        bins = materials.bins_of(names, roles)
        says_slip = head(plan.selection(bins.features)) >= 0
        by_material = {
            name: balanced_accuracy(says_slip[mine], bins.is_slip[mine], bins.represents[mine])
            for index, name in enumerate(bins.group_names)
            for mine in [bins.group == index]
        }
        return balanced_accuracy(says_slip, bins.is_slip, bins.represents), by_material

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
    """Judge every recipe on every choice of unseen materials and write the results.

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
        name: replace(recipe, sample_bins=config.train_bins)
        for name, recipe in instantiate(config.recipes, _convert_="all").items()
    }
    save_config(config, folder)
    materials = _read(config, source, names, recipes.values())
    choices = list(itertools.combinations(names, num_unseen))
    jobs = [(recipe, unseen) for recipe in recipes.values() for unseen in choices]
    found_in_order = iter(_each(materials, jobs, config.num_workers))
    results = {name: [next(found_in_order) for _ in choices] for name in recipes}
    found = {
        "simulated": source.is_simulated,
        "seed": config.seed,
        "num_unseen": num_unseen,
        "train_bins": config.train_bins,
        "materials": names,
        "splits": results,
        "seconds": time.perf_counter() - started,
    }
    with whole_file(folder / "crossval.json") as temporary:
        temporary.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    crossval_figure(found, folder / "crossval.png")
    print("\n" + crossval_table(found))
    print(f"\nresults in {folder}")
    return found


def _read(
    config: DictConfig, source: RecordingSource, names: Sequence[str], recipes: Iterable[Recipe]
) -> Materials:
    rule: LabelRule = instantiate(config.labels)
    by_cycle: Split = seen6(
        source.ids, seen=names, train_share=config.train_share, seed=config.seed
    )[0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    for recipe in recipes:
        recipe.allowed(pool)  # refuses before any work
    materials = Materials(pool, config.train_bins, config.judged_bins)
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the processors belong to those who make features
    with feature_cache(config.cache) as cache:
        maker = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
        data = SlipDataModule(maker, by_cycle, config.num_workers)
        for batch in bar(data.loader(["train", "test"]), "features of all materials", "recording"):
            materials.update(batch, by_cycle.roles[batch.recording])
    torch.set_num_threads(num_threads)
    return materials


_shared: Materials | None = None
"""What forked workers find in their memory."""


def _each(
    materials: Materials, jobs: Sequence[tuple[Recipe, Sequence[str]]], num_workers: int | None
) -> Iterable[dict[str, Any]]:
    """Results in the order of the jobs, from as many processes as there are processors."""
    global _shared
    _shared = materials
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    count = min(count, 8) if num_workers is None else num_workers
    if count < 2 or "fork" not in multiprocessing.get_all_start_methods():
        return [_job(job) for job in bar(jobs, "splits", "split")]
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(count, context, torch.set_num_threads, (1,)) as pool:
        return list(bar(pool.map(_job, jobs), "splits", "split", total=len(jobs)))


def _job(job: tuple[Recipe, Sequence[str]]) -> dict[str, Any]:
    assert _shared is not None  # _each
    return judge(_shared, *job)


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="crossval")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        crossval(config, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    run_entry_point(main)
