"""An experiment as a sequence of stages: features, fit, test, alarm, export; fold by fold."""

from __future__ import annotations

import errno
import logging
import os
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra.utils import instantiate
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import ROLES, Split, everything, have_same_bins
from tactslip_torch.features.cache import FeatureCache, default_cache_folder, versions
from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import statistics_of
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.native import BackendName, backend_of
from tactslip_torch.runtime import check_choice
from tactslip_torch.signals.filtering import Align, ChannelFilter, frame_lengths
from tactslip_torch.signals.wavelet import SpectrumMethod, highest_level
from tactslip_torch.training.bins import SampledBins
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule, training_origin
from tactslip_torch.training.evaluation import merged_results
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import Recipe

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Experiment:
    """All that a training is made of.

    Args:
        maker: of features.
        folds: of recordings, each with a detector of its own.
        recipe: how detectors are made.
        alarm: sets the alarm of a detector and returns what that measured; ``None``: nothing does.
        trainer: Lightning's, for a folder of results.
        cache: as ``feature_cache`` takes it.
        metadata: of the experiment, to be kept with detectors.
        num_workers: processes that make features; ``None``: one a processor.
        with_baselines: whether baselines are fitted and evaluated.
        export: writes the ONNX files of a detector into a folder; ``None``: nothing does.
        train_on_all: whether a last detector, the one to use, is trained on all recordings of the
            folds; those of folds then show what to expect of it, in place of a nested validation.
        keep_bins: writes the sample of the training bins of a detector into a folder; of several
            folds only of the last detector, where there is one. ``None``: nothing does.
        after_save: called when a detector was written. Before, nothing of an earlier run in the
            folder has changed.
    """

    maker: FeatureMaker
    folds: Sequence[Split]
    recipe: Recipe
    alarm: Callable[[SlipDetector], dict[str, Any]] | None
    trainer: Callable[[Path], L.Trainer]
    cache: str | bool | None = "auto"
    metadata: Mapping[str, Any] = field(default_factory=dict)
    num_workers: int | None = None
    with_baselines: bool = True
    export: Callable[[SlipDetector, Path], dict[str, Any]] | None = None
    train_on_all: bool = False
    keep_bins: Callable[[SlipDetector, SampledBins, Path], None] | None = None
    after_save: Callable[[], None] | None = None


def run_experiment(experiment: Experiment, folder: Path) -> dict[str, Any]:
    """Features once for all folds; for each fold fit, test, alarm, export; results merged.

    Args:
        experiment: to be run.
        folder: of results; of several folds each has a folder in it.

    Returns:
        Plain values, as ``metrics.json`` has them; ``features`` are rows of the selected features.
    """
    folds, on_all = experiment.folds, dict[str, Any]()
    results: dict[str, dict[str, Any]] = {}
    with feature_cache(experiment.cache) as experiment.maker.cache:
        data = SlipDataModule(experiment.maker, folds, experiment.num_workers)
        is_one = len(folds) == 1 and not experiment.train_on_all
        of_folds = experiment if is_one else replace(experiment, keep_bins=None)
        if experiment.train_on_all:
            of_folds = replace(of_folds, export=None)
        for data.fold in folds:
            place = folder if is_one else folder / data.fold.name
            results[data.fold.name] = _run_fold(of_folds, data, place)
        if experiment.train_on_all:
            recordings = sorted({r for fold in folds for r in fold.having(*ROLES)})
            (data.fold,) = everything(recordings, role="train")
            on_all = _run_fold(replace(experiment, with_baselines=False), data, folder)
            on_all["num_recordings"] = len(recordings)
    every = [*results.values(), *filter(None, [on_all])]
    seconds = {"features": data.seconds, **_added([of.pop("timing_s") for of in every])}
    first, *others = results.values()
    shared = set(first["selected"]).intersection(*(of["selected"] for of in others))
    features = [row for row in first["features"] if row["name"] in shared]
    recording_events = [of.pop("recording_events") for of in results.values()]
    outcomes = {name: of.pop("outcomes") for name, of in results.items()}
    for of in results.values():
        del of["features"]
    metrics = dict(first)
    if others:
        events = dict(zip(results, recording_events, strict=True))
        metrics = merged_results(results, events, outcomes, by_fold=have_same_bins(folds))
        metrics |= {"selected": [row["name"] for row in features], "folds": results}
    if on_all:  # what was measured is of the folds, all else of the detector to use
        measured = {"splits", "baselines", "comparison", "events", "recording_events", "outcomes"}
        features = on_all["features"]
        metrics |= {key: value for key, value in on_all.items() if key not in measured}
    return metrics | {
        "timing_s": seconds,
        "features": features,
    }


