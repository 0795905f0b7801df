import math

import numpy as np
import oracles
import pytest
import torch

from tactslip_torch import FeaturePool, HandLayout

NAMES = oracles.pool_names()
PLAIN = [" ".join(name) for name in NAMES]
DESCRIPTORS = sorted({name[3] for name in NAMES})
SMALL_HAND = HandLayout.from_rows(
    [
        {"name": name, "kind": kind, "finger": "index", "segment": "distal"}
        for name, kind in [("SG1", "SG"), ("PVDF1", "PVDF"), ("PVDF2", "PVDF")]
    ]
)


@pytest.fixture(scope="module")
def pool():
    return FeaturePool(HandLayout.paper24())


def columns(channel=None, component=None, domain=None, descriptor=None):
    wanted = (channel, component, domain, descriptor)
    return [
        i
        for i, name in enumerate(NAMES)
        if all(w is None or w == part for w, part in zip(wanted, name, strict=True))
    ]


def column(*name):
    return NAMES.index(name)


def oracle(bins, **options):
    return np.stack([oracles.pool(one, **options) for one in bins])


def assert_pools_close(actual, expected, names):
    """1e-10 of the larger of the value and the column's scale, but for one conditioning limit.

    The cv of a branch whose mean is below 1e-4 of its rms carries the rounding of the mean 1e4
    times over, in the oracle as in the pool: there 1/cv, which is mean/std, is compared.
    """
    actual, expected = actual.numpy().copy(), expected.copy()
    assert np.isfinite(actual).all()
    of_cv = np.array([name.endswith("cv") for name in names])
    huge = of_cv & (np.abs(expected) > 1e4)
    np.testing.assert_allclose(1 / actual[huge], 1 / expected[huge], rtol=0, atol=1e-14)
    actual[huge] = expected[huge]
    oracles.assert_columns_close(actual, expected, names=names)


# Equal to the slow oracle --------------------------------------------------------------------


@pytest.mark.parametrize("make", [oracles.random_bins, oracles.integer_bins])
def test_every_column_equals_the_oracle(make, pool, rng):
    bins = make(rng, 12, 24, 100)
    assert_pools_close(pool(torch.from_numpy(bins)), oracle(bins), PLAIN)


def test_every_column_equals_the_oracle_on_plausible_bins(pool, rng):
    bins = oracles.plausible_bins(rng, 12)
    assert_pools_close(pool(torch.from_numpy(bins)), oracle(bins), PLAIN)


@pytest.mark.slow
def test_every_column_equals_the_oracle_on_many_bins(pool, rng):
    for bins in (rng.standard_normal((40, 24, 100)), oracles.plausible_bins(rng, 40)):
        assert_pools_close(pool(torch.from_numpy(bins)), oracle(bins), PLAIN)


@pytest.mark.parametrize(
    "options",
    [
        {"sample_rate_hz": 1000.0},
        {"bin_samples": 64, "level": 2},
        {"bin_samples": 99},
        {"bin_samples": 101, "spectrum": "clean"},
        {"spectrum": "clean"},
        {"wavelet": "db2", "level": 3},
    ],
)
def test_every_option_equals_the_oracle(options, rng):
    pool = FeaturePool(SMALL_HAND, **options)
    bins = rng.standard_normal((20, 3, options.get("bin_samples", 100)))
    for_oracle = {k: v for k, v in options.items() if k not in ("bin_samples", "spectrum")}
    expected = oracle(bins, num_gauges=1, method=options.get("spectrum", "reference"), **for_oracle)
    plain = [" ".join(name) for name in oracles.pool_names(1, 2, options.get("level", 4))]
    assert [str(name) for name in pool.names] == plain
    assert_pools_close(pool(torch.from_numpy(bins)), expected, plain)


def test_names_and_order(pool):
    actual = [(n.channel, n.component, n.domain, n.descriptor) for n in pool.names]
    assert actual == NAMES
    assert len(actual) == len(set(actual)) == 2582
    assert [str(name) for name in pool.names] == PLAIN
    assert len(columns(channel="SG14")) == 13
    assert len(columns(channel="PVDF10")) == 240


