"""How far each descriptor may move when its values do: the condition of every definition.

Every bound is the first derivative of the definition with respect to the values in the maximum
norm, times how far the values move, twice (the second time for what is beyond first order). To the
move of the caller, rounding adds a few eps of the largest magnitude for each value, and ``n`` eps
of the span for sums. mode and entropy step: where values stand too near to a step, the bound is all
they can do.
"""

from __future__ import annotations

import numpy as np

RUN_TOLERANCE = {np.dtype(np.float64): 1e-12, np.dtype(np.float32): 2.0**-20}
FIELDS = ("mean", "median", "mode", "range", "mean_deviation", "std", "cv", "iqr", "skewness")
FIELDS += ("kurtosis", "energy", "entropy", "peak_factor")


def tolerances(
    x: np.ndarray,
    move: np.ndarray,
    dtype: type[np.floating],
    *,
    scale: np.ndarray,
    scale_after: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """Bounds for the 13 common descriptors of ``x [*, n]`` whose values move by ``move [*]``.

    Args:
        x: the values before they move.
        move: by how much each may move, what rounding it has before it gets here included.
        dtype: that the descriptors are computed in.
        scale: by which ``mode`` tells values apart.
        scale_after: the same after the move.
    """
    eps, num = float(np.finfo(dtype).eps), x.shape[-1]
    x = x.astype(np.float64)
    scale_after = scale if scale_after is None else scale_after
    span = np.ptp(x, axis=-1)
    value = move + 4 * eps * np.abs(x).max(-1)  # of one value
    total = value + num * eps * span  # of sums
    mean, std = x.mean(-1), x.std(-1)
    rms = np.sqrt((x * x).mean(-1))
    unbiased = std * np.sqrt(num / (num - 1))
    divisor = np.maximum(np.abs(mean), 1e-6 * rms)
    z = (x - mean[..., None]) / std[..., None]
    skewness, kurtosis = np.abs((z**3).mean(-1)), (z**4).mean(-1)
    shaken = total / std
    cv = 2 * total / divisor + unbiased * total / divisor**2
    cv = np.where(np.abs(mean) <= 2 * total, cv + 2 * unbiased / divisor, cv)
    bounds = {
        "mean": total,
        "median": value,
        "mode": np.where(_may_join(x, value, dtype, scale, scale_after), span, value),
        "range": 2 * value,
        "mean_deviation": 2 * total,
        "std": 2 * total,
        "cv": cv,
        "iqr": 2 * value,
        "skewness": (6 + 3 * skewness) * shaken,
        "kurtosis": 12 * kurtosis * shaken,
        "energy": 2 * total * np.abs(x).sum(-1) + num * total**2,
        "entropy": np.where(_may_step(x, value), np.log2(num), num * eps),
        "peak_factor": (1 + np.sqrt(num)) * total / rms,
    }
    relative = num * eps  # of the value, for its sums and roots
    values = {"cv": unbiased / divisor, "skewness": skewness, "kurtosis": kurtosis}
    values |= {"energy": num * rms**2, "peak_factor": np.sqrt(num), "std": unbiased}
    return {name: 2 * (bounds[name] + relative * values.get(name, 0)) for name in FIELDS}


def correlation_tolerance(
    x: np.ndarray,
    move: np.ndarray,
    other: np.ndarray,
    other_move: np.ndarray,
    dtype: type[np.floating],
) -> np.ndarray:
    """The same for Pearson's correlation of ``x`` and ``other``: of two unit vectors."""
    eps, num = float(np.finfo(dtype).eps), x.shape[-1]
    shaken = num * eps
    for values, by in ((x, move), (other, other_move)):
        size = np.abs(values).max(-1)
        shaken = shaken + 2 * (by + (4 + num) * eps * size) / values.std(-1)
    return 2 * shaken


def line_tolerances(
    spectrum: np.ndarray, move: np.ndarray, dtype: type[np.floating], highest_hz: float
) -> dict[str, np.ndarray]:
    """The same for centroid and spread of a spectrum ``[*, lines]`` in hertz."""
    eps, num = float(np.finfo(dtype).eps), spectrum.shape[-1]
    hz = np.linspace(0, highest_hz, num)
    total = spectrum.sum(-1)
    weights = spectrum / total[..., None]
    centroid = (weights * hz).sum(-1)
    square = (weights * (hz - centroid[..., None]) ** 2).sum(-1)
    shaken = num * (move + 4 * eps * spectrum.max(-1)) / total + num * eps
    return {
        "spectral_centroid": 2 * highest_hz * shaken,
        "spectral_spread": 2 * highest_hz**2 * shaken / np.sqrt(square),
    }


def ratio_tolerance(spectra: np.ndarray, move: np.ndarray, dtype: type[np.floating]) -> np.ndarray:
    """The same for band energy ratios; spectra ``[*, branches, lines]``, move ``[*, branches]``."""
    eps, num = float(np.finfo(dtype).eps), spectra.shape[-1]
    move = move + 4 * eps * spectra.max(-1)
    energy = (spectra**2).sum(-1)
    moved = 2 * move * spectra.sum(-1) + num * move**2 + num * eps * energy
    total = energy.sum(-1, keepdims=True)
    return 2 * (moved + energy / total * moved.sum(-1, keepdims=True)) / total


def _may_join(
    x: np.ndarray,
    by: np.ndarray,
    dtype: type[np.floating],
    scale: np.ndarray,
    scale_after: np.ndarray,
) -> np.ndarray:
    """Whether two sorted values may cease or begin to count as one."""
    gaps = np.diff(np.sort(x, axis=-1), axis=-1)
    run = RUN_TOLERANCE[np.dtype(dtype)]
    low, high = np.minimum(scale, scale_after) * run, np.maximum(scale, scale_after) * run
    is_near = (gaps >= (low - 2 * by)[..., None]) & (gaps <= (high + 2 * by)[..., None])
    return is_near.any(-1)


def _may_step(x: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Whether a value may take another of the 256 levels of the entropy."""
    span = np.ptp(x, axis=-1)
    levels = 255 * (x - x.min(-1, keepdims=True)) / span[..., None] + 0.5 + 1e-9
    return (np.abs(levels - np.round(levels)) <= (255 * 4 * by / span)[..., None]).any(-1)
