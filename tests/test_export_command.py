"""Exports from detectors in their files: whose certificate, by training, by the command."""

import hashlib
import json
import subprocess
import sys

import pytest
from small_detector import alarming_detector, certified, small_detector

from tactslip_torch.commands import export as export_command
from tactslip_torch.graph import export
from tactslip_torch.graph.export import export_detector, sidecar_facts, summary, worst_error
from tactslip_torch.graph.facts import CERTIFICATE_FORMAT, sidecar_path
from tactslip_torch.training import experiment

pytestmark = pytest.mark.onnx


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


# Where it comes from ----------------------------------------------------------------------------


@pytest.fixture
def kept(tmp_path):
    """A detector in its file, and the digest of that."""
    source = tmp_path / "detector.pt"
    small_detector(backend="auto").save(source)
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
        small_detector(backend="auto"), source.parent, ["bin"], source=source, alone=False
    )
    return sidecar_facts(path), summary(path)


@pytest.mark.usefixtures("quick")
def test_the_certificate_of_this_detector_is_handed_on(kept):
    source, digest = kept
    content = certified(small_detector()).content
    content |= {"format": CERTIFICATE_FORMAT, "detector": {"sha256": digest}}
    facts, line = exported_with(source, json.dumps(content))
    assert facts["detector_sha256"] == digest
    margin = content["margin"]["score"]
    assert facts["certificate"]["margin"] == margin
    assert f"certified but where |score| is below {margin:.1e} (simulated data)" in line
    _, line = exported_with(source, json.dumps(content | {"holds": False}))
    assert "its certificate does not hold" in line


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_no_other_certificate_is_handed_on(kept):
    source, digest = kept
    content = certified(small_detector()).content
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
    found = experiment.export_fold(detector, tmp_path)
    assert found.keys() == {"bin", "stream"}
    for kind, name in export.FILES.items():
        assert found[kind]["bytes"] == (tmp_path / name).stat().st_size
        assert found[kind]["error"] == worst_error(sidecar_facts(tmp_path / name)) < 1e-3
    digest = hashlib.sha256((tmp_path / "detector.pt").read_bytes()).hexdigest()
    assert sidecar_facts(tmp_path / "stream.onnx")["detector_sha256"] == digest

    def failing(of, form, kind):
        raise ValueError("no such descriptor\nas a graph")

    monkeypatch.setattr(export, "_graph", failing)
    found = experiment.export_fold(small_detector(), tmp_path)
    assert found == {"bin": f"{tmp_path / 'model.onnx'} was not written: no such descriptor"}


# The command ------------------------------------------------------------------------------------


def command(monkeypatch, capsys, *arguments):
    """Exit status, what was said, and what was wrong."""
    monkeypatch.setattr(sys, "argv", ["export", *arguments])
    status = 0
    try:
        export_command.main()
    except SystemExit as stop:
        status = stop.code
    said = capsys.readouterr()
    return status, said.out, said.err


def test_the_command_leaves_what_the_detector_can_give(monkeypatch, capsys, tmp_path, detector):
    detector.save(tmp_path / "detector.pt")
    made = []

    def instead(of, folder, graphs, precision, *, source):
        made.append((str(folder), graphs, precision, str(source)))
        return ()

    monkeypatch.setattr(export_command, "export_detector", instead)
    model = f"model={tmp_path / 'detector.pt'}"
    assert command(monkeypatch, capsys, model) == (0, "", "")
    out = tmp_path / "out"
    options = ("graph=stream", "precision=float64", f"output={out}")
    assert command(monkeypatch, capsys, model, *options)[0] == 0
    command(monkeypatch, capsys, model, "graph=both")
    detector = small_detector()
    detector.save(tmp_path / "detector.pt")
    command(monkeypatch, capsys, model)
    source, here = str(tmp_path / "detector.pt"), str(tmp_path)
    assert made == [
        (here, ("bin", "stream"), "float32", source),
        (str(out), ("stream",), "float64", source),
        (here, ("bin", "stream"), "float32", source),
        (here, ("bin",), "float32", source),
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
        [sys.executable, "-m", "tactslip_torch", "export", "model=detector.pt", "output=out"],
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
