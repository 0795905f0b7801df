"""From the skin to volts: the strain gauge's chain, the film's chain, and the front end.

An SG follows force slowly and stays: preload, shear, creep, offset, drift. A PVDF film gives the
rate of strain: nothing of what stays passes its high-pass. Both end in white noise and a
converter with rails. Last link of the chain in PHYSICS.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.grasp import recording_key, session_key
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.randomness import Array, generator, lognormal, normal_blocks
from tactslip_torch.simulation.scene import Scene
from tactslip_torch.simulation.vibration import Vibration

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
    knobs, num = scene.sensors, len(scene.hand)
    session, rng = generator(*session_key(scene, "front")), generator(*recording_key(scene, "f"))
    gain = lognormal(session, knobs.gain_spread, num) * lognormal(rng, knobs.gain_spread / 3, num)
    floor_mv = knobs.white_noise_mv * lognormal(session, knobs.white_noise_session_spread)
    sg_offset = knobs.sg_session_offset_v * session.standard_normal(num)
    sg_offset = sg_offset + knobs.sg_offset_v * rng.standard_normal(num)
    pvdf_offset = 1e-3 * knobs.pvdf_offset_mv * rng.uniform(-1.0, 1.0, num)
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
    rng = generator(*recording_key(scene, "drift"), index)
    hertz = 0.05 * 40.0 ** rng.random(DRIFT_TONES)
    phase = 2 * np.pi * rng.random(DRIFT_TONES)
    amplitude = 1e-3 * size_mv * np.sqrt(2.0 / DRIFT_TONES) * lognormal(rng, 0.3, DRIFT_TONES)
    nodes = np.arange(_DRIFT_NODES + 1) / _DRIFT_NODES
    t = (grid.blocks[:, None] + nodes) * (grid.block_samples / grid.sample_rate_hz)
    value = np.zeros_like(t)
    for a, f, p in zip(amplitude, hertz, phase, strict=True):
        value += a * np.sin(2 * np.pi * f * t + p)
    step = grid.block_samples // _DRIFT_NODES
    ramp = np.arange(step) / step
    lines: Array = value[:, :-1, None] + np.diff(value)[:, :, None] * ramp
    return np.asarray(lines.reshape(grid.time_s.shape), dtype=np.float64)


def warming(scene: Scene, index: int, grid: Grid, duration_s: float) -> Array:
    """How far one channel's zero has moved as the hand warms up, in volts, ``[K, B]``.

    Nothing at first, fast in the beginning and slower later, with a sign and size of the
    channel's own; a film moves a fiftieth as far as a gauge.
    """
    rng = generator(*recording_key(scene, "warming"), index)
    share = 1.0 if scene.hand.channels[index].adapting == "slow" else FILM_WARMING_SHARE
    sign = 1.0 if rng.random() < 0.5 else -1.0
    far_v = 1e-3 * scene.sensors.warming_mv * share * sign * float(lognormal(rng, 0.5))
    since = np.maximum(grid.time_s, 0.0) / duration_s
    way: Array = np.expm1(-WARMING_TIMES * since) / np.expm1(-WARMING_TIMES)
    return far_v * way


def front_end(
    scene: Scene, front: Front, index: int, grid: Grid, volts: Array, duration_s: float
) -> Array:
    """What the converter says: with offset, drift and white noise, between the rails, in steps."""
    key = (*recording_key(scene, "white"), scene.hand.names[index])
    noise = front.white_v[index] * normal_blocks(key, grid.blocks, grid.block_samples)
    total = volts + front.offset_v[index] + drift(scene, index, grid) + noise
    if scene.sensors.warming_mv > 0:
        total = total + warming(scene, index, grid, duration_s)
    rail_v = scene.sensors.rail_v
    step: float = 2.0 * rail_v / 2.0**scene.sensors.num_bits
    quantised: Array = np.clip(np.round(total / step) * step, -rail_v, rail_v - step)
    return quantised
