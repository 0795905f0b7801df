"""Gradients at the extremes: finite, and within a bound of the exact gradient.

Each exact gradient is a short polynomial in the standardised values z; the bounds put the error of
z, ``eta``, and the forward error of the descriptor into it, to first order, and double the sum.
Gradients beyond the dtype saturate, those of ordered values may fall on any of equal values.
"""

import pytest
import torch
from exact import CTX, FLOAT64, Exact
from extreme_samples import KINDS, samples
from test_descriptors_exact import (
    DTYPES,
    EVERY,
    bound,
    exactly,
    measured,
    prepared,
    span_in_sigmas,
    third,
)

from tactslip_torch.features.guards import is_constant

ORDERED = ("median", "mode", "range", "iqr")
CENTRAL = ("mean_deviation", "std", "cv", "skewness", "kurtosis", "correlation")
WITH_UNIT = ("mean", "median", "range", "mean_deviation", "std", "iqr", "mode")


def eta(s: Exact):
    """Error of a standardised value, in ``[(n + 2 k + 8) eps k]`` with k the span in sigmas."""
    k = span_in_sigmas(s)
    return CTX.mpf(s.rules.eps) * k * (s.n + 2 * k + 8)


def mean_deviation_bound(s, e, n):
    """A value as near to the mean as the mean is uncertain may stand on either side of it."""
    near = [abs(d) <= (n + 3) * e * s.range for d in s.d]
    return [2 * (i + CTX.mpf(sum(near)) / n) / n + (n + 8) * e / n for i in near]


def cv_bound(s, e, n):
    divisor = abs(s.cv_divisor)
    off = bound(s, "mean") / divisor
    if 10 * off > 1 or abs(abs(s.mean) - s.cv_floor) <= bound(s, "mean"):
        return None  # the mean is lost in rounding: the definition itself is not resolved
    along = bound(s, "std") / s.std + 2 * off + (n + 8) * e
    return [2 * (eta(s) / (n * divisor) + abs(a) * off + abs(b) * along) for a, b in s.cv_terms()]


def skewness_bound(s, e, n):
    g, forward, rho = abs(s.skewness), bound(s, "skewness"), third(s)
    return [
        6 / (n * s.sigma) * ((2 * a + g + 1) * eta(s) + forward * a + n * e * (a**2 + 1 + rho * a))
        for a in map(abs, s.z)
    ]


def kurtosis_bound(s, e, n):
    k, odd, even, rho = s.kurtosis, bound(s, "skewness"), bound(s, "kurtosis"), third(s)
    return [
        8
        / (n * s.sigma)
        * ((3 * a**2 + k + 1) * eta(s) + odd + even * a + n * e * (a**3 + rho + k * a))
        for a in map(abs, s.z)
    ]


def correlation_bound(s, e, n):
    if s.reference.is_flat:
        return [0] * s.n
    forward, other = bound(s, "correlation"), s.reference
    return [
        2 / (n * s.sigma) * (eta(other) + eta(s) + forward * a + n * e * (a + b + 1))
        for a, b in zip(map(abs, s.z), map(abs, other.z), strict=True)
    ]


def centroid_bound(s, e, n):
    return [(2 * n + 8) * e * (f + s.spectral_centroid) / (s.total or CTX.inf) for f in s.hz]


def spread_bound(s, e, n):
    c, spread, off = s.spectral_centroid, s.spectral_spread, bound(s, "spectral_centroid")
    along = bound(s, "spectral_spread")
    if 10 * along > spread:
        return None if spread else [0] * s.n  # lines that rounding cannot tell from one
    gradient = s.gradient("spectral_spread")
    return [
        (2 * off * (abs(f - c) + f + c) + 2 * n * e * ((f - c) ** 2 + spread**2) + off**2)
        / (spread * s.total)
        + abs(g) * along / spread
        for f, g in zip(s.hz, gradient, strict=True)
    ]


