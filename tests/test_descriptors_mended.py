"""Faults found against exact arithmetic, each by name; and that guards cost no digit."""

import math

import pytest
import torch
from test_descriptors import EVERY, measure

from tactslip_torch.features import descriptors, sample
from tactslip_torch.features.descriptors import band_energy_ratio, describe
from tactslip_torch.features.guards import is_constant, stretch

DTYPES = [torch.float64, torch.float32]
SECOND = ["std", "cv", "skewness", "kurtosis", "peak_factor", "correlation", "spectral_spread"]


def smallest(dtype):
    facts = torch.finfo(dtype)
    return facts.tiny * facts.eps


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_span_beyond_the_dtype_spoils_nothing(dtype):
    """Was NaN in every column: max - min is Inf."""
    largest = torch.finfo(dtype).max
    x = torch.tensor([1.0, -1.0, 0.5, 0.0], dtype=dtype) * largest
    got = dict(zip(EVERY, measure(x).tolist(), strict=True))
    plain = dict(zip(EVERY, measure(x / largest).tolist(), strict=True))
    for name in ("cv", "skewness", "kurtosis", "entropy", "peak_factor", "correlation"):
        assert got[name] == pytest.approx(plain[name], rel=1e-6), name
    for name in ("mean", "median", "mode", "mean_deviation", "std"):
        assert got[name] / largest == pytest.approx(plain[name], rel=1e-6), name
    assert got["range"] == got["energy"] == largest  # 2 largest, more than its square
    x.requires_grad_()
    describe(x, ["range", "energy"]).sum().backward()
    assert not x.grad.any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_median_of_two_largest_numbers(dtype):
    """Was Inf: their sum is."""
    x = torch.full((4,), torch.finfo(dtype).max, dtype=dtype)
    assert torch.equal(describe(x, ["median", "mean"]), x[:2])


