"""From the skin to volts: what sliding sounds like, the strain gauge, the film, the front end.

*Vibration* is in volts at a PVDF film of unit gain. Three parts while an element slides: a *high*
part, broadband behind the skin's resonance (friction noise of every contact, and the texture's
``k^-a`` part, whose spectrum keeps its shape at any speed); a *low* part below 25 Hz; and *lines*
at speed over wavelength, which run with the arm's position. Then a burst where it lets go.

An SG follows force slowly and stays: preload, shear, creep, offset, drift. A PVDF film gives the
rate of strain: nothing of what stays passes its high-pass. Both end in white noise and a
converter with rails. Last links of the chain in PHYSICS.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.blocks import (
    Array,
    Grid,
    causal_response,
    generator,
    lognormal,
    normal_blocks,
)
from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.grasp import Grasp, Surface
from tactslip_torch.simulation.scene import Motion, Scene

REFERENCE_MM_S = 40.0
"""The speed at which levels are given."""

LOW_BAND_HZ = 25.0
"""Where the low part of friction noise ends."""

LINE_DAMPING = 0.5
"""Damping ratio with which lines meet the skin: a patch is many bristles (prior, ours)."""

SG_VIBRATION_SHARE = 0.08
"""Of the film's vibration, what the gauge on the stiff backing sees (prior, ours)."""

FORCE_FLUCTUATION = 0.03
"""Slow fluctuation of friction over its mean while sliding, rms (prior, ours)."""

DRIFT_TONES = 4
"""Slow sines that make up a channel's drift, .05 to 2 Hz."""

WARMING_TIMES = 2.0
"""Time constants of warming that a recording lasts (prior, ours)."""

FILM_WARMING_SHARE = 0.02
"""Of a gauge's warming, what is left behind a film's high-pass (prior, ours)."""

_DRIFT_NODES = 8  # per block, joined by straight lines

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


@dataclass(frozen=True, eq=False)
class Field:
    """What all elements of a recording share on a grid.

    Args:
        grid: where.
        friction_level: volts rms of friction noise at mu = 1 and 1 N, ``[K, B]``.
        texture_level: volts rms of texture at 1 N, ``[K, B]``.
        lines: sine and cosine of every line, ``[2, L, K, B]``; L may be 0.
    """

    grid: Grid
    friction_level: Array
    texture_level: Array
    lines: Array


def shared_field(scene: Scene, grasp: Grasp, motion: Motion) -> Field:
    """Levels and lines as the arm's speed and position make them."""
    surface, contact = grasp.surface, scene.contact
    relative = motion.speed_mm_s / REFERENCE_MM_S
    return Field(
        grid=motion.grid,
        friction_level=1e-3 * contact.friction_noise_mv * relative**contact.friction_noise_exponent,
        texture_level=1e-3 * surface.texture_mv * relative**surface.texture_exponent,
        lines=_lines(scene, grasp, motion.position_mm, motion.speed_mm_s),
    )


def _lines(scene: Scene, grasp: Grasp, position_mm: Array, speed_mm_s: Array) -> Array:
    """Sine and cosine of the texture's lines, weighted by what the skin and the converter pass.

    A tacky material's sawtooth has harmonics that fall with their order. Lines near or beyond
    the Nyquist frequency are faded out, not folded.
    """
    wavelengths_mm, weights = _line_table(scene, grasp.surface)
    out = np.zeros((2, len(weights), *position_mm.shape))
    middle_hz, damping = float(np.median(grasp.resonance_hz)), LINE_DAMPING
    for number, (wavelength, weight) in enumerate(zip(wavelengths_mm, weights, strict=True)):
        frequency = speed_mm_s / wavelength
        passed = weight * np.minimum(_resonance(frequency, middle_hz, damping), 1.0)
        passed *= np.clip(4.5 - 10.0 * frequency / scene.sample_rate_hz, 0.0, 1.0)
        phase = (2 * np.pi / wavelength) * position_mm
        np.multiply(passed, np.sin(phase), out=out[0, number])
        np.multiply(passed, np.cos(phase), out=out[1, number])
    return out


