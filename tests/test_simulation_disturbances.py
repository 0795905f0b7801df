"""What disturbs, handles and breaks: what each adds to the channels, when, and where it stops."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scene_files import (
    CONTACTS,
    FINE,
    NAMES,
    RATE_HZ,
    STILL,
    contacts,
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
from scipy.stats import kstest

from tactslip_torch.simulation import (
    Handling,
    Imperfections,
    Scene,
    Stroke,
    simulate,
    timeline,
)
from tactslip_torch.simulation._disturbances import (
    MARGIN_S,
    _motor_level_mv,
    _quiet,
    losses,
    machine_runs,
    machine_wave,
    mains_bursts,
    partial_intervals,
    rotation_hz,
)
from tactslip_torch.simulation._sensors import draw_front

TWO = ("M3", "M6")


def harmonic_share(samples: np.ndarray, hertz: float, orders: tuple[int, ...]) -> np.ndarray:
    """Of each row's power, what a least-squares fit of the harmonics takes: no window, no leak."""
    time_s = np.arange(samples.shape[-1]) / RATE_HZ
    angles = 2 * np.pi * hertz * np.outer(time_s, orders)
    basis = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    fitted = basis @ np.linalg.lstsq(basis, samples.T, rcond=None)[0]
    return np.sum(fitted.T**2, -1) / np.sum(samples**2, -1)


def full_speed(scene: Scene) -> tuple[float, float]:
    """A stretch in which the machine runs at its full speed for half a second at least."""
    duration_s = timeline(scene).duration_s
    runs = [(a + 0.31, min(b, duration_s) - 0.31) for a, b in machine_runs(scene)]
    return max(runs, key=lambda run: run[1] - run[0])


@pytest.mark.parametrize("material", TWO)
def test_a_machine_runs_at_its_lines_and_stands_still_between(material):
    added, scene = difference("machine", material, "machine_mv"), scene_of("machine", material)
    runs = machine_runs(scene)
    running = is_within([(a, b) for a, b in runs], added.shape[1])
    assert 0.2 < running.mean() < 0.95
    assert np.abs(added[:, ~running]).max() < 1e-7
    assert 12.0 <= rotation_hz(scene) <= 60.0
    steady = part(added, *full_speed(scene))
    assert steady.shape[1] > 1000
    orders = (1, 2, 3, 4, 6, 8)
    assert harmonic_share(steady, rotation_hz(scene), orders).min() > 0.999
    assert harmonic_share(steady, 1.07 * rotation_hz(scene), orders).max() < 0.5
    level_mv = 1e3 * np.sqrt(np.mean(steady**2, -1))
    assert 15.0 / 1.6 < np.median(level_mv) < 15.0 * 1.6  # 24 draws of spread .4
    assert level_mv.min() > 2.0  # felt in every channel


def test_a_machine_shakes_with_the_square_of_its_speed_and_turns_without_a_break():
    scene = scene_of("machine", "M3", machine_hz=(200.0, 200.1))
    duration_s = timeline(scene).duration_s
    start_s, stop_s = machine_runs(scene)[0]
    wave = machine_wave(scene, whole_grid(round(duration_s * RATE_HZ))).reshape(-1)
    level = [rms(part(wave, start_s + t, start_s + t + 0.03)) for t in (0.085, 0.185, 0.4)]
    assert level[0] / level[2] == pytest.approx((0.1 / 0.3) ** 2, rel=0.25)
    assert level[1] / level[2] == pytest.approx((0.2 / 0.3) ** 2, rel=0.15)
    slow = scene_of("machine", "M3", machine_hz=(12.0, 12.1))
    wave = machine_wave(slow, whole_grid(round(duration_s * RATE_HZ))).reshape(-1)
    whole_run = part(wave, start_s + 0.31, stop_s - 0.31)
    assert np.abs(np.diff(wave)).max() < 1.01 * np.abs(np.diff(whole_run)).max()  # no seam
    assert rms(whole_run) == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("material", TWO)
