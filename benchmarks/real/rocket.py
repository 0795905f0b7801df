"""MiniRocket and ridge, whose penalty is chosen in two ways: by windows and by objects left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from benchmarks.peers.others import mini_rocket, quiet
from benchmarks.real.inner import best_choice
from benchmarks.real.method import Fitted, Method, Training
from benchmarks.real.ridge import ridge_scores
from benchmarks.real.sizes import Sizes
from benchmarks.real.windows import Array, Windows

ALPHAS = np.logspace(-3, 5, 17)
BY_WINDOWS = "MiniRocket, ridge by windows"
"""Leaves single windows out, as its authors do and ``RidgeClassifierCV`` of itself."""
BY_OBJECTS = "MiniRocket, ridge by objects"
"""Leaves training objects out, as ours and the other rivals do."""

_Ridge = Callable[[Array, Training], tuple[Any, float]]


def rocket(windows: Windows, way: str, seed: int, sizes: Sizes) -> Method:
    """MiniRocket's features, standardised, and ridge that finds its penalty in a way."""
    rows = windows.samples.astype(np.float32)
    return Method(f"{way}, seed {seed}", rows, 0.0, partial(_fit, _WAYS[way], seed, sizes))


def _fit(penalised: _Ridge, seed: int, sizes: Sizes, training: Training) -> Fitted:
    transform = mini_rocket(training.rows, 1, sizes.rocket_kernels, seed)
    with quiet():
        ridge, alpha = penalised(np.asarray(transform.transform(training.rows)), training)

    def judge(samples: Array) -> Array:
        with quiet():
            rows = np.asarray(transform.transform(samples.astype(np.float32)))
            found: Array = ridge.decision_function(rows)
        return found

    return Fitted(judge, judge, {"alpha": alpha})


def ridge_by_windows(rows: Array, training: Training) -> tuple[Any, float]:
    """Ridge on standardised rows ``[n, F]``, and its penalty."""
    from sklearn.linear_model import RidgeClassifierCV

    made = scaled(RidgeClassifierCV(ALPHAS, class_weight="balanced"))
    made.fit(rows, training.is_slip)
    return made, float(made[-1].alpha_)


def ridge_by_objects(rows: Array, training: Training) -> tuple[Any, float]:
    """Likewise."""
    from sklearn.linear_model import RidgeClassifier

    def trial(train: Array, held: Array) -> list[Array]:
        return list(ridge_scores(rows[train], training.is_slip[train], rows[held], ALPHAS))

    most = len(set(training.objects.tolist()))  # each object is left out alone
    best, _ = best_choice(trial, training.is_slip, training.objects, most)
    made = scaled(RidgeClassifier(ALPHAS[best], class_weight="balanced"))
    return made.fit(rows, training.is_slip), float(ALPHAS[best])


def scaled(ridge: Any) -> Any:
    """It, and a ``StandardScaler`` before it."""
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(StandardScaler(), ridge)


_WAYS: Mapping[str, _Ridge] = {BY_WINDOWS: ridge_by_windows, BY_OBJECTS: ridge_by_objects}
