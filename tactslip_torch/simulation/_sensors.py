"""From the skin to volts: vibration of sliding, slow and fast channels, what disturbs them.

*Vibration* is in volts at a fast channel of unit gain. While an element slides it has a *high*
part, broadband behind the skin's resonance; a *low* part below 25 Hz; and *lines* at speed over
wavelength, which run with the arm's position. Then a burst where it lets go.

A slow channel (SG, strain gauge) follows force and stays: preload, shear, creep, offset, drift. A
fast one (PVDF film) gives the rate of strain, behind a high-pass. Both end in white noise and a
converter with rails.

*Disturbances* reach every channel through one coupling each. *Handling* loads a contact that does
not slide and begins no slip. *Imperfections* are noise, wander and partial slip of single elements;
*faults* are what is broken between the sensors and the file. Everything is a function of absolute
time and of keys of its own, so any interval can be computed alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactslip_torch.runtime import runs_of
from tactslip_torch.simulation._blocks import (
    Array,
    Flags,
    Grid,
    Interval,
    Key,
    Spectrum,
    causal_response,
    generator,
    log_uniform,
    lognormal,
    smooth_step,
)
from tactslip_torch.simulation._contact import Contacts, ElementContact, Grasp, draw_grasp
from tactslip_torch.simulation.scene import Motion, Scene

_BANDS = ("high", "low")  # parts of vibration, above and below 25 Hz
_REFERENCE_MM_S = 40.0  # the speed at which levels are given
_LOW_BAND_HZ = 25.0  # where the low part of friction noise ends
_LINE_DAMPING = 0.5  # ratio with which lines meet the skin: a patch is many bristles (prior, ours)
_SLOW_VIBRATION = 0.08  # of a fast channel's vibration, what a slow one sees (prior, ours)
_FORCE_FLUCTUATION = 0.03  # slow, of friction over its mean while sliding, rms (prior, ours)
_DRIFT_HZ = (0.05, 2.0)  # where a channel's drift lies
_DRIFT_NODES = 8  # per block
_WARMING_TIMES = 2.0  # time constants of warming that a recording lasts (prior, ours)
_FAST_WARMING = (
    0.02  # of a slow channel's warming, what passes a fast one's high-pass (prior, ours)
)

# --- vibration ------------------------------------------------------------------------------------


class _Vibration(NamedTuple):
    """One element's vibration on a grid.

    Attributes:
        bands: volts above about 25 Hz, bursts included, and below, ``[2, K, B]``.
        fluctuation: the friction force's relative slow fluctuation, unit rms while sliding,
            ``[K, B]``.
    """

    bands: Array
    fluctuation: Array


def _levels_v(scene: Scene, grasp: Grasp, speed_mm_s: Array) -> tuple[Array, Array]:
    """Volts rms of friction noise at mu = 1 and of texture, both at 1 N."""
    relative, contact = speed_mm_s / _REFERENCE_MM_S, scene.contact
    friction_v = 1e-3 * contact.friction_noise_mv * relative**contact.friction_noise_exponent
    return friction_v, 1e-3 * grasp.texture_mv * relative**grasp.texture_exponent


def _lines(scene: Scene, grasp: Grasp, speed_mm_s: Array, position_mm: Array) -> Array:
    """Sine and cosine of the texture's lines, weighted by what the skin and the converter pass.

    Their weights' squares sum to 1. A tacky material's sawtooth has harmonics that fall with their
    order; these lines stand for its stick-slip, so bristles, which stick and slip, have none. Lines
    near or beyond the Nyquist frequency are faded out, not folded.
    """
    shape = speed_mm_s.shape
    tacky = grasp.material.character == "tacky"
    if grasp.wavelength_mm is None or (tacky and scene.fidelity != "kinematic"):
        return np.zeros((2, 0, *shape))
    rng = generator(*scene.session_key("lines"), scene.material)
    orders = np.repeat([1, 2, 3, 4], 2) if tacky else np.ones(6)
    spread = lognormal(rng, grasp.material.line_bandwidth, len(orders))
    weights = 1.0 / orders / np.sqrt(np.sum(1.0 / orders**2))
    middle_hz = float(np.median(grasp.resonance_hz))
    out = np.empty((2, len(orders), *shape))
    for number, wavelength in enumerate(grasp.wavelength_mm * spread / orders):
        frequency = speed_mm_s / wavelength
        passed = np.minimum(_resonance(frequency, middle_hz, _LINE_DAMPING), 1.0)
        passed *= weights[number] * np.clip(4.5 - 10.0 * frequency / scene.sample_rate_hz, 0, 1)
        phase = (2 * np.pi / wavelength) * position_mm
        out[:, number] = passed * np.sin(phase), passed * np.cos(phase)
    return out


def _resonance(frequency_hz: Array, resonance_hz: float, damping: float) -> Array:
    """Magnitude of the skin's resonance, 1 at its peak."""
    ratio = (frequency_hz / resonance_hz) ** 2
    return 2 * damping / np.sqrt((1 - ratio) ** 2 + 4 * damping**2 * ratio)


@lru_cache(maxsize=256)
def _band_responses(
    exponent: float, resonance_hz: float, damping: float, sample_rate_hz: float
) -> Spectrum:
    """Filters of the high and of the low part, of unit power, ``[2, B + 1]``; not to be changed.

    The high part: rate of a height spectrum ``k^-a`` with ``a`` the exponent, so ``f^(1 - a/2)``,
    behind the skin. All of it belongs to the session, so its recordings share them.
    """
    f = Grid(np.zeros(0, np.int64), sample_rate_hz).frequency_hz
    step = (f / _LOW_BAND_HZ) ** 4
    high = (f / _LOW_BAND_HZ) ** (1.0 - 0.5 * exponent) * np.sqrt(step / (1 + step))
    high *= _resonance(f, resonance_hz, damping)
    low = np.sqrt(f**2 / (f**2 + 4.0) / (1 + step))
    return causal_response(np.stack([high, low]))


