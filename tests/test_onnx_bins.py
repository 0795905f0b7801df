"""The graph of bins beside the pool and the detector it was made of, in torch and float64."""

import numpy as np
import pytest
import torch
from small_detector import HAND, raw_bins, small_detector
from test_detector import VARIANTS, noise, random_detector
from test_predictions import with_gaussians

from tactslip_torch.deploy.bins import RawBin, bin_graph, described
from tactslip_torch.deploy.check import runner, session_of
from tactslip_torch.deploy.value import Graph
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.calibration import Isotonic, Platt, widened_llr
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

pytestmark = pytest.mark.onnx
PRECISIONS = ("float32", "float64")
CLOSE = {"float32": 1e-4, "float64": 1e-9}  # of scores, in standard deviations
NAN, INF = float("nan"), float("inf")


def cut(detector, samples):
    """What of raw bins with the detector's full context the graph takes."""
    raw = RawBin.of(detector)
    start = detector.context_before - raw.before
    return samples[..., start : start + raw.length].contiguous()


def run_on(detector, precision, samples, mask=None):
    """Outputs of onnxruntime for bins with full context."""
    feeds = {"samples": cut(detector, samples).to(getattr(torch, precision)).numpy()}
    if mask is not None:
        feeds["samples"][..., mask.numpy(), :] = np.nan
    return runner(session_of(bin_graph(detector, precision).model()))(feeds)


def assert_scores(detector, precision, samples, mask=None, spread=None):
    """Scores are those of torch in float64, flags those of torch in the graph's precision."""
    given = samples.to(getattr(torch, precision))
    expected = detector.predict_raw(given.double(), masked_channels=mask)
    got = run_on(detector, precision, given, mask)
    assert got["score"].dtype == precision
    spread = float(expected.score.std()) if spread is None else spread
    error = np.abs(got["score"] - expected.score.numpy())
    assert error.max(initial=0.0) <= CLOSE[precision] * spread
    is_valid = detector.predict_raw(given, masked_channels=mask).is_valid
    np.testing.assert_array_equal(got["valid"], is_valid)
    return got


# Features --------------------------------------------------------------------------------------


def whole_pool(align="centred", spectrum="reference", bin_samples=100, level=4):
    """A detector of every feature there is; its head is never used."""
    pool = FeaturePool(HAND, bin_samples=bin_samples, level=level, spectrum=spectrum)
    ones = torch.ones(len(pool.names), dtype=torch.float64)
    flat = torch.zeros(len(ones), len(ones), dtype=torch.float64)
    head = QuadraticForm(flat, flat[0], flat[0, 0])
    channel_filter = ChannelFilter((51, 51, 11, 11), 1, align)
    return SlipDetector(pool, channel_filter, range(len(ones)), FeatureScaler(-ones, ones), head)


def off(detector, precision, samples):
    """Largest error of each feature, by its root mean square over the bins."""
    given = samples.to(getattr(torch, precision))
    expected = detector.pool(detector.channel_filter.valid(given.double())).numpy()
    graph, shape = Graph(), ("batch", len(HAND), RawBin.of(detector).length)
    made = described(graph.input("samples", np.dtype(precision), shape), detector)[0]
    graph.output("features", made, ("batch", len(detector.selected)))
    got = runner(session_of(graph.model()))({"samples": cut(detector, given).numpy()})["features"]
    size = np.sqrt((expected**2).mean(0))
    error = np.abs(got - expected).max(0) / np.where(size > 0, size, 1)
    return dict(zip(map(str, detector.pool.names), error, strict=True))


@pytest.mark.parametrize(
    ("precision", "case"),
    [
        ("float32", {}),
        ("float64", {"align": "causal"}),
        ("float64", {"bin_samples": 75, "level": 3, "spectrum": "clean"}),
        ("float64", {"bin_samples": 101, "align": "trailing"}),
    ],
    ids=str,
)
def test_every_feature_of_the_pool_is_that_of_torch(precision, case):
    detector = whole_pool(**case)
    extra = torch.from_numpy(np.random.default_rng(1).standard_normal((20, 4, 1)))
    samples = torch.cat([raw_bins(20), extra], -1)[..., : detector.pool.bin_samples + 50]
    error = off(detector, precision, samples)
    worst = max(error, key=error.get)
    assert error[worst] < {"float32": 2e-4, "float64": 1e-9}[precision], worst


@pytest.mark.parametrize("offset", [2.5, 1000.0])
def test_an_offset_takes_no_digits_from_float32(offset):
    """Off by what the offset took from the samples, which torch is given too, and by no more."""
    samples = (0.01 * torch.randn(24, 4, 150, generator=torch.Generator().manual_seed(8))).double()
    error = off(whole_pool(), "float32", samples + offset)
    names = [name for name in error if name.startswith("PVDF") and name.endswith("correlation")]
    assert len(names) == 16
    assert max(error[name] for name in names) < 1e-5


