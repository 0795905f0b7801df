"""Tools that make other features of the same bins: TSFEL, and aeon's MiniRocket with ridge.

Imported when first used, with their warnings kept to themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_MINI_ROCKET = "aeon.transformations.collection.convolution_based"


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
        transform = import_module(_MINI_ROCKET).MiniRocket(
            n_kernels=num_kernels, n_jobs=threads, random_state=seed
        )
        transform.fit(windows.astype(np.float32))
        transform.transform(windows[:2].astype(np.float32))
    return transform


def mini_rocket_ridge(
    windows: Array, targets: Array, threads: int, num_kernels: int = 10_000
) -> Callable[[Array], Array]:
    """Scores by MiniRocket and ridge, as aeon's classifier does it, fitted to +-1.

    Args:
        windows: ``[N, C, n]``.
        targets: ``[N]``.
        threads: of the transform.
        num_kernels: likewise.
    """
    from sklearn.linear_model import RidgeClassifierCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    transform = mini_rocket(windows, threads, num_kernels)
    with quiet():
        ridge = make_pipeline(
            StandardScaler(with_mean=False), RidgeClassifierCV(alphas=np.logspace(-3, 3, 10))
        )
        ridge.fit(transform.transform(windows.astype(np.float32)), targets)

    def scores(windows: Array) -> Array:
        with quiet():
            found: Array = ridge.decision_function(transform.transform(windows))
        return found

    return scores
