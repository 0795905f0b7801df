"""The door of the dynamic rung: lanes carried through time under a drive, by either engine.

SDIRK2 (PHYSICS.md, stiffness): order 2, L-stable, and its second stage ends at the step's end, so
that what a trace holds obeys the balance of forces to rounding. Alexander (1977), SIAM J. Numer.
Anal. 14(6), 1006-1021.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Literal, cast, get_args

import torch
from torch import Tensor

from tactslip_torch.engines import usable_engine
from tactslip_torch.simulation.dynamics import eager
from tactslip_torch.simulation.dynamics.lanes import Lanes, LaneState
from tactslip_torch.simulation.dynamics.stage import GAMMA

EngineName = Literal["auto", "compiled", "eager"]

Drive = Callable[[Tensor], tuple[Tensor, Tensor]]
"""From times ``[n]`` in s, float64, to arm's speeds in m/s and loads in N.

Both broadcast to ``[n, *]`` with the lanes' shape ``*``.
"""

_DRIVEN_AT_ONCE = 1 << 16  # numbers that a drive is asked for in one go; they fit a cache


@dataclass(frozen=True, eq=False)
class Trace:
    """Lanes at every so many steps; all ``[T, *]``.

    Args:
        friction_n: what the skin's springs transmit, ``k u + q``.
        inertia_n: mass times acceleration of the patch.
        speed_m_s: of the patch over the surface.
        slip_m_s: that speed less the bristles' rates, each by its share of the load. More than
            half of the arm's speed is gross sliding.
        incipient: whether a bristle slips at more than half of the speed of an arm that moves; so
            does any without load, which the patch drags along.
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
    engine: EngineName = "auto",
) -> tuple[Trace, LaneState]:
    """Carry lanes through time under a drive.

    Memory goes with the trace alone: the drive is asked for some steps at a time. To do with less,
    integrate piece by piece, each from the state that the one before it gave back.

    Args:
        lanes: skin and friction.
        state: where the lanes are at ``start_s``.
        drive: the arm's speed over the surface and the load, at the times of the stages.
        num_steps: how many steps, a multiple of ``every``.
        step_s: their length; 125 to 250 us are accurate, any is stable.
        every: of how many steps the last is kept.
        start_s: time at which the first step starts.
        engine: ``"compiled"`` is for float64 on the CPU and has no gradient; ``"auto"`` takes it
            where it can, else ``"eager"``. They agree to rounding.

    Returns:
        The trace, its entry ``i`` at ``start_s + (i + 1) every step_s``, and the last state.

    Shape:
        - output: ``[num_steps / every, *]``, in the lanes' kind of number and on their device

    Raises:
        ValueError: for a number of steps that is not a multiple of ``every``, a step that is not
            positive, shapes of ``state`` or ``drive`` that do not fit the lanes, an unknown engine,
            or one that cannot do this.
    """
    _check(lanes, state, num_steps, step_s, every)
    chosen = _resolved(engine)
    parts: list[tuple[Tensor, ...]] = []
    at_once = max(1, _DRIVEN_AT_ONCE // (2 * max(1, lanes.shape.numel())))
    for done in range(0, num_steps, at_once):
        steps = range(done, min(done + at_once, num_steps))
        arm, normal = _driven(lanes, drive, steps, step_s, start_s)
        if chosen == "compiled" and (lack := _lack(lanes, state, arm, normal)):
            if engine == "compiled":
                raise ValueError(f'engine "compiled" {lack}; use engine "eager"')
            chosen = "eager"
        if chosen == "compiled":
            from tactslip_torch.simulation.dynamics import packing  # numba takes a second

            part, state = packing.carry(lanes, state, arm, normal, step_s, every, done % every)
        else:
            part, state = eager.carry(lanes, state, arm, normal, step_s, every, done % every)
        parts.append(part)
    if not parts:
        nothing = lanes.pressure.new_empty((0, *lanes.shape))
        return Trace(nothing, nothing, nothing, nothing, nothing.bool()), state
    friction, inertia, speed, slip, incipient = map(torch.cat, zip(*parts, strict=True))
    return Trace(friction, inertia, speed, slip, incipient), state


def integrator(
    engine: EngineName = "auto",
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> dict[str, str]:
    """What carries lanes of a kind here without gradient: engines and their releases round apart.

    Raises:
        ValueError: for an unknown engine, or one that cannot be used here.

    Example:
        >>> integrator("eager")["engine"]
        'eager'
    """
    kind = torch.device(device).type
    chosen = _resolved(engine)
    if (dtype, kind) != (torch.float64, "cpu"):
        chosen = "eager"
    runs_on = "numba" if chosen == "compiled" else "torch"
    return {
        "engine": chosen,
        f"{runs_on}_version": version(runs_on),
        "dtype": str(dtype).removeprefix("torch."),
        "device": kind,
    }


def _driven(
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


def _lack(lanes: Lanes, state: LaneState, arm: Tensor, normal: Tensor) -> str:
    """Why kernels cannot do this; empty if they can."""
    if lanes.pressure.dtype != torch.float64 or lanes.pressure.device.type != "cpu":
        return f"needs float64 on the CPU, got {lanes.pressure.dtype} on {lanes.pressure.device}"
    tensors = (*vars(lanes).values(), *vars(state).values(), arm, normal)
    if torch.is_grad_enabled() and any(values.requires_grad for values in tensors):
        return "has no gradient, which is asked for"
    return ""


def _resolved(engine: EngineName) -> EngineName:
    """The engine that a name means on this machine, or one line why it cannot be."""
    known = get_args(EngineName)
    return cast(EngineName, usable_engine(engine, known, _load_kernels, "lanes are carried"))


def _load_kernels() -> None:
    from tactslip_torch.simulation.dynamics import packing  # noqa: F401


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
