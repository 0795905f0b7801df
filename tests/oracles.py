"""Slow, plain references for every operator, to be read against the definitions.

Written from the paper's formulas alone, in NumPy, SciPy and PyWavelets; nothing of the
package is imported. One 1-D float64 signal at a time, loops welcome. Below the references: what
the tests feed in, and how they compare.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pywt
import torch
from scipy import signal, stats
from torch import Tensor

EPS = np.finfo(np.float64).eps

SG_DESCRIPTORS = (
    "mean",
    "median",
    "mode",
    "range",
    "mean_deviation",
    "std",
    "cv",
    "iqr",
    "skewness",
    "kurtosis",
    "energy",
    "entropy",
    "peak_factor",
)
TIME_DESCRIPTORS = (*SG_DESCRIPTORS, "correlation")
SPECTRUM_DESCRIPTORS = (*SG_DESCRIPTORS, "spectral_centroid", "spectral_spread")
SIMPLE_OF_GAUGES = ("rms", "mean_abs_change")
SIMPLE_OF_FILMS = ("mean", "std", "rms", "range", "mean_abs_change")


# Section 2: filter ---------------------------------------------------------------------------


def savgol(x: np.ndarray, window_length: int, polyorder: int = 1) -> np.ndarray:
    return signal.savgol_filter(x, window_length, polyorder, mode="interp", axis=-1)


# Section 3: branches and spectrum ------------------------------------------------------------


def wavelet_branches(x: np.ndarray, wavelet: str = "rbio2.2", level: int = 4) -> np.ndarray:
    """A1, D1, A2, D2, ..: decompose m times, keep one array of coefficients, put it back."""
    branches = []
    for m in range(1, level + 1):
        coefficients = pywt.wavedec(x, wavelet, mode="symmetric", level=m)  # cA_m, cD_m, cD_m-1, ..
        for kept in (0, 1):
            only = [c if i == kept else np.zeros_like(c) for i, c in enumerate(coefficients)]
            branches.append(pywt.waverec(only, wavelet)[: len(x)])
    return np.stack(branches)


def amplitude_spectrum(x: np.ndarray, method: str = "reference") -> np.ndarray:
    n = len(x)
    if method == "clean":
        amplitude = np.abs(np.fft.rfft(x)) / n
        amplitude[1 : (n + 1) // 2] *= 2  # neither DC nor, for even n, Nyquist
        return amplitude
    length = 2 * (n - 1)
    n_fft = 1
    while n_fft < length:
        n_fft *= 2
    amplitude = np.abs(np.fft.fft(x, n_fft))[:n] / length
    amplitude[1 : n - 1] *= 2
    return amplitude


def frequency_axis_hz(n: int, sample_rate_hz: float, method: str = "reference") -> np.ndarray:
    lines = n // 2 + 1 if method == "clean" else n
    return np.array([k * sample_rate_hz / n for k in range(lines)])


# Section 4: descriptors ----------------------------------------------------------------------


def settle(x: np.ndarray, scale: float) -> np.ndarray:
    """A span below 16 eps of the raw bin's magnitude is rounding: the mean stands for it."""
    return np.full_like(x, x.mean()) if x.max() - x.min() < 16 * EPS * scale else x


def mode(x: np.ndarray, scale: float) -> float:
    runs: list[list[float]] = []
    for value in np.sort(x):
        if runs and value - runs[-1][-1] <= 1e-12 * scale:
            runs[-1].append(value)
        else:
            runs.append([value])
    return max(runs, key=len)[0]  # max keeps the first of equals: the smallest value


def entropy(x: np.ndarray) -> float:
    if np.ptp(x) == 0:
        return 0.0
    q = np.floor(255 * ((x - x.min()) / np.ptp(x)) + 0.5 + 1e-6)
    counts, _ = np.histogram(q, bins=np.unique(q))  # NumPy's last cell holds both its edges
    p = counts / len(x)
    return float(-(p * np.log2(p + EPS)).sum())


