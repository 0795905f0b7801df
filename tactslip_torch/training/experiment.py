"""One experiment: features and trainer, and each fold fitted, tested, saved and exported."""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import lightning as L
import torch
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Checkpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from omegaconf import DictConfig, OmegaConf
from tqdm.auto import tqdm

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.deploy.check import GraphKind
from tactslip_torch.deploy.export import export_detector, read_sidecar
from tactslip_torch.features.cache import (
    FeatureCache,
    cache_key,
    default_cache_folder,
    source_digest,
)
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import statistics_of
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.native import BackendName, backend_of
from tactslip_torch.onset.baselines import BaselineDetector, BaselineName
from tactslip_torch.onset.decisions import KEY, Scorer
from tactslip_torch.report.metrics import merged_answers, merged_metrics, summed_metrics
from tactslip_torch.report.results import tuning_figure
from tactslip_torch.runtime import LEAD, __version__, whole_file
from tactslip_torch.signals.filtering import Align, ChannelFilter
from tactslip_torch.signals.spectrum import SpectrumMethod
from tactslip_torch.signals.wavelet import highest_level
from tactslip_torch.training.adaptation import FILE as STATISTICS
from tactslip_torch.training.adaptation import Statistics
from tactslip_torch.training.alarm import CalibratedAlarm, DebouncedAlarm
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.learner import SlipLearner, event_numbers
from tactslip_torch.training.recipe import FeatureSelection
from tactslip_torch.training.tuning import Tuning


def combined(folds: dict[str, dict[str, Any]], *, by_fold: bool) -> dict[str, Any]:
    """One fold as it is; of several, ``merged_results``, and the features that all selected."""
    if len(folds) == 1:
        (only,) = folds.values()
        del only["recording_events"]
        return only
    merged = merged_results(folds, by_fold=by_fold)
    found = list(folds.values())
    times = {name: dict[str, float]() for name in ("timing_s", "worker_s")}
    for own in found:
        del own["recording_events"]
        for name, total in times.items():
            for stage, seconds in own.pop(name).items():
                total[stage] = total.get(stage, 0.0) + seconds
    shared = set.intersection(*(set(own["selected"]) for own in found))
    selected = [name for name in found[0]["selected"] if name in shared]
    return merged | times | {"selected": selected, "folds": folds}


def merged_results(
    folds: Mapping[str, Mapping[str, Any]], *, by_fold: bool = False
) -> dict[str, Any]:
    """Splits, baselines, events and answers of several tests as of one, by role.

    Args:
        folds: of each its ``metrics`` as ``SlipLearner`` has them, and ``recording_events``.
        by_fold: whether folds have the same bins, which then are not summed: results have each role
            of each fold, such as ``"protocol/unseen"``.
    """
    splits, answers = defaultdict[str, list[Any]](list), defaultdict[str, dict[str, Any]](dict)
    baselines, events = (defaultdict[str, Any](lambda: defaultdict(list)) for _ in range(2))
    for fold, found in folds.items():
        before = f"{fold}/" if by_fold else ""
        for role, scores in found["splits"].items():
            splits[before + role].append(scores)
        for role, own in found.get("answers", {}).items():
            answers[before + role][fold] = own
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
        "answers": {role: merged_answers(own) for role, own in answers.items()},
    }


MOST_LEVELS = 4
"""Wavelet levels of the paper, and of ``features.level=null`` at most."""
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
    if dtype not in DTYPES:
        raise ValueError(f"features.dtype must be one of {', '.join(DTYPES)}, got {dtype!r}")
    if pooling is not None:
        statistics_of(pooling, len(source.hand))
    lengths = frame_lengths(source.hand, frames)
    bin_samples = round(rule.bin_ms * source.sample_rate_hz / 1000)
    pool = FeaturePool(
        source.hand,
        source.sample_rate_hz,
        bin_samples=bin_samples,
        wavelet=wavelet,
        level=_checked_level(level, bin_samples, wavelet),
        spectrum=spectrum,
        arithmetic="native" if dtype == "float32" else "double",
    )
    channel_filter = ChannelFilter(lengths, polyorder, align)
    computed_in, computed_by = DTYPES[dtype], backend_of(backend)
    return FeatureMaker(source, pool, channel_filter, rule, None, computed_in, computed_by)


