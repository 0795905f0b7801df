"""What disturbs, handles and breaks: what each adds to the channels, when, and where it stops."""

from dataclasses import replace

import numpy as np
import pytest
from scene_files import (
    CALM,
    FINE,
    NAMES,
    RATE_HZ,
    added,
    contacts,
    is_within,
    part,
    rms,
    scene_of,
    volts,
)
from scipy.signal import butter, sosfiltfilt

from tactslip_torch.simulation import Handling, Imperfections, Scene, Stroke, timeline
from tactslip_torch.simulation._contact import Grasp, draw_grasp
from tactslip_torch.simulation._sensors import (
    Handled,
    _quiet,
    draw_front,
    losses,
    machine_runs,
    mains_bursts,
    partial_intervals,
    rotation_hz,
)

SLOW, FAST = slice(0, 14), slice(14, 24)  # the paper's SG and PVDF channels
SURE = {**CALM, "lifted_fraction": 0.0}
QUIET = {**FINE, **CALM, "white_noise_mv": 0.0, "motor_vibration_mv": 0.0, "arm_transient_mv": 0.0}


def highpassed(samples: np.ndarray, corner_hz: float) -> np.ndarray:
    return sosfiltfilt(butter(4, corner_hz, "high", fs=RATE_HZ, output="sos"), samples)


def touching(grasp: Grasp) -> np.ndarray:
    """Which channels belong to an element that touches, ``[C]``."""
    return np.isin(grasp.element_of_channel, grasp.touching)


def longest(intervals):
    return max(intervals, key=lambda interval: interval[1] - interval[0])


# --- disturbances of every channel --------------------------------------------------------------


def harmonic_power(samples: np.ndarray, hertz: float, orders: tuple[int, ...]) -> np.ndarray:
    """Of each row's power, what a least-squares fit of the harmonics takes: no window, no leak."""
    time_s = np.arange(samples.shape[-1]) / RATE_HZ
    angles = 2 * np.pi * hertz * np.outer(time_s, orders)
    basis = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    fitted = basis @ np.linalg.lstsq(basis, samples.T, rcond=None)[0]
    return np.sum(fitted.T**2, -1) / np.sum(samples**2, -1)


def test_a_machine_runs_at_its_lines_and_stands_still_between():
    wave, scene = added("machine", "M3", "machine_mv"), scene_of("machine", "M3")
    runs, hertz, orders = machine_runs(scene), rotation_hz(scene), (1, 2, 3, 4, 6, 8)
    running = is_within(runs, wave.shape[1])
    assert 0.2 < running.mean() < 0.95
    assert np.abs(wave[:, ~running]).max() < 1e-7
    assert 12.0 <= hertz <= 60.0
    duration_s = timeline(scene).duration_s
    steady = part(wave, *longest([(a + 0.31, min(b, duration_s) - 0.31) for a, b in runs]))
    assert steady.shape[1] > 1000
    assert harmonic_power(steady, hertz, orders).min() > 0.999
    assert harmonic_power(steady, 1.07 * hertz, orders).max() < 0.5
    level_mv = 1e3 * np.sqrt(np.mean(steady**2, -1))
    assert 15.0 / 1.6 < np.median(level_mv) < 15.0 * 1.6  # 24 draws of spread .4
    assert level_mv.min() > 2.0  # felt in every channel