class _Vibrations:
    """Vibration of the touching elements of a recording on a grid.

    Args:
        scene: of the recording.
        grasp: how the hand touches.
        grid: where.
    """

    def __init__(self, scene: Scene, grasp: Grasp, grid: Grid) -> None:
        self._scene, self._grasp, self._grid = scene, grasp, grid
        motion = Motion(scene.slides, grid)
        self._levels_v = _levels_v(scene, grasp, motion.speed_mm_s)  # [K, B] each
        self._lines = _lines(scene, grasp, motion.speed_mm_s, motion.position_mm)

    def element(self, element: int, contact: ElementContact) -> _Vibration:
        """One element's vibration, imperfections included; work only in blocks that slide."""
        scene, grasp, grid = self._scene, self._grasp, self._grid
        root_load = np.sqrt(grasp.load_n[element])
        rng = generator(*scene.key("line mixture"), element)
        mixture = rng.standard_normal(self._lines.shape[:2])
        bands, fluctuation = np.stack([contact.release_v, grid.zeros()]), grid.zeros()
        for rows in _runs(np.asarray(contact.slide.any(axis=-1))):
            slide = contact.slide[rows]
            noises = self.sliding_noises(element, rows)
            if scene.fidelity == "bristles":  # a speed of its own, with the vibration of that speed
                friction_gate = _powered(slide, scene.contact.friction_noise_exponent)
                texture_gate = _powered(slide, grasp.texture_exponent)
            else:  # a fading in
                friction_gate = texture_gate = slide
            friction_v, texture_v = (level_v[rows] for level_v in self._levels_v)
            friction = grasp.mu_ratio * grasp.mu_s * root_load * friction_v * friction_gate
            texture = root_load * texture_v * texture_gate
            lines = np.einsum("pl,plkb->kb", mixture, self._lines[:, :, rows])
            bands[:, rows] += _sliding_v(scene, grasp, friction, texture, noises, lines)
            fluctuation[rows] += np.minimum(slide, 1.0) * noises[1]
        self._add_imperfections(bands, element, contact)
        return _Vibration(bands, fluctuation)

    def _add_imperfections(self, bands: Array, element: int, contact: ElementContact) -> None:
        """Partial slip or sticking, and local noise."""
        scene, grasp, grid = self._scene, self._grasp, self._grid
        index = int(np.flatnonzero(grasp.element_of_channel == element)[0])
        for start_s, end_s in _partial_intervals(scene, scene.hand.channels[index].finger):
            rows, envelope = grid.pulse(start_s, end_s, _PARTIAL_RAMP_S)
            holds = contact.slide[rows] == 0
            slip_v = np.where(holds, envelope, 0.0)
            slip_v *= _steady_v(scene, grasp, element, _PARTIAL_MM_S)
            sticks = np.where(holds, 1.0, 1.0 - envelope)
            noises = self._friction_noises(element, rows, "partial slip")
            bands[:, rows] = sticks * bands[:, rows] + slip_v * noises
        if scene.imperfections.local_noise_mv > 0:
            bands += np.sqrt(grasp.load_n[element]) * self.local_noise_v(element)

    def local_noise_v(self, element: int) -> Array:
        """Noise of an element of 1 N that is independent of all others, ``[2, K, B]``."""
        scene, grid = self._scene, self._grid
        if scene.imperfections.local_noise_mv == 0:
            return np.stack([grid.zeros(), grid.zeros()])
        rng = generator(*scene.key("local noise"), element)
        size_v = 1e-3 * scene.imperfections.local_noise_mv * lognormal(rng, _LEVEL_SPREAD)
        level_v = size_v * _wandering(_LEVEL_SPREAD, rng, grid)
        return np.asarray(level_v * self._friction_noises(element, slice(None), "local noise"))

    def sliding_noises(self, element: int, rows: slice = slice(None)) -> Array:
        """Noise of the high and of the low part of sliding, of unit rms, ``[2, k, B]``."""
        keys = [(*self._scene.key(band), element) for band in _BANDS]
        return self._band_noises(element, rows, keys)

    def _friction_noises(self, element: int, rows: slice, purpose: str) -> Array:
        """Noise with the bands' fractions of friction's power, unit rms in all, ``[2, k, B]``."""
        low_fraction = self._scene.contact.friction_noise_low_share
        keys = [(*self._scene.key(purpose), element, band) for band in _BANDS]
        sizes = np.sqrt([1.0 - low_fraction, low_fraction])
        return np.asarray(sizes[:, None, None] * self._band_noises(element, rows, keys))

    def _band_noises(self, element: int, rows: slice, keys: Iterable[Key]) -> Array:
        """Noise of the high and of the low part, of unit rms, by the key of each, ``[2, k, B]``."""
        grasp, part = self._grasp, self._grid.only(rows)
        skin = float(grasp.resonance_hz[element]), float(grasp.damping[element])
        responses = _band_responses(grasp.spectral_exponent, *skin, part.sample_rate_hz)
        pairs = zip(keys, responses, strict=True)
        return np.stack([part.coloured_noise(key, response) for key, response in pairs])


def _sliding_v(
    scene: Scene, grasp: Grasp, friction_v: Array, texture_v: Array, noises: Array, lines: Array
) -> Array:
    """Vibration of a slide above and below 25 Hz, volts at a fast channel of unit gain.

    Args:
        scene: whose friction noise is divided.
        grasp: whose texture is.
        friction_v: rms of friction noise.
        texture_v: rms of the texture's vibration.
        noises: of the high and of the low part, of unit rms.
        lines: of the texture.

    Shape:
        - noises, output: ``[2, *]``; all else ``[*]``
    """
    low_fraction = scene.contact.friction_noise_low_share
    line_fraction = grasp.material.line_share if grasp.material.wavelength_mm else 0.0
    broad = np.sqrt((1 - low_fraction) * friction_v**2 + (1 - line_fraction) * texture_v**2)
    high = broad * noises[0] + np.sqrt(line_fraction) * texture_v * lines
    return np.stack([high, np.sqrt(low_fraction) * friction_v * noises[1]])


def _steady_v(scene: Scene, grasp: Grasp, element: int, speed_mm_s: float) -> float:
    """Volts rms of an element that slides steadily, its texture's lines counted as noise."""
    friction_v, texture_v = _levels_v(scene, grasp, np.asarray(speed_mm_s))
    kinetic = grasp.mu_ratio * grasp.mu_s
    return float(np.sqrt(grasp.load_n[element]) * np.hypot(kinetic * friction_v, texture_v))


def _powered(slide: Array, exponent: float) -> Array:
    """Level over that at the arm's speed; none where nothing slides, whatever the power."""
    return np.where(slide > 0, slide**exponent, 0.0)


def _runs(chosen: Flags) -> list[slice]:
    """The runs of rows that are chosen."""
    return [slice(*run) for run in runs_of(chosen).tolist()]


# --- sensors --------------------------------------------------------------------------------------


class _Front(NamedTuple):
    """Parameters of every channel in one recording, ``[C]`` each.

    Attributes:
        gain: factor on what the element feels.
        white_v: rms of white noise.
        offset_v: constant.
    """

    gain: Array
    white_v: Array
    offset_v: Array


def _draw_front(scene: Scene) -> _Front:
    """Gains, noise floors and offsets: per session, and a little again per recording."""
    sensors, num = scene.sensors, len(scene.hand)
    session, rng = generator(*scene.session_key("front")), generator(*scene.key("f"))
    gain = lognormal(session, sensors.gain_spread, num)
    gain = gain * lognormal(rng, sensors.gain_spread / 3, num)
    floor_mv = sensors.white_noise_mv * lognormal(session, sensors.white_noise_session_spread)
    sg_offset = sensors.sg_session_offset_v * session.standard_normal(num)
    sg_offset = sg_offset + sensors.sg_offset_v * rng.standard_normal(num)
    pvdf_offset = 1e-3 * sensors.pvdf_offset_mv * rng.uniform(-1.0, 1.0, num)
    return _Front(
        gain=gain,
        white_v=1e-3 * floor_mv * lognormal(session, 0.2, num),
        offset_v=np.where(_is_slow(scene), sg_offset, pvdf_offset),
    )