def frame_lengths(hand: HandLayout, frames: Mapping[str, int | None]) -> list[int]:
    """The frame of each channel, from ``features.frames``.

    Args:
        hand: the channels.
        frames: an odd number of samples by kind of channel; 1 or ``None`` leaves the kind as it is.

    Raises:
        ValueError: if a kind has no frame, or one that is even or no number.
    """
    if missing := [kind for kind in hand.kinds if kind not in frames]:
        raise ValueError(
            f"features.frames has no frame for {', '.join(missing)} channels; give an odd number "
            f"of samples, as +features.frames.{missing[0]}=11, or null to leave them unfiltered"
        )
    lengths = {kind: 1 if frames[kind] is None else frames[kind] for kind in hand.kinds}
    for kind, length in lengths.items():
        if not isinstance(length, int) or length < 1 or length % 2 == 0:
            raise ValueError(
                f"features.frames.{kind} must be an odd number of samples, or null to leave such "
                f"channels unfiltered, got {length!r}"
            )
    return [int(lengths[channel.kind] or 1) for channel in hand.channels]


def _checked_level(level: int | None, bin_samples: int, wavelet: str) -> int:
    """``features.level`` for bins of such a length."""
    highest = highest_level(bin_samples, wavelet)
    if level is None:
        return min(MOST_LEVELS, highest)
    if not isinstance(level, int) or not 1 <= level <= highest:
        raise ValueError(
            f"features.level must lie in 1..{highest} for bins of {bin_samples} samples and "
            f"features.wavelet={wavelet}, got {level!r}; give fewer levels, longer bins "
            "(labels.bin_ms), or null for as many as there can be"
        )
    return level


def features_of(
    detector: SlipDetector, source: RecordingSource, rule: LabelRule, cache: FeatureCache
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
    yield cache
    cache.prune()


class RecordingProgressBar(TQDMProgressBar):
    """Lightning's bar, named after the pass that is running and counting recordings."""

    def __init__(self) -> None:
        # a terminal is redrawn at every recording, a log file is not filled with bars
        super().__init__(refresh_rate=1 if sys.stderr.isatty() else 50)

    def init_train_tqdm(self) -> Any:
        """The bar of both training passes, on standard error: standard output is for results."""
        return tqdm(unit=" recording", dynamic_ncols=True, disable=self.is_disabled, smoothing=0)

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
        callbacks=[RecordingProgressBar(), *callbacks],
        enable_checkpointing=any(isinstance(callback, Checkpoint) for callback in callbacks),
    )
    started = int(os.environ.get("WORLD_SIZE", "1"))
    if "TORCHELASTIC_RUN_ID" in os.environ and started != trainer.world_size:
        raise ValueError(
            f"{started} processes were started, the trainer has {trainer.world_size}; add "
            "trainer.strategy=ddp trainer.devices=PROCESSES_OF_A_HOST trainer.num_nodes=HOSTS"
        )
    return trainer


def save_config(config: DictConfig, folder: Path) -> None:
    """Write the resolved configuration."""
    with whole_file(folder / "config.yaml") as temporary:
        temporary.write_text(OmegaConf.to_yaml(config, resolve=True))


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


def versions() -> dict[str, str]:
    """What made a result, for files that say so."""
    return {
        "tactslip_torch": __version__,
        "torch": torch.__version__,
        "code": source_digest(),
    }


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


log = logging.getLogger(__name__)


class SaveAfterFirstPass(Checkpoint):
    """Writes ``last.ckpt`` behind the first pass, whole or not at all, for ``ckpt_path=``.

    Not behind the second: resuming repeats that and the solve, which read features from the
    cache. A ``Checkpoint`` is called behind the learner's own end of an epoch, with its plan.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save."""
        if trainer.current_epoch == 0 and not getattr(trainer, "fast_dev_run", False):
            if trainer.is_global_zero:
                with whole_file(self._folder / "last.ckpt") as temporary:
                    trainer.save_checkpoint(temporary)
            else:  # saving is done in step; only the first process writes
                trainer.save_checkpoint(self._folder / "last.ckpt")


