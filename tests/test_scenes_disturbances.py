"""A machine, a bad mains, a warming hand: what each adds, when, and at which frequencies."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scene_files import (
    FINE,
    RATE_HZ,
    difference,
    end_s,
    is_within,
    part,
    rms,
    scene_of,
    volts,
    whole_grid,
)
from scipy.stats import kstest

from tactslip_torch.simulation import Scene, timeline
from tactslip_torch.simulation.disturbances import mains_bursts, motor_level_mv
from tactslip_torch.simulation.machine import machine_runs, machine_wave, rotation_hz

TWO = ("M3", "M6")


def harmonic_share(samples: np.ndarray, hertz: float, orders: tuple[int, ...]) -> np.ndarray:
    """Of each row's power, what a least-squares fit of the harmonics takes: no window, no leak."""
    time_s = np.arange(samples.shape[-1]) / RATE_HZ
    angles = 2 * np.pi * hertz * np.outer(time_s, orders)
    basis = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    fitted = basis @ np.linalg.lstsq(basis, samples.T, rcond=None)[0]
    return np.sum(fitted.T**2, -1) / np.sum(samples**2, -1)


# Machine -------------------------------------------------------------------------------------


def full_speed(scene: Scene) -> tuple[float, float]:
    """A stretch in which the machine runs at its full speed for half a second at least."""
    duration_s = timeline(scene).duration_s
    runs = [(a + 0.31, min(b, duration_s) - 0.31) for a, b in machine_runs(scene, duration_s)]
    return max(runs, key=lambda run: run[1] - run[0])


@pytest.mark.parametrize("material", TWO)
def test_a_machine_runs_at_its_lines_and_stands_still_between(material):
    added, scene = difference("machine", material, "machine_mv"), scene_of("machine", material)
    runs = machine_runs(scene, timeline(scene).duration_s)
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
    start_s, stop_s = machine_runs(scene, duration_s)[0]
    wave = machine_wave(scene, duration_s, whole_grid(round(duration_s * RATE_HZ))).reshape(-1)
    level = [rms(part(wave, start_s + t, start_s + t + 0.03)) for t in (0.085, 0.185, 0.4)]
    assert level[0] / level[2] == pytest.approx((0.1 / 0.3) ** 2, rel=0.25)
    assert level[1] / level[2] == pytest.approx((0.2 / 0.3) ** 2, rel=0.15)
    slow = scene_of("machine", "M3", machine_hz=(12.0, 12.1))
    wave = machine_wave(slow, duration_s, whole_grid(round(duration_s * RATE_HZ))).reshape(-1)
    whole_run = part(wave, start_s + 0.31, stop_s - 0.31)
    assert np.abs(np.diff(wave)).max() < 1.01 * np.abs(np.diff(whole_run)).max()  # no seam
    assert rms(whole_run) == pytest.approx(1.0, rel=0.02)


def test_a_machine_runs_up_and_down_with_its_speed(monkeypatch):
    monkeypatch.setattr("tactslip_torch.simulation.machine.ORDERS", (1,))
    scene = scene_of("machine", "M3", machine_hz=(200.0, 200.1))
    duration_s = timeline(scene).duration_s
    start_s, stop_s = machine_runs(scene, duration_s)[0]
    wave = machine_wave(scene, duration_s, whole_grid(round(duration_s * RATE_HZ))).reshape(-1)
    for from_s, to_s, turns in (
        (start_s + 0.1, start_s + 0.2, 10.0),  # half of 200 Hz, in the middle of the ramp
        (start_s + 0.5, start_s + 0.6, 20.0),
        (stop_s - 0.2, stop_s - 0.1, 10.0),
    ):
        crossings = np.sum(np.diff(np.sign(part(wave, from_s, to_s))) != 0)
        assert crossings == pytest.approx(2 * turns, abs=1.5)