def _is_slow(scene: Scene) -> Flags:
    """Which channels are slow, ``[C]``."""
    return np.isin(np.arange(len(scene.hand)), scene.hand.slow)


@lru_cache(maxsize=8)
def _highpass_response(corner_hz: float, block_samples: int, sample_rate_hz: float) -> Spectrum:
    """A film and its amplifier: first-order high-pass that passes no constant, ``[B + 1]``.

    The one-pole filter with a zero at 0 Hz, cut after one block and freed of what the cut leaves
    at 0 Hz (e^-10 of the step at 6.6 Hz).
    """
    pole = np.exp(-2 * np.pi * corner_hz / sample_rate_hz)
    taps = -(1 - pole) * pole ** np.arange(-1.0, block_samples)
    taps[0] = 1.0
    taps *= 0.5 * (1 + pole)
    taps -= taps.mean()
    return np.asarray(np.fft.rfft(taps, 2 * block_samples))


def _slow_volts(scene: Scene, normal_n: Array, friction_n: Array, vibration: _Vibration) -> Array:
    """Volts of a slow channel of unit gain on its element; all on one grid."""
    sensors = scene.sensors
    shear_v = sensors.sg_shear_v_per_n * friction_n
    shear_v = shear_v * (1.0 + _FORCE_FLUCTUATION * vibration.fluctuation)
    vibration_v = _SLOW_VIBRATION * (vibration.bands[0] + vibration.bands[1])
    return np.asarray(sensors.sg_preload_v_per_n * normal_n + shear_v + vibration_v)


def _fast_volts(scene: Scene, grid: Grid, force_n: Array, vibration: _Vibration) -> Array:
    """Volts of a fast channel of unit gain on its element.

    Args:
        scene: whose sensors.
        grid: where the volts are wanted.
        force_n: friction, and what taps and grips press, on ``grid.history``.
        vibration: on ``grid``; behind the high-pass already.
    """
    corner_hz = scene.sensors.pvdf_highpass_hz
    response = _highpass_response(corner_hz, grid.block_samples, grid.sample_rate_hz)
    strain_v = grid.filtered(scene.sensors.pvdf_shear_v_per_n * force_n, response)
    return np.asarray(strain_v + vibration.bands[0] + vibration.bands[1])


def _drift_v(scene: Scene, index: int, grid: Grid) -> Array:
    """Slow drift of one channel: a few slow sines, ``[K, B]``."""
    sensors, rng = scene.sensors, generator(*scene.key("drift"), index)
    size_mv = sensors.sg_drift_mv if index in scene.hand.slow else sensors.pvdf_drift_mv
    return grid.wander(rng, _DRIFT_HZ, _DRIFT_NODES, size=1e-3 * size_mv, spread=0.3)


def _warming_v(scene: Scene, index: int, grid: Grid) -> Array:
    """How far one channel's zero has moved as the hand warms up, ``[K, B]``.

    Nothing at first, fast in the beginning and slower later, with a sign and size of the channel's.
    """
    rng = generator(*scene.key("warming"), index)
    fraction = 1.0 if index in scene.hand.slow else _FAST_WARMING
    sign = 1.0 if rng.random() < 0.5 else -1.0
    far_v = 1e-3 * scene.sensors.warming_mv * fraction * sign * lognormal(rng, 0.5)
    since = np.maximum(grid.time_s, 0.0) / scene.end_s
    return np.asarray(far_v * np.expm1(-_WARMING_TIMES * since) / np.expm1(-_WARMING_TIMES))


def _with_noise(scene: Scene, front: _Front, index: int, grid: Grid, volts: Array) -> Array:
    """Volts of one channel with its offset, drift and white noise, ``[K, B]``."""
    noise = grid.white_noise((*scene.key("white"), scene.hand.names[index]))
    total = volts + front.offset_v[index] + front.white_v[index] * noise
    total += _drift_v(scene, index, grid)
    if scene.sensors.warming_mv > 0:
        total += _warming_v(scene, index, grid)
    return np.asarray(total)


def _converted(scene: Scene, volts: Array) -> Array:
    """Volts of the converter: with the gain of all channels, between the rails, in steps."""
    volts = scene.sensors.gain * volts
    rail_v = scene.sensors.rail_v
    step_v = 2.0 * rail_v / 2.0**scene.sensors.num_bits
    return np.asarray(np.clip(np.round(volts / step_v) * step_v, -rail_v, rail_v - step_v))


def volts_of(
    scene: Scene, grasp: Grasp, contact: Contacts, grid: Grid, indices: list[int]
) -> list[Array]:
    """Volts of the channels asked for on the grid, ``[K, B]`` each."""
    history, _, now = grid.history
    front, vibrations = _draw_front(scene), _Vibrations(scene, grasp, grid)
    motion, handled = Motion(scene.slides, history), Handled(scene, grasp)
    volts = dict(zip(indices, _common_volts(scene, grid, indices), strict=True))
    elements = set(grasp.element_of_channel[indices].tolist()) & set(grasp.touching.tolist())
    for element in sorted(elements):
        state = contact.element(element, grid, motion)
        vibration = vibrations.element(element, state)
        normal_n, shear_n, press_n = state.normal_n, state.friction_n, history.zeros()
        if scene.imperfections.share_wander > 0:
            factor = _drift_factor(scene, "share", element, history)
            normal_n, shear_n = normal_n * factor, shear_n * factor
            vibration.bands[:] *= np.sqrt(factor[now])
        if not handled.is_idle:
            press_n = handled.press_n(element, normal_n, history)
            shear_n = shear_n + handled.shear_n(element, history.time_s)
            vibration.bands[0] += handled.knock_v(element, grid)
        for index in indices:
            if grasp.element_of_channel[index] != element:
                continue
            if index in scene.hand.slow:
                sensed = _slow_volts(scene, (normal_n + press_n)[now], shear_n[now], vibration)
            else:  # what presses is felt like friction (prior, ours)
                sensed = _fast_volts(scene, grid, shear_n + press_n, vibration)
            volts[index] += front.gain[index] * _drift_factor(scene, "gain", index, grid) * sensed
    return [
        _converted(scene, _with_noise(scene, front, index, grid, volts[index])) for index in indices
    ]


# --- disturbances of every channel ----------------------------------------------------------------

_ARM_MODES_HZ = (6.0, 6.5, 15.0, 56.0, 87.0, 277.0)
"""Modes of a light arm with payload (Wu 2021, Intell. Robot. 1(2):99), proxy for the UR5e."""

