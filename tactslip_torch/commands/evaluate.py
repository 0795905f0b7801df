"""Evaluate a saved detector: ``tactslip evaluate FOLDER model=detector.pt``.

Prints the tables and writes the figures that ``train`` does, for any set, labels and split. Says so
where recordings the detector was trained on are among those it is evaluated on. Recordings that
several folds hold out count once.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split, evaluated_once
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report.results import print_results, write_results
from tactslip_torch.runtime import is_first_process
from tactslip_torch.training.datamodule import SlipDataModule
from tactslip_torch.training.evaluation import merged_results
from tactslip_torch.training.experiment import (
    common_metadata,
    feature_cache,
    feature_rows,
    features_of,
    make_trainer,
)
from tactslip_torch.training.learner import SlipLearner


def evaluate(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Evaluate the detector of ``config.model`` and write the results.

    Args:
        config: composed from ``conf/evaluate.yaml``.
        folder: where results go.

    Returns:
        The content of ``metrics.json``.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector.
    """
    started = time.perf_counter()
    detector = SlipDetector.load(config.model)
    source: RecordingSource = instantiate(config.data, _convert_="all")
    rule: LabelRule = instantiate(config.labels)
    units, own = getattr(source, "units", "V"), detector.info.get("units", "V")
    if units != own:
        raise ValueError(
            f"the recordings are in {units}, the detector was trained on {own}; give recordings in "
            f"{own}, or data.units={own} if they are"
        )
    folds: list[Split] = instantiate(config.split, _convert_="all")(source.ids)
    overlaps = {fold.name: overlap(detector, source, fold) for fold in folds}
    if is_first_process():
        save_config(config, folder)
        for fold in folds:
            _print_overlap(fold, overlaps[fold.name])
    results: dict[str, dict[str, Any]] = {}
    events: dict[str, Any] = {}
    once = evaluated_once(folds)
    with feature_cache(config.cache) as cache:
        maker = features_of(detector, source, rule, cache)
        data = SlipDataModule(maker, once, config.num_workers)
        for data.fold in once:
            learner = SlipLearner(maker.pool, maker.channel_filter, detector=detector)
            place = folder if len(once) == 1 else folder / data.fold.name  # each its own logs
            make_trainer(config.trainer, place).test(learner, datamodule=data, verbose=False)
            results[data.fold.name], events[data.fold.name] = learner.metrics, learner.events
    metrics = common_metadata(maker, config) | merged_results(results, events)
    if not metrics["splits"]:
        raise ValueError("no recording has a label, so nothing can be counted; detect needs none")
    metrics |= {
        "selected": [str(name) for name in detector.selected_names],
        "timing_s": {"total": time.perf_counter() - started},
        "overlap": overlaps,
        "detector": detector.info,
    }
    rows = feature_rows(detector.selected_names, source.hand)
    if is_first_process():
        write_results(folder, metrics, rows)
        print_results(metrics, rows)
        print(f"\nresults in {folder}")
    return metrics


def overlap(detector: SlipDetector, source: RecordingSource, fold: Split) -> dict[str, list[str]]:
    """What a fold holds out that the detector was trained on: recordings, and materials.

    Recordings are compared by everything that determines them, not by name.
    """
    known = set(detector.info.get("train_recordings", {}).values())
    held_out = fold.having("test", "unseen")
    materials = {recording.material for recording in fold.having("unseen")}
    return {
        "recordings": [str(r) for r in held_out if cache_key(source.key(r)) in known],
        "unseen_materials": sorted(materials & set(detector.info.get("train_materials", []))),
    }


def _print_overlap(fold: Split, trained_on: dict[str, list[str]]) -> None:
    for what, names in trained_on.items():
        if names:
            print(
                f"note: the detector was trained on {len(names)} {what.replace('_', ' ')} that "
                f"{fold.name} holds out (such as {names[0]}): not a held-out score"
            )


main = entry_point("evaluate", evaluate)
