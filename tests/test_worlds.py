"""Recordings over many worlds: what is drawn, and what the simulator makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactslip_torch.simulation import Handling, Scene, Sensors, Stroke, simulate, timeline
from tactslip_torch.simulation._contact import draw_grasp
from tactslip_torch.simulation._sensors import Handled
from tactslip_torch.simulation.worlds import CONFOUNDERS, SLIP, WorldRecordings

MATERIALS = ["M1", "M2", "M3"]
EACH = dict.fromkeys(CONFOUNDERS, 3)


def scenes_of(worlds):
    return [Scene.from_dict(worlds.key(recording)) for recording in worlds.ids]


def test_every_recording_has_its_kind_material_and_mounting():
    worlds = WorldRecordings(slips=4, confounders=EACH, materials=MATERIALS)
    kinds = [recording.scene for recording in worlds.ids]
    assert [kinds.count(kind) for kind in (SLIP, *CONFOUNDERS)] == [4, *[3] * len(CONFOUNDERS)]
    slips = [str(recording) for recording in worlds.ids[:4]]
    assert slips == ["M1/0/slip", "M2/0/slip", "M3/0/slip", "M1/1/slip"]
    assert len({scene.session for scene in scenes_of(worlds)}) == len(worlds.ids)
    for recording in worlds.ids:
        times = worlds.timeline(recording)
        assert len(times.onsets_s) == (3 if recording.scene == SLIP else 0)
        assert bool(times.arm_s) or recording.scene not in ("arm", "lifted")


def test_a_seed_draws_the_same_whatever_else_is_drawn():
    one = WorldRecordings(slips=6, confounders=EACH, materials=MATERIALS)
    few = WorldRecordings(slips=2, confounders={"taps": 3}, materials=MATERIALS)
    for recording in few.ids:
        assert one.key(recording) == few.key(recording)
    other = WorldRecordings(seed=1, slips=2, materials=MATERIALS)
    assert other.key(other.ids[0]) != few.key(few.ids[0])
    first = few.ids[0]
    assert torch.equal(few.load(first).samples, one.load(first).samples)


def test_worlds_cover_what_was_asked_for():
    scenes = scenes_of(WorldRecordings(slips=400, materials=MATERIALS))
    bristles = [scene.fidelity == "bristles" for scene in scenes]
    imperfect = [scene.imperfections.local_noise_mv > 0 for scene in scenes]
    for found in (bristles, imperfect):  # 400 draws of .4: 160 with a deviation of 10
        assert 120 < sum(found) < 200
    loads, gains = (
        [f(s) for s in scenes] for f in (lambda s: s.contact.load_n, lambda s: s.sensors.gain)
    )
    assert 0.1 <= min(loads) < 0.12
    assert 2.5 < max(loads) <= 3.0
    assert 0.1 <= min(gains) < 0.13
    assert 8.0 < max(gains) <= 10.0
    fingers = {len(s.contact.touching or s.hand.channels) for s in scenes}
    assert len(fingers) > 3
    assert any(s.contact.onset_pulse_v == 0 for s in scenes)
    assert max(s.contact.slide_rise_s for s in scenes) > 0.2
    fixed = WorldRecordings(
        slips=20, materials=MATERIALS, bristles=0, imperfect=0, scene={"load_n": 2.0}
    )
    for scene in scenes_of(fixed):
        assert (scene.fidelity, scene.contact.load_n) == ("kinematic", 2.0)
        assert scene.imperfections.local_noise_mv == 0


def test_no_finger_creeps_where_a_hand_is_held_with_imperfect_channels_or_not():
    held, grips = (
        [scene.imperfections for scene in scenes_of(worlds)]
        for worlds in (
            WorldRecordings(confounders={kind: 40}, materials=MATERIALS)
            for kind in ("held", "grips")
        )
    )
    assert {own.partial_slips_per_s for own in held} == {0.0}
    assert 5 < sum(own.local_noise_mv > 0 for own in held) < 35
    assert max(own.partial_slips_per_s for own in grips) > 0.1


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"confounders": {"rain": 1}}, "no kind of recordings without slip is called rain; there"),
        ({"slips": -1}, "slips must be a whole number of at least 0, got -1"),
        ({"imperfect": 1.5}, "imperfect must lie between 0 and 1, got 1.5"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        WorldRecordings(**changes)


def test_a_weight_comes_when_an_object_is_lifted_and_goes_when_it_is_put_down():
    strokes = (Stroke(40.0, 20.0, 0.5, "both"), Stroke(40.0, 20.0, 0.8, "both"))
    handling = Handling(carried_kg=0.0, weight_share=0.6, lift_s=0.1)
    scene = Scene("M2", strokes=strokes, handling=handling, tail_s=0.5)
    grasp = draw_grasp(scene)
    handled = Handled(scene, grasp)
    lifted_s, down_s = (stroke.start_s for stroke in scene.arm)
    at = np.array([lifted_s, lifted_s + 0.05, lifted_s + 0.1, down_s, down_s + 0.1])
    found = sum(handled.shear_n(element, at) for element in grasp.touching)
    wanted = 0.6 * grasp.friction_n.sum() * np.array([0, 0.5, 1, 1, 0])
    assert found == pytest.approx(wanted, abs=1e-9)
    assert not timeline(scene).onsets_s


def loosened(**changes):
    handling = Handling(loosenings_per_s=2.0, loosening_share=(0.3, 0.9), grip_s=(0.2, 0.4))
    return Scene("M2", handling=handling, **changes)


def test_a_grip_that_loosens_leaves_the_load_that_its_shear_needs():
    scene = loosened()
    grasp = draw_grasp(scene)
    events = Handled(scene, grasp).grips
    first_s = scene.slides[0].start_s
    before, behind = (
        [e for e in events if (e.start_s < first_s) == is_before] for is_before in (True, False)
    )
    assert before
    assert behind
    assert all((event.size > -1).all() and (event.size < 0).all() for event in events)
    for event in behind:  # shear over mu_s N is at most that behind a slide, N falls by the size
        assert (grasp.shear_after / (1 + event.size) < 1).all()
    assert min(event.size.min() for event in before) < -0.3


def test_a_grip_that_loosens_lowers_slow_channels_and_moves_no_onset():
    scene = loosened(strokes=(), tail_s=3.0)
    plain = replace(scene, handling=Handling())
    found, usual = (simulate(s, dtype=torch.float64).samples for s in (scene, plain))
    grasp = draw_grasp(scene)
    slow = [c for c in scene.hand.slow if grasp.load_n[grasp.element_of_channel[c]] > 0]
    change = (found - usual)[slow]
    assert change.min() < -0.01
    assert change.max() < 0.001  # rounding of the converter
    assert timeline(loosened()).onsets_s == timeline(Scene("M2")).onsets_s


def test_gain_is_that_of_all_before_the_converter():
    quiet = Scene("M2", strokes=(), tail_s=1.0, sensors=Sensors(num_bits=32, rail_v=50.0))
    loud = replace(quiet, sensors=replace(quiet.sensors, gain=3.0))
    found, usual = (simulate(s, dtype=torch.float64).samples for s in (loud, quiet))
    torch.testing.assert_close(found, 3.0 * usual, rtol=0, atol=1e-7)


def test_a_slide_that_fades_in_has_the_same_onset_and_starts_quieter():
    scene = Scene("M1")
    faded = replace(scene, contact=replace(scene.contact, slide_rise_s=0.2, onset_pulse_v=0.0))
    plain = replace(scene, contact=replace(scene.contact, onset_pulse_v=0.0))
    assert timeline(faded).onsets_s == timeline(scene).onsets_s
    end_s = timeline(scene).released_s[0][1]
    window = [(end_s, end_s + 0.1)]
    rms = [
        np.nanstd(simulate(s, windows=window).samples[list(s.hand.fast)].numpy(), -1).mean()
        for s in (faded, plain)
    ]
    assert rms[0] < 0.5 * rms[1]


def test_older_keys_of_recordings_stay():
    plain = Scene("M1").to_dict()
    for group, name in (
        ("contact", "slide_rise_s"),
        ("sensors", "gain"),
        ("handling", "loosenings_per_s"),
    ):
        assert name not in plain[group]
    assert Scene.from_dict(loosened().to_dict()) == loosened()
