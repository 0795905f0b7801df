"""TSFEL, which makes other features of the same bins; and random convolutions of them, then ridge.

MiniRocket, and MultiRocket with Hydra, are the strongest general classifiers of time series that
fit in seconds; aeon makes the convolutions. All are imported when first used, with their warnings
kept to themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import eigh
from sklearn.linear_model import RidgeClassifier, RidgeClassifierCV
from sklearn.metrics import balanced_accuracy_score
from sklearn.preprocessing import StandardScaler

Array = NDArray[Any]
ALPHAS = np.logspace(-3, 5, 17)
MINI_ROCKET = "MiniRocket"
MULTI_ROCKET_HYDRA = "MultiRocketHydra"
_CONVOLUTIONS = "aeon.transformations.collection.convolution_based"
Transform = Callable[[Array], Array]


@contextmanager
def quiet() -> Iterator[None]:
    """Warnings of other people's code are not shown, and are no errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with np.errstate(all="ignore"):
            yield


def tsfel_features(sample_rate_hz: float = 2000.0) -> Callable[[Array], Array]:
    """Every feature that TSFEL has, as a function of one bin ``[C, n]``."""
    with quiet():
        import tsfel

        config = tsfel.get_features_by_domain()

    def features(bin_: Array) -> Array:
        with quiet():
            table = tsfel.time_series_features_extractor(
                config, bin_.T, fs=sample_rate_hz, verbose=0
            )
        row: Array = np.asarray(table)[0]
        return row

    return features


class Predictor(NamedTuple):
    """A fitted classifier of windows.

    Attributes:
        score: of windows ``[N, C, T]``, ``[N]``; at least 0 means slip.
        alpha: penalty of the ridge.
    """

    score: Transform
    alpha: float


def fit(
    windows: Array,
    is_slip: Array,
    groups: Array | None = None,
    *,
    name: str = MINI_ROCKET,
    seed: int = 0,
    num_kernels: int | None = None,
    num_groups: int = 64,
) -> Predictor:
    """Fit a classifier of windows with balanced classes.

    Args:
        windows: in any unit; a window's own scale matters.
        is_slip: bool.
        groups: what is left out together to choose the penalty, such as materials; by default it
            is chosen by leaving out single windows.
        name: ``MINI_ROCKET`` or ``MULTI_ROCKET_HYDRA``.
        seed: of the kernels.
        num_kernels: of MiniRocket or MultiRocket; their authors' by default.
        num_groups: of Hydra's kernels, eight each, for every dilation.

    Shape:
        - windows: ``[N, C, T]``; is_slip, groups: ``[N]``
    """
    if name == MINI_ROCKET:
        rocket = mini_rocket(windows, 1, num_kernels or 10_000, seed)
        scaler = StandardScaler().fit(rocket.transform(_single(windows)))
        transform: Transform = lambda x: scaler.transform(rocket.transform(_single(x)))  # noqa: E731
    else:
        transform = _multi_rocket_hydra(windows, seed, num_kernels or 6_250, num_groups)
    with quiet():
        rows = transform(windows)
        if groups is None:
            ridge = RidgeClassifierCV(ALPHAS, class_weight="balanced").fit(rows, is_slip)
            alpha = float(ridge.alpha_)
        else:
            alpha = _best_alpha((rows @ rows.T).astype(np.float64), is_slip, groups)
            ridge = RidgeClassifier(alpha, class_weight="balanced").fit(rows, is_slip)

    def score(windows: Array) -> Array:
        with quiet():
            found: Array = ridge.decision_function(transform(windows))
        return found

    return Predictor(score, alpha)


