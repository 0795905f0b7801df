"""The scenes of ``conf/scene/`` as tests ask for them: by name, for a material, with changes."""

from typing import Any

import numpy as np
import torch
import yaml

from tactslip_torch.commands.entry import conf_dir
from tactslip_torch.simulation import Scene, paper_scenes, simulate, timeline
from tactslip_torch.simulation.blocks import Grid, block_samples_for
from tactslip_torch.simulation.contact import ElementContact, scene_contact
from tactslip_torch.simulation.disturbances import Handled
from tactslip_torch.simulation.grasp import Grasp, draw_grasp
from tactslip_torch.simulation.scene import ArmStroke, Motion

SCENE_FILES = sorted((conf_dir() / "scene").glob("*.yaml"))
NAMES = [path.stem for path in SCENE_FILES]
RATE_HZ = 2000.0

CONTACTS: dict[str, dict[str, Any]] = {
    "kinematic": {"fidelity": "kinematic"},
    "one": {"fidelity": "bristles", "num_bristles": 1},
    "many": {"fidelity": "bristles", "num_bristles": 24},
}
"""The ways to model a contact: closed forms, LuGre's single bristle, a patch."""

BRISTLES = ("one", "many")

FINE = {"num_bits": 32, "rail_v": 100.0}
"""A converter without steps or rails, where recordings are subtracted from each other."""

STILL = {
    "white_noise_mv": 0.0,
    "mains_mv": 0.0,
    "sg_drift_mv": 0.0,
    "pvdf_drift_mv": 0.0,
    "burst_rate_hz": 0.0,
}
"""Nothing but what the contact, the arm and the scene itself say."""


def scene_on(model: str, material: str, cycle: int = 0, **changes: Any) -> Scene:
    """A paper's scene with one of ``CONTACTS``."""
    of_model = {**CONTACTS[model], **changes}
    return paper_scenes(cycles=cycle + 1, materials=(material,), **of_model)[cycle]


def scene_of(name: str, material: str, cycle: int = 0, **changes: Any) -> Scene:
    own = yaml.safe_load((conf_dir() / "scene" / f"{name}.yaml").read_text())
    scenes = paper_scenes(cycles=cycle + 1, materials=(material,), **{**own, **changes})
    return scenes[cycle]


def volts(scene: Scene) -> np.ndarray:
    return simulate(scene, dtype=torch.float64).samples.numpy()


def difference(name: str, material: str, knob: str, cycle: int = 0, **changes: Any) -> np.ndarray:
    """What a parameter of the scene adds to the samples, ``[C, T]``."""
    changes = {**FINE, **changes}
    with_it = scene_of(name, material, cycle, **changes)
    without = scene_of(name, material, cycle, **{**changes, knob: 0.0})
    return volts(with_it) - volts(without)


def rms(samples: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((samples - samples.mean(-1, keepdims=True)) ** 2, -1))


def part(samples: np.ndarray, start_s: float, end_s: float) -> np.ndarray:
    return samples[..., round(start_s * RATE_HZ) : round(end_s * RATE_HZ)]


def is_within(intervals: list[tuple[float, float]], num_samples: int) -> np.ndarray:
    """Which samples lie in one of the intervals, ``[T]``."""
    time_s = np.arange(num_samples) / RATE_HZ
    within = [(time_s >= start_s) & (time_s < end_s) for start_s, end_s in intervals]
    return np.any([np.zeros(num_samples, dtype=bool), *within], axis=0)


def insides(scene: Scene) -> tuple[Grasp, tuple[ArmStroke, ...], Handled]:
    """What is drawn for a recording."""
    grasp = draw_grasp(scene)
    return grasp, scene.arm, Handled(scene, grasp)


def whole_grid(num_samples: int) -> Grid:
    size = block_samples_for(RATE_HZ)
    return Grid(np.arange(-(-num_samples // size)), size, RATE_HZ)


def contacts(scene: Scene) -> tuple[dict[int, ElementContact], np.ndarray]:
    """Every touching element's contact on all samples, flat, and the times of the samples."""
    grasp, grid = draw_grasp(scene), whole_grid(timeline(scene).num_samples)
    model, motion = scene_contact(scene, grasp), Motion(scene.slides, grid.history[0])
    found = {}
    for element in grasp.touching.tolist():
        state = model.element(element, grid, motion)
        normal_n, friction_n = (x[grid.history[2]] for x in (state.normal_n, state.friction_n))
        columns = (normal_n, friction_n, state.slide, state.release_v)
        found[element] = ElementContact(*(column.ravel() for column in columns))
    return found, grid.time_s.ravel()