_ARM_MODE_WEIGHTS = (0.25, 0.15, 0.25, 0.2, 0.1, 0.05)  # of a transient's first swing (prior, ours)
_MAINS_ORDERS = np.array([1, 2, 3, 5, 7, 9])  # up to 450 Hz
_MAINS_BURST_S = (0.1, 1.0)  # how long the mains is stronger; log-uniform (prior, ours)
_MAINS_RAMP_S = 0.02  # of a burst, at both ends
_MOTOR_PITCH_MM = (0.37, 0.61)  # arm travel per turn of two gears that vibrate (prior, ours)
_MACHINE_ORDERS = np.array([1, 2, 3, 4, 6, 8])  # harmonics of the rotation
_MACHINE_RUN_S = (1.0, 4.0)  # how long a run lasts; log-uniform (ours)
_MACHINE_BREAK_S = (0.5, 2.0)  # how long it stands between runs; log-uniform (ours)
_MACHINE_RAMP_S = 0.3  # how long it runs up and down, at both ends of a run (ours)
_PICKUP_COUPLING_SPREAD = 0.7  # of the channels (ours)
_SLOW_PICKUP = 0.1  # coupling of a slow channel, of low resistance, over a fast one's (ours)
_LEVEL_SPREAD = 0.5  # of levels of pick-up and local noise over time, and between elements (ours)
_WANDER_HZ = (0.1, 2.0)  # where levels wander
_WANDER_NODES = 16  # per block


def _common_volts(scene: Scene, grid: Grid, channels: list[int]) -> Array:
    """Mains, motor, arm, machine, knocks and pick-up of some channels, ``[len(channels), K, B]``.

    Raises:
        ValueError: if the machine's rotation would be folded at the converter.
    """
    of, num, modes = scene.disturbances, len(scene.hand), len(_ARM_MODES_HZ)
    driven = Motion(tuple(stroke for stroke in scene.arm if stroke.drives), grid)
    volts = np.zeros((len(channels), *grid.time_s.shape))

    def add(coupling_v: Array, wave: Array, rows: slice = slice(None)) -> None:
        for channel_volts, size_v in zip(volts, coupling_v[channels], strict=True):
            channel_volts[rows] += size_v * wave

    session = generator(*scene.session_key("couplings"))
    mains_v = 1e-3 * of.mains_mv * lognormal(session, of.mains_session_spread)
    couplings = lognormal(session, 0.4, num)
    motor_mv = _motor_level_mv(scene)
    motor_v = 1e-3 * motor_mv * lognormal(session, 0.3, num)
    signs = np.where(session.random((num, modes)) < 0.5, -1.0, 1.0)
    arm_v = 1e-3 * of.arm_transient_mv * signs * lognormal(session, 0.4, (num, modes))

    bursts = _mains_bursts(scene)
    if of.mains_mv > 0 or bursts:
        mains = _mains(scene, grid)
        add(mains_v * couplings, mains)
        for start_s, end_s in bursts:
            rows, envelope = grid.pulse(start_s, end_s, _MAINS_RAMP_S)
            add(1e-3 * of.mains_burst_mv * couplings, envelope * mains[rows], rows)
    if driven.strokes and motor_mv > 0:
        rows, wave = _motor(scene, driven)
        add(motor_v, wave, rows)
    if driven.strokes and of.arm_transient_mv > 0:
        rows, ringing = _arm_ringing(scene, driven)
        for mode_v, wave in zip(arm_v.T, ringing, strict=True):
            add(mode_v, wave, rows)
    if of.machine_mv > 0:
        machine = lognormal(generator(*scene.session_key("machine couplings")), 0.4, num)
        add(1e-3 * of.machine_mv * machine, _machine_wave(scene, grid))
    for coupling_v, time_s, omega, decay in _draw_knocks(scene):
        rows, wave = grid.ringing(time_s, 12.0 / decay, omega, decay)
        add(coupling_v, wave, rows)
    if scene.imperfections.pickup_mv > 0:
        session = generator(*scene.session_key("pick-up"))
        signs = np.where(session.random(num) < 0.5, -1.0, 1.0)
        signs *= np.where(_is_slow(scene), _SLOW_PICKUP, 1.0)
        add(signs * lognormal(session, _PICKUP_COUPLING_SPREAD, num), _pickup_v(scene, grid))
    return volts


def _mains(scene: Scene, grid: Grid) -> Array:
    """Fundamental of amplitude 1 with its harmonics, one phase for all channels."""
    session = generator(*scene.session_key("mains"))
    num = len(_MAINS_ORDERS)
    levels = 0.3 * lognormal(session, 0.5, num) / _MAINS_ORDERS
    phases = 2 * np.pi * session.random(num)
    levels[0], phases[0] = 1.0, 0.0
    rng = generator(*scene.key("mains"))
    hertz = scene.disturbances.mains_hz + 0.02 * rng.standard_normal()
    angle = 2 * np.pi * (hertz * grid.time_s + rng.random())
    wave = grid.zeros()
    for order, level, phase in zip(_MAINS_ORDERS, levels, phases, strict=True):
        if order == 1 or order * hertz < 0.5 * scene.sample_rate_hz:
            wave += level * np.sin(order * angle + phase)
    return wave


def _mains_bursts(scene: Scene) -> list[Interval]:
    """When the mains is stronger; bursts may overlap, and then add."""
    per_s = scene.disturbances.mains_bursts_per_s
    return _at_random(scene, scene.key("mains bursts"), per_s, _MAINS_BURST_S)


def _motor_level_mv(scene: Scene) -> float:
    """The recording's motor vibration: the scene's, or a draw of its own from the scene's range."""
    level = scene.disturbances.motor_vibration_mv
    if isinstance(level, tuple):
        return float(log_uniform(generator(*scene.key("motor level")), level))
    return level


def _motor(scene: Scene, driven: Motion) -> tuple[slice, Array]:
    """Vibration of unit rms at 40 mm/s while the arm moves: two gear lines and broad noise."""
    grid, strokes = driven.grid, driven.strokes
    rows = grid.overlapping(strokes[0].start_s, strokes[-1].stop_s)
    part, f = grid.only(rows), grid.frequency_hz
    response = causal_response(f**2 / (f**2 + 20.0**2) / (1 + (f / 200.0) ** 2))
    noise = part.coloured_noise(scene.key("motor"), response)
    for pitch in _MOTOR_PITCH_MM:
        noise += np.sin(2 * np.pi / pitch * driven.position_mm[rows])
    return rows, np.sqrt(driven.speed_mm_s[rows] / 40.0) * noise / np.sqrt(2.0)


def _arm_ringing(scene: Scene, driven: Motion) -> tuple[slice, list[Array]]:
    """The arm's modes, struck at every start and stop, one ``[k, B]`` per mode.

    Between two strikes a mode is one decaying phasor, the sum of all strikes before.
    """
    rng, session = generator(*scene.key("arm")), generator(*scene.session_key("arm"))
    strikes_s = np.sort([t for stroke in driven.strokes for t in (stroke.start_s, stroke.stop_s)])
    sizes = lognormal(rng, 0.3, len(strikes_s)) * np.tile([1.0, -1.0], len(driven.strokes))
    hertz = np.asarray(_ARM_MODES_HZ) * lognormal(session, 0.03, len(_ARM_MODES_HZ))
    damping = 0.03 + 0.03 * session.random(len(_ARM_MODES_HZ))
    rows = driven.grid.overlapping(strikes_s[0], driven.grid.time_s[-1, -1])
    t = driven.grid.time_s[rows]
    last = np.searchsorted(strikes_s, t, side="right") - 1  # strike before each sample, or -1
    elapsed = np.maximum(t - strikes_s[np.maximum(last, 0)], 0.0)
    modes = []
    for frequency, ratio, weight in zip(hertz, damping, _ARM_MODE_WEIGHTS, strict=True):
        rate = 2 * np.pi * frequency * complex(-ratio, 1.0)
        phasors = [0j]  # before the first strike
        for gap_s, size in zip(np.diff(strikes_s, prepend=strikes_s[0]), sizes, strict=True):
            phasors.append(phasors[-1] * np.exp(rate * gap_s) + weight * size)
        modes.append((np.asarray(phasors)[last + 1] * np.exp(rate * elapsed)).imag)
    return rows, modes


