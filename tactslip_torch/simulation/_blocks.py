"""Blocks of time and the random numbers in them, so that any interval can be computed alone.

Every draw comes from a Philox counter generator; its key is a hash of the draw's purpose, its
counter the block of time it belongs to. A block has a fixed place on the recording's time axis and
is computed whole, from itself and the block before it, filters by overlap-save.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Float64 NumPy array."""

Flags = NDArray[np.bool_]
"""NumPy array of truth values."""

Spectrum = NDArray[np.complex128]
"""A filter: the rfft of its taps over two blocks, ``[B + 1]``."""

Key = tuple[str | int, ...]
"""What a draw is for, most general part first."""

Interval = tuple[float, float]
"""Start and end in seconds."""

_TONES = 4  # sines of a wave that wanders


def _philox_key(key: Key) -> NDArray[np.uint64]:
    """128 bits of the SHA-256 of the key's JSON text (typed: 1 and "1" differ)."""
    digest = hashlib.sha256(json.dumps(key).encode()).digest()
    return np.frombuffer(digest[:16], dtype="<u8").astype(np.uint64)


def generator(*key: str | int) -> np.random.Generator:
    """The generator that belongs to ``key``, always at its beginning."""
    return np.random.Generator(np.random.Philox(key=_philox_key(key)))


def lognormal(
    rng: np.random.Generator, spread: float, size: int | tuple[int, ...] | None = None
) -> Any:
    """Factors of median 1 whose logarithm has standard deviation ``spread``."""
    return np.exp(spread * rng.standard_normal(size))


def log_uniform(
    rng: np.random.Generator, bounds: tuple[float, float], size: int | None = None
) -> Any:
    """Values whose logarithm is uniform between those of the bounds, both positive."""
    low, high = bounds
    return low * np.exp(math.log(high / low) * rng.random(size))