def _line_table(scene: Scene, surface: Surface) -> tuple[list[float], list[float]]:
    """Wavelengths in mm and weights whose squares sum to 1; empty without a wavelength.

    A tacky material's lines stand for its stick-slip, so bristles, which stick and slip, have none.
    """
    tacky = surface.material.character == "tacky"
    if surface.wavelength_mm is None or (tacky and scene.fidelity != "kinematic"):
        return [], []
    rng = generator(*scene.session_key("lines"), scene.material)
    orders = np.repeat([1, 2, 3, 4], 2) if tacky else np.ones(6)
    spread = lognormal(rng, surface.material.line_bandwidth, len(orders))
    weights = (1.0 / orders) / np.sqrt(np.sum(1.0 / orders**2))
    return (surface.wavelength_mm * spread / orders).tolist(), weights.tolist()


def _resonance(frequency_hz: Array, resonance_hz: float, damping: float) -> Array:
    """Magnitude of the skin's resonance, 1 at its peak."""
    ratio = (frequency_hz / resonance_hz) ** 2
    return 2 * damping / np.sqrt((1 - ratio) ** 2 + 4 * damping**2 * ratio)


def band_responses(grasp: Grasp, element: int, grid: Grid) -> NDArray[np.complex128]:
    """Filters of the high and of the low part, of unit power, ``[2, B + 1]``.

    The high part: rate of a height spectrum ``k^-a``, so ``f^(1 - a/2)``, behind the skin. They
    belong to the session, so its recordings share them.
    """
    return _band_responses(
        grasp.surface.spectral_exponent,
        float(grasp.resonance_hz[element]),
        float(grasp.damping[element]),
        grid.block_samples,
        grid.sample_rate_hz,
    )


@lru_cache(maxsize=256)
def _band_responses(
    exponent: float, resonance_hz: float, damping: float, block_samples: int, rate_hz: float
) -> NDArray[np.complex128]:
    nowhere = Grid(np.zeros(0, dtype=np.int64), block_samples, rate_hz)
    f = np.maximum(nowhere.frequency_hz(), 1.0)
    tilt = (f / LOW_BAND_HZ) ** (1.0 - 0.5 * exponent)
    skin = _resonance(f, resonance_hz, damping)
    step = (f / LOW_BAND_HZ) ** 4
    high = tilt * skin * np.sqrt(step / (1 + step))
    low = np.sqrt(f**2 / (f**2 + 4.0) / (1 + step))
    responses = causal_response(np.stack([high, low]), unit_power=True)
    responses.flags.writeable = False
    return responses


def element_vibration(
    scene: Scene, grasp: Grasp, contact: ElementContact, field: Field, element: int
) -> Vibration:
    """One touching element's vibration over the whole grid; work only in blocks that slide."""
    grid = field.grid
    vibration = Vibration(grid.zeros(), grid.zeros(), grid.zeros())
    responses = None
    for rows in _runs(np.asarray(contact.slide.any(axis=-1))):
        responses = band_responses(grasp, element, grid) if responses is None else responses
        slide = contact.slide[rows]
        part = grid.only(rows)
        noise = [
            part.coloured_noise((*scene.key(band), element), response)
            for band, response in zip(("high", "low"), responses, strict=True)
        ]
        root_load = np.sqrt(grasp.load_n[element])
        friction = grasp.surface.mu_ratio * grasp.surface.mu_s * root_load
        friction = friction * field.friction_level[rows]
        texture = root_load * field.texture_level[rows]
        gate = slide
        if scene.fidelity == "bristles":  # a speed of its own, where the other is a fading in
            friction = friction * _powered(slide, scene.contact.friction_noise_exponent)
            texture = texture * _powered(slide, grasp.surface.texture_exponent)
            gate = np.ones(slide.shape)
        low_share, line_share = (
            scene.contact.friction_noise_low_share,
            grasp.surface.material.line_share,
        )
        broad = np.sqrt((1 - low_share) * friction**2 + (1 - line_share) * texture**2)
        lines = _element_lines(scene, field, element, rows)
        high = broad * noise[0] + np.sqrt(line_share) * texture * lines
        vibration.high[rows] += gate * high
        vibration.low[rows] += gate * (np.sqrt(low_share) * friction * noise[1])
        vibration.fluctuation[rows] += np.minimum(slide, 1.0) * noise[1]
    vibration.high[:] += contact.release_v
    return vibration


