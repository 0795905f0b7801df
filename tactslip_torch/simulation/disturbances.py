"""What is in a recording and is no slip of the hand: disturbances, handling, imperfections, faults.

*Disturbances* reach every channel: arm, motor, mains, knocks, a machine beside the hand. Each is a
common signal (or a few) times one coupling per channel.

*Handling* loads the contact without sliding: a carried object's inertia, taps, changes of grip. It
comes on top of what the contact says, and only where nothing slides: at rest and in strokes that
move ``"both"``, ``MARGIN_S`` away from any stroke that slides. One thing reaches further: a carried
object's shear outlasts its stroke by ``JERK_S``, into a slide that begins sooner, where it is heard
and moves no truth. Taps and grips press harder and never less, and carried shear stays below half
of static friction, so a contact that sticks goes on sticking: no slip begins or ends by them.

*Imperfections* are noise, wander and partial slip of single elements; *faults* are what is broken
between the sensors and the file. Neither moves what slides and when.

Everything is a function of absolute time and of keys of its own, so any stretch can be computed
alone, and nothing moves by what is switched on beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.blocks import (
    Array,
    Grid,
    Interval,
    causal_response,
    generator,
    log_uniform,
    lognormal,
    smooth_step,
)
from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.scene import ArmStroke, Motion, Scene
from tactslip_torch.simulation.sensors import Vibration, band_responses, shear_noise_v

# --- disturbances of every channel ----------------------------------------------------------------

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


@dataclass(frozen=True, eq=False)
class CommonWave:
    """A signal that reaches every channel.

    Args:
        volts: at a wave of 1, of every channel, ``[C]``.
        rows: of the grid where it is not zero.
        wave: there, ``[k, B]``.
    """

    volts: Array
    rows: slice
    wave: Array


def common_waves(scene: Scene, motion: Motion) -> list[CommonWave]:
    """Mains, motor, arm, machine and knocks of one recording.

    Args:
        scene: whose disturbances.
        motion: the arm's own, and where; its plan may be empty.
    """
    plan, grid, num, of = motion.plan, motion.grid, len(scene.hand), scene.disturbances
    modes, everywhere, waves = len(ARM_MODES_HZ), slice(None), []
    session = generator(*scene.session_key("couplings"))
    mains_v = 1e-3 * of.mains_mv * lognormal(session, of.mains_session_spread)
    couplings = lognormal(session, 0.4, num)
    motor_mv = _motor_level_mv(scene)
    motor_v = 1e-3 * motor_mv * lognormal(session, 0.3, num)
    signs = np.where(session.random((num, modes)) < 0.5, -1.0, 1.0)
    arm_v = 1e-3 * of.arm_transient_mv * signs * lognormal(session, 0.4, (num, modes))
    bursts = mains_bursts(scene)
    if of.mains_mv > 0 or bursts:
        mains = _mains(scene, grid)
        waves.append(CommonWave(mains_v * couplings, everywhere, mains))
        if bursts:
            stronger = _burst_envelope(bursts, grid) * mains
            waves.append(CommonWave(1e-3 * of.mains_burst_mv * couplings, everywhere, stronger))
    if plan and motor_mv > 0:
        waves.append(CommonWave(motor_v, *_motor(scene, motion)))
    if plan and of.arm_transient_mv > 0:
        rows, ringing = _arm_ringing(scene, plan, grid)
        waves += [CommonWave(v, rows, mode) for v, mode in zip(arm_v.T, ringing, strict=True)]
    if of.machine_mv > 0:
        machine_v = lognormal(generator(*scene.session_key("machine couplings")), 0.4, num)
        waves.append(
            CommonWave(1e-3 * of.machine_mv * machine_v, everywhere, machine_wave(scene, grid))
        )
    return waves + _knocks(scene, grid)


def _mains(scene: Scene, grid: Grid) -> Array:
    """Fundamental of amplitude 1 with its harmonics, one phase for all channels."""
    session = generator(*scene.session_key("mains"))
    levels = 0.3 * lognormal(session, 0.5, len(MAINS_ORDERS)) / np.asarray(MAINS_ORDERS)
    phases = 2 * np.pi * session.random(len(MAINS_ORDERS))
    rng = generator(*scene.key("mains"))
    hertz = scene.disturbances.mains_hz + 0.02 * rng.standard_normal()
    angle = 2 * np.pi * (hertz * grid.time_s + rng.random())
    wave = np.sin(angle)
    for order, level, phase in list(zip(MAINS_ORDERS, levels, phases, strict=True))[1:]:
        if order * hertz < 0.5 * scene.sample_rate_hz:
            wave += level * np.sin(order * angle + phase)
    return wave


def mains_bursts(scene: Scene) -> tuple[Interval, ...]:
    """When the mains is stronger; bursts may overlap, and then add."""
    rng = generator(*scene.key("mains bursts"))
    num = int(rng.poisson(scene.disturbances.mains_bursts_per_s * scene.end_s))
    starts_s = scene.end_s * rng.random(num)
    ends_s = [start_s + log_uniform(rng, MAINS_BURST_S) for start_s in starts_s]
    return tuple(zip(starts_s.tolist(), ends_s, strict=True))


def _burst_envelope(bursts: tuple[Interval, ...], grid: Grid) -> Array:
    """1 in every burst, with smooth ends, and 0 outside, ``[K, B]``."""
    envelope = grid.zeros()
    for start_s, end_s in bursts:
        rows = grid.overlapping(start_s, end_s)
        t = grid.time_s[rows]
        rise, fall = ((t - start_s) / _MAINS_RAMP_S, (end_s - t) / _MAINS_RAMP_S)
        envelope[rows] += smooth_step(rise) * smooth_step(fall)
    return envelope


def _motor_level_mv(scene: Scene) -> float:
    """The recording's motor vibration: the scene's, or a draw of its own from the scene's range."""
    level = scene.disturbances.motor_vibration_mv
    if isinstance(level, tuple):
        return log_uniform(generator(*scene.key("motor level")), level)
    return level