def test_mains_bursts_are_mains_and_only_in_their_intervals():
    often = {"mains_bursts_per_s": 1.0}
    burst = added("mains_bursts", "M3", "mains_bursts_per_s", **often)
    hum = added("mains_bursts", "M3", "mains_mv", **often)  # the bursts stay
    scene = scene_of("mains_bursts", "M3", **often)
    bursts = mains_bursts(scene)
    assert 5 < len(bursts) < 30  # 15 expected
    lengths = np.diff(bursts)
    assert 0.1 <= lengths.min() < lengths.max() <= 1.0
    within = is_within(bursts, burst.shape[1])
    assert 0.1 < within.mean() < 0.9
    assert np.abs(burst[:, ~within]).max() < 1e-7
    alone = [a for a in bursts if all(b is a or b[0] > a[1] or b[1] < a[0] for b in bursts)]
    start_s, stop_s = longest(alone)
    inside = (start_s + 0.03, min(stop_s, timeline(scene).duration_s) - 0.03)
    burst, hum = part(burst, *inside), part(hum, *inside)
    assert harmonic_power(burst, 50.0, (1, 2, 3, 5, 7, 9)).min() > 0.97  # 50 +- .02 Hz
    assert harmonic_power(burst, 61.0, (1, 2, 3, 5, 7)).max() < 0.2
    factor = np.sum(burst * hum, -1) / np.sum(hum**2, -1)
    np.testing.assert_allclose(burst, factor[:, None] * hum, atol=1e-6)  # one wave, one phase
    np.testing.assert_allclose(factor, factor[0], rtol=1e-4)  # one coupling per channel
    fundamental = harmonic_power(burst, 50.0, (1,))
    assert fundamental.min() > 0.6
    amplitude_mv = 1e3 * np.sqrt(2 * fundamental * np.mean(burst**2, -1))
    assert 50.0 / 1.5 < np.median(amplitude_mv) < 50.0 * 1.5


def test_warming_is_slow_and_each_channels_own():
    moved = added("drift", "M3", "warming_mv", sg_drift_mv=0.0, pvdf_drift_mv=0.0)
    duration_s = timeline(scene_of("drift", "M3")).duration_s
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=1e-7)
    steps = np.diff(moved[:, ::200]) * np.sign(moved[:, -1:])  # every tenth of a second
    assert np.all(steps > 0)  # one way
    assert np.all(np.diff(steps)[:, :-1] < 1e-7)  # slower and slower
    assert np.abs(np.diff(moved)).max() < 2.5 * np.abs(moved).max() / (duration_s * RATE_HZ)
    far_mv = 1e3 * np.abs(moved[:, -1])
    assert 400 / 2 < np.median(far_mv[SLOW]) < 400 * 2  # 14 draws of spread .5
    assert 8 / 2 < np.median(far_mv[FAST]) < 8 * 2
    assert len(set(np.sign(moved[SLOW, -1]))) == 2
    assert np.ptp(np.log(far_mv[SLOW])) > 0.5


# --- faults -------------------------------------------------------------------------------------

NO_FAULTS = {"dead": [], "saturated": [], "swapped": [], "drops_per_s": 0.0}


@pytest.mark.parametrize(
    "name", [n for n in NAMES if n.endswith(("channel", "channels", "samples"))]
)
def test_faults_change_the_file_and_leave_the_truth_alone(name):
    scene, sound_scene = scene_of(name, "M5"), scene_of(name, "M5", **NO_FAULTS)
    assert timeline(scene) == timeline(sound_scene)
    broken, sound = volts(scene), volts(sound_scene)
    one, other, gauge = (scene.hand.names.index(n) for n in ("PVDF7", "PVDF1", "SG10"))
    if name == "dead_channel":
        sound[one] = 0.0
    elif name == "saturated_channel":
        sound[gauge] = 5.0 - 10.0 / 2**16
    elif name == "swapped_channels":
        sound[[one, other]] = sound[[other, one]]
        alone = volts(scene, channels=["PVDF7"])
        assert np.array_equal(alone[one], sound[one])
        assert np.isnan(alone[other]).all()
    else:  # samples are lost: the last one is repeated
        lost = {i for span in losses(scene, sound.shape[1]) for i in range(*span)}
        assert lost
        for index in sorted(lost):
            sound[:, index] = sound[:, index - 1]
    assert np.array_equal(broken, sound)
    assert not np.array_equal(broken, volts(sound_scene))


# --- handling -----------------------------------------------------------------------------------


def least_jolt(scene: Scene) -> float:
    """Arm starts over the rest before them: the channel and stroke that feels least."""
    samples = volts(scene)
    rest = rms(part(samples, 0.2, 1.0))
    starts_s = [start_s for start_s, _ in timeline(scene).arm_s]
    return min(float(np.min(rms(part(samples, s, s + 0.2)) / rest)) for s in starts_s)


