"""What comes with the package: a detector, a recording, the demo, the hosts."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from tactslip_torch import SlipDetector, StreamingDetector, sample_recording, simulate
from tactslip_torch.commands import demo, hosts
from tactslip_torch.pretrained import HELD_OUT, REAL_NAME, real_onset_s, write_real_recordings
from tactslip_torch.pretrained.make import SCENE

ROOT = Path(__file__).parents[1]


def test_the_recording_is_what_its_script_makes_and_the_detector_finds_its_slip():
    recording, made = sample_recording(), simulate(SCENE)
    torch.testing.assert_close(recording.samples, made.samples)
    assert recording.onsets_s == made.onsets_s
    detector = SlipDetector.pretrained("paper24-sim")
    assert "paper24-sim: 24 channels" in repr(detector)
    assert "simulated" in repr(detector)
    assert recording.material not in detector.info["train_materials"]
    stream = StreamingDetector(detector)
    (alarm,) = (*stream.push(recording.samples.T).alarms, *stream.flush().alarms)
    assert 0 < alarm.alarm_s - recording.onsets_s[0] < 0.2
    with pytest.raises(ValueError, match="no pretrained detector 'hand'; there are paper24-sim"):
        SlipDetector.pretrained("hand")


def test_the_real_detector_was_not_trained_on_the_recording_that_it_is_shown_on(tmp_path):
    paths = write_real_recordings(tmp_path)
    detector = SlipDetector.pretrained(REAL_NAME)
    trained = {f"{name.replace('/', '_')}.csv" for name in detector.info["trained_on"]}
    assert trained | {HELD_OUT} == {path.name for path in paths}
    assert HELD_OUT not in trained
    assert detector.info["simulated"] is False
    assert "MIT License" in (tmp_path / "LICENSE.md").read_text()
    table = np.genfromtxt(tmp_path / HELD_OUT, delimiter=",", skip_header=1)
    slip = table[:, -1]
    assert table[np.flatnonzero(slip == 1)[0], 0] == pytest.approx(real_onset_s(), abs=1e-4)
    lost = np.isnan(slip)
    assert lost.any()  # behind the loss of the box nothing is labelled
    assert lost[np.flatnonzero(lost)[0] :].all()


@pytest.mark.onnx
def test_the_demo_says_when_the_slip_began_and_leaves_all_it_names(typed, tmp_path):
    out = tmp_path / "demo"
    _, printed, _ = typed(demo, "--out", out)
    (found,) = json.loads((out / "onsets.json").read_text())["recordings"]
    (onset_s,) = sample_recording().onsets_s
    assert f"The slip began at {onset_s:.3f} s" in printed
    assert f"alarm at {found['alarms'][0]['alarm_s']:.3f} s" in printed
    assert "simulated" in printed
    (real,) = json.loads((out / "real" / "onsets.json").read_text())["recordings"]
    assert f"slips from {real_onset_s():.2f} s on" in printed
    assert f"alarms at {real['alarms'][0]['alarm_s']:.2f} s" in printed
    assert real["simulated"] is None
    files = (
        "real/box_5_onsets.png real/recordings/LICENSE.md recording_onsets.png model.onnx "
        "stream.onnx.json web/page.mjs web/stream.onnx node/npy.mjs"
    )
    assert all((out / name).is_file() for name in files.split())
    status, _, err = typed(demo, "--out", out)
    assert status == 2
    assert "is there and not empty; give another one, --out DIR" in err


@pytest.mark.parametrize("name", ["c", "native", "node", "python", "web"])
def test_hosts_are_copied_whole(typed, tmp_path, name):
    assert str(tmp_path / name / "README.md") in typed(hosts, name, tmp_path)[1]
    for path in (ROOT / "export" / name).glob("*.*"):
        if path.is_file():
            texts = [each.read_bytes() for each in (tmp_path / name / path.name, path)]
            if path.name == "README.md":  # whose links lead into the copy
                texts = [re.sub(rb"\]\([^)]*\)", b"]", text) for text in texts]
            assert texts[0] == texts[1]
    if name == "native":  # with the library's sources
        assert {"stream.cpp", "tactslip.h"} <= {p.name for p in (tmp_path / "native/src").iterdir()}
    if name == "web":  # what it plays when it is started without arguments
        assert all((tmp_path / "web" / own).is_file() for own in ("stream.onnx", "recording.npz"))
    for wrong, words in (
        (name, "is there already"),
        ("rust", "no host 'rust'; there are c, native, node"),
    ):
        status, _, err = typed(hosts, wrong, tmp_path)
        assert status == 2
        assert words in err
