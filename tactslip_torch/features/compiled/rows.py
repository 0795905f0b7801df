"""Kernels that describe one row: a gauge's bin, a branch or a spectrum, in the nearest cache.

A row is ``centre + span * d``, ``d`` of order one, so that nothing overflows or cancels
(``descriptors`` has the definitions).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tactslip_torch.features.compiled.jit import Array, inner, larger, smaller
from tactslip_torch.features.compiled.numbering import (
    CENTROID,
    CORRELATION,
    CV,
    DESCRIPTORS,
    ENERGY,
    ENTROPY,
    KURTOSIS,
    MEAN,
    MEAN_DEVIATION,
    PEAK_FACTOR,
    RANGE,
    SKEWNESS,
    SPREAD,
    STD,
)
from tactslip_torch.features.compiled.steps import LINES, TIME, WANTS_CENTROID, WANTS_ENTROPY, Steps

_TOP = 255
_CV_FLOOR = 1e-6
NOISE = 16 * 2.0**-52
"""Part of a channel's magnitude below which a span is rounding (``guards.is_constant``)."""


class Desk(NamedTuple):
    """Where one thread works: small arrays that stay in the nearest cache."""

    shifted: Array
    raw: Array
    sums: Array
    square: Array
    amplitude: Array
    frequency_hz: Array
    d: Array
    level: Array
    cells: Array
    values: Array
    is_constant: Array
    centre: Array
    energies: Array


def desk_of(steps: Steps, number: type[np.floating[Any]]) -> Desk:
    """Room for bins of these steps, statistics in that kind of number."""
    num_branches, n, _ = steps.dense.shape
    num_lines = len(steps.frequency_hz)
    most = max(n, num_lines)
    return Desk(
        shifted=np.empty(n),
        raw=np.empty(n, number),
        sums=np.empty(2 * num_lines, number),
        square=np.empty(num_lines),
        amplitude=np.empty(num_lines, number),
        frequency_hz=steps.frequency_hz.astype(number),
        d=np.empty(most, number),
        level=np.empty(most, np.int32),
        cells=np.empty(256, np.uint32),
        values=np.empty(len(DESCRIPTORS)),
        is_constant=np.empty(num_branches, np.int8),
        centre=np.empty(num_branches),
        energies=np.empty(num_branches),
    )


@inner
def extent(row: Array) -> tuple[float, float, float]:
    """Smallest and largest value, and the mean."""
    low = high = row[0]
    total = 0.0
    for i in range(row.size):
        v = row[i]
        low, high = smaller(low, v), larger(high, v)
        total += v
    return low, high, total / row.size


@inner
def scaled(row: Array, mean: float, span: float, d: Array) -> None:
    """``d = (row - mean) / span``, 0 for no span."""
    factor = row.dtype.type(1) / span if span > 0 else row.dtype.type(0)
    for i in range(row.size):
        d[i] = (row[i] - mean) * factor


@inner
def _entropy(row: Array, low: float, span: float, steps: Steps, kind: int, desk: Desk) -> float:
    """Entropy in bits of values of that least value and span."""
    growth, grown, level, cells = steps.growth[kind], steps.grown[kind], desk.level, desk.cells
    t = row.dtype.type
    levels, half = t(_TOP / span), t(0.5 + (2.0**-13 if row.itemsize == 4 else 1e-9))
    second = np.int32(0)
    for i in range(row.size):
        place = np.int32((row[i] - low) * levels + half)
        level[i] = place
        below = place if place < _TOP else np.int32(0)
        second = below if below > second else second
    for i in range(cells.size):
        cells[i] = 0
    total = 0.0
    for i in range(row.size):
        cell = np.uint32(level[i] & _TOP)
        rank = cells[cell]
        total += growth[rank]
        cells[cell] = rank + np.uint32(1)
    a, b = cells[_TOP], cells[np.uint32(second)]  # the second highest joins the highest
    return float(total + grown[a + b] - grown[a] - grown[b])


@inner
def _describe(
    d: Array,
    other: Array,
    centre: float,
    span: float,
    top: float,
    energy: float,
    values: Array,
) -> None:
    """All descriptors that need neither order nor cells; ``energy`` below 0 where not known."""
    n = d.size
    zero = d.dtype.type(0)
    s1 = s2 = s3 = s4 = both = zero
    for i in range(n):
        v = d[i]
        w = v * v
        s1 += abs(v)
        s2 += w
        s3 += w * v
        s4 += w * w
        both += v * other[i]
    square = np.float64(s2)
    if energy < 0:
        energy = span * span * square + n * centre * centre
    rms = np.sqrt(energy / n)
    std = span * np.sqrt(square / (n - 1))
    floor = max(abs(centre), _CV_FLOOR * rms)
    values[MEAN] = centre
    values[RANGE] = span
    values[MEAN_DEVIATION] = span * s1 / n
    values[STD] = std
    values[ENERGY] = energy
    values[PEAK_FACTOR] = top / rms if rms > 0 else 0.0
    values[CORRELATION] = both
    if span > 0:
        values[CV] = std / (floor if centre >= 0 else -floor)
        values[SKEWNESS] = s3 * np.sqrt(n / square) / square
        values[KURTOSIS] = n * np.float64(s4) / (square * square)
    else:
        values[CV] = values[SKEWNESS] = 0.0
        values[KURTOSIS] = 3.0


