"""Train and evaluate a detector: ``python -m tactslip_torch.train +exp=unseen4``.

Simulates (or reads) the recordings, makes features, selects, solves, tests, and leaves
``metrics.json``, ``detector.pt``, ``model.onnx`` (and ``stream.onnx`` where an alarm was set),
figures, logs and the resolved configuration in ``outputs/<name>/<time>``. ``--help`` and
``--cfg job`` show what can be set.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any, get_args

import lightning as L
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Checkpoint
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split, have_same_bins
from tactslip_torch.deploy.check import GraphKind
from tactslip_torch.deploy.export import export_detector, read_sidecar
from tactslip_torch.features.pooling import pooled_names
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.baselines import BaselineDetector, BaselineName
from tactslip_torch.onset.decisions import KEY, Scorer, calibration_of
from tactslip_torch.package_files import read_checkpoint
from tactslip_torch.report.results import print_results, write_results
from tactslip_torch.runtime import is_first_process, whole_file
from tactslip_torch.training.alarm import CalibratedAlarm, DebouncedAlarm
from tactslip_torch.training.datamodule import SlipDataModule, training_origin
from tactslip_torch.training.experiment import (
    common_metadata,
    feature_cache,
    feature_maker,
    feature_rows,
    make_trainer,
    merged_results,
    write_tensorboard,
)
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import Recipe

log = logging.getLogger(__name__)


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Run an experiment and write its results.

    Args:
        config: composed from ``conf/train.yaml``.
        folder: where results go.

    Returns:
        Accuracy and balanced accuracy of each role, such as ``"unseen/accuracy"``; of folds that
        share bins each its own, such as ``"protocol/unseen/accuracy"``.

    Raises:
        ValueError: for bad input, in one line.
    """
    started = time.perf_counter()
    if not isinstance(config.seed, int):
        raise ValueError(f"seed must be a whole number, got {config.seed!r}")
    L.seed_everything(config.seed, verbose=False)
    source: RecordingSource = instantiate(config.data, _convert_="all")
    rule: LabelRule = instantiate(config.labels)
    recipe: Recipe = instantiate(config.recipe, _convert_="all")
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    maker = feature_maker(source, rule, **config.features)
    pool = maker.pool
    recipe.check_pool(len(pool.names))
    alarming: CalibratedAlarm | DebouncedAlarm | None
    alarming = instantiate(config.onset, _convert_="all") or None
    if isinstance(alarming, CalibratedAlarm) and len(folds) > 1:
        raise ValueError(
            f"onset=alarms sets the alarm of one detector, this split makes {len(folds)}; take "
            "split=unseen4 or split=seen6, or onset=debounced"
        )
    if isinstance(alarming, DebouncedAlarm):
        alarming.hop_samples(pool.sample_rate_hz, pool.bin_samples)  # refused before the fit
    is_first = is_first_process()
    if is_first:
        save_config(config, folder)
    fold_metrics: dict[str, dict[str, Any]] = {}
    with feature_cache(config.cache) as maker.cache:
        for fold in folds:
            place = folder if len(folds) == 1 else folder / fold.name
            data = SlipDataModule(maker, fold, config.num_workers)
            learner = SlipLearner(
                pool,
                maker.channel_filter,
                recipe,
                with_baselines=config.baselines,
            )
            fold_metrics[fold.name] = _run_fold(config, place, data, learner, alarming)
    metrics = common_metadata(source, pool, config) | _combined(
        fold_metrics, by_fold=have_same_bins(folds)
    )
    metrics["timing_s"]["total"] = time.perf_counter() - started
    names = list(pool.names)
    if recipe.pooling is not None:
        names += pooled_names(source.hand, pool.names, recipe.pooling)
    by_name = {str(name): name for name in names}
    rows = feature_rows([by_name[name] for name in metrics["selected"]], source.hand)
    if is_first:
        write_results(folder, metrics, rows)
        write_tensorboard(folder, config, metrics)
        print_results(metrics, rows)
        print(f"\nresults in {folder}")
    exports = [found for fold in fold_metrics.values() for found in fold["onnx"].values()]
    if problems := [found for found in exports if isinstance(found, str)]:
        raise ValueError(f"an ONNX file was not written, all other results are: {problems[0]}")
    return {
        f"{role}/{name}": scores[name]
        for role, scores in metrics["splits"].items()
        for name in ("accuracy", "balanced_accuracy")
        if scores[name] is not None
    }


