"""Lanes carried through time by SDIRK2, two implicit stages a step (PHYSICS.md, stiffness).

The second stage ends at the step's end, so what a trace holds obeys the balance of forces to
rounding. Order 2 and L-stable: Alexander (1977), SIAM J. Numer. Anal. 14(6), 1006-1021.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.lanes import Lanes, LaneState
from tactslip_torch.simulation.dynamics.stage import Stage, skin_of, stage

GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
"""Length of a stage in steps."""

Drive = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From times ``[n]`` in s, float64, to arm's speeds in m/s and loads in N.

Both broadcast to ``[n, *]`` with the lanes' shape ``*``.
"""

_DRIVEN_AT_ONCE = 1 << 16  # numbers that a drive is asked for in one go


@dataclass(frozen=True, eq=False)
class Trace:
    """Lanes at every so many steps; all ``[T, *]``.

    Args:
        friction_n: what the skin's springs transmit, ``k u + q``.
        inertia_n: mass times acceleration of the patch.
        speed_m_s: of the patch over the surface.
        slip_m_s: that speed less the bristles' rates, each by its share of the load. More than
            half of the arm's speed is gross sliding.
        incipient: whether a bristle slips at more than half of the speed of an arm that moves.
    """

    friction_n: Tensor
    inertia_n: Tensor
    speed_m_s: Tensor
    slip_m_s: Tensor
    incipient: Tensor


def integrate(
    lanes: Lanes,
    state: LaneState,
    drive: Drive,
    num_steps: int,
    step_s: float,
    every: int = 1,
    start_s: float = 0.0,
) -> tuple[Trace, LaneState]:
    """Carry lanes through time under a drive.

    Memory goes with the trace alone: the drive is asked for some steps at a time. To do with less,
    integrate piece by piece, each from the state that the one before it gave back.

    Args:
        state: where the lanes are at ``start_s``.
        drive: the arm's speed over the surface and the load, at the times of the stages.
        num_steps: how many steps, a multiple of ``every``.
        step_s: their length; 125 to 250 us are accurate, any is stable.
        every: of how many steps the last is kept.

    Returns:
        The trace, its entry ``i`` at ``start_s + (i + 1) every step_s``, and the last state.

    Shape:
        - output: ``[num_steps / every, *]``, in the lanes' kind of number and on their device

    Raises:
        ValueError: for a number of steps that is not a multiple of ``every``, a step that is not
            positive, or shapes of ``state`` or ``drive`` that do not fit the lanes.
    """
    _check(lanes, state, num_steps, step_s, every)
    skin, rows = skin_of(lanes, GAMMA * step_s), []
    arm = normal = torch.empty(0)
    at_once = max(1, _DRIVEN_AT_ONCE // (2 * max(1, lanes.shape.numel())))
    for number in range(num_steps):
        place = number % at_once
        if place == 0:
            steps = range(number, min(number + at_once, num_steps))
            arm, normal = driven(lanes, drive, steps, step_s, start_s)
        first = stage(skin, state, arm[2 * place], normal[2 * place], state.speed_m_s)
        last = stage(
            skin,
            _ahead(state, first.rates, (1.0 - GAMMA) * step_s),
            arm[2 * place + 1],
            normal[2 * place + 1],
            state.speed_m_s + (first.state.speed_m_s - state.speed_m_s) / GAMMA,
        )
        state = last.state
        if (number + 1) % every == 0:
            rows.append(_row(lanes, last, arm[2 * place + 1]))
    if not rows:
        nothing = lanes.pressure.new_empty((0, *lanes.shape))
        return Trace(*[nothing] * 4, nothing.bool()), state
    return Trace(*(torch.stack(column) for column in zip(*rows, strict=True))), state


def driven(
    lanes: Lanes, drive: Drive, steps: range, step_s: float, start_s: float
) -> tuple[Tensor, Tensor]:
    """What drives the stages of some steps, two rows a step: ``[2 n, *]`` both."""
    numbers = torch.arange(
        steps.start, steps.stop, dtype=torch.float64, device=lanes.pressure.device
    )
    ends = torch.stack((numbers + GAMMA, numbers + 1.0), -1).flatten()
    arm, normal = drive(start_s + ends * step_s)
    shape = (len(ends), *lanes.shape)
    try:
        return arm.to(lanes.pressure).expand(shape), normal.to(lanes.pressure).expand(shape)
    except RuntimeError:
        raise ValueError(
            f"expected drive to return tensors that expand to {shape} for {len(ends)} times, got "
            f"{tuple(arm.shape)} and {tuple(normal.shape)}"
        ) from None


def _ahead(state: LaneState, rates: LaneState, time_s: float) -> LaneState:
    return LaneState(
        state.stretch_m + time_s * rates.stretch_m,
        state.speed_m_s + time_s * rates.speed_m_s,
        state.relaxing_n + time_s * rates.relaxing_n,
        state.bristle_m + time_s * rates.bristle_m,
    )


def _row(lanes: Lanes, last: Stage, arm: Tensor) -> tuple[Tensor, ...]:
    state = last.state
    slips = last.slip_m_s
    moving = (slips.abs() > 0.5 * arm.abs()[..., None]).any(-1) & (arm != 0)
    return (
        lanes.stiffness_n_m * state.stretch_m + state.relaxing_n,
        last.inertia_n,
        state.speed_m_s,
        (slips * lanes.pressure).sum(-1),
        moving,
    )


def _check(lanes: Lanes, state: LaneState, num_steps: int, step_s: float, every: int) -> None:
    if every < 1 or num_steps < 0 or num_steps % every:
        raise ValueError(
            f"expected num_steps as a multiple of every, got {num_steps} and {every}; pieces of "
            "whole multiples leave no step out"
        )
    if not 0 < step_s < math.inf:
        raise ValueError(f"expected step_s positive and finite, got {step_s:g}")
    shape = lanes.shape
    wanted = (shape, shape, shape, (*shape, lanes.num_bristles))
    came = [values.shape for values in vars(state).values()]
    if tuple(map(tuple, came)) != tuple(map(tuple, wanted)):
        raise ValueError(
            f"expected a state of lanes {tuple(shape)} with {lanes.num_bristles} bristles, got "
            f"{', '.join(str(tuple(c)) for c in came)}"
        )
