"""Carrying, tapping, gripping, pulling: what each does to the channels, and where it stops.

Statistics with thresholds that the scene meets and the same scene without its knob does not.
"""

from dataclasses import replace

import numpy as np
import pytest
from scene_files import (
    FINE,
    RATE_HZ,
    STILL,
    difference,
    insides,
    is_within,
    part,
    rms,
    scene_of,
    volts,
    whole_grid,
)
from scipy.signal import butter, sosfiltfilt

from tactslip_torch.simulation import Handling, Scene, Stroke, timeline
from tactslip_torch.simulation.events import MARGIN_S, quiet_stretches
from tactslip_torch.simulation.ladder import scene_contact
from tactslip_torch.simulation.sensors import draw_front

TWO = ("M3", "M6")
GAUGES, FILMS = slice(0, 14), slice(14, 24)
CALM = {"burst_rate_hz": 0.0, "mains_mv": 0.0, "sg_drift_mv": 0.0, "pvdf_drift_mv": 0.0}
SURE = {**CALM, "lifted_fraction": 0.0}


def highpassed(samples: np.ndarray, corner_hz: float) -> np.ndarray:
    return sosfiltfilt(butter(4, corner_hz, "high", fs=RATE_HZ, output="sos"), samples)


# The arm -------------------------------------------------------------------------------------


def least_jolt(scene: Scene) -> float:
    """Arm starts over the rest before them: the channel and stroke that feels least."""
    samples = volts(scene)
    return min(
        float(np.min(rms(part(samples, start_s, start_s + 0.2)) / rms(part(samples, 0.2, 1.0))))
        for start_s, _ in timeline(scene).arm_s
    )


def slip_vibration(scene: Scene) -> float:
    """Films in the steady part of the last stroke over rest, high band, the median film."""
    samples = highpassed(volts(scene)[FILMS], 100.0)
    stroke = insides(scene)[1][-1]
    steady = part(samples, stroke.start_s + 0.5, stroke.stop_s - 0.15)
    return float(np.median(rms(steady) / rms(part(samples, 0.2, 1.0))))


def moving(scene: Scene, moves: str) -> Scene:
    return replace(scene, strokes=tuple(replace(s, moves=moves) for s in scene.strokes))


@pytest.mark.parametrize("material", TWO)
def test_a_moved_arm_jolts_every_channel_and_no_slip_is_heard(material):
    scene = scene_of("arm_motion", material, **SURE)
    assert least_jolt(scene) > 2.0
    assert least_jolt(scene_of("arm_motion", material, arm_transient_mv=0.0, **SURE)) < 1.5
    quiet_arm = scene_of("arm_motion", material, motor_vibration_mv=0.0, **SURE)
    assert slip_vibration(quiet_arm) < 1.1 < slip_vibration(scene)  # the motor is heard
    assert slip_vibration(moving(quiet_arm, "hand")) > 1.4


@pytest.mark.parametrize("material", TWO)
def test_a_carried_object_pushes_by_its_momentum_and_far_from_slipping(material):
    scene = scene_of("arm_motion", material, carried_kg=0.3)
    grasp, plan, handled = insides(scene)
    grid = whole_grid(timeline(scene).num_samples)
    shear = {e: handled.shear_n(e, grid.time_s).reshape(-1) for e in grasp.touching.tolist()}
    total = sum(shear.values())
    for stroke in plan:
        middle_s = 0.5 * (stroke.start_s + stroke.stop_s)
        up = part(total, stroke.start_s - 0.1, middle_s).sum() / RATE_HZ
        down = part(total, middle_s, stroke.stop_s + 0.1).sum() / RATE_HZ
        assert up == pytest.approx(0.3 * 1e-3 * stroke.peak_mm_s, rel=1e-3)  # m v
        assert down == pytest.approx(-up, rel=1e-3)
    assert np.abs(total).max() == pytest.approx(0.3 * 0.5, rel=1e-6)  # m a
    assert np.abs(np.diff(total)).max() < 0.3 * 0.5 * np.pi / 2 / (0.03 * RATE_HZ) * 1.01
    contact_of = scene_contact(scene, grasp, plan).on(grid)
    for element, pushed in shear.items():
        normal_n = contact_of(element).normal_n[-len(grid.blocks) :].reshape(-1)
        assert np.all(np.abs(pushed) < 0.5 * grasp.surface.mu_s * normal_n)
        np.testing.assert_allclose(pushed * grasp.load_n.sum(), total * grasp.load_n[element])


