"""What a sliding element sounds like: friction noise, texture, and the bursts of letting go.

Volts at a PVDF film of unit gain. Three parts while an element slides: a *high* part, broadband
behind the skin's resonance (friction noise of every contact, and the texture's ``k^-a`` part,
whose spectrum keeps its shape at any speed); a *low* part below 25 Hz; and *lines* at
speed over wavelength, which run with the arm's position. Then a burst where it lets go.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.grasp import Grasp, Surface, recording_key, session_key
from tactslip_torch.simulation.grid import Grid, causal_response
from tactslip_torch.simulation.motion import Motion
from tactslip_torch.simulation.randomness import Array, generator, lognormal
from tactslip_torch.simulation.scene import Scene

REFERENCE_MM_S = 40.0
"""The speed at which levels are given."""

LOW_BAND_HZ = 25.0
"""Where the low part of friction noise ends."""

LINE_DAMPING = 0.5
"""Damping ratio with which lines meet the skin: a patch is many bristles (prior, ours)."""


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

    A tacky material's lines stand for its stick-slip, so a rung that sticks and slips has none.
    """
    tacky = surface.material.character == "tacky"
    if surface.wavelength_mm is None or (tacky and scene.fidelity != "kinematic"):
        return [], []
    rng = generator(*session_key(scene, "lines"), scene.material)
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
    grid, shape = field.grid, field.grid.time_s.shape
    vibration = Vibration(np.zeros(shape), np.zeros(shape), np.zeros(shape))
    responses = None
    for rows in _runs(np.asarray(contact.slide.any(axis=-1))):
        responses = band_responses(grasp, element, grid) if responses is None else responses
        slide = contact.slide[rows]
        part = Grid(grid.blocks[rows], grid.block_samples, grid.sample_rate_hz)
        noise = [
            part.coloured_noise((*recording_key(scene, band), element), response)
            for band, response in zip(("high", "low"), responses, strict=True)
        ]
        root_load = np.sqrt(grasp.load_n[element])
        friction = grasp.surface.mu_ratio * grasp.surface.mu_s * root_load
        friction = friction * field.friction_level[rows]
        texture = root_load * field.texture_level[rows]
        gate = slide
        if scene.fidelity != "kinematic":  # a speed of its own, where the other is a fading in
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
        rng = generator(*recording_key(scene, "line mixture"), element)
        mixture = rng.standard_normal((2, num_lines))
        for part in range(2):
            for line in range(num_lines):
                total += mixture[part, line] * field.lines[part, line, rows]
    return total
