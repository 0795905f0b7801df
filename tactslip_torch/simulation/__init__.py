"""The simulated hand: scenes in, recordings with exact truth out."""

from tactslip_torch.simulation._sensors import HandSignals
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
from tactslip_torch.simulation.simulate import SimulatedRecordings, Timeline, simulate, timeline
from tactslip_torch.simulation.worlds import CONFOUNDERS, WorldRecordings

__all__ = [
    "CONFOUNDERS",
    "FIDELITIES",
    "MATERIALS",
    "SEEN_MATERIALS",
    "SIMULATION_VERSION",
    "UNSEEN_MATERIALS",
    "Contact",
    "Disturbances",
    "Dynamics",
    "Faults",
    "HandSignals",
    "Handling",
    "Imperfections",
    "Material",
    "Scene",
    "Sensors",
    "SimulatedRecordings",
    "Stroke",
    "Timeline",
    "WorldRecordings",
    "paper_scenes",
    "simulate",
    "timeline",
]