def shear_noise_v(scene: Scene, grasp: Grasp, element: int, speed_mm_s: float) -> float:
    """Volts rms of an element that slides steadily, its texture's lines counted as noise."""
    surface, contact, relative = grasp.surface, scene.contact, speed_mm_s / REFERENCE_MM_S
    friction_mv = contact.friction_noise_mv * relative**contact.friction_noise_exponent
    texture_mv = surface.texture_mv * relative**surface.texture_exponent
    root_load = float(np.sqrt(grasp.load_n[element]))
    return (
        1e-3
        * root_load
        * float(np.hypot(surface.mu_ratio * surface.mu_s * friction_mv, texture_mv))
    )


def _powered(slide: Array, exponent: float) -> Array:
    """Level over that at the arm's speed; none where nothing slides, whatever the power."""
    return np.where(slide > 0, slide**exponent, 0.0)


def _runs(chosen: NDArray[np.bool_]) -> list[slice]:
    """The stretches of rows that are chosen."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]])))
    return [slice(int(low), int(high)) for low, high in edges.reshape(-1, 2)]


def _element_lines(scene: Scene, field: Field, element: int, rows: slice) -> Array:
    """The element's own mixture of the shared lines, about unit rms."""
    total = np.zeros(field.friction_level[rows].shape)
    num_lines = field.lines.shape[1]
    if num_lines:
        rng = generator(*scene.key("line mixture"), element)
        mixture = rng.standard_normal((2, num_lines))
        for part in range(2):
            for line in range(num_lines):
                total += mixture[part, line] * field.lines[part, line, rows]
    return total


