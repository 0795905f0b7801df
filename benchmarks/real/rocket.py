"""MiniRocket and MultiRocketHydra with ridge, whose penalty is chosen by objects left out."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.peers.others import quiet
from benchmarks.peers.rockets import (
    MINI_ROCKET,
    convolve,
    predictor,
    ridge_by_groups,
)
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.sizes import Sizes
from benchmarks.real.windows import Windows


def rocket(windows: Windows, name: str, seed: int, sizes: Sizes) -> Method:
    """Features by random convolutions, scaled, and ridge that chooses its penalty in a way."""
    rows = windows.samples.astype(np.float32)
    return Method(f"{name}, seed {seed}", rows, 0.0, partial(_fit, name, seed, sizes))


def _fit(name: str, seed: int, sizes: Sizes, training: Training) -> Fitted:
    is_mini = name == MINI_ROCKET
    kernels = sizes.rocket_kernels if is_mini else sizes.multi_rocket_kernels
    convolved = convolve(training.rows, name, seed, kernels, sizes.hydra_groups)
    with quiet():
        rows = convolved.transform(training.rows)
        ridge, alpha = ridge_by_groups(
            rows, training.is_slip, training.objects, convolved.is_scaled
        )
    made = predictor(convolved, ridge, alpha)
    return Fitted(made.score, made.score, {"alpha": alpha})