def _draw_knocks(scene: Scene) -> list[tuple[Array, float, float, float]]:
    """Knocks at random times, each in about half of the channels, weakly in slow ones (ours).

    Volts of every channel, time, angular frequency and decay of each.
    """
    of, num_channels = scene.disturbances, len(scene.hand)
    rng = generator(*scene.key("bursts"))
    num = int(rng.poisson(of.burst_rate_hz * scene.end_s))
    times_s = scene.end_s * rng.random(num)
    omegas = 2 * np.pi * log_uniform(rng, (15.0, 150.0), num)
    decays = 1.0 / log_uniform(rng, (0.005, 0.05), num)
    reached = rng.random((num, num_channels)) < 0.5
    sizes_v = 1e-3 * of.burst_mv * lognormal(rng, 0.5, (num, 1))
    sizes_v = sizes_v * lognormal(rng, 0.5, (num, num_channels)) * reached
    sizes_v *= np.where(_is_slow(scene), 0.3, 1.0)
    return list(zip(sizes_v, times_s.tolist(), omegas.tolist(), decays.tolist(), strict=True))


def _machine_runs(scene: Scene) -> list[Interval]:
    """When the neighbouring machine turns, runs up or runs down; the last run may go on."""
    if scene.disturbances.machine_mv == 0:
        return []
    rng = generator(*scene.key("machine"))
    runs, now_s = [], _MACHINE_BREAK_S[1] * rng.random()
    while now_s < scene.end_s:
        stop_s = float(now_s + log_uniform(rng, _MACHINE_RUN_S))
        runs.append((now_s, stop_s))
        now_s = float(stop_s + log_uniform(rng, _MACHINE_BREAK_S))
    return runs


def _rotation_hz(scene: Scene) -> float:
    """The machine's rotation at full speed; the session's."""
    rng = generator(*scene.session_key("machine"))
    return float(log_uniform(rng, scene.disturbances.machine_hz))


def _machine_wave(scene: Scene, grid: Grid) -> Array:
    """The machine's vibration, of unit rms at full speed and zero where it stands, ``[K, B]``.

    In a run the rotation's phase is the integral of a speed that rises and falls linearly, and
    each harmonic's size goes with the square of that speed. Orders that would be folded at the
    converter are left out.

    Raises:
        ValueError: if the rotation itself would be folded.
    """
    wave, hertz, highest_hz = grid.zeros(), _rotation_hz(scene), 0.45 * scene.sample_rate_hz
    if hertz >= highest_hz:
        raise ValueError(
            f"machine_hz must lie below {highest_hz:g} Hz at {scene.sample_rate_hz:g} samples a "
            f"second, got {scene.disturbances.machine_hz}"
        )
    rng, num = generator(*scene.session_key("machine harmonics")), len(_MACHINE_ORDERS)
    levels = lognormal(rng, 0.5, num) / _MACHINE_ORDERS
    phases = 2 * np.pi * rng.random(num)
    levels = np.where(_MACHINE_ORDERS * hertz < highest_hz, levels, 0.0)
    levels *= np.sqrt(2.0 / np.sum(levels**2))
    for start_s, stop_s in _machine_runs(scene):
        rows = grid.overlapping(start_s, stop_s)
        since = np.clip(grid.time_s[rows] - start_s, 0.0, stop_s - start_s)
        left = stop_s - start_s - since
        speed = np.clip(np.minimum(since, left) / _MACHINE_RAMP_S, 0.0, 1.0)
        up: Array = np.minimum(since, _MACHINE_RAMP_S)
        down: Array = np.maximum(_MACHINE_RAMP_S - left, 0.0)
        turns = hertz * (since - up + (up**2 - down**2) / (2 * _MACHINE_RAMP_S))
        for order, level, phase in zip(_MACHINE_ORDERS, levels, phases, strict=True):
            wave[rows] += level * speed**2 * np.sin(2 * np.pi * order * turns + phase)
    return wave


def _pickup_v(scene: Scene, grid: Grid) -> Array:
    """Broadband pick-up at a fast channel of coupling 1; its level wanders, ``[K, B]``."""
    f = grid.frequency_hz
    response = causal_response(f / (f + 20.0) / (1 + f / 200.0))
    level = _wandering(_LEVEL_SPREAD, generator(*scene.key("pick-up level")), grid)
    noise = grid.coloured_noise(scene.key("pick-up"), response)
    return np.asarray(1e-3 * scene.imperfections.pickup_mv * level * noise)


def _wandering(spread: float, rng: np.random.Generator, grid: Grid) -> Array:
    """A factor whose logarithm wanders slowly, ``[K, B]``."""
    return np.asarray(np.exp(spread * grid.wander(rng, _WANDER_HZ, _WANDER_NODES)))


def _at_random(scene: Scene, key: Key, per_s: float, lengths_s: Interval) -> list[Interval]:
    """Intervals at random times of a recording, which may overlap; lengths are log-uniform."""
    rng = generator(*key)
    starts_s = scene.end_s * rng.random(rng.poisson(per_s * scene.end_s))
    return [(float(at), float(at + log_uniform(rng, lengths_s))) for at in starts_s]


# --- handling -------------------------------------------------------------------------------------

_MARGIN_S = 0.1  # between a tap or grip, with its settling, and a stroke that slides (ours)
_SETTLE_S = 0.1  # how long a fast channel still shows a tap or grip that is over (ours)
_EVENT_SPREAD = 0.3  # how unevenly elements take part in a tap or grip (ours)
_RINGING_S = 0.3  # how long the arm's ringing counts as handling after a stroke (ours)
_MOST_CARRIED = 0.5  # of static friction, what a carried object's inertia may take
_MOST_LIFTED = 0.95  # of static friction, what inertia and weight may take (ours)
_MOST_LOOSENED = 0.8  # of the load beyond what the shear needs, by which a grip may loosen (ours)
_KNOCK_V_PER_N = (
    0.05  # first swing of a knock's modes at a fast channel, per newton of the peak (ours)
)
_KNOCK_HZ = (60.0, 800.0)  # where a knock's modes lie
_KNOCK_DECAY_S = (0.002, 0.008)
_KNOCK_MODES = 8

