"""Elements that differ without slip: what each imperfection adds, where, and to which channels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import FINE, STILL, end_s, insides, is_within, part, rms, scene_of, volts

from tactslip_torch.simulation import Imperfections, Scene, simulate, timeline
from tactslip_torch.simulation.imperfections import partial_stretches

QUIET = {**FINE, **STILL, "motor_vibration_mv": 0.0, "arm_transient_mv": 0.0}
REST_S = (0.0, 1.9)
"""Before the first stroke."""
NAMES = ("local_noise_mv", "share_wander", "gain_drift", "pickup_mv", "partial_slips_per_s")


def added(material: str, **knobs: float) -> np.ndarray:
    """What imperfections add to the samples of a quiet recording, ``[C, T]``."""
    return volts(scene_of("paper", material, **QUIET, **knobs)) - volts(
        scene_of("paper", material, **QUIET)
    )


def films(scene: Scene) -> list[int]:
    return [i for i, channel in enumerate(scene.hand.channels) if channel.adapting == "fast"]


def fingers(scene: Scene) -> np.ndarray:
    return np.array([channel.finger for channel in scene.hand.channels])


def touching(scene: Scene) -> np.ndarray:
    """Which channels belong to an element that touches, ``[C]``."""
    grasp = insides(scene)[0]
    return np.isin(grasp.element_of_channel, grasp.touching)


def test_the_papers_scene_has_none_and_does_not_say_so():
    assert "imperfections" not in scene_of("paper", "M1").to_dict()
    hard = scene_of("hard", "M1")
    assert Scene.from_dict(hard.to_dict()) == hard
    assert all(getattr(hard.imperfections, name) > 0 for name in NAMES)
    assert replace(hard, imperfections=Imperfections(), name="paper") == scene_of("paper", "M1")


@pytest.mark.parametrize("rung", ["kinematic", "lugre"])
def test_no_imperfection_moves_the_truth(rung):
    hard = scene_of("hard", "M6", fidelity=rung)
    assert timeline(hard) == timeline(replace(hard, imperfections=Imperfections()))


def test_windows_and_channels_of_a_hard_hand_equal_the_whole_recording():
    scene = scene_of("hard", "M1", cycle=1)
    onset_s = timeline(scene).onsets_s[1]
    window, names = (onset_s - 0.3, onset_s + 0.4), ["SG2", "PVDF4", "PVDF7"]
    rows = [scene.hand.names.index(name) for name in names]
    cut = slice(round(window[0] * 2000), round(window[1] * 2000))
    some = simulate(scene, windows=[window], channels=names).samples[rows, cut]
    assert torch.equal(some, simulate(scene).samples[rows, cut])


def test_local_noise_is_there_at_rest_and_each_elements_own():
    scene = scene_of("paper", "M3", **QUIET)
    noise = part(added("M3", local_noise_mv=2.0), *REST_S)
    down = touching(scene)
    assert np.abs(noise[~down]).max() == 0
    grasp, pvdf = insides(scene)[0], [i for i in films(scene) if down[i]]
    load = grasp.load_n[grasp.element_of_channel]
    level_mv = 1e3 * rms(noise[pvdf]) / np.sqrt(load[pvdf])
    assert 2.0 / 2 < np.median(level_mv) < 2.0 * 2  # a dozen draws of spread .5 and gains of .3
    alike = np.abs(np.corrcoef(noise[pvdf]))
    element = grasp.element_of_channel[pvdf]
    other = element[:, None] != element
    assert alike[other].max() < 0.3
    assert other.any()


def test_shares_wander_each_on_its_own_by_their_spread():
    """At rest before any stroke a gauge's preload is its load."""
    scene = scene_of("paper", "M3", strokes=[], tail_s=60.0, **QUIET, sg_offset_v=0.0)
    still = {"sg_session_offset_v": 0.0, "sg_offset_v": 0.0, "pvdf_offset_mv": 0.0}
    made = {
        s: volts(scene_of("paper", "M3", strokes=[], tail_s=60.0, **QUIET | still, **k))
        for s, k in (("with", {"share_wander": 0.25}), ("without", {}))
    }
    gauges = [i for i in np.flatnonzero(touching(scene)) if i not in films(scene)]
    log_factor = np.log(made["with"][gauges] / made["without"][gauges])
    assert np.median(rms(log_factor)) == pytest.approx(0.25, rel=0.15)
    grasp = insides(scene)[0]
    element = grasp.element_of_channel[gauges]
    alike = np.abs(np.corrcoef(log_factor[:, ::100]))
    assert np.median(alike[element[:, None] != element]) < 0.3
    assert np.abs(np.diff(log_factor)).max() < 0.01  # slow: no jump from sample to sample