def test_mains_bursts_are_mains_and_only_in_their_intervals(material):
    steady = {"mains_bursts_per_s": 1.0}
    added = difference("mains_bursts", material, "mains_bursts_per_s", **steady)
    scene = scene_of("mains_bursts", material, **steady, **FINE)
    bursts = mains_bursts(scene)
    assert 5 < len(bursts) < 30  # 15 expected
    lengths = np.array([b - a for a, b in bursts])
    assert 0.1 <= lengths.min() < lengths.max() <= 1.0
    within = is_within(list(bursts), added.shape[1])
    assert 0.1 < within.mean() < 0.9
    assert np.abs(added[:, ~within]).max() < 1e-7
    alone = [a for a in bursts if all(b is a or b[0] > a[1] or b[1] < a[0] for b in bursts)]
    start_s, stop_s = max(alone, key=lambda burst: burst[1] - burst[0])
    inside = part(added, start_s + 0.02, min(stop_s, timeline(scene).duration_s) - 0.02)
    assert harmonic_share(inside, 50.0, (1, 2, 3, 5, 7, 9)).min() > 0.97  # 50 +- .02 Hz
    assert harmonic_share(inside, 61.0, (1, 2, 3, 5, 7)).max() < 0.2
    assert harmonic_share(inside, 50.0, (1,)).min() > 0.6


def test_a_mains_burst_has_the_size_the_phase_and_the_couplings_of_the_mains():
    added = difference("mains_bursts", "M3", "mains_bursts_per_s")
    scene = scene_of("mains_bursts", "M3")
    hum = difference("mains_bursts", "M3", "mains_mv")  # bursts stay: they are not the mains' own
    bursts = mains_bursts(scene)
    start_s, stop_s = max(bursts, key=lambda burst: burst[1] - burst[0])
    burst, plain = (part(x, start_s + 0.03, stop_s - 0.03) for x in (added, hum))
    factor = np.sum(burst * plain, -1) / np.sum(plain**2, -1)
    np.testing.assert_allclose(burst, factor[:, None] * plain, atol=1e-6)  # one wave, one phase
    np.testing.assert_allclose(factor, factor[0], rtol=1e-4)  # one coupling per channel
    amplitude_mv = 1e3 * np.sqrt(2 * harmonic_share(burst, 50.0, (1,)) * np.mean(burst**2, -1))
    assert 50.0 / 1.5 < np.median(amplitude_mv) < 50.0 * 1.5


@pytest.mark.parametrize("material", TWO)
def test_warming_is_slow_and_each_channels_own(material):
    cold = {"sg_drift_mv": 0.0, "pvdf_drift_mv": 0.0}
    added = difference("drift", material, "warming_mv", **cold)
    duration_s = timeline(scene_of("drift", material)).duration_s
    np.testing.assert_allclose(added[:, 0], 0.0, atol=1e-7)
    steps = np.diff(added[:, ::200]) * np.sign(added[:, -1:])  # every tenth of a second
    assert np.all(steps > 0)  # one way
    assert np.all(np.diff(steps)[:, :-1] < 1e-7)  # slower and slower
    assert np.abs(np.diff(added)).max() < 2.5 * np.abs(added).max() / (duration_s * RATE_HZ)
    far_mv = 1e3 * np.abs(added[:, -1])
    assert 400 / 2 < np.median(far_mv[:14]) < 400 * 2  # 14 draws of spread .5
    assert 8 / 2 < np.median(far_mv[14:]) < 8 * 2
    assert len(set(np.sign(added[:14, -1]))) == 2
    assert np.ptp(np.log(far_mv[:14])) > 0.5


def test_a_range_of_motor_vibration_is_drawn_per_recording_and_moves_nothing_else():
    bounds = (1.0, 30.0)
    first = scene_of("arm_motion", "M3", motor_vibration_mv=bounds)
    scenes = [replace(first, cycle=cycle) for cycle in range(200)]
    levels = np.array([_motor_level_mv(scene) for scene in scenes])
    place = np.log(levels / bounds[0]) / np.log(bounds[1] / bounds[0])
    assert kstest(place, "uniform").pvalue > 0.01
    again = scene_of("arm_motion", "M3", motor_vibration_mv=float(levels[0]))
    assert np.array_equal(volts(scenes[0]), volts(again))


NO_FAULTS = {"dead": [], "saturated": [], "swapped": [], "drops_per_s": 0.0}


def samples(scene: Scene, **asked: object) -> torch.Tensor:
    return simulate(scene, dtype=torch.float64, **asked).samples


def rows(scene: Scene, *names: str) -> list[int]:
    return [scene.hand.names.index(name) for name in names]