def test_a_machine_is_the_sessions_and_its_runs_are_the_recordings():
    def level(cycle: int, **changes: str) -> np.ndarray:
        scene = scene_of("machine", "M3", cycle, **changes)
        return rms(
            part(difference("machine", "M3", "machine_mv", cycle, **changes), *full_speed(scene))
        )

    first, second, other = level(0), level(1), level(0, session="another")
    np.testing.assert_allclose(first, second, rtol=0.05)
    assert np.abs(np.log(first / other)).max() > 0.3
    speeds = {rotation_hz(scene_of("machine", "M3", cycle)) for cycle in range(3)}
    assert len(speeds) == 1
    assert rotation_hz(scene_of("machine", "M3", session="another")) not in speeds
    runs = [machine_runs(scene_of("machine", "M3", cycle), 15.0) for cycle in (0, 1)]
    assert runs[0] != runs[1]
    long = machine_runs(scene_of("machine", "M3"), 100.0)
    assert long[: len(runs[0])] == runs[0]
    lengths = np.array([b - a for a, b in long])
    gaps = np.array([b[0] - a[1] for a, b in pairwise(long)])
    assert len(long) > 10
    assert 1.0 <= lengths.min() < lengths.max() <= 4.0
    assert 0.5 <= gaps.min() < gaps.max() <= 2.0


def machine_contrast(scene: Scene) -> float:
    """Power at the machine's lines in films at rest before the first slide, over next to them."""
    films = volts(scene)[14:, : round(RATE_HZ * (timeline(scene).onsets_s[0] - 0.5))]
    hertz = rotation_hz(scene)
    on, off = (harmonic_share(films, factor * hertz, (1, 2, 3)) for factor in (1.0, 1.37))
    return float(np.median(on / off))


@pytest.mark.parametrize("material", TWO)
def test_the_machine_stands_out_of_the_noise(material):
    quiet = {"mains_mv": 0.0, "burst_rate_hz": 0.0, "pvdf_drift_mv": 0.0, "pvdf_offset_mv": 0.0}
    cycle = next(
        c for c in range(20) if machine_runs(scene_of("machine", material, c), 15.0)[0][0] < 0.5
    )
    assert machine_contrast(scene_of("machine", material, cycle, **quiet)) > 5.0
    assert machine_contrast(scene_of("machine", material, cycle, machine_mv=0.0, **quiet)) < 2.0


# Mains ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("material", TWO)
def test_mains_bursts_are_mains_and_only_in_their_stretches(material):
    steady = {"mains_bursts_per_s": 1.0}
    added = difference("mains_bursts", material, "mains_bursts_per_s", **steady)
    scene = scene_of("mains_bursts", material, **steady, **FINE)
    bursts = mains_bursts(scene, end_s(scene))
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
    bursts = mains_bursts(scene, end_s(scene))
    start_s, stop_s = max(bursts, key=lambda burst: burst[1] - burst[0])
    burst, plain = (part(x, start_s + 0.03, stop_s - 0.03) for x in (added, hum))
    factor = np.sum(burst * plain, -1) / np.sum(plain**2, -1)
    np.testing.assert_allclose(burst, factor[:, None] * plain, atol=1e-6)  # one wave, one phase
    np.testing.assert_allclose(factor, factor[0], rtol=1e-4)  # one coupling per channel
    amplitude_mv = 1e3 * np.sqrt(2 * harmonic_share(burst, 50.0, (1,)) * np.mean(burst**2, -1))
    assert 50.0 / 1.5 < np.median(amplitude_mv) < 50.0 * 1.5


# Warming -------------------------------------------------------------------------------------


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


def test_the_drift_scene_wanders_far_at_rest_and_the_paper_does_not():
    def wander(**changes: float) -> float:
        rest = volts(scene_of("drift", "M3", lifted_fraction=0.99, **changes))[:14]
        return float(np.median(np.ptp(rest[:, ::50], axis=-1)))

    off = {"warming_mv": 0.0, "sg_drift_mv": 3.0, "arm_transient_mv": 0.0}
    assert wander(arm_transient_mv=0.0) > 0.2
    assert wander(**off) < 0.05


# Motor ---------------------------------------------------------------------------------------


def test_a_range_of_motor_vibration_is_drawn_per_recording_and_moves_nothing_else():
    bounds = (1.0, 30.0)
    first = scene_of("arm_motion", "M3", motor_vibration_mv=bounds)
    scenes = [replace(first, cycle=cycle) for cycle in range(200)]
    levels = np.array([motor_level_mv(scene) for scene in scenes])
    place = np.log(levels / bounds[0]) / np.log(bounds[1] / bounds[0])
    assert kstest(place, "uniform").pvalue > 0.01
    again = scene_of("arm_motion", "M3", motor_vibration_mv=float(levels[0]))
    assert np.array_equal(volts(scenes[0]), volts(again))


def test_an_empty_range_of_motor_vibration_is_refused():
    with pytest.raises(ValueError, match=r"motor_vibration_mv must be \(low, high\)"):
        scene_of("arm_motion", "M3", motor_vibration_mv=(3.0, 1.0))
