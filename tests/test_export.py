"""Exported files: right, whole, with their metadata, or none at all; the command, and training."""

import hashlib
import json
import shutil

import onnxruntime
import pytest
import torch
from small_detector import HAND, alarming_detector, small_detector
from test_commands import composed

from tactslip_torch.commands.export import export as export_command
from tactslip_torch.commands.train import _export_fold
from tactslip_torch.deploy import export
from tactslip_torch.deploy.export import (
    export_detector,
    read_sidecar,
    summary,
)
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.rules import Cusum

pytestmark = pytest.mark.onnx


@pytest.fixture(scope="module")
def detector():
    return alarming_detector()


@pytest.fixture(scope="module")
def exported(detector, tmp_path_factory):
    """Both files; the detector stays as it was."""
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    paths = export_detector(detector, tmp_path_factory.mktemp("export") / "deep")
    for name, value in detector.state_dict().items():
        assert torch.equal(value, before[name])
        assert value.dtype == torch.float64
    return paths


def test_a_model_says_of_itself_what_its_sidecar_says(detector, exported):
    for path, kind in zip(exported, ("bin", "stream"), strict=True):
        session = onnxruntime.InferenceSession(path)
        text = session.get_modelmeta().custom_metadata_map
        metadata = {name: json.loads(value) for name, value in text.items()}
        content = path.read_bytes()
        assert read_sidecar(path) == metadata | {
            "file": path.name,
            "onnx_sha256": hashlib.sha256(content).hexdigest(),
            "onnx_bytes": len(content),
        }
        said = {
            "graph": kind,
            "precision": "float32",
            "channels": list(HAND.names),
            "kinds": ["SG", "SG", "PVDF", "PVDF"],
            "features": [str(name) for name in detector.selected_names],
        }
        assert {name: metadata[name] for name in said} == said
        worst_sd = metadata["check"]["worst_sd"]
        assert 0 < worst_sd < 1e-3
        assert f"{worst_sd:.1e} standard deviations of those that torch" in summary(path)
    sidecar = exported[1].with_name("stream.onnx.json").read_text()
    lines = [line.strip(" ,") for line in sidecar.splitlines()]
    for name, value in read_sidecar(exported[1]).items():  # a scalar a line: for hosts in C
        if not isinstance(value, dict | list):
            assert f'"{name}": {json.dumps(value)}' in lines


def test_an_export_of_the_same_detector_gives_the_same_bytes(detector, exported, tmp_path):
    detector.save(tmp_path / "detector.pt")
    again = export_detector(detector, tmp_path, ["bin"], source=tmp_path / "detector.pt")[0]
    assert again.read_bytes() == exported[0].read_bytes()


# Where a file comes from -----------------------------------------------------------------------


@pytest.fixture
def unchecked(monkeypatch):
    """That a model is right is asked elsewhere."""
    monkeypatch.setattr(export, "check_model", lambda *given: {"worst_sd": 1e-6})


@pytest.mark.usefixtures("unchecked")
def test_a_calibration_of_training_and_a_curve_are_told_and_what_json_has_not_is_null(tmp_path):
    made = small_detector()
    made.info["calibration"] = Platt(2.0, 0.5).to_dict()
    (path,) = export_detector(made, tmp_path, ["bin"])
    told = read_sidecar(path)
    assert (told["calibration"], told["slip_share"]) == (Platt(2.0, 0.5).to_dict(), 0.5)
    curve = {"threshold_curve": [[2.0, 30.0], [4.0, 0.5]]}
    endless = AlarmSettings(20, Platt(2.0, 0.5), Cusum(), float("inf"), 1.0, metadata=curve)
    made.info[KEY] = endless.to_dict()
    (path,) = export_detector(made, tmp_path, ["stream"])
    assert read_sidecar(path)["threshold"] is None
    assert read_sidecar(path)["threshold_curve"] == curve["threshold_curve"]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("tare_s", [None, [0.1, 0.5]])
def test_the_rest_whose_mean_is_taken_off_is_told(tmp_path, tare_s):
    made = small_detector()
    made.info["reading"] = {"tare_s": tare_s}
    (path,) = export_detector(made, tmp_path, ["bin"])
    assert read_sidecar(path)["tare_s"] == tare_s


# What is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("graphs", "came"), [(["both"], "both"), ([], "none")])
def test_another_choice_is_refused(tmp_path, graphs, came):
    with pytest.raises(ValueError, match=f"graphs must be bin or stream, or both, got {came}"):
        export_detector(small_detector(), tmp_path, graphs)
    assert not list(tmp_path.iterdir())


def test_a_wrong_model_is_not_left_and_the_earlier_files_are_kept(detector, tmp_path, monkeypatch):
    earlier = {"model.onnx": b"yesterday's", "model.onnx.json": b"{}"}
    for file, content in earlier.items():
        (tmp_path / file).write_bytes(content)
    right, of_another = export.stream_graph, alarming_detector(3)
    monkeypatch.setattr(export, "stream_graph", lambda _, *given: right(of_another, *given))
    with pytest.raises(ValueError, match=r"stream\.onnx was not written: .*differs?"):
        export_detector(detector, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == earlier


def test_training_tells_of_each_graph_and_loses_nothing(detector, tmp_path, monkeypatch):
    detector.save(tmp_path / "detector.pt")
    monkeypatch.setattr(export, "check_model", lambda *given: {"worst_sd": 1e-6})
    found = _export_fold(detector, tmp_path)
    for kind, name in export.FILES.items():
        size = (tmp_path / name).stat().st_size
        assert found[kind] == {"error": 1e-6, "bytes": size}

    def failing(*given):
        raise ValueError("no such descriptor\nas a graph")

    monkeypatch.setattr(export, "bin_graph", failing)
    found = _export_fold(small_detector(), tmp_path)
    assert found == {"bin": f"{tmp_path / 'model.onnx'} was not written: no such descriptor"}


# The command -----------------------------------------------------------------------------------


def command(model, folder, *overrides):
    """Run it as it is called."""
    export_command(composed(f"model={model}", *overrides, name="export"), folder)


@pytest.mark.usefixtures("unchecked")
def test_the_command_leaves_what_the_detector_can_give(capsys, tmp_path, detector):
    model, out = tmp_path / "detector.pt", tmp_path / "out"
    detector.save(model)
    command(model, tmp_path)
    lines = capsys.readouterr().out.splitlines()
    files = [str(tmp_path / name) for name in ("model.onnx", "stream.onnx")]
    assert [line.split(":")[0] for line in lines] == files
    assert all("kB, float32, scores within" in line for line in lines)
    command(model, tmp_path, "graph=stream", "precision=float64", f"output={out}")
    assert sorted(path.name for path in out.iterdir()) == ["stream.onnx", "stream.onnx.json"]
    assert read_sidecar(out / "stream.onnx")["precision"] == "float64"
    with pytest.raises(ValueError, match=r"^output must be a folder, got small\.onnx"):
        command(model, tmp_path, "output=small.onnx")


def test_export_writes_where_it_is_told_and_else_beside_the_detector(paper, command, tmp_path):
    model = shutil.copy(paper.file, tmp_path / "detector.pt")
    for words, place in (
        (["hydra.run.dir=told"], "told"),
        (["output=out", "hydra.run.dir=told"], "out"),
        ([], ""),
    ):
        command.well(tmp_path, "export", f"model={model}", "graph=bin", *words)
        assert (tmp_path / place / "model.onnx").is_file(), words
    assert not (tmp_path / "told" / "model.onnx").samefile(tmp_path / "model.onnx")
