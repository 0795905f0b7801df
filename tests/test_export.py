"""The files of an export: right, whole, with their facts."""

import hashlib
import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from small_detector import HAND, alarming_detector, raw_bins
from test_detector import VARIANTS, noise, random_detector

from tactslip_torch.graph.export import export_detector, sidecar_facts, summary, worst_error
from tactslip_torch.graph.form import Window
from tactslip_torch.graph.trials import simulated_stream
from tactslip_torch.model.calibration import probability
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

pytestmark = pytest.mark.onnx


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


@pytest.fixture(scope="module")
def exported(detector, tmp_path_factory):
    """Both files as they are usually made, with the whole check."""
    folder = tmp_path_factory.mktemp("export") / "deep"
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    paths = export_detector(detector, folder)
    for name, value in detector.state_dict().items():  # the detector stays as it was: float64
        assert torch.equal(value, before[name])
        assert value.dtype == torch.float64
    return paths


def run(path, **inputs):
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, inputs), strict=True))


def cropped(detector, samples):
    """Raw bins as the graph takes them: no more context than its channels reach."""
    window = Window.of(detector)
    before = detector.context_before - window.before
    after = detector.context_after - window.after
    return samples[..., before : samples.shape[-1] - after].numpy()


def test_an_export_leaves_its_files_and_nothing_else(exported):
    names = ["model.onnx", "model.onnx.json", "stream.onnx", "stream.onnx.json"]
    assert [path.name for path in exported] == ["model.onnx", "stream.onnx"]
    assert sorted(path.name for path in exported[0].parent.iterdir()) == names
    for path in exported:
        onnx.checker.check_model(onnx.load(path), full_check=True)


@pytest.mark.parametrize("batch", [0, 1, 2, 7, 64])
def test_the_bin_graph_gives_the_detectors_judgement(detector, exported, batch):
    samples = raw_bins(batch, seed=batch).float()
    expected = detector.predict_raw(samples.double())
    got = run(exported[0], samples=cropped(detector, samples))
    assert got.keys() == {"score", "probability", "valid"}
    spread = float(detector.score_raw(raw_bins(64)).std())
    np.testing.assert_allclose(got["score"], expected.score, rtol=0, atol=1e-3 * spread)
    assert got["score"].dtype == got["probability"].dtype == np.float32
    assert got["valid"].tolist() == [True] * batch
    settings = AlarmSettings.of(detector)
    stated = probability(settings.calibration.llr(expected.score), settings.slip_share)
    np.testing.assert_allclose(got["probability"], stated, rtol=0, atol=1e-4)


def test_bins_of_a_batch_do_not_meet(detector, exported):
    samples = cropped(detector, raw_bins(7).float())
    together = run(exported[0], samples=samples)["score"]
    alone = [run(exported[0], samples=sample[None])["score"][0] for sample in samples]
    np.testing.assert_allclose(together, alone, rtol=1e-6, atol=1e-6)


def test_the_stream_graph_raises_the_detectors_alarms(detector, exported):
    samples = simulated_stream(HAND, 2000.0, torch.float32).T.contiguous()
    made = StreamingDetector(detector, dtype=torch.float64).push(samples)
    feeds = {"tail": np.empty((0, 4), np.float32), "state": np.empty(0), "threshold": np.empty(0)}
    got = run(exported[1], samples=samples.numpy(), **feeds)
    assert made.is_alarm.any()
    assert np.array_equal(got["alarm"], made.is_alarm)
    np.testing.assert_allclose(got["time_s"], made.available_s, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got["onset_s"], made.onset_s, rtol=0, atol=1e-9)


def test_a_model_says_of_itself_what_its_sidecar_says(detector, exported):
    for path, kind in zip(exported, ("bin", "stream"), strict=True):
        session = onnxruntime.InferenceSession(path)
        text = session.get_modelmeta().custom_metadata_map
        facts = {name: json.loads(value) for name, value in text.items()}
        beside = sidecar_facts(path)
        content = path.read_bytes()
        assert facts["graph"] == kind
        assert beside == facts | {
            "file": path.name,
            "onnx_sha256": hashlib.sha256(content).hexdigest(),
            "onnx_bytes": len(content),
        }
        shape = session.get_inputs()[0].shape
        assert len(facts["channels"]) == shape[-2 if kind == "bin" else -1] == 4
    window = Window.of(detector)
    parts = ("context_before_samples", "bin_samples", "context_after_samples")
    assert sum(sidecar_facts(exported[0])[name] for name in parts) == window.length


def test_a_stream_hands_on_what_it_says_it_does(exported):
    facts = sidecar_facts(exported[1])
    feeds = {"tail": np.empty((0, 4), np.float32), "state": np.empty(0), "threshold": np.empty(0)}
    for num in (0, 1, 300):
        got = run(exported[1], samples=np.zeros((num, 4), np.float32), **feeds)
        assert got["next_tail"].shape == (facts["tail_samples"], 4)
        assert got["next_state"].shape == (facts["state_size"],)
        needed = max(facts["first_samples"], facts["frame_samples"])
        due = 0 if num < needed else (num - facts["first_samples"]) // facts["hop_samples"] + 1
        assert len(got["score"]) == due


def test_what_the_check_measured_is_told(exported):
    for path in exported:
        facts = sidecar_facts(path)
        assert facts["check"]["simulated"] is True
        assert facts["check"]["guards"] > 5
        assert 0 < worst_error(facts) < 1e-3
        assert f"{worst_error(facts):.1e} score deviations" in summary(path)
        assert "no certificate" in summary(path)
    assert sidecar_facts(exported[1])["check"]["alarms"] > 0


def test_an_export_of_the_same_detector_gives_the_same_bytes(detector, exported, tmp_path):
    again = export_detector(detector, tmp_path, ["bin"], alone=False)[0]
    assert again.read_bytes() == exported[0].read_bytes()


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_head_and_scaler_comes_through(variant, precision, tmp_path):
    """The check sees to the errors; its bound is the one that it states."""
    detector = random_detector(**VARIANTS[variant])
    (path,) = export_detector(detector, tmp_path, ["bin"], precision, alone=False)
    worst = {"float32": 1e-3, "float64": 1e-9}[precision]
    assert 0 < worst_error(sidecar_facts(path)) <= worst
    samples = noise(5).to(getattr(torch, precision))
    got = run(path, samples=cropped(detector, samples))
    expected = detector.score_raw(samples.double())
    spread = float(detector.score_raw(noise(64)).std())
    np.testing.assert_allclose(got["score"], expected, rtol=0, atol=worst * spread)
    assert got["score"].dtype == precision
