"""TSFEL, which makes other features of the same bins; and MiniRocket of them, then ridge.

MiniRocket is among the strongest general classifiers of time series that fit in seconds; aeon makes
its convolutions. Both are imported when first used, with their warnings kept to themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from sklearn.linear_model import RidgeClassifier, RidgeClassifierCV
from sklearn.metrics import balanced_accuracy_score
from sklearn.preprocessing import StandardScaler

Array = NDArray[Any]
ALPHAS = np.logspace(-3, 5, 17)


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


def fit(
    windows: Array,
    is_slip: Array,
    groups: Array | None = None,
    *,
    seed: int = 0,
    num_kernels: int = 10_000,
) -> Callable[[Array], Array]:
    """MiniRocket and ridge fitted to windows with balanced classes: what scores windows.

    Args:
        windows: in any unit; a window's own scale matters.
        is_slip: bool.
        groups: what is left out together to choose the penalty, such as materials; by default it
            is chosen by leaving out single windows.
        seed: of the kernels.
        num_kernels: about as many features.

    Shape:
        - windows: ``[N, C, T]``; is_slip, groups: ``[N]``
        - output: ``[N]`` of the result; at least 0 means slip
    """
    rocket = mini_rocket(windows, 1, num_kernels, seed)
    with quiet():
        scaler = StandardScaler()
        rows = scaler.fit_transform(rocket.transform(_single(windows)))
        if groups is None:
            ridge = RidgeClassifierCV(ALPHAS, class_weight="balanced").fit(rows, is_slip)
        else:
            alpha = _best_alpha((rows @ rows.T).astype(np.float64), is_slip, groups)
            ridge = RidgeClassifier(alpha, class_weight="balanced").fit(rows, is_slip)

    def score(windows: Array) -> Array:
        with quiet():
            rows = scaler.transform(rocket.transform(_single(windows)))
            found: Array = ridge.decision_function(rows)
        return found

    return score


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
        from aeon.transformations.collection.convolution_based import MiniRocket

        numba.config.THREADING_LAYER = "workqueue"  # that by OpenMP sets the threads of torch too
        transform = MiniRocket(n_kernels=num_kernels, n_jobs=threads, random_state=seed)
        transform.fit(_single(windows))
        transform.transform(_single(windows[:2]))
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