_JERK_S = 0.03
"""How long the object takes to follow a change of the arm's acceleration: a raised cosine (ours).

The skin of all elements and 0.2 kg resonate near 40 Hz.
"""


class _Event(NamedTuple):
    """A tap or a change of grip.

    Attributes:
        start_s: when it begins.
        end_s: when the load is what it was before.
        size: of every element, newtons of a tap or a grip's rise over the load, ``[E]``.
    """

    start_s: float
    end_s: float
    size: Array


def _quiet(scene: Scene) -> list[Interval]:
    """Where nothing slides or is about to: all but the strokes that slide, and a margin."""
    ends_s = [stroke.start_s - _MARGIN_S for stroke in scene.slides]
    starts_s = [stroke.stop_s + _MARGIN_S for stroke in scene.slides]
    gaps = zip([0.0, *starts_s], [*ends_s, scene.end_s], strict=True)
    return [(start_s, end_s) for start_s, end_s in gaps if end_s > start_s]


class Handled:
    """What hands do to the object in one recording.

    Args:
        scene: whose handling.
        grasp: how the hand touches.

    Attributes:
        taps: in order of time.
        grips: the same; those that loosen behind the others.
        carried: strokes in which an object of some mass moves with the hand.

    Raises:
        ValueError: if the carried object's inertia would take more than half of static friction,
            inertia and weight together more than .95, or more than a slide before has left of it;
            or if there is no rest long enough for a tap or grip that is asked for.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        self._scene, self._grasp, of = scene, grasp, scene.handling
        self._load_n = grasp.load_n
        has_mass = of.carried_kg > 0 or of.weight_share > 0
        self.carried = [stroke for stroke in scene.arm if has_mass and not stroke.slides]
        if self.carried:
            _require_carriable(scene, grasp)
        tap_s = (1e-3 * of.tap_ms[0], 1e-3 * of.tap_ms[1])
        load = grasp.load_n / scene.contact.load_n
        self.taps = self._events("taps", of.taps_per_s, of.tap_n, tap_s, load)
        self.grips = self._events("grips", of.grips_per_s, of.grip_share, of.grip_s)
        self.grips += self._loosenings()

    def _events(
        self, purpose: str, per_s: float, sizes: Interval, lengths_s: Interval, load: Any = 1.0
    ) -> list[_Event]:
        """Events at random times where nothing slides, in order of time."""
        if per_s == 0:
            return []
        scene, quiet = self._scene, _quiet(self._scene)
        if not any(end_s - start_s > lengths_s[1] + _SETTLE_S for start_s, end_s in quiet):
            raise ValueError(
                f"no rest long enough for {purpose} of up to {lengths_s[1]:g} s, {_SETTLE_S:g} s "
                f"to settle and {_MARGIN_S:g} s before and after each slide: pause longer or add "
                "a tail_s"
            )
        rng, events = generator(*scene.key(purpose)), []
        for _ in range(rng.poisson(per_s * sum(end_s - start_s for start_s, end_s in quiet))):
            length_s, size = log_uniform(rng, lengths_s), log_uniform(rng, sizes)
            factor = lognormal(rng, _EVENT_SPREAD, len(self._load_n)) * load
            needed_s = length_s + _SETTLE_S
            starts, latest = np.array([(a, b - needed_s) for a, b in quiet if b - a > needed_s]).T
            reached = np.cumsum(latest - starts)  # of the time in which the event may begin
            place_s = rng.random() * reached[-1]
            gap = np.searchsorted(reached, place_s)
            start_s = float(latest[gap] - (reached[gap] - place_s))
            events.append(_Event(start_s, float(start_s + length_s), size * factor))
        return sorted(events, key=lambda event: event.start_s)

    def _loosenings(self) -> list[_Event]:
        """Grips of negative size, which leave of the load what the shear at that time needs."""
        of, first_s = (
            self._scene.handling,
            min((s.start_s for s in self._scene.slides), default=math.inf),
        )
        events = self._events("loosenings", of.loosenings_per_s, of.loosening_share, of.grip_s)
        held = [self._grasp.shear_after * (event.start_s > first_s) for event in events]
        if self.carried:
            most = _MOST_LIFTED if of.weight_share else _MOST_CARRIED
            held = [max(share, most) for share in held]
        return [
            event._replace(size=-np.minimum(event.size, _MOST_LOOSENED * (1.0 - share)))
            for event, share in zip(events, held, strict=True)
        ]

    @property
    def is_idle(self) -> bool:
        """Whether nothing is done."""
        return not (self.taps or self.grips or self.carried)

    def intervals_s(self, duration_s: float) -> tuple[Interval, ...]:
        """Where the hand is handled: ascending, apart, within the recording, never in a slide.

        The whole of a recording without strokes: there is nothing else to tell slip from.
        """
        arm = self._scene.arm
        if not arm:
            return ((0.0, duration_s),)
        handled = [(event.start_s, event.end_s + _SETTLE_S) for event in (*self.taps, *self.grips)]
        for number, stroke in enumerate(arm):
            later_s = [other.start_s for other in arm[number + 1 :] if other.slides]
            if not stroke.slides:
                handled.append((stroke.start_s, min([stroke.stop_s + _RINGING_S, *later_s])))
        union: list[Interval] = []
        for start_s, end_s in sorted(handled):
            end_s = min(end_s, duration_s)
            if union and start_s <= union[-1][1]:
                union[-1] = (union[-1][0], max(union[-1][1], end_s))
            elif end_s > start_s:
                union.append((start_s, end_s))
        return tuple(union)

    def shear_n(self, element: int, time_s: Array) -> Array:
        """Newtons of a carried object on an element; signed like a slide's friction."""
        total, weight, of = np.zeros(time_s.shape), np.zeros(time_s.shape), self._scene.handling
        for number, stroke in enumerate(self.carried):
            stop_s = stroke.stop_s - stroke.start_s
            corners_s = (0.0, stroke.ramp_s, stop_s - stroke.ramp_s, stop_s)
            since = time_s - stroke.start_s
            up, even, down, rest = (smooth_step((since - at) / _JERK_S) for at in corners_s)
            total += 1e-3 * stroke.acceleration_mm_s2 * (up - even - down + rest)
            if of.weight_share:
                weight += (-1.0) ** number * smooth_step(since / of.lift_s)
        fraction = float((self._load_n / self._load_n.sum())[element])
        weight_n = of.weight_share * float(self._grasp.friction_n.sum()) * weight
        return fraction * (of.carried_kg * total + weight_n)

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
            phase = (grid.time_s[rows] - tap.start_s) / (tap.end_s - tap.start_s)
            extra[rows] += tap.size[element] * np.sin(np.pi * np.clip(phase, 0.0, 1.0))
        for grip in self.grips:
            ramp_s = (grip.end_s - grip.start_s) / 4
            rows, rise = grid.pulse(grip.start_s, grip.end_s, ramp_s)
            extra[rows] += grip.size[element] * rise * before_n[rows]
        return extra

    def knock_v(self, element: int, grid: Grid) -> Array:
        """Volts of a fast channel of unit gain by taps beyond their force: many modes, soon gone.

        Shape:
            - output: ``[K, B]``
        """
        volts, rng = grid.zeros(), generator(*self._scene.key("knocks"), element)
        for tap in self.taps:
            hertz = log_uniform(rng, _KNOCK_HZ, _KNOCK_MODES)
            decays = 1.0 / log_uniform(rng, _KNOCK_DECAY_S, _KNOCK_MODES)
            swings = rng.standard_normal(_KNOCK_MODES) * _KNOCK_V_PER_N * tap.size[element]
            length_s = 12.0 * _KNOCK_DECAY_S[1]
            for f, decay, swing in zip(hertz, decays, swings, strict=True):
                if f < 0.4 * self._scene.sample_rate_hz:
                    rows, wave = grid.ringing(tap.start_s, length_s, 2 * np.pi * f, decay)
                    volts[rows] += swing * wave
        return volts


