"""The files of an export: right, whole, with their facts; or none, and the earlier ones kept."""

import copy
import hashlib
import json
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from small_detector import HAND, alarming_detector, certified, raw_bins, small_detector
from test_detector import VARIANTS, noise, random_detector

from tactslip_torch import export, train
from tactslip_torch.certify import FORMAT as CERTIFICATE_FORMAT
from tactslip_torch.export import export_detector, sidecar_facts, summary, worst_error
from tactslip_torch.graph.facts import sidecar_path
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


# Files that are right ---------------------------------------------------------------------------


def test_an_export_leaves_its_files_and_nothing_else(exported):
    names = ["model.onnx", "model.onnx.json", "stream.onnx", "stream.onnx.json"]
    assert [path.name for path in exported] == ["model.onnx", "stream.onnx"]
    assert sorted(path.name for path in exported[0].parent.iterdir()) == names
    for path in exported:
        onnx.checker.check_model(onnx.load(path), full_check=True)


@pytest.mark.parametrize("batch", [0, 1, 2, 7, 64])
def test_the_bin_graph_gives_the_detectors_judgement(detector, exported, batch):
    samples = raw_bins(batch, seed=batch).float()
    expected = detector.judge_raw(samples.double())
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


@pytest.mark.parametrize("precision", ["float32", "float64"])
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


def test_the_bulk_layout_gives_the_same(detector, exported, tmp_path):
    paths = export_detector(detector, tmp_path, layout="bulk", alone=False)
    samples = cropped(detector, raw_bins(64).float())
    in_bulk, one = (run(path, samples=samples)["score"] for path in (paths[0], exported[0]))
    assert sidecar_facts(paths[0])["layout"] == sidecar_facts(paths[1])["layout"] == "bulk"
    np.testing.assert_allclose(in_bulk, one, rtol=0, atol=1e-4 * float(one.std()))


# What is refused --------------------------------------------------------------------------------


def test_a_detector_without_alarm_gives_no_stream(tmp_path):
    with pytest.raises(ValueError, match="this detector has no alarm threshold"):
        export_detector(small_detector(), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"graphs": ["both"]}, "graphs must be bin or stream, or both, got both"),
        ({"graphs": []}, "got none"),
        ({"precision": "float16"}, "precision must be one of float32, float64, got 'float16'"),
        ({"layout": "small"}, "layout must be one of latency, bulk, got 'small'"),
    ],
)
def test_another_choice_is_refused(detector, tmp_path, arguments, message):
    with pytest.raises(ValueError, match=message):
        export_detector(detector, tmp_path, **arguments)
    assert not list(tmp_path.iterdir())


class Broken:
    """A graph whose model somebody changed."""

    def __init__(self, graph, change):
        self.graph, self.change = graph, change

    def model(self, metadata):
        model = self.graph.model(metadata)
        self.change(model)
        return model


def node_before(model, output):
    return next(node for node in model.graph.node if output in node.output)


def denies(model):
    """``valid`` is its contrary."""
    node = node_before(model, "valid")
    node.CopyFrom(helper.make_node("Not", node.input[:1], ["valid"]))


def tensors_of(graph):
    """Constants, those of bodies too."""
    yield from graph.initializer
    for node in graph.node:
        for part in node.attribute:
            if part.HasField("g"):
                yield from tensors_of(part.g)


def other_numbers(model):
    """Every second column of the largest matrix is 1 % larger."""
    largest = max(tensors_of(model.graph), key=lambda tensor: np.prod(tensor.dims))
    numbers = numpy_helper.to_array(largest).copy()
    numbers[..., ::2] *= 1.01
    largest.CopyFrom(numpy_helper.from_array(numbers, largest.name))


def static(model):
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 7


def foreign(model):
    model.graph.node.append(helper.make_node("DFT", ["samples"], ["spectrum"]))


def heavy(model):
    numbers = np.zeros(400_000, np.float32)
    model.graph.initializer.append(numpy_helper.from_array(numbers, "ballast"))


def silent(model):
    """Scores are of no number where a sample is none."""
    node = node_before(model, "score")
    model.graph.node.remove(node)
    first = model.graph.node.add
    first(op_type="ReduceSum", input=["samples", "both"], output=["sum"]).attribute.append(
        helper.make_attribute("keepdims", 0)
    )
    first(op_type="Sub", input=["sum", "sum"], output=["none"])
    first(op_type="Add", input=[node.input[0], "none"], output=["score"])
    model.graph.initializer.append(numpy_helper.from_array(np.array([1, 2]), "both"))


