"""Which sensors matter: ``python -m tactslip_torch importance model=RUN/detector.pt``.

For whoever must build the hand. Four answers, for every channel, finger and kind: how far the score
moves with it, what its absence costs with the features as they are, what it costs when features are
selected again, and how well the hand does with the best 1, 2, 3, .. of them. Machines are refitted
in closed form on a sample of the training bins; held-out training groups alone make the choices.
Writes ``sensors.json``, ``sensors.csv`` and ``sensors.png``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.analysis.importance import (
    HELD_OUT,
    Ranking,
    Refit,
    first_order,
    measure,
    score_gradients,
)
from tactslip_torch.analysis.old.bin_sample import BinSample
from tactslip_torch.analysis.old.recipe import (
    FeatureSelection,
    Recipe,
    of_recipe,
    sample_groups,
    sample_weight,
    scaled_selection,
)
from tactslip_torch.analysis.old.statistics import TrainingStatistics
from tactslip_torch.analysis.raw_bins import draw_bins
from tactslip_torch.commands.entry import entry_point, leave_results, save_config
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.features.cache import versions
from tactslip_torch.features.selection import t_scores
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import kernel_from_dict
from tactslip_torch.report.importance import best_table, sensors_csv, sensors_figure, sensors_table
from tactslip_torch.runtime import bar, check_number, one_thread
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule, training_origin
from tactslip_torch.training.experiment import feature_cache, features_of

FORMAT = "tactslip_torch sensors 1"
_WHOLE_NUMBERS = {
    "bins": 2, "scored_bins": 1, "gradient_bins": 2, "most_channels": 1, "draws": 1, "seed": 0
}  # fmt: skip
_BINS_OF_RECORDING = 8  # that the score is differentiated at
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
        config: composed from ``conf/importance.yaml``.
        folder: where results go.

    Returns:
        The content of ``sensors.json``.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector, or no configuration beside it.
    """
    started = time.perf_counter()
    for name, least in _WHOLE_NUMBERS.items():
        check_number(name, config[name], least=least, whole=True)
    few, reselect = config.num_features, config.reselect
    if few is not None:
        check_number("num_features", few, whole=True)
    if reselect not in ("ranked", "shared"):
        raise ValueError(f"reselect must be ranked or shared, got {reselect!r}")
    with feature_cache(config.cache) as cache:
        trained = _trained(Path(config.model), cache)
        if trained.detector.pooling is not None and (few is not None or reselect != "ranked"):
            raise ValueError(
                "this detector pools all features over channels, none are selected again among "
                "channels; leave out num_features and reselect, or train with recipe=paper"
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
        draws=config.draws,
        seed=config.seed,
    )
    content["timing_s"] = {"total": time.perf_counter() - started}
    sensors_csv(content, folder / "sensors.csv")
    tables = sensors_table(content), best_table(content)
    leave_results(folder, "sensors", content, sensors_figure, *tables)
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
    if training_origin(source, fold)["train_recordings"] != detector.info.get("train_recordings"):
        raise ValueError(
            f"the training recordings of {found} are not those that {model.name} was trained on; "
            "keep both files of a training together, and its data unchanged"
        )
    maker = features_of(detector, source, instantiate(config.labels), cache, whole=True)
    return Trained(
        detector, source, fold, of_recipe(instantiate(config.recipe, _convert_="all")), maker
    )


def _read(config: DictConfig, trained: Trained) -> tuple[Refit, Ranking]:
    """One pass over all recordings: statistics and samples of the bins of every role."""
    pool, recipe = trained.detector.pool, trained.recipe
    statistics = TrainingStatistics(len(pool.names), config.bins)
    others = {role: BinSample(config.scored_bins) for role in ROLES if role != "train"}
    data = SlipDataModule(trained.maker, [trained.fold], config.num_workers)
    data.setup()
    with one_thread():  # workers need the processors
        for batch in bar(data.features(*ROLES), "features", "recording"):
            name, recording = str(batch.recording), batch.recording
            if bool((mask := batch.roles["train"]).any()):
                stratum = recipe.stratum(recording)
                statistics.update(name, stratum, batch.features[mask], batch.is_slip[mask])
            for role, other in others.items():
                mask = batch.roles[role]
                other.update(name, recording.material, batch.features[mask], batch.is_slip[mask])
    sample, detector = statistics.sample.bins(), trained.detector
    weights = sample_weight(recipe, sample)
    group, group_names = sample_groups(sample)
    sample = replace(sample, group=group, group_names=group_names)
    selected, is_pooled = detector.selected, detector.pooling is not None
    allowed = recipe.allowed(pool)
    if is_pooled:  # which takes all features of a channel, or none
        allowed = torch.zeros(len(pool.names), dtype=torch.bool)
        allowed[list(selected)] = True
        selection = FeatureSelection(selected, detector.scaler, detector.pooling)
    else:
        selection = scaled_selection(recipe, statistics, range(len(pool.names)))
    refit = Refit(
        train=sample,
        weights=weights,
        scored={role: of.bins() for role, of in others.items() if of.num_seen},
        selection=selection,
        kernel=kernel_from_dict(detector.info["kernel"]),
        penalties=sorted({*recipe.penalties_ascending, float(detector.info["penalty"])}),
    )
    ranking = Ranking(
        scores=t_scores(statistics.moments, recipe.score_variance),
        channels=[name.channel for name in pool.names],
        allowed=allowed,
        sample=sample,
        num_features=config.num_features or len(selected),
        most_correlation=1.0 if is_pooled else recipe.most_correlation,
        is_shared=config.reselect == "shared",
    )
    return refit, ranking


def _gradients(config: DictConfig, trained: Trained) -> dict[str, dict[str, float]]:
    """By channel: how far it moves the score, at bins of either class."""
    number, each = config.gradient_bins, _BINS_OF_RECORDING
    raw, is_slip, _ = draw_bins(
        trained.maker, trained.fold, "train", number, config.seed, each, by_class=True
    )
    scores, gradients = score_gradients(trained.detector, raw)
    moved = first_order(scores, gradients, raw, is_slip).T.tolist()
    return {
        name: {"non_slip": non_slip, "slip": slip}
        for name, (non_slip, slip) in zip(trained.source.hand.names, moved, strict=True)
    }


def _origin(config: DictConfig, trained: Trained, refit: Refit) -> dict[str, Any]:
    """What was measured, and on what."""
    sets = {HELD_OUT: refit.train} | dict(refit.scored)
    return {
        "format": FORMAT,
        "simulated": trained.source.is_simulated,
        "detector": {"file": Path(config.model).name, "features": len(trained.detector.selected)},
        "split": trained.fold.name,
        "channels": trained.source.hand.to_rows(),
        "num_bins": {role: len(bins.is_slip) for role, bins in sets.items()},
        "groups": {role: list(bins.group_names) for role, bins in sets.items()},
        "settings": {name: config[name] for name in (*_WHOLE_NUMBERS, "num_features", "reselect")},
        "versions": versions(),
    }


main = entry_point("importance", sensors)
