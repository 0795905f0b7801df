"""The contact of a recording in which nothing slides: the same on every rung, and free."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactslip_torch.simulation.contact import ContactModel, ElementContact, Slips
from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.ladder import contact_model
from tactslip_torch.simulation.load import normal_force
from tactslip_torch.simulation.motion import ArmStroke
from tactslip_torch.simulation.scene import Scene


class RestingContact:
    """A ``ContactModel`` without slips: the grasp's load and no friction.

    Args:
        scene: whose contact.
        grasp: how the hand touches.
    """

    def __init__(self, scene: Scene, grasp: Grasp) -> None:
        none = np.zeros((0, len(grasp.load_n)))
        self.slips = Slips(none, none)
        self._scene, self._grasp = scene, grasp

    def on(self, grid: Grid) -> Callable[[int], ElementContact]:
        """What computes a touching element's contact on a grid."""
        time_s, still = grid.history[0].time_s, np.zeros(grid.time_s.shape)
        unmoved = np.zeros(time_s.shape)

        def element_contact(element: int) -> ElementContact:
            normal_n = normal_force(self._scene, self._grasp, element, unmoved, time_s)
            return ElementContact(normal_n, unmoved, still, still)

        return element_contact


def scene_contact(scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> ContactModel:
    """The contact of a scene: on its rung where a stroke slides, at rest where none does."""
    if any(stroke.slides for stroke in plan):
        return contact_model(scene, grasp, plan)
    return RestingContact(scene, grasp)
