"""What costs most of the features in NumPy: mode, entropy, powers; row by row, and all at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.arrays import EPS, Way

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
TOP_LEVEL = 255


def mode_of_row(ordered: Array, tolerance: float) -> float:
    """First value of the longest run of neighbours no further apart than a tolerance."""
    edges = np.flatnonzero(np.diff(ordered) > tolerance) + 1
    starts = np.concatenate([[0], edges])
    lengths = np.diff(np.concatenate([starts, [len(ordered)]]))
    return float(ordered[starts[lengths.argmax()]])


def entropy_of_row(x: Array) -> float:
    """Entropy of 256 levels, which serve as the edges of NumPy's histogram."""
    level = np.floor(TOP_LEVEL * (x - x.min()) / np.ptp(x) + 0.5 + 1e-9)
    counts, _ = np.histogram(level, bins=np.unique(level))
    share = counts / len(x)
    return float(-(share * np.log2(share + EPS)).sum())


def modes(ordered: Array, tolerance: Array) -> Array:
    """``mode_of_row`` of every row."""
    rank = _rank(np.diff(ordered, axis=-1) > tolerance[..., None])
    last = rank.argmax(-1)[..., None]
    first = last - np.take_along_axis(rank, last, axis=-1)
    return np.take_along_axis(ordered, first, axis=-1)[..., 0]


def entropies(ordered: Array) -> Array:
    """``entropy_of_row`` of every row."""
    low, high = ordered[..., :1], ordered[..., -1:]
    level = np.floor(TOP_LEVEL * (ordered - low) / (high - low) + 0.5 + 1e-9)
    is_new = (np.diff(level, axis=-1) != 0) & (level[..., 1:] != TOP_LEVEL)  # the top one joins
    num = ordered.shape[-1]
    share = np.arange(num + 1) / num
    growth = np.diff(-share * np.log2(share + EPS))
    entropy: Array = growth[_rank(is_new)].sum(-1)
    return entropy


def _rank(is_new: Mask) -> NDArray[np.int64]:
    """Position of each value in its run; ``is_new`` of all but the first."""
    place = np.arange(is_new.shape[-1] + 1)
    start = np.zeros((*is_new.shape[:-1], len(place)), dtype=np.int64)
    np.maximum.accumulate(np.where(is_new, place[1:], 0), axis=-1, out=start[..., 1:])
    return place - start


def _modes_by_row(ordered: Array, tolerance: Array) -> Array:
    rows = zip(ordered.reshape(-1, ordered.shape[-1]), tolerance.ravel(), strict=True)
    return np.array([mode_of_row(*row) for row in rows]).reshape(tolerance.shape)


def _entropies_by_row(ordered: Array) -> Array:
    rows = ordered.reshape(-1, ordered.shape[-1])
    return np.array([entropy_of_row(row) for row in rows]).reshape(ordered.shape[:-1])


def _powers(d: Array) -> tuple[Array, Array, Array]:
    return d**2, d**3, d**4


def _products(d: Array) -> tuple[Array, Array, Array]:
    square = d * d
    return square, square * d, square * square


BY_ROW = Way(_modes_by_row, _entropies_by_row, _powers)
"""The slow oracle; ``d**3`` calls ``pow`` for every value."""
VECTORISED = Way(modes, entropies, _products)
