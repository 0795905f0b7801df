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
from typing import Any

import lightning as L
from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingSource
from tactslip_torch.data.splits import Split, have_same_bins
from tactslip_torch.features.pooling import pooled_names
from tactslip_torch.report.results import print_results, write_results
from tactslip_torch.runtime import is_first_process
from tactslip_torch.training.alarm import CalibratedAlarm, DebouncedAlarm
from tactslip_torch.training.datamodule import SlipDataModule
from tactslip_torch.training.experiment import (
    combined,
    common_metadata,
    feature_cache,
    feature_maker,
    feature_rows,
    run_fold,
    save_config,
    tune_fold,
)
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.plan import Abstaining
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.tuning import Tuning

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
    abstaining = Abstaining(config.coverage, config.coverage_by)
    alarming: CalibratedAlarm | DebouncedAlarm | None
    alarming = instantiate(config.onset, _convert_="all") or None
    tuning: Tuning | None = instantiate(config.tuning, _convert_="all") or None
    if config.trainer.get("fast_dev_run"):
        tuning = None  # a batch has no materials to hold out
    if config.statistics:
        recipe.check_quadratic("statistics=true")
    if config.ckpt_path is not None and (config.statistics or tuning):
        raise ValueError(
            f"{'statistics=true' if config.statistics else 'tuning'} needs the first pass, which "
            "ckpt_path skips; train without ckpt_path (features come from the cache)"
        )
    if tuning is not None:
        for fold in folds:
            tuning.check(recipe, fold)
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
                abstaining=abstaining,
                with_baselines=config.baselines,
            )
            found: dict[str, Any] | None = None
            if tuning is not None:
                learner, found = tune_fold(config, place, data, learner, tuning)
            fold_metrics[fold.name] = run_fold(config, place, data, learner, alarming, found)
    metrics = common_metadata(source, pool, config) | combined(
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


main = entry_point("train", train)

if __name__ == "__main__":
    main()
