"""Train and evaluate a detector: ``python -m tactslip_torch.train +exp=unseen4``.

Makes features of recordings, selects, solves, tests, and leaves ``metrics.json``, ``detector.pt``,
``model.onnx`` (and ``stream.onnx`` where an alarm was set), figures, logs and the resolved
configuration in ``outputs/<name>/<time>``.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import ROLES
from tactslip_torch.deploy.check import GraphKind
from tactslip_torch.deploy.export import export_detector, read_sidecar
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import KEY
from tactslip_torch.report.results import print_results, write_results
from tactslip_torch.runtime import is_first_process
from tactslip_torch.training.alarm import CalibratedAlarm, DebouncedAlarm
from tactslip_torch.training.bins import SampledBins
from tactslip_torch.training.experiment import (
    Experiment,
    common_metadata,
    feature_maker,
    make_trainer,
    run_experiment,
    write_tensorboard,
)
from tactslip_torch.training.recipe import General, Paper, Recipe
from tactslip_torch.training.refit import BINS, KeptBins

log = logging.getLogger(__name__)

_NO_ALARM = (
    "no alarm is set, so that detect and stream.onnx do not work on this detector: "
    "onset=debounced needs scores of recordings left out"
)
_OF_A_HAND = (
    *("pattern", "labels", "rename", "channels", "kind", "adapting", "units"),
    *("skip_s", "slide_s"),
)
"""Settings of ``data`` that are the same for all recordings of a hand."""


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
    experiment = replace(_experiment(config), after_save=partial(save_config, config, folder))
    found = run_experiment(experiment, folder)
    metrics = common_metadata(experiment.maker, config) | found
    metrics["timing_s"]["total"] = time.perf_counter() - started
    features = metrics.pop("features")
    if is_first_process():
        write_results(folder, metrics, features)
        write_tensorboard(folder, config, metrics)
        print_results(metrics, features)
        print(f"\nresults in {folder}")
    folds = metrics.get("folds", {}).values()
    exports = [graph for fold in (metrics, *folds) for graph in fold.get("onnx", {}).values()]
    if problems := [graph for graph in exports if isinstance(graph, str)]:
        raise ValueError(f"an ONNX file was not written, all other results are: {problems[0]}")
    return {
        f"{role}/{name}": scores[name]
        for role, scores in metrics["splits"].items()
        for name in ("accuracy", "balanced_accuracy")
        if scores[name] is not None
    }


def _experiment(config: DictConfig) -> Experiment:
    """All that a configuration describes, before any work."""
    source = instantiate(config.data, _convert_="all")
    recipe = instantiate(config.recipe, _convert_="all")
    folds = instantiate(config.split, _convert_="all")(source.ids)
    maker = feature_maker(
        source,
        instantiate(config.labels),
        recipe=recipe,
        with_baselines=config.baselines,
        **config.features,
    )
    recipe.allowed(maker.pool)  # refused before any work
    alarm: CalibratedAlarm | DebouncedAlarm | None
    _refuse_simulated_streams(config, source)
    alarm = instantiate(config.onset, _convert_="all") or None
    for key in ("train_on_all", "keep_bins"):
        if type(config[key]) is not bool:
            raise ValueError(f"{key} must be true or false, got {config[key]!r}")
    if isinstance(alarm, CalibratedAlarm) and len(folds) > 1:
        raise ValueError(
            f"onset=alarms sets the alarm of one detector, this split makes {len(folds)}; take "
            "split=unseen4 or split=seen6, or onset=debounced"
        )
    if isinstance(alarm, CalibratedAlarm):  # refused before the fit
        alarm.classifier.evidence(source.hand, source.sample_rate_hz)
    if isinstance(alarm, DebouncedAlarm):
        alarm.hop_samples(maker.pool.sample_rate_hz, maker.pool.bin_samples)
        trained = [{r for fold in folds for r in fold.having(*ROLES)}]
        trained = trained if config.train_on_all else [set(f.having("train")) for f in folds]
        if why := _why_unvalidated(recipe, min(map(len, trained))):
            log.warning("%s: %s", _NO_ALARM, why)
    keep_bins = None
    if config.keep_bins and isinstance(recipe, General):
        keep_bins = partial(_keep_bins, recipe, maker.pool.selected)
    return Experiment(
        maker=maker,
        folds=folds,
        recipe=recipe,
        alarm=alarm and partial(_set_alarm, alarm, source, config.num_workers),
        trainer=partial(make_trainer, config.trainer),
        cache=config.cache,
        metadata={
            "experiment": config.name,
            "seed": config.seed,
            "features_dtype": config.features.dtype,
            **({} if source.is_simulated else _reading_settings(config)),
        },
        num_workers=config.num_workers,
        with_baselines=config.baselines,
        export=_export_fold if config.export else None,
        train_on_all=config.train_on_all,
        keep_bins=keep_bins,
    )


def _refuse_simulated_streams(config: DictConfig, source: RecordingSource) -> None:
    """Refuse an alarm that is calibrated on another hand's simulated recordings."""
    streams = config.onset.get("streams") or {}
    if source.is_simulated or ".simulation." not in str(streams.get("_target_")):
        return
    raise ValueError(
        "onset=alarms is calibrated on simulated recordings, and these are not; leave onset at "
        "debounced, and set the alarm for a rate with tactslip calibrate FOLDER model=RUN/"
        "detector.pt per_hour=5"
    )


