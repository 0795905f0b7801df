"""The features of the paper's pool in batched NumPy: whole arrays, plain formulas.

``hard`` has the two ways to what costs most: ``BY_ROW``, the slow oracle, takes mode and entropy in
a loop over rows and powers as formulas write them; ``VECTORISED`` does without loop and powers.
Constants are replaced as the package replaces them; nothing else is guarded.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pywt
from numpy.typing import NDArray

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)


class Way(NamedTuple):
    """How what costs most is taken; values are ``[*, n]``.

    Attributes:
        mode: of sorted values and the distance ``[*]`` up to which neighbours count as equal.
        entropy: of sorted values that are not all equal.
        powers: second, third and fourth.
    """

    mode: Callable[[Array, Array], Array]
    entropy: Callable[[Array], Array]
    powers: Callable[[Array], tuple[Array, Array, Array]]


class Maps(NamedTuple):
    """Constant matrices of a bin: branches ``[B, n, n]``, and the spectrum's factors ``[L]``."""

    branches: Array
    is_approximation: NDArray[np.bool_]
    num_fft: int
    line_scale: Array


def features(
    bins: Array, num_gauges: int, way: Way, sample_rate_hz: float = 2000.0, chunk_bins: int = 16
) -> Array:
    """The whole pool of filtered bins whose gauges come first, in chunks that fit the cache.

    Shape:
        - bins: ``[N, C, n]``
        - output: ``[N, F]``
    """
    parts = [
        np.concatenate(
            [
                _gauges(bins[start : start + chunk_bins, :num_gauges], way),
                _films(bins[start : start + chunk_bins, num_gauges:], way, sample_rate_hz),
            ],
            axis=1,
        )
        for start in range(0, len(bins), chunk_bins)
    ]
    return np.concatenate(parts)


@lru_cache
def maps(num: int, wavelet: str = "rbio2.2") -> Maps:
    """The maps of a bin of ``num`` samples, by PyWavelets on an identity."""
    level = pywt.dwt_max_level(num, wavelet)
    branches = []
    for m in range(1, level + 1):
        coefficients = pywt.wavedec(np.eye(num), wavelet, mode="symmetric", level=m)
        for kept in (0, 1):
            only = [c if i == kept else np.zeros_like(c) for i, c in enumerate(coefficients)]
            branches.append(pywt.waverec(only, wavelet, mode="symmetric")[:, :num])
    length = 2 * (num - 1)
    scale = np.full(num, 2 / length)
    scale[[0, -1]] /= 2
    is_approximation = np.tile([True, False], level)
    return Maps(np.stack(branches), is_approximation, 1 << (length - 1).bit_length(), scale)


def describe(x: Array, scale: Array, way: Way) -> list[Array]:
    """The 13 descriptors that everything has.

    Shape:
        - x: ``[*, n]``; scale: ``[*]``; each output: ``[*]``
    """
    num = x.shape[-1]
    ordered = np.sort(x, axis=-1)
    low, high = ordered[..., 0], ordered[..., -1]
    is_flat = low == high
    mean = x.mean(-1)
    d = x - mean[..., None]
    square, cube, fourth = way.powers(d)
    variance = np.where(is_flat, 1.0, square.mean(-1))
    std = np.where(is_flat, 0.0, np.sqrt(variance * (num / (num - 1))))
    energy = (x * x).sum(-1)
    rms = np.sqrt(energy / num)
    floor = np.maximum(np.abs(mean), 1e-6 * rms)
    is_zero = rms == 0
    quarter = np.quantile(ordered, [0.25, 0.75], axis=-1, method="hazen")
    spread = np.where(is_flat[..., None], np.arange(num), ordered)  # any that are not all equal
    entropy = np.where(is_flat, 0.0, way.entropy(spread))
    return [
        mean,
        (ordered[..., (num - 1) // 2] + ordered[..., num // 2]) / 2,
        way.mode(ordered, 1e-12 * scale),
        high - low,
        np.where(is_flat, 0.0, np.abs(d).mean(-1)),
        std,
        std / np.where(is_zero, 1.0, np.where(mean < 0, -floor, floor)),
        quarter[1] - quarter[0],
        np.where(is_flat, 0.0, cube.mean(-1) / variance**1.5),
        np.where(is_flat, 3.0, fourth.mean(-1) / variance**2),
        energy,
        entropy,
        np.where(is_zero, 0.0, high / np.where(is_zero, 1.0, rms)),
    ]


def settle(x: Array, scale: Array) -> Array:
    """A span that is rounding beside the bin's magnitude is replaced by the mean."""
    is_constant = np.ptp(x, axis=-1) < 16 * EPS * scale
    return np.where(is_constant[..., None], x.mean(-1, keepdims=True), x)


def _gauges(x: Array, way: Way) -> Array:
    scale = np.abs(x).max(-1)
    return np.stack(describe(settle(x, scale), scale, way), axis=-1).reshape(len(x), -1)


def _films(x: Array, way: Way, sample_rate_hz: float) -> Array:
    num_bins, num_films, num = x.shape
    linear = maps(num)
    scale = np.abs(x).max(-1)  # [N, films]
    branches = np.einsum("bij,nfi->nfbj", linear.branches, x, optimize=True)
    wide = np.broadcast_to(scale[..., None], branches.shape[:-1])
    settled = settle(branches, wide)
    is_gone = (np.ptp(settled, axis=-1) == 0) & ~linear.is_approximation
    branches = np.where(is_gone[..., None], 0.0, settled)
    lines = np.fft.rfft(branches, linear.num_fft)[..., :num]
    spectra = np.abs(lines) * linear.line_scale

    in_time = [*describe(branches, wide, way), _correlation(branches, settle(x, scale))]
    frequency_hz = np.arange(num) * sample_rate_hz / num
    total = spectra.sum(-1)
    weights = spectra / np.where(total == 0, 1.0, total)[..., None]
    centroid = weights @ frequency_hz
    distance = frequency_hz - centroid[..., None]
    moments = [centroid, np.sqrt((weights * distance * distance).sum(-1))]
    in_frequency = [*describe(spectra, wide, way), *moments]

    energy = (spectra * spectra).sum(-1)  # [N, films, branches]
    whole = energy.sum(-1, keepdims=True)
    ratio = energy / np.where(whole == 0, 1.0, whole)

    level = len(linear.is_approximation) // 2
    by_level = [
        np.stack(part, axis=-1).reshape(num_bins, num_films, level, -1)  # A and D of a level
        for part in (in_time, in_frequency)
    ]
    of_film = np.concatenate(by_level, axis=-1).reshape(num_bins, num_films, -1)
    ratios = ratio.reshape(num_bins, num_films, level, 2).swapaxes(-1, -2)
    ratios = ratios.reshape(num_bins, num_films, -1)
    every: Array = np.concatenate([of_film, ratios], axis=-1)
    return every.reshape(num_bins, -1)


def _correlation(branches: Array, films: Array) -> Array:
    d = branches - branches.mean(-1, keepdims=True)
    e = (films - films.mean(-1, keepdims=True))[:, :, None]
    size = np.sqrt((d * d).sum(-1) * (e * e).sum(-1))
    is_flat = (np.ptp(branches, axis=-1) == 0) | (np.ptp(films, axis=-1) == 0)[..., None]
    correlation: Array = (d * e).sum(-1) / np.where(size == 0, 1.0, size)
    return np.where(is_flat, 0.0, correlation)