def slip_vibration(scene: Scene) -> float:
    """Films in the steady part of the last stroke over rest, high band, the median film."""
    samples, stroke = highpassed(volts(scene)[FAST], 100.0), scene.arm[-1]
    steady = part(samples, stroke.start_s + 0.5, stroke.stop_s - 0.15)
    return float(np.median(rms(steady) / rms(part(samples, 0.2, 1.0))))


def moving(scene: Scene, moves: str) -> Scene:
    return replace(scene, strokes=tuple(replace(s, moves=moves) for s in scene.strokes))


def test_a_moved_arm_jolts_every_channel_and_no_slip_is_heard():
    scene = scene_of("arm_motion", "M3", **SURE)
    assert least_jolt(scene) > 2.0
    assert least_jolt(scene_of("arm_motion", "M3", arm_transient_mv=0.0, **SURE)) < 1.5
    quiet_arm = scene_of("arm_motion", "M3", motor_vibration_mv=0.0, **SURE)
    assert slip_vibration(quiet_arm) < 1.1 < slip_vibration(scene)  # the motor is heard
    assert slip_vibration(moving(quiet_arm, "hand")) > 1.4


def test_a_carried_object_pushes_by_its_momentum_and_far_from_slipping():
    scene = scene_of("arm_motion", "M6", carried_kg=0.3)
    grasp, (states, time_s) = draw_grasp(scene), contacts(scene)
    handled = Handled(scene, grasp)
    shear = {e: handled.shear_n(e, time_s) for e in grasp.touching.tolist()}
    total = sum(shear.values())
    for stroke in scene.arm:
        middle_s = 0.5 * (stroke.start_s + stroke.stop_s)
        up = part(total, stroke.start_s - 0.1, middle_s).sum() / RATE_HZ
        down = part(total, middle_s, stroke.stop_s + 0.1).sum() / RATE_HZ
        assert up == pytest.approx(0.3 * 1e-3 * stroke.peak_mm_s, rel=1e-3)  # m v
        assert down == pytest.approx(-up, rel=1e-3)
    assert np.abs(total).max() == pytest.approx(0.3 * 0.5, rel=1e-6)  # m a
    assert np.abs(np.diff(total)).max() < 0.3 * 0.5 * np.pi / 2 / (0.03 * RATE_HZ) * 1.01
    for element, pushed in shear.items():
        static_n = grasp.mu_s * states[element].normal_n
        assert np.all(np.abs(pushed) < 0.5 * static_n)
        np.testing.assert_allclose(pushed * grasp.load_n.sum(), total * grasp.load_n[element])


def onset_bursts(scene: Scene) -> float:
    """Films in the 40 ms after an onset over rest: the median of films that touch."""
    films = highpassed(volts(scene)[FAST][touching(draw_grasp(scene))[FAST]], 20.0)
    rest = rms(part(films, 0.2, 1.2))
    bursts = [rms(part(films, at - 0.01, at + 0.04)) / rest for at in timeline(scene).onsets_s]
    return float(np.median(bursts))


def jolt_without_touch(scene: Scene) -> float:
    """As each stroke starts, over rest, in channels that touch nothing: the most that is felt."""
    away = volts(scene)[~touching(draw_grasp(scene))]
    assert len(away) >= 8
    rest = rms(part(away, 0.2, 1.2))
    starts = [part(away, s.start_s, s.start_s + 0.3) for s in scene.arm]
    return float(np.max([rms(start) / rest for start in starts]))


