"""Blocks of time and the random numbers in them: what makes any stretch computable alone.

Every draw comes from a Philox counter generator whose key is a hash of its purpose (seed, session,
material, cycle, name) and whose counter is the block of time it belongs to. So the same scene
gives the same bytes whatever the worker, the order, or the stretch of time asked for.

A block has a fixed place on the recording's time axis, and everything in it is computed whole,
from itself and the block before it. So a stretch of time needs the blocks that cover it and one
block of history, and its samples equal those of the whole recording. Filters are finite
(at most one block plus one tap) and run by overlap-save at one fixed FFT length.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 NumPy array."""

Key = tuple[str | int, ...]
"""What a draw is for, most general part first."""

Interval = tuple[float, float]
"""Start and end in seconds."""


def generator(*key: str | int) -> np.random.Generator:
    """The generator that belongs to ``key``, always at its beginning."""
    return np.random.Generator(np.random.Philox(key=_philox_key(key)))


def _philox_key(key: Key) -> NDArray[np.uint64]:
    """128 bits of the SHA-256 of the key's JSON text (typed: 1 and "1" differ)."""
    digest = hashlib.sha256(json.dumps(key).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8").astype(np.uint64)


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


def smooth_step(phase: Array) -> Array:
    """Half a raised cosine: 0 up to phase 0, 1 from phase 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(phase, 0.0, 1.0)))


def block_samples_for(sample_rate_hz: float) -> int:
    """Samples per block: the power of two next above a quarter second, 512 at 2 kHz."""
    return max(64, 1 << int(np.ceil(np.log2(0.25 * sample_rate_hz))))


@dataclass(frozen=True, eq=False)
class Grid:
    """Some blocks of a recording, ascending.

    Args:
        blocks: absolute indices ``[K]``; -1 is the block before the recording.
        block_samples: samples per block, B.
        sample_rate_hz: samples per second.
    """

    blocks: NDArray[np.int64]
    block_samples: int
    sample_rate_hz: float

    @cached_property
    def time_s(self) -> Array:
        """Time of every sample, ``[K, B]``."""
        index = self.blocks[:, None] * self.block_samples + np.arange(self.block_samples)
        return np.asarray(index / self.sample_rate_hz, dtype=np.float64)

    def zeros(self) -> Array:
        """A signal of zeros, ``[K, B]``."""
        return np.zeros((len(self.blocks), self.block_samples))

    def overlapping(self, start_s: float, end_s: float) -> slice:
        """The rows whose blocks touch ``[start_s, end_s]``."""
        first = np.floor(start_s * self.sample_rate_hz / self.block_samples)
        last = np.floor(end_s * self.sample_rate_hz / self.block_samples)
        low, high = np.searchsorted(self.blocks, [first, last + 1])
        return slice(int(low), int(high))

    def ringing(
        self, start_s: float, length_s: float, omega: float, decay: float
    ) -> tuple[slice, Array]:
        """A decaying sine of size 1 that starts at a time, and the rows it lies on."""
        rows = self.overlapping(start_s, start_s + length_s)
        since = np.maximum(self.time_s[rows] - start_s, 0.0)
        return rows, np.exp(-decay * since) * np.sin(omega * since)

    def only(self, rows: slice) -> Grid:
        """A grid of some of the rows."""
        return Grid(self.blocks[rows], self.block_samples, self.sample_rate_hz)

    @cached_property
    def history(self) -> tuple[Grid, NDArray[np.int64], NDArray[np.int64]]:
        """A grid that also has every block's predecessor, and the rows of both in it.

        The larger grid, the rows ``[K]`` of the predecessors, the rows ``[K]`` of the blocks.
        """
        wider = np.union1d(self.blocks, self.blocks - 1)
        grid = Grid(wider, self.block_samples, self.sample_rate_hz)
        return grid, np.searchsorted(wider, self.blocks - 1), np.searchsorted(wider, self.blocks)

    def filtered(self, before: Array, now: Array, response: NDArray[np.complex128]) -> Array:
        """Overlap-save: the filter's output on the blocks, from them and their predecessors.

        Shape:
            - before, now: ``[*, K, B]``
            - response: ``[*, B + 1]``, the rfft over 2 B points of at most B + 1 taps
            - output: ``[*, K, B]``
        """
        spectrum = np.fft.rfft(np.concatenate([before, now], axis=-1), axis=-1)
        spectrum *= response
        signal = np.fft.irfft(spectrum, 2 * self.block_samples, axis=-1)
        return np.asarray(signal[..., self.block_samples :], dtype=np.float64)

    def coloured_noise(self, key: Key, response: NDArray[np.complex128]) -> Array:
        """White noise of unit variance behind a filter, ``[K, B]``."""
        grid, before, now = self.history
        white = normal_blocks(key, grid.blocks, self.block_samples)
        return self.filtered(white[before], white[now], response)

    def frequency_hz(self) -> Array:
        """The ``B + 1`` frequencies of a filter's response."""
        step_hz = 0.5 * self.sample_rate_hz / self.block_samples
        return np.arange(self.block_samples + 1, dtype=np.float64) * step_hz

    def node_times_s(self, num: int) -> Array:
        """Times of ``num`` nodes a block and the one behind it, ``[K, num + 1]``."""
        nodes = np.arange(num + 1) / num
        return np.asarray(
            (self.blocks[:, None] + nodes) * (self.block_samples / self.sample_rate_hz)
        )

    def joined(self, values: Array) -> Array:
        """Values at the nodes joined by straight lines.

        Shape:
            - values: ``[K, num + 1]``
            - output: ``[K, B]``
        """
        step = self.block_samples // (values.shape[1] - 1)
        ramp = np.arange(step) / step
        lines: Array = values[:, :-1, None] + np.diff(values)[:, :, None] * ramp
        return np.asarray(lines.reshape(len(self.blocks), self.block_samples), dtype=np.float64)


def causal_response(magnitude: Array, *, unit_power: bool = False) -> NDArray[np.complex128]:
    """The minimum-phase filter of at most B + 1 taps with about this magnitude.

    Args:
        magnitude: on ``Grid.frequency_hz``, floored at 1e-4 of its maximum.
        unit_power: scale the taps so that white noise of unit variance comes out with unit
            variance.

    Shape:
        - magnitude: ``[*, B + 1]``
        - output: ``[*, B + 1]``, the rfft over 2 B points of the taps

    Reference:
        Oppenheim and Schafer, Discrete-Time Signal Processing: minimum phase from the folded
        real cepstrum.
    """
    num_taps = magnitude.shape[-1]
    n = 2 * (num_taps - 1)
    floor = 1e-4 * magnitude.max(axis=-1, keepdims=True)
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, floor)), n, axis=-1)
    cepstrum[..., 1 : n // 2] *= 2.0
    cepstrum[..., n // 2 + 1 :] = 0.0
    taps = np.fft.irfft(np.exp(np.fft.rfft(cepstrum, axis=-1)), n, axis=-1)[..., :num_taps]
    if unit_power:
        taps = taps / np.sqrt(np.sum(taps**2, axis=-1, keepdims=True))
    return np.asarray(np.fft.rfft(taps, n, axis=-1), dtype=np.complex128)
