"""One implicit stage of every lane: skin and bristles eliminated, the speed solved for.

With ``a`` the stage's length, base values in small letters and the arm's speed ``w``::

    U = u + a (w - V)        Q = (q + a k1 (w - V)) / (1 + a / tau)
    m V = m v + a (k U + Q + c (w - V) - sigma2 V - F(V))

the last is one scalar equation ``A V + B + a F(V) = 0`` a lane, with ``A > 0`` and ``F`` bounded,
so there is always a root and a bracket. PHYSICS.md, stiffness.
"""

from __future__ import annotations

import math
from itertools import count
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.bristles import (
    Patch,
    Pull,
    carried,
    clamped,
    patch_of,
    pull,
)
from tactslip_torch.simulation.dynamics.lanes import Lanes, LaneState

GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Length of a stage in steps."""

PATIENCE = 10
"""Evaluations after which every other step halves the bracket, whatever Newton says.

So the search ends: by then or, at the latest, when no number lies within the bracket, which in
float64 takes 1074 + 1024 + 53 halvings of the widest there is.
"""


class Skin(NamedTuple):
    """What stages of one length share; ``[*]``."""

    stage_s: float
    inertia: Tensor  # A, kg
    relaxed: Tensor  # 1 / (1 + a / tau)
    lanes: Lanes
    patch: Patch


class Stage(NamedTuple):
    """A lane at the end of a stage and how fast it changes there."""

    state: LaneState
    rates: LaneState
    inertia_n: Tensor  # m v'
    slip_m_s: Tensor  # of each bristle, [*, n]


def skin_of(lanes: Lanes, stage_s: float) -> Skin:
    """Constants of stages of one length."""
    a = stage_s
    relaxed = 1.0 / (1.0 + a / lanes.relaxation_time_s)
    springs = lanes.stiffness_n_m + lanes.relaxing_n_m * relaxed
    dampers = lanes.damping_n_s_m + lanes.viscous_n_s_m
    return Skin(a, lanes.mass_kg + a * (a * springs + dampers), relaxed, lanes, patch_of(lanes))


def stage(skin: Skin, base: LaneState, arm: Tensor, normal_n: Tensor, guess: Tensor) -> Stage:
    """The end of a stage of length ``a`` from ``base``; differentiable.

    Args:
        skin: constants of the stage.
        base: values that the stage starts from.
        arm: speed at the stage's time, ``[*]``.
        normal_n: load at that time, ``[*]``.
        guess: speed to start the search from.
    """
    lanes, patch, a = skin.lanes, skin.patch, skin.stage_s
    load = carried(patch, normal_n)
    bristle = clamped(patch, load, base.bristle_m)
    ahead = base.relaxing_n + a * lanes.relaxing_n_m * arm
    drive = (
        lanes.stiffness_n_m * (base.stretch_m + a * arm)
        + skin.relaxed * ahead
        + lanes.damping_n_s_m * arm
    )
    offset = -lanes.mass_kg * base.speed_m_s - a * drive
    at_rest = offset + a * (patch.stiffness * bristle).sum(-1)
    side = torch.where(at_rest > 0, -1.0, 1.0).to(offset.dtype)  # the root is on this side of 0
    turned, offset = side[..., None] * bristle, side * offset
    with torch.no_grad():
        most = 3.0 * a * lanes.mu_s * load.sum(-1)  # more than bristles can pull
        high = (most - offset) / skin.inertia
        speed = _root(skin, load, turned, offset, side * guess, high.clamp(min=0.0))
    if torch.is_grad_enabled():  # one more step of Newton has the derivative of the root
        left, slope, _ = _left(skin, load, turned, offset, speed)
        speed = speed - (left - left.detach()) / slope.detach()
    at = pull(patch, load, turned, speed, a)
    v = side * speed
    stretching = arm - v
    relaxing = skin.relaxed * (base.relaxing_n + a * lanes.relaxing_n_m * stretching)
    accelerating = (v - base.speed_m_s) / a
    back = side[..., None]
    return Stage(
        LaneState(base.stretch_m + a * stretching, v, relaxing, back * at.bristle),
        LaneState(
            stretching,
            accelerating,
            lanes.relaxing_n_m * stretching - relaxing / lanes.relaxation_time_s,
            back * at.rate,
        ),
        lanes.mass_kg * accelerating,
        back * (speed[..., None] - at.rate),
    )


def _left(
    skin: Skin, load: Tensor, base: Tensor, offset: Tensor, speed: Tensor
) -> tuple[Tensor, Tensor, Pull]:
    """What is left of a stage's equation at a speed, and its slope."""
    at = pull(skin.patch, load, base, speed, skin.stage_s)
    left = skin.inertia * speed + offset + skin.stage_s * at.force
    return left, skin.inertia + skin.stage_s * at.slope, at


def _root(
    skin: Skin, load: Tensor, base: Tensor, offset: Tensor, guess: Tensor, high: Tensor
) -> Tensor:
    """A root between 0, where the equation is not positive, and ``high``, where not negative.

    Newton's steps; one that would leave the bracket goes to its lower end the first time (the
    force bends down with the speed, so that Newton climbs from there) and halves it later. A lane
    is done where the equation holds to rounding, a step of Newton within the bracket is so small
    that the next would be rounding, or no number is left within the bracket. It then no longer
    moves, so that its result does not depend on its neighbours.
    """
    eps = torch.finfo(offset.dtype).eps
    low = torch.zeros_like(high)
    speed = torch.minimum(guess.clamp(min=0.0), high)
    done = torch.zeros_like(high, dtype=torch.bool)
    was_low = done
    for number in count():
        left, slope, at = _left(skin, load, base, offset, speed)
        scale = skin.inertia * speed + offset.abs() + skin.stage_s * at.force.abs()
        below = left < 0
        low = torch.where(below, speed, low)
        high = torch.where(below, high, speed)
        wanted = speed - left / slope
        outside = ~((wanted >= low) & (wanted <= high))  # so is NaN
        if number >= PATIENCE and number % 2:
            outside = torch.ones_like(outside)
        half = low + 0.5 * (high - low)
        empty = ~((half > low) & (half < high))  # also where it is NaN
        to_low = outside & ~was_low & (number < PATIENCE)
        wanted = torch.where(outside, torch.where(to_low, low, half), wanted)
        was_low = was_low | to_low
        close = (wanted - speed).abs() <= eps**0.5 * speed
        exact = left.abs() <= 4.0 * eps * scale
        speed = torch.where(done | exact & outside, speed, wanted)
        done = done | exact | close & ~outside | empty
        if bool(done.all()):
            break
    return speed
