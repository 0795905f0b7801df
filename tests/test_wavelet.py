"""Wavelet branches against PyWavelets, of named wavelets and of filters without a name."""

import json

import numpy as np
import oracles
import pytest
import pywt
import torch
from small_detector import HAND

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.wavelet import (
    WaveletFilters,
    as_wavelet,
    branch_matrix,
    highest_level,
    wavelet_branches,
)


def assert_branches_close(actual, expected):
    """Against the largest branch value: a detail is as exact as the sum it is taken from."""
    scale = np.abs(expected).max()
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-10, atol=1e-13 * scale)


@pytest.mark.parametrize("wavelet", ["haar", "bior2.4", "sym5"])
@pytest.mark.parametrize("mode", ["symmetric", "reflect", "zero", "periodic", "constant"])
@pytest.mark.parametrize(("num_samples", "level"), [(72, 1), (75, 3)])
def test_every_option_equals_pywavelets(wavelet, mode, level, num_samples, rng):
    x = rng.standard_normal((2, num_samples))
    options = {"wavelet": wavelet, "mode": mode, "level": level}
    expected = np.stack([oracles.wavelet_branches(one, **options) for one in x])
    assert_branches_close(wavelet_branches(torch.from_numpy(x), **options), expected)
    matrix = branch_matrix(num_samples, **options)
    assert matrix.dtype == torch.float64
    assert_branches_close(matrix @ torch.from_numpy(x[0]), expected[0])


@pytest.mark.parametrize("num_samples", [80, 101])
@pytest.mark.parametrize("make", [oracles.random_bins, oracles.integer_bins])
def test_the_papers_branches_equal_pywavelets_and_add_up(num_samples, make, rng):
    x = make(rng, 3, num_samples)
    branches = wavelet_branches(torch.from_numpy(x))
    assert_branches_close(branches, np.stack([oracles.wavelet_branches(one) for one in x]))
    parent = torch.from_numpy(x)
    for m in range(4):
        a, d = branches[:, 2 * m], branches[:, 2 * m + 1]
        torch.testing.assert_close(a + d, parent, rtol=0, atol=1e-13 * float(parent.abs().max()))
        parent = a


def test_a_constant_has_no_detail_and_a_nan_stays_where_its_filters_reach():
    branches = wavelet_branches(torch.full((100,), 5.0, dtype=torch.float64))
    torch.testing.assert_close(branches[::2], torch.full_like(branches[::2], 5), rtol=1e-14, atol=0)
    assert branches[1::2].abs().max() < 16 * oracles.EPS * 5
    x = torch.ones(2, 100)
    x[0, 50] = torch.nan
    branches = wavelet_branches(x)
    assert branches[0, :, 50].isnan().all()
    assert branches[1].isfinite().all()


@pytest.mark.parametrize("wavelet", ["haar", "rbio2.2", "dmey"])
def test_the_highest_level_is_pywavelets(wavelet):
    length = pywt.Wavelet(wavelet).dec_len
    shortest = 2 * (length - 1)
    for num_samples in (shortest, shortest + 1, 100 + shortest, 1000):
        assert highest_level(num_samples, wavelet) == pywt.dwt_max_level(num_samples, length) >= 1
    with pytest.raises(ValueError, match=f"{wavelet}, which needs {shortest}"):
        highest_level(shortest - 1, wavelet)


@pytest.mark.parametrize(
    ("num_samples", "options", "message"),
    [
        (100, {"level": 5}, r"1\.\.4.*100 samples.*got 5"),
        (100, {"level": 0}, r"1\.\.4.*got 0"),
        (50, {}, r"1\.\.3.*50 samples.*got 4"),
        (100, {"wavelet": "rbio9.9"}, r"rbio9\.9"),
        (9, {"level": 1}, r"bins of 9 samples .* rbio2\.2, which needs 10; use longer"),
        (0, {"level": 1}, r"bins of 0 samples are too short"),
    ],
)
def test_errors_name_the_value(num_samples, options, message):
    with pytest.raises(ValueError, match=message):
        wavelet_branches(torch.zeros(num_samples), **options)


# --- filters without a name ---------------------------------------------------------------------

FILTERS = ("dec_lo", "dec_hi", "rec_lo", "rec_hi")


def filters_of(name):
    return WaveletFilters(f"as {name}", *(tuple(taps) for taps in pywt.Wavelet(name).filter_bank))


@pytest.mark.parametrize("name", ["rbio2.2", "db3"])
def test_the_filters_of_a_named_wavelet_are_that_wavelet(name, rng):
    filters = filters_of(name)
    level = highest_level(100, filters)
    assert level == highest_level(100, name)
    assert torch.equal(branch_matrix(100, filters, level), branch_matrix(100, name, level))
    with pytest.raises(ValueError, match=rf"level must lie in 1\.\.{level} .* as {name}, got 9"):
        branch_matrix(100, filters, 9)


def test_filters_come_back_exactly(rng):
    bank, scale = pywt.Wavelet("rbio2.2").filter_bank, float(rng.uniform(0.3, 3))
    scales = (scale, scale, 1 / scale, 1 / scale)  # of no short decimal
    taps = [tuple(by * tap for tap in own) for own, by in zip(bank, scales, strict=True)]
    filters = WaveletFilters("scaled", *taps)
    assert as_wavelet(json.loads(json.dumps(filters.to_dict()))) == filters
    assert (len(filters), str(filters)) == (6, "scaled")
    scaled, plain = branch_matrix(100, filters), branch_matrix(100)
    torch.testing.assert_close(scaled, plain, rtol=0, atol=1e-13)  # gains cancel in a branch


def haar_but(**taps):
    values = filters_of("haar").to_dict() | taps
    return {key: value for key, value in values.items() if value is not None}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (haar_but(rec_lo=None), "have the keys name, dec_lo, .* got name, dec_lo, dec_hi"),
        (haar_but(more=[1.0]), "have the keys"),
        (haar_but(name=""), "need a name, got ''"),
        (haar_but(dec_lo=[0.7]), "one even length, got 1, 2, 2, 2"),
        ({"name": "odd"} | {name: [1.0, 2.0, 1.0] for name in FILTERS}, "got 3, 3, 3, 3"),
        (haar_but(dec_lo=[0.7, float("nan")]), "dec_lo must be finite"),
        (haar_but(dec_hi="ab"), "dec_hi must hold numbers, got 'ab'"),
        (haar_but(dec_hi=3), "dec_hi must hold numbers, got 3"),
        (haar_but(dec_lo=[0.7, 0.7]), r"do not reconstruct: off by 1\.0e-02"),
        (3, "a wavelet is a name or its filters, got int"),
        (["rbio2.2"], "a wavelet is a name or its filters, got list"),
    ],
)
def test_what_is_no_wavelet_is_refused_in_one_line(values, message):
    for take in (as_wavelet, lambda wavelet: FeaturePool(HAND, wavelet=wavelet)):
        with pytest.raises(ValueError, match=message) as error:
            take(values)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"as dmey do not reconstruct: off by"):
        filters_of("dmey")  # an approximation of PyWavelets
