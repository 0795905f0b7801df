"""From the skin to volts: what sliding sounds like, the strain gauge, the film, the front end.

*Vibration* is in volts at a PVDF film of unit gain. Three parts while an element slides: a *high*
part, broadband behind the skin's resonance (friction noise of every contact, and the texture's
``k^-a`` part, whose spectrum keeps its shape at any speed); a *low* part below 25 Hz; and *lines*
at speed over wavelength, which run with the arm's position. Then a burst where it lets go.

An SG channel follows force slowly and stays: preload, shear, creep, offset, drift. A PVDF channel
gives the rate of strain: nothing of what stays passes its high-pass. Both end in white noise and a
converter with rails. Last links of the chain in PHYSICS.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tactslip_torch.simulation._blocks import (
    Array,
    Flags,
    Grid,
    Key,
    Spectrum,
    causal_response,
    generator,
    lognormal,
)
from tactslip_torch.simulation._contact import ElementContact, Grasp
from tactslip_torch.simulation.scene import Motion, Scene

_REFERENCE_MM_S = 40.0  # the speed at which levels are given
_LOW_BAND_HZ = 25.0  # where the low part of friction noise ends
_LINE_DAMPING = 0.5  # ratio with which lines meet the skin: a patch is many bristles (prior, ours)
_SG_VIBRATION = 0.08  # of a film's vibration, what an SG channel sees (prior, ours)
_FORCE_FLUCTUATION = 0.03  # slow, of friction over its mean while sliding, rms (prior, ours)
_DRIFT_HZ = (0.05, 2.0)  # where a channel's drift lies
_DRIFT_NODES = 8  # per block
_WARMING_TIMES = 2.0  # time constants of warming that a recording lasts (prior, ours)
_PVDF_WARMING = 0.02  # of an SG channel's warming, what passes a film's high-pass (prior, ours)

# --- vibration ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Vibration:
    """One element's vibration on a grid, ``[K, B]`` each.

    Args:
        high: volts above about 25 Hz, bursts included.
        low: volts below 25 Hz.
        fluctuation: the friction force's relative slow fluctuation, unit rms while sliding.
    """

    high: Array
    low: Array
    fluctuation: Array


class SharedVibration(NamedTuple):
    """What all elements of a recording share on a grid.

    Attributes:
        friction_v: rms of friction noise at mu = 1 and 1 N, ``[K, B]``.
        texture_v: rms of texture at 1 N, ``[K, B]``.
        lines: sine and cosine of every line, ``[2, L, K, B]``; L may be 0.
    """

    friction_v: Array
    texture_v: Array
    lines: Array


def shared_vibration(scene: Scene, grasp: Grasp, motion: Motion) -> SharedVibration:
    """Levels and lines as the arm's speed and position make them."""
    levels_v = _levels_v(scene, grasp, motion.speed_mm_s)
    return SharedVibration(*levels_v, _lines(scene, grasp, motion))


def _levels_v(scene: Scene, grasp: Grasp, speed_mm_s: Array) -> tuple[Array, Array]:
    """Volts rms of friction noise at mu = 1 and of texture, both at 1 N."""
    relative, contact = speed_mm_s / _REFERENCE_MM_S, scene.contact
    friction_v = 1e-3 * contact.friction_noise_mv * relative**contact.friction_noise_exponent
    return friction_v, 1e-3 * grasp.texture_mv * relative**grasp.texture_exponent


def _lines(scene: Scene, grasp: Grasp, motion: Motion) -> Array:
    """Sine and cosine of the texture's lines, weighted by what the skin and the converter pass.

    Their weights' squares sum to 1. A tacky material's sawtooth has harmonics that fall with their
    order; these lines stand for its stick-slip, so bristles, which stick and slip, have none. Lines
    near or beyond the Nyquist frequency are faded out, not folded.
    """
    shape = motion.grid.time_s.shape
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
        frequency = motion.speed_mm_s / wavelength
        passed = np.minimum(_resonance(frequency, middle_hz, _LINE_DAMPING), 1.0)
        passed *= weights[number] * np.clip(4.5 - 10.0 * frequency / scene.sample_rate_hz, 0, 1)
        phase = (2 * np.pi / wavelength) * motion.position_mm
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


def band_noises(grasp: Grasp, element: int, grid: Grid, keys: Iterable[Key]) -> list[Array]:
    """Noise of the high and of the low part, of unit rms, by the key of each."""
    skin = float(grasp.resonance_hz[element]), float(grasp.damping[element])
    responses = _band_responses(grasp.spectral_exponent, *skin, grid.sample_rate_hz)
    return [grid.coloured_noise(key, part) for key, part in zip(keys, responses, strict=True)]


def element_vibration(
    scene: Scene,
    grasp: Grasp,
    contact: ElementContact,
    shared: SharedVibration,
    element: int,
    grid: Grid,
) -> Vibration:
    """One touching element's vibration over the whole grid; work only in blocks that slide."""
    material = grasp.material
    low_fraction = scene.contact.friction_noise_low_share
    line_fraction = material.line_share if material.wavelength_mm else 0.0
    root_load = np.sqrt(grasp.load_n[element])
    mixture = generator(*scene.key("line mixture"), element).standard_normal(shared.lines.shape[:2])
    vibration = Vibration(contact.release_v.copy(), grid.zeros(), grid.zeros())
    for rows in _runs(np.asarray(contact.slide.any(axis=-1))):
        slide, part = contact.slide[rows], grid.only(rows)
        keys = ((*scene.key(band), element) for band in ("high", "low"))
        high, low = band_noises(grasp, element, part, keys)
        if scene.fidelity == "bristles":  # a speed of its own, with the sound of that speed
            friction_gate = _powered(slide, scene.contact.friction_noise_exponent)
            texture_gate = _powered(slide, grasp.texture_exponent)
        else:  # a fading in
            friction_gate = texture_gate = slide
        friction = grasp.mu_ratio * grasp.mu_s * root_load * shared.friction_v[rows]
        friction = friction * friction_gate
        texture = root_load * shared.texture_v[rows] * texture_gate
        broad = np.sqrt((1 - low_fraction) * friction**2 + (1 - line_fraction) * texture**2)
        lines = np.einsum("pl,plkb->kb", mixture, shared.lines[:, :, rows])
        vibration.high[rows] += broad * high + np.sqrt(line_fraction) * texture * lines
        vibration.low[rows] += np.sqrt(low_fraction) * friction * low
        vibration.fluctuation[rows] += np.minimum(slide, 1.0) * low
    return vibration


