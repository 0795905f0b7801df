"""What a model says of itself: in its metadata, and in the sidecar beside it."""

import copy
import hashlib
import json
import math

import onnxruntime
import pytest
from small_detector import certified, small_detector
from test_graph_structure import guarded

from tactslip_torch.graph.facts import (
    FORMAT,
    Origin,
    certificate_facts,
    detector_sha256,
    in_file,
    model_facts,
    sidecar_path,
    sidecar_text,
)
from tactslip_torch.graph.form import Form
from tactslip_torch.model.abstention import KEY as ABSTAIN
from tactslip_torch.model.abstention import Abstention
from tactslip_torch.model.calibration import Isotonic, Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.rules import Cusum
from tactslip_torch.onset.settings import KEY, AlarmSettings

ORIGIN = Origin("1.2.3", "ab" * 32)
IN_BOTH = {
    *("format", "version", "graph", "precision", "channels", "kinds", "unit"),
    *("sample_rate_hz", "bin_samples", "context_before_samples", "context_after_samples"),
    *("features", "slip_if_score_at_least", "calibration", "slip_share", "abstain"),
    *("experiment", "train_materials", "simulated", "detector_sha256", "certificate"),
}
IN_STREAM = {
    *("hop_samples", "first_samples", "frame_samples", "tail_samples", "state_size", "rule"),
    *("threshold", "target_false_alarms_per_hour", "threshold_curve"),
}


def alarming(settings=None):
    detector = small_detector()
    settings = settings or AlarmSettings(20, Platt(2.0, 0.5), Cusum(ceiling=8.0), 3.0, 1.5)
    detector.info |= {KEY: settings.to_dict(), "train_materials": ["M1", "M4"]}
    return detector


def test_a_bin_graph_says_what_a_host_must_know():
    detector = small_detector()
    facts = model_facts(detector, Form("float64"), ORIGIN)
    assert facts.keys() == IN_BOTH
    assert facts["format"] == FORMAT == "tactslip_torch onnx 1"
    assert (facts["graph"], facts["precision"]) == ("bin", "float64")
    assert facts["channels"] == ["SG1", "SG2", "PVDF1", "PVDF2"]
    assert facts["kinds"] == ["SG", "SG", "PVDF", "PVDF"]
    assert (facts["unit"], facts["sample_rate_hz"], facts["bin_samples"]) == ("V", 2000.0, 100)
    assert (facts["context_before_samples"], facts["context_after_samples"]) == (25, 25)
    assert facts["features"] == [str(name) for name in detector.selected_names]
    assert facts["slip_if_score_at_least"] == 0.0
    assert facts["calibration"] is facts["slip_share"] is facts["certificate"] is None
    assert facts["abstain"] is None
    assert (facts["experiment"], facts["train_materials"], facts["simulated"]) == (None, [], True)
    assert (facts["version"], facts["detector_sha256"]) == ("1.2.3", "ab" * 32)


def test_a_graph_says_between_which_scores_a_host_is_unsure():
    detector = small_detector()
    detector.info[ABSTAIN] = Abstention(0.9, -0.25, 0.5, {"unit": "recording"}).to_dict()
    facts = model_facts(detector, Form(), ORIGIN)
    assert facts["abstain"] == {"coverage": 0.9, "low": -0.25, "high": 0.5, "unit": "recording"}


def test_a_stream_graph_says_how_it_decides():
    detector = alarming()
    facts = model_facts(detector, Form(), ORIGIN, "stream")
    assert facts.keys() == IN_BOTH | IN_STREAM
    assert (facts["graph"], facts["train_materials"]) == ("stream", ["M1", "M4"])
    assert (facts["hop_samples"], facts["state_size"]) == (20, 7)
    assert facts["tail_samples"] == 25 + 100 + 25 - 1  # with the next, those of a bin
    assert (facts["first_samples"], facts["frame_samples"]) == (125, 51)
    assert facts["rule"] == Cusum(ceiling=8.0).to_dict()
    assert facts["calibration"] == {"kind": "platt", "slope": 2.0, "offset": 0.5}
    assert (facts["threshold"], facts["target_false_alarms_per_hour"]) == (3.0, 1.5)
    assert facts["threshold_curve"] == []