def _motor(scene: Scene, motion: Motion) -> tuple[slice, Array]:
    """Vibration of unit rms at 40 mm/s while the arm moves: two gear lines and broad noise."""
    grid, plan = motion.grid, motion.plan
    rows = grid.overlapping(plan[0].start_s, plan[-1].stop_s)
    part = grid.only(rows)
    if not len(part.blocks):
        return rows, np.zeros(part.time_s.shape)
    f = np.maximum(part.frequency_hz(), 1.0)
    response = causal_response(f**2 / (f**2 + 20.0**2) / (1 + (f / 200.0) ** 2), unit_power=True)
    noise = part.coloured_noise(scene.key("motor"), response)
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
    rng = generator(*scene.key("arm"))
    strikes_s = np.sort([time for stroke in plan for time in (stroke.start_s, stroke.stop_s)])
    sizes = lognormal(rng, 0.3, len(strikes_s)) * np.tile([1.0, -1.0], len(plan))
    session = generator(*scene.session_key("arm"))
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


def _knocks(scene: Scene, grid: Grid) -> list[CommonWave]:
    """Knocks at random times, each in about half of the channels, weakly in gauges (ours)."""
    of, num_channels = scene.disturbances, len(scene.hand)
    rng = generator(*scene.key("bursts"))
    num = int(rng.poisson(of.burst_rate_hz * scene.end_s))
    times_s = scene.end_s * rng.random(num)
    omegas = 2 * np.pi * 15.0 * 10.0 ** rng.random(num)
    decays = 1.0 / (0.005 * 10.0 ** rng.random(num))
    reach = rng.random((num, num_channels)) < 0.5
    share = np.array([1.0 if c.adapting == "fast" else 0.3 for c in scene.hand.channels])
    sizes_v = 1e-3 * of.burst_mv * lognormal(rng, 0.5, (num, 1))
    sizes_v = sizes_v * lognormal(rng, 0.5, (num, num_channels)) * share * reach
    return [
        CommonWave(size_v, *grid.ringing(time_s, 12.0 / decay, omega, decay))
        for time_s, omega, decay, size_v in zip(times_s, omegas, decays, sizes_v, strict=True)
    ]


# --- a machine beside the hand --------------------------------------------------------------------

MACHINE_ORDERS = (1, 2, 3, 4, 6, 8)
"""Harmonics of the rotation."""

MACHINE_RUN_S = (1.0, 4.0)
"""How long a run lasts; log-uniform (ours)."""

MACHINE_BREAK_S = (0.5, 2.0)
"""How long the machine stands between runs; log-uniform (ours)."""

MACHINE_RAMP_S = 0.3
"""How long it runs up and down, at both ends of a run (ours)."""


