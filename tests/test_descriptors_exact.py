"""Every descriptor at the extremes: finite, and within its stated bound of the exact value."""

import pytest
import torch
from exact import CTX, FLOAT32, FLOAT64, Exact, band_energy_gradient, band_energy_ratios
from exact import is_constant as is_constant_exactly
from extreme_samples import KINDS, samples

from tactslip_torch.features.descriptors import (
    TIME_DESCRIPTORS,
    band_energy_ratio,
    describe,
)
from tactslip_torch.features.guards import is_constant, settle

RULES = {torch.float64: FLOAT64, torch.float32: FLOAT32}
DTYPES = list(RULES)
SPECTRAL = ("spectral_centroid", "spectral_spread")
EVERY = (*TIME_DESCRIPTORS, *SPECTRAL)


def axis(num: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.arange(num, dtype=dtype) * 20


def prepared(x: torch.Tensor, name: str) -> torch.Tensor:
    """A spectrum has no negative line."""
    return x.abs() if name in SPECTRAL else x


def measured(x: torch.Tensor, name: str) -> torch.Tensor:
    """One descriptor of samples, which are settled first unless they are spectra."""
    scale = x.detach().abs().amax(-1)
    settled = x if name in SPECTRAL else settle(x, scale)
    reference = settle(x.detach().flip(-1).sin(), scale)
    hz = axis(x.shape[-1], x.dtype)
    return describe(settled, [name], scale=scale, reference=reference, frequency_hz=hz)[..., 0]


def exactly(x: torch.Tensor, name: str) -> Exact:
    """The same sample [n] for the oracle; settled by the package, which has a test of its own."""
    rules, scale = RULES[x.dtype], x.abs().max()
    settled = x if name in SPECTRAL else settle(x, scale)
    reference = Exact(settle(x.flip(-1).sin(), scale).tolist(), rules)
    return Exact(settled.tolist(), rules, scale.item(), reference, axis(len(x), x.dtype).tolist())


# The bounds of descriptors.py, from exact data --------------------------------------------------


def span_in_sigmas(s: Exact):
    return CTX.mpf(0) if s.is_flat else s.range / s.sigma


def third(s: Exact):
    """Mean absolute third moment of the standardised values."""
    return CTX.mpf(0) if s.is_flat else sum(abs(z) ** 3 for z in s.z) / s.n


BOUNDS = {
    "mean": lambda s, e, n, k: e * ((n / 2 + 1) * s.range + abs(s.mean)),
    "median": lambda s, e, n, k: e * abs(s.median),
    "range": lambda s, e, n, k: e * s.range,
    "mean_deviation": lambda s, e, n, k: e * (n + 3) * s.range,
    "std": lambda s, e, n, k: e * (2 * s.range + (n + 4) * s.std),
    "iqr": lambda s, e, n, k: 10 * e * s.iqr + e**4 * s.magnitude,
    "skewness": lambda s, e, n, k: e * ((2 * n + 11) * k + (2 * n + 5 * k + 12) * third(s)),
    "kurtosis": lambda s, e, n, k: (
        e * ((2 * n + 14) * k * third(s) + (2 * n + 7 * k + 15) * s.kurtosis)
    ),
    "energy": lambda s, e, n, k: e * n / 2 * s.energy + n * s.rules.smallest,
    "peak_factor": lambda s, e, n, k: e * (n / 4 + 2) * abs(s.peak_factor) + e**3,
    "correlation": lambda s, e, n, k: e * (n + 8 + 4 * k + 4 * span_in_sigmas(s.reference)),
    "spectral_centroid": lambda s, e, n, k: e * (n + 1) * s.spectral_centroid + n * e**3 * s.hz[-1],
    "spectral_spread": lambda s, e, n, k: (
        e * ((n + 2) * s.spectral_centroid + (n / 2 + 2) * s.spectral_spread)
        + e**2 * CTX.sqrt(n) * s.hz[-1]
    ),
}


def bound(s: Exact, name: str):
    e, n = CTX.mpf(s.rules.eps), CTX.mpf(s.n)
    return BOUNDS[name](s, e, n, span_in_sigmas(s)) + s.rules.smallest


def cv_bounds(s: Exact):
    """Least and largest magnitude, and whether the sign is decided."""
    e, n = CTX.mpf(s.rules.eps), CTX.mpf(s.n)
    off, relative = bound(s, "mean"), bound(s, "std") / s.std + (n / 4 + 4) * e
    size = abs(s.cv_divisor)
    least = s.std / (size + off) * (1 - relative)
    return least, s.std / max(size - off, s.cv_floor) * (1 + relative), abs(s.mean) > off


def assert_right(got: float, s: Exact, name: str) -> None:
    e = CTX.mpf(s.rules.eps)
    if name == "mode":
        assert CTX.mpf(got) in s.modes(4 * s.rules.eps)
    elif name == "entropy":
        allowed = s.entropies(640 * s.rules.eps)  # 255 levels, five roundings
        assert min(abs(CTX.mpf(got) - h) - s.n * e * (h + 2) for h in allowed) <= 0, got
    elif name == "cv" and not s.is_flat:
        least, most, has_sign = cv_bounds(s)
        assert least <= abs(CTX.mpf(got)) <= most
        assert not has_sign or got * s.mean >= 0
    else:
        value = s.rules.saturated(getattr(s, name))
        allowed = 0 if name == "cv" else bound(s, name)
        assert abs(CTX.mpf(got) - value) <= allowed, f"{got!r}, exact {value}, bound {allowed}"


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_every_descriptor_is_right_to_its_bound(kind, dtype):
    for x in samples(kind, dtype):
        for name in EVERY:
            rows = prepared(x, name)
            for row, got in zip(rows, measured(rows, name).tolist(), strict=True):
                assert_right(got, exactly(row, name), name)


@pytest.mark.parametrize("name", [name for name in BOUNDS if name != "correlation"])
def test_the_bounds_of_ordinary_samples_are_small(name):
    """A bound that allows anything proves nothing."""
    for dtype, share in ((torch.float64, 1e-12), (torch.float32, 6e-4)):
        for x in samples("plain", dtype):
            for row in x[:, :100] if x.shape[-1] > 50 else []:
                s = exactly(prepared(row, name), name)
                natural = s.range if name in ("mean", "median") else 1 if name == "skewness" else 0
                assert bound(s, name) <= share * max(abs(getattr(s, name)), natural)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_settling_is_right_to_its_bound(kind, dtype):
    rules = RULES[dtype]
    for x in samples(kind, dtype):
        scale = x.abs().amax(-1) * torch.tensor([1.0, 1e6, 2.0**40], dtype=dtype)[:, None]
        scale = scale.clamp(max=torch.finfo(dtype).max)
        for magnitude in scale:
            settled, said = settle(x, magnitude), is_constant(x, magnitude)
            for i, row in enumerate(x):
                s = Exact(row.tolist(), rules)
                constant = is_constant_exactly(s.x, CTX.mpf(magnitude[i].item()), rules)
                assert said[i].item() == constant
                if not constant:
                    assert torch.equal(settled[i], row)
                    continue
                assert len(settled[i].unique()) == 1
                assert abs(CTX.mpf(settled[i, 0].item()) - s.mean) <= bound(s, "mean")


# Band energy ratio ---------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_band_energy_ratios_are_right_to_their_bound(kind, dtype):
    e = CTX.mpf(RULES[dtype].eps)
    for x in samples(kind, dtype):
        spectra = x.abs().requires_grad_()
        num, branches = x.shape[-1] + 8, len(x)
        ratios = band_energy_ratio(spectra)
        for got, value in zip(ratios.tolist(), band_energy_ratios(spectra.tolist()), strict=True):
            assert abs(CTX.mpf(got) - value) <= e * (num + branches) * value + num * e**1.5
        (gradient,) = torch.autograd.grad(ratios[0], spectra)
        assert gradient.isfinite().all()
        lines = band_energy_gradient(spectra.tolist(), 0)
        parts = band_energy_gradient(spectra.tolist(), None)  # 2 P / sum, of which it is made
        for got, line, part in zip(gradient.tolist(), lines, parts, strict=True):
            for g, value, size in zip(got, line, part, strict=True):
                off = abs(CTX.mpf(g) - RULES[dtype].saturated(value))
                assert off <= 2 * e * (num + branches) * size + RULES[dtype].smallest