def test_a_pulled_object_slips_and_no_arm_is_felt():
    some = {"touching": ("SG10", "SG11", "SG12", "SG7", "SG8"), **SURE}
    scene = scene_of("pulled", "M6", **some)
    assert slip_vibration(scene_of("pulled", "M6", **SURE)) > 1.4
    assert onset_bursts(scene) > 5.0
    assert jolt_without_touch(scene) < 1.5
    assert jolt_without_touch(moving(scene, "hand")) > 5.0
    silent = {"friction_noise_mv": 0.0, "texture_scale": 0.0, "onset_pulse_v": 0.0}
    assert slip_vibration(scene_of("pulled", "M6", **SURE, **silent)) < 1.1
    calm = {**silent, "pvdf_shear_v_per_n": 0.0}
    assert onset_bursts(scene_of("pulled", "M6", **some, **calm)) < 1.5


def test_a_tap_is_a_half_sine_in_the_sg_channels_and_nothing_outside():
    felt = added("taps", "M3", "taps_per_s", onset_pulse_v=0.0)
    scene = scene_of("taps", "M3")
    grasp, time_s = draw_grasp(scene), np.arange(felt.shape[1]) / RATE_HZ
    taps, forces = Handled(scene, grasp).taps, np.zeros((len(grasp.load_n), len(time_s)))
    for tap in taps:
        length_s = tap.end_s - tap.start_s
        assert 0.005 <= length_s <= 0.040
        phase = (time_s - tap.start_s) / length_s
        half_sine = np.where((phase > 0) & (phase < 1), np.sin(np.pi * phase), 0.0)
        forces += tap.size[:, None] * half_sine
    assert len(taps) >= 3
    expected = 0.2 * (draw_front(scene).gain[:, None] * forces[grasp.element_of_channel])
    lasting = sosfiltfilt(butter(2, 30.0, fs=RATE_HZ, output="sos"), felt - expected)
    assert np.abs(lasting[SLOW]).max() < 0.02 * expected[SLOW].max()  # the knock's rest
    away = ~is_within(timeline(scene).non_slip_s, felt.shape[1])
    for kind, most in ((SLOW, 1e-3), (FAST, 0.02)):
        assert np.abs(felt[kind][:, away]).max() < most * np.abs(felt[kind]).max()
    down = touching(grasp)
    assert np.all(felt[~down] == 0)
    assert np.all(np.abs(felt[down]).max(-1) > 1e-3)


def test_taps_and_grips_come_at_their_rate_and_never_near_a_slide():
    counts, expected, in_carried = np.zeros(2), np.zeros(2), 0
    mixed = (
        Stroke(40.0, 30.0, 1.5),
        Stroke(60.0, 30.0, 0.5, "both"),
        Stroke(20.0, 20.0, 1.4, "object"),
    )
    handling = Handling(taps_per_s=3.0, grips_per_s=1.0, tap_ms=(5.0, 200.0))
    for cycle in range(40):
        scene = Scene("M2", strokes=mixed, handling=handling, cycle=cycle, tail_s=0.5)
        truth, arm, handled = timeline(scene), scene.arm, Handled(scene, draw_grasp(scene))
        quiet_s = sum(b - a for a, b in _quiet(scene))
        slides = [(s.start_s - 0.1, s.stop_s + 0.1) for s in arm if s.slides]
        assert quiet_s == pytest.approx(arm[-1].stop_s + 0.5 - sum(b - a for a, b in slides))
        counts += len(handled.taps), len(handled.grips)
        expected += 3.0 * quiet_s, 1.0 * quiet_s
        for event in (*handled.taps, *handled.grips):
            assert 0 <= event.start_s < event.end_s < truth.duration_s
            assert not any(event.end_s > a and event.start_s < b for a, b in slides)
            assert any(a <= event.start_s and event.end_s <= b for a, b in truth.non_slip_s)
            in_carried += arm[1].start_s < event.start_s < arm[1].stop_s
        assert any(a <= arm[1].start_s and arm[1].stop_s <= b for a, b in truth.non_slip_s)
    assert np.all(np.abs(counts - expected) < 4 * np.sqrt(expected))
    assert in_carried > 10


