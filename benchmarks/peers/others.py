"""TSFEL, which makes other features of the same bins.

Imported when first used, with their warnings kept to themselves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


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
