"""Descriptors, the paper's and two more, each defined once, as short functions of ``Rows``.

Rows are bins, wavelet branches or spectra that were brought to order one before (``bank.py``), so
that no definition has to know of extremes. Only operations that ``torch.Tensor`` and the values of
an ONNX graph (``deploy/value.py``) both offer are used: the same functions are the reference on any
device, with gradients, and write the graph.

A row that is constant has std, cv, skewness, correlation, entropy and mean absolute change 0 and
kurtosis 3; a zero row has rms and peak factor 0; a zero spectrum has centroid, spread and band
energy ratios 0. Gradients of constant rows and of tied values are 0 or one-sided, never NaN. Those
of ``median``, ``iqr`` and ``mode`` depend on which of several nearly equal values is chosen. No
gradient flows through ``entropy``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from torch import Tensor

SIMPLE_STATISTICS = ("mean", "std", "rms", "range", "mean_abs_change")
"""Descriptors of the filtered bin itself that every channel has, fast ones too; in volts."""


@dataclass(frozen=True)
class FeatureName:
    """What a feature is, and of what.

    Args:
        channel: channel name, such as ``"PVDF3"``; of a pooled feature the kind, ``"PVDF"``.
        component: ``"raw"`` (the filtered bin) or, of a fast channel, a branch, ``"A1"`` to
            ``"D4"``.
        domain: ``"time"`` or ``"freq"``.
        descriptor: name in ``descriptors.py``, or ``"band_energy_ratio"``.
        statistic: over the channels of the kind, such as ``"std"`` (``pooling.py``); empty for a
            feature of one channel.

    Example:
        >>> str(FeatureName("PVDF3", "A2", "freq", "kurtosis"))
        'PVDF3 A2 freq kurtosis'
        >>> str(FeatureName("PVDF", "A2", "freq", "kurtosis", "std"))
        'PVDF A2 freq kurtosis [std]'
    """

    channel: str
    component: str
    domain: str
    descriptor: str
    statistic: str = ""

    def __str__(self) -> str:
        statistic = f" [{self.statistic}]" if self.statistic else ""
        return f"{self.channel} {self.component} {self.domain} {self.descriptor}{statistic}"

    @property
    def is_pooled(self) -> bool:
        """Whether it is a statistic over channels."""
        return bool(self.statistic)

    @property
    def is_simple(self) -> bool:
        """Whether it is one of ``SIMPLE_STATISTICS`` of the filtered bin, or pooled of such."""
        return self.component == "raw" and self.descriptor in SIMPLE_STATISTICS


TINY = 1e-300
"""Instead of 0 in a divisor, where a quotient of 0 is to be 0."""
_ENTROPY_LEVELS = 255
_RUN_TOLERANCE = 1e-12
_HALF_SLACK = 1e-6
_CV_FLOOR = 1e-6
_CV_ZERO = 1e-12
_NEXT_TO_NOTHING = 1e-60  # instead of 0 in a divisor; variances of rows are 0 or far above


# Operations that torch has not under one name. Each asks once whether it is given a tensor, or a
# value of a graph (deploy/value.py); both take part in all others that are used below.


def root(square: Tensor) -> Tensor:
    """Square root, whose derivative at 0 is 0."""
    if not isinstance(square, Tensor):
        return square.sqrt()
    is_zero = square.detach() <= 0  # not so for NaN
    return torch.where(is_zero, 0.0, torch.where(is_zero, 1.0, square).sqrt())


def taken(x: Tensor, index: Tensor | None, axis: int) -> Tensor:
    """Entries at constant places along an axis; ``None`` is all of them."""
    if index is None:
        return x
    if not isinstance(x, Tensor):
        return x.take(index.tolist(), axis)
    return x.index_select(axis, index.to(x.device))


def _looked_up(table: Tensor, index: Tensor) -> Tensor:
    """Entries of a constant table ``[n]`` at places that were computed, in the shape of these."""
    return table.to(index.device)[index] if isinstance(index, Tensor) else index.entries_of(table)


def _counted(index: Tensor, num: int) -> Tensor:
    """How often each of the numbers 0 to ``num - 1`` occurs along the last axis.

    Shape:
        - index: ``[*, n]``, whole numbers in that range
        - output: ``[*, num]``
    """
    if not isinstance(index, Tensor):
        return index.counted(num)
    none = index.new_zeros(*index.shape[:-1], num)
    return none.scatter_add(-1, index, torch.ones_like(index))


def like(constant: Tensor, x: Tensor) -> Tensor:
    """A constant with the dtype and the device of what it meets; a value of a graph asks itself."""
    return constant.to(x) if isinstance(x, Tensor) else constant


@dataclass
class Rows:
    """Rows of one length, of order one, and what several descriptors of them share.

    There is one number a sample in the dtype of ``values``, and one number a row in float64.

    Args:
        values: less their mean.
        mean: in the unit of the row.
        unit: by which values and mean are multiplied to be volts; no gradient.
        num: values in a row.
        scale: largest magnitude of the bin that a row comes from, in the unit of the row; ``mode``
            decides by it which values are equal. No gradient.
        filtered: bin less its mean, of order one, with which ``correlation`` correlates.
        amplitude: of spectra, the values with their mean.
        frequency_hz: of the lines of spectra.
        in_order: the values in ascending order, where a descriptor of sorted values is wanted.

    Shape:
        - values, filtered, amplitude, in_order: ``[*, R, n]``; mean, unit, scale: ``[*, R]``;
          frequency_hz: ``[n]``
    """

    values: Tensor
    mean: Tensor
    unit: Tensor
    num: int
    scale: Tensor
    filtered: Tensor | None = None
    amplitude: Tensor | None = None
    frequency_hz: Tensor | None = None
    in_order: Tensor | None = None

    def take(self, index: Tensor | None) -> Rows:
        """Some of the rows, by their places; all of them for ``None``."""
        if index is None:
            return self
        return replace(
            self,
            values=taken(self.values, index, -2),
            mean=taken(self.mean, index, -1),
            unit=taken(self.unit, index, -1),
            scale=taken(self.scale, index, -1),
            filtered=None if self.filtered is None else taken(self.filtered, index, -2),
            amplitude=None if self.amplitude is None else taken(self.amplitude, index, -2),
        )

    @property
    def ascending(self) -> Tensor:
        """Values in ascending order, ``[*, R, n]``."""
        if self.in_order is None:
            raise ValueError("mode and iqr need the values in ascending order")
        return self.in_order

    def ranked(self, first: int, count: int) -> Tensor:
        """Values at ``count`` places of the ascending order, from ``first`` on, ``[*, R, count]``.

        A graph whose values are not in order selects quicker than it sorts.
        """
        if self.in_order is not None:
            return self.in_order[..., first : first + count]
        return self.values.ranked(first, count)  # type: ignore[attr-defined,no-any-return]

    @cached_property
    def squares(self) -> Tensor:
        """Squared values, ``[*, R, n]``."""
        return self.values * self.values

    @cached_property
    def variance(self) -> Tensor:
        """Mean of the squares, ``[*, R]``; 0 for a constant."""
        return self.squares.mean(-1).double()

    @cached_property
    def safe_variance(self) -> Tensor:
        """The variance, and next to nothing where that is 0, ``[*, R]``."""
        return self.variance.clamp(min=_NEXT_TO_NOTHING)

    @cached_property
    def std(self) -> Tensor:
        """Standard deviation in the unit, with ``n - 1`` in the denominator, ``[*, R]``."""
        return root(self.variance * (self.num / (self.num - 1)))

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square in the unit, ``[*, R]``; next to nothing for a zero row."""
        return (self.mean * self.mean + self.variance).clamp(min=_NEXT_TO_NOTHING).sqrt()


