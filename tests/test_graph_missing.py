"""Graphs of hands with missing sensors beside the detector they were made of, in torch."""

import numpy as np
import pytest
import torch
from small_detector import HAND, raw_bins
from test_dead_streams import alarming_with_gaussians
from test_predictions import with_gaussians

from tactslip_torch.graph.bins import bin_graph
from tactslip_torch.graph.check import check_model
from tactslip_torch.graph.form import Form, Window
from tactslip_torch.graph.runs import runner, session_of
from tactslip_torch.graph.stream import stream_graph
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.missing_channels import widened_llr
from tactslip_torch.onset.settings import AlarmSettings

pytestmark = pytest.mark.onnx
FORMS = [Form("float32"), Form("float64")]
MASKS = [None, [2], [0, 3], [0, 1, 2, 3]]


def named(form):
    return form.precision


def broken_bins():
    """Bins some of which miss one or two sensors, or all, neighbours the same or others."""
    samples = raw_bins(24)
    samples[3, 2, 60] = samples[4, 2, 80] = torch.nan
    samples[5, 0, 60] = samples[5, 3, 90] = torch.inf
    samples[9] = torch.nan
    samples[10, 2, 70] = -torch.inf
    return samples


def run_on(detector, form, samples, dead=None):
    window = Window.of(detector)
    start = detector.context_before - window.before
    feeds = {"samples": samples[..., start : start + window.length].numpy()}
    if dead is not None:
        feeds["masked_channels"] = dead.numpy()
    return runner(session_of(bin_graph(detector, form).model({})))(feeds)


@pytest.mark.parametrize("form", FORMS, ids=named)
@pytest.mark.parametrize("lost", MASKS, ids=str)
def test_expected_scores_are_those_of_torch(form, lost):
    detector = with_gaussians()
    samples = broken_bins().to(getattr(torch, form.precision))
    dead = None if lost is None else torch.zeros(4).bool().index_fill(0, torch.tensor(lost), True)
    expected = detector.predict_raw(samples.double(), masked_channels=dead)
    got = run_on(detector, form, samples, dead)
    most = 1e-9 if form.precision == "float64" else 1e-4
    error = np.abs(got["score"] - expected.score.numpy()).max()
    assert error < most * float(detector.predict_raw(raw_bins(24)).score.std())
    assert np.array_equal(
        got["valid"], detector.predict_raw(samples, masked_channels=dead).is_valid.numpy()
    )


@pytest.mark.parametrize(
    "calibration", [Platt(0.4, -0.2), Isotonic((-3.0, 0.0, 4), (-4.0, 0.5, 3))]
)
def test_probabilities_are_as_wide_as_the_scores_are_uncertain(calibration):
    detector = with_gaussians()
    detector.info["calibration"] = calibration.to_dict()
    samples = broken_bins()
    judged = detector.predict_raw(samples)
    wide = torch.sigmoid(widened_llr(calibration, judged.score, judged.variance)).numpy()
    got = run_on(detector, Form("float64"), samples)["probability"]
    np.testing.assert_allclose(got, wide, atol=1e-9)
    certain = torch.sigmoid(calibration.llr(judged.score)).numpy()
    assert (np.abs(got - 0.5) < np.abs(certain - 0.5) - 1e-6)[judged.variance.numpy() > 0].any()


def test_dead_may_be_left_out_and_is_no_input_that_a_host_must_know():
    detector = alarming_with_gaussians()
    stream = stream_graph(detector, AlarmSettings.of(detector), Form())
    for graph in (bin_graph(detector, Form()), stream):
        session = session_of(graph.model({}))
        assert [each.name for each in session.get_overridable_initializers()] == ["masked_channels"]
        assert "masked_channels" not in [each.name for each in session.get_inputs()]
    named = {"masked_channels": np.zeros(4, bool), "samples": np.ones((2, 4, 150), np.float32)}
    run = runner(session_of(bin_graph(detector, Form()).model({})))
    whole = run({"samples": named["samples"][..., : Window.of(detector).length]})
    named["samples"] = named["samples"][..., : Window.of(detector).length]
    assert np.array_equal(run(named)["score"], whole["score"])


@pytest.mark.parametrize("kind", ["bin", "stream"])
@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_the_check_of_an_export_tries_masks(kind, precision):
    detector, form = alarming_with_gaussians(), Form(precision)
    graphs = {
        "bin": lambda: bin_graph(detector, form),
        "stream": lambda: stream_graph(detector, AlarmSettings.of(detector), form),
    }
    facts = check_model(graphs[kind]().model({}), detector, form, kind)
    dead = facts["dead"] if kind == "stream" else facts["dead"]["every other"]
    assert dead["worst_sd"] < (1e-2 if precision == "float32" else 1e-6)
    if kind == "bin":
        assert list(facts["dead"]) == ["the first", "every other", "all"]
        assert dead["valid"] == 0
    detector.gaussians.mean += 0.5  # what a graph of other Gaussians would say
    other = graphs[kind]().model({})
    with pytest.raises(ValueError, match=r"differ.* from torch"):
        check_model(other, alarming_with_gaussians(), form, kind)


def test_all_channels_of_the_hand_may_be_named():
    detector = with_gaussians()
    got = run_on(detector, Form(), raw_bins(3).float(), torch.ones(len(HAND)).bool())
    assert np.isfinite(got["score"]).all()
    assert not got["valid"].any()
    assert np.ptp(got["score"]) == 0  # nothing is felt