@pytest.mark.parametrize("material", TWO)
@pytest.mark.parametrize(
    ("name", "channel", "value"),
    [("dead_channel", "PVDF7", 0.0), ("saturated_channel", "SG10", 5.0 - 10.0 / 2**16)],
)
def test_a_stuck_channel_holds_its_value_and_the_others_theirs(name, channel, value, material):
    scene = scene_of(name, material)
    broken, sound = samples(scene), samples(scene_of(name, material, **NO_FAULTS))
    (row,) = rows(scene, channel)
    assert torch.all(broken[row] == value)
    assert sound[row].std() > 1e-3  # it is the fault that stills it
    others = [index for index in range(24) if index != row]
    assert torch.equal(broken[others], sound[others])


@pytest.mark.parametrize("material", TWO)
def test_swapped_cables_exchange_two_rows_and_nothing_else(material):
    scene = scene_of("swapped_channels", material)
    broken = samples(scene)
    sound = samples(scene_of("swapped_channels", material, **NO_FAULTS))
    order = list(range(24))
    one, other = rows(scene, "PVDF7", "PVDF1")
    order[one], order[other] = other, one
    assert torch.equal(broken, sound[order])
    assert not torch.equal(broken, sound)
    alone = samples(scene, channels=["PVDF7"])
    assert torch.equal(alone[one], sound[other])
    assert alone[other].isnan().all()


def repeated(sound: np.ndarray, lost: set[int]) -> np.ndarray:
    """What a logger writes that repeats its last sample while it loses some."""
    written = sound.copy()
    for index in range(1, sound.shape[1]):
        if index in lost:
            written[:, index] = written[:, index - 1]
    return written


@pytest.mark.parametrize("material", TWO)
@pytest.mark.parametrize("drops", [{}, {"drops_per_s": 20.0, "drop_ms": [100.0, 200.0]}])
def test_lost_samples_repeat_the_last_one_in_all_channels(material, drops):
    scene = scene_of("dropped_samples", material, **drops)
    intervals = losses(scene, timeline(scene).num_samples)
    lost = {index for first, end in intervals for index in range(first, end)}
    sound = samples(scene_of("dropped_samples", material, **NO_FAULTS)).numpy()
    broken = samples(scene).numpy()
    np.testing.assert_array_equal(broken, repeated(sound, lost))
    is_lost = np.isin(np.arange(sound.shape[1]), sorted(lost))
    assert is_lost.any()
    assert np.all(np.diff(broken)[:, is_lost[1:]] == 0)
    assert np.mean(np.any(np.diff(broken)[:, ~is_lost[1:]] != 0, axis=0)) > 0.99


def test_losses_come_at_their_rate_and_length():
    counts, lengths = [], []
    for cycle in range(30):
        scene = scene_of("dropped_samples", "M2", cycle, drop_ms=[5.0, 50.0])
        intervals = losses(scene, 30000)
        assert list(intervals) == sorted(intervals)
        assert all(1 <= first < end <= 30000 for first, end in intervals)
        counts.append(len(intervals))
        lengths += [end - first for first, end in intervals if end < 30000]
    assert abs(sum(counts) - 30 * 30) < 4 * np.sqrt(30 * 30)  # 2 a second for 15 s
    assert 10 <= min(lengths) < 15
    assert 90 < max(lengths) <= 101
    assert np.median(lengths) == pytest.approx(2 * np.sqrt(5 * 50), rel=0.1)  # log-uniform
    assert losses(scene_of("paper", "M2"), 30000) == ()


@pytest.mark.parametrize(
    "name", [n for n in NAMES if n.endswith(("channel", "channels", "samples"))]
)
def test_faults_leave_the_truth_alone(name):
    assert timeline(scene_of(name, "M5")) == timeline(scene_of(name, "M5", **NO_FAULTS))


GAUGES, FILMS = slice(0, 14), slice(14, 24)

CALM = {"burst_rate_hz": 0.0, "mains_mv": 0.0, "sg_drift_mv": 0.0, "pvdf_drift_mv": 0.0}

SURE = {**CALM, "lifted_fraction": 0.0}


def highpassed(samples: np.ndarray, corner_hz: float) -> np.ndarray:
    return sosfiltfilt(butter(4, corner_hz, "high", fs=RATE_HZ, output="sos"), samples)


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
    states, _ = contacts(scene)
    for element, pushed in shear.items():
        normal_n = states[element].normal_n
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


