"""What the sections of a configuration make: features, cache, trainer; and what results say."""

from __future__ import annotations

import errno
import logging
import os
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Checkpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.features.cache import (
    FeatureCache,
    default_cache_folder,
    versions,
)
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import statistics_of
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.native import BackendName, backend_of
from tactslip_torch.report.metrics import merged_metrics, summed_metrics
from tactslip_torch.runtime import LEAD, Progress, check_choice
from tactslip_torch.signals.filtering import Align, ChannelFilter, frame_lengths
from tactslip_torch.signals.wavelet import SpectrumMethod, highest_level
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.learner import event_numbers


def merged_results(
    folds: Mapping[str, Mapping[str, Any]], *, by_fold: bool = False
) -> dict[str, Any]:
    """Splits, baselines and events of several tests as of one, by role.

    Args:
        folds: of each its ``metrics`` as ``SlipLearner`` has them, and ``recording_events``.
        by_fold: whether folds have the same bins, which then are not summed: results have each role
            of each fold, such as ``"protocol/unseen"``.
    """
    splits = defaultdict[str, list[Any]](list)
    baselines, events = (defaultdict[str, Any](lambda: defaultdict(list)) for _ in range(2))
    for fold, found in folds.items():
        before = f"{fold}/" if by_fold else ""
        for role, scores in found["splits"].items():
            splits[before + role].append(scores)
        for name, about in found["baselines"].items():
            for role, scores in about["splits"].items():
                baselines[name][before + role].append(scores)
        for role, by_rule in found["recording_events"].items():
            for name, recordings in by_rule.items():
                events[before + role][name] += recordings
    summed = {
        name: {"splits": {role: summed_metrics(own) for role, own in by_role.items()}}
        for name, by_role in baselines.items()
    }
    only = next(iter(folds.values()))["baselines"] if len(folds) == 1 else None
    return {
        "splits": {role: merged_metrics(scores) for role, scores in splits.items()},
        "baselines": summed if only is None else only,  # what they are is told of one fold alone
        "events": event_numbers(events),
    }


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
    channel_filter = ChannelFilter(lengths, polyorder, align)
    computed_in, computed_by = DTYPES[dtype], backend_of(backend)
    return FeatureMaker(source, pool, channel_filter, rule, None, computed_in, computed_by)


def features_of(
    detector: SlipDetector, source: RecordingSource, rule: LabelRule, cache: FeatureCache | None
) -> FeatureMaker:
    """The features of a detector, computed as in its training."""
    dtype = DTYPES[detector.info.get("features_dtype", "float64")]
    return FeatureMaker(source, detector.pool, detector.channel_filter, rule, cache, dtype)


@contextmanager
def feature_cache(setting: str | bool | None) -> Iterator[FeatureCache]:
    """The cache of ``cache=auto|off|FOLDER``; ``off`` keeps features for this run only.

    Two passes need the features twice, so even ``off`` holds them on disk, in a temporary folder
    that goes with the run.
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


class _RecordingProgressBar(TQDMProgressBar):
    """Lightning's bar, named after the pass that is running and counting recordings."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=1)

    def init_train_tqdm(self) -> Any:
        """The bar of both training passes, on standard error: standard output is for results."""
        return Progress(
            unit=" recording", dynamic_ncols=True, disable=self.is_disabled, smoothing=0
        )

    def init_test_tqdm(self) -> Any:
        """The bar of the test pass."""
        return self.init_train_tqdm()

    def on_train_epoch_start(self, trainer: Any, *args: Any) -> None:
        """Name the pass."""
        super().on_train_epoch_start(trainer, *args)
        what = "statistics" if trainer.current_epoch == 0 else "sums"
        self.train_progress_bar.set_description_str(f"{'features, ' + what:{LEAD}}")

    def on_test_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """Name the pass; Lightning numbers its loaders instead."""
        super().on_test_batch_start(*args, **kwargs)
        self.test_progress_bar.set_description_str(f"{'features, scores':{LEAD}}")

    def get_metrics(self, trainer: Any, pl_module: Any) -> dict[str, Any]:
        """Nothing, instead of Lightning's version number."""
        return {}


def make_trainer(
    config: DictConfig,
    folder: Path,
    callbacks: Sequence[L.Callback] = (),
) -> L.Trainer:
    """The Lightning trainer of the ``trainer`` section, logging to TensorBoard and CSV.

    Raises:
        ValueError: if torchrun started another number of processes than it has.
    """
    # Lightning's advertisements and a deprecation inside it are nothing a user can act on
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=r".*isinstance\(treespec, LeafSpec\).*")
    trainer: L.Trainer = instantiate(
        config,
        default_root_dir=str(folder),
        logger=[
            TensorBoardLogger(str(folder), name="", version="tensorboard"),
            CSVLogger(str(folder), name="", version="csv"),
        ],
        callbacks=[_RecordingProgressBar(), *callbacks],
        enable_checkpointing=any(isinstance(callback, Checkpoint) for callback in callbacks),
    )
    started = int(os.environ.get("WORLD_SIZE", "1"))
    if "TORCHELASTIC_RUN_ID" in os.environ and started != trainer.world_size:
        raise ValueError(
            f"{started} processes were started, the trainer has {trainer.world_size}; add "
            "trainer.strategy=ddp trainer.devices=PROCESSES_OF_A_HOST trainer.num_nodes=HOSTS"
        )
    return trainer


def write_tensorboard(folder: Path, config: DictConfig, metrics: Mapping[str, Any]) -> None:
    """Add to a run's TensorBoard its figures, validation, configuration, and final scores.

    The curve of validation has the choices in the order of C as its steps.

    Args:
        folder: of the run, with its figures.
        config: of the run.
        metrics: the content of ``metrics.json``.
    """
    plain: Any = OmegaConf.to_container(config, resolve=True)
    flat = {key: value for key, value in _flat(plain) if "._" not in key}
    is_simple = (bool, int, float, str)
    given = {key: v if isinstance(v, is_simple) else str(v) for key, v in flat.items()}
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
        choices = sorted(metrics.get("validation") or (), key=lambda row: row["penalty"])
        penalties = sorted({row["penalty"] for row in choices})
        for row in choices:
            kernel = "_".join(f"{k}={v}" for k, v in row["kernel"].items())
            name = f"validation/{row.get('use', 'channel')}/K={row['num_features']}/{kernel}"
            board.add_scalar(name, row["mean"], penalties.index(row["penalty"]))
        board.add_hparams(given, final, run_name=".")


def _flat(section: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def feature_rows(names: Sequence[FeatureName], hand: HandLayout) -> list[dict[str, str]]:
    """Features as plain rows, with the kind and finger of their channel, for tables and figures."""
    rows = []
    for name in names:
        about = {"channel": "all", "kind": name.channel, "finger": "all"}
        if not name.is_pooled:
            channel = hand.channel(name.channel)
            about = {"kind": channel.kind, "finger": channel.finger}
        rows.append({"name": str(name), **asdict(name), **about})
    return rows


def common_metadata(
    source: RecordingSource, pool: FeaturePool, config: DictConfig
) -> dict[str, Any]:
    """What every ``metrics.json`` says of its origin."""
    return {
        "simulated": source.is_simulated,
        "experiment": config.name,
        "seed": config.seed,
        "labels": OmegaConf.to_container(config.labels, resolve=True),
        "num_features_pool": len(pool.names),
        "is_papers_hand": pool.hand == HandLayout.paper24(),
        "versions": versions(),
    }
