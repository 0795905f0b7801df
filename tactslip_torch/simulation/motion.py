"""The arm: rest, accelerate, run, decelerate, stroke after stroke without return.

First link of the chain in PHYSICS.md. Times in seconds from the start of the recording,
positions in millimetres from where the arm was then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.knobs import Stroke
from tactslip_torch.simulation.knobs.strokes import Moves
from tactslip_torch.simulation.randomness import Array


@dataclass(frozen=True)
class ArmStroke:
    """One stroke as the arm runs it: a trapezoid of speed, or a triangle if it is short.

    Args:
        start_s: when the arm begins to move.
        origin_mm: how far the hand has slid before.
        acceleration_mm_s2: of both ramps.
        peak_mm_s: highest speed, the steady one unless the stroke is short.
        ramp_s: duration of each ramp.
        stop_s: when the arm is at rest again.
        distance_mm: travel.
        moves: who does: see ``Stroke``.
    """

    start_s: float
    origin_mm: float
    acceleration_mm_s2: float
    peak_mm_s: float
    ramp_s: float
    stop_s: float
    distance_mm: float
    moves: Moves = "hand"

    @property
    def slides(self) -> bool:
        """Whether hand and object move against each other."""
        return self.moves != "both"

    @property
    def drives(self) -> bool:
        """Whether the arm moves."""
        return self.moves != "object"

    def travel_mm(self, time_s: Array) -> Array:
        """Distance from the stroke's origin, clamped before and after the stroke."""
        t = np.clip(time_s - self.start_s, 0.0, self.stop_s - self.start_s)
        up: Array = np.minimum(t, self.ramp_s)
        down: Array = np.maximum(t - (self.stop_s - self.start_s - self.ramp_s), 0.0)
        half = 0.5 * self.acceleration_mm_s2
        return half * up * up + self.peak_mm_s * (t - up) - half * down * down

    def speed_mm_s(self, time_s: Array) -> Array:
        """Speed; zero outside the stroke."""
        ramp = np.minimum(time_s - self.start_s, self.stop_s - time_s)
        return np.clip(self.acceleration_mm_s2 * ramp, 0.0, self.peak_mm_s)

    def time_of_travel_s(self, travel_mm: Array) -> Array:
        """When the arm has come so far; the inverse of ``travel_mm`` within the stroke."""
        ramp_mm = 0.5 * self.acceleration_mm_s2 * self.ramp_s**2
        early = np.sqrt(2 * np.minimum(travel_mm, ramp_mm) / self.acceleration_mm_s2)
        left_mm = np.clip(self.distance_mm - travel_mm, 0.0, ramp_mm)
        late = self.stop_s - np.sqrt(2 * left_mm / self.acceleration_mm_s2)
        middle = self.start_s + self.ramp_s + (travel_mm - ramp_mm) / self.peak_mm_s
        time = np.where(travel_mm <= ramp_mm, self.start_s + early, middle)
        return np.where(self.distance_mm - travel_mm < ramp_mm, late, time)


def arm_strokes(strokes: tuple[Stroke, ...], acceleration_m_s2: float) -> tuple[ArmStroke, ...]:
    """The strokes as the arm runs them, one after the other.

    A stroke at speed v over the distance d lasts ``d/v + v/a``, so the paper's nominal onsets of
    2, 9 and 13.5 s become arm starts at 2, 9.04 and 13.62 s.
    """
    plan, now_s, here_mm = [], 0.0, 0.0
    a = 1000.0 * acceleration_m_s2
    for stroke in strokes:
        peak = min(stroke.speed_mm_s, math.sqrt(a * stroke.distance_mm))
        start_s = now_s + stroke.pause_s
        now_s = start_s + stroke.distance_mm / peak + peak / a
        plan.append(
            ArmStroke(start_s, here_mm, a, peak, peak / a, now_s, stroke.distance_mm, stroke.moves)
        )
        here_mm += stroke.distance_mm if stroke.slides else 0.0
    return tuple(plan)


def last_stop_s(plan: tuple[ArmStroke, ...]) -> float:
    """When the last stroke is over; 0 if there is none."""
    return plan[-1].stop_s if plan else 0.0


class Motion:
    """A motion on a grid, computed once for all elements.

    Args:
        plan: the strokes that count: those that slide for the contact's motion, those that the
            arm drives for its own.
        grid: where.

    Attributes:
        travel_mm: of every stroke from its own origin, ``[K, B]`` each.
        position_mm: over all strokes, ``[K, B]``.
    """

    def __init__(self, plan: tuple[ArmStroke, ...], grid: Grid) -> None:
        self.plan, self.grid = plan, grid
        self.travel_mm = tuple(stroke.travel_mm(grid.time_s) for stroke in plan)
        self.position_mm: Array = sum(self.travel_mm, np.zeros(grid.time_s.shape))

    @cached_property
    def speed_mm_s(self) -> Array:
        """Speed over all strokes, ``[K, B]``."""
        speeds = (stroke.speed_mm_s(self.grid.time_s) for stroke in self.plan)
        return sum(speeds, np.zeros(self.grid.time_s.shape))