def machine_runs(scene: Scene) -> tuple[Interval, ...]:
    """When the neighbouring machine turns, runs up or runs down; the last run may go on."""
    if scene.disturbances.machine_mv == 0:
        return ()
    rng = generator(*scene.key("machine"))
    runs, now_s = [], MACHINE_BREAK_S[1] * rng.random()
    while now_s < scene.end_s:
        stop_s = now_s + log_uniform(rng, MACHINE_RUN_S)
        runs.append((now_s, stop_s))
        now_s = stop_s + log_uniform(rng, MACHINE_BREAK_S)
    return tuple(runs)


def rotation_hz(scene: Scene) -> float:
    """The machine's rotation at full speed; the session's."""
    rng = generator(*scene.session_key("machine"))
    return log_uniform(rng, scene.disturbances.machine_hz)


def machine_wave(scene: Scene, grid: Grid) -> Array:
    """The machine's vibration, of unit rms at full speed and zero where it stands, ``[K, B]``.

    In a run the rotation's phase is the integral of a speed that rises and falls linearly, and
    each harmonic's size goes with the square of that speed. Orders that would be folded at the
    converter are left out.

    Raises:
        ValueError: if the rotation itself would be folded.
    """
    wave, hertz = grid.zeros(), rotation_hz(scene)
    highest_hz = 0.45 * scene.sample_rate_hz
    if hertz >= highest_hz:
        raise ValueError(
            f"machine_hz must lie below {highest_hz:g} Hz at {scene.sample_rate_hz:g} samples a "
            f"second, got {scene.disturbances.machine_hz}"
        )
    rng = generator(*scene.session_key("machine harmonics"))
    orders = np.array(MACHINE_ORDERS)
    levels = lognormal(rng, 0.5, len(orders)) / orders
    phases = 2 * np.pi * rng.random(len(orders))
    levels = np.where(orders * hertz < highest_hz, levels, 0.0)
    levels *= np.sqrt(2.0 / np.sum(levels**2))
    for start_s, stop_s in machine_runs(scene):
        rows = grid.overlapping(start_s, stop_s)
        since = np.clip(grid.time_s[rows] - start_s, 0.0, stop_s - start_s)
        left = stop_s - start_s - since
        speed = np.clip(np.minimum(since, left) / MACHINE_RAMP_S, 0.0, 1.0)
        up: Array = np.minimum(since, MACHINE_RAMP_S)
        down: Array = np.maximum(MACHINE_RAMP_S - left, 0.0)
        turns = hertz * (since - up + (up**2 - down**2) / (2 * MACHINE_RAMP_S))
        for order, level, phase in zip(MACHINE_ORDERS, levels, phases, strict=True):
            if level > 0:
                wave[rows] += level * speed**2 * np.sin(2 * np.pi * order * turns + phase)
    return wave


# --- handling -------------------------------------------------------------------------------------

MARGIN_S = 0.1
"""Between a tap or grip, with its settling, and a stroke that slides (ours)."""

SETTLE_S = 0.1
"""How long a film still tells of a tap or grip that is over (ours)."""

SHARE_SPREAD = 0.3
"""How unevenly elements share a tap or grip: spread of a factor on their load (ours)."""
RINGING_S = 0.3
"""How long the arm's ringing counts as handling after a stroke (ours)."""

JERK_S = 0.03
"""How long the object takes to follow a change of the arm's acceleration: a raised cosine (ours).

The skin of all elements and 0.2 kg resonate near 40 Hz.
"""

MOST_CARRIED_SHARE = 0.5
"""Of static friction, what a carried object may take."""

KNOCK_V_PER_N = 0.05
"""First swing of each of a knock's modes at a film, per newton of the tap's peak (ours)."""

KNOCK_HZ = (60.0, 800.0)
"""Where a knock's modes lie."""

_KNOCK_MODES = 8
_KNOCK_DECAY_S = (0.002, 0.008)


@dataclass(frozen=True, eq=False)
class Event:
    """A tap or a change of grip.

    Args:
        start_s: when it begins.
        duration_s: until the load is what it was before.
        size: newtons of a tap on an element of relative load 1, or a grip's rise over the load.
        shares: factor on it for every element, ``[E]``.
    """

    start_s: float
    duration_s: float
    size: float
    shares: Array

    @property
    def end_s(self) -> float:
        """When the load is what it was before."""
        return self.start_s + self.duration_s

    @property
    def interval_s(self) -> Interval:
        """What of the recording tells of it."""
        return self.start_s, self.end_s + SETTLE_S