def test_taps_and_grips_come_at_their_rate_and_never_near_a_slide():
    counts, expected = np.zeros(2), np.zeros(2)
    mixed = (
        Stroke(40.0, 30.0, 1.5),
        Stroke(60.0, 30.0, 0.5, "both"),
        Stroke(20.0, 20.0, 1.4, "object"),
    )
    handling = Handling(taps_per_s=3.0, grips_per_s=1.0, tap_ms=(5.0, 200.0))
    in_carried = 0
    for cycle in range(40):
        scene = Scene("M2", strokes=mixed, handling=handling, cycle=cycle, tail_s=0.5)
        truth, (_, plan, handled) = timeline(scene), insides(scene)
        quiet_s = sum(b - a for a, b in _quiet(scene))
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


@pytest.mark.parametrize("material", TWO)
def test_a_grip_raises_the_gauges_stays_and_comes_back(material):
    scene = scene_of("grips", material, cycle=1, grips_per_s=0.6, **FINE)
    added = difference("grips", material, "grips_per_s", cycle=1, grips_per_s=0.6)
    grasp, _, handled = insides(scene)
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
    states, _ = contacts(scene)
    gain = draw_front(scene).gain
    for grip in alone:
        assert 0.2 <= grip.duration_s <= 1.0
        quarter_s = grip.duration_s / 4
        for channel in np.flatnonzero(touching[GAUGES]).tolist():
            element = int(grasp.element_of_channel[channel])
            normal_n = states[element].normal_n[:num]
            rise = added[channel] / (0.2 * gain[channel] * normal_n)  # over the load
            held = part(rise, grip.start_s + 1.01 * quarter_s, grip.end_s - 1.01 * quarter_s)
            np.testing.assert_allclose(held, grip.size * grip.shares[element], rtol=1e-4)
            up = part(rise, grip.start_s, grip.start_s + quarter_s)
            down = part(rise, grip.end_s - quarter_s, grip.end_s)
            assert np.all(np.diff(up) > -1e-7)
            assert np.all(np.diff(down) < 1e-7)
            ends = [part(rise, t - 0.002, t + 0.002).min() for t in (grip.start_s, grip.end_s)]
            assert max(ends) < 0.01 * held.mean()


QUIET = {**FINE, **STILL, "motor_vibration_mv": 0.0, "arm_transient_mv": 0.0}

REST_S = (0.0, 1.9)
"""Before the first stroke."""

WAYS = ("local_noise_mv", "share_wander", "gain_drift", "pickup_mv", "partial_slips_per_s")


def added(material: str, **changes: float) -> np.ndarray:
    """What imperfections add to the samples of a quiet recording, ``[C, T]``."""
    return volts(scene_of("paper", material, **QUIET, **changes)) - volts(
        scene_of("paper", material, **QUIET)
    )


def films(scene: Scene) -> list[int]:
    return [i for i, channel in enumerate(scene.hand.channels) if channel.adapting == "fast"]


def fingers(scene: Scene) -> np.ndarray:
    return np.array([channel.finger for channel in scene.hand.channels])


def touching(scene: Scene) -> np.ndarray:
    """Which channels belong to an element that touches, ``[C]``."""
    grasp = insides(scene)[0]
    return np.isin(grasp.element_of_channel, grasp.touching)


def test_the_papers_scene_has_none_and_does_not_say_so():
    assert "imperfections" not in scene_of("paper", "M1").to_dict()
    hard = scene_of("hard", "M1")
    assert Scene.from_dict(hard.to_dict()) == hard
    assert all(getattr(hard.imperfections, name) > 0 for name in WAYS)
    assert replace(hard, imperfections=Imperfections(), name="paper") == scene_of("paper", "M1")


@pytest.mark.parametrize("model", ["kinematic", "one"])
def test_no_imperfection_moves_the_truth(model):
    hard = scene_of("hard", "M6", **CONTACTS[model])
    assert timeline(hard) == timeline(replace(hard, imperfections=Imperfections()))


def test_local_noise_is_there_at_rest_and_each_elements_own():
    scene = scene_of("paper", "M3", **QUIET)
    noise = part(added("M3", local_noise_mv=2.0), *REST_S)
    down = touching(scene)
    assert np.abs(noise[~down]).max() == 0
    grasp, pvdf = insides(scene)[0], [i for i in films(scene) if down[i]]
    load = grasp.load_n[grasp.element_of_channel]
    level_mv = 1e3 * rms(noise[pvdf]) / np.sqrt(load[pvdf])
    assert 2.0 / 2 < np.median(level_mv) < 2.0 * 2  # a dozen draws of spread .5 and gains of .3
    alike = np.abs(np.corrcoef(noise[pvdf]))
    element = grasp.element_of_channel[pvdf]
    other = element[:, None] != element
    assert alike[other].max() < 0.3
    assert other.any()


