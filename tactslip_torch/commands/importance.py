"""Which sensors matter: ``python -m tactslip_torch importance model=RUN/detector.pt``.

For whoever must build the hand. Four answers, for every channel, finger and kind: how far the score
moves with it, what its absence costs with the features as they are, what it costs when features are
selected anew, and how well the hand does with the best 1, 2, 3, .. of them. Machines are refitted
in closed form on a sample of the training bins; what chooses is held-out training groups alone.
Writes ``sensors.json``, ``sensors.csv`` and ``sensors.png``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.analysis.importance import (
    HELD_OUT,
    Draws,
    Ranking,
    Refit,
    draw_raw_bins,
    first_order,
    measure,
    score_gradients,
)
from tactslip_torch.commands.entry import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.features.bin_sample import BinSample
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.selection import t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import kernel_from_dict
from tactslip_torch.report.importance import best_table, sensors_csv, sensors_figure, sensors_table
from tactslip_torch.runtime import bar, whole_file
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.experiment import DTYPES, feature_cache, save_config, versions
from tactslip_torch.training.recipe import Recipe, sample_groups, sample_weight, scaled_selection

FORMAT = "tactslip_torch sensors 1"
_WHOLE_NUMBERS = {
    "bins": 2, "judged_bins": 1, "gradient_bins": 2, "most_channels": 1, "draws": 1, "seed": 0
}  # fmt: skip
_OTHERS = ("num_features", "anew")
_SECTIONS = ("data", "labels", "split", "recipe")


@dataclass(frozen=True)
class Trained:
    """A detector with what it was trained on."""

    detector: SlipDetector
    source: RecordingSource
    fold: Split
    recipe: Recipe
    maker: FeatureMaker


def sensors(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Measure which sensors of a trained detector matter, and write what was found.

    Args:
        config: composed from ``conf/sensors.yaml``.
        folder: where results go.

    Returns:
        The content of ``sensors.json``.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector, or no configuration beside it.
    """
    started = time.perf_counter()
    for name, least in _WHOLE_NUMBERS.items():
        if type(config[name]) is not int or config[name] < least:
            raise ValueError(f"{name} must be a whole number from {least} on, got {config[name]!r}")
    few = config.num_features
    if few is not None and (type(few) is not int or few < 1):
        raise ValueError(f"num_features must be null or a whole number from 1 on, got {few!r}")
    if config.anew not in ("ranked", "shared"):
        raise ValueError(f"anew must be ranked or shared, got {config.anew!r}")
    with feature_cache(config.cache) as cache:
        trained = _trained(Path(config.model), cache)
        if trained.detector.pooling is not None and (few is not None or config.anew != "ranked"):
            raise ValueError(
                "this detector pools all features over channels, none are selected anew among "
                "channels; leave out num_features and anew, or train with recipe=robust"
            )
        save_config(config, folder)
        refit, ranking = _read(config, trained)
        gradient = _gradients(config, trained)
    content = _origin(config, trained, refit) | measure(
        refit,
        ranking,
        trained.detector.selected,
        trained.source.hand,
        gradient,
        most=config.most_channels,
        draws=Draws(config.draws, config.seed),
    )
    content["timing_s"] = {"total": time.perf_counter() - started}
    with whole_file(folder / "sensors.json") as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    with whole_file(folder / "sensors.csv") as temporary:
        temporary.write_text(sensors_csv(content))
    sensors_figure(content, folder / "sensors.png")
    if "tuned" in trained.detector.info:
        print(
            "\nthe detector was tuned: machines without sensors are fitted with its filters, but "
            "with ranges and C of the recipe"
        )
    print(f"\n{sensors_table(content)}\n\n{best_table(content)}\n\nresults in {folder}")
    return content


def _trained(model: Path, cache: Any) -> Trained:
    detector = SlipDetector.load(model)
    places = [folder / "config.yaml" for folder in (model.parent, model.parent.parent)]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise FileNotFoundError(
            f"no config.yaml beside {model}: sensors reads how it was trained from the folder that "
            "train left; give model=RUN/detector.pt in there"
        )
    config = OmegaConf.load(found)
    missing = [name for name in _SECTIONS if name not in config]
    if missing or not isinstance(config, DictConfig):
        raise ValueError(f"{found} has no {', '.join(missing)}; give the config.yaml of a training")
    source: RecordingSource = instantiate(config.data, _convert_="all")
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    fold = next((fold for fold in folds if fold.name == detector.info.get("split")), None)
    if fold is None:
        raise ValueError(
            f"{found} has no fold {detector.info.get('split')!r}, of which {model.name} is; keep "
            "both files of a training together"
        )
    keys = {str(recording): cache_key(source.key(recording)) for recording in fold.having("train")}
    if keys != detector.info.get("train_recordings"):
        raise ValueError(
            f"the training recordings of {found} are not those that {model.name} was trained on; "
            "keep both files of a training together, and its data unchanged"
        )
    dtype = DTYPES[detector.info.get("features_dtype", "float64")]
    rule, filters = instantiate(config.labels), detector.channel_filter
    maker = FeatureMaker(source, detector.pool, filters, rule, cache, dtype)
    return Trained(detector, source, fold, instantiate(config.recipe, _convert_="all"), maker)