def test_channels_are_found_by_kind_wherever_they_lie(rng):
    """A hand that lists its films first has the same features in the pool's own order."""
    rows = SMALL_HAND.to_rows()
    mixed = FeaturePool(HandLayout.from_rows([rows[1], rows[0], rows[2]]))
    bins = torch.from_numpy(rng.standard_normal((4, 3, 100)))
    straight = FeaturePool(SMALL_HAND)
    torch.testing.assert_close(mixed(bins[:, [1, 0, 2]]), straight(bins), rtol=1e-12, atol=1e-12)
    assert mixed.names == straight.names
    assert mixed.validity(bins[:, [1, 0, 2]]).all()


# The known values of a constant bin ----------------------------------------------------------

KNOWN = {
    "cv": 2.736,
    "skewness": 5.908,
    "kurtosis": 41.133,
    "peak_factor": 7.566,
    "spectral_centroid": 321.391,
    "spectral_spread": 479.107,
    "entropy": 3.866,
}


@pytest.mark.parametrize("level", [1.0, 0.1, 5.0, 3e-5])
def test_known_values_of_a_constant_positive_bin(level, pool):
    features = pool(torch.full((24, 100), level, dtype=torch.float64))
    for m in range(1, 5):
        for descriptor, expected in KNOWN.items():
            actual = features[columns(None, f"A{m}", "freq", descriptor)]
            assert len(actual) == 10
            assert actual.tolist() == pytest.approx([expected] * 10, abs=5.01e-4), descriptor
        for component, expected in ((f"A{m}", 0.25), (f"D{m}", 0.0)):
            actual = features[columns(None, component, "freq", "band_energy_ratio")]
            assert actual.tolist() == pytest.approx([expected] * 10, abs=1e-12)


STILL = {
    "range": 0,
    "mean_deviation": 0,
    "std": 0,
    "cv": 0,
    "iqr": 0,
    "skewness": 0,
    "kurtosis": 3,
    "entropy": 0,
    "correlation": 0,
}


@pytest.mark.parametrize("level", [0.1, -5.0, 0.0, 1e-30])
def test_a_constant_bin_has_the_stated_time_features(level, pool):
    features = pool(torch.full((24, 100), level, dtype=torch.float64))
    for descriptor, expected in STILL.items():
        actual = features[columns(domain="time", descriptor=descriptor)]
        assert (actual == expected).all(), descriptor
    for i in columns(domain="time"):
        _, component, _, descriptor = NAMES[i]
        here = 0.0 if component[0] == "D" else level
        if descriptor in ("mean", "median", "mode"):
            assert features[i].item() == pytest.approx(here, rel=1e-14), PLAIN[i]
        if descriptor == "energy":
            assert features[i].item() == pytest.approx(100 * here**2, rel=1e-13), PLAIN[i]
        if descriptor == "peak_factor":
            assert features[i].item() == pytest.approx(np.sign(here), rel=1e-14), PLAIN[i]


def test_silence_has_no_spectrum(pool):
    """A zero spectrum: every value 0, but for the kurtosis of a constant."""
    features = pool(torch.zeros(24, 100, dtype=torch.float64))
    in_spectrum = columns(domain="freq")
    kurtosis = columns(domain="freq", descriptor="kurtosis")
    assert (features[kurtosis] == 3).all()
    assert (features[sorted(set(in_spectrum) - set(kurtosis))] == 0).all()


# At the extremes -----------------------------------------------------------------------------


def extreme_bins():
    t = torch.arange(100, dtype=torch.float64)
    spike = torch.zeros(100, dtype=torch.float64)
    spike[37] = 1
    return {
        "zero": torch.zeros_like(t),
        "constant": torch.full_like(t, 0.1),
        "spike": spike,
        "edge spike": spike.roll(-37),
        "ramp": t,
        "step": torch.where(t < 50, 0.0, 5.0).double(),
        "rails": torch.where(t % 2 == 0, -5.0, 5.0).double(),
        "vibration on an offset": 5 + 1e-6 * torch.sin(t),
        "1e30": 1e30 * torch.sin(t),
        "1e-30": 1e-30 * torch.sin(t),
    }


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", extreme_bins())
def test_features_and_gradients_stay_finite(kind, dtype, pool):
    bins = extreme_bins()[kind].to(dtype).expand(24, 100).clone().requires_grad_()
    features = pool(bins)
    bad = [PLAIN[i] for i in (~features.isfinite()).nonzero().flatten().tolist()]
    assert not bad
    smooth = [i for i, name in enumerate(NAMES) if name[3] not in ("mode", "entropy", "energy")]
    features[smooth].sum().backward()
    assert bins.grad.isfinite().all()


