"""The rivals' scores by NumPy's spectrum and PyWavelets' branches, and the rule of transitions."""

import numpy as np
import pytest
import torch
from oracles import plausible_bins, wavelet_branches
from small_detector import HAND, raw_bins, small_detector

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.onset.baselines import (
    _VIBRATION_HZ,
    FLOOR_V,
    BaselineDetector,
    film_band_power,
    largest_detail,
)
from tactslip_torch.onset.rules import latch, latch_start
from tactslip_torch.signals.filtering import ChannelFilter

FILMS = HandLayout.paper24().indices("PVDF")
SCORES = {"film_band_power": film_band_power, "largest_detail": largest_detail}


def band_rms(x, rate=2000.0, band=_VIBRATION_HZ):
    """Root mean square of what is left of a bin if all lines outside the band are taken out."""
    lines, hz = np.fft.rfft(x), np.fft.rfftfreq(len(x), 1 / rate)
    lines[(hz < band[0]) | (hz > band[1]) | (hz == 0)] = 0
    return np.sqrt(np.mean(np.fft.irfft(lines, len(x)) ** 2))


def detail(x, levels=(1, 2, 3, 4)):
    branches = wavelet_branches(x)
    return max(np.abs(branches[2 * m - 1]).max() for m in levels)


# ------------------------------------------------------------------------------------ the values


@pytest.mark.parametrize("num", [99, 128])
@pytest.mark.parametrize("band", [(5.0, 400.0), (40.0, 200.0), (0.0, 1000.0)])
def test_band_power_is_numpys_for_bins_of_any_length(num, band, rng):
    """Up to half the rate too, where an even bin has a line that is no pair."""
    bins = 0.2 + rng.standard_normal((3, 2, num))
    expected = [np.log(max(band_rms(x, 2000.0, band) for x in bin_)) for bin_ in bins]
    actual = film_band_power(torch.from_numpy(bins), [0, 1], 2000.0, band)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


def test_a_tone_counts_in_its_band_and_only_there():
    t = torch.arange(100, dtype=torch.float64) / 2000
    tone = 0.3 * torch.sin(2 * torch.pi * 60 * t) + 2.0
    bins = tone.expand(1, 1, 100)
    rms = 0.3 / 2**0.5
    assert film_band_power(bins, [0]).exp().item() == pytest.approx(rms, rel=1e-9)
    assert film_band_power(bins, [0], band_hz=(60, 60)).exp().item() == pytest.approx(rms, rel=1e-9)
    assert film_band_power(bins, [0], band_hz=(80, 400)).item() == pytest.approx(np.log(FLOOR_V))
    # at another rate the same samples are another tone
    assert film_band_power(bins, [0], 1000.0, (30, 30)).exp().item() == pytest.approx(rms, rel=1e-9)


@pytest.mark.parametrize("levels", [None, (3, 4)])
def test_the_largest_detail_is_pywavelets(levels, rng):
    bins = plausible_bins(rng, 6)
    of = (1, 2, 3, 4) if levels is None else levels
    expected = [np.log(max(detail(x, of) for x in bin_[14:])) for bin_ in bins]
    actual = largest_detail(torch.from_numpy(bins), FILMS, levels=levels)
    np.testing.assert_allclose(actual, expected, atol=1e-10)


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


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("scale", [1e-3, 1e200])
def test_gradients_flow(name, scale, rng):
    """Of the score; its amplitude is in proportion to the bin, so this one's scale with it."""
    bins = torch.from_numpy(rng.standard_normal((2, 2, 50))).requires_grad_()

    def score(x):
        return SCORES[name](scale * x, [0, 1], **({"level": 3} if name == "largest_detail" else {}))

    assert torch.autograd.gradcheck(score, (bins,), eps=1e-6, atol=1e-6)


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


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("place", [7])
def test_a_bare_score_of_what_is_not_finite_is_nan(name, value, place):
    bins = torch.randn(4, 3, 100)
    bins[1, 2, place] = value
    bins[2, 0, place] = value  # no film
    assert SCORES[name](bins, [1, 2]).isnan().tolist() == [False, True, False, False]
    one_line = film_band_power(bins, [1, 2], band_hz=(60, 60))  # of which no weight is 0
    assert one_line.isnan().tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: film_band_power(x, []), "needs a film"),
        (lambda x: largest_detail(x, torch.zeros(3, dtype=torch.bool)), "needs a film"),
        (lambda x: film_band_power(x, [0], 2000.0, (1.0, 9.0)), "no line of 100 samples"),
        (lambda x: film_band_power(x, [0], 2000.0, (0.0, 0.0)), "no line of 100 samples"),
        (lambda x: largest_detail(x, [0], levels=(5,)), "levels must lie in 1..4"),
        (lambda x: largest_detail(x, [0], levels=()), "levels must lie in 1..4"),
        (lambda x: largest_detail(x[..., :20], [0]), "level must lie in"),
        (lambda x: largest_detail(x, [0], wavelet="none"), "unknown wavelet"),
    ],
)
def test_what_is_no_baseline_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.randn(2, 3, 100))


