"""The compiled engine: lanes as the kernel takes them, and what it gives back."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.compiled import carry_blocks
from tactslip_torch.simulation.dynamics.lanes import GROSS_SHARE, Lanes, LaneState
from tactslip_torch.simulation.dynamics.stage import GAMMA, PATIENCE

Array = np.ndarray[Any, Any]


def carry(
    lanes: Lanes, state: LaneState, arm: Tensor, normal: Tensor, step_s: float, every: int, ago: int
) -> tuple[tuple[Tensor, ...], LaneState]:
    """``eager.carry`` of float64 on the CPU, without gradient."""
    n, shape, a = lanes.num_bristles, lanes.shape, GAMMA * step_s
    relaxed = 1.0 / (1.0 + a / lanes.relaxation_time_s)
    springs = lanes.stiffness_n_m + lanes.relaxing_n_m * relaxed
    dampers = lanes.damping_n_s_m + lanes.viscous_n_s_m
    rows = (
        lanes.mass_kg,
        lanes.stiffness_n_m,
        lanes.relaxing_n_m,
        lanes.relaxation_time_s,
        lanes.damping_n_s_m,
        lanes.mu_s,
        lanes.mu_k,
        lanes.stribeck_m_s,
        lanes.bristle_stiffness_n_m / n,
        lanes.bristle_damping_n_s_m / n,
        relaxed,
        lanes.mass_kg + a * (a * springs + dampers),
    )
    table = torch.stack([row.detach().expand(shape).reshape(-1) for row in rows]).numpy()
    *flat, bristle = (values.detach() for values in vars(state).values())
    states = torch.stack([values.reshape(-1) for values in flat]).numpy()
    bristles = bristle.reshape(-1, n).numpy().copy()
    num_rows = (ago + len(arm) // 2) // every
    out = np.empty((4, num_rows, shape.numel()))
    incipient = np.empty((num_rows, shape.numel()), dtype=np.bool_)
    carry_blocks(
        table,
        states,
        bristles,
        np.ascontiguousarray(lanes.pressure.detach().numpy()),
        _columns(arm),
        _columns(normal),
        step_s,
        GAMMA,
        PATIENCE,
        GROSS_SHARE,
        every,
        ago,
        out,
        incipient,
    )
    kept = [torch.from_numpy(values).reshape(num_rows, *shape) for values in (*out, incipient)]
    u, v, q = torch.from_numpy(states).reshape(3, *shape)
    return tuple(kept), LaneState(u, v, q, torch.from_numpy(bristles).reshape(*shape, n))


def _columns(rows: Tensor) -> Array:
    """What drives the stages, as one column if all lanes are driven alike; ``[2 K, 1 or L]``."""
    sides = zip(rows.stride()[1:], rows.shape[1:], strict=True)
    alike = all(step == 0 or size == 1 for step, size in sides)
    rows = rows.detach().reshape(len(rows), rows.shape[1:].numel())
    return rows[:, : 1 if alike else None].contiguous().numpy()