def _merged(intervals: list[Interval]) -> tuple[Interval, ...]:
    """The union of intervals, ascending and apart; empty ones are left out."""
    union: list[list[float]] = []
    for start_s, end_s in sorted(intervals):
        if end_s <= start_s:
            continue
        if union and start_s <= union[-1][1]:
            union[-1][1] = max(union[-1][1], end_s)
        else:
            union.append([start_s, end_s])
    return tuple((start_s, end_s) for start_s, end_s in union)


def _quiet(scene: Scene) -> tuple[Interval, ...]:
    """Where nothing slides or is about to: all but the strokes that slide, and ``MARGIN_S``."""
    quiet, now_s = [], 0.0
    for stroke in scene.slides:
        quiet.append((now_s, stroke.start_s - MARGIN_S))
        now_s = stroke.stop_s + MARGIN_S
    return _merged([*quiet, (now_s, scene.end_s)])


def _draw_events(
    scene: Scene,
    grasp: Grasp,
    purpose: str,
    rate_hz: float,
    sizes: tuple[float, float],
    lengths_s: tuple[float, float],
) -> tuple[Event, ...]:
    """Events at random times where nothing slides, in order of time."""
    if rate_hz == 0:
        return ()
    quiet = _quiet(scene)
    if not any(end_s - start_s > lengths_s[1] + SETTLE_S for start_s, end_s in quiet):
        raise ValueError(
            f"no rest long enough for {purpose} of up to {lengths_s[1]:g} s, {SETTLE_S:g} s to "
            f"settle and {MARGIN_S:g} s before and after each slide: pause longer or add a tail_s"
        )
    rng = generator(*scene.key(purpose))
    load = grasp.load_n / scene.contact.load_n
    events = []
    for _ in range(rng.poisson(rate_hz * sum(end_s - start_s for start_s, end_s in quiet))):
        length_s, size = log_uniform(rng, lengths_s), log_uniform(rng, sizes)
        shares = lognormal(rng, SHARE_SPREAD, len(load))
        rooms = [(a, b - length_s - SETTLE_S) for a, b in quiet if b - a > length_s + SETTLE_S]
        start_s = _place(rooms, rng.random())
        events.append(Event(start_s, length_s, size, shares * (load if purpose == "taps" else 1)))
    return tuple(sorted(events, key=lambda event: event.start_s))


def _place(rooms: list[Interval], share: float) -> float:
    """The time at a share of the intervals' total length."""
    lengths = np.array([end_s - start_s for start_s, end_s in rooms])
    reached = np.cumsum(lengths)
    room = min(int(np.searchsorted(reached, share * reached[-1], side="right")), len(rooms) - 1)
    return float(rooms[room][1] - (reached[room] - share * reached[-1]))


