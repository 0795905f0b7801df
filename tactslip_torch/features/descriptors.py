"""The paper's 17 descriptors of a bin, a wavelet branch or a spectrum (REFERENCE.md section 4).

Each descriptor is a function of a ``Sample``: ``n`` values along the last axis, with the parts
that several descriptors share (sorted values, scaled deviations, moments) computed once, when
first asked for. ``describe`` is the front door.

Extremes (our rules): a sample whose span is below ``16 * eps * scale`` counts as constant and is
replaced by its mean beforehand (``settle``); it then has std, cv, skewness, correlation and
entropy 0 and kurtosis 3. A zero sample has peak factor 0; a zero spectrum has centroid, spread and
band energy ratios 0. Moments are two-pass, on values shifted by a sample and scaled by the span, so
large offsets, denormals and 1e30 neither cancel nor overflow; values whose squares leave the dtype
are first multiplied by a power of two (``stretch``). What is beyond the largest finite number of
the dtype (an energy, the range of +-1.7e308) saturates there with gradient 0, and so does a
gradient (of the order of 1/span, for denormals). Gradients of replaced or tied values are 0 or
one-sided, never NaN. A NaN or Inf among the values makes every descriptor NaN: never a silent
number.

Errors at most, to first order in the dtype's eps: n values of span S, mean m, standard deviation s
(with n), k = S/s <= sqrt(2 n), r = mean(abs(x - m)^3) / s^3; c centroid, f largest frequency. What
has a unit adds the smallest float. Held against 50 digits in ``tests/test_descriptors_exact.py``:

=================  ===============================  ==============  ================================
mean               eps ((n/2 + 1) S + abs(m))       skewness        eps ((2n + 11) k
median             eps abs(median)                                  + (2n + 5k + 12) r)
mode               exact but for its tolerance      kurtosis        eps ((2n + 14) k r
range              eps range                                        + (2n + 7k + 15) kurtosis)
mean deviation     eps (n + 3) S                    energy          eps n/2 energy + n smallest
std                eps (2 S + (n + 4) std)          entropy         eps n (entropy + 2), +-1 level
cv                 that of std and of its divisor   peak factor     eps (n/4 + 2) peak factor
iqr                10 eps iqr                       correlation     eps (n + 8 + 4 k + 4 k')
centroid           eps (n + 1) c                    spread          eps ((n + 2) c
band energy ratio  eps (n + branches) ratio                         + (n/2 + 2) spread)
=================  ===============================  ==============  ================================
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from tactslip_torch.features.guards import are_ordinary, are_positive, bounded_gradient, stretch
from tactslip_torch.features.runs import entropy_growth, rank_in_run
from tactslip_torch.features.sample import Sample

ENTROPY_LEVELS = 255
RUN_TOLERANCE = {torch.float64: 1e-12, torch.float32: 2.0**-20}
HALF_SLACK = {torch.float64: 1e-9, torch.float32: 2.0**-13}
CV_FLOOR = 1e-6


def mean(sample: Sample) -> Tensor:
    """Arithmetic mean, ``[*]``."""
    return sample.out_of_unit(sample.mean)


def median(sample: Sample) -> Tensor:
    """Middle value, or the mean of the two middle values for even ``n``, ``[*]``."""
    if sample.num % 2:
        return sample.ordered[..., sample.num // 2]
    middle = sample.ordered[..., sample.num // 2 - 1 : sample.num // 2 + 1]
    if sample.is_ordinary:
        return middle.sum(-1) * 0.5
    early = sample.stretch.clamp(0.5, 1.0)  # huge values are halved before they are added
    return (middle * early[..., None]).sum(-1) * (0.5 / early)


def mode(sample: Sample) -> Tensor:
    """Most frequent value, the smallest of ties; the minimum if all are distinct, ``[*]``.

    Sorted values no further than a tolerance from their neighbour form one run (ours): 1e-12 of
    ``scale`` in float64, 2^-20 in float32, because exact equality in branches is decided by
    rounding. The result is the first value of the longest run. Not differentiable where the
    longest run changes; elsewhere the gradient is that of the value returned.
    """
    tolerance = RUN_TOLERANCE[sample.x.dtype] * sample.in_unit(sample.scale)
    rank = rank_in_run(sample.gaps > tolerance[..., None])
    last = rank.argmax(-1, keepdim=True)  # the first maximum: the end of the first longest run
    return sample.ordered.gather(-1, last - rank.gather(-1, last).long()).squeeze(-1)


def range_(sample: Sample) -> Tensor:
    """Largest minus smallest value, ``[*]``."""
    return sample.out_of_unit(sample.span)


def mean_deviation(sample: Sample) -> Tensor:
    """Mean absolute deviation from the mean, ``[*]``."""
    return sample.out_of_unit(sample.centred.abs().mean(-1))


def std(sample: Sample) -> Tensor:
    """Standard deviation with ``n - 1`` in the denominator, ``[*]``."""
    return sample.out_of_unit(sample.std)


def cv(sample: Sample) -> Tensor:
    """Coefficient of variation, ``std / mean``, signed, ``[*]``.

    The mean's magnitude counts as at least 1e-6 of the rms (ours); 0 for a zero sample.
    """
    floor = torch.maximum(sample.mean.abs(), CV_FLOOR * sample.rms)
    signed = torch.where(sample.mean < 0, -floor, floor)
    return sample.std / signed


def iqr(sample: Sample) -> Tensor:
    """Interquartile range, quantiles at Hazen positions ``q n + 1/2``, ``[*]``."""
    low, high = (min(max(q * sample.num - 0.5, 0.0), sample.num - 1.0) for q in (0.25, 0.75))
    base = sample.in_unit(sample.ordered[..., int(low)])

    def above_base(position: float) -> Tensor:
        below, share = int(position), position % 1
        near, far = (
            sample.in_unit(sample.ordered[..., place]) - base
            for place in (below, min(below + 1, sample.num - 1))
        )
        return near * (1 - share) + far * share

    return sample.out_of_unit(above_base(high) - above_base(low))


def skewness(sample: Sample) -> Tensor:
    """Third central moment over the 3/2 power of the second, ``[*]``; 0 for a constant."""
    return (sample.squares * sample.deviation).mean(-1) / sample.variance**1.5


def kurtosis(sample: Sample) -> Tensor:
    """Fourth central moment over the squared second, not excess, ``[*]``; 3 for a constant."""
    fourth = (sample.squares * sample.squares).mean(-1)
    return sample.unless_flat(fourth / sample.variance**2, 3.0)


def energy(sample: Sample) -> Tensor:
    """Sum of squares, ``[*]``; Inf beyond the dtype, which ``describe`` saturates."""
    return (sample.x * sample.x).sum(-1)


def entropy(sample: Sample) -> Tensor:
    """Shannon entropy of the amplitude histogram in bits, ``[*]``; 0 for a constant.

    Values are quantised to 256 levels between their extremes, exact halves rounded up: within 1e-9
    of a level in float64, 2^-13 in float32, either above the rounding of 255 levels. The
    distinct levels serve as histogram *edges*, so the two highest occupied ones share one cell.
    Piecewise constant: its gradient is 0 wherever it exists, and none flows.
    """
    least = sample.in_unit(sample.smallest.detach())[..., None]
    levels = (ENTROPY_LEVELS / sample.safe_span)[..., None]
    half = 0.5 + HALF_SLACK[sample.x.dtype]
    level = ((sample.ranked - least) * levels + half).floor()
    # the maximum always has the top level, so the second highest level joins it
    new_cell = (level[..., 1:] != level[..., :-1]) & (level[..., 1:] != ENTROPY_LEVELS)
    growth = entropy_growth(sample.num).to(sample.x)
    rank = rank_in_run(new_cell)
    grown = growth.index_select(0, rank.flatten()).reshape(rank.shape)
    return sample.unless_flat(grown.sum(-1), 0.0)


def peak_factor(sample: Sample) -> Tensor:
    """Signed maximum over the root mean square, ``[*]``; 0 for a zero sample."""
    return (sample.largest if sample.is_ordinary else sample.unit.amax(-1)) / sample.rms


def correlation(sample: Sample) -> Tensor:
    """Pearson correlation with the filtered raw bin, ``[*]``; 0 if either is constant.

    Raises:
        ValueError: if the sample has no reference.
    """
    if sample.reference is None:
        raise ValueError("correlation needs reference=, the filtered raw bin of the branch")
    other = sample.reference
    covariance = (sample.deviation * other.deviation).mean(-1)
    plain = covariance / (sample.variance.sqrt() * other.variance.sqrt())
    return sample.unless_flat(other.unless_flat(plain, 0.0), 0.0)


def spectral_centroid(sample: Sample) -> Tensor:
    """Mean frequency with amplitudes as weights, hertz, ``[*]``; 0 for a zero spectrum.

    Raises:
        ValueError: if the sample has no frequency axis.
    """
    return (sample.weights * _frequency_axis(sample)).sum(-1)


def spectral_spread(sample: Sample) -> Tensor:
    """Root of the weighted mean squared distance from the centroid, hertz, ``[*]``.

    0, without gradient, for a zero spectrum and for a single line.

    Raises:
        ValueError: if the sample has no frequency axis.
    """
    distance = _frequency_axis(sample) - spectral_centroid(sample)[..., None]
    square = (sample.weights * distance * distance).sum(-1)
    if are_positive(square):
        return square.sqrt()
    is_positive = square.detach() > 0
    return torch.where(is_positive, torch.where(is_positive, square, 1.0).sqrt(), 0.0)


def band_energy_ratio(spectra: Tensor) -> Tensor:
    """Each branch's share of the energy of all branches' spectra; 0 if all are zero.

    Shape:
        - spectra: ``[*, branches, lines]``
        - output: ``[*, branches]``
    """
    spectra = bounded_gradient(spectra)
    magnitude = spectra.detach().flatten(-2).abs().amax(-1)
    is_ordinary = are_ordinary(magnitude)
    scaled = spectra if is_ordinary else spectra * stretch(magnitude)[..., None, None]
    energies = (scaled * scaled).sum(-1)
    total = energies.sum(-1, keepdim=True)
    if not is_ordinary:
        total = torch.where(total.detach() == 0, torch.inf, total)
    return energies / total


_DESCRIPTORS: dict[str, Callable[[Sample], Tensor]] = {
    "mean": mean,
    "median": median,
    "mode": mode,
    "range": range_,
    "mean_deviation": mean_deviation,
    "std": std,
    "cv": cv,
    "iqr": iqr,
    "skewness": skewness,
    "kurtosis": kurtosis,
    "energy": energy,
    "entropy": entropy,
    "peak_factor": peak_factor,
    "correlation": correlation,
    "spectral_centroid": spectral_centroid,
    "spectral_spread": spectral_spread,
}
COMMON_DESCRIPTORS = tuple(_DESCRIPTORS)[:13]
TIME_DESCRIPTORS = (*COMMON_DESCRIPTORS, "correlation")
SPECTRUM_DESCRIPTORS = (*COMMON_DESCRIPTORS, "spectral_centroid", "spectral_spread")


def describe(
    x: Tensor,
    names: Sequence[str],
    *,
    scale: Tensor | None = None,
    reference: Tensor | None = None,
    frequency_hz: Tensor | None = None,
) -> Tensor:
    """The named descriptors of samples that are already settled (``settle``) where they must be.

    Args:
        x: values in any unit.
        names: any of ``TIME_DESCRIPTORS`` or ``SPECTRUM_DESCRIPTORS``, in any order.
        scale: largest magnitude of the raw bin; default: that of ``x``.
        reference: the filtered raw bin, needed by ``correlation``.
        frequency_hz: the axis of a spectrum, needed by its centroid and spread.

    Shape:
        - x: ``[*, n]``; scale: ``[*]``; reference: broadcastable to ``x``; frequency_hz: ``[n]``
        - output: ``[*, len(names)]``

    Raises:
        ValueError: for an unknown name or none, fewer than two values, another dtype than float32
            and float64, or a missing argument.

    Example:
        >>> describe(torch.tensor([1.0, 2.0, 2.0, 5.0]), ["mean", "mode", "range"])
        tensor([2.5000, 2.0000, 4.0000])
    """
    unknown = [name for name in names if name not in _DESCRIPTORS]
    if unknown:
        raise ValueError(f"unknown descriptors {unknown}; known are {', '.join(_DESCRIPTORS)}")
    if not names or x.dtype not in RUN_TOLERANCE:
        raise ValueError(f"expected float32 or float64 and a name, got {x.dtype} and {names}")
    if not x.ndim or x.shape[-1] < 2:
        raise ValueError(f"a sample needs at least two values, got shape {tuple(x.shape)}")
    sample = Sample(x, scale, None if reference is None else Sample(reference), frequency_hz)
    values = torch.stack([_DESCRIPTORS[name](sample) for name in names], dim=-1)
    if sample.is_ordinary:
        return values
    largest = torch.finfo(x.dtype).max
    return torch.where(
        sample.magnitude.isfinite()[..., None], values.clamp(-largest, largest), torch.nan
    )


def _frequency_axis(sample: Sample) -> Tensor:
    if sample.frequency_hz is None:
        raise ValueError("spectral_centroid and spectral_spread need frequency_hz=")
    return sample.frequency_hz.to(sample.x)