def describe_one(
    x: np.ndarray,
    name: str,
    *,
    scale: float | None = None,
    reference: np.ndarray | None = None,
    frequency_hz: np.ndarray | None = None,
) -> float:
    """One descriptor of one settled signal, branch or spectrum, from the table of section 4."""
    scale = float(np.abs(x).max()) if scale is None else scale
    constant = np.ptp(x) == 0
    x = x.astype(np.longdouble)  # so that the reference's own rounding stays out of the way
    n, m, rms = len(x), x.mean(), np.sqrt((x**2).mean())
    d = x - x[0]
    d = d - d.mean()  # in two steps: exact however large the offset
    match name:
        case "mean":
            return m
        case "median":
            return np.median(x)
        case "mode":
            return mode(x, scale)
        case "range":
            return x.max() - x.min()
        case "mean_deviation":
            return 0.0 if constant else np.abs(d).mean()
        case "std":
            return 0.0 if constant else np.sqrt((d**2).sum() / (n - 1))
        case "cv":
            if constant:
                return 0.0
            sign = -1.0 if m < 0 else 1.0
            return np.sqrt((d**2).sum() / (n - 1)) / (sign * max(abs(m), 1e-6 * rms))
        case "iqr":
            return np.quantile(x, 0.75, method="hazen") - np.quantile(x, 0.25, method="hazen")
        case "skewness":
            return 0.0 if constant else (d**3).mean() / (d**2).mean() ** 1.5
        case "kurtosis":
            return 3.0 if constant else (d**4).mean() / (d**2).mean() ** 2
        case "rms":
            return rms
        case "mean_abs_change":
            return np.abs(np.diff(d)).mean()
        case "energy":
            return (x**2).sum()
        case "entropy":
            return entropy(x)
        case "peak_factor":
            return 0.0 if rms == 0 else x.max() / rms
        case "correlation":
            if constant or np.ptp(reference) == 0:
                return 0.0
            e = reference.astype(np.longdouble) - reference[0]
            e = e - e.mean()
            return (d * e).sum() / np.sqrt((d**2).sum() * (e**2).sum())
        case "spectral_centroid":
            return 0.0 if x.sum() == 0 else (frequency_hz * x).sum() / x.sum()
        case "spectral_spread":
            if x.sum() == 0:
                return 0.0
            centroid = (frequency_hz * x).sum() / x.sum()
            return np.sqrt(((frequency_hz - centroid) ** 2 * x).sum() / x.sum())
    raise KeyError(name)


def describe(x: np.ndarray, names: tuple[str, ...], **options) -> np.ndarray:
    return np.array([describe_one(x, name, **options) for name in names], dtype=np.float64)


def band_energy_ratio(spectra: np.ndarray) -> np.ndarray:
    energy = (spectra**2).sum(axis=-1)
    return energy / energy.sum() if energy.sum() > 0 else np.zeros_like(energy)


def pool_names(
    num_gauges: int = 14, num_films: int = 10, level: int = 4
) -> list[tuple[str, str, str, str]]:
    """(channel, component, domain, descriptor) in pool order: the paper's, then what is ours."""
    levels = range(1, level + 1)
    names = [(f"SG{i}", "raw", "time", d) for i in range(1, num_gauges + 1) for d in SG_DESCRIPTORS]
    for i in range(1, num_films + 1):
        film = f"PVDF{i}"
        for m in levels:
            names += [(film, f"A{m}", "time", d) for d in TIME_DESCRIPTORS]
            names += [(film, f"D{m}", "time", d) for d in TIME_DESCRIPTORS]
            names += [(film, f"A{m}", "freq", d) for d in SPECTRUM_DESCRIPTORS]
            names += [(film, f"D{m}", "freq", d) for d in SPECTRUM_DESCRIPTORS]
        for letter in "AD":
            names += [(film, f"{letter}{m}", "freq", "band_energy_ratio") for m in levels]
    for i in range(1, num_gauges + 1):
        names += [(f"SG{i}", "raw", "time", d) for d in SIMPLE_OF_GAUGES]
    for i in range(1, num_films + 1):
        names += [(f"PVDF{i}", "raw", "time", d) for d in SIMPLE_OF_FILMS]
    return names


def film_branches(x: np.ndarray, wavelet: str = "rbio2.2", level: int = 4) -> dict[str, np.ndarray]:
    """The branches of a PVDF bin by name; a constant A is its mean, a constant D is 0."""
    names = [f"{letter}{m}" for m in range(1, level + 1) for letter in "AD"]
    branches = {}
    for name, branch in zip(names, wavelet_branches(x, wavelet, level), strict=True):
        settled = settle(branch, np.abs(x).max())
        gone = name[0] == "D" and np.ptp(settled) == 0
        branches[name] = np.zeros_like(branch) if gone else settled
    return branches


