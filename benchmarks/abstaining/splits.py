"""Choices of unseen materials, and for each a machine with held-out scores of its training bins."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.abstaining.sizes import Sizes
from benchmarks.clocks import say
from tactslip_torch.commands.crossval import Materials
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.data.splits import seen6
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.simulation import SEEN_MATERIALS
from tactslip_torch.training.abstention import held_out_scores
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import feature_cache, feature_parts
from tactslip_torch.training.recipe import Recipe, stand_for
from tactslip_torch.training.selection import plan_detector

ROLES = {"test": "held-out cycles of seen materials", "unseen": "materials never met"}


@dataclass(frozen=True)
class Scored:
    """Bins with their scores.

    Args:
        score: ``[n]``, float64.
        is_slip: ``[n]``, bool.
        recording: ``[n]``, whole numbers.
    """

    score: Tensor
    is_slip: Tensor
    recording: Tensor


@dataclass(frozen=True)
class SplitScores:
    """What every way of answering starts from.

    Args:
        unseen: materials left out.
        held_out: the training bins with scores by the machine that never met the bin itself
            (``"bin"``), its recording or its material.
        weights: of the training bins, as trained.
        judged: bins by role, scored by the machine of all training bins.
    """

    unseen: tuple[str, ...]
    held_out: dict[str, Scored]
    weights: Tensor
    judged: dict[str, Scored]


@torch.no_grad()
def load_splits(sizes: Sizes) -> tuple[list[SplitScores], bool]:
    """Fit a machine for every split; and whether the recordings are simulated."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("crossval", [f"seed={sizes.seed}", *sizes.overrides])
    recipe: Recipe = replace(
        instantiate(config.recipes.robust, _convert_="all"),
        sample_bins=sizes.train_bins,
        num_features=sizes.num_features,
        penalties=sizes.penalties,
    )
    source = instantiate(config.data, _convert_="all")
    names = sorted({recording.material for recording in source.ids})
    materials = _materials(config, source, names, sizes)
    found = []
    for unseen in choices(names, sizes):
        say(f"split without {', '.join(unseen)}")
        found.append(_scores(materials, recipe, [n for n in names if n not in unseen], unseen))
    return found, source.is_simulated


def choices(names: Sequence[str], sizes: Sizes) -> list[tuple[str, ...]]:
    """The paper's unseen materials where they are as many, then others by the seed."""
    every = list(itertools.combinations(sorted(names), sizes.num_unseen))
    papers = tuple(sorted(set(names) - set(SEEN_MATERIALS)))
    first = [papers] if papers in every else []
    others = [choice for choice in every if choice not in first]
    return [*first, *random.Random(sizes.seed).sample(others, len(others))][: sizes.splits]


def _materials(config: Any, source: Any, names: Sequence[str], sizes: Sizes) -> Materials:
    rule = instantiate(config.labels)
    by_cycle = seen6(source.ids, seen=names, train_share=config.train_share, seed=sizes.seed)[0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    materials = Materials(pool, sizes.train_bins, sizes.judged_bins)
    with feature_cache(config.cache) as cache:
        maker = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
        data = SlipDataModule(maker, by_cycle, config.num_workers)
        for number, batch in enumerate(data.loader(["train", "test"])):
            if number % 20 == 0:
                say(f"features of recording {number} of {len(source.ids)}")
            materials.update(batch, by_cycle.roles[batch.recording])
    return materials


def _scores(
    materials: Materials, recipe: Recipe, seen: Sequence[str], unseen: tuple[str, ...]
) -> SplitScores:
    survey = materials.survey_of(seen)
    plan = plan_detector(recipe, survey, _quietly)
    sample = survey.sample.bins()
    weights = stand_for(sample, recipe, survey.moments.count.tolist())
    training = TrainingBins(plan.frame(sample.features), sample.is_slip, weights)
    head = fit_machine(training, plan.penalty, plan.kernel)
    groups = {
        "bin": torch.arange(len(sample.is_slip)),
        "recording": sample.recording,
        "material": sample.group,
    }

    def judged(bins: SampledBins) -> Scored:
        return Scored(head(plan.frame(bins.features)), bins.is_slip, bins.recording)

    return SplitScores(
        unseen,
        {
            name: Scored(
                held_out_scores(plan, recipe, survey, group), sample.is_slip, sample.recording
            )
            for name, group in groups.items()
        },
        weights,
        {
            "test": judged(materials.bins_of(seen, ("test",))),
            "unseen": judged(materials.bins_of(unseen, ("train", "test"))),
        },
    )


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
