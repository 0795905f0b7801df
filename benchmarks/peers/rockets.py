"""MiniRocket, and MultiRocket with Hydra: random convolutions of windows, then ridge.

The strongest general classifiers of time series that fit in seconds. The penalty of the ridge is
chosen by leaving groups out, such as materials or objects, unless said otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import eigh

from benchmarks.peers.others import Array, mini_rocket, quiet
from benchmarks.real.inner import best_choice
from benchmarks.real.ridge import balanced_weights, ridge_scores

ALPHAS = np.logspace(-3, 5, 17)
MINI_ROCKET = "MiniRocket"
MULTI_ROCKET_HYDRA = "MultiRocketHydra"
_CONVOLUTIONS = "aeon.transformations.collection.convolution_based"
Score = Callable[[Array], Array]


class Predictor(NamedTuple):
    """A fitted classifier of windows.

    Attributes:
        score: of windows ``[N, C, T]``, ``[N]``; at least 0 means slip.
        alpha: penalty of the ridge.
    """

    score: Score
    alpha: float


class Convolved(NamedTuple):
    """Features of windows.

    Attributes:
        transform: from windows ``[N, C, T]`` to rows ``[N, F]``.
        is_scaled: whether rows are scaled already; if not, ridge standardises them.
    """

    transform: Score
    is_scaled: bool


def fit(
    windows: Array,
    is_slip: Array,
    groups: Array,
    *,
    name: str = MINI_ROCKET,
    seed: int = 0,
    num_kernels: int | None = None,
) -> Predictor:
    """Fit a classifier of windows, its penalty chosen by leaving groups out.

    Args:
        windows: in any unit; a window's own scale matters.
        is_slip: bool.
        groups: what is left out together, such as materials.
        name: ``MINI_ROCKET`` or ``MULTI_ROCKET_HYDRA``.
        seed: of the kernels.
        num_kernels: of MiniRocket or MultiRocket; their authors' by default.

    Shape:
        - windows: ``[N, C, T]``; is_slip, groups: ``[N]``
    """
    convolved = convolve(windows, name, seed, num_kernels)
    with quiet():
        rows = convolved.transform(windows)
        ridge, alpha = ridge_by_groups(rows, is_slip, groups, convolved.is_scaled)
    return predictor(convolved, ridge, alpha)


def predictor(convolved: Convolved, ridge: Any, alpha: float) -> Predictor:
    """From windows to scores by features and a fitted ridge."""

    def score(windows: Array) -> Array:
        with quiet():
            found: Array = ridge.decision_function(convolved.transform(windows))
        return found

    return Predictor(score, alpha)


def convolve(
    windows: Array, name: str, seed: int = 0, num_kernels: int | None = None, num_groups: int = 64
) -> Convolved:
    """Features fitted to training windows ``[N, C, T]``, without labels.

    Args:
        windows: of training.
        name: ``MINI_ROCKET`` or ``MULTI_ROCKET_HYDRA``.
        seed: of the kernels.
        num_kernels: of MiniRocket or MultiRocket; their authors' by default.
        num_groups: of Hydra's kernels, eight each, for every dilation.
    """
    if name == MINI_ROCKET:
        made = mini_rocket(windows, 1, num_kernels or 10_000, seed)
        return Convolved(lambda x: np.asarray(made.transform(_single(x))), False)
    return Convolved(_multi_rocket_hydra(windows, seed, num_kernels or 6_250, num_groups), True)


def _multi_rocket_hydra(windows: Array, seed: int, num_kernels: int, num_groups: int) -> Score:
    """As aeon's ``MultiRocketHydraClassifier``: both transforms, each with a scaler of its own."""
    from sklearn.preprocessing import StandardScaler

    threads = torch.get_num_threads()
    with quiet(), torch.random.fork_rng([]):
        import numba

        numba.config.THREADING_LAYER = "workqueue"  # that by OpenMP sets the threads of torch too
        convolutions = import_module(_CONVOLUTIONS)
        hydra = import_module(f"{_CONVOLUTIONS}._hydra").HydraTransformer(
            n_groups=num_groups, random_state=seed
        )
        rocket = convolutions.MultiRocket(n_kernels=num_kernels, random_state=seed)
        x = _single(windows)
        counts = hydra.fit_transform(x)
        torch.set_num_threads(threads)  # which Hydra sets
        of_hydra = import_module("aeon.classification.convolution_based._hydra")._SparseScaler()
        of_hydra.fit(counts)
        of_rocket = StandardScaler().fit(rocket.fit_transform(x))

    def transform(others: Array) -> Array:
        x = _single(others)
        with quiet():
            counts = of_hydra.transform(hydra.transform(x)).numpy()
            values = of_rocket.transform(rocket.transform(x))
        return np.concatenate([counts, values], 1, dtype=np.float32)

    return transform


def ridge_by_groups(
    rows: Array, is_slip: Array, groups: Array, is_scaled: bool = False
) -> tuple[Any, float]:
    """Ridge on rows ``[n, F]``, its penalty by leaving each group out, and that penalty."""
    from sklearn.linear_model import RidgeClassifier

    products = (rows @ rows.T).astype(np.float64) if is_scaled else None

    def trial(train: Array, held: Array) -> list[Array]:
        if products is None:
            return list(ridge_scores(rows[train], is_slip[train], rows[held], ALPHAS))
        parts = products[np.ix_(train, train)], products[np.ix_(held, train)]
        return list(ridge_scores_of_products(*parts, is_slip[train], ALPHAS))

    best, _ = best_choice(trial, is_slip, groups, len(set(groups.tolist())))
    made = scaled(RidgeClassifier(ALPHAS[best], class_weight="balanced"), is_scaled)
    return made.fit(rows, is_slip), float(ALPHAS[best])


def ridge_scores_of_products(products: Array, known: Array, is_slip: Array, alphas: Array) -> Array:
    """Ridge regression to +-1 with balanced classes, from inner products of rows alone.

    As ``RidgeClassifier(class_weight="balanced")``; rows are centred, not scaled.

    Args:
        products: of training rows.
        known: of other rows with those.
        is_slip: of training rows, bool.
        alphas: penalties, positive; the intercept has none.

    Shape:
        - products: ``[n, n]``; known: ``[m, n]``; is_slip: ``[n]``; alphas: ``[A]``
        - output: ``[A, m]``; at least 0 means slip
    """
    target, weight = np.where(is_slip, 1.0, -1.0), balanced_weights(is_slip)
    middle = products @ (weight / weight.sum())  # with the weighted mean of rows
    level = middle @ (weight / weight.sum())
    away = known @ (weight / weight.sum())
    root = np.sqrt(weight)
    centred = (products - middle - middle[:, None] + level) * root * root[:, None]
    values, vectors = eigh(centred, driver="evd")
    wanted = vectors.T @ (root * target)  # balanced: the weighted mean of targets is 0
    others = (known - middle - away[:, None] + level) * root @ vectors
    return np.stack([others @ (wanted / (values.clip(0) + alpha)) for alpha in alphas])


def scaled(ridge: Any, is_scaled: bool = False) -> Any:
    """It, with a ``StandardScaler`` before it unless rows are scaled already."""
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    return make_pipeline(*([] if is_scaled else [StandardScaler()]), ridge)


def _single(windows: Array) -> Array:
    return np.ascontiguousarray(windows, dtype=np.float32)