def tune_fold(
    config: DictConfig, folder: Path, data: SlipDataModule, first: SlipLearner, tuning: Tuning
) -> tuple[SlipLearner, dict[str, Any]]:
    """Fit as the recipe says, and learn from there: the second fit's learner, and what was found.

    Detectors of the recipe's choice and of the grid's least loss are evaluated as the tuned one
    will be, and kept as ``grid.pt`` and ``start.pt``: what is beyond the latter is due to the
    gradient.
    """
    started = time.perf_counter()
    trainer = make_trainer(config.trainer, folder / "grid")
    if trainer.world_size > 1:
        raise ValueError(
            f"tuning runs in one process, the trainer has {trainer.world_size}; leave out "
            "trainer.devices and trainer.num_nodes, or take tuning=none"
        )
    trainer.fit(first, datamodule=data)
    found: dict[str, Any] = {"fit_s": time.perf_counter() - started}
    plan, (_, sample) = first.plan, first.gathered
    tuned = tuning(plan, sample, [str(name) for name in data.maker.pool.names])
    found |= tuned.metadata
    start = found["start"]
    by_loss = _settled(first, data, plan.selection, start["penalty"], start["offset"])
    other = make_trainer(config.trainer, folder / "start")
    other.fit(by_loss, datamodule=data)
    found["splits"] = {}
    tests = (("grid", "recipe", trainer, first), ("start", "grid", other, by_loss))
    for name, way, tester, learner in tests:
        tester.test(learner, datamodule=data, verbose=False)
        found["splits"][way] = learner.metrics["splits"]
        if learner.detector is not None:
            learner.detector.info |= _origin(config, data)
            learner.detector.save(folder / f"{name}.pt")
    simulated = data.maker.source.is_simulated
    tuning_figure(found, folder / "tuning.png", simulated=simulated)
    found["validation"] = first.metadata["validation"]
    return _settled(first, data, tuned.selection, tuned.penalty, tuned.offset), found


def _settled(
    first: SlipLearner,
    data: SlipDataModule,
    selection: FeatureSelection,
    penalty: float,
    offset: float,
) -> SlipLearner:
    """A learner like the first with nothing left to choose."""
    size = len(selection.selected)
    recipe = replace(first.recipe, num_features=size, penalties=penalty, offsets=offset)
    return SlipLearner(
        data.maker.pool,
        data.maker.channel_filter,
        recipe,
        selection=selection,
        abstaining=first.abstaining,
        with_baselines=first.with_baselines,
    )