def test_gains_drift_with_the_channel_and_not_with_the_element():
    scene = scene_of("paper", "M3", **QUIET)
    still = QUIET | {"sg_session_offset_v": 0.0, "sg_offset_v": 0.0, "pvdf_offset_mv": 0.0}
    with_it, without = (volts(scene_of("paper", "M3", **still, gain_drift=g)) for g in (0.1, 0.0))
    gauges = [i for i in np.flatnonzero(touching(scene)) if i not in films(scene)]
    log_gain = np.log(with_it[gauges] / without[gauges])
    assert np.median(rms(log_gain)) == pytest.approx(0.1, rel=0.2)
    for index in films(scene):
        if touching(scene)[index]:
            here = np.abs(without[index]) > 0.02
            ratio = with_it[index][here] / without[index][here]
            assert 0.5 < ratio.min() <= ratio.max() < 2.0


def test_pick_up_is_one_signal_with_a_coupling_of_each_channel():
    scene = scene_of("paper", "M3", **QUIET)
    wave = added("M3", pickup_mv=2.0)
    singular = np.linalg.svd(wave[:, :4000], compute_uv=False)
    assert singular[1] < 1e-4 * singular[0]
    levels, pvdf = rms(wave), films(scene)
    gauges = [i for i in range(len(levels)) if i not in pvdf]
    assert 2e-3 / 2.5 < np.median(levels[pvdf]) < 2e-3 * 2.5
    assert np.median(levels[gauges]) < 0.3 * np.median(levels[pvdf])
    signs = np.sign(wave @ wave[pvdf[0]])
    assert {-1.0, 1.0} == set(signs)
    assert np.log(levels[pvdf]).std() > 0.3


def test_a_finger_that_slips_alone_is_heard_at_rest_and_a_finger_that_sticks_falls_silent():
    knobs = {"partial_slips_per_s": 0.5, **QUIET}
    scene = scene_of("paper", "M1", **knobs)
    plain = volts(scene_of("paper", "M1", **QUIET))
    changed = volts(scene) - plain
    truth, down, own = timeline(scene), touching(scene), fingers(scene)
    duration_s = end_s(scene)
    starts, ends = truth.arm_s[0][0], truth.sliding_s[0][1]
    heard = silent = 0
    for finger in sorted(set(own)):
        mine = [i for i in films(scene) if own[i] == finger and down[i]]
        stretches = partial_stretches(scene, finger, duration_s)
        inside = is_within(list(stretches), changed.shape[1])
        if mine:
            assert np.abs(changed[mine][:, ~inside]).max() < 1e-9
        for start_s, stop_s in stretches:
            alone = sum(
                a < stop_s and start_s < b
                for other in sorted(set(own))
                for a, b in partial_stretches(scene, other, duration_s)
            )
            if not mine or alone > 1:
                continue
            if stop_s < starts:
                assert rms(part(changed[mine], start_s, stop_s)).min() > 1e-3
                heard += 1
            elif truth.sliding_s[0][0] + 0.05 < start_s and stop_s < ends - 0.05:
                middle = (start_s + 0.015, stop_s - 0.015)
                if middle[1] - middle[0] > 0.03:
                    left = rms(part(plain[mine] + changed[mine], *middle))
                    assert np.median(left / rms(part(plain[mine], *middle))) < 0.5
                    silent += 1
    assert heard
    assert silent


@pytest.mark.parametrize("name", NAMES)
def test_a_negative_imperfection_is_refused(name):
    with pytest.raises(ValueError, match=f"Imperfections.{name} must be finite and not negative"):
        Imperfections(**{name: -1.0})