def wide(model):
    node = node_before(model, "score")
    node.CopyFrom(helper.make_node("Cast", node.input[:1], ["score"], to=TensorProto.DOUBLE))
    output = next(value for value in model.graph.output if value.name == "score")
    output.type.tensor_type.elem_type = TensorProto.DOUBLE


BREAKS = {
    "valid is wrong": (denies, "valid differs from torch"),
    "a matrix is wrong": (other_numbers, "scores differ from torch in float64"),
    "batch is fixed": (static, "axis 0 of samples is 7 for ever"),
    "an operator is slow": (foreign, "it has the operators DFT"),
    "the file is large": (heavy, "its file has .* bytes, more than"),
    "a guard is gone": (silent, "scores are not finite"),
    "a score is wide": (wide, "expected .*score float32"),
}


@pytest.mark.parametrize("name", BREAKS)
def test_a_bad_model_is_not_left_and_the_earlier_one_is_kept(detector, tmp_path, monkeypatch, name):
    change, message = BREAKS[name]
    earlier = {"model.onnx": b"yesterday's", "model.onnx.json": b"{}"}
    for file, content in earlier.items():
        (tmp_path / file).write_bytes(content)
    made = export._graph
    monkeypatch.setattr(export, "_graph", lambda *given: Broken(made(*given), change))
    with pytest.raises(ValueError, match=rf"model\.onnx was not written: .*{message}") as caught:
        export_detector(detector, tmp_path, ["bin"], alone=False)
    assert "\n" not in str(caught.value)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == earlier


def test_all_files_are_left_or_none(detector, tmp_path, monkeypatch):
    made = export._graph

    def graph(of, form, kind):
        return made(of, form, kind) if kind == "bin" else Broken(made(of, form, kind), denies)

    monkeypatch.setattr(export, "_graph", graph)
    with pytest.raises(ValueError, match=r"stream\.onnx was not written: .*valid differs"):
        export_detector(detector, tmp_path, alone=False)
    assert not list(tmp_path.iterdir())


def test_what_a_fresh_process_says_counts(detector, tmp_path, monkeypatch):
    """It is the file that is run there; here a changed one."""
    saved = onnx.save

    def save(model, path):
        model = copy.deepcopy(model)
        other_numbers(model)
        saved(model, path)

    monkeypatch.setattr(export.onnx, "save", save)
    with pytest.raises(ValueError, match="in a fresh process score is another"):
        export_detector(detector, tmp_path, ["bin"])
    assert not list(tmp_path.iterdir())


# Where it comes from ----------------------------------------------------------------------------


@pytest.fixture
def kept(tmp_path):
    """A detector in its file, and the digest of that."""
    source = tmp_path / "detector.pt"
    small_detector(engine="eager").save(source)
    return source, hashlib.sha256(source.read_bytes()).hexdigest()


@pytest.fixture
def quick(monkeypatch):
    """What is asked is where a model comes from; that it is right is asked elsewhere."""
    measured = {"noise": {"worst_sd": 1e-6}, "simulated_slip": {"worst_sd": 1e-6}}
    monkeypatch.setattr(export, "check_model", lambda *given: measured)


def exported_with(source, certificate=None):
    if certificate is not None:
        source.with_name("certificate.json").write_text(certificate)
    (path,) = export_detector(
        small_detector(engine="eager"), source.parent, ["bin"], source=source, alone=False
    )
    return sidecar_facts(path), summary(path)


@pytest.mark.usefixtures("quick")
def test_the_certificate_of_this_detector_is_handed_on(kept):
    source, digest = kept
    content = certified(small_detector()).facts()
    content |= {"format": CERTIFICATE_FORMAT, "detector": {"sha256": digest}}
    facts, line = exported_with(source, json.dumps(content))
    assert facts["detector_sha256"] == digest
    margin = content["margin"]["score"]
    assert facts["certificate"]["margin"] == margin
    assert f"certified but where |score| is below {margin:.1e} (simulated data)" in line
    _, line = exported_with(source, json.dumps(content | {"holds": False}))
    assert "its certificate does not hold" in line


