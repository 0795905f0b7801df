"""Predictions with their validity: what is missing, masked or extreme; vmap, grad and autocast."""

import copy
from functools import partial

import numpy as np
import pytest
import torch
from small_detector import HAND, raw_bins, small_detector
from test_detector import noise, random_detector

from tactslip_torch.features.bank import linear_maps
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector

BAD = [float("nan"), float("inf"), -float("inf"), 1e308]


def parts_of(detector):
    return (detector.pool, detector.channel_filter, detector.selected, detector.scaler)


def scaled_of(detector, samples):
    """Scaled features of whole raw bins."""
    bins = detector.channel_filter.valid(samples)
    return detector.scaler(detector.pool(bins)[:, list(detector.selected)])


def with_imputation(**options):
    """The small detector, with imputation values that differ."""
    made = small_detector(**options)
    values = torch.linspace(-0.9, 0.9, len(made.selected), dtype=torch.float64)
    return SlipDetector(*parts_of(made), made.head, made.info, imputation=values)


@pytest.fixture(scope="module")
def detector():
    return random_detector()


@pytest.fixture(scope="module")
def small():
    return with_imputation()


def used_channel(detector):
    return detector.pool.hand.names.index(detector.selected_names[0].channel)


# NaN and Inf -----------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD)
def test_a_missing_channel_gets_its_imputation_values(bad, detector):
    """The score is that of features computed by hand, with the channel's own replaced."""
    imputation = torch.linspace(-0.9, 0.9, len(detector.selected), dtype=torch.float64)
    detector = SlipDetector(*parts_of(detector), detector.head, imputation=imputation)
    bins, channel = detector.channel_filter.valid(noise(4)), used_channel(detector)
    z = scaled_of(detector, noise(4))[2]
    z = torch.where(detector.channel_index == channel, imputation, z)
    bins[2, channel, 50] = bad
    found = detector.predict(bins)
    assert found.is_valid.all()
    assert found.channels_lost.nonzero().tolist() == [[2, channel]]
    assert found.span[2, channel].isnan()
    torch.testing.assert_close(found.score[2], detector.head(z), rtol=1e-12, atol=0)
    assert torch.equal(detector(bins), found.score)


def test_a_single_bin_has_a_score_without_axes(detector):
    found = detector.predict_raw(noise(1)[0])
    assert found.score.shape == found.is_valid.shape == ()
    assert found.channels_lost.shape == found.span.shape == (24,)


def test_a_head_that_overflows_is_not_valid():
    detector = random_detector()
    detector.head.quadratic *= 1e40
    found = detector.float().predict_raw(noise(4).float())
    assert not found.is_valid.all()
    assert torch.equal(found.score.isfinite(), found.is_valid)


NO_SAMPLES = [
    (torch.zeros(2, 24, 150, dtype=torch.int32), "got torch.int32; convert with .float"),
    (torch.zeros(2, 24, 150, dtype=torch.bfloat16), r"bfloat16; convert .* or .double\(\)"),
    (np.zeros((2, 24, 150)), "got numpy.ndarray; use torch.as_tensor"),
    (torch.full((2, 25, 150), torch.nan), r"24, .*got \(2, 25, 150\)"),
    (torch.full((150,), torch.nan), r"24, .*got \(150,\)"),
]


@pytest.mark.parametrize(("samples", "message"), NO_SAMPLES)
def test_what_are_no_samples_of_this_hand_is_refused_in_words(samples, message, detector):
    for take in (detector.predict_raw, detector.score_raw):
        with pytest.raises((TypeError, ValueError), match=message):
            take(samples)
    for take in (detector.predict, detector, detector.pool):
        with pytest.raises((TypeError, ValueError), match=message.replace("150", "100")):
            take(samples[..., :100])


# Masked channels -------------------------------------------------------------------------------


@pytest.mark.parametrize("num", [1, 9, 40], ids="of {} bins".format)
def test_a_masked_channel_takes_its_imputation_values_whatever_it_says(num, small):
    samples, channel = raw_bins(num), int(small.channel_index[0])
    is_lost, z = small.channel_index == channel, scaled_of(small, samples)
    expected = small.head(torch.where(is_lost, small.imputation, z))
    mask = torch.arange(len(HAND)) == channel
    broken = samples.clone()
    broken[:, channel] = torch.nan
    samples[:, channel] = 5.0  # at a rail: what it says does not count
    bins, name = small.channel_filter.valid(samples), HAND.names[channel]
    for found in (
        small.predict_raw(samples, masked_channels=mask),
        small.predict_raw(samples, masked_channels=name),
        small.predict(bins, masked_channels=[name]),
        small.predict_raw(broken),
    ):
        torch.testing.assert_close(found.score, expected, rtol=1e-9, atol=1e-9)
        assert torch.equal(found.channels_lost, mask.expand(num, -1))
        assert found.is_valid.all()
    alone = small.predict(bins[0], masked_channels=[name])  # without batch axes
    assert alone.score.shape == ()
    torch.testing.assert_close(alone.score, found.score[0], rtol=1e-12, atol=1e-12)


