"""Synthetic features for timing the kernel machine: no hand, no simulation, any number of bins.

Bins are bounded and correlated much as the 120 scaled features of the simulated hand are, and
labels follow a quadratic rule with noise that mislabels one bin in ten.
Batch ``i`` depends on the seed and on ``i`` alone, so any shard makes its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_RULE, _TRAINING, _HELD_OUT = range(3)  # streams of random numbers
_RANK, _DECAY = 16, 0.7  # of what the features have in common, the first factor strongest
_COMMON, _OWN = 0.45, 0.15  # standard deviations before the squashing
_NOISE = 0.3  # of the labels' score
_SAMPLE = 4096  # bins that settle where the rule divides


class Batch(NamedTuple):
    """Some bins: a name, ``[N, K]`` float64 in [-1, 1], and ``[N]`` bool."""

    name: str
    z: Tensor
    is_slip: Tensor


@dataclass(frozen=True)
class SyntheticBins:
    """Bins of a synthetic set.

    Args:
        num_features: K.
        seed: of everything.
    """

    num_features: int
    seed: int = 0

    def batches(
        self, num_bins: int, batch_bins: int, part: int = 0, parts: int = 1
    ) -> Iterator[Batch]:
        """The batches of a shard, made one at a time: ``part``, ``part + parts`` and so on.

        Args:
            num_bins: of the whole set.
            batch_bins: of every batch but the last.
            part: of the shard, from 0.
            parts: number of shards.
        """
        for index in range(part, num_batches(num_bins, batch_bins), parts):
            size = min(batch_bins, num_bins - index * batch_bins)
            yield Batch(f"batch {index}", *self._make(_TRAINING, index, size))

    def training(self, num_bins: int) -> tuple[Tensor, Tensor]:
        """Features ``[N, K]`` and labels ``[N]`` of ``num_bins`` bins, in one piece."""
        return self._make(_TRAINING, 0, num_bins)

    def held_out(self, num_bins: int) -> tuple[Tensor, Tensor]:
        """Likewise, and none of them is among the training bins."""
        return self._make(_HELD_OUT, 0, num_bins)

    @cached_property
    def _rule(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """How features are mixed ``[rank, K]``, directions of the labels ``[3, K]``, threshold."""
        rng = np.random.default_rng([self.seed, _RULE])
        mix = rng.normal(size=(_RANK, self.num_features))
        mix *= np.arange(1.0, _RANK + 1)[:, None] ** -_DECAY
        mix *= _COMMON / np.sqrt(np.square(mix).sum(axis=0).mean())
        directions = rng.normal(size=(3, _RANK)) @ mix
        z = _features(rng, _SAMPLE, mix)
        directions /= _along(z, directions).std(axis=1)[:, None]
        return mix, directions, float(np.median(_quadratic(z, directions)))

    def _make(self, stream: int, index: int, num_bins: int) -> tuple[Tensor, Tensor]:
        mix, directions, threshold = self._rule
        rng = np.random.default_rng([self.seed, stream, index])
        z = _features(rng, num_bins, mix)
        score = _quadratic(z, directions) + _NOISE * rng.normal(size=num_bins)
        return torch.from_numpy(z), torch.from_numpy(score > threshold)


def num_batches(num_bins: int, batch_bins: int) -> int:
    """How many batches it takes."""
    return -(-num_bins // batch_bins)


def _features(
    rng: np.random.Generator, num_bins: int, mix: NDArray[np.float64]
) -> NDArray[np.float64]:
    common = rng.normal(size=(num_bins, len(mix), 1))
    z = _OWN * rng.normal(size=(num_bins, mix.shape[1]))
    for factor, row in enumerate(mix):  # no product of matrices: its bits depend on the threads
        z += common[:, factor] * row
    return np.tanh(z)


def _quadratic(z: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b, c = _along(z, directions)
    value: NDArray[np.float64] = a * b + c
    return value


def _along(z: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """``[3, N]``; also summed without a product of matrices."""
    found: NDArray[np.float64] = np.einsum("nk,dk->dn", z, directions, optimize=False)
    return found