# ------------------------------------------------------------------------------ first transition
def test_the_papers_rule_is_the_latch_without_debounce_and_pause(rng):
    llr = torch.from_numpy(rng.standard_normal((4, 100)))
    start = latch_start(llr[:, 0])
    is_alarm, is_on, _ = latch(llr, 0.0, rearm=1, refractory=0, state=start)
    before = torch.cat([torch.zeros(4, 1).bool(), (llr >= 0)[:, :-1]], 1)
    assert torch.equal((llr >= 0) & ~before, is_alarm)
    assert torch.equal(llr >= 0, is_on)


# --------------------------------------------------------------------------------- in the harness
def rival(name, **change):
    detector = small_detector()
    parts = {"pool": detector.pool, "channel_filter": detector.channel_filter} | change
    return BaselineDetector(name, parts["pool"], parts["channel_filter"])


@pytest.mark.parametrize("name", SCORES)
def test_a_rival_judges_filtered_bins(name, rng):
    detector = rival(name)
    films = list(HAND.indices("PVDF"))
    assert detector.needed_index.tolist() == films
    assert detector.look_ahead == 5  # half the films' frame, not the gauges' 25
    bins = ChannelFilter([51, 51, 11, 11]).valid(raw_bins(20))
    score, is_valid, is_missing, _ = detector.predict(bins)
    assert torch.equal(score, SCORES[name](bins, films))
    assert is_valid.all()
    assert not is_missing.any()
    in_32 = detector.predict(bins, given=torch.float32)
    assert in_32.score.dtype == torch.float32
    torch.testing.assert_close(in_32.score.double(), score, rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", SCORES)
def test_a_missing_film_is_flagged_and_counts_as_silent(name):
    detector = rival(name)
    bins = ChannelFilter([51, 51, 11, 11]).valid(raw_bins(5))
    whole = detector.predict(bins)
    bins[1, 2, 30] = torch.nan  # a film
    bins[2, 0, 30] = torch.inf  # a gauge, which no score depends on
    bins[3, 3] = 0.1  # a dead film
    bins[4] = torch.nan
    found = detector.predict(bins)
    assert found.score.isfinite().all()
    assert found.is_valid.tolist() == [True, False, True, False, False]
    assert found.is_missing.sum(-1).tolist() == [0, 1, 1, 0, 4]
    other = SCORES[name](bins[1:2], [3])
    torch.testing.assert_close(found.score[1:2], other)
    torch.testing.assert_close(found.score[[0, 2]], whole.score[[0, 2]])


def test_a_rival_that_does_not_exist_or_feels_nothing_is_refused():
    with pytest.raises(ValueError, match="no baseline 'loudest'; take one of film_band_power"):
        rival("loudest")
    gauges = HandLayout(tuple(c for c in HAND.channels if c.kind == "SG"))
    with pytest.raises(ValueError, match="needs a film"):
        rival("largest_detail", pool=FeaturePool(gauges), channel_filter=ChannelFilter([51, 51]))
    with pytest.raises(ValueError, match="expected bins"):
        rival("largest_detail").predict(torch.randn(2, 3, 100))
