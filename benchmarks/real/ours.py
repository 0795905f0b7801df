"""Ours in a fold, by the same parts as ``train``: survey, plan, pass, solve, and a detector."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.windows import Array, Windows
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.training.fitting import TrainingPass
from tactslip_torch.training.recipe import Recipe
from tactslip_torch.training.selection import plan_detector

_AT_ONCE = 64


def pool_rows(windows: Windows) -> tuple[Array, float]:
    """The whole pool of every window ``[N, F]``, float32, and the seconds that one took."""
    samples, extractor = torch.from_numpy(windows.samples), windows.maker.extractor
    extractor(samples[:_AT_ONCE])  # compiles
    started = time.perf_counter()
    with torch.no_grad():
        rows = torch.cat([extractor(part).float() for part in samples.split(_AT_ONCE)])
    return rows.numpy(), (time.perf_counter() - started) / len(samples)


def ours(
    windows: Windows,
    recipe: Recipe,
    rows: Array,
    rows_s: float,
    detectors: dict[tuple[str, ...], SlipDetector] | None = None,
) -> Method:
    """The machine of a recipe.

    Args:
        windows: all.
        recipe: how it is made.
        rows: of ``pool_rows``.
        rows_s: likewise.
        detectors: keeps that of each fold, by training objects.
    """
    fit = partial(_fit, windows, recipe, detectors)
    return Method(f"ours, recipe={recipe.name}", rows, rows_s, fit)


def detector_of(windows: Windows, recipe: Recipe, training: Training) -> SlipDetector:
    """The detector that ``train`` makes of these windows."""
    pool = windows.maker.pool
    allowed = recipe.allowed(pool)
    parts = list(_by_recording(windows, training))
    survey = Survey(len(pool.names), recipe.sample_bins)
    for place, features, is_slip in parts:
        recording = windows.recordings[place]
        survey.update(str(recording), recipe.group(recording), features, is_slip)
    options: dict[str, Any] = {"allowed": allowed, "pool": pool, "is_nested": False}
    plan = plan_detector(recipe, survey, _quietly, **options)
    gathered = TrainingPass(plan)
    for place, features, is_slip in parts:
        gathered.update(str(windows.recordings[place]), features, is_slip)
    head = gathered.solve()
    return SlipDetector(
        pool,
        windows.maker.channel_filter,
        plan.frame.selected,
        plan.frame.scaler,
        head,
        {"penalty": plan.penalty, "calibration": plan.calibration, "kernel": plan.kernel.to_dict()},
        plan.typical,
        plan.gaussians,
        plan.frame.pooling,
    )


def _fit(
    windows: Windows,
    recipe: Recipe,
    detectors: dict[tuple[str, ...], SlipDetector] | None,
    training: Training,
) -> Fitted:
    detector = detector_of(windows, recipe, training)
    if detectors is not None:
        detectors[training.fold] = detector
    selected = list(detector.selected)

    def decide(rows: Array) -> Array:
        with torch.no_grad():
            return detector.score_features(torch.from_numpy(rows[:, selected]).double()).numpy()

    def judge(samples: Array) -> Array:
        with torch.no_grad():
            return detector.judge(torch.from_numpy(samples)).score.numpy()

    names = detector.selected_names
    chosen = {
        "features": len(names),
        "pooled": sum(name.is_pooled for name in names),
        "degree": detector.info["kernel"].get("degree"),
        "C": detector.info["penalty"],
    }
    return Fitted(decide, judge, chosen)


def _by_recording(windows: Windows, training: Training) -> Iterable[tuple[int, Tensor, Tensor]]:
    for place in np.unique(training.recording).tolist():
        mine = training.recording == place
        yield place, torch.from_numpy(training.rows[mine]), torch.from_numpy(training.is_slip[mine])


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
