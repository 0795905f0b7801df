"""The normal force of an element: share of the grasp, run-out of the surface, creep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import Scene

RUNOUT_PERIOD_MM = 180.0
"""Travel over which the normal load rises and falls (prior, ours)."""


def normal_force(
    scene: Scene,
    grasp: Grasp,
    element: int | NDArray[np.int64],
    position_mm: Array,
    time_s: Array,
) -> Array:
    """Newtons: the surface's run-out over travel, and creep after the grasp like the shear.

    Shape:
        - position_mm, time_s, output: any one shape; with several elements ``[E]`` the times are
          ``[*, 1]`` and the output is ``[*, E]``
    """
    angle = 2 * np.pi / RUNOUT_PERIOD_MM * position_mm
    runout = scene.contact.runout * np.sin(angle + grasp.runout_phase[element])
    since_grasp_s = np.maximum(time_s, 0.0) + 1.0
    creep = np.exp(-since_grasp_s / (5.0 * grasp.relaxation_time_s[element]))
    normal_n: Array = (
        grasp.load_n[element] * (1.0 + runout) * (1.0 + 0.3 * grasp.relaxation[element] * creep)
    )
    return normal_n