@pytest.mark.usefixtures("quick")
def test_no_other_certificate_is_handed_on(kept):
    source, digest = kept
    content = certified(small_detector()).facts()
    of_another = content | {"format": CERTIFICATE_FORMAT, "detector": {"sha256": "0" * 64}}
    foreign = {"format": "another", "detector": {"sha256": digest}}
    hollow = {"format": CERTIFICATE_FORMAT, "detector": {"sha256": digest}}
    for text in (None, json.dumps(of_another), json.dumps(foreign), json.dumps(hollow), "{", "[]"):
        facts, line = exported_with(source, text)
        assert facts["detector_sha256"] == digest
        assert facts["certificate"] is None
        assert "no certificate" in line


# The end of training ----------------------------------------------------------------------------


def test_training_tells_of_each_graph_and_loses_nothing(detector, tmp_path, monkeypatch):
    detector.save(tmp_path / "detector.pt")
    found = train._export(detector, tmp_path)
    assert found.keys() == {"bin", "stream"}
    for kind, name in export.FILES.items():
        assert found[kind]["bytes"] == (tmp_path / name).stat().st_size
        assert found[kind]["error"] == worst_error(sidecar_facts(tmp_path / name)) < 1e-3
    digest = hashlib.sha256((tmp_path / "detector.pt").read_bytes()).hexdigest()
    assert sidecar_facts(tmp_path / "stream.onnx")["detector_sha256"] == digest

    def failing(of, form, kind):
        raise ValueError("no such descriptor\nas a graph")

    monkeypatch.setattr(export, "_graph", failing)
    found = train._export(small_detector(), tmp_path)
    assert found == {"bin": f"{tmp_path / 'model.onnx'} was not written: no such descriptor"}


# The command ------------------------------------------------------------------------------------


def command(monkeypatch, capsys, *arguments):
    """Exit status, what was said, and what was wrong."""
    monkeypatch.setattr(sys, "argv", ["export", *arguments])
    status = 0
    try:
        export.main()
    except SystemExit as stop:
        status = stop.code
    said = capsys.readouterr()
    return status, said.out, said.err


def test_the_command_leaves_what_the_detector_can_give(monkeypatch, capsys, tmp_path, detector):
    detector.save(tmp_path / "detector.pt")
    made = []

    def instead(of, folder, graphs, precision, layout, *, source):
        made.append((str(folder), graphs, precision, layout, str(source)))
        return ()

    monkeypatch.setattr(export, "export_detector", instead)
    model = f"model={tmp_path / 'detector.pt'}"
    assert command(monkeypatch, capsys, model) == (0, "", "")
    out = tmp_path / "out"
    options = ("graph=stream", "precision=float64", "layout=bulk", f"output={out}")
    assert command(monkeypatch, capsys, model, *options)[0] == 0
    command(monkeypatch, capsys, model, "graph=both")
    detector = small_detector()
    detector.save(tmp_path / "detector.pt")
    command(monkeypatch, capsys, model)
    source, here = str(tmp_path / "detector.pt"), str(tmp_path)
    assert made == [
        (here, ("bin", "stream"), "float32", "latency", source),
        (str(out), ("stream",), "float64", "bulk", source),
        (here, ("bin", "stream"), "float32", "latency", source),
        (here, ("bin",), "float32", "latency", source),
    ]


WRONG_COMMANDS = {
    "another graph": (["graph=all"], "graph must be bin, stream or both, got 'all'"),
    "another precision": (["precision=float16"], "precision must be one of float32, float64"),
    "no alarm": (["graph=stream"], "this detector has no alarm threshold; train with +exp=onset"),
    "a file": (["output=small.onnx"], "output must be a folder, got small.onnx"),
}


@pytest.mark.parametrize("name", WRONG_COMMANDS)
def test_bad_input_is_one_line(monkeypatch, capsys, tmp_path, name):
    small_detector().save(tmp_path / "detector.pt")
    arguments, words = WRONG_COMMANDS[name]
    model = f"model={tmp_path / 'detector.pt'}"
    status, out, err = command(monkeypatch, capsys, model, *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert words in err
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["detector.pt"]


@pytest.mark.slow
def test_it_works_as_a_command(detector, tmp_path):
    detector.save(tmp_path / "detector.pt")
    done = subprocess.run(
        [sys.executable, "-m", "tactslip_torch.export", "model=detector.pt", "output=out"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.split(":")[0] for line in lines] == ["out/model.onnx", "out/stream.onnx"]
    assert all("kB, float32, within" in line for line in lines)
    for name in ("model.onnx", "stream.onnx"):
        assert sidecar_path(tmp_path / "out" / name).is_file()
