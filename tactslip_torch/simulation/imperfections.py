"""Noise, wander and partial slip of single elements; nothing where their parameters are zero.

Everything is a function of absolute time and of keys of its own, so nothing else moves.
"""

from __future__ import annotations

import numpy as np

from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.events import Stretch, smooth_step
from tactslip_torch.simulation.grasp import Grasp, recording_key, session_key
from tactslip_torch.simulation.grid import Grid, causal_response
from tactslip_torch.simulation.randomness import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.scene import Scene
from tactslip_torch.simulation.vibration import Vibration, band_responses, shear_noise_v

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
    nodes = np.arange(_NODES + 1) / _NODES
    t = (grid.blocks[:, None] + nodes) * (grid.block_samples / grid.sample_rate_hz)
    value = np.sin(2 * np.pi * hertz * t[..., None] + phase).sum(-1) * np.sqrt(2 / WANDER_TONES)
    ramp = np.arange(grid.block_samples // _NODES) / (grid.block_samples // _NODES)
    lines = value[:, :-1, None] + np.diff(value)[:, :, None] * ramp
    return np.asarray(lines.reshape(len(grid.blocks), grid.block_samples), dtype=np.float64)


def load_factor(scene: Scene, element: int, grid: Grid) -> Array | None:
    """What an element's load wanders by, ``[K, B]``; ``None`` if it does not."""
    spread = scene.imperfections.share_wander
    if spread == 0:
        return None
    return np.exp(spread * wander(generator(*recording_key(scene, "share"), element), grid))


def gain_factor(scene: Scene, index: int, grid: Grid) -> Array | float:
    """What a channel's gain drifts by, ``[K, B]``; 1 if it does not."""
    spread = scene.imperfections.gain_drift
    if spread == 0:
        return 1.0
    return np.exp(spread * wander(generator(*recording_key(scene, "gain"), index), grid))


def disturb(
    scene: Scene,
    grasp: Grasp,
    contact: ElementContact,
    element: int,
    grid: Grid,
    vibration: Vibration,
    duration_s: float,
) -> None:
    """Change one touching element's vibration, in place: partial slip or sticking, local noise."""
    parameters = scene.imperfections
    for start_s, end_s in partial_stretches(scene, _finger(scene, grasp, element), duration_s):
        rows = grid.overlapping(start_s, end_s)
        if rows.start == rows.stop:
            continue
        part = Grid(grid.blocks[rows], grid.block_samples, grid.sample_rate_hz)
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
        rng = generator(*recording_key(scene, "local noise"), element)
        size_v = 1e-3 * parameters.local_noise_mv * float(lognormal(rng, LEVEL_SPREAD))
        level = np.exp(LEVEL_SPREAD * wander(rng, grid)) * np.sqrt(grasp.load_n[element]) * size_v
        bands = _bands(scene, grasp, element, grid, "local noise")
        for band, noise in zip((vibration.high, vibration.low), bands, strict=True):
            band[:] += level * noise


def pickup(scene: Scene, grid: Grid) -> tuple[Array, Array] | None:
    """Pick-up in volts at a channel of coupling 1, ``[K, B]``, and the couplings, ``[C]``."""
    size_mv = scene.imperfections.pickup_mv
    if size_mv == 0:
        return None
    session = generator(*session_key(scene, "pick-up"))
    num = len(scene.hand)
    signs = np.where(session.random(num) < 0.5, -1.0, 1.0)
    fast = np.array([channel.adapting == "fast" for channel in scene.hand.channels])
    couplings = signs * lognormal(session, COUPLING_SPREAD, num) * np.where(fast, 1.0, GAUGE_PICKUP)
    f = np.maximum(grid.frequency_hz(), 1.0)
    response = causal_response(f / (f + 20.0) / (1 + f / 200.0), unit_power=True)
    level = np.exp(LEVEL_SPREAD * wander(generator(*recording_key(scene, "pick-up level")), grid))
    noise = grid.coloured_noise(recording_key(scene, "pick-up"), response)
    return 1e-3 * size_mv * level * noise, couplings


def partial_stretches(scene: Scene, finger: str, duration_s: float) -> tuple[Stretch, ...]:
    """When a finger slips or sticks on its own; stretches may overlap."""
    rate_hz = scene.imperfections.partial_slips_per_s
    if rate_hz == 0:
        return ()
    rng = generator(*recording_key(scene, "partial slips"), finger)
    starts_s = duration_s * rng.random(int(rng.poisson(rate_hz * duration_s)))
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
        share * grid.coloured_noise((*recording_key(scene, purpose), element, name), response)
        for share, name, response in zip(shares, ("high", "low"), responses, strict=True)
    ]
