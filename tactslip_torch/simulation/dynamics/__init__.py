"""The dynamic rungs: skin and bristles of every lane, integrated in time."""

from tactslip_torch.simulation.dynamics.lanes import Lanes, LaneState, hertz_pressure
from tactslip_torch.simulation.dynamics.stepper import Drive, Trace, integrate

__all__ = ["Drive", "LaneState", "Lanes", "Trace", "hertz_pressure", "integrate"]
