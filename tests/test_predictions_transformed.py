"""Predictions under vmap, func.grad, jvp, a trace, torch.compile and inference mode."""

import warnings

import pytest
import torch
from small_detector import raw_bins, small_detector
from test_predictions import with_gaussians

from tactslip_torch.model.detector import SlipDetector

SEED = 4  # of a detector that needs no SG1


@pytest.fixture(scope="module", params=["imputation", "gaussians"])
def detector(request):
    return {"imputation": small_detector, "gaussians": with_gaussians}[request.param](seed=SEED)


def healthy_bins(detector):
    return detector.channel_filter.valid(raw_bins(6))


def broken_bins(detector):
    """Bins that miss nothing, what no feature needs, a sensor, two (twice), and all."""
    bins = healthy_bins(detector)
    bins[1, 0, 50] = bins[2, 2, 50] = torch.nan
    bins[3:5, 1:3, 50] = torch.inf
    bins[5] = torch.nan
    return bins


BINS = pytest.mark.parametrize("bins_of", [healthy_bins, broken_bins])


def assert_same(found, expected, most=1e-9):
    for each, wanted in zip(found, expected, strict=True):
        torch.testing.assert_close(each, wanted, rtol=most, atol=most)


def gradient_of(detector, bins):
    """Of the sum of the scores; the patterns are looked at here, and bins go by them."""
    bins = bins.clone().requires_grad_()
    detector.predict(bins).score.sum().backward()
    return bins.grad


@BINS
def test_mapped_over_bins(bins_of, detector):
    bins = bins_of(detector)
    assert_same(torch.vmap(detector.predict)(bins), detector.predict(bins))
    dead = ["SG2", "PVDF2"]
    mapped = torch.vmap(lambda part: detector.predict(part, masked_channels=dead))(bins)
    assert_same(mapped, detector.predict(bins, masked_channels=dead))


@BINS
def test_gradients_are_those_of_backward(bins_of, detector):
    bins = bins_of(detector)
    expected = gradient_of(detector, bins)
    assert expected.isfinite().all()
    assert expected[0].abs().max() > 0

    def score(part):
        return detector.predict(part).score.sum()

    for take in (torch.func.grad(score), torch.vmap(torch.func.grad(score))):
        torch.testing.assert_close(take(bins), expected, rtol=1e-8, atol=1e-8)


@pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")  # torch's own, in jvp
@BINS
def test_tangents_are_those_of_backward(bins_of, detector):
    bins = bins_of(detector)
    direction = torch.randn(bins.shape, generator=torch.Generator().manual_seed(2)).double()
    score, slope = torch.func.jvp(lambda x: detector.predict(x).score, (bins,), (direction,))
    torch.testing.assert_close(score, detector.predict(bins).score, rtol=1e-9, atol=1e-9)
    expected = (gradient_of(detector, bins) * direction).sum((-2, -1))
    torch.testing.assert_close(slope, expected, rtol=1e-8, atol=1e-8)


@BINS
def test_a_trace_holds_for_other_bins(bins_of, detector):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tracing is deprecated, and says so
        given = healthy_bins(detector)
        traced = torch.jit.trace(lambda x: tuple(detector.predict(x)), given, check_trace=False)
        bins = bins_of(detector).flip(0)
        # a trace keeps the table of entropies in float32
        assert_same(traced(bins), detector.predict(bins), most=1e-4)


@pytest.mark.slow
def test_compiled_it_holds_for_other_bins(detector, monkeypatch):
    """With samples for features, as capturing the descriptors takes half a minute."""

    def samples(bins):
        return bins.index_select(-2, detector.channel_index)[..., 7]

    monkeypatch.setattr(detector, "_features", samples)
    monkeypatch.setattr(detector.extractor, "backend", "torch")  # the engine would ask for none
    torch.compiler.reset()
    compiled = torch.compile(detector.predict, backend="eager")  # capture alone, without a compiler
    for bins in (healthy_bins(detector), broken_bins(detector)):
        assert_same(compiled(bins), detector.predict(bins))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Dynamo detected a call to a `functools.lru_cache`")
def test_a_detector_compiles():
    detector = with_gaussians(seed=SEED)
    torch.compiler.reset()
    compiled = torch.compile(detector, backend="eager")
    for bins in (healthy_bins(detector), healthy_bins(detector).float()):
        assert_same([compiled(bins)], [detector(bins)])


# Autocast and other kinds of numbers -------------------------------------------------------------


@pytest.mark.parametrize("backend", ["native", "torch"])
def test_autocast_changes_nothing(backend):
    """Not even in a head of float32, whose products it would make in bfloat16."""
    detector = small_detector(backend=backend).float()
    samples = raw_bins(20).float()
    bins = detector.channel_filter.valid(samples)
    features = detector.extractor(bins)
    calls = (
        (detector.predict_raw, samples),
        (detector.score_raw, samples.clone().requires_grad_()),
        (detector, bins),
        (detector.pool, bins.clone().requires_grad_()),
        (detector.score_features, features),
    )
    for call, x in calls:
        plain = call(x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            narrowed = call(x)
        torch.testing.assert_close(narrowed, plain, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("convert", "message"),
    [
        (torch.Tensor.bfloat16, r"got torch.bfloat16; convert with .float\(\) or .double\(\)"),
        (torch.Tensor.half, "got torch.float16; convert"),
        (torch.Tensor.int, "got torch.int32; convert"),
        (torch.Tensor.numpy, "got numpy.ndarray; use torch.as_tensor"),
        (torch.Tensor.tolist, "got list; use torch.as_tensor"),
    ],
)
def test_what_is_no_tensor_of_volts_is_refused(convert, message):
    detector, samples = small_detector(), raw_bins(2)
    for call in (detector.predict_raw, detector.score_raw):
        with pytest.raises((TypeError, ValueError), match=message):
            call(convert(samples))
    for call in (detector.predict, detector, detector.pool):
        with pytest.raises((TypeError, ValueError), match=message):
            call(convert(samples[..., 25:125]))


# Inference mode ----------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["loaded", "moved"])
def test_what_is_made_under_inference_mode_judges_what_is_missing(how, detector, tmp_path):
    """Once refused by torch: tensors of that mode do not count how often they are changed."""
    bins = broken_bins(detector)
    detector.save(tmp_path / "detector.pt")
    with torch.inference_mode():
        made = SlipDetector.load(tmp_path / "detector.pt")
        if how == "moved":
            made = made.float().double()
        inside = made.predict(bins)
    for found in (inside, made.predict(bins)):
        torch.testing.assert_close(found.score, detector.predict(bins).score, rtol=1e-5, atol=1e-5)


def test_a_change_under_inference_mode_is_followed(tmp_path):
    with_gaussians(seed=SEED).save(tmp_path / "detector.pt")
    with torch.inference_mode():
        made = SlipDetector.load(tmp_path / "detector.pt")
        bins = broken_bins(made)
        before = made.predict(bins).score
        made.head.constant += 1.0
        torch.testing.assert_close(made.predict(bins).score, before + 1, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("is_loaded", [False, True])
def test_gradients_are_open_after_a_first_use_under_inference_mode(is_loaded, tmp_path):
    detector = with_gaussians(seed=SEED)
    detector.save(tmp_path / "detector.pt")
    with torch.inference_mode():
        if is_loaded:
            detector = SlipDetector.load(tmp_path / "detector.pt")
        detector.predict(broken_bins(detector))
    assert gradient_of(detector, broken_bins(detector)).isfinite().all()
