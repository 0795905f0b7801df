"""A detector whose sensors are missing: what it says without them, and how sure it is of it."""

import copy

import pytest
import torch
from small_detector import HAND, raw_bins, small_detector

from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import (
    ClassGaussians,
    ExpectedScore,
    channel_mask,
    without,
)


def with_gaussians(**options):
    """The small detector, with the Gaussians of some bins cut in two by their score."""
    made = small_detector(**options)
    z = made.scaler(made.pool(made.channel_filter.valid(raw_bins(200, 5)))[:, list(made.selected)])
    gaussians = ClassGaussians.fit(z, made.head(z) >= 0)
    parts = (made.pool, made.channel_filter, made.selected, made.scaler, made.head, made.info)
    return SlipDetector(*parts, gaussians=gaussians)


@pytest.fixture(scope="module")
def detector():
    return with_gaussians()


def expected_of(detector, samples, channel):
    """By the features of whole bins and the closed form alone."""
    bins = detector.channel_filter.valid(samples)
    z = detector.scaler(detector.pool(bins)[:, list(detector.selected)])
    is_lost = (detector.channel_index == channel).expand(len(z), -1)
    return ExpectedScore(detector.head, detector.gaussians)(z, is_lost)


@pytest.mark.parametrize("num", [1, 3, 9, 40], ids="of {} bins".format)
def test_a_dead_sensor_leaves_the_expected_score_and_its_variance(num, detector):
    samples = raw_bins(num)
    channel = int(detector.channel_index[0])
    mean, variance = expected_of(detector, samples, channel)
    mask = torch.arange(len(HAND)) == channel
    for dead in (mask, HAND.names[channel], [HAND.names[channel]]):
        judged = detector.predict_raw(samples, masked_channels=dead)
        torch.testing.assert_close(judged.score, mean, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(judged.variance, variance, rtol=1e-10, atol=1e-10)
        assert torch.equal(judged.is_missing, mask.expand(num, -1))
        assert not judged.is_valid.any()
    assert (variance > 0).all()


def test_dead_is_the_same_as_nan_whatever_the_sensor_says(detector):
    samples = raw_bins(30)
    broken = samples.clone()
    broken[:, 2] = torch.nan
    expected = detector.predict_raw(broken)
    samples[:, 2] = 5.0  # at a rail
    found = detector.predict_raw(samples, masked_channels=[HAND.names[2]])
    filtered = detector.predict(
        detector.channel_filter.valid(samples), masked_channels=[HAND.names[2]]
    )
    for one, other in ((found, expected), (filtered, expected)):
        for each, wanted in zip(one, other, strict=True):
            torch.testing.assert_close(each, wanted, rtol=1e-12, atol=1e-12)


def test_whole_bins_among_broken_ones_keep_their_score_and_are_certain(detector):
    samples = raw_bins(30)
    whole = detector.predict_raw(samples)
    assert torch.equal(whole.variance, torch.zeros(30, dtype=torch.float64))
    samples[::3, 3, 70] = torch.nan
    found = detector.predict_raw(samples)
    kept = torch.arange(30) % 3 != 0
    assert torch.equal(found.score[kept], whole.score[kept])
    assert torch.equal(found.variance > 0, ~kept)
    assert torch.equal(found.is_valid, kept & whole.is_valid)


def test_one_bin_without_batch_axes(detector):
    bins = detector.channel_filter.valid(raw_bins(1))
    batch, alone = (
        detector.predict(bins, masked_channels=["PVDF1"]),
        detector.predict(bins[0], masked_channels=["PVDF1"]),
    )
    assert alone.score.shape == alone.variance.shape == ()
    torch.testing.assert_close(alone.score, batch.score[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(alone.variance, batch.variance[0], rtol=1e-12, atol=0)


def test_gradients_pass_by_a_dead_sensor(detector):
    bins = detector.channel_filter.valid(raw_bins(20)).requires_grad_()
    detector.predict(bins, masked_channels=["PVDF2"]).score.sum().backward()
    assert bins.grad is not None
    assert bins.grad.isfinite().all()
    assert torch.equal(bins.grad[:, 3], torch.zeros_like(bins.grad[:, 3]))
    assert bins.grad[:, 2].abs().max() > 0


@pytest.mark.parametrize("num", [2, 30])
def test_a_head_that_changes_in_place_is_followed(num):
    detector = with_gaussians()
    samples = raw_bins(num)
    before = detector.predict_raw(samples, masked_channels=["PVDF1"])
    detector.head.constant += 1.0
    after = detector.predict_raw(samples, masked_channels=["PVDF1"])
    torch.testing.assert_close(after.score, before.score + 1, rtol=1e-10, atol=1e-10)
    detector.gaussians.mean += 0.1
    assert (detector.predict_raw(samples, masked_channels=["PVDF1"]).score != after.score).any()


def test_the_file_holds_the_gaussians_and_a_float32_detector_keeps_them_exact(detector, tmp_path):
    detector.save(tmp_path / "detector.pt")
    again = SlipDetector.load(tmp_path / "detector.pt")
    samples = raw_bins(9)
    expected = detector.predict_raw(samples, masked_channels=["PVDF2"])
    found = again.predict_raw(samples, masked_channels=["PVDF2"])
    assert torch.equal(found.score, expected.score)
    assert torch.equal(found.variance, expected.variance)
    single = copy.deepcopy(detector).float()
    assert torch.equal(single.gaussians.covariance, detector.gaussians.covariance)
    near = single.predict_raw(samples.float(), masked_channels=["PVDF2"])
    sd = float(expected.score.std())
    assert near.variance.dtype == torch.float32
    assert float((near.score - expected.score).abs().max()) < 1e-4 * sd


@pytest.mark.parametrize("head", ["quadratic", "sum"])
def test_without_gaussians_or_a_quadratic_form_typical_features_stand_in(head, tmp_path):
    made = small_detector(head=head)
    parts = (made.pool, made.channel_filter, made.selected, made.scaler, made.head)
    imputation = torch.linspace(-0.9, 0.9, 12, dtype=torch.float64)
    made = SlipDetector(*parts, imputation=imputation)
    made.save(tmp_path / "detector.pt")
    made = SlipDetector.load(tmp_path / "detector.pt")
    assert made.gaussians is None
    samples = raw_bins(9)
    z = made.scaler(made.pool(made.channel_filter.valid(samples))[:, list(made.selected)])
    filled = torch.where(made.channel_index == 2, imputation, z)
    judged = made.predict_raw(samples, masked_channels=["PVDF1"])
    torch.testing.assert_close(judged.score, made.head(filled), rtol=1e-9, atol=1e-9)
    assert torch.equal(judged.variance, torch.zeros(9, dtype=torch.float64))


@pytest.mark.parametrize(
    ("dead", "said"),
    [
        (
            ["SG9"],
            r"^masked_channels names the channel 'SG9', .* take some of SG1, SG2, PVDF1, PVDF2$",
        ),
        ("SG", r"^masked_channels names the channel 'SG'"),
        (torch.zeros(3).bool(), r"bool mask \[4\], got torch.bool \(3,\)"),
        (torch.zeros(4), r"bool mask \[4\], got torch.float32 \(4,\)"),
    ],
)
def test_what_is_no_channel_of_the_hand_is_refused_in_one_line(dead, said, detector):
    with pytest.raises(ValueError, match=said):
        channel_mask(dead, HAND.names)
    with pytest.raises(ValueError, match=said):
        detector.predict_raw(raw_bins(1), masked_channels=dead)


def test_nothing_dead_is_nothing_done():
    samples = raw_bins(2)
    for dead in (None, [], torch.zeros(4).bool()):
        assert without(samples, dead, HAND.names) is samples


def test_gaussians_of_other_features_are_refused(detector):
    eye = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    parts = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    with pytest.raises(ValueError, match="Gaussians of 3 features do not fit 12"):
        SlipDetector(*parts, detector.head, gaussians=ClassGaussians(eye[:, 0], eye))
