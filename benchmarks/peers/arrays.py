"""The features of the paper's pool in batched NumPy: whole arrays, plain formulas.

Constants are replaced as the package replaces them; nothing else is guarded.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pywt
from numpy.typing import NDArray

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)
TOP_LEVEL = 255


class Maps(NamedTuple):
    """Constant matrices of a bin: branches ``[B, n, n]``, and the spectrum's factors ``[L]``."""

    branches: Array
    is_approximation: NDArray[np.bool_]
    num_fft: int
    line_scale: Array


def features(
    bins: Array, num_gauges: int, sample_rate_hz: float = 2000.0, chunk_bins: int = 16
) -> Array:
    """The whole pool of filtered bins whose gauges come first, in chunks that fit the cache.

    Shape:
        - bins: ``[N, C, n]``
        - output: ``[N, F]``
    """
    chunks = (bins[start : start + chunk_bins] for start in range(0, len(bins), chunk_bins))
    made = [
        np.concatenate([_gauges(x[:, :num_gauges]), _films(x[:, num_gauges:], sample_rate_hz)], 1)
        for x in chunks
    ]
    return np.concatenate(made)


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


def _describe(x: Array, scale: Array) -> list[Array]:
    """The 13 descriptors that everything has, of ``[*, n]`` and its scale ``[*]``, each ``[*]``."""
    num = x.shape[-1]
    ordered = np.sort(x, axis=-1)
    low, high = ordered[..., 0], ordered[..., -1]
    is_flat = low == high
    mean = x.mean(-1)
    d = x - mean[..., None]
    square = d * d
    variance = np.where(is_flat, 1.0, square.mean(-1))
    std = np.where(is_flat, 0.0, np.sqrt(variance * (num / (num - 1))))
    energy = (x * x).sum(-1)
    rms = np.sqrt(energy / num)
    floor = np.maximum(np.abs(mean), 1e-6 * rms)
    is_zero = rms == 0
    quarter = np.quantile(ordered, [0.25, 0.75], axis=-1, method="hazen")
    spread = np.where(is_flat[..., None], np.arange(num), ordered)  # any that are not all equal
    return [
        mean,
        (ordered[..., (num - 1) // 2] + ordered[..., num // 2]) / 2,
        _modes(ordered, 1e-12 * scale),
        high - low,
        np.where(is_flat, 0.0, np.abs(d).mean(-1)),
        std,
        std / np.where(is_zero, 1.0, np.where(mean < 0, -floor, floor)),
        quarter[1] - quarter[0],
        np.where(is_flat, 0.0, (square * d).mean(-1) / variance**1.5),
        np.where(is_flat, 3.0, (square * square).mean(-1) / variance**2),
        energy,
        np.where(is_flat, 0.0, _entropies(spread)),
        np.where(is_zero, 0.0, high / np.where(is_zero, 1.0, rms)),
    ]


def _modes(ordered: Array, tolerance: Array) -> Array:
    """First value of the longest run of neighbours no further apart than a tolerance."""
    rank = _rank(np.diff(ordered, axis=-1) > tolerance[..., None])
    last = rank.argmax(-1)[..., None]
    first = last - np.take_along_axis(rank, last, axis=-1)
    return np.take_along_axis(ordered, first, axis=-1)[..., 0]


def _entropies(ordered: Array) -> Array:
    """Entropy of 256 levels, which serve as the edges of NumPy's histogram."""
    low, high = ordered[..., :1], ordered[..., -1:]
    level = np.floor(TOP_LEVEL * (ordered - low) / (high - low) + 0.5 + 1e-9)
    is_new = (np.diff(level, axis=-1) != 0) & (level[..., 1:] != TOP_LEVEL)  # the top one joins
    num = ordered.shape[-1]
    fraction = np.arange(num + 1) / num
    growth = np.diff(-fraction * np.log2(fraction + EPS))
    entropy: Array = growth[_rank(is_new)].sum(-1)
    return entropy


def _rank(is_new: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Position of each value in its run; ``is_new`` of all but the first."""
    place = np.arange(is_new.shape[-1] + 1)
    start = np.zeros((*is_new.shape[:-1], len(place)), dtype=np.int64)
    np.maximum.accumulate(np.where(is_new, place[1:], 0), axis=-1, out=start[..., 1:])
    return place - start


def _settle(x: Array, scale: Array) -> Array:
    """A span that is rounding beside the bin's magnitude is replaced by the mean."""
    is_constant = np.ptp(x, axis=-1) < 16 * EPS * scale
    return np.where(is_constant[..., None], x.mean(-1, keepdims=True), x)


def _gauges(x: Array) -> Array:
    scale = np.abs(x).max(-1)
    return np.stack(_describe(_settle(x, scale), scale), axis=-1).reshape(len(x), -1)


def _films(x: Array, sample_rate_hz: float) -> Array:
    num_bins, num_films, num = x.shape
    linear = maps(num)
    scale = np.abs(x).max(-1)  # [N, films]
    branches = np.einsum("bij,nfi->nfbj", linear.branches, x, optimize=True)
    wide = np.broadcast_to(scale[..., None], branches.shape[:-1])
    settled = _settle(branches, wide)
    is_gone = (np.ptp(settled, axis=-1) == 0) & ~linear.is_approximation
    branches = np.where(is_gone[..., None], 0.0, settled)
    spectra = np.abs(np.fft.rfft(branches, linear.num_fft)[..., :num]) * linear.line_scale

    in_time = [*_describe(branches, wide), _correlation(branches, _settle(x, scale))]
    frequency_hz = np.arange(num) * sample_rate_hz / num
    total = spectra.sum(-1)
    weights = spectra / np.where(total == 0, 1.0, total)[..., None]
    centroid = weights @ frequency_hz
    distance = frequency_hz - centroid[..., None]
    moments = [centroid, np.sqrt((weights * distance * distance).sum(-1))]
    in_frequency = [*_describe(spectra, wide), *moments]

    energy = (spectra * spectra).sum(-1)  # [N, films, branches]
    whole = energy.sum(-1, keepdims=True)
    ratio = energy / np.where(whole == 0, 1.0, whole)

    level = len(linear.is_approximation) // 2
    by_level = [
        np.stack(of, axis=-1).reshape(num_bins, num_films, level, -1)  # A and D of a level
        for of in (in_time, in_frequency)
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