def smooth_step(phase: Array) -> Array:
    """Half a raised cosine: 0 up to phase 0, 1 from phase 1."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.clip(phase, 0.0, 1.0)))


@dataclass(frozen=True, eq=False)
class Grid:
    """Some blocks of a recording, ascending. ``[K, B]`` below: K blocks of B samples.

    Args:
        blocks: absolute indices ``[K]``; -1 is the block before the recording.
        sample_rate_hz: samples per second.
    """

    blocks: NDArray[np.int64]
    sample_rate_hz: float

    @cached_property
    def block_samples(self) -> int:
        """Samples per block: the power of two next above a quarter second, 512 at 2 kHz."""
        return max(64, 1 << math.ceil(math.log2(0.25 * self.sample_rate_hz)))

    @cached_property
    def time_s(self) -> Array:
        """Time of every sample, ``[K, B]``."""
        index = self.blocks[:, None] * self.block_samples + np.arange(self.block_samples)
        return np.asarray(index / self.sample_rate_hz)

    @cached_property
    def frequency_hz(self) -> Array:
        """Frequencies of a filter's response, ``[B + 1]``; 1 instead of 0."""
        step_hz = 0.5 * self.sample_rate_hz / self.block_samples
        return np.asarray(np.maximum(np.arange(self.block_samples + 1) * step_hz, 1.0))

    @cached_property
    def history(self) -> tuple[Grid, NDArray[np.int64], NDArray[np.int64]]:
        """A grid that also has every block's predecessor, and the rows of both in it.

        The larger grid, the rows ``[K]`` of the predecessors, the rows ``[K]`` of the blocks.
        """
        wider = np.union1d(self.blocks, self.blocks - 1)
        grid = Grid(wider, self.sample_rate_hz)
        return grid, np.searchsorted(wider, self.blocks - 1), np.searchsorted(wider, self.blocks)

    def zeros(self) -> Array:
        """A signal of zeros, ``[K, B]``."""
        return np.zeros((len(self.blocks), self.block_samples))

    def only(self, rows: slice) -> Grid:
        """A grid of some of the rows."""
        return Grid(self.blocks[rows], self.sample_rate_hz)

    def overlapping(self, start_s: float, end_s: float) -> slice:
        """The rows whose blocks touch ``[start_s, end_s]``."""
        first = np.floor(start_s * self.sample_rate_hz / self.block_samples)
        last = np.floor(end_s * self.sample_rate_hz / self.block_samples)
        low, high = np.searchsorted(self.blocks, [first, last + 1])
        return slice(int(low), int(high))

    def pulse(self, start_s: float, end_s: float, ramp_s: float) -> tuple[slice, Array]:
        """1 between two times with smooth ramps inside, 0 outside; and the rows it lies on."""
        rows = self.overlapping(start_s, end_s)
        rise = smooth_step((self.time_s[rows] - start_s) / ramp_s)
        return rows, rise * smooth_step((end_s - self.time_s[rows]) / ramp_s)

    def ringing(
        self, start_s: float, length_s: float, omega: float, decay: float
    ) -> tuple[slice, Array]:
        """A decaying sine of size 1 that starts at a time; and the rows it lies on."""
        rows = self.overlapping(start_s, start_s + length_s)
        since = np.maximum(self.time_s[rows] - start_s, 0.0)
        return rows, np.exp(-decay * since) * np.sin(omega * since)

    def wander(
        self,
        rng: np.random.Generator,
        hertz_range: tuple[float, float],
        num_nodes: int,
        *,
        size: float = 1.0,
        spread: float = 0.0,
    ) -> Array:
        """A slow random wave, ``[K, B]``: a few sines, straight between nodes of each block.

        Args:
            rng: of frequencies, phases and sizes.
            hertz_range: of its frequencies.
            num_nodes: of each block.
            size: rms of the wave, where the sines are of one size.
            spread: of the sines' sizes.
        """
        hertz = log_uniform(rng, hertz_range, _TONES)
        phases = 2 * np.pi * rng.random(_TONES)
        sizes = size * (np.sqrt(2.0 / _TONES) * lognormal(rng, spread, _TONES))
        nodes = self.blocks[:, None] + np.arange(num_nodes + 1) / num_nodes
        time_s = nodes * (self.block_samples / self.sample_rate_hz)
        values = np.sin(2 * np.pi * hertz * time_s[..., None] + phases) @ sizes
        step = self.block_samples // num_nodes
        lines = np.diff(values)[..., None] * (np.arange(step) / step) + values[:, :-1, None]
        return np.asarray(lines.reshape(len(self.blocks), self.block_samples))

    def white_noise(self, key: Key) -> Array:
        """Standard normal noise, ``[K, B]``; a row is a function of the key and its block alone."""
        bits = np.random.Philox(key=_philox_key(key))
        normal, state = np.random.Generator(bits), bits.state
        noise = self.zeros()
        for row, block in zip(noise, self.blocks.tolist(), strict=True):
            state["state"]["counter"][2] = block + 1  # the lower words run within the block
            bits.state = state
            normal.standard_normal(out=row)
        return noise

    def coloured_noise(self, key: Key, response: Spectrum) -> Array:
        """White noise of unit variance behind a filter, ``[K, B]``."""
        return self.filtered(self.history[0].white_noise(key), response)

    def filtered(self, signal: Array, response: Spectrum) -> Array:
        """Overlap-save: a filter's output on the blocks, from them and their predecessors.

        Shape:
            - signal: ``[*, K', B]`` on ``history``
            - output: ``[*, K, B]``
        """
        _, before, now = self.history
        both = np.concatenate([signal[..., before, :], signal[..., now, :]], axis=-1)
        passed = np.fft.irfft(np.fft.rfft(both) * response, 2 * self.block_samples)
        return np.asarray(passed[..., self.block_samples :])


def causal_response(magnitude: Array) -> Spectrum:
    """The minimum-phase filter of at most B + 1 taps with about this magnitude.

    Its taps are scaled so that white noise of unit variance comes out with unit variance.

    Args:
        magnitude: on ``Grid.frequency_hz``, floored at 1e-4 of its maximum.

    Shape:
        - magnitude, output: ``[*, B + 1]``

    Reference:
        Oppenheim and Schafer, Discrete-Time Signal Processing: minimum phase from the folded
        real cepstrum.
    """
    num_taps = magnitude.shape[-1]
    n = 2 * (num_taps - 1)
    floor = 1e-4 * magnitude.max(axis=-1, keepdims=True)
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, floor)), n)
    cepstrum[..., 1 : n // 2] *= 2.0
    cepstrum[..., n // 2 + 1 :] = 0.0
    taps = np.fft.irfft(np.exp(np.fft.rfft(cepstrum)), n)[..., :num_taps]
    taps /= np.sqrt(np.sum(taps**2, axis=-1, keepdims=True))
    return np.asarray(np.fft.rfft(taps, n))
