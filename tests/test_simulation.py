"""Scenes and recordings: truth, the same bytes always, only what is asked for, clear refusals."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import (
    CONTACTS,
    NAMES,
    RATE_HZ,
    contacts,
    insides,
    is_within,
    scene_of,
    scene_on,
)

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.simulation import (
    MATERIALS,
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Faults,
    Handling,
    Material,
    Scene,
    Sensors,
    Stroke,
    paper_scenes,
    simulate,
    timeline,
)
from tactslip_torch.simulation.grasp import draw_grasp
from tactslip_torch.simulation.sensors import draw_front
from tactslip_torch.simulation.source import SimulatedRecordings

SHORT = (Stroke(40.0, 20.0, 0.6), Stroke(60.0, 20.0, 0.4))
"""Two short strokes: 1.9 s instead of 15.4."""


def short_scenes() -> list[Scene]:
    return paper_scenes(cycles=2, materials=("M1", "M6", "iron"), strokes=SHORT, seed=5)


def digest(scene: Scene) -> str:
    return hashlib.sha256(simulate(scene).samples.numpy().tobytes()).hexdigest()


def test_same_seed_same_bytes_in_any_order_and_in_a_fresh_process():
    scenes = short_scenes()
    forward = [digest(scene) for scene in scenes]
    assert [digest(scene) for scene in reversed(scenes)] == forward[::-1]
    assert len(set(forward)) == len(scenes)
    program = (
        "import json, sys, hashlib\n"
        "from tactslip_torch.simulation import Scene, simulate\n"
        "scene = Scene.from_dict(json.loads(sys.stdin.read()))\n"
        "print(hashlib.sha256(simulate(scene).samples.numpy().tobytes()).hexdigest())\n"
    )
    fresh = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(scenes[3].to_dict()),
        capture_output=True,
        text=True,
        check=True,
    )
    assert fresh.stdout.strip() == forward[3]


def test_a_session_keeps_its_mounting_and_a_recording_grasps_anew():
    first, second = (draw_grasp(Scene("M3", cycle=cycle)) for cycle in (0, 1))
    other = draw_grasp(Scene("M3", session="another"))
    np.testing.assert_array_equal(first.resonance_hz, second.resonance_hz)
    assert not np.array_equal(first.resonance_hz, other.resonance_hz)
    assert not np.array_equal(first.load_n, second.load_n)
    same_mounting = draw_grasp(Scene("iron", session="M3"))
    np.testing.assert_array_equal(first.resonance_hz, same_mounting.resonance_hz)


@pytest.mark.parametrize("material", ["M2", "M6"])
def test_windows_and_channels_equal_the_whole_recording(material):
    scene = Scene(material, cycle=2)
    whole = simulate(scene).samples
    onset_s = timeline(scene).onsets_s[1]
    windows = [(0.0, 0.1), (onset_s - 0.3, onset_s + 0.4), (15.0, timeline(scene).duration_s)]
    names = ["SG2", "SG10", "PVDF4", "PVDF7"]
    part = simulate(scene, windows=windows, channels=names).samples
    asked = torch.zeros(whole.shape, dtype=torch.bool)
    for start_s, end_s in windows:
        asked[:, round(start_s * 2000) : round(end_s * 2000)] = True
    asked &= torch.tensor([name in names for name in scene.hand.names])[:, None]
    assert torch.equal(part[asked], whole[asked])
    assert part[~asked].isnan().all()
    assert whole.isfinite().all()


def test_overlapping_and_unordered_windows_are_their_union():
    scene = Scene("M1", strokes=SHORT)
    samples = simulate(scene, windows=[(1.0, 1.2), (0.2, 0.3), (1.1, 1.4)]).samples
    asked = torch.zeros(samples.shape[1], dtype=torch.bool)
    asked[400:600] = asked[2000:2800] = True
    assert torch.equal(samples.isfinite().all(0), asked)
    assert torch.equal(samples[:, asked], simulate(scene).samples[:, asked])


def test_dtype_is_honoured_and_the_values_are_the_same():
    scene = Scene("M5", strokes=SHORT)
    double = simulate(scene, dtype=torch.float64).samples
    assert double.dtype == torch.float64
    single = simulate(scene).samples
    assert single.dtype == torch.float32
    assert torch.equal(single, double.float())
    steps = double / (10.0 / 2**16)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"dtype must be floating, got torch\.int64"):
        simulate(scene, dtype=torch.int64)


def test_recording_carries_truth_and_provenance():
    scene = Scene("copper", seed=3, cycle=7, strokes=SHORT)
    recording, truth = simulate(scene, windows=[]), timeline(scene)
    assert recording.samples.shape == (24, truth.num_samples)
    assert recording.onsets_s == truth.onsets_s
    assert recording.annotated_onsets_s == truth.annotated_onsets_s
    assert recording.sliding_s == truth.sliding_s
    assert recording.speeds_mm_s == (40.0, 60.0)
    stated = {"simulated": True, "fidelity": "kinematic", "seed": 3, "material": "copper"}
    assert stated.items() <= recording.provenance.items()
    assert recording.provenance["cycle"] == 7


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0, 8000.0])
def test_other_rates_tell_the_same_story(rate_hz):
    scene = Scene("M2", strokes=SHORT, sample_rate_hz=rate_hz, contact=Contact(lifted_fraction=0))
    recording = simulate(scene, channels=["PVDF7"], dtype=torch.float64)
    assert recording.onsets_s == timeline(replace(scene, sample_rate_hz=2000.0)).onsets_s
    film = recording.samples[20]
    onset = round(recording.onsets_s[0] * rate_hz)
    burst = film[onset : onset + round(0.05 * rate_hz)].abs().max()
    assert burst > 5 * film[: onset - round(0.2 * rate_hz)].abs().max()


def test_other_hands_work():
    hand = HandLayout(
        (Channel("tip", "PVDF", "left", "pad"), Channel("root", "SG", "right", "pad"))
    )
    recording = simulate(Scene("M1", hand, strokes=SHORT), channels=["tip"])
    assert recording.samples.isfinite().all(1).tolist() == [True, False]


def test_scene_dict_is_plain_json_and_loses_nothing():
    scene = Scene(
        "wood",
        strokes=SHORT,
        contact=Contact(touching=("SG1",), presliding_mm=(0.1, 0.7), mu_s=0.4, mu_k=0.3),
        sensors=Sensors(num_bits=12),
        disturbances=Disturbances(burst_rate_hz=1.5),
        seed=2,
        session=9,
    )
    plain = json.loads(json.dumps(scene.to_dict()))
    assert plain == scene.to_dict()
    assert Scene.from_dict(plain) == scene
    assert hash(Scene.from_dict(plain)) == hash(scene)
    assert digest(Scene.from_dict(plain)) == digest(scene)


def test_paper_scenes_are_the_protocol_and_take_flat_overrides():
    scenes = paper_scenes(
        friction_noise_mv=3, presliding_mm=[0.2, 2.0], burst_rate_hz=0.1, sensors={"num_bits": 12}
    )
    assert [s.material for s in scenes[::28]] == list(SEEN_MATERIALS + UNSEEN_MATERIALS)
    assert [s.cycle for s in scenes[:28]] == list(range(28))
    assert [(s.speed_mm_s, s.distance_mm, s.pause_s) for s in scenes[0].strokes] == [
        (20, 100, 2),
        (40, 100, 2),
        (60, 100, 2),
    ]
    assert scenes[0].contact == Contact(friction_noise_mv=3, presliding_mm=(0.2, 2.0))
    assert scenes[0].disturbances.burst_rate_hz == 0.1
    assert scenes[0].sensors.num_bits == 12
    with pytest.raises(ValueError, match=r"unknown override burst_rate; a scene has .*strokes"):
        paper_scenes(burst_rate=1)
    with pytest.raises(ValueError, match="cycles must be at least 1, got 0"):
        paper_scenes(cycles=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"windows": [(-0.1, 0.5)]},
            r"within the recording, 0 <= start < end .* got \(-0\.1, 0\.5",
        ),
        ({"windows": [(1.0, 99.0)]}, r"within the recording, .* got \(1, 99\)"),
        ({"windows": [(1.0, 1.0)]}, r"within the recording, .* got \(1, 1\)"),
        ({"windows": [(0.0, float("nan"))]}, r"a window must be finite, got \(0\.0, nan\)"),
        ({"channels": ["SG1", "SG15"]}, r"unknown channels SG15; this hand has SG1, .*PVDF10"),
    ],
)
def test_bad_requests_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        simulate(Scene("M1", strokes=SHORT), **arguments)


MODELS = [(name, material, model) for name in NAMES for material, model in (("M3", "kinematic"),)]
MODELS += [(name, "M6", model) for name in ("pulled", "arm_motion", "taps") for model in CONTACTS]


def short(name: str, material: str, model: str, cycle: int = 0) -> Scene:
    """A scene of a file with one of ``CONTACTS``; where bristles are, no longer than it must be."""
    scene = scene_of(name, material, cycle, **CONTACTS[model])
    if model == "kinematic":
        return scene
    return replace(scene, strokes=tuple(replace(s, distance_mm=20.0) for s in scene.strokes[:2]))


def assert_truth_is_the_contacts(scene: Scene) -> None:
    """Half of the load slides in each slide, and nothing does where the hand is handled."""
    truth, (states, _) = timeline(scene), contacts(scene)
    load = insides(scene)[0].load_n
    num = truth.num_samples
    beyond = 0.5 if scene.fidelity == "bristles" else 0.0
    share = sum(load[e] / load.sum() * (s.slide[:num] > beyond) for e, s in states.items())
    slides = np.any([state.slide[:num] > 0 for state in states.values()], axis=0)
    assert truth.speeds_mm_s == tuple(s.speed_mm_s for s in scene.strokes if s.moves != "both")
    assert len(truth.onsets_s) == len(truth.sliding_s) == len(truth.annotated_onsets_s)
    assert len(truth.onsets_s) == len(truth.speeds_mm_s)
    for start_s, end_s in truth.sliding_s:
        within = share[round(2000 * start_s) + 2 : round(2000 * end_s) - 2]
        assert (within >= 0.5 - 1e-12).mean() > (0.7 if scene.material == "M6" else 0.95)
    around = [(start_s - 1e-3, end_s + 1e-3) for start_s, end_s in truth.sliding_s]
    assert share[~is_within(around, num)].max() < 0.5 + 1e-12
    assert not (is_within(truth.non_slip_s, num) & slides).any()
    bounds = np.array(truth.non_slip_s).reshape(-1)
    assert np.all(np.diff(bounds) > 0)  # ascending, apart, none empty
    assert np.all((bounds >= 0) & (bounds <= truth.duration_s))


@pytest.mark.parametrize(("name", "material", "model"), MODELS)
def test_truth_is_what_the_contact_does(name, material, model):
    assert_truth_is_the_contacts(short(name, material, model))


@pytest.mark.parametrize("model", CONTACTS)
def test_handling_keeps_clear_of_slides(model):
    strokes = (Stroke(40.0, 20.0, 1.0), Stroke(60.0, 30.0, 1.0, "both"), Stroke(40.0, 20.0, 0.6))
    handling = {"taps_per_s": 4.0, "grips_per_s": 1.0, "grip_s": (0.2, 0.4)}
    scene = scene_on(model, "M5", strokes=strokes, tail_s=1.0, **handling)
    assert_truth_is_the_contacts(scene)
    truth = timeline(scene)
    assert is_within(truth.non_slip_s, truth.num_samples).mean() > 0.2
    assert len(truth.onsets_s) == 2


@pytest.mark.parametrize(("name", "material", "model"), MODELS)
def test_windows_and_channels_equal_the_whole_of_any_scene(name, material, model):
    assert_windows_equal_the_whole(short(name, material, model, cycle=1))


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


CARRY = (Stroke(40.0, 20.0, 0.5, "both"),)

AT_ONCE = (Stroke(40.0, 20.0, 0.5), Stroke(40.0, 20.0, 0.0, "both"))


def test_what_is_refused_for_one_contact_passes_for_another():
    heavy = Handling(carried_kg=10.0)
    firm = Contact(load_n=5.0)
    with pytest.raises(ValueError, match="more than half"):
        timeline(Scene("M4", strokes=CARRY, handling=heavy))
    assert timeline(Scene("M4", strokes=CARRY, handling=heavy, contact=firm)).non_slip_s
    rested = (AT_ONCE[0], replace(AT_ONCE[1], pause_s=1.0))
    assert len(timeline(Scene("M1", strokes=rested)).non_slip_s) == 1


BAD_SCENES = {
    r"unknown material 'M7'; known are M1, .*wood": lambda: Scene("M7"),
    r"unknown fidelity 'fast'; there is kinematic, bristles$": lambda: Scene("M1", fidelity="fast"),
    r"unknown fidelity 'lugre'; .* take bristles with num_bristles=1": lambda: Scene(
        "M1", fidelity="lugre"
    ),
    r"sample_rate_hz must be positive and finite, got 0": lambda: Scene("M1", sample_rate_hz=0),
    r"acceleration_m_s2 must be positive": lambda: Scene("M1", acceleration_m_s2=-1.0),
    r"a scene needs a stroke, or a tail_s to rest for; it has neither": lambda: Scene(
        "M1", strokes=()
    ),
    r"stroke 1 of 2 mm is too short to slip surely": lambda: Scene("M1", strokes=(Stroke(9, 2),)),
    r"Stroke\.speed_mm_s must be positive and finite, got -3": lambda: Stroke(-3.0),
    r"Stroke\.distance_mm must be positive and finite, got 0": lambda: Stroke(3.0, 0),
    r"Stroke\.pause_s must be finite and not negative, got -1": lambda: Stroke(3.0, 10, -1),
    r"Contact\.mu_s must be finite and not negative, got -0\.2": lambda: Contact(mu_s=-0.2),
    r"mu_k must not exceed mu_s, got mu_k=0\.6 and mu_s=0\.5": lambda: Contact(mu_s=0.5, mu_k=0.6),
    r"mu_k must not exceed mu_s, got 2\.0 above M1's 0\.8": lambda: Scene(
        "M1", contact=Contact(mu_k=2.0)
    ),
    r"x: mu_s must be positive, got -1": lambda: Material(
        "x", -1, (0.8, 0.9), (1, 2), None, 0.1, 0.0, 10.0, "smooth"
    ),
    r"x: mu_k must not exceed mu_s, got a ratio mu_k/mu_s of up to 1\.2": lambda: Material(
        "x", 1, (0.8, 1.2), (1, 2), None, 0.1, 0.0, 10.0, "smooth"
    ),
    r"no element in contact: lifted_fraction must be below 1": lambda: Contact(lifted_fraction=1),
    r"no element in contact: touching must be null or some channels": lambda: Contact(touching=()),
    r"no element in contact: load_n must be positive": lambda: Contact(load_n=0),
    r"no element in contact: every element that may touch has zero load": lambda: Scene(
        "M1", contact=Contact(touching=("SG1",), finger_loads=(("little", 0.0),))
    ),
    r"contact\.touching names \['SG99'\], which this hand": lambda: Scene(
        "M1", contact=Contact(touching=("SG99",))
    ),
    r"Contact\.presliding_mm must be \(low, high\)": lambda: Contact(presliding_mm=(3.0, 0.3)),
    r"Contact\.relaxation must be at most 1": lambda: Contact(relaxation=(0.5, 1.5)),
    r"Sensors\.num_bits must be 2 to 32, got 1": lambda: Sensors(num_bits=1),
    r"Sensors\.pvdf_highpass_hz must be at least 2, .* got 0\.66": lambda: Sensors(
        pvdf_highpass_hz=0.66
    ),
    r"Sensors\.rail_v must be positive, got 0": lambda: Sensors(rail_v=0.0),
    r"burst_rate_hz must be finite and not negative, got nan": lambda: Disturbances(
        burst_rate_hz=float("nan")
    ),
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


def test_no_channel_is_ever_silent_and_none_leaves_the_rails():
    samples = simulate(Scene("M6", cycle=4)).samples
    bins = samples[:, : samples.shape[1] // 100 * 100].unflatten(-1, (-1, 100))
    assert bins.std(-1).min() > 5e-5
    assert samples.abs().max() <= 5.0


def test_texture_frequency_is_speed_over_wavelength():
    # Lines of M3's weave: the power spectrum over *travel* peaks at the same wavelength at
    # every speed, so its frequency grows in proportion to speed.
    contact = Contact(lifted_fraction=0.0, friction_noise_mv=0.0, texture_scale=10.0)
    quiet = Disturbances(mains_mv=0.0, arm_transient_mv=0.0, burst_rate_hz=0.0)
    scene = Scene("M3", contact=contact, disturbances=quiet, cycle=1)
    recording = simulate(scene, channels=["PVDF7", "PVDF8"])
    peaks_hz = []
    for start_s, end_s in recording.sliding_s:
        first, last = round((start_s + 0.2) * RATE_HZ), round((end_s - 0.2) * RATE_HZ)
        x = recording.samples[20:22, first:last].double().numpy()
        power = np.abs(np.fft.rfft(x * np.hanning(x.shape[1]))) ** 2
        hertz = np.fft.rfftfreq(x.shape[1], 1 / RATE_HZ)
        power = power.sum(0) * (hertz > 8)
        peaks_hz.append(np.sum(hertz * power**2) / np.sum(power**2))
    wavelengths_mm = np.array([20, 40, 60]) / np.array(peaks_hz)
    assert np.all((wavelengths_mm > 0.4) & (wavelengths_mm < 1.8))
    assert peaks_hz[0] < 0.7 * peaks_hz[1] < 0.7 * peaks_hz[2]


@pytest.mark.parametrize("message", BAD_SCENES)
def test_bad_scenes_are_refused_in_one_line(message):
    with pytest.raises(ValueError, match=message) as refusal:
        BAD_SCENES[message]()
    assert "\n" not in str(refusal.value)