def test_a_grip_raises_the_sg_channels_stays_and_comes_back():
    changes = {"cycle": 1, "grips_per_s": 0.6}
    felt, scene = added("grips", "M3", "grips_per_s", **changes), scene_of("grips", "M3", **changes)
    grasp, (states, _) = draw_grasp(scene), contacts(scene)
    down, gain, num = touching(grasp), draw_front(scene).gain, felt.shape[1]
    assert felt[SLOW].min() > -1e-7  # never below
    assert np.abs(felt[SLOW][:, ~is_within(timeline(scene).non_slip_s, num)]).max() < 1e-7
    assert np.all(felt[~down] == 0)
    grips = Handled(scene, grasp).grips
    alone = [
        g for g in grips if all(o is g or o.start_s > g.end_s or o.end_s < g.start_s for o in grips)
    ]
    assert alone
    for grip, channel in [(g, c) for g in alone for c in np.flatnonzero(down[SLOW]).tolist()]:
        quarter_s, element = (grip.end_s - grip.start_s) / 4, grasp.element_of_channel[channel]
        assert 0.2 <= 4 * quarter_s <= 1.0
        rise = felt[channel] / (0.2 * gain[channel] * states[element].normal_n[:num])  # over load
        held = part(rise, grip.start_s + 1.01 * quarter_s, grip.end_s - 1.01 * quarter_s)
        np.testing.assert_allclose(held, grip.size[element], rtol=1e-4)
        assert np.all(np.diff(part(rise, grip.start_s, grip.start_s + quarter_s)) > -1e-7)
        assert np.all(np.diff(part(rise, grip.end_s - quarter_s, grip.end_s)) < 1e-7)
        ends = [part(rise, t - 0.002, t + 0.002).min() for t in (grip.start_s, grip.end_s)]
        assert max(ends) < 0.01 * held.mean()


# --- imperfections ------------------------------------------------------------------------------


def imperfect(material: str, **changes: float) -> np.ndarray:
    """What imperfections add to the samples of a quiet recording, ``[C, T]``."""
    (key,) = changes
    return added("paper", material, key, **{**QUIET, **changes})


def test_pick_up_is_one_signal_with_a_coupling_of_each_channel():
    wave = imperfect("M3", pickup_mv=2.0)
    singular = np.linalg.svd(wave[:, :4000], compute_uv=False)
    assert singular[1] < 1e-4 * singular[0]
    levels = rms(wave)
    assert 2e-3 / 2.5 < np.median(levels[FAST]) < 2e-3 * 2.5
    assert np.median(levels[SLOW]) < 0.3 * np.median(levels[FAST])
    assert {-1.0, 1.0} == set(np.sign(wave @ wave[14]))
    assert np.log(levels[FAST]).std() > 0.3


def test_a_finger_that_slips_alone_is_heard_at_rest_and_a_finger_that_sticks_falls_silent():
    scene = scene_of("paper", "M1", partial_slips_per_s=0.5, **QUIET)
    plain = volts(replace(scene, imperfections=Imperfections()))
    changed, truth, down = volts(scene) - plain, timeline(scene), touching(draw_grasp(scene))
    fingers = np.array([channel.finger for channel in scene.hand.channels])
    spans = {finger: partial_intervals(scene, finger) for finger in sorted(set(fingers))}
    slide_s, heard, silent = truth.sliding_s[0], 0, 0
    for finger, intervals in spans.items():
        films = np.flatnonzero((fingers == finger) & down)
        films = films[films >= 14]
        if not len(films):
            continue
        assert np.abs(changed[films][:, ~is_within(intervals, changed.shape[1])]).max() < 1e-9
        for start_s, stop_s in intervals:
            at_once = sum(a < stop_s and start_s < b for own in spans.values() for a, b in own)
            middle = (start_s + 0.015, stop_s - 0.015)
            if at_once > 1:
                continue
            if stop_s < truth.arm_s[0][0]:
                assert rms(part(changed[films], start_s, stop_s)).min() > 1e-3
                heard += 1
            elif slide_s[0] + 0.05 < start_s < stop_s - 0.06 and stop_s < slide_s[1] - 0.05:
                before, after = (part(x[films], *middle) for x in (plain, plain + changed))
                assert np.median(rms(after) / rms(before)) < 0.5
                silent += 1
    assert heard
    assert silent