def _require_carriable(scene: Scene, grasp: Grasp) -> None:
    """Refuse an object whose inertia and weight come near to making the contact slide."""
    force_n = scene.handling.carried_kg * scene.acceleration_m_s2
    friction_n = (1.0 - scene.contact.runout) * float(grasp.friction_n.sum())
    what = f"carrying {scene.handling.carried_kg:g} kg at {scene.acceleration_m_s2:g} m/s2 takes"
    if force_n > _MOST_CARRIED * friction_n:
        raise ValueError(
            f"{what} {force_n:.3g} N, more than half of the {friction_n:.3g} N of static friction: "
            "lower carried_kg or acceleration_m_s2, or raise load_n"
        )
    if force_n > (_MOST_LIFTED - scene.handling.weight_share) * friction_n:
        raise ValueError(
            f"{what} {force_n:.3g} N and its weight {scene.handling.weight_share:g} of the "
            f"{friction_n:.3g} N of static friction, together more than {_MOST_LIFTED:g}: lower "
            "weight_share or carried_kg"
        )
    fraction = force_n / friction_n + scene.handling.weight_share
    for number, stroke in enumerate(scene.arm, 1):
        stops_s = [slide.stop_s for slide in scene.slides if slide.stop_s <= stroke.start_s]
        if stroke.slides or not stops_s:
            continue
        left = float(grasp.relaxed(stroke.start_s - stops_s[-1])[grasp.touching].max())
        if left + fraction > 1.0:
            raise ValueError(
                f"{what} {fraction:.3g} of static friction in stroke {number}, and up to {left:.3g}"
                " may be left of the slide before: pause longer or lower carried_kg or weight_share"
            )


# --- imperfections --------------------------------------------------------------------------------

_PARTIAL_S = (0.05, 0.3)
"""How long a finger slips or sticks on its own; log-uniform. With the speed: .5 to 3 mm (ours)."""

_PARTIAL_MM_S = 10.0  # speed of a partial slip (ours)
_PARTIAL_RAMP_S = 0.01


def _drift_factor(scene: Scene, what: Literal["share", "gain"], number: int, grid: Grid) -> Any:
    """What an element's load share or a channel's gain drifts by, ``[K, B]``; 1 without a drift."""
    of = scene.imperfections
    spread = of.share_wander if what == "share" else of.gain_drift
    return _wandering(spread, generator(*scene.key(what), number), grid) if spread > 0 else 1.0


def _partial_intervals(scene: Scene, finger: str) -> list[Interval]:
    """When a finger slips or sticks on its own; intervals may overlap."""
    per_s = scene.imperfections.partial_slips_per_s
    return _at_random(scene, (*scene.key("partial slips"), finger), per_s, _PARTIAL_S)


# --- faults ---------------------------------------------------------------------------------------


def recorded_channels(scene: Scene) -> tuple[list[int], dict[int, float]]:
    """Whose signal stands in every row of the file, and the volts of rows that hold one value.

    A row has its own channel's signal, unless cables are swapped; what is stuck has the converter's
    zero or its highest step.
    """
    sensors, names = scene.sensors, scene.hand.names
    recorded = list(range(len(names)))
    for one, other in scene.faults.swapped:
        row, row_of_other = names.index(one), names.index(other)
        recorded[row], recorded[row_of_other] = row_of_other, row
    highest_v = sensors.rail_v - 2.0 * sensors.rail_v / 2.0**sensors.num_bits
    dead = {names.index(name): 0.0 for name in scene.faults.dead}
    return recorded, dead | {names.index(name): highest_v for name in scene.faults.saturated}


def losses(scene: Scene, num_samples: int) -> list[tuple[int, int]]:
    """The first sample of every loss and the first behind it, in order; they may overlap.

    The recording's first sample is never lost, so that each loss has one to repeat.
    """
    duration_s, rate_hz = num_samples / scene.sample_rate_hz, scene.sample_rate_hz
    rng, lost = generator(*scene.key("losses")), []
    for _ in range(rng.poisson(scene.faults.drops_per_s * duration_s)):
        start_s = duration_s * rng.random()
        end_s = start_s + 1e-3 * log_uniform(rng, scene.faults.drop_ms)
        lost.append([max(round(start_s * rate_hz), 1), min(round(end_s * rate_hz), num_samples)])
    return [(first, end) for first, end in sorted(lost) if first < end]


def held_samples(scene: Scene, num_samples: int) -> NDArray[np.int64]:
    """Which sample of the sensors stands at every sample of the file, ``[T]``.

    Itself, or in a loss the last one before it.
    """
    held = np.arange(num_samples)
    for first, end in losses(scene, num_samples):
        held[first:end] = held[first - 1]
    return held


# --- forces from outside --------------------------------------------------------------------------


