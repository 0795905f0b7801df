"""A machine beside the hand: it runs up, turns, runs down, and all the table hums with it.

An unbalanced rotor shakes with the square of its speed; its harmonics follow from gears and
blades. Everything is a function of absolute time.
"""

from __future__ import annotations

import numpy as np

from tactslip_torch.simulation.events import Stretch
from tactslip_torch.simulation.grasp import recording_key, session_key
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.randomness import Array, generator, log_uniform, lognormal
from tactslip_torch.simulation.scene import Scene

ORDERS = (1, 2, 3, 4, 6, 8)
"""Harmonics of the rotation."""

RUN_S = (1.0, 4.0)
"""How long a run lasts; log-uniform (ours)."""

BREAK_S = (0.5, 2.0)
"""How long the machine stands between runs; log-uniform (ours)."""

RAMP_S = 0.3
"""How long it runs up and down, at both ends of a run (ours)."""


def machine_runs(scene: Scene, duration_s: float) -> tuple[Stretch, ...]:
    """When the neighbouring machine turns, runs up or runs down; the last run may go on."""
    if scene.disturbances.machine_mv == 0:
        return ()
    rng = generator(*recording_key(scene, "machine"))
    runs, now_s = [], BREAK_S[1] * rng.random()
    while now_s < duration_s:
        stop_s = now_s + log_uniform(rng, RUN_S)
        runs.append((now_s, stop_s))
        now_s = stop_s + log_uniform(rng, BREAK_S)
    return tuple(runs)


def rotation_hz(scene: Scene) -> float:
    """The machine's rotation at full speed; the session's."""
    rng = generator(*session_key(scene, "machine"))
    return log_uniform(rng, scene.disturbances.machine_hz)


def machine_wave(scene: Scene, duration_s: float, grid: Grid) -> Array:
    """The machine's vibration, of unit rms at full speed and zero where it stands, ``[K, B]``.

    In a run the rotation's phase is the integral of a speed that rises and falls linearly, and
    each harmonic's size goes with the square of that speed. Orders that would be folded at the
    converter are left out.

    Raises:
        ValueError: if the rotation itself would be folded.
    """
    wave, hertz = np.zeros(grid.time_s.shape), rotation_hz(scene)
    highest_hz = 0.45 * scene.sample_rate_hz
    if hertz >= highest_hz:
        raise ValueError(
            f"machine_hz must lie below {highest_hz:g} Hz at {scene.sample_rate_hz:g} samples a "
            f"second, got {scene.disturbances.machine_hz}"
        )
    rng = generator(*session_key(scene, "machine harmonics"))
    orders = np.array(ORDERS)
    levels = lognormal(rng, 0.5, len(orders)) / orders
    phases = 2 * np.pi * rng.random(len(orders))
    levels = np.where(orders * hertz < highest_hz, levels, 0.0)
    levels *= np.sqrt(2.0 / np.sum(levels**2))
    for start_s, stop_s in machine_runs(scene, duration_s):
        rows = grid.overlapping(start_s, stop_s)
        since = np.clip(grid.time_s[rows] - start_s, 0.0, stop_s - start_s)
        left = stop_s - start_s - since
        speed = np.clip(np.minimum(since, left) / RAMP_S, 0.0, 1.0)
        up: Array = np.minimum(since, RAMP_S)
        down: Array = np.maximum(RAMP_S - left, 0.0)
        turns = hertz * (since - up + (up**2 - down**2) / (2 * RAMP_S))
        for order, level, phase in zip(ORDERS, levels, phases, strict=True):
            if level > 0:
                wave[rows] += level * speed**2 * np.sin(2 * np.pi * order * turns + phase)
    return wave
