"""Long signals as the few points that a line on a page can show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def envelope(values: Array, num_stretches: int) -> tuple[NDArray[np.int64], Array]:
    """The least and the greatest sample of each of ``num_stretches`` stretches, in order of time.

    A line through them looks like the line through all samples, and no burst is lost. Signals of
    at most twice as many samples come back whole. Samples that are not finite count only where a
    stretch has no others, and are NaN then: a gap.

    Shape:
        - values: ``[C, T]``
        - output: indices into ``T`` and values there, both ``[C, M]``
    """
    num_channels, num_samples = values.shape
    finite = np.where(np.isfinite(values), values, np.nan)
    if num_samples <= 2 * num_stretches:
        return np.tile(np.arange(num_samples), (num_channels, 1)), finite
    size = -(-num_samples // num_stretches)
    starts = np.arange(0, num_samples, size)
    missing = np.full((num_channels, len(starts) * size - num_samples), np.nan)
    cut = np.concatenate([finite, missing], axis=1).reshape(num_channels, len(starts), size)
    gap = np.isnan(cut)
    least = np.where(gap, np.inf, cut).argmin(axis=2)
    greatest = np.where(gap, -np.inf, cut).argmax(axis=2)
    places = np.sort(np.stack([least, greatest], axis=2), axis=2) + starts[None, :, None]
    indices = places.reshape(num_channels, -1)
    return indices, np.take_along_axis(finite, indices, axis=1)
