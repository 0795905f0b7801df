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

from tactslip_torch.simulation.contact import Slips
from tactslip_torch.simulation.grasp import Grasp
from tactslip_torch.simulation.motion import ArmStroke, Motion
from tactslip_torch.simulation.randomness import Array

RESTICK_SHARE = 0.5
"""Share of the shear lost at letting go that the skin takes up again as the arm stops (ours)."""

SLIDE_RISE_S = 0.004
"""Time constant with which an element that let go reaches the arm's speed (ours)."""


@dataclass(frozen=True, eq=False)
class StickSlips(Slips):
    """``Slips`` with the shear between them, as a share of ``mu_s N``.

    Args:
        shear_before: at the start of each stroke, ``[S, E]``.
        shear_after: as the stroke stops, ``[S, E]``.
    """

    shear_before: Array
    shear_after: Array


def slips(grasp: Grasp, plan: tuple[ArmStroke, ...]) -> StickSlips:
    """When each element lets go and sticks again, over a plan of strokes that slide."""
    shape = (len(plan), len(grasp.load_n))
    start_s, end_s, before = np.empty(shape), np.empty(shape), np.zeros(shape)
    after_slide = _shear_after_slide(grasp)
    restick_mm = (after_slide - grasp.surface.mu_ratio) * grasp.presliding_mm
    for number, stroke in enumerate(plan):
        if number:
            pause_s = stroke.start_s - plan[number - 1].stop_s
            before[number] = after_slide * relaxed(grasp, np.asarray(pause_s))
        travel_mm = (1.0 - before[number]) * grasp.presliding_mm
        start_s[number] = stroke.time_of_travel_s(travel_mm)
        end_s[number] = stroke.time_of_travel_s(stroke.distance_mm - restick_mm)
    lifted = grasp.load_n <= 0
    start_s[:, lifted] = end_s[:, lifted] = np.nan
    return StickSlips(start_s, end_s, before, np.broadcast_to(after_slide, shape))


def _shear_after_slide(grasp: Grasp) -> Array:
    """Shear when the arm has stopped, as a share of ``mu_s N``, ``[E]``."""
    ratio = grasp.surface.mu_ratio
    return np.full(len(grasp.load_n), ratio + RESTICK_SHARE * (1.0 - ratio))


def relaxed(grasp: Grasp, rest_s: Array, element: int | slice = slice(None)) -> Array:
    """Share of the shear left after a rest."""
    decay = -np.expm1(-rest_s / grasp.relaxation_time_s[element])
    return np.asarray(1.0 - grasp.relaxation[element] * decay, dtype=np.float64)


def sliding_gate(slips: Slips, element: int, stroke: int, time_s: Array) -> Array:
    """How much of the arm's speed the contact slides with: 0 sticking, soon 1 sliding."""
    start_s, end_s = slips.start_s[stroke, element], slips.end_s[stroke, element]
    since = np.where((time_s >= start_s) & (time_s < end_s), time_s - start_s, 0.0)
    return -np.expm1(-since / SLIDE_RISE_S)


def shear_share(
    grasp: Grasp, slips: StickSlips, motion: Motion, element: int, recoil_s: float
) -> Array:
    """Friction force over ``mu_s N`` of one element, in ``[0, 1]``; zero before the first stroke.

    Shape:
        - output: ``[K, B]`` on the motion's grid
    """
    time_s = motion.grid.time_s
    share = np.zeros_like(time_s)
    presliding_mm, ratio = grasp.presliding_mm[element], grasp.surface.mu_ratio
    next_starts_s = [*(stroke.start_s for stroke in motion.plan), np.inf][1:]
    for number, (stroke, next_s) in enumerate(zip(motion.plan, next_starts_s, strict=True)):
        rows = motion.grid.overlapping(stroke.start_s, next_s)
        if rows.start == rows.stop:
            continue
        t, travel_mm = time_s[rows], motion.travel_mm[number][rows]
        let_go_s, stick_s = slips.start_s[number, element], slips.end_s[number, element]
        stretching = slips.shear_before[number, element] + travel_mm / presliding_mm
        sliding = ratio + (1.0 - ratio) * np.exp(-np.maximum(t - let_go_s, 0.0) / recoil_s)
        after = slips.shear_after[number, element]
        sticking = after - (stroke.distance_mm - travel_mm) / presliding_mm
        rest = after * relaxed(grasp, np.maximum(t - stroke.stop_s, 0.0), element)
        value = np.where(t > let_go_s, sliding, np.minimum(stretching, 1.0))
        value = np.where(t >= stick_s, sticking, value)
        value = np.where(t >= stroke.stop_s, rest, value)
        np.copyto(share[rows], value, where=(t >= stroke.start_s) & (t <= next_s))
    return share