def _why_unvalidated(recipe: Recipe, num_recordings: int) -> str | None:
    """Why there will be no scores of recordings left out, which an alarm needs."""
    if num_recordings < 2:
        return "training leaves recordings out for it, and there is one; record another"
    if isinstance(recipe, Paper) and len(recipe.penalties_ascending) < 2:
        return "recipe=paper leaves objects out where it chooses; give several recipe.penalties"
    return None


def _reading_settings(config: DictConfig) -> dict[str, Any]:
    """How recordings are read and labelled, for a detector's ``info``: it reads others so too."""
    plain: Any = OmegaConf.to_container(config, resolve=True)
    data = {key: value for key, value in plain["data"].items() if key in _OF_A_HAND}
    labels = {key: value for key, value in plain["labels"].items() if not key.startswith("_")}
    return {"reading": plain["data"].get("reading") or {}, "data": data, "labels": labels}


def _set_alarm(
    alarm: CalibratedAlarm | DebouncedAlarm,
    source: RecordingSource,
    num_workers: int | None,
    detector: SlipDetector,
) -> dict[str, Any]:
    """Set the alarm of a detector; what its calibration measured."""
    if isinstance(alarm, CalibratedAlarm):
        return alarm(detector, num_workers=num_workers)
    if detector.calibration is None:
        what = f"{detector.info['split']}: {_NO_ALARM}"
        log.warning("%s, or these do not tell slip from non-slip", what)
    else:
        alarm(detector)
        if alarm.classifier is not None:
            alarm.fit(detector, source, num_workers)
    return {}


def _keep_bins(
    recipe: General,
    selected: Sequence[int],
    detector: SlipDetector,
    sample: SampledBins,
    folder: Path,
) -> None:
    """Write the training bins that a refit adds to."""
    KeptBins.of(detector, sample, selected, recipe).save(folder / BINS)


def _export_fold(detector: SlipDetector, folder: Path) -> dict[str, dict[str, float] | str]:
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


def _saved(config: DictConfig, folder: Path, again: str) -> str:
    """What a stopped run leaves, and how to go on."""
    where = "lost" if config.cache in ("off", False) else "in the cache"
    return f"the features made so far are {where}; start it again with the same command: {again}"


main = entry_point("train", train, _saved)
"""``python -m tactslip_torch.train``: the command ``tactslip train``."""
