"""Scenes and recordings: truth, the same bytes always, only what is asked for, clear refusals."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import CONTACTS, NAMES, contacts, is_within, scene_of, scene_on

from tactslip_torch.deploy.check import extreme_bins
from tactslip_torch.simulation import (
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Dynamics,
    Faults,
    Handling,
    Material,
    Scene,
    Sensors,
    Stroke,
    paper_scenes,
    simulate,
    simulate_many,
    timeline,
)
from tactslip_torch.simulation._contact import draw_grasp
from tactslip_torch.simulation.simulate import SimulatedRecordings

SHORT = (Stroke(40.0, 20.0, 0.6), Stroke(60.0, 20.0, 0.4))
"""Two short strokes: 1.9 s instead of 15.4."""


def digest(recording) -> str:
    return hashlib.sha256(recording.samples.numpy().tobytes()).hexdigest()


@pytest.mark.parametrize("model", CONTACTS)
def test_same_bytes_in_any_order_and_number(model):
    scenes = [scene_on(model, m, strokes=SHORT, seed=5) for m in ("M1", "M6", "iron")]
    forward = [digest(simulate(scene)) for scene in scenes]
    assert len(set(forward)) == 3
    assert [digest(simulate(scene)) for scene in reversed(scenes)] == forward[::-1]
    assert [digest(one) for one in simulate_many(scenes, at_once=2)] == forward


def short(name: str, material: str, model: str, cycle: int = 0) -> Scene:
    """A scene of a file with one of ``CONTACTS``; where bristles are, no longer than it must be."""
    scene = scene_of(name, material, cycle, **CONTACTS[model])
    if model == "kinematic":
        return replace(scene, tail_s=min(scene.tail_s, 10.0))
    return replace(scene, strokes=tuple(replace(s, distance_mm=20.0) for s in scene.strokes[:2]))


MODELS = [(name, "M3", "kinematic") for name in NAMES] + [("paper", "M6", "kinematic")]
MODELS += [(name, "M6", model) for name in ("pulled", "taps") for model in ("one", "many")]


@pytest.mark.parametrize(
    ("name", "material", "model"),
    [
        ("paper", "M6", "kinematic"),
        ("hard", "M3", "kinematic"),
        ("dropped_samples", "M3", "kinematic"),
        ("pulled", "M6", "one"),
        ("taps", "M6", "many"),
    ],
)
def test_windows_and_channels_equal_the_whole_recording(name, material, model):
    scene = short(name, material, model, cycle=1)
    truth, whole = timeline(scene), simulate(scene).samples
    middles = [0.5 * (start_s + end_s) for start_s, end_s in truth.non_slip_s[:2]]
    windows = [(at_s - 0.004, at_s + 0.013) for at_s in (*middles, *truth.onsets_s)]
    windows += [(2.333, 2.6), (0.0, 0.01), (2.5, 2.7)]  # in any order, overlapping
    windows += [(truth.duration_s - 0.1, truth.duration_s)]
    names = ["SG2", "SG10", "PVDF1", "PVDF7"]
    some = simulate(scene, windows=windows, channels=names).samples
    asked = torch.zeros(whole.shape, dtype=torch.bool)
    for start_s, end_s in windows:
        asked[:, round(start_s * 2000) : round(end_s * 2000)] = True
    asked &= torch.tensor([channel in names for channel in scene.hand.names])[:, None]
    assert torch.equal(some.isfinite(), asked)
    assert torch.equal(some[asked], whole[asked])
    assert whole.isfinite().all()
    assert whole.abs().max() <= 5.0


def assert_truth_is_the_contacts(scene: Scene) -> None:
    """Half of the load slides in each slide, and nothing does where the hand is handled."""
    truth, (states, _) = timeline(scene), contacts(scene)
    load, num = draw_grasp(scene).load_n, truth.num_samples
    beyond = 0.5 if scene.fidelity == "bristles" else 0.0
    sliding = sum(load[e] / load.sum() * (s.slide[:num] > beyond) for e, s in states.items())
    slides = np.any([state.slide[:num] > 0 for state in states.values()], axis=0)
    assert truth.speeds_mm_s == tuple(s.speed_mm_s for s in scene.strokes if s.moves != "both")
    assert len(truth.onsets_s) == len(truth.sliding_s) == len(truth.annotated_onsets_s)
    assert len(truth.onsets_s) == len(truth.speeds_mm_s)
    for onset_s, (first_s, last_s) in zip(truth.onsets_s, truth.released_s, strict=True):
        assert first_s < onset_s <= last_s
    for start_s, end_s in truth.sliding_s:
        within = sliding[round(2000 * start_s) + 2 : round(2000 * end_s) - 2]
        assert (within >= 0.5 - 1e-12).mean() > (0.7 if scene.material == "M6" else 0.95)
    around = [(start_s - 1e-3, end_s + 1e-3) for start_s, end_s in truth.sliding_s]
    assert sliding[~is_within(around, num)].max() < 0.5 + 1e-12
    assert not (is_within(truth.non_slip_s, num) & slides).any()
    bounds = np.array(truth.non_slip_s).reshape(-1)
    assert np.all(np.diff(bounds) > 0)  # ascending, apart, none empty
    assert np.all((bounds >= 0) & (bounds <= truth.duration_s))


@pytest.mark.parametrize(("name", "material", "model"), MODELS)
def test_truth_is_what_the_contact_does(name, material, model):
    assert_truth_is_the_contacts(short(name, material, model))


def test_a_recording_carries_truth_and_provenance_and_the_dtype_asked_for():
    scene = Scene("copper", seed=3, cycle=7, strokes=SHORT)
    truth, double = timeline(scene), simulate(scene, dtype=torch.float64)
    assert double.samples.shape == (24, truth.num_samples)
    names = ("onsets_s", "annotated_onsets_s", "sliding_s", "speeds_mm_s", "non_slip_s")
    for name in (*names, "released_s"):
        assert getattr(double, name) == getattr(truth, name)
    stated = {"simulated": True, "fidelity": "kinematic", "seed": 3, "cycle": 7, "scene": "paper"}
    assert stated.items() <= double.provenance.items()
    assert "integrator" not in double.provenance
    single = simulate(scene).samples
    assert single.dtype == torch.float32
    assert torch.equal(single, double.samples.float())
    steps = double.samples / (10.0 / 2**16)
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)


def test_a_scenes_dictionary_is_plain_json_and_loses_nothing():
    scene = Scene(
        "wood",
        strokes=SHORT,
        contact=Contact(touching=("SG1",), presliding_mm=(0.1, 0.7), mu_s=0.4, mu_k=0.3),
        sensors=Sensors(num_bits=12),
        disturbances=Disturbances(burst_rate_hz=1.5, motor_vibration_mv=(1.0, 2.0)),
        faults=Faults(swapped=(("SG1", "SG2"),)),
        seed=2,
        session=9,
    )
    plain = json.loads(json.dumps(scene.to_dict()))
    assert plain == scene.to_dict()
    assert "imperfections" not in plain
    assert Scene.from_dict(plain) == scene
    assert hash(Scene.from_dict(plain)) == hash(scene)
    hard = scene_of("hard", "M1")
    assert Scene.from_dict(hard.to_dict()) == hard


def test_paper_scenes_are_the_protocol_and_take_flat_overrides():
    scenes = paper_scenes(
        friction_noise_mv=3, presliding_mm=[0.2, 2.0], burst_rate_hz=0.1, sensors={"num_bits": 12}
    )
    assert [s.material for s in scenes[::28]] == list(SEEN_MATERIALS + UNSEEN_MATERIALS)
    assert [s.cycle for s in scenes[:28]] == list(range(28))
    strokes = [(s.speed_mm_s, s.distance_mm, s.pause_s) for s in scenes[0].strokes]
    assert strokes == [(20, 100, 2), (40, 100, 2), (60, 100, 2)]
    assert scenes[0].contact == Contact(friction_noise_mv=3, presliding_mm=(0.2, 2.0))
    assert scenes[0].disturbances.burst_rate_hz == 0.1
    assert scenes[0].sensors.num_bits == 12


# --- sets ---------------------------------------------------------------------------------------


# --- what is refused ----------------------------------------------------------------------------

CARRY = (Stroke(40.0, 20.0, 0.5, "both"),)
SOFT = Contact(
    presliding_mm=(0.3, 0.3),
    relaxation=(1.0, 1.0),
    relaxation_time_s=(0.2, 0.2),
    touching=("PVDF7", "PVDF9"),
)
AT_ONCE = (Stroke(40.0, 20.0, 0.5), Stroke(40.0, 20.0, 0.0, "both"))


def scene(**values):
    return lambda: Scene("M1", **{"strokes": SHORT, **values})


def group(kind, **values):
    return lambda: kind(**values)


def recording(**values):
    return lambda: simulate(Scene("M1", strokes=SHORT), **values)


def truth(**values):
    return lambda: timeline(Scene("M1", **values))


def bristles(**values):
    return lambda: timeline(scene_on("one", "M2", **values))


def surface(mu_s, mu_ratio):
    return lambda: Material("x", mu_s, (1, 2), 10.0, mu_ratio=mu_ratio)


REFUSED = [
    (lambda: Scene("M7"), r"unknown material 'M7'; known are M1, .*wood"),
    (scene(fidelity="lugre"), r"unknown fidelity 'lugre'; known are kinematic, bristles$"),
    (scene(sample_rate_hz=0), r"sample_rate_hz must be positive and finite, got 0"),
    (scene(acceleration_m_s2=-1.0), r"acceleration_m_s2 must be positive"),
    (scene(tail_s=-1), r"tail_s must be finite and not negative, got -1"),
    (scene(strokes=()), r"a scene needs a stroke, or a tail_s to rest for; it has neither"),
    (scene(strokes=(Stroke(9, 2),)), r"stroke 1 of 2 mm is too short to slip surely"),
    (scene(contact=Contact(mu_k=2.0)), r"mu_k must not exceed mu_s, got 2\.0 above M1's 0\.8"),
    (
        scene(contact=Contact(touching=("SG1",), finger_loads=(("little", 0.0),))),
        r"no element in contact: every element that may touch has zero load",
    ),
    (scene(contact=Contact(touching=("SG99",))), r"contact\.touching names \['SG99'\], which this"),
    (scene(faults=Faults(dead=("PVDF99",))), r"faults names \['PVDF99'\], which this hand does"),
    (scene(faults=Faults(swapped=(("X", "SG1"),))), r"faults names \['X'\], which this hand"),
    (group(Stroke, speed_mm_s=-3.0), r"Stroke\.speed_mm_s must be .*, got -3"),
    (group(Stroke, speed_mm_s=3, distance_mm=0), r"Stroke\.distance_mm must be positive, got 0"),
    (group(Stroke, speed_mm_s=3, pause_s=-1), r"Stroke\.pause_s must be finite and not neg.*-1"),
    (group(Stroke, speed_mm_s=4, moves="it"), r"moves must be one of hand, object, both, got 'it'"),
    (group(Contact, mu_s=-0.2), r"Contact\.mu_s must be finite and not negative, got -0\.2"),
    (group(Contact, mu_s=0.5, mu_k=0.6), r"mu_k must not exceed mu_s, got mu_k=0\.6 and mu_s=0\.5"),
    (group(Contact, lifted_fraction=1), r"lifted_fraction must be below 1, or no element is in"),
    (group(Contact, touching=()), r"touching must be null or some channels, or no element"),
    (group(Contact, load_n=0), r"load_n must be positive, or no element is in contact, got 0"),
    (group(Contact, presliding_mm=(3.0, 0.3)), r"Contact\.presliding_mm must be \(low, high\)"),
    (group(Contact, relaxation=(0.5, 1.5)), r"Contact\.relaxation must be at most 1"),
    (group(Sensors, num_bits=1), r"Sensors\.num_bits must be 2 to 32, got 1"),
    (group(Sensors, pvdf_highpass_hz=0.66), r"pvdf_highpass_hz must be at least 2, .* got 0\.66"),
    (group(Sensors, rail_v=0.0), r"Sensors\.rail_v must be positive, got 0"),
    (group(Disturbances, burst_rate_hz=float("nan")), r"burst_rate_hz must be finite .* got nan"),
    (group(Handling, tap_n=(2, 1)), r"tap_n must be \(low, high\), 0 < low <= high, got \(2, 1\)"),
    (group(Faults, dead=("SG1",), saturated=("SG1",)), r"names SG1 twice; a channel has one fault"),
    (group(Faults, swapped=[["SG1", "SG1"]]), r"swapped must be pairs of channels, got \(\('SG1'"),
    (group(Faults, drop_ms=(1.0, 300.0)), r"drop_ms must be at most 200, got \(1\.0, 300\.0\)"),
    (group(Dynamics, step_us=0.0), r"Dynamics\.step_us must be in \(0, 5000\], got 0"),
    (group(Dynamics, num_bristles=1.5), r"num_bristles must be a whole number of 1 or more"),
    (surface(-1, (0.8, 0.9)), r"x: expected mu_s > 0 and mu_ratio .* got -1 and \(0\.8, 0\.9\)"),
    (surface(1, (0.8, 1.2)), r"x: .* 0 < low <= high <= 1, got 1 and \(0\.8, 1\.2\)"),
    (
        truth(strokes=CARRY, handling=Handling(carried_kg=50.0)),
        r"carrying 50 kg at 0\.5 m/s2 takes 25 N, more than half of the [\d.]+ N of static",
    ),
    (truth(strokes=AT_ONCE), r"in stroke 2, and up to 1 may be left of the slide before: pause"),
    (
        truth(strokes=(Stroke(40.0, 20.0, 0.2),), handling=Handling(taps_per_s=1.0)),
        r"no rest long enough for taps of up to 0\.04 s, 0\.1 s to settle and 0\.1 s",
    ),
    (
        truth(strokes=(Stroke(40.0, 20.0, 1.1),), handling=Handling(grips_per_s=1.0)),
        r"no rest long enough for grips of up to 1 s",
    ),
    (
        lambda: simulate(scene_of("machine", "M1", machine_hz=(30, 50), sample_rate_hz=60.0)),
        r"machine_hz must lie below 27 Hz at 60 samples a second, got \(30, 50\)",
    ),
    (bristles(step_us=300.0), r"^a whole number of steps .* take 250$"),
    (bristles(step_us=1000.0), r"^a whole number of steps .* take 500$"),
    # a skin that relaxes altogether gives way to so slow an arm faster than it is stretched
    (
        bristles(strokes=(Stroke(0.4, 0.8, 0.1),), contact=SOFT),
        r"^stroke 1 never slides: .* 0 % of the load let go",
    ),
    (recording(windows=[(-0.1, 0.5)]), r"within the recording, 0 <= start < end .* \(-0\.1, 0\.5"),
    (recording(windows=[(1.0, 99.0)]), r"within the recording, .* got \(1, 99\)"),
    (recording(windows=[(1.0, 1.0)]), r"within the recording, .* got \(1, 1\)"),
    (recording(windows=[(0.0, float("nan"))]), r"a window must be finite, got \(0\.0, nan\)"),
    (recording(channels=["SG1", "SG15"]), r"unknown channels SG15; this hand has SG1, .*PVDF10"),
    (recording(dtype=torch.int64), r"dtype must be floating, got torch\.int64"),
    (lambda: paper_scenes(burst_rate=1), r"unknown override burst_rate; a scene has .*strokes"),
    (lambda: paper_scenes(cycles=0), r"cycles must be a whole number of at least 1, got 0"),
    (lambda: SimulatedRecordings(sessions=0), r"data\.sessions must be at least 1, got 0"),
    (lambda: simulate_many([], at_once=0), r"at_once must be at least 1, got 0"),
    (lambda: simulate_many([], windows=[None]), r"expected windows of each of 0 scenes, got 1"),
    (
        lambda: extreme_bins("quiet", (100,), torch.Generator()),
        r"kind must be one of plain, .* got 'quiet'",
    ),
    (lambda: extreme_bins("plain", (3, 1), torch.Generator()), r"two samples, got shape \(3, 1\)"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_cannot_be_is_refused_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as refusal:
        call()
    assert "\n" not in str(refusal.value)


# --- generated extremes -------------------------------------------------------------------------
