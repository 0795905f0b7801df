"""The arm, the contact by closed forms and by bristles, and the onset that lies between them."""

import hashlib
import json
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
import torch
from scene_files import BRISTLES, CONTACTS, RATE_HZ, contacts, scene_on, whole_grid

from tactslip_torch import runtime as engines
from tactslip_torch.simulation import (
    MATERIALS,
    SEEN_MATERIALS,
    Contact,
    Disturbances,
    Scene,
    Stroke,
    simulate,
    simulate_many,
    timeline,
)
from tactslip_torch.simulation.blocks import Grid, causal_response, normal_blocks
from tactslip_torch.simulation.contact import ElementContact, scene_contact, scene_traces
from tactslip_torch.simulation.grasp import draw_grasp, quasi_static_slips
from tactslip_torch.simulation.scene import Motion
from tactslip_torch.simulation.sensors import element_vibration, highpass_response, shared_field
from tactslip_torch.simulation.source import SimulatedRecordings


@pytest.mark.parametrize(
    ("speed", "distance", "acceleration"), [(20, 100, 0.5), (60, 100, 0.5), (60, 5, 0.5), (1, 7, 9)]
)
def test_arm_travels_its_distance_with_bounded_acceleration(speed, distance, acceleration):
    strokes = (Stroke(speed, distance, 0.5),)
    contact = Contact(presliding_mm=(0.1, 0.1))
    scene = Scene("M1", strokes=strokes, contact=contact, acceleration_m_s2=acceleration)
    (stroke,) = scene.arm
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
    plan = Scene("M1").arm
    np.testing.assert_allclose([s.start_s for s in plan], [2, 9, 13.5], atol=0.15)
    assert [s.origin_mm for s in plan] == [0, 100, 200]
    motion = Motion(plan, whole_grid(31000))
    assert np.all(np.diff(motion.position_mm.ravel()) >= 0)
    assert motion.position_mm[-1, -1] == pytest.approx(300)


@pytest.mark.parametrize("material", SEEN_MATERIALS)
def test_onset_comes_after_the_arm_and_by_the_presliding_travel(material):
    for cycle in range(10):
        scene = Scene(material, cycle=cycle)
        truth, grasp = timeline(scene), draw_grasp(scene)
        plan = scene.arm
        for stroke, onset_s, (start_s, end_s) in zip(
            plan, truth.onsets_s, truth.sliding_s, strict=True
        ):
            assert stroke.start_s + 0.005 < onset_s == start_s < end_s < stroke.stop_s
        fresh_mm = plan[0].travel_mm(np.array(truth.onsets_s[0]))
        touching_mm = grasp.presliding_mm[grasp.touching]
        assert touching_mm.min() * (1 - 1e-9) <= fresh_mm <= touching_mm.max() * (1 + 1e-9)
        later_mm = plan[1].travel_mm(np.array(truth.onsets_s[1]))
        assert later_mm < 0.65 * fresh_mm  # the pause left most of the shear


def test_onset_is_the_load_weighted_median_of_the_elements():
    scene = Scene("M4", cycle=3)
    grasp = draw_grasp(scene)
    slipping = quasi_static_slips(grasp, scene.arm)
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
    grasp, (states, t) = draw_grasp(scene), contacts(scene)
    slips = quasi_static_slips(grasp, scene.arm)
    for element, state in states.items():
        static_n = grasp.surface.mu_s * state.normal_n
        assert np.all((state.friction_n >= 0) & (state.friction_n <= static_n + 1e-12))
        share = state.friction_n / static_n
        # no jump but the fall at letting go: stretching, relaxing and sticking are continuous
        assert np.abs(np.diff(share)).max() < 0.12
        assert np.all(share[t < scene.arm[0].start_s] == 0)
        spans = list(zip(slips.start_s[:, element], slips.end_s[:, element], strict=True))
        middle = share[(t > spans[0][0] + 0.1) & (t < spans[0][1])]
        np.testing.assert_allclose(middle, grasp.surface.mu_ratio, rtol=1e-3)
        inside = np.any([(t >= start_s) & (t <= end_s) for start_s, end_s in spans], axis=0)
        assert np.all(state.slide[~inside] == 0)
        assert 0.99 < state.slide.max() <= 1.0


def test_lifted_elements_never_slip_and_about_a_tenth_is_lifted():
    lifted = np.concatenate([draw_grasp(Scene("M1", cycle=c)).load_n == 0 for c in range(60)])
    assert 0.06 < lifted.mean() < 0.14
    grasp = draw_grasp(Scene("M1", contact=Contact(lifted_fraction=0.999)))
    assert len(grasp.touching) == 1
    slipping = quasi_static_slips(grasp, Scene("M1").arm)
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
    grid = whole_grid(120000)
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


