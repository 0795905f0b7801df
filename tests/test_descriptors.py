import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats
from torch.autograd import forward_ad

from tactslip_torch.features.descriptors import (
    SPECTRUM_DESCRIPTORS,
    TIME_DESCRIPTORS,
    band_energy_ratio,
    describe,
)
from tactslip_torch.features.guards import settle

EVERY = (*TIME_DESCRIPTORS, "spectral_centroid", "spectral_spread")
UNSMOOTH = ("mode", "entropy")
SMOOTH = [name for name in EVERY if name not in UNSMOOTH]
LENGTHS = [3, 5, 50, 64, 99, 100, 101]
DEGREE = {  # the power of a in describe(a x), a > 0; every other descriptor ignores a
    **dict.fromkeys(["mean", "median", "mode", "range", "mean_deviation", "std", "iqr"], 1),
    "energy": 2,
}


def axis(num_samples):
    return oracles.frequency_axis_hz(num_samples, 2000.0)


def measure(x, names=EVERY, reference=None, **options):
    """``describe`` on tensors or arrays [*, n], with every option filled in."""
    x = torch.as_tensor(x)
    reference = x.flip(-1) if reference is None else torch.as_tensor(reference)
    hz = torch.from_numpy(axis(x.shape[-1]))
    return describe(x, names, reference=reference, frequency_hz=hz, **options)


def value(x, name, **options):
    return measure(np.asarray(x, dtype=np.float64), [name], **options).item()


def with_offset(rng, *shape):
    return 3 + 1e-3 * rng.standard_normal(shape)


MAKERS = [oracles.random_bins, oracles.integer_bins, with_offset]


def test_names_and_their_order():
    assert TIME_DESCRIPTORS == oracles.TIME_DESCRIPTORS
    assert SPECTRUM_DESCRIPTORS == oracles.SPECTRUM_DESCRIPTORS


def test_the_oracle_agrees_with_scipy_and_numpy(rng):
    x, y = rng.standard_normal((2, 100))
    expected = {
        "skewness": stats.skew(x),
        "kurtosis": stats.kurtosis(x, fisher=False),
        "cv": stats.variation(x, ddof=1),
        "iqr": stats.iqr(x, interpolation="hazen"),
        "std": x.std(ddof=1),
        "correlation": stats.pearsonr(x, y).statistic,
        "mode": x.min(),
    }
    actual = oracles.describe(x, tuple(expected), reference=y)
    np.testing.assert_allclose(actual, list(expected.values()), rtol=1e-12)
    x = rng.integers(0, 7, 100).astype(float)  # level 6 is its own edge, level 5's cell takes it
    x[:2] = 0, 255
    counts = np.unique(x, return_counts=True)[1]
    counts = [*counts[:-2], counts[-2] + counts[-1]]
    assert oracles.entropy(x) == pytest.approx(stats.entropy(counts, base=2), rel=1e-12)
    assert oracles.mode(x, 1.0) == stats.mode(x).mode


@pytest.mark.parametrize("num_samples", LENGTHS)
@pytest.mark.parametrize("make", MAKERS)
def test_time_descriptors_equal_the_oracle(num_samples, make, rng):
    x, reference = make(rng, 60, num_samples), make(rng, 60, num_samples)
    scale = np.abs(reference).max(-1)
    moving = np.ptp(x, axis=-1) > 0  # three integers may all be equal
    x, reference, scale = x[moving], reference[moving], scale[moving]
    expected = np.stack(
        [
            oracles.describe(one, TIME_DESCRIPTORS, scale=s, reference=r)
            for one, r, s in zip(x, reference, scale, strict=True)
        ]
    )
    actual = describe(
        torch.from_numpy(x),
        TIME_DESCRIPTORS,
        scale=torch.from_numpy(scale),
        reference=torch.from_numpy(reference),
    )
    oracles.assert_columns_close(actual, expected, names=list(TIME_DESCRIPTORS))


