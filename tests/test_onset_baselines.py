"""The largest detail as a baseline of the alarm: its values, and as a detector."""

import numpy as np
import pytest
import torch
from oracles import plausible_bins, wavelet_branches
from small_detector import HAND, raw_bins

from benchmarks.onset_baselines import BaselineDetector, largest_detail
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.filtering import ChannelFilter

FILMS = HandLayout.paper24().indices("PVDF")


def test_the_largest_detail_is_pywavelets(rng):
    bins = plausible_bins(rng, 6)
    details = [[np.abs(wavelet_branches(x)[1::2]).max() for x in bin_[14:]] for bin_ in bins]
    actual = largest_detail(torch.from_numpy(bins), FILMS)
    np.testing.assert_allclose(actual, np.log(np.max(details, axis=1)), atol=1e-10)


def baseline(hand=HAND):
    lengths = [{"SG": 51, "PVDF": 11}[channel.kind] for channel in hand.channels]
    return BaselineDetector(FeaturePool(hand), ChannelFilter(lengths))


def test_a_baseline_scores_filtered_bins(rng):
    detector = baseline()
    films = list(HAND.indices("PVDF"))
    assert detector.needed_index.tolist() == films
    assert detector.look_ahead == 5  # half the films' frame, not the gauges' 25
    samples = raw_bins(20)
    score, is_valid, in_range, is_lost, span = detector.predict_raw(samples)
    assert torch.equal(score, largest_detail(ChannelFilter([51, 51, 11, 11]).valid(samples), films))
    assert (is_valid & in_range).all()
    assert not is_lost.any()
    filtered = ChannelFilter([51, 51, 11, 11]).valid(samples)[:, films]
    assert torch.equal(span[:, films], filtered.amax(-1) - filtered.amin(-1))
    assert span[:, :2].isnan().all()
    in_32 = detector.predict_raw(samples, given=torch.float32)
    assert in_32.score.dtype == torch.float32
    torch.testing.assert_close(in_32.score.double(), score, rtol=0, atol=1e-4)


def test_a_lost_film_counts_as_silent_and_without_films_there_is_no_score():
    detector = baseline()
    samples = raw_bins(5)
    whole = detector.predict_raw(samples)
    samples[1, 2, 60] = torch.nan  # a film
    samples[2, 0, 60] = torch.inf  # a gauge, which no score depends on
    samples[3, 3] = 0.1  # a dead film
    samples[4] = torch.nan
    found = detector.predict_raw(samples)
    assert found.is_valid.tolist() == found.in_range.tolist() == [True, True, True, True, False]
    assert torch.equal(found.score.isfinite(), found.is_valid)
    assert found.channels_lost.sum(-1).tolist() == [0, 1, 0, 1, 2]
    filtered = ChannelFilter([51, 51, 11, 11]).valid(samples)
    for row, film in ((1, 3), (3, 2)):
        other = largest_detail(filtered[row : row + 1], [film])
        torch.testing.assert_close(found.score[row : row + 1], other)
    torch.testing.assert_close(found.score[[0, 2]], whole.score[[0, 2]])


NO_BASELINE = [
    (lambda x: largest_detail(x, []), "of fast channels needs one"),
    (
        lambda x: baseline(HandLayout(HAND.channels[:2])),
        "of fast channels needs one",
    ),
    (lambda x: baseline().predict_raw(x), "expected samples"),
]


@pytest.mark.parametrize(("call", "message"), NO_BASELINE)
def test_what_is_no_baseline_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.randn(2, 3, 100))