class Handled:
    """What hands do to the object in one recording.

    Args:
        scene: whose handling.
        grasp: how the hand touches.

    Attributes:
        taps: in order of time.
        grips: the same.

    Raises:
        ValueError: if the carried object would take more than half of static friction, or more
            than a slide before has left of it, or there is no rest long enough for a tap or grip
            that is asked for.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        self._scene, self._plan = scene, scene.arm
        self._share_of_load = grasp.load_n / grasp.load_n.sum()
        _require_carriable(scene, grasp)
        parameters = scene.handling
        tap_s = (1e-3 * parameters.tap_ms[0], 1e-3 * parameters.tap_ms[1])
        self.taps = _draw_events(
            scene, grasp, "taps", parameters.taps_per_s, parameters.tap_n, tap_s
        )
        self.grips = _draw_events(
            scene, grasp, "grips", parameters.grips_per_s, parameters.grip_share, parameters.grip_s
        )

    @property
    def _carried(self) -> tuple[ArmStroke, ...]:
        """Strokes in which an object of some mass moves with the hand."""
        strokes = tuple(stroke for stroke in self._plan if not stroke.slides)
        return strokes if self._scene.handling.carried_kg > 0 else ()

    @property
    def is_idle(self) -> bool:
        """Whether nothing is done."""
        return not (self.taps or self.grips or self._carried)

    def intervals_s(self, duration_s: float) -> tuple[Interval, ...]:
        """Where the hand is handled: ascending, apart, within the recording, never in a slide.

        The whole of a recording without strokes: there is nothing else to tell slip from.
        """
        if not self._plan:
            return ((0.0, duration_s),)
        intervals = [event.interval_s for event in (*self.taps, *self.grips)]
        for number, stroke in enumerate(self._plan):
            later = [s.start_s for s in self._plan[number + 1 :] if s.slides]
            if not stroke.slides:
                stop_s = min([stroke.stop_s + RINGING_S, *later])
                intervals.append((stroke.start_s, stop_s))
        return _merged([(start_s, min(end_s, duration_s)) for start_s, end_s in intervals])

    def shear_n(self, element: int, time_s: Array) -> Array:
        """Newtons of the carried object's inertia on an element; signed like a slide's friction."""
        accelerations = [_smooth_acceleration(stroke, time_s) for stroke in self._carried]
        total: Array = sum(accelerations, np.zeros(time_s.shape))
        per_element = self._scene.handling.carried_kg * float(self._share_of_load[element])
        return per_element * total

    def press_n(self, element: int, before_n: Array, grid: Grid) -> Array:
        """Newtons that taps and grips add to an element's load.

        Args:
            element: which.
            before_n: its load without them, on ``grid``.
            grid: where.

        Shape:
            - before_n, output: ``[K, B]``
        """
        extra = grid.zeros()
        for tap in self.taps:
            rows = grid.overlapping(tap.start_s, tap.end_s)
            phase = np.clip((grid.time_s[rows] - tap.start_s) / tap.duration_s, 0.0, 1.0)
            extra[rows] += tap.size * tap.shares[element] * np.sin(np.pi * phase)
        for grip in self.grips:
            rows = grid.overlapping(grip.start_s, grip.end_s)
            phase = (grid.time_s[rows] - grip.start_s) / grip.duration_s
            rise = smooth_step(4.0 * phase) * smooth_step(4.0 * (1.0 - phase))
            extra[rows] += grip.size * grip.shares[element] * rise * before_n[rows]
        return extra

    def knock_v(self, element: int, grid: Grid) -> Array:
        """What a film of unit gain hears of the taps beyond their force: many modes, soon gone.

        Shape:
            - output: ``[K, B]``
        """
        volts = grid.zeros()
        rng = generator(*self._scene.key("knocks"), element)
        for tap in self.taps:
            low, high = KNOCK_HZ
            hertz = low * (high / low) ** rng.random(_KNOCK_MODES)
            shortest, longest = _KNOCK_DECAY_S
            decay = 1.0 / (shortest * (longest / shortest) ** rng.random(_KNOCK_MODES))
            swing = KNOCK_V_PER_N * tap.size * tap.shares[element]
            swings = swing * rng.standard_normal(_KNOCK_MODES)
            heard = hertz < 0.4 * self._scene.sample_rate_hz
            for f, d, s in zip(hertz[heard], decay[heard], swings[heard], strict=True):
                rows, wave = grid.ringing(tap.start_s, 12.0 * longest, 2 * np.pi * f, d)
                volts[rows] += s * wave
        return volts


def _smooth_acceleration(stroke: ArmStroke, time_s: Array) -> Array:
    """The arm's acceleration in m/s2 as the object follows it: the same change of speed."""
    stop_s = stroke.stop_s - stroke.start_s
    corners_s = (0.0, stroke.ramp_s, stop_s - stroke.ramp_s, stop_s)
    since = time_s - stroke.start_s
    up, even, down, rest = (smooth_step((since - corner) / JERK_S) for corner in corners_s)
    return 1e-3 * stroke.acceleration_mm_s2 * (up - even - down + rest)


def _require_carriable(scene: Scene, grasp: Grasp) -> None:
    """Refuse an object whose inertia comes near to making the contact slide."""
    force_n = scene.handling.carried_kg * scene.acceleration_m_s2
    if force_n == 0 or all(stroke.slides for stroke in scene.arm):
        return
    friction_n = (1.0 - scene.contact.runout) * float(grasp.friction_n.sum())
    what = f"carrying {scene.handling.carried_kg:g} kg at {scene.acceleration_m_s2:g} m/s2 takes"
    if force_n > MOST_CARRIED_SHARE * friction_n:
        raise ValueError(
            f"{what} {force_n:.3g} N, more than half of the {friction_n:.3g} N of static friction: "
            "lower carried_kg or acceleration_m_s2, or raise load_n"
        )
    share, stopped_s = force_n / friction_n, None
    for number, stroke in enumerate(scene.arm, 1):
        if stroke.slides:
            stopped_s = stroke.stop_s
        elif stopped_s is not None:
            rest_s = np.asarray(stroke.start_s - stopped_s)
            left = float(grasp.relaxed(rest_s)[grasp.touching].max())
            if left + share > 1.0:
                raise ValueError(
                    f"{what} {share:.3g} of static friction in stroke {number}, and up to "
                    f"{left:.3g} may be left of the slide before: pause longer or lower carried_kg"
                )