@pytest.mark.parametrize("num_samples", LENGTHS)
@pytest.mark.parametrize("make", MAKERS)
def test_spectrum_descriptors_equal_the_oracle(num_samples, make, rng):
    x = make(rng, 60, num_samples)
    spectra = np.stack([oracles.amplitude_spectrum(one) for one in x])
    hz = axis(num_samples)
    expected = np.stack(
        [oracles.describe(one, SPECTRUM_DESCRIPTORS, frequency_hz=hz) for one in spectra]
    )
    actual = describe(
        torch.from_numpy(spectra), SPECTRUM_DESCRIPTORS, frequency_hz=torch.from_numpy(hz)
    )
    oracles.assert_columns_close(actual, expected, names=list(SPECTRUM_DESCRIPTORS))


@given(
    x=hnp.arrays(
        np.float64,
        st.tuples(st.just(3), st.integers(2, 40)),
        elements=st.integers(-3, 3).map(float) | st.floats(-8, 8, width=16),
    ).filter(lambda x: (np.ptp(x, axis=-1) > 0).all())
)
def test_equal_the_oracle_on_whatever_hypothesis_finds(x):
    """Few values, many ties, zero means: relative to the value, or to a shape of order one."""
    reference = np.random.default_rng(0).standard_normal(x.shape)
    expected = np.stack(
        [
            oracles.describe(one, EVERY, reference=r, frequency_hz=axis(x.shape[1]))
            for one, r in zip(np.abs(x) + (np.arange(x.shape[1]) == 0), reference, strict=True)
        ]
    )
    x = np.abs(x) + (np.arange(x.shape[1]) == 0)  # a spectrum has no negative line
    np.testing.assert_allclose(
        measure(x, reference=reference), expected, rtol=1e-9, atol=1e-10 * np.abs(x).max()
    )


def test_names_come_in_any_order_and_number(rng):
    x = oracles.random_bins(rng, 3, 20)
    names = ["kurtosis", "mean", "kurtosis"]
    together = measure(x)
    expected = together[:, [EVERY.index(name) for name in names]]
    assert torch.equal(measure(x, names), expected)


def test_the_scale_decides_which_values_are_equal_for_the_mode():
    x = torch.tensor([0.0, 1.0, 1.0 + 1e-10, 2.0], dtype=torch.float64)
    assert describe(x, ["mode"]).item() == 0.0
    assert describe(x, ["mode"], scale=torch.tensor(1000.0, dtype=torch.float64)).item() == 1.0
    x = torch.tensor([0.0, 1.0, 1.0 + 2.0**-22, 2.0])
    assert describe(x, ["mode"]).item() == 1.0
    assert describe(x, ["mode"], scale=torch.tensor(0.1)).item() == 0.0


def test_the_smallest_of_equally_frequent_values_is_the_mode():
    assert value([5, 3, 3, -1, 5], "mode") == 3
    assert value([4, 2, 9, 7], "mode") == 2


@given(
    levels=hnp.arrays(np.int64, st.integers(3, 60), elements=st.integers(0, 510)),
    factor=st.sampled_from([0.1, 0.3, 1e-3, 7.7]),
    shift=st.sampled_from([0.0, 0.1, -3.3]),
)
def test_exact_halves_of_the_entropy_do_not_hang_on_rounding(levels, factor, shift):
    levels[:2] = 0, 510  # 255 x / 510: every odd level is an exact half
    exact = value(levels, "entropy")
    assert exact == pytest.approx(oracles.entropy(levels.astype(float)), rel=1e-12, abs=1e-12)
    assert value(factor * levels + shift, "entropy") == pytest.approx(exact, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("name", EVERY)
def test_manners(name, rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 6, 40)).abs().to(device)
    hz = torch.from_numpy(axis(40)).to(device)

    def operator(x):
        return describe(x, [name], reference=x.flip(-1), frequency_hz=hz)

    oracles.assert_manners(operator, x)


def test_float32_is_close_to_float64(rng):
    x = oracles.random_bins(rng, 40, 100)
    x[:, :2] = 0, 255
    x[:, 2:] = rng.integers(0, 256, (40, 98))  # on the entropy's own levels, with ties
    actual = measure(x.astype(np.float32)).double()
    oracles.assert_columns_close(actual, measure(x).numpy(), 1e-5, list(EVERY))


# Gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("num_samples", [2, 9, 10])
def test_gradcheck(name, num_samples, rng):
    x = torch.from_numpy(rng.permutation(num_samples) + rng.uniform(0.5, 1, num_samples))
    reference = torch.from_numpy(rng.standard_normal(num_samples))
    inputs = (x.requires_grad_(), reference.requires_grad_())

    def operator(x, reference):
        return measure(x, [name], reference=reference)

    assert torch.autograd.gradcheck(operator, inputs)


DEGENERATE = {
    "constant": np.full(100, 5.0),
    "negative": np.full(100, -5.0),
    "zero": np.zeros(100),
    "spike": np.eye(100)[30],
    "square": np.where(np.arange(100) % 2, 1.0, -1.0),
    "two equal": np.array([2.0, 2.0]),
    "two": np.array([0.0, 1.0]),
}


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("kind", DEGENERATE)
def test_values_and_gradients_of_degenerate_input_are_finite(name, kind):
    x = torch.from_numpy(DEGENERATE[kind])
    x = (x.abs() if name.startswith("spectral") else x).requires_grad_()
    result = measure(x, [name], reference=x)
    assert result.isfinite().all()
    if result.requires_grad:
        result.sum().backward()
        assert x.grad.isfinite().all()


# The extremes, as stated ---------------------------------------------------------------------

STILL = {
    "mean_deviation": 0,
    "range": 0,
    "std": 0,
    "cv": 0,
    "iqr": 0,
    "skewness": 0,
    "kurtosis": 3,
    "entropy": 0,
    "correlation": 0,
}


@pytest.mark.parametrize("level", [5.0, -5.0, 0.1, 1e30, 1e-30, 0.0])
@pytest.mark.parametrize("num_samples", [2, 99, 100])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_constant_and_zero(level, num_samples, dtype):
    x = torch.full((num_samples,), level, dtype=dtype)
    actual = dict(zip(EVERY, measure(x, reference=x).tolist(), strict=True))
    level = x[0].item()
    for name, expected in STILL.items():
        assert actual[name] == expected, name
    for name in ("mean", "median", "mode"):
        assert actual[name] == level, name
    energy = min(num_samples * level**2, torch.finfo(dtype).max)
    assert actual["energy"] == pytest.approx(energy, rel=1e-6)
    assert actual["peak_factor"] == pytest.approx(np.sign(level), rel=1e-6)
    if level == 0:
        assert (actual["spectral_centroid"], actual["spectral_spread"]) == (0, 0)


@pytest.mark.parametrize("level", [5.0, -3.3, 1e-8])
def test_a_span_of_rounding_noise_is_settled(level, rng):
    noisy = level * (1 + rng.integers(0, 4, 100) * oracles.EPS)
    scale = torch.tensor(abs(level), dtype=torch.float64)
    settled = settle(torch.from_numpy(noisy), scale)
    assert (settled == settled[0]).all()
    assert settled[0].item() == pytest.approx(noisy.mean(), rel=4e-16)
    actual = dict(zip(EVERY, measure(settled, reference=noisy).tolist(), strict=True))
    assert {name: actual[name] for name in STILL} == STILL


def test_settle_judges_the_span_by_the_raw_bin(rng):
    x = torch.from_numpy(1e-14 * rng.uniform(0, 1, 100))
    x[0], x[1] = 0, 1e-14
    assert torch.equal(settle(x, torch.tensor(1.0, dtype=torch.float64)), x)
    assert (
        settle(x, torch.tensor(5.0, dtype=torch.float64)) == settle(x, x.new_tensor(5.0))[0]
    ).all()
    both = settle(torch.stack([x, x]), torch.tensor([1.0, 5.0], dtype=torch.float64))
    assert both[0].std() > 0
    assert both[1].std() == 0
    oracle = np.stack([oracles.settle(x.numpy(), 1.0), oracles.settle(x.numpy(), 5.0)])
    np.testing.assert_allclose(both, oracle, rtol=1e-14, atol=1e-28)


