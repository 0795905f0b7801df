"""The example scripts run."""

import copy
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tactslip_torch import AlarmSettings
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.onset import OnsetTraining

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(scope="module")
def grip():
    """The names of ``grip_reflex``, which holds dataclasses: it must be a module that is known."""
    sys.path.insert(0, str(EXAMPLES))
    try:
        import grip_reflex
    finally:
        sys.path.remove(str(EXAMPLES))
    return grip_reflex


@pytest.fixture(scope="module")
def onset_run(paper, tmp_path_factory):
    """A folder as ``+exp=onset`` leaves it, of a detector with a quickly fitted alarm."""
    detector, folder = copy.deepcopy(paper.detector), tmp_path_factory.mktemp("run")
    channels = detector.pool.hand.to_rows()
    source = SimulatedRecordings(cycles=1, materials=["M1", "M6"], channels=channels)
    onset, _, _ = OnsetTraining(head="quadratic", epochs=1)(source, source.ids, 0)
    bins = AlarmSettings.of(detector)
    score = onset.score_recording(source.load(source.ids[0]).samples)
    joint = replace(bins, onset=replace(onset, threshold=float(score.quantile(0.995))))
    plain = replace(bins, hop_samples=10, calibration=Platt(1.0, 0.0), rule=KOfN(1, 1))
    methods = {bins.rule.name: bins, "largest detail": replace(plain, threshold=-2.0)}
    metrics = {name: {**own.to_dict(), "scorer": "-"} for name, own in methods.items()}
    detector.info |= {"alarm": joint.to_dict(), "train_materials": ["M1", "M6"]}
    detector.save(folder / "detector.pt")
    (folder / "metrics.json").write_text(json.dumps({"alarm": {"methods": metrics}}))
    return folder


def test_a_grip_reacts_to_the_three_alarms_of_a_run(tmp_path, capsys, grip, onset_run):
    figure = tmp_path / "grip.png"
    rows = grip.main(onset_run, figure, quick=True, num_workers=0)
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.startswith("SIMULATED")
    assert [row["alarm"] for row in rows] == 2 * [*grip.METHODS, grip.AT_ONCE]
    assert [row["friction"] for row in rows] == 4 * ["0.4"] + 4 * ["1.2"]
    assert {row["of"] for row in rows} == {"3"}  # a recording of three pulls
    at_once = [row for row in rows if row["alarm"] == grip.AT_ONCE]
    assert all(float(row["mm, median"]) < grip.REACH_MM for row in at_once)


def test_a_run_without_onset_alarm_is_refused(paper, tmp_path, grip):
    paper.detector.save(tmp_path / "detector.pt")
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match="train with \\+exp=onset"):
        grip.main(tmp_path)


GRASP = {"grip_n": 12.0, "mu_s": 0.8, "speed_m_s": 0.04}


def test_a_grip_at_its_full_force_brakes_evenly(grip):
    pull_n = 0.8 * 12.0
    brakes_m_s2 = (grip.KINETIC_RATIO * 0.8 * 24.0 - pull_n) / (0.2 + pull_n / 9.81)
    slid = grip.slid_mm(**GRASP, alarm_s=-10.0)
    assert slid == pytest.approx(1e3 * 0.04**2 / (2 * brakes_m_s2), rel=5e-3)


def test_the_later_the_alarm_the_farther_the_object_slides_until_it_is_dropped(grip):
    slid = [grip.slid_mm(**GRASP, alarm_s=alarm_s) for alarm_s in (0.0, 0.02, 0.1, math.inf)]
    assert slid == sorted(set(slid))
    assert slid[2] < slid[3] == math.inf
