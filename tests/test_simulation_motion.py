"""The arm, the contact, and the onset that lies between them."""

import numpy as np
import pytest

from tactslip_torch.simulation import SEEN_MATERIALS, Contact, Disturbances, Scene, Stroke, timeline
from tactslip_torch.simulation.friction import shear_share, sliding_gate, slips
from tactslip_torch.simulation.grasp import draw_grasp, recording_key
from tactslip_torch.simulation.grid import Grid, causal_response
from tactslip_torch.simulation.kinematic import KinematicContact
from tactslip_torch.simulation.materials import MATERIALS
from tactslip_torch.simulation.motion import Motion, arm_strokes
from tactslip_torch.simulation.randomness import normal_blocks
from tactslip_torch.simulation.sensors import highpass_response
from tactslip_torch.simulation.vibration import band_responses, element_vibration, shared_field

RATE_HZ = 2000.0


def whole_grid(duration_s: float) -> Grid:
    return Grid(np.arange(int(np.ceil(duration_s * RATE_HZ / 512))), 512, RATE_HZ)


@pytest.mark.parametrize(
    ("speed", "distance", "acceleration"), [(20, 100, 0.5), (60, 100, 0.5), (60, 5, 0.5), (1, 7, 9)]
)
def test_arm_travels_its_distance_with_bounded_acceleration(speed, distance, acceleration):
    (stroke,) = arm_strokes((Stroke(speed, distance, 0.5),), acceleration)
    t, dt = np.linspace(0.0, stroke.stop_s + 0.2, 40001, retstep=True)
    travel, velocity = stroke.travel_mm(t), stroke.speed_mm_s(t)
    assert travel[0] == 0
    assert travel[-1] == pytest.approx(distance, rel=1e-12)
    np.testing.assert_allclose(np.gradient(travel, t), velocity, atol=dt * 1000 * acceleration)
    assert velocity.max() <= speed * (1 + 1e-12)
    assert np.abs(np.gradient(velocity, t)).max() <= 1000 * acceleration * (1 + 1e-6)
    within = np.linspace(1e-3, distance * 0.999, 57)
    np.testing.assert_allclose(stroke.travel_mm(stroke.time_of_travel_s(within)), within, rtol=1e-9)


def test_strokes_run_on_without_return_near_the_papers_nominal_times():
    plan = arm_strokes(Scene("M1").strokes, 0.5)
    np.testing.assert_allclose([s.start_s for s in plan], [2, 9, 13.5], atol=0.15)
    assert [s.origin_mm for s in plan] == [0, 100, 200]
    motion = Motion(plan, whole_grid(15.5))
    assert np.all(np.diff(motion.position_mm.ravel()) >= 0)
    assert motion.position_mm[-1, -1] == pytest.approx(300)


@pytest.mark.parametrize("material", SEEN_MATERIALS)
def test_onset_comes_after_the_arm_and_by_the_presliding_travel(material):
    for cycle in range(10):
        scene = Scene(material, cycle=cycle)
        truth, grasp = timeline(scene), draw_grasp(scene)
        plan = arm_strokes(scene.strokes, scene.acceleration_m_s2)
        for stroke, onset_s, (start_s, end_s) in zip(
            plan, truth.onsets_s, truth.sliding_s, strict=True
        ):
            assert stroke.start_s + 0.005 < onset_s == start_s < end_s < stroke.stop_s
        fresh_mm = plan[0].travel_mm(np.array(truth.onsets_s[0]))
        touching_mm = grasp.presliding_mm[grasp.touching]
        assert touching_mm.min() * (1 - 1e-9) <= fresh_mm <= touching_mm.max() * (1 + 1e-9)
        later_mm = plan[1].travel_mm(np.array(truth.onsets_s[1]))
        assert later_mm < 0.65 * fresh_mm  # the pause left most of the shear


def test_a_longer_rest_relaxes_more_so_the_next_slip_comes_later():
    def delay_s(pause_s):
        scene = Scene("M5", strokes=(Stroke(40), Stroke(40, pause_s=pause_s)), cycle=1)
        truth = timeline(scene)
        return truth.onsets_s[1] - truth.arm_s[1][0]

    assert delay_s(0.05) < delay_s(0.5) < delay_s(5.0)


def test_onset_is_the_load_weighted_median_of_the_elements():
    scene = Scene("M4", cycle=3)
    grasp = draw_grasp(scene)
    slipping = slips(grasp, arm_strokes(scene.strokes, scene.acceleration_m_s2))
    for breakaways, onset_s in zip(slipping.start_s, timeline(scene).onsets_s, strict=True):
        gone = grasp.load_n[breakaways <= onset_s].sum()
        gone_before = grasp.load_n[breakaways < onset_s].sum()
        assert gone_before < 0.5 * grasp.load_n.sum() <= gone


def test_annotations_jitter_by_what_is_asked():
    offsets_ms = [
        1e3 * (marked - onset)
        for cycle in range(60)
        for truth in [timeline(Scene("M2", cycle=cycle))]
        for marked, onset in zip(truth.annotated_onsets_s, truth.onsets_s, strict=True)
    ]
    assert 12 < np.std(offsets_ms) < 18
    assert abs(np.mean(offsets_ms)) < 4
    exact = timeline(Scene("M2", disturbances=Disturbances(label_jitter_ms=0.0)))
    assert exact.annotated_onsets_s == exact.onsets_s


