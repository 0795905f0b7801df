"""The baselines' scores by NumPy's spectrum and PyWavelets' branches."""

import numpy as np
import pytest
import torch
from oracles import plausible_bins, wavelet_branches
from small_detector import HAND, raw_bins, small_detector

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.baselines import (
    FLOOR_V,
    VIBRATION_HZ,
    BaselineDetector,
    film_band_power,
    largest_detail,
)
from tactslip_torch.signals.filtering import ChannelFilter

FILMS = HandLayout.paper24().indices("PVDF")
SCORES = {"film_band_power": film_band_power, "largest_detail": largest_detail}


def band_rms(x, rate=2000.0):
    """Root mean square of what is left of a bin if all lines outside the band are taken out."""
    lines, hz = np.fft.rfft(x), np.fft.rfftfreq(len(x), 1 / rate)
    lines[(hz < VIBRATION_HZ[0]) | (hz > VIBRATION_HZ[1]) | (hz == 0)] = 0
    return np.sqrt(np.mean(np.fft.irfft(lines, len(x)) ** 2))


# ------------------------------------------------------------------------------------ the values


@pytest.mark.parametrize("num", [99, 128])
@pytest.mark.parametrize("rate", [2000.0, 700.0])
def test_band_power_is_numpys_for_bins_of_any_length_and_rate(num, rate, rng):
    """At 700 Hz up to half the rate, where an even bin has a line that is no pair."""
    bins = 0.2 + rng.standard_normal((3, 2, num))
    expected = [np.log(max(band_rms(x, rate) for x in bin_)) for bin_ in bins]
    actual = film_band_power(torch.from_numpy(bins), [0, 1], rate)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


def test_the_largest_detail_is_pywavelets(rng):
    bins = plausible_bins(rng, 6)
    details = [[np.abs(wavelet_branches(x)[1::2]).max() for x in bin_[14:]] for bin_ in bins]
    actual = largest_detail(torch.from_numpy(bins), FILMS)
    np.testing.assert_allclose(actual, np.log(np.max(details, axis=1)), atol=1e-10)


@pytest.mark.parametrize("name", SCORES)
def test_only_films_count_and_the_largest_does(name, rng):
    score = SCORES[name]
    bins = torch.from_numpy(plausible_bins(rng, 3))
    whole = score(bins, FILMS)
    other = bins.clone()
    other[:, :14] = torch.randn(3, 14, 100, dtype=torch.float64)
    assert torch.equal(score(other, FILMS), whole)
    each = torch.stack([score(bins, [film]) for film in FILMS], dim=-1)
    torch.testing.assert_close(each.amax(-1), whole, rtol=1e-12, atol=1e-12)
    is_film = torch.arange(24) >= 14
    assert torch.equal(score(bins, is_film), whole)
    apart = [FILMS[0], FILMS[7], FILMS[3]]
    torch.testing.assert_close(each[:, [0, 7, 3]].amax(-1), score(bins, apart))


# ----------------------------------------------------------------------------------- the manners


# ---------------------------------------------------------------------------------- the extremes


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("value", [0.0, 5.0, -1e30, 1e-40])
def test_a_dead_hand_has_the_lowest_score(name, value):
    dead = torch.full((2, 3, 100), value, dtype=torch.float64).requires_grad_()
    score = SCORES[name](dead, [0, 1, 2])
    if abs(value) < 1e6:  # beyond, rounding is more than a microvolt
        assert (score == torch.tensor(FLOOR_V, dtype=torch.float64).log()).all()
    assert score.isfinite().all()
    score.sum().backward()
    assert dead.grad.isfinite().all()


@pytest.mark.parametrize("name", SCORES)
def test_a_small_vibration_on_a_large_offset_survives_float32(name, rng):
    small = 1e-3 * np.round(rng.standard_normal((3, 1, 100)), 2)  # whole parts of 2^-17 of 4
    small = np.round(small * 2**17) / 2**17
    bins = torch.from_numpy(small)
    expected = SCORES[name](bins, [0])
    on_top = SCORES[name]((bins + 4.0).float(), [0])
    torch.testing.assert_close(on_top.double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: film_band_power(x, []), "needs a film"),
        (lambda x: largest_detail(x, torch.zeros(3, dtype=torch.bool)), "needs a film"),
        (lambda x: film_band_power(x, [0], 8.0), "no line of 100 samples"),
        (lambda x: largest_detail(x[..., :20], [0]), "level must lie in"),
        (lambda x: largest_detail(x, [0], wavelet="none"), "unknown wavelet"),
    ],
)
def test_what_is_no_baseline_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.randn(2, 3, 100))


# --------------------------------------------------------------------------------- in the harness
def baseline(name, **change):
    detector = small_detector()
    parts = {"pool": detector.pool, "channel_filter": detector.channel_filter} | change
    return BaselineDetector(name, parts["pool"], parts["channel_filter"])


@pytest.mark.parametrize("name", SCORES)
def test_a_baseline_scores_filtered_bins(name, rng):
    detector = baseline(name)
    films = list(HAND.indices("PVDF"))
    assert detector.needed_index.tolist() == films
    assert detector.look_ahead == 5  # half the films' frame, not the gauges' 25
    samples = raw_bins(20)
    score, is_valid, is_missing, _ = detector.predict_raw(samples)
    assert torch.equal(score, SCORES[name](ChannelFilter([51, 51, 11, 11]).valid(samples), films))
    assert is_valid.all()
    assert not is_missing.any()
    in_32 = detector.predict_raw(samples, given=torch.float32)
    assert in_32.score.dtype == torch.float32
    torch.testing.assert_close(in_32.score.double(), score, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", SCORES)
def test_a_missing_film_is_flagged_and_counts_as_silent(name):
    detector = baseline(name)
    samples = raw_bins(5)
    whole = detector.predict_raw(samples)
    samples[1, 2, 60] = torch.nan  # a film
    samples[2, 0, 60] = torch.inf  # a gauge, which no score depends on
    samples[3, 3] = 0.1  # a dead film
    samples[4] = torch.nan
    found = detector.predict_raw(samples)
    assert found.score.isfinite().all()
    assert found.is_valid.tolist() == [True, False, True, False, False]
    assert found.is_missing.sum(-1).tolist() == [0, 1, 1, 0, 4]
    other = SCORES[name](ChannelFilter([51, 51, 11, 11]).valid(samples)[1:2], [3])
    torch.testing.assert_close(found.score[1:2], other)
    torch.testing.assert_close(found.score[[0, 2]], whole.score[[0, 2]])


def test_a_baseline_that_does_not_exist_or_feels_nothing_is_refused():
    with pytest.raises(ValueError, match="no baseline 'loudest'; take one of film_band_power"):
        baseline("loudest")
    gauges = HandLayout(tuple(c for c in HAND.channels if c.kind == "SG"))
    with pytest.raises(ValueError, match="needs a film"):
        baseline("largest_detail", pool=FeaturePool(gauges), channel_filter=ChannelFilter([51, 51]))
    with pytest.raises(ValueError, match="expected samples"):
        baseline("largest_detail").predict_raw(torch.randn(2, 3, 150))
