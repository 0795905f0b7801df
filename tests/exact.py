"""The 17 descriptors and their gradients at 50 digits, from REFERENCE.md section 4 alone.

Values are taken as the exact numbers that their floats are; nothing of the package is imported.
Rules that hang on the dtype (when a sample is constant, which values are equal, what settles the
exact halves of the entropy) come in through ``Rules``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise, product
from typing import Any

import mpmath

CTX = mpmath.mp.clone()  # a context of our own: precision is a global of mpmath
CTX.dps = 50
Number = Any  # mpmath carries no annotations


def exact(values: Sequence[float]) -> list[Number]:
    return [CTX.mpf(v) for v in values]


@dataclass(frozen=True)
class Rules:
    """What section 4 leaves to the dtype."""

    eps: float
    largest: float
    run_tolerance: str
    half_slack: str

    @property
    def smallest(self) -> Number:
        """The least positive number, a denormal."""
        digits = {2.0**-52: 1074, 2.0**-23: 149}[self.eps]
        return CTX.mpf(2) ** -digits

    def saturated(self, value: Number) -> Number:
        return max(min(value, CTX.mpf(self.largest)), -CTX.mpf(self.largest))


FLOAT64 = Rules(2.0**-52, (2 - 2.0**-52) * 2.0**1023, "1e-12", "1e-9")
FLOAT32 = Rules(2.0**-23, (2 - 2.0**-23) * 2.0**127, str(2.0**-20), str(2.0**-13))


def is_constant(x: Sequence[Number], scale: Number, rules: Rules) -> bool:
    return max(x) - min(x) < 16 * CTX.mpf(rules.eps) * scale


def average(values: Sequence[Number]) -> Number:
    return CTX.fsum(values) / len(values)


class Exact:
    """One settled sample; each descriptor is an attribute, its gradient ``gradient(name)``."""

    def __init__(
        self,
        x: Sequence[float],
        rules: Rules,
        scale: float | None = None,
        reference: Exact | None = None,
        hz: Sequence[float] = (),
    ) -> None:
        self.x, self.n, self.rules = exact(x), len(x), rules
        self.magnitude = max(abs(v) for v in self.x)
        self.scale = self.magnitude if scale is None else CTX.mpf(scale)
        self.reference, self.hz = reference, exact(hz)
        self.ordered = sorted(self.x)
        self.mean = average(self.x)
        self.d = [v - self.mean for v in self.x]
        self.range = self.ordered[-1] - self.ordered[0]
        self.is_flat = self.range == 0

    # Parts ---------------------------------------------------------------------------------

    def moment(self, k: int) -> Number:
        return average([d**k for d in self.d])

    @cached_property
    def sigma(self) -> Number:
        """Root of the second central moment."""
        return CTX.sqrt(self.moment(2))

    @cached_property
    def z(self) -> list[Number]:
        return [d / self.sigma for d in self.d]

    @cached_property
    def rms(self) -> Number:
        return CTX.sqrt(average([v**2 for v in self.x]))

    @cached_property
    def total(self) -> Number:
        return CTX.fsum(self.x)

    # Descriptors ---------------------------------------------------------------------------

    @cached_property
    def median(self) -> Number:
        return (self.ordered[(self.n - 1) // 2] + self.ordered[self.n // 2]) / 2

    def modes(self, slack: float = 0.0) -> set[Number]:
        """All values that a tolerance off by a share of ``slack`` may give."""
        found = set()
        for sign in (-1, 1):
            tolerance = CTX.mpf(self.rules.run_tolerance) * self.scale * (1 + sign * slack)
            runs = [[self.ordered[0]]]
            for low, high in pairwise(self.ordered):
                if high - low > tolerance:
                    runs.append([])
                runs[-1].append(high)
            found.add(max(runs, key=len)[0])
        return found

    @cached_property
    def mean_deviation(self) -> Number:
        return average([abs(d) for d in self.d])

    @cached_property
    def std(self) -> Number:
        return self.sigma * CTX.sqrt(CTX.mpf(self.n) / (self.n - 1))

    @cached_property
    def cv_floor(self) -> Number:
        return self.rms / 10**6

    @cached_property
    def cv_divisor(self) -> Number:
        size = max(abs(self.mean), self.cv_floor)
        return -size if self.mean < 0 else size

    @cached_property
    def cv(self) -> Number:
        return CTX.mpf(0) if self.is_flat else self.std / self.cv_divisor

    def quartile(self, q: float) -> list[tuple[int, Number]]:
        """Hazen: place and weight of the sorted values that make it up."""
        position = min(max(CTX.mpf(q) * self.n - CTX.mpf("0.5"), 0), self.n - 1)
        below = int(position)
        share = position - below
        return [(below, 1 - share), (min(below + 1, self.n - 1), share)]

    @cached_property
    def iqr(self) -> Number:
        high, low = (sum(w * self.ordered[i] for i, w in self.quartile(q)) for q in (0.75, 0.25))
        return high - low

    @cached_property
    def skewness(self) -> Number:
        return CTX.mpf(0) if self.is_flat else self.moment(3) / self.sigma**3

    @cached_property
    def kurtosis(self) -> Number:
        return CTX.mpf(3) if self.is_flat else self.moment(4) / self.sigma**4

    @cached_property
    def energy(self) -> Number:
        return CTX.fsum([v**2 for v in self.x])

    def entropies(self, slack: float = 0.0) -> list[Number]:
        """All values that levels off by ``slack`` may give (255 levels span the range)."""
        if self.is_flat:
            return [CTX.mpf(0)]
        half = CTX.mpf("0.5") + CTX.mpf(self.rules.half_slack)
        least = self.ordered[0]
        choices = []
        for value, same in groupby(self.ordered):
            level, count = 255 * (value - least) / self.range + half, len(list(same))
            slacks = (0,) if value in (least, self.ordered[-1]) else (-slack, slack)
            choices.append([(q, count) for q in {int(CTX.floor(level + s)) for s in slacks}])
        return [self._entropy(levels) for levels in product(*choices)]

    def _entropy(self, levels: Sequence[tuple[int, int]]) -> Number:
        counts: dict[int, int] = {}
        for level, count in levels:
            counts[level] = counts.get(level, 0) + count
        *lower, second, top = [counts[q] for q in sorted(counts)]
        shares = [CTX.mpf(c) / self.n for c in (*lower, second + top)]
        return -CTX.fsum([p * CTX.log(p + CTX.mpf(2) ** -52, 2) for p in shares])

    @cached_property
    def peak_factor(self) -> Number:
        return self.ordered[-1] / self.rms if self.rms else CTX.mpf(0)

    @cached_property
    def correlation(self) -> Number:
        if self.is_flat or self.reference.is_flat:
            return CTX.mpf(0)
        return average([a * b for a, b in zip(self.z, self.reference.z, strict=True)])

    @cached_property
    def spectral_centroid(self) -> Number:
        if not self.total:
            return CTX.mpf(0)
        return CTX.fsum([f * v for f, v in zip(self.hz, self.x, strict=True)]) / self.total

    @cached_property
    def spectral_spread(self) -> Number:
        if not self.total:
            return CTX.mpf(0)
        c = self.spectral_centroid
        square = CTX.fsum([(f - c) ** 2 * v for f, v in zip(self.hz, self.x, strict=True)])
        return CTX.sqrt(square / self.total)

    # Gradients -----------------------------------------------------------------------------

    def gradient(self, name: str) -> list[Number]:
        """With respect to the values. Of ordered values: as if sorted stably (see ``places``)."""
        still = name in ("mean_deviation", "std", "cv", "skewness", "kurtosis", "correlation")
        if self.is_flat and still:
            return [CTX.mpf(0)] * self.n
        return getattr(self, f"_d_{name}")()

    def places(self, weights: Sequence[tuple[int, Number]]) -> list[Number]:
        """Weights of sorted places, given to the values that stand there."""
        order = sorted(range(self.n), key=lambda i: self.x[i])
        gradient = [CTX.mpf(0)] * self.n
        for place, weight in weights:
            gradient[order[place]] += weight
        return gradient

    def _d_mean(self) -> list[Number]:
        return [CTX.mpf(1) / self.n] * self.n

    def _d_median(self) -> list[Number]:
        half = CTX.mpf("0.5")
        return self.places([((self.n - 1) // 2, half), (self.n // 2, half)])

    def _d_mode(self) -> list[Number]:
        return self.places([(self.ordered.index(min(self.modes())), CTX.mpf(1))])

    def _d_range(self) -> list[Number]:
        return self.places([(self.n - 1, CTX.mpf(1)), (0, CTX.mpf(-1))])

    def _d_iqr(self) -> list[Number]:
        return self.places(self.quartile(0.75) + [(i, -w) for i, w in self.quartile(0.25)])

    def _d_mean_deviation(self) -> list[Number]:
        signs = [CTX.sign(d) for d in self.d]
        return [(s - average(signs)) / self.n for s in signs]

    def _d_std(self) -> list[Number]:
        return [d / ((self.n - 1) * self.std) for d in self.d]

    def cv_terms(self) -> list[tuple[Number, Number]]:
        """What comes of the numerator and of the divisor: std'/D and std D'/D^2."""
        divisor, n = self.cv_divisor, self.n
        if abs(self.mean) > self.cv_floor:
            growth = [CTX.mpf(1) / n] * n
        else:
            sign = CTX.sign(divisor)
            growth = [sign * v / (n * self.rms * 10**6) for v in self.x]
        slope = zip(self._d_std(), growth, strict=True)
        return [(up / divisor, self.cv * down / divisor) for up, down in slope]

    def _d_cv(self) -> list[Number]:
        return [a - b for a, b in self.cv_terms()]

    def _d_skewness(self) -> list[Number]:
        return [3 * (z**2 - 1 - self.skewness * z) / (self.n * self.sigma) for z in self.z]

    def _d_kurtosis(self) -> list[Number]:
        g, k = self.skewness, self.kurtosis
        return [4 * (z**3 - g - k * z) / (self.n * self.sigma) for z in self.z]

    def _d_energy(self) -> list[Number]:
        saturates = self.energy > self.rules.largest
        return [CTX.mpf(0) if saturates else 2 * v for v in self.x]

    def _d_peak_factor(self) -> list[Number]:
        if not self.rms:
            return [CTX.mpf(0)] * self.n
        ties = self.ordered.count(self.ordered[-1])  # which share evenly
        tip = [1 / (self.rms * ties) if v == self.ordered[-1] else CTX.mpf(0) for v in self.x]
        return [t + s for t, s in zip(tip, self.peak_slope(), strict=True)]

    def peak_slope(self) -> list[Number]:
        """The part of the peak factor's gradient that is the rms's."""
        return [-self.peak_factor * v / (self.n * self.rms**2) for v in self.x]

    def _d_correlation(self) -> list[Number]:
        if self.reference.is_flat:
            return [CTX.mpf(0)] * self.n
        both = zip(self.z, self.reference.z, strict=True)
        return [(w - self.correlation * z) / (self.n * self.sigma) for z, w in both]

    def _d_spectral_centroid(self) -> list[Number]:
        if not self.total:
            return [CTX.mpf(0)] * self.n
        return [(f - self.spectral_centroid) / self.total for f in self.hz]

    def _d_spectral_spread(self) -> list[Number]:
        c, s = self.spectral_centroid, self.spectral_spread
        if not s:
            return [CTX.mpf(0)] * self.n
        return [((f - c) ** 2 - s**2) / (2 * s * self.total) for f in self.hz]


def band_energy_ratios(spectra: Sequence[Sequence[float]]) -> list[Number]:
    energies = [CTX.fsum([v**2 for v in exact(lines)]) for lines in spectra]
    whole = CTX.fsum(energies)
    return [e / whole if whole else CTX.mpf(0) for e in energies]


def band_energy_gradient(
    spectra: Sequence[Sequence[float]], branch: int | None
) -> list[list[Number]]:
    """Of one branch's ratio with respect to every line; of no branch: 2 P / sum of all energies."""
    ratio = CTX.mpf(-1) if branch is None else band_energy_ratios(spectra)[branch]
    whole = CTX.fsum([v**2 for lines in spectra for v in exact(lines)]) or CTX.inf
    return [
        [2 * v * ((b == branch) - ratio) / whole for v in exact(lines)]
        for b, lines in enumerate(spectra)
    ]