def test_friction_stays_in_its_cone_sticks_before_and_falls_after_letting_go():
    scene = Scene("M6", cycle=2)
    plan, grasp = arm_strokes(scene.strokes, scene.acceleration_m_s2), draw_grasp(scene)
    motion, slipping = Motion(plan, whole_grid(15.4)), slips(grasp, plan)
    contact_of = KinematicContact(scene, grasp, plan).on(motion.grid)
    t = motion.grid.time_s.ravel()
    for element in grasp.touching:
        contact = contact_of(int(element))
        normal_n, friction_n = contact.normal_n, contact.friction_n
        assert np.all((friction_n >= 0) & (friction_n <= grasp.surface.mu_s * normal_n + 1e-12))
        share = shear_share(grasp, slipping, motion, element, 0.008).ravel()
        # no jump but the fall at letting go: stretching, relaxing and sticking are continuous
        assert np.abs(np.diff(share)).max() < 0.12
        assert np.all(share[t < plan[0].start_s] == 0)
        middle = share[(t > slipping.start_s[0, element] + 0.1) & (t < slipping.end_s[0, element])]
        np.testing.assert_allclose(middle, grasp.surface.mu_ratio, rtol=1e-3)
        for stroke in range(3):
            gate = sliding_gate(slipping, element, stroke, t)
            outside = (t < slipping.start_s[stroke, element]) | (
                t > slipping.end_s[stroke, element]
            )
            assert np.all(gate[outside] == 0)
            assert gate.max() > 0.99


def test_lifted_elements_never_slip_and_about_a_tenth_is_lifted():
    lifted = np.concatenate([draw_grasp(Scene("M1", cycle=c)).load_n == 0 for c in range(60)])
    assert 0.06 < lifted.mean() < 0.14
    grasp = draw_grasp(Scene("M1", contact=Contact(lifted_fraction=0.999)))
    assert len(grasp.touching) == 1
    slipping = slips(grasp, arm_strokes(Scene("M1").strokes, 0.5))
    assert np.isnan(slipping.start_s[:, grasp.load_n == 0]).all()


def test_material_friction_can_be_set_exactly():
    grasp = draw_grasp(Scene("M5", contact=Contact(mu_s=0.5, mu_k=0.4)))
    assert grasp.surface.mu_s == 0.5
    assert grasp.surface.mu_ratio == pytest.approx(0.8)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_kinetic_friction_asked_for_is_kept_whatever_static_friction_is_drawn(share):
    own = MATERIALS["M5"].mu_s
    mu_k = share * own
    plain = [draw_grasp(Scene("M5", seed=seed)).surface.mu_s for seed in range(12)]
    assert min(plain) < own < max(plain)
    for seed, drawn in enumerate(plain):
        surface = draw_grasp(Scene("M5", seed=seed, contact=Contact(mu_k=mu_k))).surface
        assert surface.mu_s * surface.mu_ratio == pytest.approx(mu_k, rel=1e-12)
        assert surface.mu_s == max(drawn, mu_k)


def test_noise_blocks_depend_on_their_index_alone():
    key = (0, "test", 3)
    together = normal_blocks(key, np.arange(-1, 9), 512)
    alone = normal_blocks(key, np.array([4]), 512)
    np.testing.assert_array_equal(together[5], alone[0])
    assert abs(together.mean()) < 0.06
    assert together.std() == pytest.approx(1, abs=0.04)
    assert np.abs(np.corrcoef(together) - np.eye(10)).max() < 0.2


def test_coloured_noise_has_unit_power_and_no_seam_between_blocks():
    grid = whole_grid(60)
    f = grid.frequency_hz()
    response = causal_response(1 / (1 + (f / 60) ** 2), unit_power=True)
    noise = grid.coloured_noise((1, "noise"), response)
    assert noise.std() == pytest.approx(1, abs=0.05)
    inside, seam = np.diff(noise).std(), (noise[1:, 0] - noise[:-1, -1]).std()
    assert seam == pytest.approx(inside, rel=0.3)


def test_film_passes_no_constant_and_a_fast_step_whole():
    response = highpass_response(6.6, 512, RATE_HZ)
    taps = np.fft.irfft(response, 1024)[:513]
    assert abs(taps.sum()) < 1e-12
    gain = np.abs(response)
    f = np.fft.rfftfreq(1024, 1 / RATE_HZ)
    np.testing.assert_allclose(
        gain[5:400], (f / np.hypot(f, 6.6))[5:400], rtol=0.03
    )  # the analytic first-order high-pass
    step = np.cumsum(taps)
    tau_s = 1 / (2 * np.pi * 6.6)
    t = np.arange(100) / RATE_HZ
    np.testing.assert_allclose(step[:100], np.exp(-t / tau_s), atol=0.015)


def test_two_slides_in_one_block_sound_once_each():
    short = (Stroke(60.0, 12.0, 0.3), Stroke(60.0, 12.0, 0.01))
    contact = Contact(lifted_fraction=0.0, presliding_mm=(0.1, 0.1), texture_scale=0.0)
    scene = Scene("M2", strokes=short, contact=contact, cycle=1)
    plan, grasp = arm_strokes(scene.strokes, scene.acceleration_m_s2), draw_grasp(scene)
    grid = whole_grid(plan[-1].stop_s)
    element = int(grasp.touching[0])
    state = KinematicContact(scene, grasp, plan).on(grid)(element)
    field = shared_field(scene, grasp, Motion(plan, grid))
    felt = element_vibration(scene, grasp, state, field, element).fluctuation
    response = band_responses(grasp, element, grid)[1]
    noise = grid.coloured_noise((*recording_key(scene, "low"), element), response)
    slips_of = state.slide > 0
    both = [
        ((grid.time_s[row] < plan[0].stop_s) & slips_of[row]).any()
        and ((grid.time_s[row] > plan[1].start_s) & slips_of[row]).any()
        for row in range(len(grid.blocks))
    ]
    assert any(both)
    np.testing.assert_allclose(felt, state.slide * noise, atol=1e-12)