def _read(config: DictConfig, trained: Trained) -> tuple[Refit, Ranking]:
    """One pass over all recordings: statistics and a sample of training bins, others to judge."""
    pool, recipe = trained.detector.pool, trained.recipe
    survey = Survey(len(pool.names), config.bins)
    others = {role: BinSample(config.judged_bins) for role in ROLES if role != "train"}
    data = SlipDataModule(trained.maker, trained.fold, config.num_workers)
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the processors belong to those who make features
    for batch in bar(data.loader(ROLES), "features", "recording"):
        name, recording = str(batch.recording), batch.recording
        if bool((mask := batch.roles["train"]).any()):
            stratum = recipe.stratum(recording)
            survey.update(name, stratum, batch.features[mask], batch.is_slip[mask])
        for role, other in others.items():
            mask = batch.roles[role]
            other.update(name, recording.material, batch.features[mask], batch.is_slip[mask])
    torch.set_num_threads(num_threads)
    sample, detector = survey.sample.bins(), trained.detector
    weights = sample_weight(recipe, sample)
    group, group_names = sample_groups(sample)
    sample = replace(sample, group=group, group_names=group_names)
    selected, is_pooled = list(detector.selected), detector.pooling is not None
    allowed = recipe.allowed(pool)
    if is_pooled:  # which takes all features of a channel, or none
        allowed = torch.zeros(len(pool.names), dtype=torch.bool)
        allowed[selected] = True
    refit = Refit(
        train=sample,
        weights=weights,
        judged={role: of.bins() for role, of in others.items() if of.num_seen},
        scaler=(
            detector.scaler
            if is_pooled
            else scaled_selection(recipe, survey, range(len(pool.names))).scaler
        ),
        kernel=kernel_from_dict(detector.info["kernel"]),
        penalties=sorted({*recipe.penalties_ascending, float(detector.info["penalty"])}),
        pooling=detector.pooling,
        inputs=selected,
    )
    ranking = Ranking(
        scores=t_scores(survey.moments, recipe.score_variance),
        channels=[name.channel for name in pool.names],
        allowed=allowed,
        sample=sample,
        num_features=config.num_features or len(selected),
        most_correlation=1.0 if is_pooled else recipe.most_correlation,
        is_shared=config.anew == "shared",
    )
    return refit, ranking


def _gradients(config: DictConfig, trained: Trained) -> dict[str, dict[str, float]]:
    """By channel: how far it moves the score, at bins of either class."""
    raw, is_slip = draw_raw_bins(trained.maker, trained.fold, config.gradient_bins)
    scores, gradients = score_gradients(trained.detector, raw)
    moved = first_order(scores, gradients, raw, is_slip)
    by_class = zip(moved.non_slip.tolist(), moved.slip.tolist(), strict=True)
    return {
        name: {"non_slip": non_slip, "slip": slip}
        for name, (non_slip, slip) in zip(trained.source.hand.names, by_class, strict=True)
    }


def _origin(config: DictConfig, trained: Trained, refit: Refit) -> dict[str, Any]:
    """What was measured, and on what."""
    sets = {HELD_OUT: refit.train} | dict(refit.judged)
    groups: dict[str, Sequence[str]] = {role: bins.group_names for role, bins in sets.items()}
    return {
        "format": FORMAT,
        "simulated": trained.source.is_simulated,
        "detector": {"file": Path(config.model).name, "features": len(trained.detector.selected)},
        "split": trained.fold.name,
        "channels": trained.source.hand.to_rows(),
        "num_bins": {role: len(bins.is_slip) for role, bins in sets.items()},
        "groups": {role: list(names) for role, names in groups.items()},
        "settings": {name: config[name] for name in (*_WHOLE_NUMBERS, *_OTHERS)},
        "versions": versions(),
    }


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="sensors")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        sensors(config, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    run_entry_point(main)