def _combined(folds: dict[str, dict[str, Any]], *, by_fold: bool) -> dict[str, Any]:
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


class _SaveAfterFirstPass(Checkpoint):
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


def _run_fold(
    config: DictConfig,
    folder: Path,
    data: SlipDataModule,
    learner: SlipLearner,
    alarming: CalibratedAlarm | DebouncedAlarm | None,
) -> dict[str, Any]:
    """Fit, test, set the alarm of, save and export one fold; what it found.

    Args:
        config: of the experiment.
        folder: of its results.
        data: of the fold.
        learner: of its detector.
        alarming: the stage after the fit.
    """
    trainer = make_trainer(config.trainer, folder, [_SaveAfterFirstPass(folder)])
    checkpoint = _checkpoint(config.ckpt_path, data.split)
    if checkpoint is not None:
        log.info("resumes %s: its first pass is not repeated", checkpoint)
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
    onnx: dict[str, dict[str, float] | str] = {}
    alarm: dict[str, Any] = {}
    if getattr(trainer, "fast_dev_run", False):
        alarming = None  # hours of streams are no quick look
    if trainer.is_global_zero and alarming is not None:
        detector.save(folder / "detector.pt")  # what was fitted stays, whatever comes
        if isinstance(alarming, CalibratedAlarm):
            alarm = alarming(detector, _baselines(detector), config.num_workers)
        elif calibration_of(detector) is None:
            log.warning(
                "no alarm is set, so that detect and stream.onnx do not work on this detector: "
                "onset=debounced needs scores of validation; give several recipe.penalties"
            )
        else:
            alarming(detector)
    told = time.perf_counter()
    if trainer.is_global_zero:
        detector.save(folder / "detector.pt")
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
        "recording_events": learner.events,  # for _combined
        **learner.metadata,
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


def _origin(config: DictConfig, data: SlipDataModule) -> dict[str, Any]:
    """What a detector says of where it comes from."""
    settings = {"experiment": config.name, "seed": config.seed}
    origin = training_origin(data.maker.source, data.split)
    return origin | settings | {"features_dtype": config.features.dtype}


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
    """The checkpoint to resume: the file given, or that of the fold in the run folder given.

    A fold that a run of several did not reach starts anew.

    Raises:
        FileNotFoundError: if there is nothing at the path, or in the folder no checkpoint at all.
        ValueError: if it is none, or damaged.
    """
    if given is None:
        return None
    path = Path(given)
    if path.is_dir():
        found = [path / fold.name / "last.ckpt", path / "last.ckpt"]
        if not any(path.glob("*/last.ckpt")) and not found[1].exists():
            raise FileNotFoundError(
                f"no last.ckpt in {path}: a run writes it after its first pass; train without "
                "ckpt_path (features come from the cache)"
            )
        existing = [candidate for candidate in found if candidate.exists()]
        if not existing:
            log.warning("no checkpoint of %s in %s: it starts anew", fold.name, path)
            return None
        path = existing[0]
    read_checkpoint(path)
    return path


def _saved(config: DictConfig, folder: Path, again: str) -> str:
    """What a stopped run leaves, and how to go on."""
    kept = sorted(folder.rglob("last.ckpt"))
    if kept:
        where = ", ".join(str(path) for path in kept)
        return f"the first pass is saved in {where}; resume it: {again} ckpt_path={folder}"
    where = "lost" if config.cache in ("off", False) else "in the cache"
    return f"no pass is finished, the features made so far are {where}; start again: {again}"


main = entry_point("train", train, _saved)
