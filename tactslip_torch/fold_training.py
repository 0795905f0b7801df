"""One fold of an experiment: fit, tune, test, set the alarm, save and export."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any, get_args

import lightning as L
from lightning.pytorch.callbacks import Checkpoint
from omegaconf import DictConfig

from tactslip_torch.adapting.gathering import check_recipe, gathered_statistics
from tactslip_torch.adapting.statistics import FILE as STATISTICS
from tactslip_torch.alarming.debounced import Debounced
from tactslip_torch.alarming.stage import Alarming
from tactslip_torch.config import (
    one_line,
)
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.datamodule import SlipDataModule
from tactslip_torch.experiment import (
    make_trainer,
)
from tactslip_torch.export import export_detector, sidecar_facts, worst_error
from tactslip_torch.features.cache import cache_key
from tactslip_torch.files import whole_file
from tactslip_torch.graph.facts import GraphKind
from tactslip_torch.learning import SlipLearner
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.baselines import BaselineDetector, BaselineName
from tactslip_torch.onset.scoring import Scorer
from tactslip_torch.onset.settings import KEY
from tactslip_torch.recipe import Recipe, stand_for
from tactslip_torch.report.results import tuning_figure
from tactslip_torch.tuning.second_fit import settled_learner, tuned_maker
from tactslip_torch.tuning.stage import Tuning

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
) -> tuple[SlipDataModule, SlipLearner, dict[str, Any]]:
    """Fit as the recipe says, and learn from there; what the second fit takes, and what was found.

    Detectors of the recipe's choice and of the grid's least loss are judged as the tuned one will
    be, and kept as ``grid.pt`` and ``start.pt``: what is beyond the latter is due to the gradient.
    """
    started = time.perf_counter()
    trainer = make_trainer(config.trainer, folder / "grid")
    if trainer.world_size > 1:
        raise ValueError(
            f"tuning runs in one process, the trainer has {trainer.world_size}; leave out "
            "trainer.devices and trainer.num_nodes, or take tuning=none"
        )
    trainer.fit(first, datamodule=data)
    facts: dict[str, Any] = {"fit_s": time.perf_counter() - started}
    plan, (_, sample) = first.plan, first.gathered
    counts = [float(sample.represents[sample.is_slip == kind].sum()) for kind in (False, True)]
    weights = stand_for(sample, first.recipe, counts)
    tuned = tuning(plan, first.recipe, sample, weights, data.maker, data.split)
    facts |= tuned.facts
    start = facts["start"]
    parts = (data.maker, plan.frame, start["penalty"], start["offset"])
    by_loss = settled_learner(first, *parts)
    other = make_trainer(config.trainer, folder / "start")
    other.fit(by_loss, datamodule=data)
    facts["splits"] = {}
    judged = (("grid", "recipe", trainer, first), ("start", "grid", other, by_loss))
    for name, way, judge, learner in judged:
        judge.test(learner, datamodule=data, verbose=False)
        facts["splits"][way] = learner.metrics["splits"]
        if learner.detector is not None:
            learner.detector.info |= _origin(config, data)
            learner.detector.save(folder / f"{name}.pt")
    simulated = data.maker.source.is_simulated
    tuning_figure(facts, folder / "tuning.png", simulated=simulated)
    maker = tuned_maker(tuned, data.maker)
    learner = settled_learner(first, maker, tuned.frame, tuned.penalty, tuned.offset)
    facts["validation"] = first.facts["validation"]
    return SlipDataModule(maker, data.split, config.num_workers), learner, facts


def run_fold(
    config: DictConfig,
    folder: Path,
    data: SlipDataModule,
    learner: SlipLearner,
    alarming: Alarming | Debounced | None,
    tuned: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Fit, test, set the alarm of, save and export one fold; what it found.

    Args:
        config: of the experiment.
        folder: of its results.
        data: of the fold.
        learner: of its detector.
        alarming: the stage behind the fit.
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
        alarm = alarming(detector, _rivals(detector), config.num_workers)
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
        **learner.facts,
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


def check_statistics(config: DictConfig, recipe: Recipe) -> None:
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


def _rivals(detector: SlipDetector) -> dict[str, Scorer]:
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