@inner
def _put(row: int, values: Array, steps: Steps, out: Array, limit: float) -> None:
    """A row's values to their columns, none beyond the limit."""
    for k in range(steps.start[row], steps.start[row + 1]):
        out[steps.place[k]] = min(max(values[steps.what[k]], -limit), limit)


@inner
def time_row(
    branch: Array,
    first: float,
    keeps_first: bool,
    scale: float,
    raw_square: float,
    row: int,
    steps: Steps,
    desk: Desk,
    ordered: Array,
    facts: Array,
    out: Array,
    limit: float,
) -> tuple[bool, float]:
    """Describe a branch or a gauge's bin, less its first sample; is it constant, and at what."""
    n = branch.size
    low, high, mean = extent(branch)
    span = high - low
    is_constant = span * (1 / NOISE) < scale
    if is_constant:
        span = 0.0
    offset = first if keeps_first else 0.0
    centre = 0.0 if is_constant and not keeps_first else mean + offset
    if row < 0:
        return is_constant, centre
    slot = steps.slot[row]
    d = ordered[slot] if slot >= 0 else desk.d[:n]
    scaled(branch, mean, span, d)
    top = centre if span == 0 else high + offset
    values = desk.values
    _describe(d, desk.raw, centre, span, top, -1.0, values)
    both = values[CORRELATION]
    if span > 0 and raw_square > 0:
        own = values[STD] / span
        values[CORRELATION] = both / (own * np.sqrt((n - 1) * raw_square))
    else:
        values[CORRELATION] = 0.0
    values[ENTROPY] = 0.0
    if span > 0 and steps.flags[row] & WANTS_ENTROPY:
        values[ENTROPY] = _entropy(branch, low, span, steps, TIME, desk)
    if slot >= 0:
        _note(facts[slot], centre, span, scale, d.itemsize)
    _put(row, values, steps, out, limit)
    return is_constant, centre


@inner
def _note(fact: Array, centre: float, span: float, scale: float, itemsize: int) -> None:
    """What turns sorted deviations into values, and how near two of them count as one."""
    fact[0], fact[1] = centre, span
    fact[2] = 1e-12 * scale / span + (2.0**-22 if itemsize == 4 else 0.0) if span > 0 else 1.0


@inner
def lines_row(
    lines: Array,
    gain: float,
    offset: float,
    scale: float,
    row: int,
    steps: Steps,
    desk: Desk,
    ordered: Array,
    facts: Array,
    out: Array,
    limit: float,
) -> float:
    """Describe ``scale * abs(gain * lines + offset * ones)``; its energy over ``scale**2``."""
    n = lines.size // 2
    square = desk.square[:n]
    real, imaginary, one, other = lines[:n], lines[n:], steps.ones[:n], steps.ones[n:]
    energy = most = 0.0
    for i in range(n):
        a = gain * real[i] + offset * one[i]
        b = gain * imaginary[i] + offset * other[i]
        v = a * a + b * b
        square[i] = v
        energy += v
        most = larger(most, v)
    if row < 0:
        return energy
    slot = steps.slot[row]
    amplitude = ordered[slot] if slot >= 0 else desk.amplitude
    d = desk.d[:n]
    t = d.dtype.type
    factor = 1 / most if most > 0 else 0.0
    low, high, total = t(1), t(0), t(0)
    for i in range(n):
        v = np.sqrt(t(square[i] * factor))
        amplitude[i] = v
        total += v
        low, high = smaller(low, v), larger(high, v)
    size = scale * np.sqrt(most)
    values = desk.values
    if steps.flags[row] & WANTS_CENTROID:
        values[CENTROID], values[SPREAD] = _centroid(amplitude, desk.frequency_hz, total)
    mean, share = np.float64(total) / n, high - low
    scaled(amplitude, t(mean), share, d)
    _describe(d, d, size * mean, size * share, size, scale * scale * energy, values)
    values[ENTROPY] = 0.0
    if share > 0 and steps.flags[row] & WANTS_ENTROPY:
        values[ENTROPY] = _entropy(amplitude, low, share, steps, LINES, desk)
    if slot >= 0:
        _note(facts[slot], 0.0, size, scale, d.itemsize)
    _put(row, values, steps, out, limit)
    return energy


@inner
def _centroid(amplitude: Array, frequency_hz: Array, total: float) -> tuple[float, float]:
    """Centroid and spread of amplitudes in hertz, 0 for a zero spectrum."""
    zero = amplitude.dtype.type(0)
    if total <= 0:
        return 0.0, 0.0
    moment = zero
    for i in range(amplitude.size):
        moment += frequency_hz[i] * amplitude[i]
    centre = moment / total
    moment = zero
    for i in range(amplitude.size):
        away = frequency_hz[i] - centre
        moment += away * away * amplitude[i]
    return np.float64(centre), np.sqrt(np.float64(moment / total))
