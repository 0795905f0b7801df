"""What every channel hears that is not slip: arm, motor, mains, a machine, knocks.

Each is a common signal (or a few) times one coupling per channel. Everything is a function of
absolute time, so any stretch can be computed alone.
"""

from __future__ import annotations

import numpy as np

from tactslip_torch.simulation.events import Stretch, smooth_step
from tactslip_torch.simulation.grasp import recording_key, session_key
from tactslip_torch.simulation.grid import Grid, causal_response
from tactslip_torch.simulation.machine import machine_wave
from tactslip_torch.simulation.motion import ArmStroke, Motion
from tactslip_torch.simulation.randomness import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.scene import Scene

ARM_MODES_HZ = (6.0, 6.5, 15.0, 56.0, 87.0, 277.0)
"""Modes of a light arm with payload (Wu 2021, Intell. Robot. 1(2):99), proxy for the UR5e."""

ARM_MODE_WEIGHTS = (0.25, 0.15, 0.25, 0.2, 0.1, 0.05)
"""Their shares of a transient's first swing (prior, ours)."""

MAINS_ORDERS = (1, 2, 3, 5, 7, 9)
"""Harmonics of the mains, up to 450 Hz."""

MOTOR_PITCH_MM = (0.37, 0.61)
"""Arm travel per turn of two gears that are heard (prior, ours)."""

MAINS_BURST_S = (0.1, 1.0)
"""How long the mains is stronger in a burst; log-uniform (prior, ours)."""

_MAINS_RAMP_S = 0.02  # of a burst, at both ends


class Common:
    """The disturbances of one recording on a grid, ready to be mixed into channels.

    Args:
        scene: whose disturbances.
        motion: the arm's own, and where; its plan may be empty.
        duration_s: of the recording.
    """

    def __init__(self, scene: Scene, motion: Motion, duration_s: float) -> None:
        plan, grid = motion.plan, motion.grid
        self.grid = grid
        num = len(scene.hand)
        knobs = scene.disturbances
        session = generator(*session_key(scene, "couplings"))
        mains_v = 1e-3 * knobs.mains_mv * lognormal(session, knobs.mains_session_spread)
        couplings = lognormal(session, 0.4, num)
        self._mains_v = mains_v * couplings
        self._mains_burst_v = 1e-3 * knobs.mains_burst_mv * couplings
        motor_mv = motor_level_mv(scene)
        self._motor_v = 1e-3 * motor_mv * lognormal(session, 0.3, num)
        signs = np.where(session.random((num, len(ARM_MODES_HZ))) < 0.5, -1.0, 1.0)
        self._arm_v = (
            1e-3
            * knobs.arm_transient_mv
            * signs
            * lognormal(session, 0.4, (num, len(ARM_MODES_HZ)))
        )
        self._mains_bursts = mains_bursts(scene, duration_s)
        hums = knobs.mains_mv > 0 or self._mains_bursts
        self._mains = _mains(scene, grid) if hums else None
        self._mains_envelope = _burst_envelope(self._mains_bursts, grid)
        self._motor = _motor(scene, motion) if plan and motor_mv > 0 else None
        rings = plan and knobs.arm_transient_mv > 0
        self._arm = _arm_ringing(scene, plan, grid) if rings else None
        self._bursts = _draw_bursts(scene, duration_s)
        self._machine = machine_wave(scene, duration_s, grid) if knobs.machine_mv > 0 else None
        session = generator(*session_key(scene, "machine couplings"))
        self._machine_v = 1e-3 * knobs.machine_mv * lognormal(session, 0.4, num)

    def channel(self, index: int) -> Array:
        """Volts of all disturbances in one channel, ``[K, B]``."""
        volts = np.zeros(self.grid.time_s.shape)
        if self._mains is not None:
            volts += self._mains_v[index] * self._mains
            if self._mains_bursts:
                volts += self._mains_burst_v[index] * self._mains_envelope * self._mains
        if self._motor is not None:
            rows, motor = self._motor
            volts[rows] += self._motor_v[index] * motor
        if self._arm is not None:
            rows, modes = self._arm
            for gain, mode in zip(self._arm_v[index], modes, strict=True):
                volts[rows] += gain * mode
        if self._machine is not None:
            volts += self._machine_v[index] * self._machine
        self._add_bursts(index, volts)
        return volts

    def _add_bursts(self, index: int, volts: Array) -> None:
        """Add the knocks that this channel feels."""
        times, omegas, decays, sizes = self._bursts
        for start_s, omega, decay, size in zip(times, omegas, decays, sizes[:, index], strict=True):
            if size:
                rows = self.grid.overlapping(start_s, start_s + 12.0 / decay)
                since = np.maximum(self.grid.time_s[rows] - start_s, 0.0)
                volts[rows] += size * np.exp(-decay * since) * np.sin(omega * since)


def _mains(scene: Scene, grid: Grid) -> Array:
    """Fundamental of amplitude 1 with its harmonics, one phase for all channels."""
    session = generator(*session_key(scene, "mains"))
    levels = 0.3 * lognormal(session, 0.5, len(MAINS_ORDERS)) / np.asarray(MAINS_ORDERS)
    phases = 2 * np.pi * session.random(len(MAINS_ORDERS))
    rng = generator(*recording_key(scene, "mains"))
    hertz = scene.disturbances.mains_hz + 0.02 * rng.standard_normal()
    angle = 2 * np.pi * (hertz * grid.time_s + rng.random())
    wave = np.sin(angle)
    for order, level, phase in list(zip(MAINS_ORDERS, levels, phases, strict=True))[1:]:
        if order * hertz < 0.5 * scene.sample_rate_hz:
            wave += level * np.sin(order * angle + phase)
    return wave


