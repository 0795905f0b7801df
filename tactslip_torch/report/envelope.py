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
    return _of_stretches(values, _stretch_samples(values.shape[1], num_stretches))


def _stretch_samples(num_samples: int, num_stretches: int) -> int:
    return max(1, -(-num_samples // num_stretches))


def _of_stretches(values: Array, size: int) -> tuple[NDArray[np.int64], Array]:
    """The extremes of every ``size`` samples and of the rest; of one or two they are all."""
    num_channels, num_samples = values.shape
    finite = np.where(np.isfinite(values), values, np.nan)
    if size <= 2:
        return np.tile(np.arange(num_samples), (num_channels, 1)), finite
    starts = np.arange(0, num_samples, size)
    missing = np.full((num_channels, len(starts) * size - num_samples), np.nan)
    cut = np.concatenate([finite, missing], axis=1).reshape(num_channels, len(starts), size)
    gap = np.isnan(cut)
    least = np.where(gap, np.inf, cut).argmin(axis=2)
    greatest = np.where(gap, -np.inf, cut).argmax(axis=2)
    places = np.sort(np.stack([least, greatest], axis=2), axis=2) + starts[None, :, None]
    indices = places.reshape(num_channels, -1)
    return indices, np.take_along_axis(finite, indices, axis=1)


class RunningEnvelope:
    """``envelope`` of a signal that comes in pieces; no more is kept than is drawn.

    Args:
        num_channels: C.
        num_samples: T of the whole signal, of which pieces may be missing at its end.
        num_stretches: as of ``envelope``.
    """

    def __init__(self, num_channels: int, num_samples: int, num_stretches: int) -> None:
        self._size = _stretch_samples(num_samples, num_stretches)
        self._rest: Array = np.empty((num_channels, 0))
        self._first = 0
        self._indices: list[NDArray[np.int64]] = [np.empty((num_channels, 0), dtype=np.int64)]
        self._values: list[Array] = [np.empty((num_channels, 0))]

    def add(self, values: NDArray[np.floating]) -> None:
        """Take the next samples, ``[C, n]``; ``n`` may be 0."""
        waiting = np.concatenate([self._rest, values], axis=1)
        whole = waiting.shape[1] // self._size * self._size
        self._take(waiting[:, :whole])
        self._rest = waiting[:, whole:].copy()

    def points(self) -> tuple[NDArray[np.int64], Array]:
        """What ``envelope`` says of all samples so far, the last stretch as far as it came."""
        self._take(self._rest)
        self._rest = self._rest[:, :0]
        return np.concatenate(self._indices, axis=1), np.concatenate(self._values, axis=1)

    def _take(self, values: Array) -> None:
        if values.shape[1]:  # the lists are no longer than there are stretches
            indices, seen = _of_stretches(values, self._size)
            self._indices.append(indices + self._first)
            self._values.append(seen)
            self._first += values.shape[1]
