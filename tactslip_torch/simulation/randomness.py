"""Random numbers that depend on what they are for, and on nothing else.

Every draw comes from a Philox counter generator whose key is a hash of its purpose (seed,
session, material, cycle, name) and whose counter is the block of time it belongs to. So the same
scene gives the same bytes whatever the worker, the order, or the stretch of time asked for.
"""

from __future__ import annotations

import hashlib
import json
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 numpy array."""

Key = tuple[str | int, ...]
"""What a draw is for, most general part first."""


def _philox_key(key: Key) -> NDArray[np.uint64]:
    """128 bits of the SHA-256 of the key's JSON text (typed: 1 and "1" differ)."""
    digest = hashlib.sha256(json.dumps(key).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8").astype(np.uint64)


def generator(*key: str | int) -> np.random.Generator:
    """The generator that belongs to ``key``, always at its beginning."""
    return np.random.Generator(np.random.Philox(key=_philox_key(key)))


def normal_blocks(key: Key, blocks: NDArray[np.int64], block_samples: int) -> Array:
    """Standard normal noise in blocks of absolute index; block -1 and later exist.

    Shape:
        - blocks: ``[K]``
        - output: ``[K, block_samples]``, row k a function of the key and of ``blocks[k]`` alone
    """
    bits = np.random.Philox(key=_philox_key(key))
    normal, state = np.random.Generator(bits), bits.state
    noise = np.empty((len(blocks), block_samples))
    for row, block in zip(noise, blocks.tolist(), strict=True):
        state["state"]["counter"][2] = block + 1  # the counter's lower words run within the block
        bits.state = state
        normal.standard_normal(out=row)
    return noise


def lognormal(
    rng: np.random.Generator, spread: float, size: int | tuple[int, ...] | None = None
) -> Array:
    """Factors of median 1 whose logarithm has standard deviation ``spread``."""
    return np.exp(spread * rng.standard_normal(size))


def log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """One value whose logarithm is uniform between those of the bounds, both positive."""
    low, high = bounds
    return low * math.exp(math.log(high / low) * rng.random())