def test_shares_wander_each_on_its_own_by_their_spread():
    """At rest before any stroke a gauge's preload is its load."""
    scene = scene_of("paper", "M3", strokes=[], tail_s=60.0, **QUIET, sg_offset_v=0.0)
    still = {"sg_session_offset_v": 0.0, "sg_offset_v": 0.0, "pvdf_offset_mv": 0.0}
    made = {
        s: volts(scene_of("paper", "M3", strokes=[], tail_s=60.0, **QUIET | still, **k))
        for s, k in (("with", {"share_wander": 0.25}), ("without", {}))
    }
    gauges = [i for i in np.flatnonzero(touching(scene)) if i not in films(scene)]
    log_factor = np.log(made["with"][gauges] / made["without"][gauges])
    assert np.median(rms(log_factor)) == pytest.approx(0.25, rel=0.15)
    grasp = insides(scene)[0]
    element = grasp.element_of_channel[gauges]
    alike = np.abs(np.corrcoef(log_factor[:, ::100]))
    assert np.median(alike[element[:, None] != element]) < 0.3
    assert np.abs(np.diff(log_factor)).max() < 0.01  # slow: no jump from sample to sample


def test_gains_drift_with_the_channel_and_not_with_the_element():
    scene = scene_of("paper", "M3", **QUIET)
    still = QUIET | {"sg_session_offset_v": 0.0, "sg_offset_v": 0.0, "pvdf_offset_mv": 0.0}
    with_it, without = (volts(scene_of("paper", "M3", **still, gain_drift=g)) for g in (0.1, 0.0))
    gauges = [i for i in np.flatnonzero(touching(scene)) if i not in films(scene)]
    log_gain = np.log(with_it[gauges] / without[gauges])
    assert np.median(rms(log_gain)) == pytest.approx(0.1, rel=0.2)
    for index in films(scene):
        if touching(scene)[index]:
            here = np.abs(without[index]) > 0.02
            ratio = with_it[index][here] / without[index][here]
            assert 0.5 < ratio.min() <= ratio.max() < 2.0


def test_pick_up_is_one_signal_with_a_coupling_of_each_channel():
    scene = scene_of("paper", "M3", **QUIET)
    wave = added("M3", pickup_mv=2.0)
    singular = np.linalg.svd(wave[:, :4000], compute_uv=False)
    assert singular[1] < 1e-4 * singular[0]
    levels, pvdf = rms(wave), films(scene)
    gauges = [i for i in range(len(levels)) if i not in pvdf]
    assert 2e-3 / 2.5 < np.median(levels[pvdf]) < 2e-3 * 2.5
    assert np.median(levels[gauges]) < 0.3 * np.median(levels[pvdf])
    signs = np.sign(wave @ wave[pvdf[0]])
    assert {-1.0, 1.0} == set(signs)
    assert np.log(levels[pvdf]).std() > 0.3


def test_a_finger_that_slips_alone_is_heard_at_rest_and_a_finger_that_sticks_falls_silent():
    changes = {"partial_slips_per_s": 0.5, **QUIET}
    scene = scene_of("paper", "M1", **changes)
    plain = volts(scene_of("paper", "M1", **QUIET))
    changed = volts(scene) - plain
    truth, down, own = timeline(scene), touching(scene), fingers(scene)
    starts, ends = truth.arm_s[0][0], truth.sliding_s[0][1]
    heard = silent = 0
    for finger in sorted(set(own)):
        mine = [i for i in films(scene) if own[i] == finger and down[i]]
        intervals = partial_intervals(scene, finger)
        inside = is_within(list(intervals), changed.shape[1])
        if mine:
            assert np.abs(changed[mine][:, ~inside]).max() < 1e-9
        for start_s, stop_s in intervals:
            alone = sum(
                a < stop_s and start_s < b
                for other in sorted(set(own))
                for a, b in partial_intervals(scene, other)
            )
            if not mine or alone > 1:
                continue
            if stop_s < starts:
                assert rms(part(changed[mine], start_s, stop_s)).min() > 1e-3
                heard += 1
            elif truth.sliding_s[0][0] + 0.05 < start_s and stop_s < ends - 0.05:
                middle = (start_s + 0.015, stop_s - 0.015)
                if middle[1] - middle[0] > 0.03:
                    left = rms(part(plain[mine] + changed[mine], *middle))
                    assert np.median(left / rms(part(plain[mine], *middle))) < 0.5
                    silent += 1
    assert heard
    assert silent