def test_a_single_spike_reaches_the_bounds():
    """n = 100: skewness (n-2)/sqrt(n-1), kurtosis n-2+1/(n-1), peak factor sqrt(n)."""
    spike = np.eye(100)[30]
    assert value(spike, "skewness") == pytest.approx(98 / math.sqrt(99), rel=1e-12)
    assert value(-spike, "skewness") == pytest.approx(-98 / math.sqrt(99), rel=1e-12)
    assert value(spike, "kurtosis") == pytest.approx(98 + 1 / 99, rel=1e-12)
    assert value(spike, "peak_factor") == pytest.approx(10, rel=1e-12)
    assert value(-spike, "peak_factor") == 0  # the signed maximum
    assert value(np.arange(100), "entropy") <= math.log2(100)


@given(x=hnp.arrays(np.float64, 100, elements=st.floats(-1e6, 1e6)))
def test_bounds_at_100_samples(x):
    actual = dict(zip(EVERY, measure(settle_array(x)).tolist(), strict=True))
    slack = 1 + 1e-12
    assert abs(actual["skewness"]) <= 98 / math.sqrt(99) * slack
    assert 1 / slack <= actual["kurtosis"] <= (98 + 1 / 99) * slack
    assert abs(actual["peak_factor"]) <= 10 * slack
    assert 0 <= round(actual["entropy"], 12) <= math.log2(100)
    assert abs(actual["correlation"]) <= slack


def settle_array(x):
    x = torch.from_numpy(x)
    return settle(x, x.abs().max())


def test_two_values():
    actual = dict(zip(EVERY, measure(np.array([1.0, 4.0])).tolist(), strict=True))
    expected = {
        "mean": 2.5,
        "median": 2.5,
        "mode": 1,
        "range": 3,
        "mean_deviation": 1.5,
        "std": 3 / math.sqrt(2),
        "cv": 3 / math.sqrt(2) / 2.5,
        "iqr": 3,
        "skewness": 0,
        "kurtosis": 1,
        "energy": 17,
        "entropy": 0,
        "peak_factor": 4 / math.sqrt(8.5),
        "correlation": -1,
        "spectral_centroid": 800,
        "spectral_spread": 400,
    }
    assert actual == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_nan_and_inf_are_never_a_silent_number(bad, dtype, rng):
    x = torch.from_numpy(oracles.random_bins(rng, 3, 50)).to(dtype)
    clean = measure(x)
    x[1, 7] = bad
    actual = measure(x, reference=x)
    assert not actual[1].isfinite().any()
    x[1] = 0
    torch.testing.assert_close(actual[[0, 2]][:, :13], clean[[0, 2]][:, :13])


def test_a_nan_reference_gives_a_nan_correlation(rng):
    x = torch.from_numpy(oracles.random_bins(rng, 2, 50))
    reference = x.clone()
    reference[0, 3] = math.nan
    correlation = describe(x, ["correlation"], reference=reference)[:, 0]
    assert correlation[0].isnan()
    assert correlation[1].item() == pytest.approx(1)


@pytest.mark.parametrize("exponent", [990, 500, -500, -1000])
def test_float64_extremes_keep_every_shape(exponent, rng):
    """A power of two changes no digit: the statistic must scale, saturate or stay as it was."""
    x = np.abs(oracles.random_bins(rng, 20, 64))
    factor = 2.0**exponent
    before, after = measure(x), measure(x * factor)
    for column, name in enumerate(EVERY):
        degree = DEGREE.get(name, 0)
        expected = before[:, column] * (factor if degree else 1.0)
        if degree == 2:
            expected = torch.clamp(expected * factor, max=torch.finfo(torch.float64).max)
        atol = 1e-320 if exponent < 0 else 0
        torch.testing.assert_close(after[:, column], expected, rtol=1e-12, atol=atol, msg=name)


def test_denormals_keep_their_shapes(rng):
    quanta = rng.integers(0, 1000, (20, 64)).astype(np.float64)
    tiny = quanta * 5e-324
    assert (tiny > 0).any()
    expected, actual = measure(quanta), measure(tiny)
    for name in ("skewness", "kurtosis", "cv", "peak_factor", "entropy", "spectral_centroid"):
        column = EVERY.index(name)
        torch.testing.assert_close(
            actual[:, column], expected[:, column], rtol=1e-6, atol=1e-9, msg=name
        )
    assert actual.isfinite().all()


