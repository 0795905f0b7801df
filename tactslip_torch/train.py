"""Train and judge a detector: ``python -m tactslip_torch.train +exp=unseen4``.

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

import hydra
import lightning as L
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.callbacks import Checkpoint
from omegaconf import DictConfig

from tactslip_torch.abstaining import Abstaining
from tactslip_torch.adapting.gathering import check_recipe, gathered_statistics
from tactslip_torch.adapting.statistics import FILE as STATISTICS
from tactslip_torch.alarming.debounced import Debounced
from tactslip_torch.alarming.stage import Alarming
from tactslip_torch.config import (
    conf_dir,
    errors_in_one_line,
    is_first_process,
    one_line,
    run_entry_point,
)
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split, are_rivals
from tactslip_torch.datamodule import SlipDataModule
from tactslip_torch.experiment import (
    common_facts,
    feature_cache,
    feature_parts,
    feature_rows,
    make_trainer,
    save_config,
)
from tactslip_torch.export import export_detector, sidecar_facts, worst_error
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.cache import cache_key
from tactslip_torch.files import whole_file
from tactslip_torch.folds import combined
from tactslip_torch.graph.facts import GraphKind
from tactslip_torch.learning import SlipLearner
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.baselines import BaselineDetector, BaselineName
from tactslip_torch.onset.scoring import Scorer
from tactslip_torch.onset.settings import KEY
from tactslip_torch.recipe import Recipe
from tactslip_torch.report.results import print_results, write_results

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


def train(config: DictConfig, folder: Path) -> dict[str, float]:
    """Run an experiment and write its results.

    Args:
        config: composed from ``conf/train.yaml``.
        folder: where results go.

    Returns:
        Accuracy and balanced accuracy of each role, such as ``"unseen/accuracy"``; of rival folds
        each its own, such as ``"protocol/unseen/accuracy"``.

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
    pool, channel_filter, dtype, engine = feature_parts(source, rule.bin_ms, **config.features)
    recipe.check_pool(len(pool.names))
    if config.statistics:
        _check_statistics(config, recipe)
    abstaining = Abstaining(config.coverage, config.coverage_by)
    alarming: Alarming | Debounced | None = instantiate(config.onset, _convert_="all") or None
    if isinstance(alarming, Alarming) and len(folds) > 1:
        raise ValueError(
            f"onset=alarms sets the alarm of one detector, this split makes {len(folds)}; take "
            "split=unseen4 or split=seen6, or onset=debounced"
        )
    if isinstance(alarming, Debounced):
        alarming.hop_samples(pool.sample_rate_hz, pool.bin_samples)  # refused before the fit
    is_first = is_first_process()
    if is_first:
        save_config(config, folder)
    fold_metrics: dict[str, dict[str, Any]] = {}
    with feature_cache(config.cache) as cache:
        maker = FeatureMaker(source, pool, channel_filter, rule, cache, dtype, engine)
        for fold in folds:
            place = folder if len(folds) == 1 else folder / fold.name
            data = SlipDataModule(maker, fold, config.num_workers)
            learner = SlipLearner(pool, channel_filter, recipe, abstaining=abstaining)
            fold_metrics[fold.name] = _run_fold(config, place, data, learner, alarming)
    metrics = common_facts(source, pool, config) | combined(fold_metrics, are_rivals(folds))
    metrics["timing_s"]["total"] = time.perf_counter() - started
    by_name = {str(name): name for name in pool.names}
    rows = feature_rows([by_name[name] for name in metrics["selected"]], source.hand)
    if is_first:
        write_results(folder, metrics, rows)
        print_results(metrics, rows)
        print(f"\nresults in {folder}")
    exports = [found for fold in fold_metrics.values() for found in fold["onnx"].values()]
    if problems := [found for found in exports if isinstance(found, str)]:
        raise ValueError(f"all else is written: {problems[0]}")
    return {
        f"{role}/{name}": scores[name]
        for role, scores in metrics["splits"].items()
        for name in ("accuracy", "balanced_accuracy")
        if scores[name] is not None
    }


def _run_fold(
    config: DictConfig,
    folder: Path,
    data: SlipDataModule,
    learner: SlipLearner,
    alarming: Alarming | Debounced | None,
) -> dict[str, Any]:
    """Fit, test, set the alarm of, save and export one fold; what it found."""
    source = data.maker.source
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
    trained = data.split.having("train")
    detector.info |= {
        "simulated": source.is_simulated,
        **_units(source),
        "experiment": config.name,
        "seed": config.seed,
        "split": data.split.name,
        "features_dtype": config.features.dtype,
        "train_materials": sorted({recording.material for recording in trained}),
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
    }
    onnx: dict[str, dict[str, float] | str] = {}
    alarm: dict[str, Any] = {}
    if getattr(trainer, "fast_dev_run", False):
        alarming = None  # hours of streams are no quick look
    if trainer.is_global_zero and alarming is not None:
        detector.save(folder / "detector.pt")  # what was fitted stays, whatever comes
        alarm = alarming(detector, _rivals(detector), config.num_workers)
    told = time.perf_counter()
    if trainer.is_global_zero:
        detector.save(folder / "detector.pt")
        if config.statistics:
            _save_statistics(config, learner, detector, data.split, folder / STATISTICS)
        onnx = _export(detector, folder) if config.export else {}
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
        **learner.facts,
        "selected": [str(name) for name in detector.selected_names],
        "onnx": onnx,
        "timing_s": seconds,
        "worker_s": learner.worker_seconds,
    }


def _check_statistics(config: DictConfig, recipe: Recipe) -> None:
    """Refuse before any work what would leave no statistics."""
    check_recipe(recipe)
    if config.ckpt_path is not None:
        raise ValueError(
            "statistics=true needs the first pass, which ckpt_path skips; train without ckpt_path "
            "(features come from the cache)"
        )


def _save_statistics(
    config: DictConfig, learner: SlipLearner, detector: SlipDetector, fold: Split, path: Path
) -> None:
    """What ``adapt`` solves again from, beside the detector."""
    materials = {str(recording): recording.material for recording in fold.having("train")}
    labels = {str(key): value for key, value in config.labels.items() if key != "_target_"}
    gathered_statistics(*learner.gathered, materials, labels, detector).save(path)


def _units(source: RecordingSource) -> dict[str, str]:
    """The unit of samples, where it is not volts."""
    units = getattr(source, "units", "V")  # sources that do not say record volts
    return {} if units == "V" else {"units": units}


def _rivals(detector: SlipDetector) -> dict[str, Scorer]:
    """The methods that the paper argues against, on the detector's hand, filter and bins."""
    if not detector.pool.hand.fast:
        return {}
    return {
        name.replace("_", " "): BaselineDetector(name, detector.pool, detector.channel_filter)
        for name in get_args(BaselineName)
    }


def _export(detector: SlipDetector, folder: Path) -> dict[str, dict[str, float] | str]:
    """Write the ONNX files; by graph their error, or why there is none: nothing learned is lost."""
    kinds: list[GraphKind] = ["bin", "stream"] if KEY in detector.info else ["bin"]
    found: dict[str, dict[str, float] | str] = {}
    for kind in kinds:
        try:
            paths = export_detector(detector, folder, [kind], source=folder / "detector.pt")
            facts = sidecar_facts(paths[0])
            found[kind] = {"error": worst_error(facts), "bytes": facts["onnx_bytes"]}
        except Exception as error:  # of onnxruntime they have no base in common
            log.exception("the %s graph was not written", kind)
            found[kind] = one_line(error).splitlines()[0]
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


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="train")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        train(config, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    run_entry_point(main)