def pool(
    bins: np.ndarray,
    num_gauges: int = 14,
    sample_rate_hz: float = 2000.0,
    wavelet: str = "rbio2.2",
    level: int = 4,
    method: str = "reference",
) -> np.ndarray:
    """All columns of one bin [C, n]: gauges first, then films."""
    values: list[float] = []
    hz = frequency_axis_hz(bins.shape[-1], sample_rate_hz, method)
    for x in bins[:num_gauges]:
        scale = np.abs(x).max()
        values.extend(describe(settle(x, scale), SG_DESCRIPTORS, scale=scale))
    for x in bins[num_gauges:]:
        scale = np.abs(x).max()
        branches = film_branches(x, wavelet, level)
        spectra = {name: amplitude_spectrum(branch, method) for name, branch in branches.items()}
        for m in range(1, level + 1):
            for name in (f"A{m}", f"D{m}"):
                values.extend(describe(branches[name], TIME_DESCRIPTORS, scale=scale, reference=x))
            for name in (f"A{m}", f"D{m}"):
                values.extend(
                    describe(spectra[name], SPECTRUM_DESCRIPTORS, scale=scale, frequency_hz=hz)
                )
        order = [f"{letter}{m}" for letter in "AD" for m in range(1, level + 1)]
        values.extend(band_energy_ratio(np.stack([spectra[name] for name in order])))
    for i, x in enumerate(bins):
        simple = SIMPLE_OF_GAUGES if i < num_gauges else SIMPLE_OF_FILMS
        values.extend(describe(settle(x, np.abs(x).max()), simple))
    return np.array(values)


# Section 5: selection and model --------------------------------------------------------------


def t_scores(features: np.ndarray, labels: np.ndarray) -> np.ndarray:
    slip, rest = features[labels == 1], features[labels == 0]
    return np.abs(stats.ttest_ind(slip, rest).statistic)


def kernel(a: np.ndarray, b: np.ndarray, degree: int = 2, offset: float = 0.5) -> np.ndarray:
    return np.array([[(np.dot(u, v) + offset) ** degree for v in b] for u in a])


# What the tests feed in ----------------------------------------------------------------------


