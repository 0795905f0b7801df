"""Samples at another rate. Only on request.

A polyphase low-pass over 20 samples of the lower rate, Kaiser-windowed: SciPy's ``resample_poly``.
Up to .8 of half the lower rate tones stay within .5 %, in phase; beyond 1.2 of it at most .5 % of
one is left to fold back. A constant stays one.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

MOST = 50_000
"""Largest numerator and denominator of a ratio of rates."""

_NEAREST = 1e-7  # relative error that a ratio may be off: a sample in ten million
_HALF = 10  # samples of the lower rate on either side, as SciPy has it


def resample(samples: Tensor, from_hz: float, to_hz: float) -> Tensor:
    """The same signals at another rate.

    Sample ``k`` of the output is what was at ``k / to_hz`` seconds. Beyond its ends a signal is
    taken to stand still. No gradient flows. A NaN or Inf makes NaN what its filter reaches, 10
    samples of the lower rate on either side, and nothing else.

    Args:
        samples: in any unit.
        from_hz: their rate.
        to_hz: the rate wanted.

    Shape:
        - samples: ``[C, T]``, float32 or float64
        - output: ``[C, ceil(T * to_hz / from_hz)]``, dtype of ``samples``, memory of its own

    Raises:
        ValueError: if samples are none, a rate is not positive, their ratio is none of two whole
            numbers up to ``MOST``.

    Example:
        >>> resample(torch.ones(1, 5), 100.0, 50.0)
        tensor([[1., 1., 1.]])
    """
    if samples.ndim != 2 or samples.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"expected float32 or float64 samples [C, T] to resample, got {samples.dtype} "
            f"{tuple(samples.shape)}"
        )
    ratio = _ratio(from_hz, to_hz)
    up, down = ratio.numerator, ratio.denominator
    if up == down:
        return samples.detach().clone()
    num = -(-samples.shape[-1] * up // down)
    if not samples.numel():
        return samples.new_zeros(len(samples), num)
    x = samples.detach().cpu().double().numpy()
    is_good = np.isfinite(x)
    offset = np.sum(x, -1, keepdims=True, where=is_good) / np.maximum(is_good.sum(-1), 1)[:, None]
    blocks = -(-_HALF * max(up, down) // (up * down))  # of ``down`` samples, which become ``up``
    margin = ((0, 0), (blocks * down, blocks * down))
    padded = np.pad(np.where(is_good, x - offset, 0.0), margin, mode="edge")
    from scipy.signal import resample_poly  # takes half a second to import

    resampled = resample_poly(padded, up, down, axis=-1)
    resampled = resampled[:, blocks * up :][:, :num] + offset  # which would ripple a little
    for row in np.flatnonzero(~is_good.all(-1)):
        resampled[row, _is_reached(~is_good[row], num, up, down)] = np.nan
    return torch.from_numpy(resampled).to(samples)


def _ratio(from_hz: float, to_hz: float) -> Fraction:
    """Of the wanted rate to the given one, as near as whole numbers up to ``MOST`` come."""
    for rate in (from_hz, to_hz):
        if not (math.isfinite(rate) and rate > 0):
            raise ValueError(f"a rate must be positive to resample, got {rate:g} Hz")
    exact = Fraction(repr(float(to_hz))) / Fraction(repr(float(from_hz)))  # as they are written
    least = min(exact, 1 / exact)  # so that it is the larger of the two numbers that is limited
    nearest = least.limit_denominator(MOST)
    if nearest == 0 or abs(nearest / least - 1) > _NEAREST:
        raise ValueError(
            f"from {from_hz:.10g} to {to_hz:.10g} Hz is no ratio of whole numbers up to {MOST}; "
            "resample to a rate further away, or less so, or state the rate that is meant"
        )
    return nearest if least == exact else 1 / nearest


def _is_reached(is_bad: NDArray[Any], num: int, up: int, down: int) -> NDArray[np.bool_]:
    """Which samples of the output take in one of the input that is not finite."""
    before = np.concatenate([[0], np.cumsum(is_bad)])
    places = np.arange(num, dtype=np.int64) * down
    reach = _HALF * max(up, down)
    first = np.clip(-((reach - places) // up), 0, len(is_bad))
    last = np.clip((places + reach) // up + 1, 0, len(is_bad))
    return np.asarray(before[last] > before[first])
