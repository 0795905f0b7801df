"""The descriptors of rows, as nodes: ``features.descriptors`` on values of order one."""

from __future__ import annotations

from collections.abc import Callable

from tactslip_torch.features.descriptors import CV_FLOOR
from tactslip_torch.graph.order import entropy as level_entropy
from tactslip_torch.graph.order import interquartile, medians, modes
from tactslip_torch.graph.shared import NEXT_TO_NOTHING, Part, Shared
from tactslip_torch.graph.value import F64

# Each of these is a number for each row it is wanted of, [B, R'], float64, in its unit.


def mean(x: Shared) -> Part:
    """Arithmetic mean."""
    places = x.all_rows
    return x.in_volts(x.mean(places), places)


def std(x: Shared) -> Part:
    """Standard deviation with ``n - 1``."""
    places = x.all_rows
    square = x.variance().of(places) * (x.num / (x.num - 1))
    return x.in_volts(square.sqrt(), places)


def cv(x: Shared) -> Part:
    """Standard deviation over the mean, whose magnitude counts as at least 1e-6 of the rms."""
    places = x.all_rows
    mean = x.mean(places)
    floor = mean.abs().max(x.rms(places) * CV_FLOOR)
    signed = x.graph.where(mean < 0.0, -floor, floor)
    square = x.variance().of(places) * (x.num / (x.num - 1))
    return Part(square.sqrt() / signed, places)


def range_(x: Shared) -> Part:
    """Largest minus smallest."""
    places = x.all_rows
    values = x.values(places)
    return x.in_volts((values.amax() - values.amin()).cast(F64), places)


def mean_deviation(x: Shared) -> Part:
    """Mean absolute deviation."""
    places = x.all_rows
    return x.in_volts(x.centred().of(places).abs().mean().cast(F64), places)


def skewness(x: Shared) -> Part:
    """Third moment over the 3/2 power of the second; 0 if flat."""
    third = x.third()
    variance = x.safe_variance(third.places)
    return Part(third.value / (variance * variance.sqrt()), third.places)


def kurtosis(x: Shared) -> Part:
    """Fourth moment over the squared second; 3 if flat."""
    fourth = x.fourth()
    variance = x.safe_variance(fourth.places)
    is_flat = x.variance().of(fourth.places).equals(0.0).cast(F64)
    return Part(fourth.value / (variance * variance) + is_flat * 3.0, fourth.places)


def energy(x: Shared) -> Part:
    """Sum of squares."""
    places = x.all_rows
    mean, unit = x.mean(places), x.unit(places)
    square = mean * mean + x.variance().of(places)
    return Part(square * unit * unit * float(x.num), places)


def peak_factor(x: Shared) -> Part:
    """Maximum over rms."""
    places = x.all_rows
    largest = x.values(places).amax().cast(F64)
    if x.rows.mean is not None:
        largest = largest + x.mean(places)
    return Part(largest / x.rms(places), places)


def correlation(x: Shared) -> Part:
    """Correlation with the filtered bin; 0 if either is flat."""
    places = x.of_rows(("correlation",))
    film = x.rows.film
    if film is None:
        raise ValueError("correlation needs the film that rows are branches of")
    other = x.of_all(film, places)
    own = x.safe_variance(places)
    covariance = (x.centred().of(places) * other).mean().cast(F64)
    theirs = (other * other).mean().cast(F64)
    return Part(covariance / (own * theirs.max(NEXT_TO_NOTHING)).sqrt(), places)


def spectral_centroid(x: Shared) -> Part:
    """Mean frequency."""
    return x.centroid_and_spread()[0]


def spectral_spread(x: Shared) -> Part:
    """Root mean squared distance from it."""
    return x.centroid_and_spread()[1]


def median(x: Shared) -> Part:
    """Middle value."""
    places = x.of_rows(("median",))
    value = medians(x.values(places), x.num).cast(F64)
    return x.in_volts(x.with_mean(value, places), places)


def iqr(x: Shared) -> Part:
    """Interquartile range."""
    places = x.of_rows(("iqr",))
    return x.in_volts(interquartile(x.values(places), x.num).cast(F64), places)


def mode(x: Shared) -> Part:
    """Most frequent value."""
    places = x.of_rows(("mode",))
    if x.rows.scale is None:
        raise ValueError("mode needs the scale of the bins that rows are of")
    scale = x.of_all(x.rows.scale, places)
    value = modes(x.graph, x.values(places), scale, x.num)
    return x.in_volts(x.with_mean(value, places), places)


def entropy(x: Shared) -> Part:
    """Entropy of the amplitude histogram."""
    places = x.of_rows(("entropy",))
    return Part(level_entropy(x.values(places), x.num, x.dtype), places)


DESCRIPTORS: dict[str, Callable[[Shared], Part]] = {
    "mean": mean,
    "std": std,
    "cv": cv,
    "range": range_,
    "mean_deviation": mean_deviation,
    "skewness": skewness,
    "kurtosis": kurtosis,
    "energy": energy,
    "peak_factor": peak_factor,
    "correlation": correlation,
    "spectral_centroid": spectral_centroid,
    "spectral_spread": spectral_spread,
    "median": median,
    "iqr": iqr,
    "mode": mode,
    "entropy": entropy,
}
"""Every descriptor by its name."""