SHORT = (Stroke(40.0, 20.0, 0.6), Stroke(60.0, 20.0, 0.4))
"""Two short strokes: 2.1 s instead of 15.4."""


@pytest.mark.parametrize("model", BRISTLES)
def test_pauses_relax_as_in_closed_form_and_strokes_join_without_a_jump(model):
    scene = scene_on(model, "M3", strokes=SHORT)
    (a, time_s), (b, _) = contacts(scene), contacts(replace(scene, fidelity="kinematic"))
    arm = timeline(scene).arm_s
    paused = (time_s > arm[0][1] + 0.25) & (time_s < arm[1][0])
    before = time_s < arm[0][0]
    assert min(paused.sum(), before.sum()) > 200
    for mine, other in zip(a.values(), b.values(), strict=True):
        np.testing.assert_allclose(mine.friction_n[paused], other.friction_n[paused], 1e-9)
        assert not mine.friction_n[before].any()
        assert not mine.slide[before].any()
        # the spring's force changes by at most k v dt a sample: no seam shows in it
        static = mine.friction_n.max()
        steps = np.abs(np.diff(mine.friction_n[time_s < timeline(scene).duration_s]))
        seams = np.searchsorted(time_s, [arm[0][0], arm[0][1], arm[0][1] + 0.25, arm[1][0]])
        for seam in seams:
            assert steps[seam - 2 : seam + 2].max() < 0.01 * static


@pytest.mark.parametrize("model", BRISTLES)
def test_elements_let_go_when_their_own_load_lets_them(model):
    # With a strong run-out and a skin that does not relax, static friction is reached when the
    # skin is stretched by presliding x load / nominal load: late for a loaded element.
    skin = Contact(
        presliding_mm=(1.0, 1.0), presliding_spread=0.0, relaxation=(1e-6, 1e-6), runout=0.6
    )
    strokes = (Stroke(20.0, 12.0, 0.2),)
    scene = scene_on(model, "M2", contact=skin, strokes=strokes)
    grasp = draw_grasp(scene)
    down, slips = grasp.touching, scene_contact(scene, grasp).slips
    travel_mm = np.ones(len(down))
    for _ in range(50):  # to the root of travel = presliding x load over nominal load
        angle = 2 * np.pi / 180.0 * travel_mm + grasp.runout_phase[down]
        travel_mm = 1.0 + 0.6 * np.sin(angle)
    expected_s = scene.arm[0].start_s + _time_of(travel_mm)
    found_s = slips.start_s[0, down]
    assert np.ptp(expected_s) > 0.04
    late = found_s - expected_s
    assert np.corrcoef(found_s, expected_s)[0, 1] > 0.98
    assert np.abs(late).max() < (0.006 if model == "one" else 0.02)
    kinematic = quasi_static_slips(grasp, scene.arm).start_s
    assert np.abs(kinematic[0, down] - expected_s).max() > 0.02


def _time_of(travel_mm):
    """Of a trapezoid of .5 m/s2 up to 20 mm/s, which is reached after .04 s and .4 mm."""
    return np.where(travel_mm < 0.4, np.sqrt(2e-3 * travel_mm / 0.5), 0.04 + (travel_mm - 0.4) / 20)


