"""The simulated hand: scenes in, recordings with exact truth out."""

from tactslip_torch.simulation.scene import (
    FIDELITIES,
    MATERIALS,
    SEEN_MATERIALS,
    SIMULATION_VERSION,
    UNSEEN_MATERIALS,
    Contact,
    Disturbances,
    Dynamics,
    Faults,
    Handling,
    Imperfections,
    Material,
    Scene,
    Sensors,
    Stroke,
    paper_scenes,
)
from tactslip_torch.simulation.simulate import Timeline, simulate, simulate_many, timeline

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