def _run_fold(experiment: Experiment, data: SlipDataModule, folder: Path) -> dict[str, Any]:
    """Fit, test, set the alarm of, save and export the detector of a fold; its results."""
    maker, trainer = experiment.maker, experiment.trainer(folder)
    learner = SlipLearner(
        maker.pool,
        maker.channel_filter,
        experiment.recipe,
        with_baselines=experiment.with_baselines,
    )
    trainer.fit(learner, datamodule=data)
    detector, started = learner.detector, time.perf_counter()
    if detector is None:
        raise ValueError("nothing was fitted; leave trainer.max_epochs at 1")
    trainer.test(learner, datamodule=data, verbose=False)
    tested = time.perf_counter()
    detector.info |= training_origin(maker.source, data.fold) | dict(experiment.metadata)
    alarm: dict[str, Any] = {}
    onnx: dict[str, Any] = {}
    if trainer.is_global_zero:
        detector.save(folder / "detector.pt")  # stays, whatever comes
        if experiment.after_save:
            experiment.after_save()
        if experiment.keep_bins and learner.sample is not None:
            experiment.keep_bins(detector, learner.sample, folder)
        alarm = experiment.alarm(detector) if experiment.alarm else {}
        detector.save(folder / "detector.pt")
    alarmed = time.perf_counter()
    if trainer.is_global_zero and experiment.export:
        onnx = experiment.export(detector, folder)
    seconds = {"test": tested - started, "alarm": alarmed - tested}
    return {
        **learner.metrics,
        "events": learner.metrics["events"] | alarm.pop("events", {}),
        **({"alarm": alarm} if alarm else {}),
        "recording_events": learner.events,
        "outcomes": learner.outcomes,
        **learner.metadata,
        "selected": [str(name) for name in detector.selected_names],
        "features": feature_rows(detector.selected_names, maker.source.hand),
        "trained_on": {
            "materials": detector.info["train_materials"],
            "sessions": detector.info["train_sessions"],
            "scenes": sorted({recording.scene for recording in data.fold.having("train")}),
        },
        "onnx": onnx,
        "timing_s": learner.seconds | seconds | {"save_export": time.perf_counter() - alarmed},
    }