def test_a_calibration_of_training_is_told_without_an_alarm():
    detector = small_detector()
    detector.info["calibration"] = Platt(2.0, 0.5).to_dict()
    facts = model_facts(detector, Form(), ORIGIN)
    assert (facts["calibration"], facts["slip_share"]) == (Platt(2.0, 0.5).to_dict(), 0.5)


def test_the_curve_of_thresholds_is_handed_on_where_it_is_known():
    curve = [[2.0, 30.0], [4.0, 0.5]]
    settings = AlarmSettings(
        20, Platt(2.0, 0.5), Cusum(), 3.0, 1.0, facts={"threshold_curve": curve}
    )
    facts = model_facts(alarming(settings), Form(), ORIGIN, "stream")
    assert facts["threshold_curve"] == curve


def test_what_json_does_not_have_is_null():
    settings = AlarmSettings(20, Isotonic((0.0, 1.0), (-2.0, 2.0)), Cusum(), math.inf, 1.0)
    facts = model_facts(alarming(settings), Form(), ORIGIN, "stream")
    assert facts["threshold"] is None
    assert facts["calibration"]["scores"] == [0.0, 1.0]
    assert json.loads(json.dumps(facts, allow_nan=False)) == facts


def test_facts_come_back_from_the_file_through_onnxruntime():
    facts = model_facts(alarming(), Form(), ORIGIN, "stream") | {"check": {"worst_sd": 1e-6}}
    model = guarded()
    for name, text in in_file(facts).items():
        model.metadata_props.add(key=name, value=text)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    read = session.get_modelmeta().custom_metadata_map
    assert {name: json.loads(text) for name, text in read.items()} == facts


def test_a_sidecar_has_a_line_for_each_scalar_and_knows_its_file(tmp_path):
    assert sidecar_path(tmp_path / "stream.onnx") == tmp_path / "stream.onnx.json"
    facts = model_facts(alarming(), Form(), ORIGIN, "stream")
    text = sidecar_text(facts, "stream.onnx", b"all of it")
    read = json.loads(text)
    assert {name: read[name] for name in facts} == facts
    assert read.keys() - facts.keys() == {"file", "onnx_sha256", "onnx_bytes"}
    assert (read["file"], read["onnx_bytes"]) == ("stream.onnx", 9)
    assert read["onnx_sha256"] == hashlib.sha256(b"all of it").hexdigest()
    lines = text.splitlines()
    for name, value in read.items():
        if not isinstance(value, dict | list):
            assert f' "{name}": {json.dumps(value)}' in [line.removesuffix(",") for line in lines]


def test_the_digest_of_a_detector_is_that_of_its_file(tmp_path):
    detector = small_detector()
    detector.save(tmp_path / "detector.pt")
    digest = hashlib.sha256((tmp_path / "detector.pt").read_bytes()).hexdigest()
    assert detector_sha256(detector) == digest
    assert detector_sha256(SlipDetector.load(tmp_path / "detector.pt")) == digest
    other = copy.deepcopy(detector)
    other.info["seed"] = 1
    assert detector_sha256(other) != digest


def test_of_a_certificate_stands_what_a_host_can_use():
    found = certified(small_detector())
    facts = certificate_facts(found.content)
    assert (facts["holds"], facts["simulated"]) == (found.holds, True)
    margin = found.content["margin"]
    assert (facts["margin"], facts["margin_sd"]) == (margin["score"], margin["sd"])
    assert facts["margin"] == pytest.approx(facts["margin_sd"] * facts["score_sd"])
    assert facts["sets"].keys() == {"calibration"}
    assert facts["sets"]["calibration"]["bins"] == 48
    with pytest.raises(KeyError):
        certificate_facts({"margin": {"score": 1.0}})