# --- imperfections --------------------------------------------------------------------------------

WANDER_HZ = (0.1, 2.0)
"""Where levels wander."""

WANDER_TONES = 4

LEVEL_SPREAD = 0.5
"""Of the levels of local noise and pick-up: over time, and of noise between elements (ours)."""

COUPLING_SPREAD = 0.7
"""Of the channels' couplings to pick-up (ours)."""

GAUGE_PICKUP = 0.1
"""Coupling of a strain gauge's bridge, of low resistance, over a film's (ours)."""

PARTIAL_S = (0.05, 0.3)
"""How long a finger slips or sticks on its own; log-uniform. With the speed: .5 to 3 mm (ours)."""

PARTIAL_MM_S = 10.0
"""Speed of a partial slip (ours)."""

_RAMP_S = 0.01
_NODES = 16  # per block, joined by straight lines


def wander(rng: np.random.Generator, grid: Grid) -> Array:
    """A slow random wave of unit variance, ``[K, B]``."""
    low, high = WANDER_HZ
    hertz = low * (high / low) ** rng.random(WANDER_TONES)
    phase = 2 * np.pi * rng.random(WANDER_TONES)
    t = grid.node_times_s(_NODES)
    value = np.sin(2 * np.pi * hertz * t[..., None] + phase).sum(-1) * np.sqrt(2 / WANDER_TONES)
    return grid.joined(np.asarray(value))


def load_factor(scene: Scene, element: int, grid: Grid) -> Array | None:
    """What an element's load wanders by, ``[K, B]``; ``None`` if it does not."""
    spread = scene.imperfections.share_wander
    if spread == 0:
        return None
    return np.exp(spread * wander(generator(*scene.key("share"), element), grid))


def gain_factor(scene: Scene, index: int, grid: Grid) -> Array | float:
    """What a channel's gain drifts by, ``[K, B]``; 1 if it does not."""
    spread = scene.imperfections.gain_drift
    if spread == 0:
        return 1.0
    return np.exp(spread * wander(generator(*scene.key("gain"), index), grid))


def disturb(
    scene: Scene,
    grasp: Grasp,
    contact: ElementContact,
    element: int,
    grid: Grid,
    vibration: Vibration,
) -> None:
    """Change one touching element's vibration, in place: partial slip or sticking, local noise."""
    parameters = scene.imperfections
    for start_s, end_s in partial_intervals(scene, _finger(scene, grasp, element)):
        rows = grid.overlapping(start_s, end_s)
        if rows.start == rows.stop:
            continue
        part = grid.only(rows)
        envelope = smooth_step((part.time_s - start_s) / _RAMP_S) * smooth_step(
            (end_s - part.time_s) / _RAMP_S
        )
        holds = contact.slide[rows] == 0
        own = np.where(holds, envelope, 0.0) * shear_noise_v(scene, grasp, element, PARTIAL_MM_S)
        sticks = np.where(holds, 1.0, 1.0 - envelope)
        bands = _bands(scene, grasp, element, part, "partial slip")
        for band, noise in zip((vibration.high, vibration.low), bands, strict=True):
            band[rows] = sticks * band[rows] + own * noise
    if parameters.local_noise_mv > 0:
        rng = generator(*scene.key("local noise"), element)
        size_v = 1e-3 * parameters.local_noise_mv * float(lognormal(rng, LEVEL_SPREAD))
        level = np.exp(LEVEL_SPREAD * wander(rng, grid)) * np.sqrt(grasp.load_n[element]) * size_v
        bands = _bands(scene, grasp, element, grid, "local noise")
        for band, noise in zip((vibration.high, vibration.low), bands, strict=True):
            band[:] += level * noise