def _added(several: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Sums of the values of each key."""
    total = Counter[str]()
    for each in several:
        total.update(each)
    return dict(total)


DTYPES = {"float64": torch.float64, "float32": torch.float32}


def feature_maker(
    source: RecordingSource,
    rule: LabelRule,
    *,
    frames: Mapping[str, int | None],
    polyorder: int,
    wavelet: str,
    level: int | None,
    spectrum: SpectrumMethod,
    dtype: str,
    backend: BackendName,
    align: Align = "centred",
    pooling: str | Sequence[str] | None = None,
    memory_gib: float = 2.0,
    recipe: Recipe | None = None,
    with_baselines: bool = True,
) -> FeatureMaker:
    """The features of the ``features`` section, without a cache; no recording is read for it.

    Args:
        source: of the recordings, whose hand and rate they are for.
        rule: how bins are laid and labelled.
        frames: as ``frame_lengths`` takes them.
        polyorder: of the filter.
        wavelet: of the branches.
        level: number of levels; ``None``: as many as bin and wavelet allow, at most the paper's 4.
        spectrum: of the branches.
        dtype: in which features are computed.
        backend: what computes them.
        align: of the filter.
        pooling: statistics over channels; the recipe takes them, here they are only checked.
        memory_gib: of features that are kept in memory at most.
        recipe: that the features are for; ``None`` makes all there are.
        with_baselines: whether they are for baselines too.

    Raises:
        ValueError: if a kind of channel has no frame, a statistic is unknown, a bin
            allows no such level, or a value is none that exists.
    """
    check_choice("features.dtype", dtype, DTYPES)
    if pooling is not None:
        statistics_of(pooling, len(source.hand))
    lengths = frame_lengths(source.hand, frames)
    bin_samples = round(rule.bin_ms * source.sample_rate_hz / 1000)
    highest = highest_level(bin_samples, wavelet)
    if level is not None and (not isinstance(level, int) or not 1 <= level <= highest):
        raise ValueError(
            f"features.level must lie in 1..{highest} for bins of {bin_samples} samples and "
            f"features.wavelet={wavelet}, got {level!r}; give fewer levels, longer bins "
            "(labels.bin_ms), or null for as many as there can be"
        )
    pool = FeaturePool(
        source.hand,
        source.sample_rate_hz,
        bin_samples=bin_samples,
        wavelet=wavelet,
        level=level,
        spectrum=spectrum,
        arithmetic="native" if dtype == "float32" else "double",
        backend=backend,
    )
    if recipe is not None:
        pool = pool.select(recipe.wanted(pool, with_baselines).nonzero()[:, 0].tolist())
    return FeatureMaker(
        source,
        pool,
        ChannelFilter(lengths, polyorder, align),
        rule,
        dtype=DTYPES[dtype],
        backend=backend_of(backend),
        memory_gib=memory_gib,
    )


def features_of(
    detector: SlipDetector, source: RecordingSource, rule: LabelRule, cache: FeatureCache | None
) -> FeatureMaker:
    """The features that a detector reads, computed as in its training."""
    pool, dtype = detector.pool, DTYPES[detector.info.get("features_dtype", "float64")]
    pool = pool.select(sorted(set(detector.selected)))
    return FeatureMaker(source, pool, detector.channel_filter, rule, cache, dtype)


@contextmanager
def feature_cache(setting: str | bool | None) -> Iterator[FeatureCache]:
    """The cache of ``cache=auto|off|FOLDER``; ``off`` keeps features for this run only.

    What does not fit in memory is read again, so even ``off`` holds features on disk, in a
    temporary folder that goes with the run.
    """
    if setting in ("off", False, None):  # YAML reads a bare off as false
        with tempfile.TemporaryDirectory(prefix="tactslip-") as folder:
            yield FeatureCache(folder)
        return
    cache = FeatureCache(
        default_cache_folder() if setting in ("auto", True) else Path(str(setting)).expanduser()
    )
    try:
        cache.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in (errno.EEXIST, errno.ENOTDIR):  # a mistake, told before a pass has begun
            raise
    yield cache
    cache.prune()


def make_trainer(config: DictConfig, folder: Path) -> L.Trainer:
    """The Lightning trainer of the ``trainer`` section, logging to TensorBoard and CSV.

    Raises:
        ValueError: if torchrun started another number of processes than it has.
    """
    # Lightning's advertisements and a deprecation inside it are nothing a user can act on
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=r".*isinstance\(treespec, LeafSpec\).*")
    warnings.filterwarnings("ignore", message="Experiment logs directory .* exists")  # said before
    trainer: L.Trainer = instantiate(
        config,
        default_root_dir=str(folder),
        logger=[
            TensorBoardLogger(str(folder), name="", version="tensorboard"),
            CSVLogger(str(folder), name="", version="csv"),
        ],
        enable_checkpointing=False,
        enable_progress_bar=False,  # features and validation have their own
    )
    started = int(os.environ.get("WORLD_SIZE", "1"))
    if "TORCHELASTIC_RUN_ID" in os.environ and started != trainer.world_size:
        raise ValueError(
            f"{started} processes were started, the trainer has {trainer.world_size}; add "
            "trainer.strategy=ddp trainer.devices=PROCESSES_OF_A_HOST trainer.num_nodes=HOSTS"
        )
    return trainer


def write_tensorboard(folder: Path, config: DictConfig, metrics: Mapping[str, Any]) -> None:
    """Add to a run's TensorBoard its figures, configuration, and final scores.

    Args:
        folder: of the run, with its figures.
        config: of the run.
        metrics: the content of ``metrics.json``.
    """
    final = {
        f"final/{role}/{name}": scores[name]
        for role, scores in metrics["splits"].items()
        for name in ("accuracy", "balanced_accuracy")
        if scores[name] is not None
    }
    with SummaryWriter(str(folder / "tensorboard")) as board:
        board.add_text("configuration", f"```yaml\n{OmegaConf.to_yaml(config, resolve=True)}```")
        for path in sorted(folder.glob("*.png")):
            with Image.open(path) as image:
                board.add_image(path.stem, np.asarray(image.convert("RGB")), dataformats="HWC")
        for name, score in final.items():
            board.add_scalar(name, score)


def feature_rows(names: Sequence[FeatureName], hand: HandLayout) -> list[dict[str, str]]:
    """Features as plain rows, with the kind and finger of their channel, for tables and figures."""
    rows = []
    for name in names:
        place = {"channel": "all", "kind": name.channel, "finger": "all"}
        if not name.is_pooled:
            channel = hand.channel(name.channel)
            place = {"kind": channel.kind, "finger": channel.finger}
        rows.append({"name": str(name), **asdict(name), **place})
    return rows


def common_metadata(maker: FeatureMaker, config: DictConfig) -> dict[str, Any]:
    """What every ``metrics.json`` says of its origin."""
    pool = maker.pool
    return {
        "simulated": maker.source.is_simulated,
        "experiment": config.name,
        "seed": config.seed,
        "labels": OmegaConf.to_container(config.labels, resolve=True),
        "num_features_pool": len(pool.names),
        "is_papers_hand": pool.hand == HandLayout.paper24(),
        "versions": versions(),
    }