@pytest.mark.parametrize("size", [1e30, 1e-30, 1e18])
def test_float32_extremes_keep_every_shape(size, rng):
    x = oracles.random_bins(rng, 20, 64)
    before, after = measure(x), measure((x * size).astype(np.float32)).double()
    assert after.isfinite().all()
    for column, name in enumerate(EVERY):
        if name in ("mode", "energy", "spectral_centroid", "spectral_spread", "entropy"):
            continue
        scaled = after[:, column] / (size if DEGREE.get(name) else 1)
        oracles.assert_columns_close(
            scaled[:, None], before[:, [column]].numpy(), 1e-4, names=[name]
        )
    energy = np.minimum((x**2).sum(-1) * size**2, torch.finfo(torch.float32).max)
    np.testing.assert_allclose(after[:, EVERY.index("energy")], energy, rtol=1e-5, atol=1e-44)


@pytest.mark.parametrize("offset", [1e3, -1e6, 1e9])
def test_a_small_vibration_on_a_large_offset_does_not_cancel(offset, rng):
    x = offset + 1e-3 * oracles.random_bins(rng, 20, 100)
    expected = np.stack([oracles.describe(one, oracles.SG_DESCRIPTORS) for one in x])
    oracles.assert_columns_close(measure(x)[:, :13], expected, names=list(EVERY[:13]))