# Each function takes rows and gives one number for each, [*, R], float64, in volts or its own unit.


def _mean(x: Rows) -> Tensor:
    """Arithmetic mean."""
    return x.mean * x.unit


def _median(x: Rows) -> Tensor:
    """Middle value, or the mean of the two middle values for even ``n``."""
    middle = x.ranked((x.num - 1) // 2, 2 - x.num % 2).mean(-1)
    return (middle.double() + x.mean) * x.unit


def _mode(x: Rows) -> Tensor:
    """Most frequent value, the smallest of ties; the minimum if all are distinct.

    Sorted values no further than 1e-12 of ``scale`` from their neighbour form one run (ours),
    because exact equality in branches is decided by rounding. The result is the first value of the
    longest run.
    """
    tolerance = _RUN_TOLERANCE * x.scale
    before = torch.cat([x.ascending[..., :1], x.ascending[..., :-1]], dim=-1)
    run = (x.ascending - before > tolerance[..., None]).long().cumsum(-1)
    longest = _counted(run, x.num).argmax(-1, keepdim=True)  # the first of equals
    start = (run < longest).long().sum(-1, keepdim=True)
    return (x.ascending.gather(-1, start).squeeze(-1).double() + x.mean) * x.unit


def _range(x: Rows) -> Tensor:
    """Largest minus smallest value."""
    return (x.values.amax(-1) - x.values.amin(-1)).double() * x.unit


def _mean_deviation(x: Rows) -> Tensor:
    """Mean absolute deviation from the mean."""
    return x.values.abs().mean(-1).double() * x.unit


def _std(x: Rows) -> Tensor:
    """Standard deviation with ``n - 1`` in the denominator."""
    return x.std * x.unit


def _cv(x: Rows) -> Tensor:
    """Coefficient of variation, ``std / mean``, signed.

    The mean's magnitude counts as at least 1e-6 of the rms, and a mean within 1e-12 of the rms, the
    sign of which is rounding, as positive (both ours); 0 for a zero row.
    """
    floor = torch.maximum(x.mean.abs(), x.rms * _CV_FLOOR)
    is_negative = x.mean < x.rms * -_CV_ZERO
    return x.std / torch.where(is_negative, -floor, floor)


def _iqr(x: Rows) -> Tensor:
    """Interquartile range, quantiles at Hazen positions ``q n + 1/2``."""

    def at(quantile: float) -> Tensor:
        position = min(max(quantile * x.num - 0.5, 0.0), x.num - 1.0)
        below, fraction = int(position), position % 1
        near = x.ascending[..., below]
        if fraction == 0:
            return near
        return near * (1 - fraction) + x.ascending[..., below + 1] * fraction

    return (at(0.75) - at(0.25)).double() * x.unit


def _skewness(x: Rows) -> Tensor:
    """Third central moment over the 3/2 power of the second; 0 for a constant."""
    third = (x.squares * x.values).mean(-1).double()
    return third / (x.safe_variance * x.safe_variance.sqrt())


def _kurtosis(x: Rows) -> Tensor:
    """Fourth central moment over the squared second, not excess; 3 for a constant."""
    fourth = (x.squares * x.squares).mean(-1).double()
    is_constant = (x.variance <= 0.0).double()
    return fourth / (x.safe_variance * x.safe_variance) + is_constant * 3.0


def _energy(x: Rows) -> Tensor:
    """Sum of squares; Inf beyond the dtype."""
    return (x.mean * x.mean + x.variance) * float(x.num) * x.unit * x.unit


def _entropy(x: Rows) -> Tensor:
    """Shannon entropy of the amplitude histogram in bits; 0 for a constant.

    Values are quantised to 256 levels between their extremes, halves (within 1e-6 of a level)
    rounded up. The distinct levels serve as histogram *edges*, so the two highest occupied ones
    share one cell.
    """
    values = x.values.detach()
    least = values.amin(-1, keepdim=True)
    span = values.amax(-1, keepdim=True) - least
    levels = _ENTROPY_LEVELS / span.clamp(min=_NEXT_TO_NOTHING)
    level = ((values - least) * levels + (0.5 + _HALF_SLACK)).floor()
    # the maximum always has the top level, which joins the second highest
    second = torch.where(level < float(_ENTROPY_LEVELS), level, 0.0).amax(-1, keepdim=True)
    cell = torch.where(level < second, level, second)  # of a NaN too one of the numbers
    bits = _looked_up(_entropy_terms(x.num), _counted(cell.long(), _ENTROPY_LEVELS)).sum(-1)
    return bits * (span.squeeze(-1) > 0.0).double()


def _peak_factor(x: Rows) -> Tensor:
    """Signed maximum over the root mean square; 0 for a zero row."""
    return (x.values.amax(-1).double() + x.mean) / x.rms


def _correlation(x: Rows) -> Tensor:
    """Pearson correlation of a branch with the filtered bin; 0 if either is constant."""
    if x.filtered is None:
        raise ValueError("correlation needs the filtered bin that rows are branches of")
    covariance = (x.values * x.filtered).mean(-1).double()
    other = (x.filtered * x.filtered).mean(-1).double().clamp(min=_NEXT_TO_NOTHING)
    return covariance / (x.safe_variance * other).sqrt()


def _spectral_centroid(x: Rows) -> Tensor:
    """Mean frequency with amplitudes as weights, hertz; 0 for a zero spectrum."""
    amplitude, frequency_hz = _spectrum(x)
    total = (x.mean * float(x.num)).clamp(min=_NEXT_TO_NOTHING)
    return (amplitude * frequency_hz).sum(-1).double() / total


def _spectral_spread(x: Rows) -> Tensor:
    """Root of the weighted mean squared distance from the centroid, hertz.

    0, without gradient, for a zero spectrum and for a single line.
    """
    amplitude, frequency_hz = _spectrum(x)
    distance = _spectral_centroid(x).type_as(amplitude)[..., None] - frequency_hz
    total = (x.mean * float(x.num)).clamp(min=_NEXT_TO_NOTHING)
    return root((amplitude * distance * distance).sum(-1).double() / total)


def _rms(x: Rows) -> Tensor:
    """Root mean square; 0, without gradient, for a zero row."""
    return root(x.mean * x.mean + x.variance) * x.unit


def _mean_abs_change(x: Rows) -> Tensor:
    """Mean distance between neighbours, ``mean |x[t + 1] - x[t]|``; 0 for a constant."""
    change = x.values[..., 1:] - x.values[..., :-1]
    return change.abs().mean(-1).double() * x.unit


def band_energy_ratios(energies: Tensor) -> Tensor:
    """Part of each branch in the energy of all branches' spectra; 0 if all are zero.

    Shape:
        - energies, output: ``[*, branches]``
    """
    return energies / energies.sum(-1, keepdim=True).clamp(min=1e-300)


def _spectrum(x: Rows) -> tuple[Tensor, Tensor]:
    if x.amplitude is None or x.frequency_hz is None:
        raise ValueError("spectral_centroid and spectral_spread need frequency_hz=")
    return x.amplitude, like(x.frequency_hz, x.amplitude)


@lru_cache
def _entropy_terms(num: int) -> Tensor:
    """``-p log2(p + eps)`` of cells that hold 0 to ``num`` of ``num`` values, float64."""
    p = torch.arange(num + 1, dtype=torch.float64) / num
    return -p * (p + torch.finfo(torch.float64).eps).log2()


DESCRIPTORS: dict[str, Callable[[Rows], Tensor]] = {
    "mean": _mean,
    "median": _median,
    "mode": _mode,
    "range": _range,
    "mean_deviation": _mean_deviation,
    "std": _std,
    "cv": _cv,
    "iqr": _iqr,
    "skewness": _skewness,
    "kurtosis": _kurtosis,
    "energy": _energy,
    "entropy": _entropy,
    "peak_factor": _peak_factor,
    "correlation": _correlation,
    "spectral_centroid": _spectral_centroid,
    "spectral_spread": _spectral_spread,
    "rms": _rms,
    "mean_abs_change": _mean_abs_change,
}
"""Every descriptor by its name, in the order of ``enum Descriptor`` (``native/engine.h``).

Of every signal those up to the peak factor; correlation of branches; centroid and spread of
spectra; the last two, which the paper has not, of bins.
"""
COMMON_DESCRIPTORS = tuple(DESCRIPTORS)[:13]
TIME_DESCRIPTORS = (*COMMON_DESCRIPTORS, "correlation")
SPECTRUM_DESCRIPTORS = (*COMMON_DESCRIPTORS, "spectral_centroid", "spectral_spread")
SORTED = ("median", "mode", "iqr")
"""Descriptors of sorted values."""
STEPPED = ("mode", "entropy")
"""Descriptors that step where a value moves; of float64 values, whatever the dtype of others."""