def mains_bursts(scene: Scene, duration_s: float) -> tuple[Stretch, ...]:
    """When the mains is stronger; bursts may overlap, and then add."""
    rng = generator(*recording_key(scene, "mains bursts"))
    num = int(rng.poisson(scene.disturbances.mains_bursts_per_s * duration_s))
    starts_s = duration_s * rng.random(num)
    ends_s = [start_s + log_uniform(rng, MAINS_BURST_S) for start_s in starts_s]
    return tuple(zip(starts_s.tolist(), ends_s, strict=True))


def _burst_envelope(bursts: tuple[Stretch, ...], grid: Grid) -> Array:
    """1 in every burst, with smooth ends, and 0 outside, ``[K, B]``."""
    envelope = np.zeros(grid.time_s.shape)
    for start_s, end_s in bursts:
        rows = grid.overlapping(start_s, end_s)
        t = grid.time_s[rows]
        rise, fall = ((t - start_s) / _MAINS_RAMP_S, (end_s - t) / _MAINS_RAMP_S)
        envelope[rows] += smooth_step(rise) * smooth_step(fall)
    return envelope


def motor_level_mv(scene: Scene) -> float:
    """The recording's motor vibration: the scene's, or a draw of its own from the scene's range."""
    level = scene.disturbances.motor_vibration_mv
    if isinstance(level, tuple):
        return log_uniform(generator(*recording_key(scene, "motor level")), level)
    return level


def _motor(scene: Scene, motion: Motion) -> tuple[slice, Array]:
    """Vibration of unit rms at 40 mm/s while the arm moves: two gear lines and broad noise."""
    grid, plan = motion.grid, motion.plan
    rows = grid.overlapping(plan[0].start_s, plan[-1].stop_s)
    part = Grid(grid.blocks[rows], grid.block_samples, grid.sample_rate_hz)
    if not len(part.blocks):
        return rows, np.zeros(part.time_s.shape)
    f = np.maximum(part.frequency_hz(), 1.0)
    response = causal_response(f**2 / (f**2 + 20.0**2) / (1 + (f / 200.0) ** 2), unit_power=True)
    noise = part.coloured_noise(recording_key(scene, "motor"), response)
    for pitch in MOTOR_PITCH_MM:
        noise += np.sin(2 * np.pi / pitch * motion.position_mm[rows])
    level = np.sqrt(motion.speed_mm_s[rows] / 40.0)
    return rows, level * noise / np.sqrt(2.0)


def _arm_ringing(
    scene: Scene, plan: tuple[ArmStroke, ...], grid: Grid
) -> tuple[slice, list[Array]]:
    """The arm's modes, struck at every start and stop, one ``[K, B]`` per mode.

    Between two strikes a mode is one decaying phasor, the sum of all strikes before.
    """
    rng = generator(*recording_key(scene, "arm"))
    strikes_s = np.sort([time for stroke in plan for time in (stroke.start_s, stroke.stop_s)])
    sizes = lognormal(rng, 0.3, len(strikes_s)) * np.tile([1.0, -1.0], len(plan))
    session = generator(*session_key(scene, "arm"))
    hertz = np.asarray(ARM_MODES_HZ) * lognormal(session, 0.03, len(ARM_MODES_HZ))
    damping = 0.03 + 0.03 * session.random(len(ARM_MODES_HZ))
    rows = grid.overlapping(strikes_s[0], grid.time_s[-1, -1])
    t = grid.time_s[rows]
    since_strike = np.searchsorted(strikes_s, t, side="right") - 1
    elapsed = np.maximum(t - strikes_s[np.maximum(since_strike, 0)], 0.0)
    modes = []
    for frequency, ratio, weight in zip(hertz, damping, ARM_MODE_WEIGHTS, strict=True):
        rate = 2 * np.pi * frequency * complex(-ratio, 1.0)
        phasors = [0j]  # before the first strike
        for number, size in enumerate(sizes):
            gap_s = strikes_s[number] - strikes_s[number - 1] if number else 0.0
            phasors.append(phasors[-1] * np.exp(rate * gap_s) + weight * size)
        phasor = np.asarray(phasors)[since_strike + 1]
        angle, fade = rate.imag * elapsed, np.exp(rate.real * elapsed)
        modes.append(fade * (phasor.imag * np.cos(angle) + phasor.real * np.sin(angle)))
    return rows, modes


def _draw_bursts(scene: Scene, duration_s: float) -> tuple[Array, Array, Array, Array]:
    """Knocks at random times: time, angular frequency, decay rate ``[n]``, volts ``[n, C]``.

    Each reaches about half of the channels, strain gauges weakly (prior, ours).
    """
    knobs = scene.disturbances
    rng = generator(*recording_key(scene, "bursts"))
    num = int(rng.poisson(knobs.burst_rate_hz * duration_s))
    times = duration_s * rng.random(num)
    omegas = 2 * np.pi * 15.0 * 10.0 ** rng.random(num)
    decays = 1.0 / (0.005 * 10.0 ** rng.random(num))
    reach = rng.random((num, len(scene.hand))) < 0.5
    share = np.array([1.0 if c.adapting == "fast" else 0.3 for c in scene.hand.channels])
    sizes = 1e-3 * knobs.burst_mv * lognormal(rng, 0.5, (num, 1))
    sizes = sizes * lognormal(rng, 0.5, (num, len(scene.hand))) * share * reach
    return times, omegas, decays, sizes
