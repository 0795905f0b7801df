"""The obvious loop: SciPy, PyWavelets and NumPy, one bin, one channel and one feature at a time.

What somebody writes who has the paper and these libraries: every descriptor by the library's own
function, branches and spectra of a film made once and kept. The rules for constants are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pywt
from numpy.typing import NDArray
from scipy import signal, stats

Array = NDArray[np.float64]
EPS = float(np.finfo(np.float64).eps)

_DESCRIPTORS: dict[str, Callable[[Array], float]] = {
    "mean": lambda x: float(np.mean(x)),
    "median": lambda x: float(np.median(x)),
    "range": lambda x: float(np.ptp(x)),
    "mean_deviation": lambda x: float(np.mean(np.abs(x - np.mean(x)))),
    "std": lambda x: float(np.std(x, ddof=1)),
    "cv": lambda x: float(np.std(x, ddof=1) / np.mean(x)),
    "iqr": lambda x: float(np.ptp(np.quantile(x, [0.25, 0.75], method="hazen"))),
    "skewness": lambda x: float(stats.skew(x)),
    "kurtosis": lambda x: float(stats.kurtosis(x, fisher=False)),
    "energy": lambda x: float(np.sum(x**2)),
    "entropy": lambda x: entropy(x),
    "peak_factor": lambda x: float(np.max(x) / np.sqrt(np.mean(x**2))),
}


def features(
    filtered: Array,
    names: Iterable[Sequence[str]],
    channels: Sequence[str],
    sample_rate_hz: float = 2000.0,
) -> Array:
    """Features of one filtered bin.

    Args:
        filtered: in volts.
        names: channel, component, domain and descriptor of each feature wanted.
        channels: names of the rows of ``filtered``.
        sample_rate_hz: of the bin.

    Shape:
        - filtered: ``[C, n]``
        - output: ``[K]``
    """
    rows = dict(zip(channels, filtered, strict=True))
    films: dict[str, _Film] = {}
    values = []
    for channel, component, domain, descriptor in names:
        x = rows[channel]
        if component != "raw":
            if channel not in films:
                films[channel] = _Film(x, sample_rate_hz)
            values.append(films[channel].feature(component, domain, descriptor))
        else:
            values.append(describe(x, descriptor, float(np.abs(x).max())))
    return np.array(values)


def describe(x: Array, descriptor: str, scale: float) -> float:
    """A descriptor of a signal from a bin whose largest magnitude is ``scale``."""
    if descriptor == "mode":
        return mode(x, 1e-12 * scale)
    return _DESCRIPTORS[descriptor](x)


def savgol(samples: Array, window_lengths: Sequence[int], polyorder: int, context: int) -> Array:
    """Filter a raw bin channel by channel, and drop its context.

    Shape:
        - samples: ``[C, n + 2 * context]``
        - output: ``[C, n]``
    """
    rows = [
        signal.savgol_filter(row, length, polyorder)
        for row, length in zip(samples, window_lengths, strict=True)
    ]
    return np.stack(rows)[:, context : samples.shape[-1] - context]


def kernel_score(z: Array, support: Array, beta: Array, offset: float, degree: int) -> float:
    """The sum over training bins of a polynomial kernel."""
    return float(np.dot((support @ z + offset) ** degree, beta))


def mode(x: Array, tolerance: float) -> float:
    """First value of the longest run of sorted values no further apart than a tolerance."""
    ordered = np.sort(x)
    starts = np.flatnonzero(np.diff(ordered, prepend=-np.inf) > tolerance)
    lengths = np.diff(starts, append=len(x))
    return float(ordered[starts[np.argmax(lengths)]])


def entropy(x: Array) -> float:
    """Entropy of 256 levels, which serve as the edges of NumPy's histogram."""
    level = np.floor(255 * (x - x.min()) / np.ptp(x) + 0.5 + 1e-9)
    counts, _ = np.histogram(level, bins=np.unique(level))
    share = counts / len(x)
    return float(-np.sum(share * np.log2(share + EPS)))


class _Film:
    """Branches and spectra of a film's bin, made when first asked for."""

    def __init__(self, x: Array, sample_rate_hz: float) -> None:
        self._x = x
        self._scale = float(np.abs(x).max())
        self._frequency_hz = np.arange(len(x)) * sample_rate_hz / len(x)
        self._branches: dict[str, Array] = {}
        self._spectra: dict[str, Array] = {}
        self._level = pywt.dwt_max_level(len(x), "rbio2.2")

    def feature(self, component: str, domain: str, descriptor: str) -> float:
        if descriptor == "band_energy_ratio":
            names = [f"{kind}{m}" for m in range(1, self._level + 1) for kind in "AD"]
            energies = {name: np.sum(self._spectrum(name) ** 2) for name in names}
            return float(energies[component] / sum(energies.values()))
        if domain == "time":
            branch = self._branch(component)
            if descriptor == "correlation":
                return float(np.corrcoef(branch, self._x)[0, 1])
            return describe(branch, descriptor, self._scale)
        spectrum = self._spectrum(component)
        if descriptor in ("spectral_centroid", "spectral_spread"):
            total = np.sum(spectrum)
            centroid = np.sum(self._frequency_hz * spectrum) / total
            if descriptor == "spectral_centroid":
                return float(centroid)
            return float(np.sqrt(np.sum((self._frequency_hz - centroid) ** 2 * spectrum) / total))
        return describe(spectrum, descriptor, self._scale)

    def _branch(self, name: str) -> Array:
        if name not in self._branches:
            coefficients = pywt.wavedec(self._x, "rbio2.2", mode="symmetric", level=int(name[1:]))
            kept = 0 if name[0] == "A" else 1
            only = [c if i == kept else np.zeros_like(c) for i, c in enumerate(coefficients)]
            branch = pywt.waverec(only, "rbio2.2", mode="symmetric")
            self._branches[name] = branch[: len(self._x)]
        return self._branches[name]

    def _spectrum(self, name: str) -> Array:
        if name not in self._spectra:
            num = len(self._x)
            length = 2 * (num - 1)
            num_fft = 1 << (length - 1).bit_length()
            amplitude = np.abs(np.fft.fft(self._branch(name), num_fft))[:num] / length
            amplitude[1 : num - 1] *= 2
            self._spectra[name] = amplitude
        return self._spectra[name]
