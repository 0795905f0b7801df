"""SDIRK2 in torch: two implicit stages a step, all lanes at once, on any device, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.lanes import GROSS_SHARE, Lanes, LaneState
from tactslip_torch.simulation.dynamics.stage import GAMMA, Stage, skin_of, stage


def carry(
    lanes: Lanes, state: LaneState, arm: Tensor, normal: Tensor, step_s: float, every: int, ago: int
) -> tuple[tuple[Tensor, ...], LaneState]:
    """Carry lanes through some steps.

    Args:
        lanes: skin and friction.
        state: before the first step.
        arm: speeds at the stages' times, two rows a step.
        normal: loads at these times.
        step_s: length of a step.
        every: of how many steps the last is kept.
        ago: how many steps ago one was kept.

    Returns:
        The columns of ``Trace`` for the steps kept, and the last state.

    Shape:
        - arm, normal: ``[2 K, *]``
        - output: ``[t, *]`` each
    """
    skin, rows = skin_of(lanes, GAMMA * step_s), []
    for number in range(len(arm) // 2):
        first = stage(skin, state, arm[2 * number], normal[2 * number], state.speed_m_s)
        start = state.speed_m_s
        last = stage(
            skin,
            _ahead(first, (1.0 - 2.0 * GAMMA) * step_s),
            arm[2 * number + 1],
            normal[2 * number + 1],
            start + (first.state.speed_m_s - start) / GAMMA,
        )
        state = last.state
        if (ago + number + 1) % every == 0:
            rows.append(_row(lanes, last, arm[2 * number + 1]))
    if not rows:
        nothing = lanes.pressure.new_empty((0, *lanes.shape))
        return (nothing, nothing, nothing, nothing, nothing.bool()), state
    return tuple(torch.stack(column) for column in zip(*rows, strict=True)), state


def _ahead(first: Stage, time_s: float) -> LaneState:
    """What the second stage starts from: the step's start and ``1 - gamma`` of the first's rates.

    Counted from the first stage's end, which is ``gamma`` of them ahead already and knows the load.
    """
    end, rates = first.state, first.rates
    return LaneState(
        end.stretch_m + time_s * rates.stretch_m,
        end.speed_m_s + time_s * rates.speed_m_s,
        end.relaxing_n + time_s * rates.relaxing_n,
        end.bristle_m + time_s * rates.bristle_m,
    )


def _row(lanes: Lanes, last: Stage, arm: Tensor) -> tuple[Tensor, ...]:
    state, slips = last.state, last.slip_m_s
    return (
        lanes.stiffness_n_m * state.stretch_m + state.relaxing_n,
        last.inertia_n,
        state.speed_m_s,
        (slips * lanes.pressure).sum(-1),
        (slips.abs() > GROSS_SHARE * arm.abs()[..., None]).any(-1) & (arm != 0),
    )
