"""The ladder of fidelity: rungs agree where they must, and each does what the cheaper cannot."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from tactslip_torch import engines
from tactslip_torch.simulation import Contact, Disturbances, Scene, Stroke, simulate, timeline
from tactslip_torch.simulation.batch import simulate_many
from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.dynamics import contact as dynamic
from tactslip_torch.simulation.dynamics.contact import DynamicContact
from tactslip_torch.simulation.grasp import draw_grasp
from tactslip_torch.simulation.grid import Grid, block_samples_for
from tactslip_torch.simulation.knobs import Dynamics
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.motion import Motion, arm_strokes
from tactslip_torch.simulation.source import SimulatedRecordings
from tactslip_torch.simulation.vibration import element_vibration, shared_field

SHORT = (Stroke(40.0, 20.0, 0.6), Stroke(60.0, 20.0, 0.4))
"""Two short strokes: 2.1 s instead of 15.4."""

RUNGS = ("kinematic", "lugre", "patch")
DYNAMIC = ("lugre", "patch")


def model_of(scene):
    plan = arm_strokes(scene.strokes, scene.acceleration_m_s2)
    grasp = draw_grasp(scene)
    return scene_contact(scene, grasp, plan), grasp, plan


def contacts(scene):
    """Every touching element's contact on all samples, flat, and the times of the samples."""
    model, grasp, _ = model_of(scene)
    size = block_samples_for(scene.sample_rate_hz)
    num = timeline(scene).num_samples
    grid = Grid(np.arange(-(-num // size)), size, scene.sample_rate_hz)
    on, now = model.on(grid), grid.history[2]
    found = []
    for element in grasp.touching.tolist():
        contact = on(element)
        found.append(
            {
                "friction_n": contact.friction_n[now].ravel(),
                "normal_n": contact.normal_n[now].ravel(),
                "slide": contact.slide.ravel(),
                "release_v": contact.release_v.ravel(),
            }
        )
    return found, grid.time_s.ravel()


def samples_digest(recording):
    return hashlib.sha256(recording.samples.numpy().tobytes()).hexdigest()


# --- where rungs agree --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stiff():
    """The same stiff skin on a smooth material, 40 and 60 mm/s, on every rung."""
    skin = Contact(presliding_mm=(0.05, 0.05), lifted_fraction=0.0)
    return {rung: Scene("M2", strokes=SHORT, contact=skin, fidelity=rung) for rung in RUNGS}


@pytest.mark.parametrize("rung", DYNAMIC)
def test_on_stiff_skin_onsets_and_steady_friction_are_the_kinematic_rungs(stiff, rung):
    ours, theirs = timeline(stiff[rung]), timeline(stiff["kinematic"])
    np.testing.assert_allclose(ours.onsets_s, theirs.onsets_s, rtol=0, atol=2e-3)
    start_s, end_s = np.max([ours.sliding_s, theirs.sliding_s], axis=0)[0]
    (a, time_s), (b, _) = contacts(stiff[rung]), contacts(stiff["kinematic"])
    steady = (time_s > start_s + 0.1) & (time_s < end_s - 0.1)
    assert steady.sum() > 400
    for mine, other in zip(a, b, strict=True):
        np.testing.assert_allclose(mine["friction_n"][steady], other["friction_n"][steady], 0.01)


@pytest.mark.parametrize("rung", DYNAMIC)
def test_pauses_relax_as_on_the_kinematic_rung_and_strokes_join_without_a_jump(rung):
    scene = Scene("M3", strokes=SHORT, fidelity=rung)
    (a, time_s), (b, _) = contacts(scene), contacts(replace(scene, fidelity="kinematic"))
    arm = timeline(scene).arm_s
    paused = (time_s > arm[0][1] + 0.25) & (time_s < arm[1][0])
    before = time_s < arm[0][0]
    assert min(paused.sum(), before.sum()) > 200
    for mine, other in zip(a, b, strict=True):
        np.testing.assert_allclose(mine["friction_n"][paused], other["friction_n"][paused], 1e-9)
        assert not mine["friction_n"][before].any()
        assert not mine["slide"][before].any()
        # the spring's force changes by at most k v dt a sample: no seam shows in it
        static = mine["friction_n"].max()
        steps = np.abs(np.diff(mine["friction_n"][time_s < timeline(scene).duration_s]))
        seams = np.searchsorted(time_s, [arm[0][0], arm[0][1], arm[0][1] + 0.25, arm[1][0]])
        for seam in seams:
            assert steps[seam - 2 : seam + 2].max() < 0.01 * static


# --- truth is the contact's ---------------------------------------------------------------------


@pytest.mark.parametrize("rung", DYNAMIC)
def test_elements_let_go_when_their_own_load_lets_them(rung):
    # With a strong run-out and a skin that does not relax, static friction is reached when the
    # skin is stretched by presliding x load / nominal load: late for a loaded element.
    skin = Contact(
        presliding_mm=(1.0, 1.0), presliding_spread=0.0, relaxation=(1e-6, 1e-6), runout=0.6
    )
    scene = Scene("M2", contact=skin, fidelity=rung, strokes=(Stroke(20.0, 12.0, 0.2),))
    model, grasp, plan = model_of(scene)
    down = grasp.touching
    travel_mm = np.ones(len(down))
    for _ in range(50):  # to the root of travel = presliding x load over nominal load
        angle = 2 * np.pi / 180.0 * travel_mm + grasp.runout_phase[down]
        travel_mm = 1.0 + 0.6 * np.sin(angle)
    expected_s = plan[0].start_s + _time_of(travel_mm)
    found_s = model.slips.start_s[0, down]
    assert np.ptp(expected_s) > 0.04
    late = found_s - expected_s
    assert np.corrcoef(found_s, expected_s)[0, 1] > 0.98
    assert np.abs(late).max() < (0.006 if rung == "lugre" else 0.02)
    kinematic = scene_contact(replace(scene, fidelity="kinematic"), grasp, plan).slips.start_s
    assert np.abs(kinematic[0, down] - expected_s).max() > 0.02


def _time_of(travel_mm):
    """Of a trapezoid of .5 m/s2 up to 20 mm/s, which is reached after .04 s and .4 mm."""
    return np.where(travel_mm < 0.4, np.sqrt(2e-3 * travel_mm / 0.5), 0.04 + (travel_mm - 0.4) / 20)


@pytest.mark.parametrize("rung", DYNAMIC)
def test_onset_and_end_are_where_the_contact_begins_and_ceases_to_slide(rung):
    scene = Scene("M4", strokes=SHORT, fidelity=rung)
    model, grasp, _ = model_of(scene)
    found, time_s = contacts(scene)
    for contact, element in zip(found, grasp.touching.tolist(), strict=True):
        for stroke, (start_s, end_s) in enumerate(timeline(scene).arm_s):
            slides = (contact["slide"] > 0.5) & (time_s >= start_s) & (time_s <= end_s)
            first, last = time_s[slides][[0, -1]]
            assert 0 <= first - model.slips.start_s[stroke, element] <= 1 / 2000 + 1e-9
            assert 0 <= model.slips.end_s[stroke, element] - last <= 1 / 2000 + 1e-9


def test_a_patch_slides_incipiently_before_it_slides_grossly():
    skin = Contact(presliding_mm=(1.0, 1.0))

    def lead_s(rung, share):
        scene = Scene(
            "M5",
            strokes=SHORT,
            contact=skin,
            fidelity=rung,
            dynamics=Dynamics(bristle_share=share),
        )
        model, grasp, _ = model_of(scene)
        lead = (model.slips.start_s - model.incipient_s)[0, grasp.touching]
        assert np.all(lead >= 0)
        return lead

    assert np.all(lead_s("patch", 0.2) > 2e-3)
    assert np.all(lead_s("patch", 0.4) > 1.5 * lead_s("patch", 0.2))
    assert np.all(lead_s("lugre", 0.2) < 1e-3)  # one bristle is all or nothing


# --- tacky and smooth ---------------------------------------------------------------------------


def swing(friction_n):
    """Half of the force's range over its mean in stretches of .2 s, the median of them."""
    rows = friction_n[: len(friction_n) // 400 * 400].reshape(-1, 400)
    return np.median(np.ptp(rows, axis=1) / 2 / rows.mean(1))


def slides(scene):
    """Of each stroke: share of the slide in which half of the load does, and the force's swing."""
    found, time_s = contacts(scene)
    grasp, shares, swings = draw_grasp(scene), [], []
    load = grasp.load_n[grasp.touching] / grasp.load_n.sum()
    gross = load @ np.stack([contact["slide"] > 0.5 for contact in found])
    for start_s, end_s in timeline(scene).sliding_s:
        within = (time_s >= start_s) & (time_s < end_s)
        late = (time_s > start_s + 0.3 * (end_s - start_s)) & (time_s < end_s - 0.1)
        shares.append((gross[within] >= 0.5).mean())
        swings.append(np.median([swing(contact["friction_n"][late]) for contact in found]))
    return np.array(shares), np.array(swings)


PACES = (Stroke(20.0, 16.0, 0.4), Stroke(40.0, 24.0, 0.4), Stroke(60.0, 36.0, 0.4))
"""Half a second of every speed of the paper."""


@pytest.mark.parametrize("cycle", [0, 3])
@pytest.mark.parametrize("rung", DYNAMIC)
@pytest.mark.parametrize("material", ["M2", "M3", "M4", "M5"])
def test_smooth_materials_slide_all_the_way_at_every_speed(material, rung, cycle):
    shares, swings = slides(Scene(material, fidelity=rung, strokes=PACES, cycle=cycle))
    assert (shares > 0.9).all()
    assert (swings < 0.03).all()


def test_tape_sticks_and_slips_at_every_speed():
    shares, swings = slides(Scene("M6", fidelity="lugre", strokes=PACES))
    assert (shares < 0.9).all()
    assert (swings > 0.1).all()
    _, (swinging,) = slides(Scene("M6", fidelity="lugre", strokes=(Stroke(40.0, 60.0, 0.2),)))
    assert 0.15 < swinging < 0.4  # near +-25 %


def test_the_film_hears_stick_slip_and_no_imitation_of_it():
    # Without texture and friction noise a kinematic M6 is silent once it slides.
    silent = Contact(texture_scale=0.0, friction_noise_mv=0.0)
    quiet = Disturbances(mains_mv=0.0, arm_transient_mv=0.0, burst_rate_hz=0.0)
    levels = {}
    for rung, material in (("lugre", "M6"), ("kinematic", "M6"), ("lugre", "M2")):
        scene = Scene(
            material,
            fidelity=rung,
            contact=silent,
            disturbances=quiet,
            strokes=(Stroke(40.0, 60.0, 0.6),),
        )
        recording = simulate(scene)
        samples = recording.samples[14:].double().numpy()
        ((start_s, end_s),) = recording.sliding_s
        slide = samples[:, round(1000 * (start_s + end_s)) : round(2000 * (end_s - 0.1))]
        levels[rung, material] = np.median(slide.std(1) / samples[:, :1000].std(1))
    assert levels["lugre", "M6"] > 8
    assert levels["kinematic", "M6"] < 2
    assert levels["lugre", "M2"] < 2


def test_lines_that_stand_for_stick_slip_are_the_kinematic_rungs():
    def num_lines(material, rung):
        scene = Scene(material, fidelity=rung)
        grasp, plan = draw_grasp(scene), arm_strokes(scene.strokes, scene.acceleration_m_s2)
        motion = Motion(plan, Grid(np.arange(8, 10), 512, 2000.0))
        lines = shared_field(scene, grasp, motion).lines
        assert lines.any() or not lines.size
        return lines.shape[1]

    assert num_lines("M6", "kinematic") > 0
    assert [num_lines("M6", rung) for rung in DYNAMIC] == [0, 0]
    assert num_lines("M3", "lugre") == num_lines("M3", "kinematic") > 0


@pytest.mark.parametrize("rung", RUNGS)
def test_what_slides_slower_sounds_as_at_that_speed_on_dynamic_rungs(rung):
    # friction noise grows with speed to the power .6 here, texture with another; at a slip speed
    # of a twentieth or 16 times the arm's each is the louder for it, whatever the arm's speed
    for knobs in ({"texture_scale": 0.0}, {"friction_noise_mv": 0.0}):
        contact = Contact(friction_noise_exponent=0.6, **knobs)
        scene = Scene("M4", fidelity=rung, contact=contact)
        grasp, plan = draw_grasp(scene), arm_strokes(scene.strokes, scene.acceleration_m_s2)
        grid = Grid(np.arange(8, 10), 512, 2000.0)
        field = shared_field(scene, grasp, Motion(plan, grid))
        element, ones = int(grasp.touching[0]), np.ones((2, 512))
        exponent = 0.6 if "texture_scale" in knobs else grasp.surface.texture_exponent

        def heard(slide, of=(scene, grasp, field, element, ones)):
            scene, grasp, field, element, ones = of
            slow = ElementContact(ones, ones, slide * ones, 0 * ones)
            return element_vibration(scene, grasp, slow, field, element)

        steady = heard(1.0)
        assert steady.high.any()
        for slide in (0.05, 16.0):
            louder = slide if rung == "kinematic" else slide**exponent
            np.testing.assert_allclose(heard(slide).high, louder * steady.high, rtol=1e-12)
            np.testing.assert_allclose(heard(slide).low, louder * steady.low, rtol=1e-12)
        assert not heard(0.0).high.any()


# --- the same bytes -----------------------------------------------------------------------------


@pytest.mark.parametrize("rung", RUNGS)
def test_same_seed_same_bytes_on_every_rung(rung):
    scenes = [Scene(m, strokes=SHORT, fidelity=rung, seed=4) for m in ("M6", "M1")]
    forward = [samples_digest(simulate(scene)) for scene in scenes]
    dynamic._kept.clear()
    assert [samples_digest(simulate(scene)) for scene in reversed(scenes)] == forward[::-1]
    assert [samples_digest(one) for one in simulate_many(scenes)] == forward
    assert [samples_digest(one) for one in simulate_many(scenes, at_once=1)] == forward
    program = (
        "import json, sys, hashlib\n"
        "from tactslip_torch.simulation import Scene, simulate\n"
        "scene = Scene.from_dict(json.loads(sys.stdin.read()))\n"
        "print(hashlib.sha256(simulate(scene).samples.numpy().tobytes()).hexdigest())\n"
    )
    fresh = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(scenes[0].to_dict()),
        capture_output=True,
        text=True,
        check=True,
    )
    assert fresh.stdout.strip() == forward[0]


@pytest.mark.parametrize("rung", DYNAMIC)
def test_windows_and_channels_change_neither_samples_nor_truth(rung):
    scene = Scene("M6", strokes=SHORT, fidelity=rung)
    whole = simulate(scene)
    dynamic._kept.clear()
    onset_s = whole.onsets_s[1]
    window = (onset_s - 0.1, onset_s + 0.2)
    part = simulate(scene, windows=[window], channels=["SG10", "PVDF7"])
    first, last = (round(2000 * t) for t in window)
    rows = [9, 20]
    torch.testing.assert_close(
        part.samples[rows, first:last], whole.samples[rows, first:last], rtol=0, atol=0
    )
    assert int(part.samples.isfinite().sum()) == 2 * (last - first)
    assert part.sliding_s == whole.sliding_s
    assert timeline(scene).sliding_s == whole.sliding_s


def test_a_timeline_and_its_samples_integrate_once(monkeypatch):
    calls = []
    traces_of = dynamic.traces_of
    monkeypatch.setattr(dynamic, "traces_of", lambda s: calls.append(s) or traces_of(s))
    dynamic._kept.clear()
    scenes = [
        Scene("M2", strokes=SHORT[:1], fidelity="lugre", cycle=c) for c in range(dynamic.KEPT + 1)
    ]
    timeline(scenes[0])
    simulate(scenes[0], windows=[(0.1, 0.2)])
    assert len(calls) == 1
    for scene in scenes:
        timeline(scene)
    assert len(calls) == len(scenes)
    assert len(dynamic._kept) == dynamic.KEPT
    timeline(scenes[0])  # the oldest was let go
    assert len(calls) == len(scenes) + 1


def test_a_batch_in_float32_or_by_the_eager_engine_is_the_same_to_rounding():
    strokes = (Stroke(60.0, 2.0, 0.1),)
    skin = Contact(presliding_mm=(0.3, 0.3))
    scenes = [Scene("M2", strokes=strokes, contact=skin, fidelity="lugre", cycle=c) for c in (0, 1)]
    wanted = [simulate(scene) for scene in scenes]
    for options, tolerance in (
        ({"engine": "eager"}, 4e-4),  # a step of the converter is 1.5e-4 V
        ({"dtype": torch.float32}, 2e-2),
    ):
        found = list(simulate_many(scenes, **options))
        for one, other in zip(found, wanted, strict=True):
            assert (one.samples - other.samples).abs().max() < tolerance
            np.testing.assert_allclose(one.onsets_s, other.onsets_s, atol=1e-4)
        assert [samples_digest(simulate(s)) for s in scenes] == [samples_digest(w) for w in wanted]


def test_provenance_and_keys_name_the_engine_of_a_dynamic_rung(monkeypatch):
    strokes = (Stroke(60.0, 16.0, 0.1),)
    scenes = [Scene("M2", strokes=strokes, fidelity=rung) for rung in RUNGS]
    plain, lugre, _ = found = [simulate(scene).provenance for scene in scenes]
    assert "integrator" not in plain
    has_numba = find_spec("numba") is not None
    engine = {"engine": "compiled", "numba_version": version("numba")} if has_numba else None
    engine = engine or {"engine": "eager", "torch_version": version("torch")}
    for one in found[1:]:
        assert one["integrator"] == engine | {"dtype": "float64", "device": "cpu"}
    (other,) = simulate_many(scenes[1:2], engine="eager", dtype=torch.float32)
    by = other.provenance["integrator"]
    assert (by["engine"], by["dtype"], by["torch_version"]) == (
        "eager",
        "float32",
        version("torch"),
    )
    keys = {}
    for rung in ("kinematic", "lugre"):
        source = SimulatedRecordings(
            cycles=1, materials=["M2"], fidelity=rung, scene={"strokes": strokes}
        )
        (recording,) = source.ids
        keys[rung] = [json.dumps(source.key(recording))]
        with monkeypatch.context() as without:
            without.setattr(engines, "find_spec", lambda name: None)
            keys[rung].append(json.dumps(source.key(recording)))
        key = json.loads(keys[rung][0])
        assert Scene.from_dict(key) == Scene("M2", strokes=strokes, fidelity=rung)
        assert key.get("integrator", lugre["integrator"]) == lugre["integrator"]
    assert keys["kinematic"][0] == keys["kinematic"][1]
    assert '"engine": "eager"' in keys["lugre"][1]
    assert (keys["lugre"][0] != keys["lugre"][1]) == has_numba


# --- refusals -----------------------------------------------------------------------------------


def test_steps_that_do_not_make_a_sample_are_refused_in_one_line():
    for step_us, remedy in ((300.0, "250"), (1000.0, "500")):
        scene = Scene("M2", fidelity="lugre", dynamics=Dynamics(step_us=step_us))
        with pytest.raises(ValueError, match=rf"^a whole number of steps .* take {remedy}$"):
            timeline(scene)
    timeline(Scene("M2", strokes=SHORT[:1], fidelity="lugre", dynamics=Dynamics(step_us=500.0)))


def test_a_hand_that_never_slides_is_refused_in_one_line():
    # A skin that relaxes altogether gives way to so slow an arm faster than it is stretched.
    skin = Contact(
        presliding_mm=(0.3, 0.3),
        relaxation=(1.0, 1.0),
        relaxation_time_s=(0.2, 0.2),
        touching=("PVDF7", "PVDF9"),
    )
    scene = Scene("M2", strokes=(Stroke(0.4, 0.8, 0.1),), contact=skin, fidelity="lugre")
    with pytest.raises(ValueError, match=r"^stroke 1 never slides: .* 0 % of the load let go"):
        timeline(scene)


def test_a_batch_refuses_what_does_not_fit():
    scenes = [Scene("M2", strokes=SHORT)] * 2
    with pytest.raises(ValueError, match="windows of each of 2 scenes, got 1"):
        simulate_many(scenes, windows=[None])
    with pytest.raises(ValueError, match="at_once must be at least 1, got 0"):
        simulate_many(scenes, at_once=0)


def test_a_scene_in_which_nothing_slides_has_no_slips():
    model, grasp, _ = model_of(
        Scene("M2", strokes=(Stroke(40.0, 20.0, 0.1, "both"),), fidelity="lugre")
    )
    assert isinstance(model, DynamicContact)
    assert model.slips.start_s.shape == (0, len(grasp.load_n))
    size = block_samples_for(2000.0)
    contact = model.on(Grid(np.arange(3), size, 2000.0))(int(grasp.touching[0]))
    assert not contact.friction_n.any()
    assert contact.normal_n.all()