def test_the_iqr_keeps_its_digits_beside_an_outlier():
    """Was 0: quantiles were taken above the minimum."""
    x = torch.tensor([-1e20, 1, 2, 3, 4, 5, 6, 7], dtype=torch.float64)
    assert describe(x, ["iqr"]).item() == 4


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_mean_of_integers_around_zero_is_zero(dtype):
    """Was a rounding error after division by the span, and with it the sign of cv was."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randint(-40, 41, (200, 49), generator=generator).to(dtype)
    x = torch.cat([x, -x[:, torch.randperm(49, generator=generator)]], dim=-1)
    mean, cv, std = describe(x, ["mean", "cv", "std"]).unbind(-1)
    assert not mean.any()
    assert (cv > 0).all()
    rms = (x * x).mean(-1).sqrt()
    torch.testing.assert_close(cv, std / (1e-6 * rms), rtol=1e-5, atol=0)


def test_exact_halves_of_the_entropy_in_float32():
    """Were decided by rounding: 1e-9 is nothing to a float32."""
    generator = torch.Generator().manual_seed(0)
    levels = torch.randint(0, 511, (50, 30), generator=generator).float()
    levels[:, 0], levels[:, 1] = 0, 510
    expected = describe(levels.double(), ["entropy"])
    for factor in (0.1, 0.3, 7.7):
        entropy = describe(factor * levels, ["entropy"])
        torch.testing.assert_close(entropy.double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", DTYPES)
def test_tolerances_of_denormals_are_not_rounded(dtype):
    """16 eps of the scale and the tolerance of ties were rounded to whole smallest numbers."""
    step, eps = smallest(dtype), torch.finfo(dtype).eps
    scale = torch.tensor(1.25 / (16 * eps) * step, dtype=dtype)
    x = torch.tensor([0.0, step, step], dtype=dtype)
    assert is_constant(x, scale)  # one step is less than 1.25 of them
    share = descriptors.RUN_TOLERANCE[dtype]
    scale = torch.tensor(0.75 / share * step, dtype=dtype)
    assert describe(x, ["mode"], scale=scale).item() == step  # one step is more than 0.75


# Gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_of_denormals_saturate(dtype):
    """Were Inf, and NaN where two of them met."""
    x = torch.tensor([3.0, -1.0, 4.0, 1.0, -5.0, 9.0], dtype=dtype) * smallest(dtype)
    x.requires_grad_()
    hz = torch.arange(6, dtype=dtype)
    values = describe(x.abs(), EVERY, reference=x.detach().flip(-1), frequency_hz=hz)
    (gradient,) = torch.autograd.grad(values.sum(), x)
    assert gradient.isfinite().all()
    assert gradient.abs().max() == torch.finfo(dtype).max
    (gradient,) = torch.autograd.grad(describe(x, ["mean"]).sum(), x)
    torch.testing.assert_close(gradient, torch.full_like(x, 1 / 6))
    (gradient,) = torch.autograd.grad(band_energy_ratio(x.reshape(2, 3))[0], x)
    assert gradient.isfinite().all()


def test_saturation_holds_under_function_transforms():
    x = 1e-310 * torch.randn(4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    names = ["cv", "skewness", "kurtosis", "peak_factor"]
    gradient = torch.vmap(torch.func.grad(lambda row: describe(row, names).sum()))(x)
    assert gradient.isfinite().all()
    assert gradient.abs().max() == torch.finfo(torch.float64).max


@pytest.mark.parametrize("dtype", DTYPES)
def test_no_gradient_where_there_is_no_definition(dtype):
    """Silence has no peak and no centroid, a single line no spread; some gradients were not 0."""
    silence = torch.zeros(5, dtype=dtype, requires_grad=True)
    line = torch.tensor([0.0, 0.0, 2.0, 0.0, 0.0], dtype=dtype, requires_grad=True)
    spectral = ("spectral_centroid", "spectral_spread")
    for x, names in ((silence, ("cv", "peak_factor", *spectral)), (line, spectral[1:])):
        for name in names:
            value = describe(x, [name], frequency_hz=torch.arange(5, dtype=dtype))
            (gradient,) = torch.autograd.grad(value.sum(), x)
            assert value.item() == 0, name
            assert not gradient.any(), name


@pytest.mark.parametrize("name", SECOND)
def test_second_derivatives(name, rng):
    x = torch.from_numpy(rng.permutation(7) + rng.uniform(0.5, 1, 7)).requires_grad_()
    reference = torch.from_numpy(rng.standard_normal(7))
    assert torch.autograd.gradgradcheck(lambda x: measure(x, [name], reference=reference), x)


# What guards cost: nothing --------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_guards_change_no_bit_of_ordinary_samples(dtype, monkeypatch):
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(60, 50, generator=generator, dtype=torch.float64)
    x = (x * 10 ** (-8 + 20 * torch.rand(60, 1, generator=generator).double())).to(dtype)
    reference = x.flip(-1).contiguous()

    def both():
        leaf = x.clone().requires_grad_()
        values = measure(leaf, EVERY[:14], reference=reference)
        spectral = measure(leaf.abs(), EVERY[14:], reference=reference)
        smooth = [i for i, name in enumerate(EVERY[:14]) if name not in ("mode", "entropy")]
        return (
            values,
            spectral,
            torch.autograd.grad((values[:, smooth].tanh().sum(), spectral.sum()), leaf)[0],
        )

    guarded = both()
    monkeypatch.setattr(sample, "stretch", torch.ones_like)
    monkeypatch.setattr(sample, "bounded_gradient", lambda x: x.view_as(x))
    for with_guards, without in zip(guarded, both(), strict=True):
        assert torch.equal(with_guards, without)


def test_ordinary_values_are_the_plain_formulas_to_the_bit(rng):
    x = torch.from_numpy(3 + rng.standard_normal((20, 50)))
    mean = x[:, 0] + (x - x[:, :1]).mean(-1)
    d = (x - x[:, :1]) - (x - x[:, :1]).mean(-1, keepdim=True)
    ordered = x.sort(-1).values
    plain = {
        "mean": mean,
        "median": (ordered[:, 24] + ordered[:, 25]) / 2,
        "range": x.amax(-1) - x.amin(-1),
        "mean_deviation": d.abs().mean(-1),
        "std": ((d * d).mean(-1) * (50 / 49)).sqrt(),
        "energy": (x * x).sum(-1),
        "peak_factor": x.amax(-1) / (x * x).mean(-1).sqrt(),
    }
    got = describe(x, list(plain))
    for column, (name, values) in enumerate(plain.items()):
        assert torch.equal(got[:, column], values), name


@pytest.mark.parametrize(("dtype", "unit"), [(torch.float64, 64), (torch.float32, 8)])
def test_the_stretch_is_one_between_its_ends_and_leads_back_beyond(dtype, unit):
    """A power of two everywhere, after which sizes lie between 2^-320 and 2^448 again."""
    lowest, highest = -1074 // 64 * unit, 16 * unit - 1
    exponent = torch.arange(lowest, highest)
    size = torch.ldexp(torch.ones(len(exponent), dtype=dtype), exponent)
    factor = stretch(size)
    power = factor.log2()
    assert torch.equal(power, power.round())
    is_ordinary = (exponent >= -5 * unit) & (exponent <= 7 * unit)
    assert torch.equal(power == 0, is_ordinary)
    after = exponent + power
    assert bool(((after >= -5 * unit) & (after <= 7 * unit)).all())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", ["mean", "std", "mean_deviation", "iqr", "range"])
def test_gradients_of_what_has_the_unit_of_x_are_the_same_at_every_size(name, dtype):
    """Once NaN for std from 2^448 on (1e17 in float32), and 0 below 2^-320: a root of squares."""
    x = torch.randn(40, dtype=dtype, generator=torch.Generator().manual_seed(2))
    top = math.frexp(torch.finfo(dtype).max)[1]

    def gradient(exponent):
        scaled = torch.ldexp(x, torch.tensor(exponent)).requires_grad_()
        describe(scaled, [name]).sum().backward()
        return scaled.grad

    expected = gradient(0)
    for exponent in range(-top + 8, top - 8, max(1, top // 100)):
        torch.testing.assert_close(gradient(exponent), expected, rtol=1e-5, atol=1e-7)