def test_a_carried_object_is_felt_by_gauges_and_films_of_touching_elements_alone():
    added = difference("arm_motion", "M3", "carried_kg")
    scene = scene_of("arm_motion", "M3", **FINE)
    grasp, plan, _ = insides(scene)
    touches = np.isin(grasp.element_of_channel, grasp.touching)
    assert 0 < touches[GAUGES].sum() < 14
    assert np.all(added[~touches] == 0)
    stroke = plan[-1]
    rising = part(added, stroke.start_s + 0.04, stroke.start_s + 0.1)
    falling = part(added, stroke.stop_s - 0.08, stroke.stop_s - 0.01)
    front = draw_front(scene)
    expected = (
        0.3 * front.gain * (0.2 * 0.5 * grasp.load_n / grasp.load_n.sum())[grasp.element_of_channel]
    )
    np.testing.assert_allclose(rising[GAUGES].mean(-1), expected[GAUGES], atol=1e-7)
    np.testing.assert_allclose(falling[GAUGES].mean(-1), -expected[GAUGES], atol=1e-7)
    film = part(added, stroke.start_s, stroke.start_s + 0.05)[FILMS][touches[FILMS]]
    assert np.all(film.max(-1) > 1e-5)


# Pulled --------------------------------------------------------------------------------------


def onset_bursts(scene: Scene) -> float:
    """Films in the 40 ms after an onset over rest: the median of films that touch."""
    samples = highpassed(volts(scene), 20.0)
    grasp = insides(scene)[0]
    touching = np.isin(grasp.element_of_channel, grasp.touching)
    touching[GAUGES] = False
    ratio = [
        rms(part(samples, onset_s - 0.01, onset_s + 0.04)) / rms(part(samples, 0.2, 1.2))
        for onset_s in timeline(scene).onsets_s
    ]
    return float(np.median(np.array(ratio)[:, touching]))


def jolt_without_touch(scene: Scene) -> float:
    """As each stroke starts, over rest, in channels that touch nothing: the most that is felt."""
    samples, (grasp, plan, _) = volts(scene), insides(scene)
    away = ~np.isin(grasp.element_of_channel, grasp.touching)
    assert away.sum() >= 8
    ratio = [
        rms(part(samples, s.start_s, s.start_s + 0.3)) / rms(part(samples, 0.2, 1.2)) for s in plan
    ]
    return float(np.max(np.array(ratio)[:, away]))


@pytest.mark.parametrize("material", TWO)
def test_a_pulled_object_slips_and_no_arm_is_felt(material):
    some = {"touching": ("SG10", "SG11", "SG12", "SG7", "SG8"), **SURE}
    scene = scene_of("pulled", material, **some)
    assert slip_vibration(scene_of("pulled", material, **SURE)) > 1.4
    assert onset_bursts(scene) > 5.0
    assert jolt_without_touch(scene) < 1.5
    assert jolt_without_touch(moving(scene, "hand")) > 5.0
    silent = {"friction_noise_mv": 0.0, "texture_scale": 0.0, "onset_pulse_v": 0.0}
    assert slip_vibration(scene_of("pulled", material, **SURE, **silent)) < 1.1
    calm = {**silent, "pvdf_shear_v_per_n": 0.0}
    assert onset_bursts(scene_of("pulled", material, **some, **calm)) < 1.5


@pytest.mark.parametrize("material", TWO)
def test_an_arm_that_is_off_and_an_arm_alone(material):
    some = {"touching": ("SG10", "SG11", "SG12", "SG7", "SG8"), **SURE}
    off, alone = (scene_of(name, material, **some) for name in ("motor_off", "motor_only"))
    assert jolt_without_touch(off) < 1.5
    assert jolt_without_touch(alone) > 5.0
    off, alone = (scene_of(name, material, **SURE) for name in ("motor_off", "motor_only"))
    assert slip_vibration(off) > 1.4
    assert slip_vibration(alone) > 1.5
    assert slip_vibration(replace(alone, disturbances=off.disturbances)) < 1.1
    assert onset_bursts(off) > 5.0
    assert onset_bursts(replace(alone, disturbances=off.disturbances)) < 0.1 * onset_bursts(off)


