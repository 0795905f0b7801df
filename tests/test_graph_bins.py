"""The graph of bins beside the pool and the detector it was made of, in torch and float64."""

import numpy as np
import onnxruntime
import pytest
import torch
from small_detector import HAND, raw_bins, small_detector

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.graph.bins import bin_graph, described
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import KernelSum, QuadraticForm, RadialBasis
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.simulation.extremes import EXTREMES, extreme_bins

pytestmark = pytest.mark.onnx
FORMS = [Form("float32"), Form("float64")]
ALL_ROUNDING = ("alternating", "ramp")
"""Here some values are rounding and nothing else (the sign of cv at a mean of 0, the mode of values
that are equal but for rounding), and no two orders of summing agree."""
OFFSET = "offset 1e6, vibration 1e-6"  # takes twelve of float64's sixteen digits


def named(form):
    return form.precision


def session(graph):
    model = graph.model({}).SerializeToString()
    return onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])


def cut(detector, samples):
    """What of raw bins with the detector's full context the graph takes."""
    window = Window.of(detector)
    start = detector.context_before - window.before
    return samples[..., start : start + window.length].contiguous()


def judged(detector, form, samples):
    """Score and validity by onnxruntime, of bins with full context."""
    given = cut(detector, samples).to(getattr(torch, form.precision))
    score, valid = session(bin_graph(detector, form)).run(
        ["score", "valid"], {"samples": given.numpy()}
    )
    return torch.from_numpy(score).double(), torch.from_numpy(valid)


def whole_pool(
    align="centred",
    spectrum="reference",
    bin_samples=100,
    level=4,
    frames=(51, 51, 11, 11),
    polyorder=1,
):
    """A detector of every feature there is; its head is never used."""
    pool = FeaturePool(HAND, bin_samples=bin_samples, level=level, spectrum=spectrum)
    num = len(pool.names)
    ones = torch.ones(num, dtype=torch.float64)
    flat = torch.zeros(num, num, dtype=torch.float64)
    return SlipDetector(
        pool,
        ChannelFilter(frames, polyorder, align),
        range(num),
        FeatureScaler(-ones, ones),
        QuadraticForm(flat, flat[0], flat[0, 0]),
    )


def features_by_graph(detector, form, samples):
    graph, window = Graph(), Window.of(detector)
    shape = ("batch", len(HAND), window.length)
    made = described(graph, detector, graph.input("samples", form.dtype, shape), form).features
    graph.output("features", made, ("batch", len(detector.selected)))
    given = cut(detector, samples).to(getattr(torch, form.precision))
    return session(graph).run(None, {"samples": given.numpy()})[0]


def off(detector, form, samples):
    """Largest error of each feature, by its root mean square over the bins."""
    samples = samples.to(getattr(torch, form.precision)).double()
    bins = detector.channel_filter.valid(samples)
    expected = detector.pool(bins).numpy()
    got = features_by_graph(detector, form, samples)
    size = np.sqrt((expected**2).mean(0))
    error = np.abs(got - expected).max(0) / np.where(size > 0, size, 1)
    return dict(zip(map(str, detector.pool.names), error, strict=True))


@pytest.mark.parametrize("form", FORMS, ids=named)
@pytest.mark.parametrize("align", ["centred", "causal"])
def test_every_feature_of_the_pool_is_that_of_torch(form, align):
    error = off(whole_pool(align), form, raw_bins(40))
    most = 1e-9 if form.precision == "float64" else 2e-4
    worst = max(error, key=error.get)
    assert error[worst] < most, worst


@pytest.mark.parametrize(
    "case",
    [
        {"bin_samples": 75, "level": 3, "spectrum": "clean"},
        {"bin_samples": 101, "align": "trailing"},
    ],
    ids=str,
)
def test_so_it_is_for_other_spectra_bins_and_filters(case):
    detector = whole_pool(**case)
    samples = raw_bins(20)
    if detector.pool.bin_samples != 100:
        extra = torch.from_numpy(np.random.default_rng(1).standard_normal((20, 4, 1)))
        samples = torch.cat([samples, extra], -1)[..., : detector.pool.bin_samples + 50]
    error = off(detector, Form("float64"), samples)
    worst = max(error, key=error.get)
    assert error[worst] < 1e-9, worst


@pytest.mark.parametrize("form", FORMS, ids=named)
def test_a_sensor_that_fails_is_left_out_as_in_torch(form):
    detector = small_detector()
    imputation = torch.linspace(-0.9, 0.9, 12, dtype=torch.float64)
    parts = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    detector = SlipDetector(*parts, detector.head, imputation=imputation)
    samples = raw_bins(40).to(getattr(torch, form.precision)).double()
    for row, value in enumerate([float("nan"), float("inf"), -float("inf")] * 4):
        samples[row, row % 4, 30 + 7 * row] = value
    samples[20:28, 2] = 1.0  # dead
    samples[28] = float("nan")
    expected = detector.double().predict_raw(samples)
    score, valid = judged(detector, form, samples)
    sd = float(expected.score.std())
    most = 1e-9 if form.precision == "float64" else 1e-4
    assert float((score - expected.score).abs().max()) < most * sd
    given = samples.to(getattr(torch, form.precision))
    assert torch.equal(valid, detector.predict_raw(given).is_valid)
    assert 0 < int(valid.sum()) < len(valid)