BOUNDS = {
    "mean": lambda s, e, n: [4 * e / n] * s.n,
    "median": lambda s, e, n: [e] * s.n,
    "mode": lambda s, e, n: [e] * s.n,
    "range": lambda s, e, n: [4 * e] * s.n,
    "mean_deviation": mean_deviation_bound,
    "std": lambda s, e, n: [2 * eta(s) / CTX.sqrt(n * (n - 1))] * s.n,
    "cv": cv_bound,
    "iqr": lambda s, e, n: [4 * e] * s.n,
    "skewness": skewness_bound,
    "kurtosis": kurtosis_bound,
    "energy": lambda s, e, n: [2 * e * abs(v) for v in s.x],
    "peak_factor": lambda s, e, n: [
        (n + 8) * e * (abs(slope) + (1 / s.rms if s.rms and v == s.ordered[-1] else 0))
        for slope, v in zip(s.peak_slope() if s.rms else [0] * s.n, s.x, strict=True)
    ],
    "correlation": correlation_bound,
    "spectral_centroid": centroid_bound,
    "spectral_spread": spread_bound,
}
SMOOTH = [name for name in EVERY if name in BOUNDS]


def value_of(s: Exact, name: str):
    return min(s.modes()) if name == "mode" else getattr(s, name)


def by_value(s: Exact, gradient: list) -> list:
    """Equal values share what any of them gets."""
    sums: dict = {}
    for v, g in zip(s.x, gradient, strict=True):
        sums[v] = sums.get(v, CTX.mpf(0)) + g
    return [sums[v] for v in s.x]


def assert_gradient_right(got: list[float], s: Exact, name: str) -> None:
    e, n = CTX.mpf(s.rules.eps), CTX.mpf(s.n)
    if (s.is_flat and name in CENTRAL) or abs(value_of(s, name)) > s.rules.largest:
        assert not any(got)
        return
    gradient, allowed = s.gradient(name), BOUNDS[name](s, e, n)
    if allowed is None:
        return
    got = [CTX.mpf(g) for g in got]
    if name in ORDERED:
        got, gradient, allowed = (by_value(s, part) for part in (got, gradient, allowed))
    floor = s.rules.smallest * s.n + e**2 * max(name in WITH_UNIT, *map(abs, gradient))
    for g, value, off in zip(got, gradient, allowed, strict=True):
        miss = abs(g - s.rules.saturated(value))
        assert miss <= off + floor, f"{name}: {g}, exact {value}, bound {off}"


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_every_gradient_is_right_to_its_bound(kind, dtype):
    for x in samples(kind, dtype):
        for name in SMOOTH:
            leaf = prepared(x, name).clone().requires_grad_()
            (gradient,) = torch.autograd.grad(measured(leaf, name).sum(), leaf)
            assert gradient.isfinite().all(), name
            replaced = is_constant(x, x.abs().amax(-1))
            for row, got, still in zip(leaf.detach(), gradient, replaced, strict=True):
                if still and not name.startswith("spectral"):
                    assert not got.any()
                else:
                    assert_gradient_right(got.tolist(), exactly(row, name), name)


@pytest.mark.parametrize("name", SMOOTH)
def test_the_exact_gradient_is_the_slope_of_the_exact_value(name):
    """The oracle against itself: central differences with a step of 1e-15 at 50 digits."""
    x = [0.3, -1.25, 2.5, 0.75, -0.5, 1.0]
    x = [abs(v) for v in x] if name.startswith("spectral") else x
    other = Exact([1.0, 0.5, -2.0, 0.25, 3.0, -1.0], FLOAT64)
    step = CTX.mpf(10) ** -15

    def value(values):
        return value_of(Exact(values, FLOAT64, 2.5, other, range(6)), name)

    for i, slope in enumerate(Exact(x, FLOAT64, 2.5, other, range(6)).gradient(name)):
        up, down = ([v + sign * step * (j == i) for j, v in enumerate(x)] for sign in (1, -1))
        assert abs((value(up) - value(down)) / (2 * step) - slope) < 1e-25
