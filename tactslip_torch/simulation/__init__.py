"""The simulated hand: scenes in, recordings with exact truth out."""

from tactslip_torch.simulation.batch import simulate_many
from tactslip_torch.simulation.knobs import (
    Contact,
    Disturbances,
    Dynamics,
    Faults,
    Handling,
    Imperfections,
    Sensors,
    Stroke,
)
from tactslip_torch.simulation.materials import (
    MATERIALS,
    SEEN_MATERIALS,
    UNSEEN_MATERIALS,
    Material,
)
from tactslip_torch.simulation.scene import (
    FIDELITIES,
    SIMULATION_VERSION,
    Scene,
    paper_scenes,
)
from tactslip_torch.simulation.simulate import simulate
from tactslip_torch.simulation.timeline import Timeline, timeline

__all__ = [
    "FIDELITIES",
    "MATERIALS",
    "SEEN_MATERIALS",
    "SIMULATION_VERSION",
    "UNSEEN_MATERIALS",
    "Contact",
    "Disturbances",
    "Dynamics",
    "Faults",
    "Handling",
    "Imperfections",
    "Material",
    "Scene",
    "Sensors",
    "Stroke",
    "Timeline",
    "paper_scenes",
    "simulate",
    "simulate_many",
    "timeline",
]
