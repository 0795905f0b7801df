"""Lifts in MuJoCo, in a closed loop."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from benchmarks.gripper import STEP_S, Gripper
from benchmarks.lifts import (
    REACH_MM,
    WATCHED_S,
    Lift,
    Listening,
    Never,
    Oracle,
    Reflex,
    run_lift,
    slides,
)
from tactslip_torch import SlipDetector


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_pads_carry_what_they_lift_and_stick(shape):
    gripper = Gripper(shape, 0.5, np.full(6, 0.7), 0.8, 10.0)
    for step in range(3000):
        time_s = step * STEP_S
        grip_n = 6.0 * np.clip((time_s - 0.1) / 0.3, 0.0, 1.0)
        pads = gripper.step(grip_n, 0.03 * np.clip((time_s - 0.5) / 0.6, 0.0, 1.0), 0.0)
    assert pads.normal_n.sum() == pytest.approx(12.0, rel=1e-2)
    assert pads.friction_n.sum() == pytest.approx(0.5 * 9.81, rel=1e-2)
    assert pads.slip_mm_s.max() == 0
    assert gripper.data.qpos[-5] == pytest.approx(0.1 + 0.03, abs=1.5e-3)  # less what springs give


def test_friction_falls_from_static_to_kinetic_as_pads_slide():
    gripper = Gripper("box", 0.5, np.full(6, 0.7), 0.8, 10.0)
    highest, last = 0.0, 0.0
    for step in range(2600):
        time_s = step * STEP_S
        pull_n = 6.0 * max(time_s - 0.6, 0.0)
        pads = gripper.step(6.0 * min(10 * time_s, 1.0), 0.02 * min(2 * time_s, 1.0), pull_n)
        last = pads.friction_n.sum() / max(pads.normal_n.sum(), 1e-9)
        highest = max(highest, last if time_s > 0.6 else 0.0)
        if np.median(pads.slip_mm_s) > 60:
            break
    assert highest == pytest.approx(0.7, rel=0.02)
    assert last == pytest.approx(0.8 * 0.7, rel=0.02)


class Heard:
    """A trigger that says nothing and keeps how loud fast channels are, sliding and not."""

    def __init__(self, fast):
        self.fast, self.loud = fast, {True: [], False: []}
        self.time_s = 0.0

    def hear(self, volts, pads):
        self.time_s += len(volts) * STEP_S
        if self.time_s > WATCHED_S:
            self.loud[slides(pads) > 0.5].append(np.diff(volts[:, self.fast], axis=0).std())
        return 0


def test_without_a_reflex_the_object_is_dropped_and_one_that_knows_holds_it():
    lift = Lift(0, "gradual")
    dropped, held = (run_lift(lift, trigger, 0.01) for trigger in (Never(), Oracle()))
    assert dropped["dropped"]
    assert dropped["slid_mm"] >= REACH_MM
    assert dropped["peak"] < 1
    assert not held["dropped"]
    assert held["slid_mm"] < 3
    assert 1.2 < held["peak"] < 1.8
    assert held["late_ms"] is not None
    assert held["false_alarms"] == 0


def test_fast_channels_hear_the_slide():
    detector = SlipDetector.pretrained("paper24-sim")
    heard = Heard(list(detector.pool.hand.fast))
    run_lift(Lift(1, "sudden"), heard, 0.0)
    assert np.median(heard.loud[True]) > 3 * np.median(heard.loud[False])


def test_an_alarm_tightens_the_grip():
    found = run_lift(Lift(2, "heavy"), Listening(SlipDetector.pretrained("paper24-sim")), 0.01)
    assert found["late_ms"] is not None
    assert found["peak"] > 1.2


def test_a_reflex_tightens_once_for_a_slip_and_again_while_it_goes_on():
    reflex = Reflex()
    made = [(t, reflex.factor) for t in np.arange(1.0, 1.4, 0.005) if reflex.tightens(t, 2)]
    assert [time_s for time_s, _ in made] == pytest.approx([1.0, 1.25], abs=0.011)
    assert [factor for _, factor in made] == pytest.approx([1.5, 1.8])
    assert reflex.tightens(2.0, 2)  # another slip, up to the most
    assert reflex.factor == pytest.approx(2.7)
    assert reflex.tightens(2.25, 2)
    assert reflex.factor == 3.0
    assert not reflex.tightens(3.0, 2)


def test_hints_tighten_a_little():
    reflex = Reflex()
    made = [t for t in np.arange(1.0, 3.0, 0.005) if reflex.tightens(t, 1)]
    assert len(made) == 2
    assert reflex.factor == pytest.approx(1.3)
