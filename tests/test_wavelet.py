"""Wavelet branches, spectra and resampling against PyWavelets, NumPy and SciPy."""

import json
import math

import numpy as np
import oracles
import pytest
import pywt
import scipy.signal
import torch
from small_detector import HAND

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.resampling import resample
from tactslip_torch.signals.wavelet import (
    WaveletFilters,
    as_wavelet,
    branch_matrix,
    frequency_axis_hz,
    highest_level,
    spectrum_matrix,
    wavelet_branches,
)


def assert_branches_close(actual, expected):
    """Against the largest branch value: a detail is as exact as the sum it is taken from."""
    scale = np.abs(expected).max()
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-10, atol=1e-13 * scale)


@pytest.mark.parametrize("wavelet", ["haar", "bior2.4", "sym5"])
@pytest.mark.parametrize(("num_samples", "level"), [(72, 1), (75, 3)])
def test_every_option_equals_pywavelets(wavelet, level, num_samples, rng):
    x = rng.standard_normal((2, num_samples))
    options = {"wavelet": wavelet, "level": level}
    expected = np.stack([oracles.wavelet_branches(one, **options) for one in x])
    assert_branches_close(wavelet_branches(torch.from_numpy(x), **options), expected)
    matrix = branch_matrix(num_samples, **options)
    assert matrix.dtype == torch.float64
    assert_branches_close(matrix @ torch.from_numpy(x[0]), expected[0])


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


REFUSED = [
    (100, {"level": 5}, r"1\.\.4.*100 samples.*got 5"),
    (50, {}, r"1\.\.3.*50 samples.*got 4"),
    (100, {"wavelet": "rbio9.9"}, r"rbio9\.9"),
    (9, {"level": 1}, r"9 samples .* rbio2\.2, which needs 10; use longer"),
]


@pytest.mark.parametrize(("num_samples", "options", "message"), REFUSED)
def test_errors_name_the_value(num_samples, options, message):
    with pytest.raises(ValueError, match=message):
        wavelet_branches(torch.zeros(num_samples), **options)


def test_a_spectrum_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="at least two samples, got 1"):
        spectrum_matrix(1)
    with pytest.raises(ValueError, match="'reference' or 'clean', got 'welch'"):
        spectrum_matrix(100, "welch")


# --- filters without a name ---------------------------------------------------------------------

FILTERS = ("dec_lo", "dec_hi", "rec_lo", "rec_hi")


def filters_of(name):
    return WaveletFilters(f"as {name}", *(tuple(taps) for taps in pywt.Wavelet(name).filter_bank))


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


NO_WAVELETS = [
    (haar_but(rec_lo=None), "have the keys name, dec_lo, .* got name, dec_lo, dec_hi"),
    (haar_but(name=""), "need a name, got ''"),
    (haar_but(dec_lo=[0.7]), "one even length, got 1, 2, 2, 2"),
    ({"name": "odd"} | {name: [1.0, 2.0, 1.0] for name in FILTERS}, "got 3, 3, 3, 3"),
    (haar_but(dec_lo=[0.7, float("nan")]), "dec_lo must be finite"),
    (haar_but(dec_hi="ab"), "dec_hi must hold numbers, got 'ab'"),
    (haar_but(dec_lo=[0.7, 0.7]), r"do not reconstruct: off by 1\.0e-02"),
    (3, "a wavelet is a name or its filters, got int"),
]


@pytest.mark.parametrize(("values", "message"), NO_WAVELETS)
def test_what_is_no_wavelet_is_refused_in_one_line(values, message):
    for take in (as_wavelet, lambda wavelet: FeaturePool(HAND, wavelet=wavelet)):
        with pytest.raises(ValueError, match=message) as error:
            take(values)
        assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=r"as dmey do not reconstruct: off by"):
        filters_of("dmey")  # an approximation of PyWavelets


METHODS = ["reference", "clean"]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num_samples", [2, 3, 64, 65, 100, 130])
def test_spectrum_matrix_and_axis_equal_numpys(method, num_samples, rng):
    for make in (oracles.random_bins, oracles.integer_bins):
        x = make(rng, 5, num_samples)
        expected = np.stack([oracles.amplitude_spectrum(one, method) for one in x])
        lines = spectrum_matrix(num_samples, method) @ torch.from_numpy(x).to(torch.complex128).T
        oracles.assert_columns_close(lines.abs().T, expected)
    axis = frequency_axis_hz(num_samples, 2000.0, method)
    exact = oracles.frequency_axis_hz(num_samples, 2000.0, method)
    np.testing.assert_allclose(axis.numpy(), exact, rtol=1e-15)


# --- another rate -------------------------------------------------------------------------------

