"""The knobs of a scene, in groups. Defaults are the starting values of PHYSICS.md unless marked.

Every ``*_spread`` is the standard deviation of the logarithm of a factor of median 1. Knobs
marked *calibrated* are set once, by ``python -m tactslip_torch.calibrate``, on seen-material test
accuracy and the qualitative facts alone.
"""

from tactslip_torch.simulation.knobs.contact import PAPER_FINGER_LOADS, Contact
from tactslip_torch.simulation.knobs.disturbances import Disturbances
from tactslip_torch.simulation.knobs.dynamics import Dynamics
from tactslip_torch.simulation.knobs.faults import Faults
from tactslip_torch.simulation.knobs.handling import Handling
from tactslip_torch.simulation.knobs.imperfections import Imperfections
from tactslip_torch.simulation.knobs.sensors import Sensors
from tactslip_torch.simulation.knobs.strokes import Stroke

__all__ = [
    "PAPER_FINGER_LOADS",
    "Contact",
    "Disturbances",
    "Dynamics",
    "Faults",
    "Handling",
    "Imperfections",
    "Sensors",
    "Stroke",
]
