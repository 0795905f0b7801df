"""Signals of a hand whose contact something else computes."""

import numpy as np
import pytest

from tactslip_torch.simulation import (
    Contact,
    Faults,
    HandSignals,
    Imperfections,
    Scene,
    Stroke,
    simulate,
)
from tactslip_torch.simulation._blocks import Grid
from tactslip_torch.simulation._contact import draw_grasp, scene_contact
from tactslip_torch.simulation.scene import Motion

STEP_V = 10.0 / 2**16  # of the converter


def sliding_scene(material="M5", **changes):
    """A slide on bristles whose normal force is constant, as fast channels feel what presses."""
    contact = Contact(runout=0.0, relaxation=(1e-12, 1e-12))
    return Scene(material, strokes=(Stroke(40.0),), contact=contact, fidelity="bristles", **changes)


def forces_of(scene):
    """Normal force, friction, slip speed and the skin's inertia of a scene, ``[T, E]`` each."""
    grasp, num = draw_grasp(scene), round(scene.end_s * scene.sample_rate_hz)
    empty = Grid(np.zeros(0, np.int64), scene.sample_rate_hz)
    grid = Grid(np.arange(-(-num // empty.block_samples)), scene.sample_rate_hz)
    history, _, now = grid.history
    motion, contact = Motion(scene.slides, history), scene_contact(scene, grasp)
    forces = np.zeros((4, num, len(grasp.load_n)))
    for element in grasp.touching.tolist():
        state = contact.element(element, grid, motion)
        slip_mm_s = state.slide * motion.speed_mm_s[now]
        inertia_n = state.release_v / scene.dynamics.release_v_per_n
        own = (state.normal_n[now], state.friction_n[now], slip_mm_s, inertia_n)
        forces[:, :, element] = [values.reshape(-1)[:num] for values in own]
    return forces


@pytest.fixture(scope="module")
def broken():
    """A scene with noise of each element and faults, and its forces."""
    faults = Faults(dead=("PVDF3",), swapped=(("PVDF7", "PVDF5"),), drops_per_s=3.0)
    scene = sliding_scene(
        "M1", faults=faults, imperfections=Imperfections(local_noise_mv=1.0, gain_drift=0.2)
    )
    return scene, forces_of(scene)


def test_the_forces_of_a_simulated_slide_give_its_recording():
    scene = sliding_scene()  # without lines, which run with the arm there and with elements here
    forces = forces_of(scene)
    difference = np.abs(HandSignals(scene).push(*forces) - simulate(scene).samples.T.numpy())
    assert difference[:, list(scene.hand.fast)].max() <= STEP_V
    sticks = (forces[2] == 0).all(axis=1)
    assert 0.3 < sticks.mean() < 0.7
    assert difference[sticks].max() <= STEP_V
    assert difference.max() <= 0.05  # slow friction's fluctuation: of the slip speed, not the arm's


@pytest.mark.parametrize("length", [7, 512, 1000])
def test_pieces_give_what_the_whole_gives(broken, length):
    scene, forces = broken
    whole, signals = HandSignals(scene).push(*forces), HandSignals(scene)
    starts = range(0, forces.shape[1], length)
    pieces = [signals.push(*forces[:, start : start + length]) for start in starts]
    assert np.abs(np.concatenate(pieces) - whole).max() <= STEP_V
    assert whole.std(axis=0).min() == 0 < np.median(whole.std(axis=0))  # the dead channel


def test_what_comes_later_changes_nothing_before(broken):
    scene, forces = broken
    later = forces.copy()
    later[:, 2500:] *= 3.0
    first, second = (HandSignals(scene).push(*given) for given in (forces, later))
    np.testing.assert_array_equal(first[:2500], second[:2500])
    assert np.abs(first[2500:] - second[2500:]).max() > 0.1


def test_a_slide_is_felt_by_the_channels_of_its_element_alone():
    scene = Scene("M1", strokes=(), tail_s=1.0)
    still = HandSignals(scene)
    normal, slip = np.full((2000, len(still.elements)), 0.5), np.zeros((2000, len(still.elements)))
    slip[1000:, 3] = 40.0
    quiet = still.push(normal, 0 * normal, 0 * slip)
    moved = np.abs(HandSignals(scene).push(normal, 0 * normal, slip) - quiet)
    own = still.grasp.element_of_channel == 3
    assert moved[:1000].max() == 0
    assert moved[:, ~own].max() == 0
    assert moved[1000:, own].max(axis=0).min() > 10 * STEP_V


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ((np.ones((5, 3)),) * 3, r"expected normal_n \[n, 14\] \(samples, elements\)"),
        ((np.ones((5, 14)), np.ones((4, 14)), np.ones((5, 14))), "expected friction_n"),
        ((np.ones((5, 14)),) * 2 + (np.full((5, 14), np.nan),), "slip_mm_s must be finite"),
        ((np.ones((5, 14)), -np.ones((5, 14)), np.ones((5, 14))), "friction_n must be"),
        ((np.ones((2001, 14)),) * 3, "ends after 2000 samples, got 2001: raise tail_s"),
    ],
)
def test_forces_of_another_hand_or_beyond_the_end_are_refused(given, match):
    with pytest.raises(ValueError, match=match):
        HandSignals(Scene("M5", strokes=(), tail_s=1.0)).push(*given)
