"""The ladder of fidelity: which rung models the contact of a scene."""

from __future__ import annotations

from collections.abc import Callable

from tactslip_torch.simulation.contact import ContactModel
from tactslip_torch.simulation.dynamics.contact import DynamicContact
from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.kinematic import KinematicContact
from tactslip_torch.simulation.motion import ArmStroke
from tactslip_torch.simulation.scene import Scene

_RUNGS: dict[str, Callable[[Scene, Grasp, tuple[ArmStroke, ...]], ContactModel]] = {
    "kinematic": KinematicContact,
    "lugre": DynamicContact,
    "patch": DynamicContact,
}
"""What models each of ``FIDELITIES``."""


def scene_contact(scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> ContactModel:
    """The contact of a scene on its rung; where nothing slides all rungs are one, and free.

    Args:
        scene: says which rung.
        grasp: how the hand touches.
        plan: all strokes; those that do not slide do not matter here.
    """
    sliding = tuple(stroke for stroke in plan if stroke.slides)
    return _RUNGS[scene.fidelity](scene, grasp, sliding)