def test_rails():
    x = np.where(np.arange(100) < 40, 5.0, -5.0)
    expected = oracles.describe(x, oracles.SG_DESCRIPTORS)
    np.testing.assert_allclose(measure(x)[:13], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("mean", [1e-9, -1e-9, 0.0])
def test_cv_divides_by_a_signed_floor(mean):
    """Around zero the mean gives its sign and a millionth of the rms its size."""
    x = np.tile([1.0, -1.0], 50) + mean
    expected = math.copysign(1e6, mean if mean else 1.0) * math.sqrt(100 / 99)
    assert value(x, "cv") == pytest.approx(expected, rel=1e-9)


# Physics -------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 999),
    factor=st.floats(1e-3, 1e3),
    num_samples=st.integers(3, 60),
)
def test_scaling_scales_or_preserves_each_statistic(seed, factor, num_samples):
    x = np.abs(np.random.default_rng(seed).standard_normal(num_samples)) + 0.1
    x[0] = x[1]  # a tie, so that the mode is not merely the minimum
    before = measure(x)
    powers = torch.tensor([factor ** DEGREE.get(name, 0) for name in EVERY], dtype=torch.float64)
    expected = before * powers
    torch.testing.assert_close(measure(factor * x), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("num_samples", [99, 100])
def test_a_mirrored_signal_flips_the_signed_statistics(num_samples, rng):
    x = oracles.random_bins(rng, 20, num_samples) + 0.5
    for name in ("mean", "median", "cv", "skewness"):
        torch.testing.assert_close(measure(-x, [name]), -measure(x, [name]), rtol=1e-11, atol=1e-13)
    for name in ("range", "mean_deviation", "std", "iqr", "kurtosis", "energy"):
        torch.testing.assert_close(measure(-x, [name]), measure(x, [name]), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("shift", [-7.0, 0.25, 1000.0])
def test_an_offset_moves_locations_and_no_shape(shift, rng):
    x = oracles.integer_bins(rng, 20, 100)  # exact under these shifts
    still = ["range", "mean_deviation", "std", "iqr", "skewness", "kurtosis", "entropy"]
    torch.testing.assert_close(measure(x + shift, still), measure(x, still), rtol=1e-12, atol=1e-12)
    moved = ["mean", "median", "mode"]
    torch.testing.assert_close(
        measure(x + shift, moved), measure(x, moved) + shift, rtol=1e-12, atol=1e-12
    )


def test_order_matters_to_correlation_and_spectrum_alone(rng):
    x = np.abs(oracles.random_bins(rng, 20, 100))
    shuffled = x[:, rng.permutation(100)]
    a, b = measure(x), measure(shuffled)
    torch.testing.assert_close(a[:, :13], b[:, :13], rtol=1e-12, atol=1e-12)
    assert ((a[:, 13:] - b[:, 13:]).abs() > 1e-6).any(dim=0).all()


def test_centroid_and_spread_of_two_lines():
    spectrum = np.zeros(100)
    spectrum[10], spectrum[30] = 3.0, 1.0  # 200 Hz and 600 Hz, weights 3/4 and 1/4
    assert value(spectrum, "spectral_centroid") == pytest.approx(300)
    assert value(spectrum, "spectral_spread") == pytest.approx(math.sqrt(0.75 * 0.25) * 400)


# Band energy ratio ---------------------------------------------------------------------------


@pytest.mark.parametrize("lines", [50, 51, 100])
def test_band_energy_ratio_equals_the_oracle(lines, rng):
    spectra = np.abs(rng.standard_normal((6, 8, lines))) * rng.uniform(0, 3, (6, 8, 1))
    expected = np.stack([oracles.band_energy_ratio(one) for one in spectra])
    oracles.assert_columns_close(band_energy_ratio(torch.from_numpy(spectra)), expected)


def test_band_energy_ratio_manners(rng, device):
    spectra = torch.from_numpy(np.abs(rng.standard_normal((6, 8, 20)))).to(device)
    oracles.assert_manners(band_energy_ratio, spectra, num_axes=2)
    small = torch.from_numpy(rng.uniform(0.1, 1, (3, 5))).requires_grad_()
    assert torch.autograd.gradcheck(band_energy_ratio, small)


@pytest.mark.parametrize("factor", [2.0**600, 2.0**-600, 1.0])
def test_band_energy_ratio_does_not_depend_on_the_unit(factor, rng):
    spectra = np.abs(rng.standard_normal((8, 20)))
    actual = band_energy_ratio(torch.from_numpy(spectra * factor))
    np.testing.assert_allclose(actual, oracles.band_energy_ratio(spectra), rtol=1e-12)
    assert actual.sum().item() == pytest.approx(1)


def test_band_energy_ratio_of_silence_is_zero():
    spectra = torch.zeros(8, 20, requires_grad=True)
    ratios = band_energy_ratio(spectra)
    assert (ratios == 0).all()
    ratios.sum().backward()
    assert spectra.grad.isfinite().all()


def test_band_energy_ratio_of_nan_is_nan(rng):
    spectra = torch.ones(8, 20)
    spectra[2, 3] = math.nan
    assert band_energy_ratio(spectra).isnan().all()


# Errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.int64, torch.bfloat16, torch.float16])
def test_another_dtype_is_refused(dtype):
    with pytest.raises(ValueError, match=f"expected float32 or float64 and a name, got {dtype}"):
        describe(torch.ones(3, 4, dtype=dtype), ["mean"])


def test_errors_name_what_was_passed():
    x = torch.zeros(3, 10)
    with pytest.raises(ValueError, match=r"wobble.*mean"):
        describe(x, ["mean", "wobble"])
    with pytest.raises(ValueError, match=r"at least two values, got shape \(3, 1\)"):
        describe(x[:, :1], ["mean"])
    with pytest.raises(ValueError, match=r"correlation needs reference="):
        describe(x, ["correlation"])
    for name in ("spectral_centroid", "spectral_spread"):
        with pytest.raises(ValueError, match=rf"{name}.*frequency_hz="):
            describe(x, [name])


# Derivatives that autograd does not take backwards ------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
@pytest.mark.parametrize("name", ["median", "iqr", "range", "kurtosis"])
def test_forward_derivatives_equal_backward_ones(name, rng):
    """NumPy's sort knows nothing of tangents, so it must not be used where there is one."""
    x = torch.from_numpy(rng.standard_normal(20))
    direction = torch.from_numpy(rng.standard_normal(20))

    def value(values):
        return describe(values, [name]).squeeze(-1)

    leaf = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    expected = gradient @ direction
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(x, direction)
        tangent = forward_ad.unpack_dual(value(dual)).tangent
    torch.testing.assert_close(tangent, expected)
    torch.testing.assert_close(torch.func.jvp(value, (x,), (direction,))[1], expected)


def test_vmap_equals_a_batch(rng):
    x = torch.from_numpy(rng.standard_normal((5, 20)))
    names = [name for name in EVERY if name != "correlation"][:13]

    def values(row):
        return describe(row, names)

    torch.testing.assert_close(torch.vmap(values)(x), values(x))