# Taps ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", TWO)
def test_a_tap_is_a_half_sine_in_the_gauges_and_nothing_outside(material):
    added = difference("taps", material, "taps_per_s", onset_pulse_v=0.0)
    scene = scene_of("taps", material, **FINE)
    grasp, _, handled = insides(scene)
    time_s = np.arange(added.shape[1]) / RATE_HZ
    forces = np.zeros((len(grasp.load_n), len(time_s)))
    for tap in handled.taps:
        low, high = scene.handling.tap_n
        assert low <= tap.size <= high
        assert 0.005 <= tap.duration_s <= 0.040
        phase = (time_s - tap.start_s) / tap.duration_s
        half_sine = np.where((phase > 0) & (phase < 1), np.sin(np.pi * phase), 0.0)
        forces += tap.size * tap.shares[:, None] * half_sine
    expected = 0.2 * (draw_front(scene).gain[:, None] * forces[grasp.element_of_channel])
    lasting = sosfiltfilt(butter(2, 30.0, fs=RATE_HZ, output="sos"), added - expected)
    assert len(handled.taps) >= 3
    assert np.abs(lasting[GAUGES]).max() < 0.02 * expected[GAUGES].max()  # the knock's rest
    away = ~is_within(timeline(scene).non_slip_s, added.shape[1])
    assert np.abs(added[GAUGES][:, away]).max() < 1e-3 * np.abs(added[GAUGES]).max()
    assert np.abs(added[FILMS][:, away]).max() < 0.02 * np.abs(added[FILMS]).max()
    lifted = ~np.isin(grasp.element_of_channel, grasp.touching)
    assert np.all(added[lifted] == 0)
    assert np.all(np.abs(added[~lifted]).max(-1) > 1e-3)


def knock_share(added: np.ndarray) -> float:
    """Of the power that taps add to films, what lies above 100 Hz, the median film."""
    power = np.abs(np.fft.rfft(added)) ** 2
    hertz = np.fft.rfftfreq(added.shape[1], 1 / RATE_HZ)
    power = power[power.sum(-1) > 0]
    return float(np.median(power[:, hertz > 100].sum(-1) / power.sum(-1)))


def test_a_tap_knocks_in_the_films_over_a_broad_band(monkeypatch):
    def added() -> np.ndarray:
        return difference("taps", "M3", "taps_per_s", tap_ms=[20.0, 40.0])[FILMS]

    assert knock_share(added()) > 0.1
    monkeypatch.setattr("tactslip_torch.simulation.handling.KNOCK_V_PER_N", 0.0)
    assert knock_share(added()) < 0.02


def tap_contrast(scene: Scene) -> float:
    """Films in the 30 ms from the scene's taps on over those without any, the median."""
    samples = highpassed(volts(scene)[FILMS], 20.0)
    taps = insides(scene_of("taps", scene.material, cycle=1, **SURE))[2].taps
    around = np.median([rms(part(samples, t.start_s, t.start_s + 0.03)) for t in taps])
    quiet = highpassed(volts(scene_of("taps", scene.material, taps_per_s=0.0, **SURE)), 20.0)
    return float(around / np.median(rms(part(quiet[FILMS], 0.2, 1.2))))


@pytest.mark.parametrize("material", TWO)
def test_taps_stand_out_of_the_noise(material):
    assert tap_contrast(scene_of("taps", material, cycle=1, **SURE)) > 4.0
    assert tap_contrast(scene_of("taps", material, cycle=1, taps_per_s=0.0, **SURE)) < 1.5


def test_taps_and_grips_come_at_their_rate_and_never_near_a_slide():
    counts, expected = np.zeros(2), np.zeros(2)
    mixed = (
        Stroke(40.0, 30.0, 1.5),
        Stroke(60.0, 30.0, 0.5, "both"),
        Stroke(20.0, 20.0, 1.4, "object"),
    )
    knobs = Handling(taps_per_s=3.0, grips_per_s=1.0, tap_ms=(5.0, 200.0))
    in_carried = 0
    for cycle in range(40):
        scene = Scene("M2", strokes=mixed, handling=knobs, cycle=cycle, tail_s=0.5)
        truth, (_, plan, handled) = timeline(scene), insides(scene)
        quiet_s = sum(b - a for a, b in quiet_stretches(plan, truth.duration_s))
        assert quiet_s < plan[-1].stop_s + 0.5 - sum(
            s.stop_s - s.start_s + 2 * MARGIN_S - 1e-9 for s in plan if s.slides
        )
        counts += len(handled.taps), len(handled.grips)
        expected += 3.0 * quiet_s, 1.0 * quiet_s
        slides = [(s.start_s - MARGIN_S, s.stop_s + MARGIN_S) for s in plan if s.slides]
        for event in (*handled.taps, *handled.grips):
            assert 0 <= event.start_s < event.end_s < truth.duration_s
            assert not any(event.end_s > a and event.start_s < b for a, b in slides)
            in_carried += plan[1].start_s < event.start_s < plan[1].stop_s
            inside = [a <= event.start_s and event.end_s <= b for a, b in truth.non_slip_s]
            assert any(inside)
        assert any(a <= plan[1].start_s and plan[1].stop_s <= b for a, b in truth.non_slip_s)
    assert np.all(np.abs(counts - expected) < 4 * np.sqrt(expected))
    assert in_carried > 10


