"""Scores with their validity, and what becomes of NaN and Inf."""

import copy
import warnings

import pytest
import torch
from test_detector import noise, random_detector

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins

BAD = [float("nan"), float("inf"), -float("inf"), 1e308]


@pytest.fixture(scope="module", params=["imputation", "gaussians"])
def detector(request):
    """With imputation values alone, and with Gaussians of the features."""
    made = random_detector()
    if request.param == "gaussians":
        bins = made.channel_filter.valid(noise(100, seed=5))
        z = made.scaler(made.pool(bins)[:, list(made.selected)])
        made.gaussians = ClassGaussians.fit(z, made.head(z) >= 0)
    return made


def used_channel(detector):
    return detector.pool.hand.names.index(detector.selected_names[0].channel)


def unused_channel(detector):
    used = {name.channel for name in detector.selected_names}
    return next(i for i, name in enumerate(detector.pool.hand.names) if name not in used)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_healthy_bins_are_scored_as_ever(dtype, detector):
    samples = noise(9).to(dtype)
    judged = detector.predict_raw(samples)
    assert judged.score.dtype == dtype
    assert torch.equal(judged.score, detector.score_raw(samples))
    assert judged.is_valid.tolist() == [True] * 9
    assert not judged.is_missing.any()
    bins = detector.channel_filter.valid(samples)
    assert torch.equal(detector.predict(bins).score, detector(bins))


@pytest.mark.parametrize("bad", BAD)
def test_a_missing_channel_gives_its_typical_features(bad, detector):
    """The score is that of features computed by hand, with the channel's own replaced."""
    imputation = torch.linspace(-0.9, 0.9, len(detector.selected), dtype=torch.float64)
    detector = SlipDetector(
        detector.pool,
        detector.channel_filter,
        detector.selected,
        detector.scaler,
        detector.head,
        imputation=imputation,
    )
    bins = detector.channel_filter.valid(noise(4))
    channel = used_channel(detector)
    scaled = detector.scaler(detector.pool(bins)[2, list(detector.selected)])
    name = detector.pool.hand.names[channel]
    for place, feature in enumerate(detector.selected_names):
        if feature.channel == name:
            scaled[place] = imputation[place]
    bins[2, channel, 50] = bad
    judged = detector.predict(bins)
    assert judged.is_valid.tolist() == [True, True, False, True]
    assert judged.is_missing.nonzero().tolist() == [[2, channel]]
    torch.testing.assert_close(judged.score[2], detector.head(scaled), rtol=1e-14, atol=0)
    assert detector(bins)[2].isnan() or bad == 1e308


@pytest.mark.parametrize("num", [3, 30])
@pytest.mark.parametrize("bad", [*BAD, "dead"])
def test_a_channel_no_feature_needs_changes_nothing(bad, num, detector):
    """Once an error of torch, of every detector with Gaussians: no bin to take the patterns of."""
    samples, unused = noise(num), unused_channel(detector)
    expected = detector.predict_raw(samples)
    if bad == "dead":
        judged = detector.predict_raw(samples, masked_channels=[detector.pool.hand.names[unused]])
    else:
        samples[:, unused] = bad
        judged = detector.predict_raw(samples)
    assert torch.equal(judged.score, expected.score)
    assert torch.equal(judged.variance, torch.zeros_like(judged.score))
    assert judged.is_valid.all()
    assert judged.is_missing.sum(-1).tolist() == [1] * num


@pytest.mark.parametrize("bad", BAD[:3])
def test_raise_names_bin_channel_and_sample(bad, detector):
    samples = noise(6).reshape(2, 3, 24, 150)
    samples[1, 2, 14, 149] = bad
    with pytest.raises(
        ValueError,
        match=rf"bin 1, 2, channel PVDF1, sample 149 is {bad}; repair .* nonfinite='mask'",
    ):
        detector.predict_raw(samples, nonfinite="raise")
    healthy = noise(2)
    judged = detector.predict_raw(healthy, nonfinite="raise")
    assert torch.equal(judged.score, detector.score_raw(healthy))


