"""What a rung does to downstream accuracy: detectors trained on its recordings, judged on all.

Seen materials only. Recordings of the same cycles on every rung, so that sessions and noise are
the same; features ranked and scaled, K and C chosen, and a machine fitted for each rung alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from benchmarks.clocks import say
from benchmarks.simulation.sizes import Sizes, parameters_of
from tactslip_torch.commands.crossval import Materials
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.data.splits import seen6
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.simulation import SEEN_MATERIALS
from tactslip_torch.simulation.source import SimulatedRecordings
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_parts
from tactslip_torch.training.recipe import recalls_mean, stand_for
from tactslip_torch.training.selection import plan_detector

Variant = tuple[str, float | None]
"""Rung and step."""

JUDGED_BINS = 2000


def variants(sizes: Sizes) -> list[Variant]:
    """What is trained on."""
    dynamic = [(rung, step) for rung in ("lugre", "patch") for step in sizes.accuracy_steps_us]
    return [("kinematic", None), *dynamic]


@torch.no_grad()
def accuracies(sizes: Sizes) -> list[dict[str, Any]]:
    """Balanced test accuracy of every variant, on its own test and on that of every rung."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("crossval")
    recipe = replace(
        instantiate(config.recipes.robust, _convert_="all"),
        sample_bins=sizes.train_bins,
        num_features=sizes.num_features,
    )
    kept = {variant: _materials(config, variant, sizes) for variant in variants(sizes)}
    finest = dict(kept.keys())  # the last step of each rung
    rows = []
    for variant, materials in kept.items():
        say(f"accuracy: {variant[0]}, {variant[1]}")
        survey = materials.survey_of(SEEN_MATERIALS)
        plan = plan_detector(recipe, survey, _quietly)
        sample = survey.sample.bins()
        weights = stand_for(sample, recipe, survey.moments.count.tolist())
        training = TrainingBins(plan.frame(sample.features), sample.is_slip, weights)
        head = fit_machine(training, plan.penalty, plan.kernel)

        def judged(of: Variant, frame: Any = plan.frame, head: Any = head) -> float | None:
            bins = kept[of].bins_of(SEEN_MATERIALS, ("test",))
            says_slip = head(frame(bins.features)) >= 0
            return recalls_mean(says_slip, bins.is_slip, bins.represents)

        on = {rung: judged((rung, step)) for rung, step in finest.items()}
        rows.append(
            {"rung": variant[0], "step_us": variant[1], "accuracy": judged(variant), "on": on}
        )
    return rows


def _materials(config: Any, variant: Variant, sizes: Sizes) -> Materials:
    rung, step_us = variant
    say(f"features of {len(SEEN_MATERIALS) * sizes.cycles} recordings: {rung}, {step_us}")
    step = {} if step_us is None else {"step_us": step_us}
    source = SimulatedRecordings(
        seed=sizes.seed,
        cycles=sizes.cycles,
        materials=SEEN_MATERIALS,
        scene=parameters_of(rung) | step,
    )
    rule = instantiate(config.labels)
    split = seen6(source.ids, seen=SEEN_MATERIALS, train_share=sizes.train_share, seed=sizes.seed)[
        0
    ]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, channel_filter, rule, None, dtype, engine)
    materials = Materials(pool, sizes.train_bins, JUDGED_BINS)
    for recording in source.ids:
        materials.update(maker(recording, split), split.roles[recording])
    return materials


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