def random_bins(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.standard_normal(shape)


def integer_bins(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Few levels, so many ties: what a coarse converter gives."""
    return rng.integers(-4, 5, shape).astype(np.float64)


def plausible_bins(rng: np.random.Generator, num_bins: int) -> np.ndarray:
    """Filtered bins [N, 24, 100] such as the hand gives: preload, drift, mains, rails and all."""
    num_samples = 100 * num_bins
    t = np.arange(num_samples) / 2000.0
    recording = np.empty((24, num_samples))
    for channel in range(24):
        mains = 5e-3 * np.sin(2 * np.pi * 50 * t + rng.uniform(0, 6))
        noise = 2e-3 * rng.standard_normal(num_samples)
        if channel < 14:  # a strain gauge: large offset, slow drift, a step where it slips
            body = rng.uniform(-2, 3) + 0.1 * np.sin(2 * np.pi * 0.3 * t) + 0.2 * (t > t.mean())
        else:  # a film: decaying bursts of some hundred hertz around zero
            burst = np.exp(-(((t * 2) % 1) / 0.1))
            body = rng.uniform(0.05, 1) * burst * np.sin(2 * np.pi * rng.uniform(20, 300) * t)
        recording[channel] = body + mains + noise
    recording[15] *= 40  # hits the rails
    recording[16] = 5.0  # sits on a rail
    recording[2] = recording[17] = 0.0  # dead
    recording = np.clip(np.round(recording / 1.5e-4) * 1.5e-4, -5, 5)
    filtered = np.concatenate([savgol(recording[:14], 51), savgol(recording[14:], 11)])
    return filtered.reshape(24, num_bins, 100).swapaxes(0, 1).copy()


# How the tests compare -----------------------------------------------------------------------


def assert_columns_close(
    actual: Tensor | np.ndarray, expected: np.ndarray, tolerance: float = 1e-10
) -> None:
    """Every entry of [N, F] within ``tolerance`` of the larger of its value and its column's scale.

    The scale of a column is the median magnitude of the expected values in it: a statistic that
    happens to cross zero in one bin is measured against what it usually is, and a single huge
    value in a column excuses nobody else. Both sides must be finite.
    """
    actual = np.asarray(actual.detach().cpu() if isinstance(actual, Tensor) else actual)
    assert actual.shape == expected.shape
    assert np.isfinite(expected).all(), "the oracle itself is not finite"
    assert np.isfinite(actual).all(), f"not finite at {np.argwhere(~np.isfinite(actual))[:5]}"
    scale = np.maximum(np.abs(expected), np.median(np.abs(expected), axis=0))
    excess = np.abs(actual - expected) - tolerance * scale
    if (excess > 0).any():
        row, column = np.unravel_index(np.argmax(excess / (scale + 1e-300)), excess.shape)
        raise AssertionError(
            f"{(excess > 0).sum()} entries differ; worst at bin {row}, column {column}: "
            f"{float(actual[row, column])!r}, oracle {float(expected[row, column])!r}, "
            f"scale {scale[row, column]:.3g}"
        )


def assert_manners(operator: Callable[[Tensor], Tensor], x: Tensor, num_axes: int = 1) -> None:
    """The rungs every operator shares; ``x`` is [B, ...] and the operator takes ``num_axes``.

    Batched equals stacked, any leading axes, dtype and device kept, input untouched, and a
    non-contiguous input gives the same. Results may differ by 1e-12 of the largest value:
    the order of summation may depend on the shape.
    """
    before = x.clone()
    whole = operator(x)
    size = whole.abs().max().item()

    def close(a: Tensor, b: Tensor) -> None:
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12 * size, equal_nan=True)

    assert x.ndim == num_axes + 1
    assert torch.equal(x, before), "the input was modified"
    assert (whole.dtype, whole.device) == (x.dtype, x.device)
    close(torch.stack([operator(one) for one in x]), whole)
    close(operator(x[None, None]), whole[None, None])
    if len(x) % 2 == 0:
        folded = operator(x.reshape(2, -1, *x.shape[1:]))
        close(folded.reshape(whole.shape), whole)
    strided = torch.stack([x, x + 1], dim=-1)[..., 0]
    assert not strided.is_contiguous()
    close(operator(strided), whole)
    close(operator(x.transpose(0, -1).contiguous().transpose(0, -1)), whole)
    if x.dtype == torch.float64:
        assert operator(x.float()).dtype == torch.float32
    assert operator(x[:0]).shape == (0, *whole.shape[1:])


def pooled(values: np.ndarray, in_use: np.ndarray, scale: float, statistic: str) -> float:
    """A statistic over channels of the compressed values ``[m]`` of those in use."""
    x = values[in_use]
    y = scale * np.sign(x) * np.log(1 + np.abs(x) / scale)
    if statistic == "mean":
        return float(np.mean(y))
    if statistic == "std":
        return float(np.std(y, ddof=1)) if len(y) > 1 else 0.0
    if statistic.startswith("rank"):
        fraction = (int(statistic[4:]) - 1) / (len(values) - 1)
    else:
        fraction = {"min": 0.0, "median": 0.5, "max": 1.0}[statistic]
    return float(np.quantile(y, fraction))


def class_ridge(
    u: np.ndarray, labels: np.ndarray, weights: np.ndarray, ridge: float, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes ``[S, R]`` and intercept ``[R]`` of bins ``[N, S]``, as one least-squares problem.

    All classes weigh the same together; slopes are penalised and the intercept is not.
    """
    totals = np.array([weights[labels == label].sum() for label in range(len(targets))])
    v = weights * weights.sum() / (len(targets) * totals[labels])
    rows = np.sqrt(v)[:, None] * np.column_stack([u, np.ones(len(u))])
    slopes = np.sqrt(ridge) * np.eye(u.shape[1], u.shape[1] + 1)
    wanted = np.sqrt(v)[:, None] * targets[labels]
    zeros = np.zeros((len(slopes), targets.shape[1]))
    found = np.linalg.lstsq(np.vstack([rows, slopes]), np.vstack([wanted, zeros]), rcond=None)[0]
    return found[:-1], found[-1]


def class_kernel_machine(
    gram: np.ndarray, labels: np.ndarray, weights: np.ndarray, ridge: float, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same machine by its kernel: weights of bins ``[N, R]``, which add up to 0, and intercept.

    Where the gradient of the sum vanishes, ``(K + ridge / v) beta + intercept = target``.
    """
    totals = np.array([weights[labels == label].sum() for label in range(len(targets))])
    v = weights * weights.sum() / (len(targets) * totals[labels])
    one = np.ones((len(gram), 1))
    system = np.block([[gram + np.diag(ridge / v), one], [one.T, np.zeros((1, 1))]])
    found = np.linalg.solve(system, np.vstack([targets[labels], np.zeros((1, targets.shape[1]))]))
    return found[:-1], found[-1]