class HandSignals:
    """Volts of a simulated hand for contact forces that something else computes, piece by piece.

    Gains, noise, mains, knocks, faults and, in strokes that move ``"both"``, motor and arm are the
    scene's. What happens at the contact is given, so the scene's own slides, handling and partial
    slips are left out. Each element slides on its own: vibration has the level of its slip speed
    and of the root of its normal force, and lines run with its own travel. In whatever pieces
    forces come, volts are those of one piece, to a step of the converter.

    Args:
        scene: of the hand; it lasts as long as the scene's recording.

    Attributes:
        scene: that was given.
        grasp: how the scene's hand touches, of which come friction, skin and gains; the loads are
            those of a hand at rest, for the caller to share a grip by.
        elements: finger and segment of every element, in the order of the columns of forces.

    Example:
        >>> scene = Scene("M5", strokes=(), tail_s=1.0)
        >>> signals = HandSignals(scene)
        >>> still = np.zeros((10, len(signals.elements)))
        >>> signals.push(still + 0.5, still, still).shape
        (10, 24)
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.grasp = scene, draw_grasp(scene)
        self.elements = tuple(dict.fromkeys((c.finger, c.segment) for c in scene.hand.channels))
        num, empty = len(self.elements), Grid(np.zeros(0, np.int64), scene.sample_rate_hz)
        self._end = math.ceil(scene.end_s * scene.sample_rate_hz - 1e-6)
        self._held = held_samples(scene, self._end)
        self._recorded, self._stuck = recorded_channels(scene)
        self._front, self._is_slow = _draw_front(scene), _is_slow(scene)
        size = self._block_samples = empty.block_samples
        response = _highpass_response(scene.sensors.pvdf_highpass_hz, size, scene.sample_rate_hz)
        self._taps = np.fft.irfft(response)[size::-1]
        none = np.zeros((num, 0))
        num_lines = _lines(scene, self.grasp, none, none).shape[1]
        rngs = [generator(*scene.key("line mixture"), element) for element in range(num)]
        self._mixture = np.stack([rng.standard_normal((2, num_lines)) for rng in rngs])
        self._count, self._travel_mm = 0, np.zeros((num, 1))
        self._forces_n = np.zeros((num, 0))  # of the last block, as fast channels feel them
        self._last_v = np.zeros((1, len(scene.hand)))

    def push(
        self,
        normal_n: ArrayLike,
        friction_n: ArrayLike,
        slip_mm_s: ArrayLike,
        inertia_n: ArrayLike | None = None,
    ) -> Array:
        """The volts of the next samples.

        Args:
            normal_n: that presses each element; before the first sample it was as in it.
            friction_n: size of each element's friction; likewise.
            slip_mm_s: speed at which each element slides, 0 where it sticks: a physics engine
                whose contacts creep needs a dead band.
            inertia_n: of the skin that lets go, whose burst a fast channel feels
                (``Dynamics.release_v_per_n``); none by default.

        Shape:
            - arguments: ``[n, E]``, ``n`` from 0, at the scene's sampling rate
            - output: ``[n, C]``, float64

        Raises:
            ValueError: if an argument has another shape or is not finite, or the scene's recording
                is over.
        """
        none = np.zeros(np.shape(normal_n))
        inertia_n = none if inertia_n is None else inertia_n
        given = {"normal_n": normal_n, "friction_n": friction_n, "slip_mm_s": slip_mm_s}
        arrays = []
        for name, values in {**given, "inertia_n": inertia_n}.items():
            arrays.append(array := np.asarray(values, np.float64))
            if array.shape != (len(arrays[0]), len(self.elements)):
                raise ValueError(
                    f"expected {name} [n, {len(self.elements)}] (samples, elements), all of one n, "
                    f"got {array.shape}"
                )
            if not np.isfinite(array).all() or (name in given and (array < 0).any()):
                raise ValueError(f"{name} must be finite, forces and slip speeds not negative")
        num = len(arrays[0])
        if self._count + num > self._end:
            raise ValueError(
                f"the scene ends after {self._end} samples, got {self._count + num}: raise tail_s"
            )
        pieces, at = [np.zeros((0, len(self.scene.hand)))], 0
        while at < num:
            first = self._count % self._block_samples
            if not first:
                self._begin_block(self._count // self._block_samples)
            taken = min(self._block_samples - first, num - at)
            normal, friction, slip, inertia = (array[at : at + taken].T for array in arrays)
            pieces.append(self._volts(first, normal, friction, slip, inertia))
            at, self._count = at + taken, self._count + taken
        return np.concatenate(pieces)

    def _begin_block(self, block: int) -> None:
        """Make what does not depend on forces."""
        scene, grasp, front = self.scene, self.grasp, self._front
        grid = Grid(np.array([block]), scene.sample_rate_hz)
        channels, elements = range(len(scene.hand)), range(len(self.elements))
        common = enumerate(_common_volts(scene, grid, list(channels)))
        self._noise_v = np.concatenate([_with_noise(scene, front, i, grid, v) for i, v in common])
        vibrations = _Vibrations(scene, grasp, grid)
        self._sliding = np.concatenate([vibrations.sliding_noises(e) for e in elements], 1)
        self._local_v = np.concatenate([vibrations.local_noise_v(e) for e in elements], 1)
        one = grid.zeros() + 1.0
        self._share = np.concatenate(
            [one * _drift_factor(scene, "share", e, grid) for e in elements]
        )
        gains = [g * _drift_factor(scene, "gain", i, grid) * one for i, g in enumerate(front.gain)]
        self._gain = np.concatenate(gains)

    def _volts(
        self, first: int, normal_n: Array, friction_n: Array, slip_mm_s: Array, inertia_n: Array
    ) -> Array:
        """The volts ``[m, C]`` of samples of one block, from forces ``[E, m]``."""
        scene, grasp, part = self.scene, self.grasp, slice(first, first + normal_n.shape[1])
        normal_n, friction_n = (self._share[:, part] * force for force in (normal_n, friction_n))
        travel_mm = self._travel_mm + np.cumsum(slip_mm_s, axis=1) / scene.sample_rate_hz
        self._travel_mm = travel_mm[:, -1:]
        root_load, noises = np.sqrt(normal_n), self._sliding[:, :, part]
        bands = np.zeros_like(noises)
        if (slides := slip_mm_s > 0).any():
            levels_v = (np.where(slides, v, 0.0) for v in _levels_v(scene, grasp, slip_mm_s))
            friction_v, texture_v = (root_load * level_v for level_v in levels_v)
            friction_v = grasp.mu_ratio * grasp.mu_s * friction_v
            lines = _lines(scene, grasp, slip_mm_s, travel_mm)
            lines = np.einsum("epl,plek->ek", self._mixture, lines)
            bands += _sliding_v(scene, grasp, friction_v, texture_v, noises, lines)
        bands += root_load * self._local_v[:, :, part]
        bands[0] += scene.dynamics.release_v_per_n * inertia_n
        steadiness = np.minimum(slip_mm_s / _REFERENCE_MM_S, 1.0)
        vibration = _Vibration(bands, steadiness * noises[1])
        slow_v = _slow_volts(scene, normal_n, friction_n, vibration)
        fast_v = self._strain_v(normal_n + friction_n) + bands[0] + bands[1]
        own = grasp.element_of_channel
        sensed_v = np.where(self._is_slow[:, None], slow_v[own], fast_v[own])
        volts = _converted(scene, self._noise_v[:, part] + self._gain[:, part] * sensed_v)
        volts = volts[self._recorded].T
        volts[:, list(self._stuck)] = list(self._stuck.values())
        held = self._held[self._count : self._count + len(volts)] - self._count
        volts = np.concatenate([self._last_v, volts])[np.maximum(held, -1) + 1]
        self._last_v = volts[-1:]
        return np.asarray(volts)

    def _strain_v(self, force_n: Array) -> Array:
        """What fast channels of unit gain have of a force behind their high-pass, ``[E, m]``."""
        num_before = len(self._taps) - 1
        if self._count == 0:
            self._forces_n = np.repeat(force_n[:, :1], num_before, axis=1)
        force_n = np.concatenate([self._forces_n, force_n], axis=1)
        self._forces_n = force_n[:, -num_before:]
        windows = np.lib.stride_tricks.sliding_window_view(force_n, len(self._taps), axis=1)
        return np.asarray(self.scene.sensors.pvdf_shear_v_per_n * (windows @ self._taps))