def test_one_bin_without_batch_axes(detector):
    samples = noise(1)[0]
    judged = detector.predict_raw(samples)
    assert judged.score.shape == judged.is_valid.shape == ()
    assert judged.is_missing.shape == (24,)
    samples[3, 0] = torch.nan
    with pytest.raises(ValueError, match=r"^channel SG4, sample 0 is nan"):
        detector.predict_raw(samples, nonfinite="raise")


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", EXTREMES)
def test_every_extreme_gives_a_finite_score_or_a_flag(kind, dtype, detector):
    generator = torch.Generator().manual_seed(3)
    samples = extreme_bins(kind, (16, 24, 150), generator, dtype)
    judged = detector.predict_raw(samples)
    assert judged.score.isfinite().all()
    if kind in ("constant", "zero"):
        assert not judged.is_valid.any()
    if kind in ("plain", "integers", "rails", "alternating"):
        assert judged.is_valid.float().mean() > 0.9


def test_all_channels_missing_gives_the_score_of_what_is_known_beforehand(detector):
    """That of imputation values, or the mean over both classes, alike in number."""
    judged = detector.predict(torch.full((2, 24, 100), torch.nan))
    expected = detector.head(detector.imputation)
    if (known := detector.gaussians) is not None:
        lift = (detector.head.quadratic * known.covariance).sum((-2, -1))
        expected = (detector.head(known.mean) + lift).mean()
    torch.testing.assert_close(judged.score.double(), expected.expand(2), rtol=1e-6, atol=1e-7)
    assert not judged.is_valid.any()


def test_gradients_stay_finite_beside_a_missing_channel(detector):
    samples = noise(2)
    samples[0, used_channel(detector), 70] = torch.nan
    samples.requires_grad_(True)
    detector.predict_raw(samples).score.sum().backward()
    gradient = samples.grad
    assert gradient is not None
    kept = torch.ones(24, dtype=torch.bool)
    kept[used_channel(detector)] = False
    assert gradient[:, kept].isfinite().all()
    assert gradient[0, kept].abs().max() > 0


def test_an_unknown_policy_is_refused(detector):
    with pytest.raises(ValueError, match="nonfinite must be 'mask' or 'raise', got 'drop'"):
        detector.predict_raw(noise(1), nonfinite="drop")


def test_imputation_values_are_kept_in_the_file(detector, tmp_path):
    imputation = torch.full((len(detector.selected),), 0.25, dtype=torch.float64)
    parts = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    SlipDetector(*parts, detector.head, imputation=imputation).save(tmp_path / "a.pt")
    loaded = SlipDetector.load(tmp_path / "a.pt")
    assert torch.equal(loaded.imputation, imputation)


@pytest.mark.parametrize("imputation", [torch.zeros(3), torch.full((12,), 1.5)])
def test_imputation_values_that_are_none_are_refused(imputation, detector):
    parts = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    with pytest.raises(ValueError, match="imputation must be 12 scaled features in"):
        SlipDetector(*parts, detector.head, imputation=imputation)


# Arithmetic ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", EXTREMES)
def test_float32_samples_are_scored_as_in_float64_but_for_the_head(kind, detector):
    samples = extreme_bins(kind, (8, 24, 150), torch.Generator().manual_seed(4), torch.float32)
    inside = detector.pool(detector.channel_filter.valid(samples.double()))
    z = detector.scaler(inside[:, list(detector.selected)])
    single = copy.deepcopy(detector).float()
    assert torch.equal(single.predict_raw(samples).score, single.head(z.float()))


