"""The scenes of ``conf/scene/`` as tests ask for them: by name, for a material, with changes."""

from typing import Any

import numpy as np
import torch
import yaml

from tactslip_torch.commands.configuration import conf_dir
from tactslip_torch.simulation import Scene, paper_scenes, simulate, timeline
from tactslip_torch.simulation._blocks import Grid
from tactslip_torch.simulation._contact import ElementContact, draw_grasp, scene_contact
from tactslip_torch.simulation.scene import Motion

SCENE_FILES = sorted((conf_dir() / "scene").glob("*.yaml"))
NAMES = [path.stem for path in SCENE_FILES]
RATE_HZ = 2000.0

CONTACTS: dict[str, dict[str, Any]] = {
    "kinematic": {"fidelity": "kinematic"},
    "one": {"fidelity": "bristles", "num_bristles": 1},
    "many": {"fidelity": "bristles", "num_bristles": 24},
}
"""The contact models: closed forms, LuGre's single bristle, a patch."""

FINE = {"num_bits": 32, "rail_v": 100.0}
"""A converter without steps or rails, where recordings are subtracted from each other."""

CALM = {"mains_mv": 0.0, "sg_drift_mv": 0.0, "pvdf_drift_mv": 0.0, "burst_rate_hz": 0.0}
"""Nothing but white noise and what the contact, the arm and the scene itself say."""


def scene_of(name: str, material: str, cycle: int = 0, **changes: Any) -> Scene:
    own = yaml.safe_load((conf_dir() / "scene" / f"{name}.yaml").read_text())
    return paper_scenes(cycles=cycle + 1, materials=(material,), **{**own, **changes})[cycle]


def scene_on(model: str, material: str, cycle: int = 0, **changes: Any) -> Scene:
    """A paper's scene with one of ``CONTACTS``."""
    return scene_of("paper", material, cycle, **{**CONTACTS[model], **changes})


def volts(scene: Scene, **asked: Any) -> np.ndarray:
    return simulate(scene, dtype=torch.float64, **asked).samples.numpy()


def added(name: str, material: str, key: str, cycle: int = 0, **changes: Any) -> np.ndarray:
    """What a parameter of the scene adds to the samples, ``[C, T]``."""
    changes = {**FINE, **changes}
    without = scene_of(name, material, cycle, **{**changes, key: 0.0})
    return volts(scene_of(name, material, cycle, **changes)) - volts(without)


def rms(samples: np.ndarray) -> np.ndarray:
    return samples.std(-1)


def part(samples: np.ndarray, start_s: float, end_s: float) -> np.ndarray:
    return samples[..., round(start_s * RATE_HZ) : round(end_s * RATE_HZ)]


def is_within(intervals: Any, num_samples: int) -> np.ndarray:
    """Which samples lie in one of the intervals, ``[T]``."""
    time_s = np.arange(num_samples) / RATE_HZ
    within = [(time_s >= start_s) & (time_s < end_s) for start_s, end_s in intervals]
    return np.any([np.zeros(num_samples, dtype=bool), *within], axis=0)


def whole_grid(num_samples: int) -> Grid:
    size = Grid(np.zeros(0, np.int64), RATE_HZ).block_samples
    return Grid(np.arange(-(-num_samples // size)), RATE_HZ)


def contacts(scene: Scene) -> tuple[dict[int, ElementContact], np.ndarray]:
    """Every touching element's contact on all samples, flat, and the times of the samples."""
    grasp, grid = draw_grasp(scene), whole_grid(timeline(scene).num_samples)
    model, motion = scene_contact(scene, grasp), Motion(scene.slides, grid.history[0])
    states = {}
    for element in grasp.touching.tolist():
        state = model.element(element, grid, motion)
        normal_n, friction_n = (x[grid.history[2]] for x in (state.normal_n, state.friction_n))
        columns = (normal_n, friction_n, state.slide, state.release_v)
        states[element] = ElementContact(*(column.ravel() for column in columns))
    return states, grid.time_s.ravel()