def pickup(scene: Scene, grid: Grid) -> list[CommonWave]:
    """Broadband pick-up with a sign of each channel's own; none where its parameter is zero."""
    size_mv = scene.imperfections.pickup_mv
    if size_mv == 0:
        return []
    session = generator(*scene.session_key("pick-up"))
    num = len(scene.hand)
    signs = np.where(session.random(num) < 0.5, -1.0, 1.0)
    fast = np.array([channel.adapting == "fast" for channel in scene.hand.channels])
    couplings = signs * lognormal(session, COUPLING_SPREAD, num) * np.where(fast, 1.0, GAUGE_PICKUP)
    f = np.maximum(grid.frequency_hz(), 1.0)
    response = causal_response(f / (f + 20.0) / (1 + f / 200.0), unit_power=True)
    level = np.exp(LEVEL_SPREAD * wander(generator(*scene.key("pick-up level")), grid))
    noise = grid.coloured_noise(scene.key("pick-up"), response)
    return [CommonWave(couplings, slice(None), 1e-3 * size_mv * level * noise)]


def partial_intervals(scene: Scene, finger: str) -> tuple[Interval, ...]:
    """When a finger slips or sticks on its own; intervals may overlap."""
    rate_hz = scene.imperfections.partial_slips_per_s
    if rate_hz == 0:
        return ()
    rng = generator(*scene.key("partial slips"), finger)
    starts_s = scene.end_s * rng.random(int(rng.poisson(rate_hz * scene.end_s)))
    return tuple((float(start), float(start) + log_uniform(rng, PARTIAL_S)) for start in starts_s)


def _finger(scene: Scene, grasp: Grasp, element: int) -> str:
    """The finger of an element."""
    index = int(np.flatnonzero(grasp.element_of_channel == element)[0])
    return scene.hand.channels[index].finger


def _bands(scene: Scene, grasp: Grasp, element: int, grid: Grid, purpose: str) -> list[Array]:
    """Noise with the high and the low band's share of friction's power, together of unit rms."""
    low_share = scene.contact.friction_noise_low_share
    shares = np.sqrt([1.0 - low_share, low_share])
    responses = band_responses(grasp, element, grid)
    return [
        share * grid.coloured_noise((*scene.key(purpose), element, name), response)
        for share, name, response in zip(shares, ("high", "low"), responses, strict=True)
    ]


# --- faults ---------------------------------------------------------------------------------------


def recorded_channels(scene: Scene) -> tuple[int, ...]:
    """Whose signal stands in every row of the file: its own, unless cables are swapped."""
    rows = {name: index for index, name in enumerate(scene.hand.names)}
    recorded = list(range(len(rows)))
    for one, other in scene.faults.swapped:
        recorded[rows[one]], recorded[rows[other]] = rows[other], rows[one]
    return tuple(recorded)


def stuck_volts(scene: Scene) -> dict[int, float]:
    """The rows that hold one value, and which: the converter's zero or its highest step."""
    sensors, names = scene.sensors, scene.hand.names
    highest_v = sensors.rail_v - 2.0 * sensors.rail_v / 2.0**sensors.num_bits
    dead = {names.index(name): 0.0 for name in scene.faults.dead}
    return dead | {names.index(name): highest_v for name in scene.faults.saturated}


def losses(scene: Scene, num_samples: int) -> tuple[tuple[int, int], ...]:
    """The first sample of every loss and the first behind it, in order; they may overlap.

    The recording's first sample is never lost, so that each loss has one to repeat.
    """
    duration_s = num_samples / scene.sample_rate_hz
    rng = generator(*scene.key("losses"))
    low, high = scene.faults.drop_ms
    lost: list[Interval] = []
    for _ in range(int(rng.poisson(scene.faults.drops_per_s * duration_s))):
        start_s = duration_s * rng.random()
        lost.append((start_s, start_s + 1e-3 * log_uniform(rng, (low, high))))
    edges = np.rint(scene.sample_rate_hz * np.array(sorted(lost)).reshape(-1, 2))
    whole = np.clip(edges, 1, num_samples).astype(int).tolist()
    return tuple((first, end) for first, end in whole if first < end)


def held_samples(scene: Scene, num_samples: int) -> NDArray[np.int64]:
    """Which sample of the sensors stands at every sample of the file, ``[T]``.

    Itself, or in a loss the last one before it.
    """
    held = np.arange(num_samples)
    for first, end in losses(scene, num_samples):
        held[first:end] = held[first - 1]
    return held