def mini_rocket(windows: Array, threads: int, num_kernels: int = 10_000, seed: int = 0) -> Any:
    """MiniRocket's transform, fitted and compiled.

    Args:
        windows: ``[N, C, n]``; it takes quantiles of their convolutions.
        threads: of its transform.
        num_kernels: about as many features.
        seed: of what it draws: channels of a kernel, and windows for the quantiles.
    """
    with quiet():
        import numba

        numba.config.THREADING_LAYER = "workqueue"  # that by OpenMP sets the threads of torch too
        transform = import_module(_CONVOLUTIONS).MiniRocket(
            n_kernels=num_kernels, n_jobs=threads, random_state=seed
        )
        transform.fit(_single(windows))
        transform.transform(_single(windows[:2]))
    return transform


def _multi_rocket_hydra(windows: Array, seed: int, num_kernels: int, num_groups: int) -> Transform:
    """As aeon's ``MultiRocketHydraClassifier``: both transforms, each with a scaler of its own."""
    threads = torch.get_num_threads()
    with quiet(), torch.random.fork_rng([]):
        import numba

        numba.config.THREADING_LAYER = "workqueue"
        hydra = import_module(f"{_CONVOLUTIONS}._hydra").HydraTransformer(
            n_groups=num_groups, random_state=seed
        )
        rocket = import_module(_CONVOLUTIONS).MultiRocket(n_kernels=num_kernels, random_state=seed)
        counts = hydra.fit_transform(_single(windows))
        torch.set_num_threads(threads)  # which Hydra sets
        of_hydra = import_module("aeon.classification.convolution_based._hydra")._SparseScaler()
        of_hydra.fit(counts)
        of_rocket = StandardScaler().fit(rocket.fit_transform(_single(windows)))

    def transform(others: Array) -> Array:
        with quiet():
            counts = of_hydra.transform(hydra.transform(_single(others))).numpy()
            values = of_rocket.transform(rocket.transform(_single(others)))
        return np.concatenate([counts, values], 1, dtype=np.float32)

    return transform


def _best_alpha(products: Array, is_slip: Array, groups: Array) -> float:
    """The penalty with the best balanced accuracy, each group left out in turn."""
    scores = np.empty((len(ALPHAS), len(is_slip)))
    for group in np.unique(groups):
        held, train = groups == group, groups != group
        inner, outer = products[np.ix_(train, train)], products[np.ix_(held, train)]
        scores[:, held] = ridge_scores(inner, outer, is_slip[train], ALPHAS)
    accuracies = [balanced_accuracy_score(is_slip, of >= 0) for of in scores]
    return float(ALPHAS[int(np.argmax(accuracies))])


def ridge_scores(products: Array, known: Array, is_slip: Array, alphas: Array) -> Array:
    """Ridge regression to +-1 with balanced classes, from inner products of rows alone.

    As ``RidgeClassifier(class_weight="balanced")``. There are fewer rows than features, so one
    eigendecomposition of their inner products does for all penalties.

    Args:
        products: of training rows.
        known: of other rows with those.
        is_slip: of training rows, bool.
        alphas: penalties, positive; the intercept has none.

    Shape:
        - products: ``[n, n]``; known: ``[m, n]``; is_slip: ``[n]``; alphas: ``[A]``
        - output: ``[A, m]``; at least 0 means slip
    """
    number, target = len(is_slip), np.where(is_slip, 1.0, -1.0)
    weight = np.where(is_slip, number / is_slip.sum(), number / (~is_slip).sum()) / 2
    middle = products @ (weight / weight.sum())  # with the weighted mean of rows
    level = middle @ (weight / weight.sum())
    away = known @ (weight / weight.sum())
    root = np.sqrt(weight)
    centred = (products - middle - middle[:, None] + level) * root * root[:, None]
    values, vectors = eigh(centred, driver="evd")
    wanted = vectors.T @ (root * target)  # balanced: the weighted mean of targets is 0
    others = (known - middle - away[:, None] + level) * root @ vectors
    return np.stack([others @ (wanted / (values.clip(0) + alpha)) for alpha in alphas])


def _single(windows: Array) -> Array:
    return np.ascontiguousarray(windows, dtype=np.float32)
