"""The main experiment on some of its recordings: bins, their features in each precision, a fit.

Features are ranked and scaled, K and C chosen as the main job does, once, from float64 features of
the training bins. All variants share that plan: what differs between them is rounding.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from benchmarks.arithmetic import ARITHMETIC, FLOAT64, NATIVE
from benchmarks.clocks import say
from benchmarks.precision.sizes import Sizes
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.features.extractor import FeatureExtractor
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.survey import Survey
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_parts
from tactslip_torch.training.recipe import Recipe, bin_weights
from tactslip_torch.training.selection import Plan, plan_detector

ROLES = ("test", "unseen")


@dataclass(frozen=True)
class Part:
    """Bins of one role.

    Args:
        bins: some of them, filtered, ``[n, C, samples]`` float64: for timing.
        features: ``[N, F]`` by the name of the arithmetic.
        is_slip: ``[N]``, bool.
    """

    bins: Tensor
    features: Mapping[str, Tensor]
    is_slip: Tensor


@dataclass(frozen=True)
class Experiment:
    """What every variant starts from.

    Args:
        pool: of the main job.
        channel_filter: likewise.
        plan: which features, how scaled, with which kernel and C.
        weights: of the training bins.
        train: float64 and float32 features of the training bins.
        judged: features in every arithmetic, by role.
        facts: JSON-able.
    """

    pool: FeaturePool
    channel_filter: ChannelFilter
    plan: Plan
    weights: Tensor
    train: Part
    judged: Mapping[str, Part]
    facts: dict[str, Any]

    def all_judged(self, arithmetic: str) -> Tensor:
        """Features of the bins of all roles, in the order of ``ROLES``."""
        return torch.cat([self.judged[role].features[arithmetic] for role in ROLES])


@torch.no_grad()
def load_experiment(sizes: Sizes) -> Experiment:
    """Simulate, describe, plan."""
    config = _config(sizes)
    source = instantiate(config.data, _convert_="all")
    rule = instantiate(config.labels)
    recipe: Recipe = instantiate(config.recipe, _convert_="all")
    split: Split = instantiate(config.split, _convert_="all")(source.ids)[0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    maker = FeatureMaker(source, pool, channel_filter, rule, None, dtype, engine)
    pools = {name: pool_in(pool, name) for name in ARITHMETIC}

    survey = Survey(len(pool.names), recipe.sample_bins)

    def describe(role: str, recording: RecordingId, names: Iterable[str]) -> Part:
        bins, laid = maker.filtered_bins(recording)
        bins, is_slip = bins[:: sizes.every], laid.is_slip[:: sizes.every]
        features = {name: described(pools[name], bins.to(ARITHMETIC[name].dtype)) for name in names}
        if role == "train":
            group = recipe.group(recording)
            survey.update(str(recording), group, features[FLOAT64].float(), is_slip)
        say(f"{role}: {recording}, {len(bins)} bins")
        return Part(bins[: sizes.timed_bins], features, is_slip)

    parts = {
        role: _joined([describe(role, recording, names) for recording in split.having(role)])
        for role, names in {"train": (FLOAT64, NATIVE), **dict.fromkeys(ROLES, ARITHMETIC)}.items()
    }
    train = parts.pop("train")
    say("plan")
    plan = plan_detector(recipe, survey, lambda items, what: items)
    weights = bin_weights(recipe, survey.moments.count.tolist(), train.is_slip)
    facts = {
        "simulated": source.is_simulated,
        "experiment": config.name,
        "recipe": recipe.name,
        "num_features": len(plan.frame.selected),
        "penalty": plan.penalty,
        "kernel": plan.kernel.to_dict(),
        "num_bins": {"train": int(survey.moments.count.sum())}
        | {role: len(one.is_slip) for role, one in parts.items()},
    }
    return Experiment(pool, channel_filter, plan, weights, train, parts, facts)


def described(pool: FeaturePool, bins: Tensor) -> Tensor:
    """Features ``[N, F]`` as ``SlipDetector`` takes them: not rounded to the dtype of the bins."""
    return FeatureExtractor(pool, engine="reference")(pool.widen(bins))


def pool_in(pool: FeaturePool, name: str) -> FeaturePool:
    """The same pool in another arithmetic."""
    return FeaturePool(pool.hand, **pool.facts() | {"arithmetic": ARITHMETIC[name].arithmetic})


def _joined(parts: Sequence[Part]) -> Part:
    features = {
        name: torch.cat([part.features[name] for part in parts]) for name in parts[0].features
    }
    bins = torch.cat([part.bins for part in parts])
    return Part(bins, features, torch.cat([part.is_slip for part in parts]))


def _config(sizes: Sizes) -> DictConfig:
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        return compose("train", ["+exp=unseen4", "recipe=robust", *sizes.overrides])