NO_CHANNELS = [
    (["SG9"], r"^masked_channels names the channel 'SG9', .* take some of SG1, SG2, PVDF1, PV"),
    (3, r"^masked_channels must be a list of names of channels, got 3"),
    (torch.zeros(3).bool(), r"bool mask \[4\], got torch.bool \(3,\)"),
]


@pytest.mark.parametrize(("masked", "said"), NO_CHANNELS)
def test_what_is_no_channel_of_the_hand_is_refused_in_one_line(masked, said, small):
    with pytest.raises(ValueError, match=said):
        small.predict_raw(raw_bins(1), masked_channels=masked)


SEED = 4  # of a detector that needs no SG1


@pytest.fixture(scope="module")
def either():
    return with_imputation(seed=SEED)


def healthy_bins(either):
    return either.channel_filter.valid(raw_bins(6))


def broken_bins(either):
    """Bins that miss nothing, what no feature needs, a sensor, two (twice), and all."""
    bins = healthy_bins(either)
    bins[1, 0, 50] = bins[2, 2, 50] = torch.nan
    bins[3:5, 1:3, 50] = torch.inf
    bins[5] = torch.nan
    return bins


BINS = pytest.mark.parametrize("bins_of", [healthy_bins, broken_bins])


def gradient_of(either, bins):
    """Of the sum of the scores; the patterns are looked at here, and bins go by them."""
    bins = bins.clone().requires_grad_()
    either.predict(bins).score.nansum().backward()
    return bins.grad


@BINS
def test_mapped_over_bins(bins_of, either):
    bins = bins_of(either)
    for options in ({}, {"masked_channels": ["SG2", "PVDF2"]}):
        predict = partial(either.predict, **options)
        found, expected = tuple(torch.vmap(predict)(bins)), tuple(predict(bins))
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9, equal_nan=True)


@BINS
def test_gradients_are_those_of_backward(bins_of, either):
    bins = bins_of(either)
    expected = gradient_of(either, bins)
    assert expected.isfinite().all()
    assert expected[0].abs().max() > 0

    def score(part):
        return either.predict(part).score.nansum()

    for take in (torch.func.grad(score), torch.vmap(torch.func.grad(score))):
        torch.testing.assert_close(take(bins), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`")
def test_a_detector_compiles():
    either = with_imputation(seed=SEED)
    torch.compiler.reset()
    compiled = torch.compile(either, backend="eager")
    bins = healthy_bins(either)
    torch.testing.assert_close(compiled(bins), either(bins), rtol=1e-9, atol=1e-9)


# Autocast and other kinds of numbers -------------------------------------------------------------


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_autocast_changes_nothing(backend):
    """Not even in a head of float32, whose products it would make in bfloat16."""
    either = small_detector(backend=backend).float()
    samples = raw_bins(20).float()
    bins = either.channel_filter.valid(samples)
    calls = {either.predict_raw: samples, either: bins}
    calls[either.score_raw] = samples.clone().requires_grad_()
    calls[either.pool] = bins.clone().requires_grad_()
    for call, x in calls.items():
        plain = call(x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            narrowed = call(x)
        torch.testing.assert_close(narrowed, plain, rtol=0, atol=0)


# Inference mode ----------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["made before", "loaded", "moved"])
def test_inference_mode_leaves_predictions_and_gradients_as_they_are(how, either, tmp_path):
    """Once refused by torch: tensors of that mode do not count how often they are changed."""
    bins, made = broken_bins(either), copy.deepcopy(either)
    made.save(tmp_path / "detector.pt")
    with torch.inference_mode():
        if how != "made before":
            made = SlipDetector.load(tmp_path / "detector.pt")
        if how == "moved":
            made = made.float().double()
        inside = made.predict(bins)
    for found in (inside, made.predict(bins)):
        close = {"rtol": 1e-5, "atol": 1e-5, "equal_nan": True}
        torch.testing.assert_close(found.score, either.predict(bins).score, **close)
    if how != "moved":
        assert gradient_of(made, bins).isfinite().all()


@pytest.mark.parametrize("is_made_inside", [False, True])
def test_what_a_pool_keeps_in_inference_mode_serves_a_gradient_later(is_made_inside, rng):
    """Once "Inference tensors cannot be saved for backward": vmap goes another way than values."""
    bins = torch.from_numpy(rng.standard_normal((2, len(HAND), 100)))
    linear_maps.cache_clear()
    pool = FeaturePool(HAND)
    if is_made_inside:
        linear_maps.cache_clear()
    with torch.inference_mode():
        pool = FeaturePool(HAND) if is_made_inside else pool
        inside = torch.func.vmap(pool)(bins)
    x = bins.clone().requires_grad_()
    features = pool(x)
    torch.testing.assert_close(features.detach(), inside)
    (gradient,) = torch.autograd.grad(features.sum(), x)
    assert gradient.isfinite().all()