RATES = [(2000.0, 1000.0), (1000.0, 2000.0), (2000.0, 48.0), (92.3, 100.0), (2000.0, 2048.0)]


def tone(hz, rate_hz, num, phase=0.7, offset=0.0):
    times_s = torch.arange(num, dtype=torch.float64) / rate_hz
    return (offset + torch.sin(2 * math.pi * hz * times_s + phase))[None]


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("part", [0.03, 0.8])
def test_a_tone_below_half_the_lower_rate_keeps_amplitude_and_phase(from_hz, to_hz, part):
    hz, low = part * min(from_hz, to_hz) / 2, min(from_hz, to_hz)
    found = resample(tone(hz, from_hz, round(200 * from_hz / low), offset=3.0), from_hz, to_hz)
    expected = tone(hz, to_hz, found.shape[-1], offset=3.0)
    ends = math.ceil(10 * to_hz / low) + 1
    assert (found - expected)[:, ends:-ends].abs().max() < 5e-3


@pytest.mark.parametrize(("from_hz", "to_hz"), [(2000.0, 100.0), (100.0, 61.0)])
def test_a_tone_above_half_the_new_rate_does_not_fold_back(from_hz, to_hz):
    hz = 1.2 * to_hz / 2
    found = resample(tone(hz, from_hz, round(200 * from_hz / to_hz)), from_hz, to_hz)
    assert found[:, 11:-11].abs().max() < 5e-3
    every = tone(hz, from_hz, 4000)[:, :: round(from_hz / to_hz)]
    assert every.abs().max() > 0.5  # left out samples alone would have folded it


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_stays_one_to_its_ends(from_hz, to_hz, dtype):
    x = torch.tensor([[1.7], [-1e6], [0.0]], dtype=dtype).expand(3, 50).contiguous()
    before = x.clone()
    found = resample(x, from_hz, to_hz)
    assert (found.dtype, found.shape) == (dtype, (3, math.ceil(50 * to_hz / from_hz)))
    torch.testing.assert_close(found, x[:, :1].expand_as(found), rtol=1e-6, atol=0)
    assert torch.equal(x, before)


def test_away_from_the_ends_it_is_scipys_and_the_same_rate_is_a_copy(rng):
    x = torch.from_numpy(rng.standard_normal((3, 400)))
    x -= x.mean(-1, keepdim=True)
    expected = scipy.signal.resample_poly(x.numpy(), 3, 5, axis=-1)
    ours = resample(x, 500.0, 300.0)[:, 10:-10]
    np.testing.assert_allclose(ours, expected[:, 10:-10], rtol=0, atol=1e-13)
    same = resample(x, 92.3, 92.3)
    assert torch.equal(same, x)
    assert same.data_ptr() != x.data_ptr()


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES)
@pytest.mark.parametrize("place", [0, 577])
def test_what_is_not_finite_spoils_what_reaches_it_and_nothing_else(from_hz, to_hz, place, rng):
    x = torch.from_numpy(rng.standard_normal((2, 1200)))
    whole = resample(x, from_hz, to_hz)
    x[1, place] = 0.0
    expected = resample(x, from_hz, to_hz)
    away_s = (torch.arange(whole.shape[1]) / to_hz - place / from_hz).abs()
    reach_s = 10 / min(from_hz, to_hz)
    far = away_s > 1.001 * reach_s
    assert far.any()
    for bad in (math.nan, -math.inf):
        x[1, place] = bad
        found = resample(x, from_hz, to_hz)
        assert torch.equal(found[0], whole[0])
        assert found[1, away_s < 0.999 * reach_s].isnan().all()
        torch.testing.assert_close(found[1, far], expected[1, far], rtol=0, atol=1e-3)
    assert resample(torch.full((1, 30), torch.nan), 100.0, 150.0).isnan().all()


NOT_RESAMPLED = [
    (torch.ones(5), 1.0, 2.0, r"samples \[C, T\] to resample, got torch.float32 \(5,\)"),
    (torch.ones(1, 5), 0.0, 2.0, "rate must be positive to resample, got 0 Hz"),
    (torch.ones(1, 5), 2000.0, 2000.008, "from 2000 to 2000.008 Hz is no ratio of whole"),
    (torch.ones(1, 5), 1e6, 1.0, "from 1000000 to 1 Hz is no ratio"),
]


@pytest.mark.parametrize(("samples", "from_hz", "to_hz", "message"), NOT_RESAMPLED)
def test_what_cannot_be_resampled_is_refused_in_one_line(samples, from_hz, to_hz, message):
    with pytest.raises(ValueError, match=message) as refused:
        resample(samples, from_hz, to_hz)
    assert "\n" not in str(refused.value)
