"""What is broken between the sensors and the file: cables, channels, lost samples.

Nothing of it touches the contact: what slides and when is as it was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.events import Stretch
from tactslip_torch.simulation.grasp import recording_key
from tactslip_torch.simulation.randomness import generator, log_uniform
from tactslip_torch.simulation.scene import Scene


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
    rng = generator(*recording_key(scene, "losses"))
    low, high = scene.faults.drop_ms
    lost: list[Stretch] = []
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