@pytest.mark.parametrize("kind", EXTREMES)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_extremes_get_the_score_and_the_flag_of_torch(kind, precision):
    detector = small_detector()
    dtype = getattr(torch, precision)
    generator = torch.Generator().manual_seed(5)
    samples = extreme_bins(kind, (16, 4, 150), generator, dtype)
    expected = detector.predict_raw(samples.double())
    score, valid = judged(detector, Form(precision), samples)
    assert torch.equal(valid, detector.predict_raw(samples).is_valid)
    assert bool(score.isfinite().all())
    if kind in ALL_ROUNDING or (kind, precision) == (OFFSET, "float64"):
        return
    most = 1e-9 if precision == "float64" else 1e-4  # scores lie between -20 and 20
    assert float((score - expected.score).abs().max()) < most


def test_kernels_that_do_not_fold_keep_their_sum():
    generator = torch.Generator().manual_seed(0)
    cubic = small_detector(head="sum")
    support = torch.rand(30, 12, generator=generator, dtype=torch.float64) * 2 - 1
    weights = torch.randn(30, generator=generator, dtype=torch.float64)
    parts = (cubic.pool, cubic.channel_filter, cubic.selected, cubic.scaler)
    radial = SlipDetector(*parts, KernelSum(support, weights, RadialBasis(0.4)))
    samples = raw_bins(30)
    for detector in (cubic, radial):
        score, _ = judged(detector, Form("float64"), samples)
        torch.testing.assert_close(score, detector.score_raw(samples), rtol=1e-9, atol=1e-9)


def test_features_whose_range_is_a_point_weigh_nothing():
    detector = small_detector()
    low, high = detector.scaler.minimum.clone(), detector.scaler.maximum.clone()
    high[3] = low[3]
    parts = (detector.pool, detector.channel_filter, detector.selected)
    detector = SlipDetector(*parts, FeatureScaler(low, high), detector.head)
    samples = raw_bins(30)
    score, _ = judged(detector, Form("float64"), samples)
    torch.testing.assert_close(score, detector.score_raw(samples), rtol=1e-9, atol=1e-9)


def test_compressed_features_too():
    detector = small_detector()
    features = detector.pool(detector.channel_filter.valid(raw_bins(64, seed=99)))
    scaler = FeatureScaler.fit(features[:, list(detector.selected)], compress=True, tail=0.02)
    parts = (detector.pool, detector.channel_filter, detector.selected)
    detector = SlipDetector(*parts, scaler, detector.head)
    samples = raw_bins(30)
    score, _ = judged(detector, Form("float64"), samples)
    torch.testing.assert_close(score, detector.score_raw(samples), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("batch", [0, 1, 7])
def test_any_number_of_bins(batch):
    detector = small_detector()
    samples = raw_bins(8)[:batch]
    score, valid = judged(detector, Form("float64"), samples)
    assert score.shape == valid.shape == (batch,)
    torch.testing.assert_close(score, detector.score_raw(samples), rtol=1e-9, atol=1e-9)


def test_only_what_the_selected_features_need_is_in_the_file():
    detector = small_detector()
    names = [str(name) for name in detector.selected_names]
    one = next(i for i, n in enumerate(names) if n.startswith("PVDF") and "time" in n)
    parts = (detector.pool, detector.channel_filter)
    flat = torch.zeros(1, 1, dtype=torch.float64)
    small = SlipDetector(
        *parts,
        [detector.selected[one]],
        FeatureScaler(flat[0] - 1, flat[0] + 1),
        QuadraticForm(flat, flat[0] + 1, flat[0, 0]),
    )
    sizes = [
        len(bin_graph(each, Form()).model({}).SerializeToString()) for each in (detector, small)
    ]
    assert sizes[1] < sizes[0] / 2
    assert len(Window.of(small).channels) == 1
    assert Window.of(small).length == 110  # a film's frame, not a gauge's


@pytest.mark.parametrize("offset", [2.5, 1000.0])
def test_an_offset_takes_no_digits_from_float32(offset):
    """Off by what the offset took from the samples, which torch is given too, and by no more."""
    samples = (0.01 * torch.randn(24, 4, 150, generator=torch.Generator().manual_seed(8))).double()
    error = off(whole_pool(), Form("float32"), samples + offset)
    names = [name for name in error if name.startswith("PVDF") and name.endswith("correlation")]
    assert len(names) == 16
    assert max(error[name] for name in names) < 1e-5
