"""``adapt`` as a command: what it leaves, takes back and refuses, on files of a tiny hand."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from drawing import assert_png
from hydra.errors import InstantiationException
from test_commands import TINY, TinyRecordings, composed

from tactslip_torch import SlipDetector
from tactslip_torch.commands import adapt as module
from tactslip_torch.commands.adapt import adapt
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.commands.train import train
from tactslip_torch.data.folder import RecordingFolder, write_manifest
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.training.adaptation import (
    AccuracyChange,
    Statistics,
    add,
    detector_digest,
    locked,
)

TRAINING = (
    *TINY,
    *("recipe=robust", "baselines=false", "data.seed=0", "statistics=true"),
    "cache=off",
)
SETTINGS = AlarmSettings(20, Platt(1.0, 0.0), KOfN(2, 3), 2.0, target_per_hour=1.0)


def write_files(folder, materials, cycles=4, seed=0, wanted=None):
    """Recordings in files with their manifest: all, or the named ones."""
    source = TinyRecordings(seed, cycles, materials)
    folder.mkdir()
    files = RecordingFolder(source, folder, "npz", {})
    chosen = [r for r in source.ids if wanted is None or str(r) in wanted]
    write_manifest(folder, [files.write(recording) for recording in chosen])
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train(composed(*TRAINING), folder)
    detector = SlipDetector.load(folder / "detector.pt")
    detector.info[KEY] = SETTINGS.to_dict()
    detector.save(folder / "detector.pt")
    return folder


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("files") / "set", ["A", "B", "C"])


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run that may be changed."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def act(run, *overrides):
    """Carry out the command on a run; what it returns."""
    told = f"model={run / 'detector.pt'}", "cache=off"
    return adapt(composed(*told, *overrides, name="adapt"), run / "results")


def content(run):
    return [(run / name).read_bytes() for name in ("detector.pt", "statistics.pt")]


def add_c(run, files, *overrides):
    chosen = f"recordings={files}", "data.materials=[C]", "margin=0.2"
    return act(run, *chosen, *overrides)


def test_training_leaves_statistics_that_make_its_detector(trained):
    found = Statistics.load(trained / "statistics.pt")
    detector = SlipDetector.load(trained / "detector.pt")
    assert found.detector == detector_digest(detector)
    machine = found.machine
    head = found.sums.solve(machine.penalty, machine.offset, balance=machine.balance)
    z = found.rehearsal.z
    torch.testing.assert_close(head(z), detector.head(z), rtol=1e-9, atol=1e-12)
    assert sorted(set(found.rehearsal.materials)) == ["A", "B"]


def test_a_material_comes_in_and_all_is_said(run, files, trained, capsys, monkeypatch):
    written = []
    monkeypatch.setattr(
        module,
        "export_detector",
        lambda detector, *place, source: written.append((*place, source.read_bytes())),
    )
    found = add_c(run, files, "export=true")
    # both graphs, for an alarm is set
    assert written == [(run, ["bin", "stream"], (run / "detector.pt").read_bytes())]
    kept = json.loads((run / "results" / "adaptation.json").read_text())
    assert kept == json.loads(json.dumps(found))
    assert (kept["accepted"], kept["simulated"]) == (True, False)
    assert sorted(kept["old"]["before"]) == ["A", "B"]
    assert_png(run / "results" / "adaptation.png")
    assert "C (new)" in capsys.readouterr().out
    old, new = (SlipDetector.load(f / "detector.pt") for f in (trained, run))
    assert not torch.equal(old.head.quadratic, new.head.quadratic)
    assert torch.equal(old.scaler.minimum, new.scaler.minimum)
    assert new.info["train_materials"] == ["A", "B", "C"]
    added = [f"C/{cycle}" for cycle in range(4)]
    assert sorted(n for n in new.info["train_recordings"] if n[0] == "C") == added
    (entry,) = new.info["adaptations"]
    assert entry["weight"] == found["weight"] > 0
    assert entry["recordings"] == added
    alarm = AlarmSettings.of(new)
    assert (alarm.threshold, alarm.target_per_hour) == (SETTINGS.threshold, None)
    assert "it stands for no rate; the calibration is made anew" in alarm.metadata["adapted"]
    assert alarm.calibration.to_dict() == new.info["calibration"] != SETTINGS.calibration.to_dict()
    assert new.info["calibration"] != old.info["calibration"]


def test_steps_in_and_out_are_listed_and_taken_back_to_the_bit(
    run, files, trained, capsys, monkeypatch
):
    """Graphs beside it are told to be of another detector while they are."""
    source, kept = run / "detector.pt", trained / "detector.pt"
    act(run, "action=list")
    assert "no step since training" in capsys.readouterr().out
    monkeypatch.setattr("tactslip_torch.deploy.export.check_model", lambda *_: {"worst_sd": 0.0})
    export_detector(SlipDetector.load(source), run, ["bin"], source=source)
    add_c(run, files, "weight=2")
    stale = "model.onnx beside it: of another detector; python -m tactslip_torch export model="
    assert stale in capsys.readouterr().out
    added = source.read_bytes()
    assert len(act(run, "action=list")["steps"]) == 1
    act(run, "action=forget", "material=C")
    old, new = SlipDetector.load(kept), SlipDetector.load(source)
    z = Statistics.load(run / "statistics.pt").rehearsal.z
    torch.testing.assert_close(new.head(z), old.head(z), rtol=1e-9, atol=1e-12)
    assert new.info["train_materials"] == ["A", "B"]
    act(run, "action=undo")
    assert source.read_bytes() == added
    source.write_bytes(kept.read_bytes())  # as where writing was cut off between the two files
    with pytest.raises(ValueError, match=r"one step ahead of .* action=undo"):
        act(run, "action=list")
    capsys.readouterr()
    act(run, "action=undo")
    assert stale not in capsys.readouterr().out
    assert source.read_bytes() == kept.read_bytes()
    sums, before = (Statistics.load(each / "statistics.pt").sums for each in (run, trained))
    torch.testing.assert_close(sums.sums, before.sums, rtol=0, atol=1e-11)
    assert sums.seen_batches == before.seen_batches
    with pytest.raises(ValueError, match="nothing to undo"):
        act(run, "action=undo")


def test_a_training_material_is_forgotten_from_its_files(run, tmp_path):
    before = Statistics.load(run / "statistics.pt").sums.seen_batches
    of_b = {name for name in before if name.startswith("B")}
    files = write_files(tmp_path / "files", ["B"], wanted=of_b)
    act(run, "action=forget", f"recordings={files}")
    assert {*Statistics.load(run / "statistics.pt").sums.seen_batches} == {*before} - of_b
    assert SlipDetector.load(run / "detector.pt").info["train_materials"] == ["A"]


def test_what_old_materials_do_not_allow_changes_nothing(run, files, monkeypatch):
    falling = AccuracyChange({"A": 0.9, "B": 0.9}, {"A": 0.6, "B": 0.6})
    monkeypatch.setattr(module, "add", lambda *given: replace(add(*given), old=falling))
    state = content(run)
    with pytest.raises(ValueError, match="refused, nothing is changed: old materials fall"):
        add_c(run, files, "weight=1")
    assert content(run) == state
    kept = json.loads((run / "results" / "adaptation.json").read_text())
    assert kept["accepted"] is False
    assert kept["problem"].startswith("old materials fall from 90.00 to 60.00 %")
    add_c(run, files, "weight=1", "force=true")
    assert content(run) != state
    assert Statistics.load(run / "statistics.pt").steps[0].entry["forced"] is True


@pytest.mark.slow
def test_no_recording_comes_in_twice_by_another_name(run, files, tmp_path):
    add_c(run, files, "weight=2", "material=wood")
    state = content(run)
    for again in ([], ["material=steel"], ["material=wood"]):
        with pytest.raises(ValueError, match=r"is in already.*; action=forget takes it out first"):
            add_c(run, files, "weight=2", *again)
    twins = write_files(tmp_path / "twins", ["D"], cycles=2, seed=1)
    one, other = sorted(twins.glob("D*.npz"))
    other.write_bytes(one.read_bytes())
    with pytest.raises(ValueError, match="D/1 is the same recording as D/0; give it once"):
        act(run, f"recordings={twins}", "weight=2")
    assert content(run) == state


@pytest.mark.slow
def test_two_programs_do_not_change_a_detector_at_once(run, files):
    state = content(run)
    with locked(run / "detector.pt"), pytest.raises(ValueError, match="another adapt is changing"):
        add_c(run, files, "weight=2")
    assert content(run) == state
    add_c(run, files, "weight=2")
    assert not list(run.glob(".*"))
    (run / ".detector.pt.lock").touch()  # of a program that was killed
    with pytest.raises(ValueError, match=r"if none runs any more, remove .*\.detector\.pt\.lock$"):
        act(run, "action=undo")
    act(run, "action=list")


REFUSED = [
    (["recordings=nowhere"], "no folder at nowhere"),
    (["weight=heavy"], "weight must be auto or a positive number below 8000, got 'heavy'"),
    (["action=forget", "material=D"], "action=forget needs material= one that was added"),
    (["action=forget"], "action=forget needs material= one that was added (none was), or rec"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED)
def test_bad_input_is_one_line(run, overrides, message):
    state = content(run)
    with pytest.raises((ValueError, FileNotFoundError, InstantiationException)) as caught:
        act(run, *overrides)
    assert message in one_line(caught.value)
    assert content(run) == state


def test_a_detector_without_its_statistics_says_how_to_get_them(run, trained):
    other = SlipDetector.load(run / "detector.pt")
    other.head.constant += 1
    other.save(run / "detector.pt")
    with pytest.raises(ValueError, match="belongs to another detector"):
        act(run, "action=list")
    (run / "statistics.pt").unlink()
    with pytest.raises(FileNotFoundError, match="train with recipe=robust statistics=true"):
        act(run, "action=list")


NO_STATISTICS = [
    (["recipe.kernel=rbf", "recipe.gamma=0.1"], "statistics=true needs recipe.kernel="),
    (["ckpt_path=elsewhere"], "statistics=true needs the first pass"),
]


@pytest.mark.parametrize(("overrides", "message"), NO_STATISTICS)
def test_training_refuses_statistics_that_it_cannot_leave(tmp_path, overrides, message):
    with pytest.raises(ValueError, match=message):
        train(composed(*TRAINING, *overrides), tmp_path)