# Scores ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_head_and_scaler_comes_through(variant, precision):
    detector = random_detector(**VARIANTS[variant])
    assert_scores(detector, precision, noise(24))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_sensor_that_fails_is_replaced_as_in_torch(precision):
    detector = small_detector()
    imputation = torch.linspace(-0.9, 0.9, 12, dtype=torch.float64)
    of_signal = (detector.pool, detector.channel_filter, detector.selected, detector.scaler)
    detector = SlipDetector(*of_signal, detector.head, imputation=imputation)
    samples = raw_bins(40)
    for row, value in enumerate([NAN, INF, -INF] * 4):
        samples[row, row % 4, 30 + 7 * row] = value
    samples[20:28, 2] = 1.0  # dead
    samples[28] = NAN
    valid = assert_scores(detector, precision, samples)["valid"]
    assert 0 < valid.sum() < len(valid)


# Missing channels and probabilities ------------------------------------------------------------


def broken_bins():
    """Bins some of which miss one or two sensors, or all, neighbours the same or others."""
    samples = raw_bins(24)
    samples[3, 2, 60] = samples[4, 2, 80] = NAN
    samples[5, 0, 60] = samples[5, 3, 90] = INF
    samples[9] = NAN
    samples[10, 2, 70] = -INF
    return samples


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("lost", [None, [2], [0, 3], [0, 1, 2, 3]], ids=str)
def test_expected_scores_are_those_of_torch(precision, lost):
    detector = with_gaussians()
    mask = None if lost is None else torch.zeros(4).bool().index_fill(0, torch.tensor(lost), True)
    spread = float(detector.predict_raw(raw_bins(24)).score.std())
    got = assert_scores(detector, precision, broken_bins(), mask, spread)
    if lost is not None and len(lost) == 4:
        assert not got["valid"].any()
        assert np.ptp(got["score"]) == 0  # nothing is known of any bin


@pytest.mark.parametrize(
    "calibration", [Platt(0.4, -0.2), Isotonic((-3.0, 0.0, 4), (-4.0, 0.5, 3))]
)
def test_probabilities_are_as_wide_as_the_scores_are_uncertain(calibration):
    detector = with_gaussians()
    detector.info["calibration"] = calibration.to_dict()
    samples = broken_bins()
    found = detector.predict_raw(samples)
    wide = torch.sigmoid(widened_llr(calibration, found.score, found.variance)).numpy()
    got = run_on(detector, "float64", samples)["probability"]
    np.testing.assert_allclose(got, wide, atol=1e-9)
    certain = torch.sigmoid(calibration.llr(found.score)).numpy()
    assert (np.abs(got - 0.5) < np.abs(certain - 0.5) - 1e-6)[found.variance.numpy() > 0].any()


# The file --------------------------------------------------------------------------------------

SLOW = {"DFT", "Conv", "AveragePool", "Einsum", "Det", "Unique", "Loop", "LayerNormalization"}
"""Slow or imprecise in onnxruntime, or missing there in float64."""


def operators(graph):
    for node in graph.node:
        yield node.op_type
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from operators(attribute.g)


def test_a_file_has_operators_of_onnx_alone_and_one_input(capfd):
    model = bin_graph(with_gaussians()).model()
    assert [each.domain for each in model.opset_import] == [""]
    assert not SLOW.intersection(operators(model.graph))
    session = session_of(model)
    assert not session.get_overridable_initializers()
    assert capfd.readouterr().err == ""  # no warning
    assert [each.name for each in session.get_inputs()] == ["samples"]
    assert session.get_inputs()[0].shape[0] == session.get_outputs()[0].shape[0] == "batch"


def test_only_what_the_selected_features_need_is_in_the_file():
    detector = small_detector()
    names = [str(name) for name in detector.selected_names]
    one = next(i for i, n in enumerate(names) if n.startswith("PVDF") and "time" in n)
    flat = torch.zeros(1, 1, dtype=torch.float64)
    small = SlipDetector(
        detector.pool,
        detector.channel_filter,
        [detector.selected[one]],
        FeatureScaler(flat[0] - 1, flat[0] + 1),
        QuadraticForm(flat, flat[0] + 1, flat[0, 0]),
    )
    sizes = [bin_graph(each).model().ByteSize() for each in (detector, small)]
    assert sizes[1] < sizes[0] / 2
    assert sizes[0] < 700_000
    assert len(RawBin.of(small).channels) == 1
    assert RawBin.of(small).length == 110  # a film's frame, not a gauge's
