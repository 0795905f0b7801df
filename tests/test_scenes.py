"""Every scene of ``conf/scene/``: its truth is the contact's, and its bytes are always the same.

What each scene does to the signals is tested in the ``test_scenes_*`` files beside this one.
"""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import NAMES, SCENE_FILES, insides, is_within, scene_of, whole_grid

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.simulation import (
    FIDELITIES,
    MATERIALS,
    Contact,
    Faults,
    Handling,
    Scene,
    Stroke,
    simulate,
    timeline,
)
from tactslip_torch.simulation.grasp import draw_grasp
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.sensors import draw_front
from tactslip_torch.simulation.source import SimulatedRecordings

EXPECTED = {"arm_motion", "taps", "grips", "pulled", "motor_off", "motor_only", "machine", "drift"}
EXPECTED |= {"mains_bursts", "dead_channel", "saturated_channel", "swapped_channels"}
EXPECTED |= {"dropped_samples", "paper"}
TWO = ("M3", "M6")
CASES = [(name, material) for name in NAMES for material in TWO]
ON_RUNGS = [(n, rung) for n in ("pulled", "arm_motion", "taps") for rung in ("lugre", "patch")]


def short_on(rung: str, name: str, material: str, cycle: int = 0) -> Scene:
    """A scene's first two strokes on a rung, no longer than they must be."""
    scene = scene_of(name, material, cycle, fidelity=rung)
    strokes = tuple(replace(stroke, distance_mm=20.0) for stroke in scene.strokes[:2])
    return replace(scene, strokes=strokes)


def test_the_scenes_are_there_and_say_what_they_are():
    assert set(NAMES) >= EXPECTED
    for path in SCENE_FILES:
        assert path.read_text().startswith("# "), path.name


# Truth ---------------------------------------------------------------------------------------