def test_a_feature_far_from_zero_keeps_its_digits_in_a_float32_detector():
    """Once scaled in float32: a mean of 1e3 V that moves by 1e-2 V was off by a third of a
    percent of its range."""
    detector = random_detector()
    means = [i for i, n in enumerate(detector.pool.names) if str(n).endswith("raw time mean")][:12]
    generator = torch.Generator().manual_seed(6)
    bins = 1e3 + 1e-2 * torch.randn(200, 24, 1, generator=generator, dtype=torch.float64)
    bins = bins + 1e-2 * torch.randn(200, 24, 100, generator=generator, dtype=torch.float64)
    scaler = FeatureScaler.fit(detector.pool(bins)[:, means])
    parts = (detector.pool, detector.channel_filter, means, scaler, detector.head)
    samples = bins[:, :, :1] + torch.zeros(200, 24, 150)
    exact = SlipDetector(*parts).score_raw(samples.float().double())
    single = SlipDetector(*parts).float().score_raw(samples.float())
    assert float((single - exact).abs().max() / exact.std()) < 1e-5


def test_widening_happens_once_and_before_the_filter(detector):
    samples = noise(2).float()
    assert detector.pool.widen(samples).dtype == torch.float64
    native = FeaturePool(detector.pool.hand, arithmetic="native")
    assert native.widen(samples) is samples
    wide = samples.double()
    assert detector.pool.widen(wide) is wide


def test_an_unknown_arithmetic_is_refused(detector):
    with pytest.raises(ValueError, match="arithmetic must be one of double, native, got 'half'"):
        FeaturePool(detector.pool.hand, arithmetic="half")


# Found by review --------------------------------------------------------------------------------


@pytest.mark.parametrize("arithmetic", ["double", "native"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", BAD[:3])
def test_filtered_bins_with_a_broken_channel(bad, dtype, arithmetic):
    """Once NaN and not missing, for Inf in float32: the limit itself was rounded to Inf."""
    detector = random_detector()
    detector.pool.arithmetic = arithmetic
    bins = detector.channel_filter.valid(noise(3)).to(dtype)
    bins[0, used_channel(detector)] = bad
    bins[1, used_channel(detector), 5] = bad
    judged = detector.predict(bins)
    assert judged.score.isfinite().all()
    assert judged.is_missing[:, used_channel(detector)].tolist() == [True, True, False]
    assert judged.is_valid.tolist() == [False, False, True]


def test_a_head_that_overflows_is_not_valid():
    detector = random_detector()
    detector.head.quadratic *= 1e40
    judged = detector.float().predict_raw(noise(4).float())
    assert not judged.is_valid[~judged.score.isfinite()].any()
    assert not judged.score.isfinite().all()


@pytest.mark.parametrize("policy", ["mask", "raise"])
@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (torch.zeros(2, 24, 150, dtype=torch.int64), "float32 or float64 .*, got torch.int64"),
        (torch.full((2, 25, 150), torch.nan), r"24, .*got \(2, 25, 150\)"),
        (torch.full((150,), torch.nan), r"24, .*got \(150,\)"),
    ],
)
def test_what_are_no_samples_of_this_hand_is_refused_in_words(samples, message, policy, detector):
    with pytest.raises(ValueError, match=message):
        detector.predict_raw(samples, nonfinite=policy)
    with pytest.raises(ValueError, match=message.replace("150", "100")):
        detector.predict(samples[..., :100], nonfinite=policy)


def test_gradients_of_denormal_samples_are_finite(detector):
    samples = noise(2) * 1e-311
    samples.requires_grad_()
    detector.score_raw(samples).sum().backward()
    assert samples.grad.isfinite().all()


def test_a_trace_holds_for_other_bins(detector):
    """Once the sorted values and the look at extremes of the traced bins went into the graph."""
    pool, bins = detector.pool, detector.channel_filter.valid(noise(2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tracing is deprecated, and says so
        traced = torch.jit.trace(pool, bins, check_trace=False)
        for other in (detector.channel_filter.valid(noise(2, seed=5)), torch.zeros_like(bins)):
            torch.testing.assert_close(traced(other), pool(other), rtol=1e-6, atol=1e-6)
