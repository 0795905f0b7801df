"""Stick, let go, slide, stick again: the quasi-static contact of every element.

While an element sticks, the arm's travel stretches its skin and the friction force grows in
proportion. At ``mu_s N`` it lets go, falls to ``mu_k N`` and slides until, shortly before the arm
stops, the remaining travel is taken up by the skin again. Over the pause the shear relaxes;
the next stroke starts with what is left and needs only the rest of the presliding travel.
PHYSICS.md, friction and skin; the rules are those of a Coulomb slider behind a spring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.motion import ArmStroke
from tactslip_torch.simulation.randomness import Array

RESTICK_SHARE = 0.5
"""Share of the shear lost at letting go that the skin takes up again as the arm stops (ours)."""

SLIDE_RISE_S = 0.004
"""Time constant with which an element that let go reaches the arm's speed (ours)."""


@dataclass(frozen=True, eq=False)
class Slips:
    """Every slip of every element; arrays over S strokes and E elements.

    Args:
        start_s: when the element lets go, ``[S, E]``; NaN for elements that do not touch.
        end_s: when it sticks again, ``[S, E]``.
        shear_before: shear at the start of each stroke, as a share of ``mu_s N``, ``[S, E]``.
        shear_after: shear as the arm stops, ``[S, E]``.
    """

    start_s: Array
    end_s: Array
    shear_before: Array
    shear_after: Array


def slips(grasp: Grasp, plan: tuple[ArmStroke, ...]) -> Slips:
    """When each element lets go and sticks again, stroke after stroke."""
    shape = (len(plan), len(grasp.load_n))
    start_s, end_s, before = np.empty(shape), np.empty(shape), np.zeros(shape)
    after_slide = _shear_after_slide(grasp)
    restick_mm = (after_slide - grasp.surface.mu_ratio) * grasp.presliding_mm
    for number, stroke in enumerate(plan):
        if number:
            pause_s = stroke.start_s - plan[number - 1].stop_s
            before[number] = after_slide * _relaxed(grasp, np.asarray(pause_s))
        travel_mm = (1.0 - before[number]) * grasp.presliding_mm
        start_s[number] = stroke.time_of_travel_s(travel_mm)
        end_s[number] = stroke.time_of_travel_s(stroke.distance_mm - restick_mm)
    lifted = grasp.load_n <= 0
    start_s[:, lifted] = end_s[:, lifted] = np.nan
    return Slips(start_s, end_s, before, np.broadcast_to(after_slide, shape))


def _shear_after_slide(grasp: Grasp) -> Array:
    """Shear when the arm has stopped, as a share of ``mu_s N``, ``[E]``."""
    ratio = grasp.surface.mu_ratio
    return np.full(len(grasp.load_n), ratio + RESTICK_SHARE * (1.0 - ratio))


def _relaxed(grasp: Grasp, rest_s: Array, element: int | slice = slice(None)) -> Array:
    """Share of the shear left after a rest."""
    decay = -np.expm1(-rest_s / grasp.relaxation_time_s[element])
    return np.asarray(1.0 - grasp.relaxation[element] * decay, dtype=np.float64)


def sliding_gate(slips: Slips, element: int, stroke: int, time_s: Array) -> Array:
    """How much of the arm's speed the contact slides with: 0 sticking, soon 1 sliding."""
    start_s, end_s = slips.start_s[stroke, element], slips.end_s[stroke, element]
    since = np.where((time_s >= start_s) & (time_s < end_s), time_s - start_s, 0.0)
    return -np.expm1(-since / SLIDE_RISE_S)


def shear_share(
    grasp: Grasp,
    slips: Slips,
    plan: tuple[ArmStroke, ...],
    element: int,
    grid: Grid,
    recoil_s: float,
) -> Array:
    """Friction force over ``mu_s N`` of one element, in ``[0, 1]``.

    Shape:
        - output: ``[K, B]`` on the grid
    """
    share = np.zeros_like(grid.time_s)
    if not len(grid.blocks):
        return share
    last_s = float(grid.time_s[-1, -1])
    for number, stroke in enumerate(plan):
        next_s = plan[number + 1].start_s if number + 1 < len(plan) else max(last_s, stroke.stop_s)
        rows = grid.overlapping(stroke.start_s, next_s)
        t = grid.time_s[rows]
        stuck = slips.shear_before[number, element] + (
            stroke.travel_mm(t) / grasp.presliding_mm[element]
        )
        since = np.clip(t - slips.start_s[number, element], 0.0, None)
        ratio = grasp.surface.mu_ratio
        sliding = ratio + (1.0 - ratio) * np.exp(-since / recoil_s)
        left_mm = stroke.distance_mm - stroke.travel_mm(t)
        after = slips.shear_after[number, element]
        sticking = after - left_mm / grasp.presliding_mm[element]
        rest = after * _relaxed(grasp, np.clip(t - stroke.stop_s, 0.0, None), element)
        value = np.where(since > 0, sliding, np.minimum(stuck, 1.0))
        value = np.where(t >= slips.end_s[number, element], sticking, value)
        value = np.where(t >= stroke.stop_s, rest, value)
        share[rows] = np.where((t >= stroke.start_s) & (t <= next_s), value, share[rows])
    return share