def steady_vibration_v(scene: Scene, grasp: Grasp, element: int, speed_mm_s: float) -> float:
    """Volts rms of an element that slides steadily, its texture's lines counted as noise."""
    friction_v, texture_v = _levels_v(scene, grasp, np.asarray(speed_mm_s))
    kinetic = grasp.mu_ratio * grasp.mu_s
    return float(np.sqrt(grasp.load_n[element]) * np.hypot(kinetic * friction_v, texture_v))


def _powered(slide: Array, exponent: float) -> Array:
    """Level over that at the arm's speed; none where nothing slides, whatever the power."""
    return np.where(slide > 0, slide**exponent, 0.0)


def _runs(chosen: Flags) -> list[slice]:
    """The runs of rows that are chosen."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]])))
    return [slice(int(low), int(high)) for low, high in edges.reshape(-1, 2)]


# --- sensors --------------------------------------------------------------------------------------


class Front(NamedTuple):
    """Parameters of every channel in one recording, ``[C]`` each.

    Attributes:
        gain: factor on what the element feels.
        white_v: rms of white noise.
        offset_v: constant.
    """

    gain: Array
    white_v: Array
    offset_v: Array


def draw_front(scene: Scene) -> Front:
    """Gains, noise floors and offsets: per session, and a little again per recording."""
    sensors, num = scene.sensors, len(scene.hand)
    session, rng = generator(*scene.session_key("front")), generator(*scene.key("f"))
    gain = lognormal(session, sensors.gain_spread, num)
    gain = gain * lognormal(rng, sensors.gain_spread / 3, num)
    floor_mv = sensors.white_noise_mv * lognormal(session, sensors.white_noise_session_spread)
    sg_offset = sensors.sg_session_offset_v * session.standard_normal(num)
    sg_offset = sg_offset + sensors.sg_offset_v * rng.standard_normal(num)
    pvdf_offset = 1e-3 * sensors.pvdf_offset_mv * rng.uniform(-1.0, 1.0, num)
    return Front(
        gain=gain,
        white_v=1e-3 * floor_mv * lognormal(session, 0.2, num),
        offset_v=np.where(is_slow(scene), sg_offset, pvdf_offset),
    )


def is_slow(scene: Scene) -> Flags:
    """Which channels are slow, ``[C]``."""
    return np.isin(np.arange(len(scene.hand)), scene.hand.slow)


@lru_cache(maxsize=8)
def highpass_response(corner_hz: float, block_samples: int, sample_rate_hz: float) -> Spectrum:
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


def slow_volts(scene: Scene, normal_n: Array, friction_n: Array, vibration: Vibration) -> Array:
    """What an SG channel of unit gain says of its element; all on one grid."""
    sensors = scene.sensors
    shear_v = sensors.sg_shear_v_per_n * friction_n
    shear_v = shear_v * (1.0 + _FORCE_FLUCTUATION * vibration.fluctuation)
    vibration_v = _SG_VIBRATION * (vibration.high + vibration.low)
    return sensors.sg_preload_v_per_n * normal_n + shear_v + vibration_v


def fast_volts(scene: Scene, grid: Grid, force_n: Array, vibration: Vibration) -> Array:
    """What a PVDF channel of unit gain says of its element.

    Args:
        scene: whose sensors.
        grid: where the volts are wanted.
        force_n: friction, and what taps and grips press, on ``grid.history``.
        vibration: on ``grid``; behind the high-pass already.
    """
    corner_hz = scene.sensors.pvdf_highpass_hz
    response = highpass_response(corner_hz, grid.block_samples, grid.sample_rate_hz)
    strain_v = grid.filtered(scene.sensors.pvdf_shear_v_per_n * force_n, response)
    return strain_v + vibration.high + vibration.low


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
    fraction = 1.0 if index in scene.hand.slow else _PVDF_WARMING
    sign = 1.0 if rng.random() < 0.5 else -1.0
    far_v = 1e-3 * scene.sensors.warming_mv * fraction * sign * lognormal(rng, 0.5)
    since = np.maximum(grid.time_s, 0.0) / scene.end_s
    return np.asarray(far_v * np.expm1(-_WARMING_TIMES * since) / np.expm1(-_WARMING_TIMES))


def converted(scene: Scene, front: Front, index: int, grid: Grid, volts: Array) -> Array:
    """What the converter says: with offset, drift and white noise, between the rails, in steps."""
    noise = grid.white_noise((*scene.key("white"), scene.hand.names[index]))
    total = volts + front.offset_v[index] + front.white_v[index] * noise
    total += _drift_v(scene, index, grid)
    if scene.sensors.warming_mv > 0:
        total += _warming_v(scene, index, grid)
    rail_v = scene.sensors.rail_v
    step_v = 2.0 * rail_v / 2.0**scene.sensors.num_bits
    return np.asarray(np.clip(np.round(total / step_v) * step_v, -rail_v, rail_v - step_v))