@pytest.mark.parametrize("kind", ["spike", "edge spike", "ramp", "step", "vibration on an offset"])
def test_shapes_stay_within_their_bounds(kind, pool):
    features = pool(extreme_bins()[kind].expand(24, 100))
    slack = 1 + 1e-9
    assert features[columns(descriptor="skewness")].abs().max() <= 98 / math.sqrt(99) * slack
    kurtosis = features[columns(descriptor="kurtosis")]
    assert 1 / slack <= kurtosis.min()
    assert kurtosis.max() <= (98 + 1 / 99) * slack
    assert features[columns(descriptor="peak_factor")].max() <= 10 * slack
    assert features[columns(descriptor="entropy")].max() <= math.log2(100)
    ratios = features[columns(descriptor="band_energy_ratio")]
    torch.testing.assert_close(
        ratios.reshape(10, 8).sum(-1), torch.ones(10, dtype=torch.float64), rtol=1e-12, atol=0
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("channel", [3, 17])
def test_nan_and_inf_spoil_their_channel_and_no_other(bad, channel, pool, rng):
    bins = torch.from_numpy(rng.standard_normal((2, 24, 100)))
    clean = pool(bins)
    bins[1, channel, 50] = bad
    features = pool(bins)
    name = HandLayout.paper24().names[channel]
    own = columns(channel=name)
    others = sorted(set(range(2582)) - set(own))
    torch.testing.assert_close(features[0], clean[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(features[1, others], clean[1, others], rtol=1e-12, atol=1e-12)
    silent = [PLAIN[i] for i in own if features[1, i].isfinite()]
    assert not silent
    valid = torch.ones(2, 24, dtype=torch.bool)
    valid[1, channel] = False
    assert torch.equal(pool.validity(bins), valid)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_validity_wants_a_span_above_64_eps(dtype, pool, rng):
    eps = torch.finfo(dtype).eps
    bins = torch.from_numpy(rng.standard_normal((3, 24, 100))).to(dtype)
    bins[:, 0] = 0
    bins[:, 1] = 5
    bins[:, 2] = 1
    bins[:, 2, 9] = 1 - 32 * eps
    bins[:, 3] = 1
    bins[:, 3, 9] = 1 - 100 * eps
    bins[:, 20] = -1e30
    bins[:, 21] *= 1e30
    expected = torch.ones(3, 24, dtype=torch.bool)
    expected[:, [0, 1, 2, 20]] = False
    assert torch.equal(pool.validity(bins), expected)
    assert torch.equal(pool.validity(bins[0]), expected[0])


def test_a_detail_of_rounding_noise_is_exactly_zero(pool, rng):
    bins = torch.from_numpy(5 * (1 + rng.integers(0, 3, (24, 100)) * oracles.EPS))
    features = pool(bins)
    for m in range(1, 5):
        for descriptor in ("mean", "std", "energy", "peak_factor"):
            assert (features[columns(None, f"D{m}", None, descriptor)] == 0).all()


# Physics -------------------------------------------------------------------------------------


def test_a_tone_shows_at_its_place_in_the_spectrum(pool):
    """125 Hz: line 16 of 256 points, 320 Hz on the authors' axis; a film's A1 keeps it whole."""
    t = torch.arange(100, dtype=torch.float64) / 2000.0
    for tone_hz in (62.5, 125.0):
        tone = torch.sin(2 * math.pi * tone_hz * t) * torch.hann_window(100, dtype=torch.float64)
        features = pool(tone.expand(24, 100))
        centroid = features[column("PVDF1", "A1", "freq", "spectral_centroid")].item()
        assert centroid == pytest.approx(2.56 * tone_hz, abs=25)


@pytest.mark.parametrize("exponent", [3, -7])
def test_scaling_the_bin_scales_or_preserves_every_feature(exponent, pool, rng):
    factor = 2.0**exponent
    linear = {"mean", "median", "mode", "range", "mean_deviation", "std", "iqr"}
    power = {"energy": 2, **dict.fromkeys(linear, 1)}
    powers = torch.tensor([factor ** power.get(n[3], 0) for n in NAMES], dtype=torch.float64)
    bins = torch.from_numpy(rng.standard_normal((2, 24, 100)))
    torch.testing.assert_close(pool(factor * bins), pool(bins) * powers, rtol=1e-10, atol=1e-13)


def test_a_channel_speaks_for_itself_alone(pool, rng):
    bins = torch.from_numpy(rng.standard_normal((24, 100)))
    before = pool(bins)
    for channel, name in enumerate(HandLayout.paper24().names):
        changed = bins.clone()
        changed[channel] = torch.from_numpy(rng.standard_normal(100))
        moved = {NAMES[i][0] for i in ((pool(changed) - before).abs() > 1e-9).nonzero().flatten()}
        assert moved == {name}


# Manners -------------------------------------------------------------------------------------


def test_manners(device, rng):
    pool = FeaturePool(SMALL_HAND).to(device)
    bins = torch.from_numpy(rng.standard_normal((4, 3, 100))).to(device)
    normal = pool(bins).abs().mean(0) + 1e-12  # columns differ in size by many decades
    oracles.assert_manners(lambda bins: pool(bins) / normal.to(bins), bins, num_axes=2)


def test_native_float32_is_close_to_float64(pool, rng):
    """But for mode and entropy, which jump."""
    native = FeaturePool(HandLayout.paper24(), arithmetic="native")
    bins = rng.standard_normal((12, 24, 100))
    bins[:, 14:] += 2  # a film whose details have a mean of their own size's order is rare
    kept = [i for i, name in enumerate(NAMES) if name[3] not in ("mode", "entropy")]
    detail = [i for i in kept if NAMES[i][1][0] == "D" and NAMES[i][2:] == ("time", "cv")]
    kept = sorted(set(kept) - set(detail))
    actual = native(torch.from_numpy(bins).float()).double()[:, kept]
    expected = pool(torch.from_numpy(bins))[:, kept].numpy()
    oracles.assert_columns_close(actual, expected, 2e-4, [PLAIN[i] for i in kept])


def test_gradcheck(rng):
    pool = FeaturePool(SMALL_HAND, bin_samples=12, level=1)
    smooth = [i for i, n in enumerate(pool.names) if n.descriptor not in ("mode", "entropy")]
    bins = torch.from_numpy(rng.standard_normal((3, 12))).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda bins: torch.tanh(pool(bins)[smooth] / 10), bins, eps=1e-7, atol=1e-5
    )


def test_the_pool_has_nothing_to_learn_and_nothing_to_save(pool):
    assert list(pool.parameters()) == []


@pytest.mark.parametrize("shape", [(24, 99), (23, 100), (5, 25, 100), (100,), (100, 24)])
def test_errors_name_the_shape(shape, pool):
    message = rf"24, 100.*{', '.join(map(str, shape))}"
    with pytest.raises(ValueError, match=message):
        pool(torch.zeros(shape))
    with pytest.raises(ValueError, match=message):
        pool.validity(torch.zeros(shape))


def test_errors_at_construction_and_for_integers(pool):
    with pytest.raises(ValueError, match=r"sample_rate_hz.*-1"):
        FeaturePool(SMALL_HAND, sample_rate_hz=-1.0)
    with pytest.raises(ValueError, match=r"1\.\.3.*50 samples.*4"):
        FeaturePool(SMALL_HAND, bin_samples=50)
    with pytest.raises(ValueError, match=r"float32 or float64 .*int64"):
        pool(torch.zeros(24, 100, dtype=torch.int64))
