"""Scenes and recordings: the same bytes always, only what is asked for, and clear refusals."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.simulation import (
    MATERIALS,
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Material,
    Scene,
    Sensors,
    Stroke,
    paper_scenes,
    simulate,
    timeline,
)

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


def test_another_seed_session_or_cycle_is_another_recording():
    scene = Scene("M2", strokes=SHORT)
    others = [replace(scene, **change) for change in ({"seed": 1}, {"session": "x"}, {"cycle": 1})]
    assert len({digest(s) for s in [scene, *others]}) == 4


def test_a_session_keeps_its_mounting_and_a_recording_grasps_anew():
    from tactslip_torch.simulation.grasp import draw_grasp

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


def test_no_window_or_no_channel_gives_no_sample():
    scene = Scene("M1", strokes=SHORT)
    assert simulate(scene, windows=[]).samples.isnan().all()
    assert simulate(scene, channels=[]).samples.isnan().all()


def test_elements_out_of_contact_get_no_friction(monkeypatch):
    module = sys.modules["tactslip_torch.simulation.simulate"]  # its package name is the function
    computed = []
    real = module.element_vibration
    monkeypatch.setattr(
        module, "element_vibration", lambda *args: computed.append(args[-1]) or real(*args)
    )
    contact = Contact(touching=("SG1", "PVDF7"), lifted_fraction=0.0)
    recording = simulate(Scene("M1", strokes=SHORT, contact=contact))
    assert computed == [0, 9]  # little distal and index distal
    start_s, end_s = recording.sliding_s[0]
    slide = recording.samples[14:, round(2000 * start_s) + 200 : round(2000 * end_s)]
    felt = slide.std(-1) > 0.03
    assert felt.tolist() == [i in (0, 6) for i in range(10)]


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


BAD_SCENES = {
    r"unknown material 'M7'; known are M1, .*wood": lambda: Scene("M7"),
    r"unknown fidelity 'fast'; there is kinematic, lugre, patch": lambda: Scene(
        "M1", fidelity="fast"
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
    r"no element in contact: touching names no channel": lambda: Contact(touching=()),
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
}


@pytest.mark.parametrize("message", BAD_SCENES)
def test_bad_scenes_are_refused_in_one_line(message):
    with pytest.raises(ValueError, match=message) as refusal:
        BAD_SCENES[message]()
    assert "\n" not in str(refusal.value)


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


def test_every_material_of_the_table_simulates():
    assert tuple(MATERIALS) == SEEN_MATERIALS + UNSEEN_MATERIALS
    for material in MATERIALS:
        assert simulate(Scene(material, strokes=SHORT[:1])).samples.isfinite().all()
