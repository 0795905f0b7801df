"""The example scripts run, and do what they say."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_detector import HAND, alarming_detector

from tactslip_torch import AlarmSettings
from tactslip_torch.model.calibration import Platt
from tactslip_torch.onset.rules import KOfN
from tactslip_torch.simulation.source import SimulatedRecordings
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
def onset_run(tmp_path_factory):
    """A folder as ``+exp=onset`` leaves it, of a small detector with a quickly fitted alarm."""
    detector, folder = alarming_detector(), tmp_path_factory.mktemp("run")
    source = SimulatedRecordings(cycles=1, materials=["M1", "M6"], channels=HAND.to_rows())
    onset, _ = OnsetTraining(penalties=[10.0], comb_periods=[1])(source, source.ids, 0)
    bins = AlarmSettings.of(detector)
    score = onset.score_recording(source.load(source.ids[0]).samples)
    joint = replace(bins, onset=replace(onset, threshold=float(score.quantile(0.995))))
    plain = replace(bins, hop_samples=10, calibration=Platt(1.0, 0.0), rule=KOfN(1, 1))
    methods = {bins.rule.name: bins, "largest detail": replace(plain, threshold=-2.0)}
    told = {name: {**own.to_dict(), "scorer": "-"} for name, own in methods.items()}
    detector.info |= {"alarm": joint.to_dict(), "train_materials": ["M1", "M6"]}
    detector.save(folder / "detector.pt")
    (folder / "metrics.json").write_text(json.dumps({"alarm": {"methods": told}}))
    return folder


def test_a_grip_reacts_to_the_three_alarms_of_a_run(tmp_path, capsys, grip, onset_run):
    figure = tmp_path / "grip.png"
    pulls = grip.main(onset_run, figure, quick=True, num_workers=0)
    assert figure.read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    assert printed.startswith("SIMULATED")
    methods = (grip.PUBLISHED, grip.PLAIN, grip.ONSET)
    assert all(name in printed for name in (*methods, grip.AT_ONCE))
    assert {pull.grasp.mu_s for pull in pulls} == {0.4, 1.2}
    assert len(pulls) == 6  # two recordings of three pulls
    for pull in pulls:
        assert tuple(pull.alarms_s) == methods
        assert all(not alarm_s < pull.first_s for alarm_s in pull.alarms_s.values())


def test_a_run_without_onset_alarm_is_refused(tmp_path, grip):
    alarming_detector().save(tmp_path / "detector.pt")
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match="train with \\+exp=onset"):
        grip.main(tmp_path)


GRASP = {"grip_n": 12.0, "mu_s": 0.8, "speed_m_s": 0.04}


def test_a_grip_at_its_full_force_brakes_evenly(grip):
    reflex = grip.Reflex()
    held = grip.slide(reflex, **GRASP, alarm_s=-10.0)
    pull_n = 0.8 * 12.0
    mass_kg = 0.2 + pull_n / 9.81
    brakes_m_s2 = (reflex.kinetic_ratio * 0.8 * 24.0 - pull_n) / mass_kg
    assert held.stop_s == pytest.approx(0.04 / brakes_m_s2)
    assert held.slid_mm == pytest.approx(1e3 * 0.04**2 / (2 * brakes_m_s2))


def test_nothing_but_the_alarm_holds_the_object(grip):
    dropped = grip.slide(grip.Reflex(), **GRASP, alarm_s=math.inf)
    assert dropped.stop_s == dropped.slid_mm == math.inf
    a_m_s2 = (1 - 0.85) * 0.8 * 12.0 / (0.2 + 0.8 * 12.0 / 9.81)
    assert dropped.position_mm(0.3) == pytest.approx(1e3 * (0.04 * 0.3 + a_m_s2 * 0.3**2 / 2))


@pytest.mark.parametrize(
    ("alarm_s", "rate_n_s"), [(-0.02, 100), (0, 100), (0.06, 100), (0.06, 2000), (0.3, 100)]
)
def test_the_motion_is_that_of_small_steps(grip, alarm_s, rate_n_s):
    reflex = grip.Reflex(rate_n_s=rate_n_s)
    held = grip.slide(reflex, **GRASP, alarm_s=alarm_s)
    step_s = 1e-5
    time_s = (np.arange(round(2 / step_s)) + 0.5) * step_s
    risen_n = np.clip(rate_n_s * (time_s - alarm_s - reflex.delay_s), 0, 12.0)
    pull_n = 0.8 * 12.0
    force_n = pull_n - reflex.kinetic_ratio * 0.8 * (12.0 + risen_n)
    speed_m_s = 0.04 + np.cumsum(force_n) * step_s / (0.2 + pull_n / 9.81)
    end = int(np.argmax(speed_m_s <= 0))
    position_mm = 1e3 * np.cumsum(speed_m_s) * step_s
    assert held.stop_s == pytest.approx(time_s[end], abs=2 * step_s)
    assert held.slid_mm == pytest.approx(position_mm[end], abs=5e-3)
    some = slice(0, end, 500)
    assert held.position_mm(time_s[some] + step_s / 2) == pytest.approx(position_mm[some], abs=5e-3)