# Grips ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", TWO)
def test_a_grip_raises_the_gauges_stays_and_comes_back(material):
    scene = scene_of("grips", material, cycle=1, grips_per_s=0.6, **FINE)
    added = difference("grips", material, "grips_per_s", cycle=1, grips_per_s=0.6)
    grasp, plan, handled = insides(scene)
    num = added.shape[1]
    touching = np.isin(grasp.element_of_channel, grasp.touching)
    gauges = added[GAUGES][touching[GAUGES]]
    assert gauges.min() > -1e-7  # never below
    assert np.abs(gauges[:, ~is_within(timeline(scene).non_slip_s, num)]).max() < 1e-7
    assert np.all(added[~touching] == 0)
    grips = handled.grips
    alone = [
        g for g in grips if all(o is g or o.start_s > g.end_s or o.end_s < g.start_s for o in grips)
    ]
    assert alone
    grid = whole_grid(num)
    contact_of = scene_contact(scene, grasp, plan).on(grid)
    gain = draw_front(scene).gain
    for grip in alone:
        assert 0.2 <= grip.duration_s <= 1.0
        quarter_s = grip.duration_s / 4
        for channel in np.flatnonzero(touching[GAUGES]).tolist():
            element = int(grasp.element_of_channel[channel])
            normal_n = contact_of(element).normal_n[-len(grid.blocks) :].reshape(-1)[:num]
            rise = added[channel] / (0.2 * gain[channel] * normal_n)  # over the load
            held = part(rise, grip.start_s + 1.01 * quarter_s, grip.end_s - 1.01 * quarter_s)
            np.testing.assert_allclose(held, grip.size * grip.shares[element], rtol=1e-4)
            up = part(rise, grip.start_s, grip.start_s + quarter_s)
            down = part(rise, grip.end_s - quarter_s, grip.end_s)
            assert np.all(np.diff(up) > -1e-7)
            assert np.all(np.diff(down) < 1e-7)
            ends = [part(rise, t - 0.002, t + 0.002).min() for t in (grip.start_s, grip.end_s)]
            assert max(ends) < 0.01 * held.mean()


def test_a_firmer_grip_stands_out_in_the_gauges():
    """The level of touching gauges in the middle of grips over how they wander at rest."""

    def lift(**changes: float) -> float:
        scene = scene_of("grips", "M2", cycle=1, **SURE, **changes)
        grips = insides(scene_of("grips", "M2", cycle=1, **SURE))[2].grips
        samples = volts(scene)[GAUGES]
        middles = [0.5 * (g.start_s + g.end_s) for g in grips]
        raised = [part(samples, m - 0.02, m + 0.02).mean(-1) for m in middles]
        before = [part(samples, g.start_s - 0.04, g.start_s).mean(-1) for g in grips]
        return float(np.median(np.abs(np.array(raised) - np.array(before))))

    assert lift() > 0.02
    assert lift(grips_per_s=0.0) < 0.01


def test_handling_does_not_move_the_slides():
    for name, knob in (("taps", "taps_per_s"), ("grips", "grips_per_s")):
        with_it, without = scene_of(name, "M5", **STILL), scene_of(name, "M5", **{knob: 0.0})
        assert timeline(with_it).sliding_s == timeline(without).sliding_s
        added = difference(name, "M5", knob, **STILL)
        for start_s, end_s in timeline(with_it).sliding_s:
            assert np.abs(part(added[GAUGES], start_s, end_s)).max() < 1e-7