def swing(friction_n):
    """Half of the force's range over its mean in stretches of .2 s, the median of them."""
    rows = friction_n[: len(friction_n) // 400 * 400].reshape(-1, 400)
    return np.median(np.ptp(rows, axis=1) / 2 / rows.mean(1))


def slides(scene):
    """Of each stroke: share of the slide in which half of the load does, and the force's swing."""
    found, time_s = contacts(scene)
    grasp, shares, swings = draw_grasp(scene), [], []
    load = grasp.load_n[grasp.touching] / grasp.load_n.sum()
    gross = load @ np.stack([contact.slide > 0.5 for contact in found.values()])
    for start_s, end_s in timeline(scene).sliding_s:
        within = (time_s >= start_s) & (time_s < end_s)
        late = (time_s > start_s + 0.3 * (end_s - start_s)) & (time_s < end_s - 0.1)
        shares.append((gross[within] >= 0.5).mean())
        swings.append(np.median([swing(contact.friction_n[late]) for contact in found.values()]))
    return np.array(shares), np.array(swings)


PACES = (Stroke(20.0, 16.0, 0.4), Stroke(40.0, 24.0, 0.4), Stroke(60.0, 36.0, 0.4))
"""Half a second of every speed of the paper."""


@pytest.mark.parametrize("cycle", [0, 3])
@pytest.mark.parametrize("model", BRISTLES)
@pytest.mark.parametrize("material", ["M2", "M3", "M4", "M5"])
def test_smooth_materials_slide_all_the_way_at_every_speed(material, model, cycle):
    shares, swings = slides(scene_on(model, material, cycle, strokes=PACES))
    assert (shares > 0.9).all()
    assert (swings < 0.03).all()


def test_tape_sticks_and_slips_at_every_speed():
    shares, swings = slides(scene_on("one", "M6", strokes=PACES))
    assert (shares < 0.9).all()
    assert (swings > 0.1).all()
    _, (swinging,) = slides(scene_on("one", "M6", strokes=(Stroke(40.0, 60.0, 0.2),)))
    assert 0.15 < swinging < 0.4  # near +-25 %


def test_the_film_hears_stick_slip_and_no_imitation_of_it():
    # Without texture and friction noise a kinematic M6 is silent once it slides.
    silent = {"texture_scale": 0.0, "friction_noise_mv": 0.0}
    quiet = {"mains_mv": 0.0, "arm_transient_mv": 0.0, "burst_rate_hz": 0.0}
    levels = {}
    for model, material in (("one", "M6"), ("kinematic", "M6"), ("one", "M2")):
        strokes = (Stroke(40.0, 60.0, 0.6),)
        scene = scene_on(model, material, strokes=strokes, **silent, **quiet)
        recording = simulate(scene)
        samples = recording.samples[14:].double().numpy()
        ((start_s, end_s),) = recording.sliding_s
        slide = samples[:, round(1000 * (start_s + end_s)) : round(2000 * (end_s - 0.1))]
        levels[model, material] = np.median(slide.std(1) / samples[:, :1000].std(1))
    assert levels["one", "M6"] > 8
    assert levels["kinematic", "M6"] < 2
    assert levels["one", "M2"] < 2


def test_a_batch_in_float32_or_by_the_eager_engine_is_the_same_to_rounding():
    strokes = (Stroke(60.0, 2.0, 0.1),)
    skin = Contact(presliding_mm=(0.3, 0.3))
    scenes = [scene_on("one", "M2", c, strokes=strokes, contact=skin) for c in (0, 1)]
    wanted = [simulate(scene) for scene in scenes]
    for options, tolerance in (
        ({"engine": "eager"}, 4e-4),  # a step of the converter is 1.5e-4 V
        ({"dtype": torch.float32}, 2e-2),
    ):
        found = list(simulate_many(scenes, **options))
        for one, other in zip(found, wanted, strict=True):
            assert (one.samples - other.samples).abs().max() < tolerance
            np.testing.assert_allclose(one.onsets_s, other.onsets_s, atol=1e-4)
        assert [digest(simulate(s)) for s in scenes] == [digest(w) for w in wanted]


def test_steps_that_do_not_make_a_sample_are_refused_in_one_line():
    for step_us, remedy in ((300.0, "250"), (1000.0, "500")):
        scene = scene_on("one", "M2", step_us=step_us)
        with pytest.raises(ValueError, match=rf"^a whole number of steps .* take {remedy}$"):
            timeline(scene)
    timeline(scene_on("one", "M2", strokes=SHORT[:1], step_us=500.0))


def test_a_hand_that_never_slides_is_refused_in_one_line():
    # A skin that relaxes altogether gives way to so slow an arm faster than it is stretched.
    skin = Contact(
        presliding_mm=(0.3, 0.3),
        relaxation=(1.0, 1.0),
        relaxation_time_s=(0.2, 0.2),
        touching=("PVDF7", "PVDF9"),
    )
    scene = scene_on("one", "M2", strokes=(Stroke(0.4, 0.8, 0.1),), contact=skin)
    with pytest.raises(ValueError, match=r"^stroke 1 never slides: .* 0 % of the load let go"):
        timeline(scene)


def test_a_batch_refuses_what_does_not_fit():
    scenes = [Scene("M2", strokes=SHORT)] * 2
    with pytest.raises(ValueError, match="windows of each of 2 scenes, got 1"):
        simulate_many(scenes, windows=[None])
    with pytest.raises(ValueError, match="at_once must be at least 1, got 0"):
        simulate_many(scenes, at_once=0)


def digest(recording):
    return hashlib.sha256(recording.samples.numpy().tobytes()).hexdigest()


@pytest.mark.parametrize("model", BRISTLES)
def test_on_stiff_skin_onsets_and_steady_friction_are_the_closed_forms(model):
    skin = Contact(presliding_mm=(0.05, 0.05), lifted_fraction=0.0)
    scene = scene_on(model, "M2", strokes=SHORT, contact=skin)
    closed = replace(scene, fidelity="kinematic")
    ours, theirs = timeline(scene), timeline(closed)
    np.testing.assert_allclose(ours.onsets_s, theirs.onsets_s, rtol=0, atol=2e-3)
    start_s, end_s = np.max([ours.sliding_s, theirs.sliding_s], axis=0)[0]
    (a, time_s), (b, _) = contacts(scene), contacts(closed)
    steady = (time_s > start_s + 0.1) & (time_s < end_s - 0.1)
    assert steady.sum() > 400
    for mine, other in zip(a.values(), b.values(), strict=True):
        np.testing.assert_allclose(mine.friction_n[steady], other.friction_n[steady], 0.01)


def test_a_speed_of_its_own_sounds_as_that_speed_does():
    """Texture and friction noise grow with powers of the speed, a slower slip's as the arm's."""
    for own in ({"texture_scale": 0.0}, {"friction_noise_mv": 0.0}):
        scene = scene_on("one", "M4", friction_noise_exponent=0.6, **own)
        grasp, grid = draw_grasp(scene), Grid(np.arange(8, 10), 512, 2000.0)
        field, ones = shared_field(scene, grasp, Motion(scene.slides, grid)), np.ones((2, 512))
        exponent = 0.6 if "texture_scale" in own else grasp.surface.texture_exponent
        heard = {
            slide: element_vibration(
                scene,
                grasp,
                ElementContact(ones, ones, slide * ones, 0 * ones),
                field,
                int(grasp.touching[0]),
            )
            for slide in (0.0, 0.05, 1.0, 16.0)
        }
        assert heard[1.0].high.any()
        assert not heard[0.0].high.any()
        for slide in (0.05, 16.0):
            louder = slide**exponent * heard[1.0].high
            np.testing.assert_allclose(heard[slide].high, louder, rtol=1e-12)


@pytest.mark.parametrize("model", BRISTLES)
def test_same_bytes_in_any_order_and_number(model):
    scenes = [scene_on(model, m, strokes=SHORT, seed=4) for m in ("M6", "M1")]
    forward = [digest(simulate(scene)) for scene in scenes]
    scene_traces.cache_clear()
    assert [digest(simulate(scene)) for scene in reversed(scenes)] == forward[::-1]
    assert [digest(one) for one in simulate_many(scenes)] == forward
    assert [digest(one) for one in simulate_many(scenes, at_once=1)] == forward


def test_a_timeline_and_its_samples_integrate_once():
    scene_traces.cache_clear()
    scene = scene_on("one", "M2", strokes=SHORT[:1])
    timeline(scene)
    simulate(scene, windows=[(0.1, 0.2)])
    assert scene_traces.cache_info().misses == 1


def test_provenance_and_keys_name_the_engine_of_bristles(monkeypatch):
    pytest.importorskip("numba")
    strokes = (Stroke(60.0, 16.0, 0.1),)
    scene = scene_on("many", "M2", strokes=strokes)
    assert "integrator" not in simulate(replace(scene, fidelity="kinematic")).provenance
    compiled = {"engine": "compiled", "numba_version": version("numba")}
    compiled |= {"dtype": "float64", "device": "cpu"}
    assert simulate(scene).provenance["integrator"] == compiled
    (other,) = simulate_many([scene], engine="eager", dtype=torch.float32)
    by = {"engine": "eager", "torch_version": version("torch"), "dtype": "float32"}
    assert by.items() <= other.provenance["integrator"].items()
    for fidelity, engines_named in (
        ("kinematic", [None, None]),
        ("bristles", ["compiled", "eager"]),
    ):
        own = {"fidelity": fidelity, "scene": {"strokes": strokes}}
        source = SimulatedRecordings(cycles=1, materials=["M2"], **own)
        (recording,) = source.ids
        keys = [json.loads(json.dumps(source.key(recording)))]
        with monkeypatch.context() as without:
            without.setattr(engines, "find_spec", lambda name: None)
            keys.append(source.key(recording))
        assert [key.get("integrator", {}).get("engine") for key in keys] == engines_named
        assert Scene.from_dict(keys[0]) == replace(scene, fidelity=fidelity)


def test_where_nothing_slides_all_contacts_are_one():
    strokes = (Stroke(40.0, 20.0, 0.1, "both"),)
    scenes = [scene_on(model, "M6", strokes=strokes) for model in CONTACTS]
    assert len({digest(simulate(scene)) for scene in scenes}) == 1
    assert timeline(scenes[-1]).onsets_s == ()