def run_fold(
    config: DictConfig,
    folder: Path,
    data: SlipDataModule,
    learner: SlipLearner,
    alarming: CalibratedAlarm | DebouncedAlarm | None,
    tuned: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Fit, test, set the alarm of, save and export one fold; what it found.

    Args:
        config: of the experiment.
        folder: of its results.
        data: of the fold.
        learner: of its detector.
        alarming: the stage after the fit.
        tuned: what tuning found, if it did.
    """
    trainer = make_trainer(config.trainer, folder, [SaveAfterFirstPass(folder)])
    checkpoint = _checkpoint(config.ckpt_path, data.split)
    trainer.fit(learner, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    if learner.detector is None:
        raise ValueError(
            "the fit ended before its second pass; leave trainer.max_epochs at 2, and resume with "
            "ckpt_path=THE_FOLDER_OF_THIS_RUN"
        )
    started = time.perf_counter()
    trainer.test(learner, datamodule=data, verbose=False)
    tested = time.perf_counter()
    detector = learner.detector
    detector.info |= _origin(config, data)
    if tuned is not None:
        kept = ("learned", "steps", "bins", "start")
        detector.info["tuned"] = {name: tuned[name] for name in kept}
    onnx: dict[str, dict[str, float] | str] = {}
    alarm: dict[str, Any] = {}
    if getattr(trainer, "fast_dev_run", False):
        alarming = None  # hours of streams are no quick look
    if trainer.is_global_zero and alarming is not None:
        detector.save(folder / "detector.pt")  # what was fitted stays, whatever comes
        if isinstance(alarming, CalibratedAlarm):
            alarm = alarming(detector, _baselines(detector), config.num_workers)
        else:
            alarming(detector)
    told = time.perf_counter()
    if trainer.is_global_zero:
        detector.save(folder / "detector.pt")
        if config.statistics:
            _save_statistics(config, learner, detector, data.split, folder / STATISTICS)
        onnx = export_fold(detector, folder) if config.export else {}
    seconds = dict(learner.seconds)
    seconds["test_pass"] = tested - started
    if alarming is not None:
        seconds["alarm"] = told - tested
    seconds["save_export"] = time.perf_counter() - told
    events = {**learner.metrics.get("events", {}), **alarm.pop("events", {})}
    return {
        **learner.metrics,
        "events": events,
        **({"alarm": alarm} if alarm else {}),
        "recording_events": learner.events,  # for combined
        **learner.metadata,
        **({} if tuned is None else {"tuning": tuned, "validation": tuned.pop("validation")}),
        "selected": [str(name) for name in detector.selected_names],
        "trained_on": {
            "materials": detector.info["train_materials"],
            "sessions": detector.info["train_sessions"],
            "scenes": sorted({recording.scene for recording in data.split.having("train")}),
        },
        "onnx": onnx,
        "timing_s": seconds,
        "worker_s": learner.worker_seconds,
    }


def _save_statistics(
    config: DictConfig, learner: SlipLearner, detector: SlipDetector, fold: Split, path: Path
) -> None:
    """What ``adapt`` solves again from, beside the detector."""
    materials = {str(recording): recording.material for recording in fold.having("train")}
    labels = {str(key): value for key, value in config.labels.items() if key != "_target_"}
    Statistics.of_training(*learner.gathered, materials, labels, detector).save(path)


def _origin(config: DictConfig, data: SlipDataModule) -> dict[str, Any]:
    """What a detector says of where it comes from."""
    source, trained = data.maker.source, data.split.having("train")
    return {
        "simulated": source.is_simulated,
        **_units(source),
        "experiment": config.name,
        "seed": config.seed,
        "split": data.split.name,
        "features_dtype": config.features.dtype,
        "train_materials": sorted({recording.material for recording in trained}),
        "train_sessions": sorted({r.session or "1" for r in trained}),
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
    }


def _units(source: RecordingSource) -> dict[str, str]:
    """The unit of samples, where it is not volts."""
    units = getattr(source, "units", "V")  # sources that do not say record volts
    return {} if units == "V" else {"units": units}


def _baselines(detector: SlipDetector) -> dict[str, Scorer]:
    """The methods that the paper argues against, on the detector's hand, filter and bins."""
    if not detector.pool.hand.fast:
        return {}
    return {
        name.replace("_", " "): BaselineDetector(name, detector.pool, detector.channel_filter)
        for name in get_args(BaselineName)
    }


def export_fold(detector: SlipDetector, folder: Path) -> dict[str, dict[str, float] | str]:
    """Write the ONNX files; by graph their error, or why there is none: nothing learned is lost."""
    kinds: list[GraphKind] = ["bin", "stream"] if KEY in detector.info else ["bin"]
    found: dict[str, dict[str, float] | str] = {}
    for kind in kinds:
        try:
            paths = export_detector(detector, folder, [kind], source=folder / "detector.pt")
            written = read_sidecar(paths[0])
            error, size = written["check"]["worst_sd"], written["onnx_bytes"]
            found[kind] = {"error": error, "bytes": size}
        except Exception as error:  # of onnxruntime they have no base in common
            log.exception("the %s graph was not written", kind)
            found[kind] = (str(error) or type(error).__name__).splitlines()[0]
    return found


def _checkpoint(given: str | None, fold: Split) -> Path | None:
    """The checkpoint to resume: the file given, or that of the run folder given, if it got so far.

    Raises:
        FileNotFoundError: if there is nothing at the path.
    """
    if given is None:
        return None
    path = Path(given)
    if not path.exists():
        raise FileNotFoundError(f"no checkpoint or run folder at {path}")
    if path.is_file():
        return path
    found = [path / fold.name / "last.ckpt", path / "last.ckpt"]
    return next((candidate for candidate in found if candidate.is_file()), None)
