"""MiniRocket and MultiRocketHydra with ridge, whose penalty is chosen by windows or by objects."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from benchmarks.peers.others import quiet
from benchmarks.peers.rockets import (
    MINI_ROCKET,
    MULTI_ROCKET_HYDRA,
    convolve,
    predictor,
    ridge_by_groups,
    ridge_by_windows,
)
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.sizes import Sizes
from benchmarks.real.windows import Windows

BY_WINDOWS = "MiniRocket, ridge by windows"
"""Leaves single windows out, as its authors do and ``RidgeClassifierCV`` of itself."""
BY_OBJECTS = "MiniRocket, ridge by objects"
"""Leaves training objects out, as ours and the other baselines do."""
HYDRA_BY_OBJECTS = "MultiRocketHydra, ridge by objects"
"""Likewise."""
WAYS: Mapping[str, str] = {
    BY_WINDOWS: MINI_ROCKET,
    BY_OBJECTS: MINI_ROCKET,
    HYDRA_BY_OBJECTS: MULTI_ROCKET_HYDRA,
}
"""Whose features each has."""


def rocket(windows: Windows, way: str, seed: int, sizes: Sizes) -> Method:
    """Features by random convolutions, scaled, and ridge that chooses its penalty in a way."""
    rows = windows.samples.astype(np.float32)
    return Method(f"{way}, seed {seed}", rows, 0.0, partial(_fit, way, seed, sizes))


def _fit(way: str, seed: int, sizes: Sizes, training: Training) -> Fitted:
    is_mini = WAYS[way] == MINI_ROCKET
    kernels = sizes.rocket_kernels if is_mini else sizes.multi_rocket_kernels
    convolved = convolve(training.rows, WAYS[way], seed, kernels, sizes.hydra_groups)
    with quiet():
        rows, told = convolved.transform(training.rows), training.is_slip
        if way == BY_WINDOWS:
            ridge, alpha = ridge_by_windows(rows, told, convolved.is_scaled)
        else:
            ridge, alpha = ridge_by_groups(rows, told, training.objects, convolved.is_scaled)
    made = predictor(convolved, ridge, alpha)
    return Fitted(made.score, made.score, {"alpha": alpha})
