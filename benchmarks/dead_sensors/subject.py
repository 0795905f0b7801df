"""The machine that loses sensors: fitted as ``train +exp=unseen4`` does, and the bins it judges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import Tensor

from benchmarks.clocks import say
from benchmarks.dead_sensors.sizes import Sizes
from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.calibration import Calibration, calibration_from_dict
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.experiment import feature_cache, feature_parts
from tactslip_torch.training.selection import plan_detector

ROLES = {"test": "held-out cycles of seen materials", "unseen": "materials never met"}


@dataclass(frozen=True)
class Bins:
    """Scaled bins.

    Args:
        z: ``[N, K]``, float64.
        is_slip: ``[N]``, bool.
        recording: ``[N]``, whole numbers.
        material: ``[N]``, whole numbers.
    """

    z: Tensor
    is_slip: Tensor
    recording: Tensor
    material: Tensor


@dataclass(frozen=True)
class Subject:
    """A detector and bins by role, ``train`` among them."""

    detector: SlipDetector
    calibration: Calibration
    bins: dict[str, Bins]
    penalty: float
    is_simulated: bool


@torch.no_grad()
def fitted_subject(sizes: Sizes) -> Subject:
    """Fit the detector of the main job, and scale all bins of all roles.

    Raises:
        ValueError: if its scores cannot be calibrated.
    """
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("train", ["+exp=unseen4", "recipe=robust", *sizes.overrides])
    source, rule = instantiate(config.data, _convert_="all"), instantiate(config.labels)
    recipe = instantiate(config.recipe, _convert_="all")
    fold = instantiate(config.split, _convert_="all")(source.ids)[0]
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    survey = Survey(len(pool.names), recipe.sample_bins)
    with feature_cache(config.cache) as cache:
        maker = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
        for number, recording in enumerate(source.ids):
            if number % 40 == 0:
                say(f"survey of recording {number} of {len(source.ids)}")
            batch = maker(recording, fold)
            if "train" in batch.roles:
                mine, group = batch.roles["train"], recipe.group(recording)
                survey.update(str(recording), group, batch.features[mine], batch.is_slip[mine])
        plan = plan_detector(recipe, survey, _quietly)
        materials = sorted({recording.material for recording in source.ids})
        parts: dict[str, list[Bins]] = {"train": [], **{role: [] for role in ROLES}}
        for number, recording in enumerate(source.ids):
            if number % 40 == 0:
                say(f"bins of recording {number} of {len(source.ids)}")
            batch = maker(recording, fold)
            z, place = plan.frame(batch.features), materials.index(recording.material)
            for role, mine in batch.roles.items():
                own, slip = z[mine], batch.is_slip[mine]
                of = [torch.full((len(own),), n) for n in (number, place)]
                parts[role].append(Bins(own, slip, *of))
    bins = {role: _joined(own) for role, own in parts.items() if own}
    training = bins["train"]
    weights = class_weights(training.is_slip)
    head = fit_machine(TrainingBins(training.z, training.is_slip, weights), plan.penalty)
    if plan.calibration is None:
        raise ValueError("its scores are not calibrated; give several penalties and materials")
    parts_of = (pool, channel_filter, plan.frame.selected, plan.frame.scaler, head)
    detector = SlipDetector(*parts_of, {}, plan.typical, plan.gaussians)
    calibration = calibration_from_dict(plan.calibration)
    return Subject(detector, calibration, bins, plan.penalty, source.is_simulated)


def class_weights(is_slip: Tensor) -> Tensor:
    """By which both classes count alike, ``[N]``, float64; 1 in the mean."""
    share = is_slip.double().mean()
    return torch.where(is_slip, 0.5 / share, 0.5 / (1 - share))


def _joined(parts: list[Bins]) -> Bins:
    names = ("z", "is_slip", "recording", "material")
    return Bins(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