def sliding_load(scene: Scene, beyond: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Share of the normal load that slides at every sample, and whether any element does.

    ``beyond`` is what share of the arm's speed it takes to count.
    """
    truth, (grasp, plan, _) = timeline(scene), insides(scene)
    grid = whole_grid(truth.num_samples)
    contact_of = scene_contact(scene, grasp, plan).on(grid)
    share = np.zeros(truth.num_samples)
    for element in grasp.touching.tolist():
        slides = contact_of(element).slide.reshape(-1)[: truth.num_samples] > beyond
        share += grasp.load_n[element] / grasp.load_n.sum() * slides
    return share, share > 0


@pytest.mark.parametrize(("name", "material"), CASES)
def test_truth_is_what_the_contact_does(name, material):
    scene = scene_of(name, material)
    truth = timeline(scene)
    share, any_slides = sliding_load(scene)
    assert truth.speeds_mm_s == tuple(s.speed_mm_s for s in scene.strokes if s.moves != "both")
    assert len(truth.onsets_s) == len(truth.sliding_s) == len(truth.annotated_onsets_s)
    assert len(truth.onsets_s) == len(truth.speeds_mm_s)
    changes = np.flatnonzero(np.diff(share >= 0.5 - 1e-12))  # last samples before each change
    edges = np.array(truth.sliding_s).reshape(-1) * 2000
    assert len(changes) == len(edges)
    np.testing.assert_allclose(changes + 1, edges, atol=1.5)
    quiet = is_within(truth.non_slip_s, truth.num_samples)
    assert not (quiet & any_slides).any()
    bounds = np.array(truth.non_slip_s).reshape(-1)
    assert np.all(np.diff(bounds) > 0)  # ascending, apart, none empty
    assert np.all((bounds >= 0) & (bounds <= truth.duration_s))


@pytest.mark.parametrize(("name", "rung"), ON_RUNGS)
def test_truth_is_what_the_contact_does_on_dynamic_rungs(name, rung):
    scene = short_on(rung, name, "M5")
    truth = timeline(scene)
    gross, _ = sliding_load(scene, beyond=0.5)
    _, any_slides = sliding_load(scene)
    speeds = () if name == "arm_motion" else (20.0, 40.0)
    assert truth.speeds_mm_s == speeds
    assert len(truth.onsets_s) == len(truth.sliding_s) == len(truth.annotated_onsets_s)
    assert len(truth.onsets_s) == len(speeds)
    assert any_slides.any() == bool(speeds)
    for speed, (start_s, end_s) in zip(speeds, truth.sliding_s, strict=True):
        within = gross[round(2000 * start_s) + 1 : round(2000 * end_s) - 1]
        assert len(within) > 0.4 * 20.0 / speed * 2000  # half of the way and more
        assert (within >= 0.5 - 1e-12).mean() > 0.9
    margin_s = 2 / 2000
    slides = [(start_s - margin_s, end_s + margin_s) for start_s, end_s in truth.sliding_s]
    assert gross[~is_within(slides, truth.num_samples)].max() < 0.5 + 1e-12
    quiet = is_within(truth.non_slip_s, truth.num_samples)
    assert quiet.any() == (name != "pulled")
    assert not (quiet & any_slides).any()


@pytest.mark.parametrize("rung", FIDELITIES)
def test_handling_keeps_clear_of_slides_on_every_rung(rung):
    strokes = (Stroke(40.0, 20.0, 1.0), Stroke(60.0, 30.0, 1.0, "both"), Stroke(40.0, 20.0, 0.6))
    handling = Handling(taps_per_s=4.0, grips_per_s=1.0, grip_s=(0.2, 0.4))
    scene = Scene("M6", strokes=strokes, handling=handling, fidelity=rung, tail_s=1.0)
    truth, (_, any_slides) = timeline(scene), sliding_load(scene)
    quiet = is_within(truth.non_slip_s, truth.num_samples)
    assert quiet.mean() > 0.2
    assert any_slides.mean() > 0.1
    assert not (quiet & any_slides).any()
    assert len(truth.onsets_s) == 2
    for start_s, end_s in truth.sliding_s:
        assert any_slides[round(2000 * start_s) : round(2000 * end_s)].mean() > 0.9


def test_scenes_that_handle_the_hand_say_where_and_the_others_do_not():
    handled = {name for name in NAMES if timeline(scene_of(name, "M3")).non_slip_s}
    without_strokes = {"held", "knocked"}
    assert handled == {"arm_motion", "taps", "grips"} | without_strokes
    for name in without_strokes:  # nothing slips in them, from end to end
        truth = timeline(scene_of(name, "M3"))
        assert truth.onsets_s == truth.arm_s == truth.sliding_s == ()
        assert truth.non_slip_s == ((0.0, truth.duration_s),)
    assert timeline(scene_of("arm_motion", "M3")).onsets_s == ()
    assert timeline(scene_of("pulled", "M3")).arm_s == ()


def test_a_carried_stretch_ends_before_a_slide_and_with_the_recording():
    carried, slide = Stroke(40.0, 20.0, 0.5, "both"), Stroke(40.0, 20.0, 0.1)
    scene = Scene("M3", strokes=(carried, slide, replace(carried, pause_s=1.0)))
    truth = timeline(scene)
    starts, stops = zip(*truth.arm_s, strict=True)
    assert truth.non_slip_s[0] == (starts[0], starts[1])
    assert truth.non_slip_s[1] == (starts[2], truth.duration_s)
    longer = timeline(replace(scene, tail_s=1.0, strokes=(carried, replace(slide, pause_s=1.0))))
    assert longer.non_slip_s == ((starts[0], stops[0] + 0.3),)


def test_a_recording_carries_the_truth_of_its_scene():
    for name in ("arm_motion", "taps", "pulled"):
        scene = scene_of(name, "wood")
        recording, truth = simulate(scene, windows=[]), timeline(scene)
        for field in ("onsets_s", "annotated_onsets_s", "sliding_s", "speeds_mm_s", "non_slip_s"):
            assert getattr(recording, field) == getattr(truth, field)
        assert recording.samples.shape == (24, truth.num_samples)
        assert recording.provenance["scene"] == name


def test_a_tail_is_rest_behind_the_last_stroke():
    scene = scene_of("arm_motion", "M2")
    longer = replace(scene, tail_s=scene.tail_s + 0.5)
    assert timeline(longer).num_samples == timeline(scene).num_samples + 1000
    assert timeline(longer).arm_s == timeline(scene).arm_s


# Bytes ---------------------------------------------------------------------------------------


def digest(scene: Scene) -> str:
    return hashlib.sha256(simulate(scene).samples.numpy().tobytes()).hexdigest()


@pytest.mark.parametrize(("name", "material"), CASES)
def test_windows_and_channels_equal_the_whole(name, material):
    assert_windows_equal_the_whole(scene_of(name, material, cycle=1))


@pytest.mark.parametrize(("name", "rung"), ON_RUNGS)
def test_windows_and_channels_equal_the_whole_on_dynamic_rungs(name, rung):
    assert_windows_equal_the_whole(short_on(rung, name, "M6", cycle=1))


def assert_windows_equal_the_whole(scene):
    truth, whole = timeline(scene), simulate(scene).samples
    middles = [0.5 * (start_s + end_s) for start_s, end_s in truth.non_slip_s[:2]]
    windows = [(at_s - 0.004, at_s + 0.013) for at_s in (*middles, *truth.onsets_s)]
    windows += [(0.0, 0.01), (3.333, 3.6), (truth.duration_s - 0.1, truth.duration_s)]
    names = ["SG2", "SG10", "PVDF1", "PVDF7"]
    part = simulate(scene, windows=windows, channels=names).samples
    asked = torch.zeros(whole.shape, dtype=torch.bool)
    for start_s, end_s in windows:
        asked[:, round(start_s * 2000) : round(end_s * 2000)] = True
    asked &= torch.tensor([channel in names for channel in scene.hand.names])[:, None]
    assert torch.equal(part[asked], whole[asked])
    assert part[~asked].isnan().all()
    assert whole.isfinite().all()


def test_same_bytes_in_another_order():
    scenes = [scene_of(name, material, cycle=1) for name, material in CASES]
    forward = [digest(scene) for scene in scenes]
    assert [digest(scene) for scene in reversed(scenes)] == forward[::-1]
    assert len(set(forward)) == len(scenes)


def test_scenes_are_plain_json_and_lose_nothing():
    for name in NAMES:
        scene = scene_of(name, "M4")
        assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene
        assert hash(scene) == hash(Scene.from_dict(scene.to_dict()))


def test_a_scene_of_another_name_is_another_draw_of_the_same_session():
    scene = scene_of("machine", "M1", burst_rate_hz=0.0)
    other = replace(scene, name="another")
    assert digest(scene) != digest(other)
    assert timeline(scene).onsets_s != timeline(other).onsets_s


@pytest.mark.parametrize("name", NAMES)
def test_any_material_takes_any_scene(name):
    for material in MATERIALS:
        scene = scene_of(name, material, cycle=2)
        recording = simulate(scene, windows=[(1.5, 1.7)], channels=["SG10", "PVDF7"])
        assert int(recording.samples.isfinite().sum()) == 2 * 400


def test_where_nothing_slides_all_rungs_are_one():
    bytes_of = {
        digest(scene_of("arm_motion", "M6", fidelity=rung))
        for rung in ("kinematic", "lugre", "patch")
    }
    assert len(bytes_of) == 1


def test_kinds_of_scenes_stand_beside_each_other_in_one_set():
    arm = [{"speed_mm_s": 40.0, "distance_mm": 20.0, "pause_s": 0.5, "moves": "both"}]
    source = SimulatedRecordings(
        cycles=1, materials=["M1"], others={"carried": {"strokes": arm, "tail_s": 0.5}}
    )
    paper, carried = source.ids
    assert source.timeline(carried).onsets_s == ()
    assert source.timeline(carried).non_slip_s[0][0] == 0.5
    assert len(source.timeline(paper).onsets_s) == 3
    assert source.load(carried).samples.isfinite().all()


def test_sessions_are_other_mountings_and_the_first_is_that_of_a_set_with_one():
    taps = {"taps": {"cycles": 1, "taps_per_s": 2.0}}
    kinds = {"cycles": 2, "materials": ["M1", "M2"], "others": taps}
    one, three = SimulatedRecordings(**kinds), SimulatedRecordings(sessions=3, **kinds)
    assert three.ids[: len(one.ids)] == one.ids
    assert [three.key(r) for r in one.ids] == [one.key(r) for r in one.ids]
    assert {r.session for r in three.ids} == {"", "2", "3"}
    assert len(three.ids) == len(set(map(str, three.ids))) == 3 * len(one.ids)
    scenes = {r: Scene.from_dict(three.key(r)) for r in three.ids}
    second = [scenes[RecordingId("M1", c, s, "2")] for c, s in ((0, "paper"), (0, "taps"))]
    assert len({scene.session for scene in second}) == 1  # all kinds in one mounting
    first = scenes[RecordingId("M1", 0)]
    fronts = [draw_front(scene) for scene in (first, *second)]
    noise = [front.white_v for front in fronts]
    assert np.array_equal(noise[1], noise[2])
    assert not np.isclose(noise[0], noise[1], rtol=1e-3).any()
    with pytest.raises(ValueError, match=r"data\.sessions must be at least 1, got 0"):
        SimulatedRecordings(sessions=0)


def test_nothing_of_a_mounting_is_kept_in_another_session():
    """Whatever is drawn for a session differs: levels of silence, pick-up, contact and skin."""
    grasps = [draw_grasp(Scene("M1", session=session)) for session in ("M1", "M1/2")]
    assert not np.isclose(grasps[0].resonance_hz, grasps[1].resonance_hz, rtol=1e-3).any()
    surfaces = [grasp.surface for grasp in grasps]
    for name in ("mu_s", "mu_ratio", "texture_mv", "wavelength_mm", "spectral_exponent"):
        assert getattr(surfaces[0], name) != getattr(surfaces[1], name)


# Refusals ------------------------------------------------------------------------------------

CARRY = (Stroke(40.0, 20.0, 0.5, "both"),)
AT_ONCE = (Stroke(40.0, 20.0, 0.5), Stroke(40.0, 20.0, 0.0, "both"))

BAD_SCENES = {
    r"faults names \['PVDF99'\], which this hand does not have": lambda: Scene(
        "M1", faults=Faults(dead=("PVDF99",))
    ),
    r"faults names \['X'\], which this hand": lambda: Scene(
        "M1", faults=Faults(swapped=(("X", "SG1"),))
    ),
    r"Faults names SG1 twice; a channel has one fault": lambda: Faults(
        dead=("SG1",), saturated=("SG1",)
    ),
    r"Faults\.swapped takes pairs of channels, got \('SG1', 'SG1'\)": lambda: Faults(
        swapped=(("SG1", "SG1"),)
    ),
    r"Faults\.drop_ms must be at most 200, got \(1\.0, 300\.0\)": lambda: Faults(
        drop_ms=(1.0, 300.0)
    ),
    r"Faults\.drops_per_s must be finite and not negative, got -1": lambda: Faults(drops_per_s=-1),
    r"Handling\.taps_per_s must be finite and not negative, got -1": lambda: Handling(
        taps_per_s=-1
    ),
    r"Handling\.carried_kg must be finite and not negative, got nan": lambda: Handling(
        carried_kg=float("nan")
    ),
    r"Handling\.tap_n must be \(low, high\), 0 < low <= high, got \(2, 1\)": lambda: Handling(
        tap_n=(2, 1)
    ),
    r"Stroke\.moves must be one of hand, object, both, got 'nobody'": lambda: Stroke(
        40.0, moves="nobody"
    ),
    r"tail_s must be finite and not negative, got -1": lambda: Scene("M1", tail_s=-1),
    r"no element in contact": lambda: scene_of("arm_motion", "M1", load_n=0.0),
    r"carrying 50 kg at 0\.5 m/s2 takes 25 N, more than half of the [\d.]+ N of static": lambda: (
        timeline(Scene("M1", strokes=CARRY, handling=Handling(carried_kg=50.0)))
    ),
    r"in stroke 2, and up to 1 may be left of the slide before: pause longer": lambda: simulate(
        Scene("M1", strokes=AT_ONCE), windows=[]
    ),
    r"no rest long enough for taps of up to 0\.04 s, 0\.1 s to settle and 0\.1 s": lambda: timeline(
        Scene("M1", strokes=(Stroke(40.0, 20.0, 0.2),), handling=Handling(taps_per_s=1.0))
    ),
    r"no rest long enough for grips of up to 1 s": lambda: timeline(
        Scene("M1", strokes=(Stroke(40.0, 20.0, 1.1),), handling=Handling(grips_per_s=1.0))
    ),
    r"machine_hz must lie below 27 Hz at 60 samples a second, got \(30, 50\)": lambda: simulate(
        scene_of("machine", "M1", machine_hz=(30, 50), sample_rate_hz=60.0)
    ),
}


@pytest.mark.parametrize("message", BAD_SCENES)
def test_bad_scenes_are_refused_in_one_line(message):
    with pytest.raises(ValueError, match=message) as refusal:
        BAD_SCENES[message]()
    assert "\n" not in str(refusal.value)


def test_what_is_refused_for_one_contact_passes_for_another():
    heavy = Handling(carried_kg=10.0)
    firm = Contact(load_n=5.0)
    with pytest.raises(ValueError, match="more than half"):
        timeline(Scene("M4", strokes=CARRY, handling=heavy))
    assert timeline(Scene("M4", strokes=CARRY, handling=heavy, contact=firm)).non_slip_s
    rested = (AT_ONCE[0], replace(AT_ONCE[1], pause_s=1.0))
    assert len(timeline(Scene("M1", strokes=rested)).non_slip_s) == 1