# --- sensors --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Front:
    """Parameters of every channel in one recording, ``[C]`` each.

    Args:
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
    gain = lognormal(session, sensors.gain_spread, num) * lognormal(
        rng, sensors.gain_spread / 3, num
    )
    floor_mv = sensors.white_noise_mv * lognormal(session, sensors.white_noise_session_spread)
    sg_offset = sensors.sg_session_offset_v * session.standard_normal(num)
    sg_offset = sg_offset + sensors.sg_offset_v * rng.standard_normal(num)
    pvdf_offset = 1e-3 * sensors.pvdf_offset_mv * rng.uniform(-1.0, 1.0, num)
    is_sg = np.array([channel.adapting == "slow" for channel in scene.hand.channels])
    return Front(
        gain=gain,
        white_v=1e-3 * floor_mv * lognormal(session, 0.2, num),
        offset_v=np.where(is_sg, sg_offset, pvdf_offset),
    )


@lru_cache(maxsize=8)
def highpass_response(
    corner_hz: float, block_samples: int, sample_rate_hz: float
) -> NDArray[np.complex128]:
    """The film and its amplifier: first-order high-pass that passes no constant, ``[B + 1]``.

    The one-pole filter with a zero at 0 Hz, cut after one block and freed of what the cut leaves
    at 0 Hz (e^-10 of the step at 6.6 Hz).
    """
    pole = np.exp(-2 * np.pi * corner_hz / sample_rate_hz)
    taps = -(1 - pole) * pole ** np.arange(-1.0, block_samples)
    taps[0] = 1.0
    taps *= 0.5 * (1 + pole)
    taps -= taps.mean()
    return np.asarray(np.fft.rfft(taps, 2 * block_samples), dtype=np.complex128)


def gauge_volts(scene: Scene, normal_n: Array, friction_n: Array, vibration: Vibration) -> Array:
    """What an SG of unit gain says of its element."""
    sensors = scene.sensors
    slow = sensors.sg_shear_v_per_n * friction_n * (1.0 + FORCE_FLUCTUATION * vibration.fluctuation)
    return (
        sensors.sg_preload_v_per_n * normal_n
        + slow
        + SG_VIBRATION_SHARE * (vibration.high + vibration.low)
    )


def film_volts(
    scene: Scene,
    grid: Grid,
    friction_n: Array,
    vibration: Vibration,
    press_n: Array | None = None,
) -> Array:
    """What a PVDF film of unit gain says of its element.

    Args:
        scene: whose sensors.
        grid: where the volts are wanted.
        friction_n: friction on ``grid.history``.
        vibration: on ``grid``; behind the high-pass already.
        press_n: normal force that taps and grips add, on ``grid.history``; the film feels it
            like friction (prior, ours). ``None`` without any.
    """
    _, before, now = grid.history
    force_n = friction_n if press_n is None else friction_n + press_n
    strain_v = scene.sensors.pvdf_shear_v_per_n * force_n
    response = highpass_response(
        scene.sensors.pvdf_highpass_hz, grid.block_samples, grid.sample_rate_hz
    )
    slow = grid.filtered(strain_v[before], strain_v[now], response)
    return slow + vibration.high + vibration.low


def drift(scene: Scene, index: int, grid: Grid) -> Array:
    """Slow drift of one channel in volts, ``[K, B]``: a few slow sines."""
    is_sg = scene.hand.channels[index].adapting == "slow"
    size_mv = scene.sensors.sg_drift_mv if is_sg else scene.sensors.pvdf_drift_mv
    rng = generator(*scene.key("drift"), index)
    hertz = 0.05 * 40.0 ** rng.random(DRIFT_TONES)
    phase = 2 * np.pi * rng.random(DRIFT_TONES)
    amplitude = 1e-3 * size_mv * np.sqrt(2.0 / DRIFT_TONES) * lognormal(rng, 0.3, DRIFT_TONES)
    t = grid.node_times_s(_DRIFT_NODES)
    value = np.zeros_like(t)
    for a, f, p in zip(amplitude, hertz, phase, strict=True):
        value += a * np.sin(2 * np.pi * f * t + p)
    return grid.joined(value)


def warming(scene: Scene, index: int, grid: Grid) -> Array:
    """How far one channel's zero has moved as the hand warms up, in volts, ``[K, B]``.

    Nothing at first, fast in the beginning and slower later, with a sign and size of the
    channel's own; a film moves a fiftieth as far as a gauge.
    """
    rng = generator(*scene.key("warming"), index)
    share = 1.0 if scene.hand.channels[index].adapting == "slow" else FILM_WARMING_SHARE
    sign = 1.0 if rng.random() < 0.5 else -1.0
    far_v = 1e-3 * scene.sensors.warming_mv * share * sign * float(lognormal(rng, 0.5))
    since = np.maximum(grid.time_s, 0.0) / scene.end_s
    way: Array = np.expm1(-WARMING_TIMES * since) / np.expm1(-WARMING_TIMES)
    return far_v * way


def front_end(scene: Scene, front: Front, index: int, grid: Grid, volts: Array) -> Array:
    """What the converter says: with offset, drift and white noise, between the rails, in steps."""
    key = (*scene.key("white"), scene.hand.names[index])
    noise = front.white_v[index] * normal_blocks(key, grid.blocks, grid.block_samples)
    total = volts + front.offset_v[index] + drift(scene, index, grid) + noise
    if scene.sensors.warming_mv > 0:
        total = total + warming(scene, index, grid)
    rail_v = scene.sensors.rail_v
    step: float = 2.0 * rail_v / 2.0**scene.sensors.num_bits
    quantised: Array = np.clip(np.round(total / step) * step, -rail_v, rail_v - step)
    return quantised
