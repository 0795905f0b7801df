"""Recordings written to a folder: which files there are, what they hold, and what is kept."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import savgol
from test_commands import BAD_INPUT, TinyRecordings, composed

from tactslip_torch import HandLayout, simulate
from tactslip_torch.commands import generate as module
from tactslip_torch.commands.generate import generate
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.data.formats import FORMATS
from tactslip_torch.simulation.scene import Scene

TRUTH = ("onsets_s", "annotated_onsets_s", "sliding_s", "non_slip_s", "speeds_mm_s", "released_s")
TINY = ("data._target_=test_generate.CountedRecordings", "materials=[A,B]", "cycles=3")


class CountedRecordings(TinyRecordings):
    """A stand-in that counts what is loaded here, and fails where it is told to."""

    loads = 0
    fails = ""

    def load(self, recording, windows=None):
        CountedRecordings.loads += 1
        if str(recording) == self.fails:
            raise ValueError(f"{recording} cannot be read")
        return super().load(recording, windows)


@pytest.fixture(autouse=True)
def _fresh(monkeypatch):
    monkeypatch.setattr(CountedRecordings, "loads", 0)
    monkeypatch.setattr(CountedRecordings, "fails", "")


def run(folder, *overrides):
    """What ``generate`` returns for the tiny set, or for the simulated one."""
    own = overrides if any(o.startswith("scene=") for o in overrides) else (*TINY, *overrides)
    config = composed("num_workers=0", "figure=false", *own, name="generate")
    return generate(config, folder)


def manifest(folder):
    with (folder / "manifest.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.npz"))}


# What is written -----------------------------------------------------------------------------


def test_a_file_holds_the_recording_of_the_source_bit_for_bit(tmp_path, capsys):
    run(tmp_path, "scene=arm_motion", "materials=[M2]", "cycles=1", "seed=5")
    (line,) = manifest(tmp_path)
    assert list(contents(tmp_path)) == [line["file"]] == ["M2_arm_motion_00.npz"]
    recording, hand, key = FORMATS["npz"].load(tmp_path / line["file"])
    again = simulate(Scene.from_dict(key["recording"]))
    assert torch.equal(recording.samples, again.samples)
    assert recording.samples.isfinite().all()
    assert {**vars(recording), "samples": None} == {**vars(again), "samples": None}
    assert hand == HandLayout.paper24()
    assert key["recording"].keys() == Scene("M2", seed=5).to_dict().keys()
    said = {"material": "M2", "trial": "0", "scene": "arm_motion", "fidelity": "kinematic"}
    said |= {"seed": "5", "simulated": "true"}
    assert {name: line[name] for name in said} == said
    assert float(line["sample_rate_hz"]) == recording.sample_rate_hz == 2000.0
    assert len(recording.non_slip_s) == 3
    for name in TRUTH:
        assert json.loads(line[name]) == json.loads(json.dumps(getattr(recording, name)))
    out = capsys.readouterr().out
    assert out.startswith("\nSIMULATED data")
    assert out.endswith(f"recordings in {tmp_path}\n")


# What is kept --------------------------------------------------------------------------------


def test_finished_files_are_kept_and_lost_or_damaged_ones_made_again(tmp_path):
    first = run(tmp_path)
    assert CountedRecordings.loads == 6
    assert all(one.made for one in first)
    before, list_before = contents(tmp_path), (tmp_path / "manifest.csv").read_bytes()
    (tmp_path / "A_paper_01.npz").unlink()
    damaged = bytearray(before["B_paper_02.npz"])
    damaged[5000] ^= 1
    (tmp_path / "B_paper_02.npz").write_bytes(damaged)
    second = run(tmp_path)
    assert CountedRecordings.loads == 8
    assert [one.line["file"] for one in second if one.made] == ["A_paper_01.npz", "B_paper_02.npz"]
    assert contents(tmp_path) == before
    assert (tmp_path / "manifest.csv").read_bytes() == list_before
    assert not any(one.made for one in run(tmp_path))


def test_files_of_another_scene_or_code_are_made_anew_and_cycles_added(tmp_path, monkeypatch):
    run(tmp_path, "cycles=1")
    made = [one.made for one in run(tmp_path)]
    assert made == [False, True, True] * 2
    assert len(manifest(tmp_path)) == 6
    change = "+data.scene.slide_s=0.7"
    assert [one.made for one in run(tmp_path, "cycles=1", change)] == [True] * 2
    monkeypatch.setattr(module, "source_digest", lambda: "changed")
    assert all(one.made for one in run(tmp_path))
    assert {FORMATS["npz"].load(p).key["code"] for p in tmp_path.glob("*.npz")} == {"changed"}


@pytest.mark.parametrize("workers", [0, 2])
def test_a_run_that_fails_keeps_what_it_finished_and_has_no_manifest(
    tmp_path, monkeypatch, workers
):
    monkeypatch.setattr(CountedRecordings, "fails", "B/0")
    with pytest.raises(ValueError, match="B/0 cannot be read"):
        run(tmp_path, f"num_workers={workers}")
    finished = contents(tmp_path)
    assert {"A_paper_00.npz", "A_paper_01.npz", "A_paper_02.npz"} <= set(finished)
    assert "B_paper_00.npz" not in finished
    assert not (tmp_path / "manifest.csv").exists()
    assert not list(tmp_path.glob(".*"))
    monkeypatch.setattr(CountedRecordings, "fails", "")
    again = run(tmp_path, f"num_workers={workers}")
    assert [one.made for one in again[:4]] == [False, False, False, True]
    assert finished.items() <= contents(tmp_path).items()
    assert len(manifest(tmp_path)) == 6


# What is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b"", b"my own notes", b"PK\x03\x04 zipped"])
def test_a_file_that_is_not_ours_is_never_replaced(tmp_path, content):
    run(tmp_path, "cycles=1")
    before = contents(tmp_path)
    (tmp_path / "B_paper_02.npz").write_bytes(content)
    loads, listed = CountedRecordings.loads, (tmp_path / "manifest.csv").read_bytes()
    with pytest.raises(ValueError, match=r"B_paper_02\.npz is no recording .*move it away"):
        run(tmp_path)
    assert contents(tmp_path) == before | {"B_paper_02.npz": content}
    assert CountedRecordings.loads == loads
    assert (tmp_path / "manifest.csv").read_bytes() == listed


def test_a_manifest_of_ones_own_is_never_replaced(tmp_path):
    (tmp_path / "manifest.csv").write_text("file,material,onsets_s\na.csv,cup,1.5\n")
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=r"manifest\.csv is of recordings of your own"):
        run(tmp_path)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["figure=no"], "figure must be true or false, got 'no'"),
        (["seed=abc", "scene=paper"], "seed must be a whole number, got 'abc'"),
        (["materials=M1", "scene=paper"], r"materials must be a list such as \[M1,M6\], got 'M1'"),
        (["materials=[]", "scene=paper"], "no recording to write; give at least one"),
        (["cycles=0", "scene=paper"], "data: cycles must be a whole number of at least 1, got 0"),
        (["scene=paper", "scene.name=a/b", "materials=[M1]"], "cannot name a file; give the scene"),
        (["format=xls"], "format must be one of npz, csv, h5, mat, parquet, mcap, got 'xls'"),
        (["num_workers=-1"], "num_workers must be null or a number from 0, got -1"),
        (["~features.frames.PVDF"], "features.frames has no frame for PVDF channels"),
    ],
)
def test_bad_input_is_one_line_and_touches_nothing(tmp_path, overrides, said):
    with pytest.raises(BAD_INPUT) as caught:
        run(tmp_path, *overrides)
    line = one_line(caught.value)
    assert re.search(said, line), line
    assert "\n" not in line
    assert not list(tmp_path.iterdir())


# What is drawn -------------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch):
    """What the figures are made of, by file name, instead of the figures."""
    found = {}

    def keep(rows, channels, path, *, title, views=None):
        found[Path(path).name] = (rows, channels, title, views)

    monkeypatch.setattr(module, "signals_figure", keep)
    return found


def test_the_figures_show_each_material_filtered(tmp_path, drawn):
    run(tmp_path, "features.frames.SG=31", "figure=true")
    assert set(drawn) == {"recordings_paper.png", "onset_paper.png"}
    whole, near = drawn["recordings_paper.png"], drawn["onset_paper.png"]
    assert [title for title, _ in whole[0]] == ["A", "B"]
    for title, row in whole[0]:
        content, hand, _ = FORMATS["npz"].load(tmp_path / f"{title}_paper_00.npz")
        assert whole[1] == hand.to_rows()
        for channel, raw, seen in zip(hand.channels, content.samples, row.samples, strict=True):
            frame = 31 if channel.kind == "SG" else 11
            np.testing.assert_allclose(seen, savgol(raw.double().numpy(), frame), atol=1e-12)
        assert row.onsets_s == content.onsets_s
        assert row.sliding_s == content.sliding_s
    assert whole[2] == near[2] == "Recordings: scene paper"
    assert whole[3] is None
    assert near[3] == [(pytest.approx(1.1), 4.5)] * 2  # two seconds before 3.1 s, to the end
