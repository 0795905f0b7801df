"""The scheme of ``stage`` and ``stepper`` as a kernel that numba compiles: float64, on the CPU.

Line by line what the eager engine does, lane by lane in place of all at once, so that both take the
same steps of Newton. All that is compiled stands in this file: numba looks for changes here alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
import torch
from torch import Tensor

from tactslip_torch.simulation.dynamics.lanes import Lanes, LaneState
from tactslip_torch.simulation.dynamics.stage import GAMMA, MOST_EVALUATIONS, PATIENCE

Array = np.ndarray[Any, Any]
Constants = tuple[float, float, float, float, float]
Function = TypeVar("Function", bound=Callable[..., Any])

_FADED = 6.5
_NEAR = 1e-4  # Stribeck speeds, below which exp(-(v/vs)^2) is its series to rounding
_EPS = float(np.finfo(np.float64).eps)
_CLOSE = math.sqrt(_EPS)
_FLOOR = float(np.finfo(np.float64).tiny) ** 0.25
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}


def _inner(function: Function) -> Function:
    return cast(Function, numba.njit(forceinline=True, **_OPTIONS)(function))


def _kernel(function: Function) -> Function:
    try:
        return cast(Function, numba.njit(cache=True, **_OPTIONS)(function))
    except RuntimeError:  # no folder that numba may write to
        return cast(Function, numba.njit(**_OPTIONS)(function))


@_inner
def _fading(ratio: float) -> float:
    """``exp(-ratio^2)``."""
    if ratio >= _FADED:
        return 0.0
    square = ratio * ratio
    if ratio < _NEAR:
        return 1.0 - square
    return math.exp(-square)


@_inner
def _left(
    v: float,
    a: float,
    inertia: float,
    offset: float,
    load: Array,
    base: Array,
    constants: Constants,
) -> tuple[float, float, float]:
    """What is left of a stage's equation at a speed, its slope, and the bristles' force."""
    s, d0, mu_s, mu_k, stribeck = constants
    ratio = min(v / stribeck, _FADED)
    fading = (mu_s - mu_k) * _fading(ratio)
    mu = mu_k + fading
    mu_slope = fading * (-2.0 * ratio / stribeck)
    lag = a * s
    force = 0.0
    slope = 0.0
    for i in range(load.shape[0]):
        most = load[i] * mu_k
        g = load[i] * mu
        g_slope = load[i] * mu_slope
        below, damped = g + lag * v, most + d0 * v
        if load[i] == 0.0:
            below, damped = 1.0, 1.0
        both = 1.0 / (below * damped)
        share, damped = damped * both, below * both
        reached = base[i] + a * v
        bristle = g * reached * share
        free = g - s * base[i]
        rate = v * free * share
        damping = d0 * most * damped
        force += s * bristle + damping * rate
        slope += (
            s * (g_slope * reached + g * a - bristle * (g_slope + lag))
            + damping * (free + v * g_slope - rate * (g_slope + lag))
        ) * share - damping * d0 * damped * rate
    return inertia * v + offset + a * force, inertia + a * slope, force


@_inner
def _root(
    guess: float,
    high: float,
    search: tuple[int, int],
    a: float,
    inertia: float,
    offset: float,
    load: Array,
    base: Array,
    constants: Constants,
) -> float:
    """``stage._root`` of one lane."""
    most_evaluations, patience = search
    low = 0.0
    v = min(max(guess, 0.0), high)
    was_low = False
    for number in range(most_evaluations):
        left, slope, force = _left(v, a, inertia, offset, load, base, constants)
        exact = abs(left) <= 4.0 * _EPS * (inertia * v + abs(offset) + a * abs(force))
        if left < 0.0:
            low = v
        else:
            high = v
        wanted = v - left / slope
        outside = not (wanted >= low and wanted <= high)
        if number >= patience and number % 2 == 1:
            outside = True
        if outside:
            if exact:
                return v
            if not was_low and number < patience:
                wanted = low
                was_low = True
            else:
                wanted = low + 0.5 * (high - low)
        elif exact or abs(wanted - v) <= _CLOSE * v:
            return wanted
        v = wanted
    return v


@_kernel
def _carry(
    table: Array,
    pressure: Array,
    u: Array,
    v: Array,
    q: Array,
    z: Array,
    arm: Array,
    normal: Array,
    step_s: float,
    gamma: float,
    search: tuple[int, int],
    every: int,
    ago: int,
    out: Array,
    incipient: Array,
) -> None:
    """Carry lanes through some steps: ``u [L], v [L], q [L], z [L, n]``, in place.

    ``table [L, 11]`` holds mass, k, k1, tau, c, mu_s, mu_k, vs, s and d0 of a bristle, and sigma2;
    ``arm`` and ``normal [2 K, 1 or L]`` two rows a step; ``out [4, t, L]`` takes friction, inertia,
    speed and slip of the steps that are kept, ``incipient [t, L]`` the rest.
    """
    num_bristles = pressure.shape[0]
    load = np.empty(num_bristles)
    base = np.empty(num_bristles)
    now = np.empty(num_bristles)
    rate = np.empty(num_bristles)
    a = gamma * step_s
    rest = (1.0 - gamma) * step_s
    for lane in range(u.shape[0]):
        m, k, k1, tau = table[lane, 0], table[lane, 1], table[lane, 2], table[lane, 3]
        c, mu_s, mu_k, stribeck = table[lane, 4], table[lane, 5], table[lane, 6], table[lane, 7]
        s, d0, sigma2 = table[lane, 8], table[lane, 9], table[lane, 10]
        constants = (s, d0, mu_s, mu_k, stribeck)
        relaxed = 1.0 / (1.0 + a / tau)
        inertia = m + a * (a * (k + k1 * relaxed) + (c + sigma2))
        arm_column = lane if arm.shape[1] > 1 else 0
        normal_column = lane if normal.shape[1] > 1 else 0
        u_now, v_now, q_now = u[lane], v[lane], q[lane]
        for i in range(num_bristles):
            now[i] = z[lane, i]
        for step in range(arm.shape[0] // 2):
            u_base, v_base, q_base = u_now, v_now, q_now
            guess = v_now
            v_start = v_now
            for which in range(2):
                w = arm[2 * step + which, arm_column]
                n = normal[2 * step + which, normal_column]
                n = n if n > _FLOOR else 0.0
                ahead = relaxed * (q_base + a * k1 * w)
                offset = -m * v_base - a * (k * (u_base + a * w) + ahead + c * w)
                held = 0.0
                for i in range(num_bristles):
                    load[i] = n * pressure[i]
                    most = load[i] * (mu_s / s)
                    base[i] = min(max(now[i], -most), most)
                    held += s * base[i]
                side = 1.0
                if offset + a * held > 0.0:
                    side = -1.0
                    offset = -offset
                    for i in range(num_bristles):
                        base[i] = -base[i]
                high = max((3.0 * a * mu_s * n - offset) / inertia, 0.0)
                x = _root(side * guess, high, search, a, inertia, offset, load, base, constants)
                mu = mu_k + (mu_s - mu_k) * _fading(min(x / stribeck, _FADED))
                for i in range(num_bristles):
                    g = load[i] * mu
                    share = 1.0 / (g + a * s * x) if load[i] > 0.0 else 1.0
                    now[i] = side * g * (base[i] + a * x) * share
                    rate[i] = side * x * (g - s * base[i]) * share
                v_now = side * x
                stretching = w - v_now
                accelerating = (v_now - v_base) / a
                u_now = u_base + a * stretching
                q_now = relaxed * (q_base + a * k1 * stretching)
                if which == 0:
                    guess = v_start + (v_now - v_start) / gamma
                    u_base += rest * stretching
                    q_base += rest * (k1 * stretching - q_now / tau)
                    v_base += rest * accelerating
                    for i in range(num_bristles):
                        turned = side * base[i]
                        now[i] = turned + rest * rate[i]
            number = ago + step + 1
            if number % every == 0:
                row = number // every - 1
                slip = 0.0
                some = False
                for i in range(num_bristles):
                    each = v_now - rate[i]
                    slip += pressure[i] * each
                    some = some or abs(each) > 0.5 * abs(w)
                out[0, row, lane] = k * u_now + q_now
                out[1, row, lane] = m * accelerating
                out[2, row, lane] = v_now
                out[3, row, lane] = slip
                incipient[row, lane] = some and w != 0.0
        u[lane], v[lane], q[lane] = u_now, v_now, q_now
        for i in range(num_bristles):
            z[lane, i] = now[i]


def carry(
    lanes: Lanes, state: LaneState, arm: Tensor, normal: Tensor, step_s: float, every: int, ago: int
) -> tuple[tuple[Tensor, ...], LaneState]:
    """``eager.carry`` of float64 on the CPU, without gradient."""
    n, shape = lanes.num_bristles, lanes.shape
    columns = (
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
        lanes.viscous_n_s_m,
    )
    table = torch.stack([column.expand(shape).reshape(-1) for column in columns], -1)
    u, v, q, z = (values.detach().numpy().copy() for values in vars(state).values())
    num_rows = (ago + len(arm) // 2) // every
    out = np.empty((4, num_rows, u.size))
    incipient = np.empty((num_rows, u.size), dtype=np.bool_)
    _carry(
        table.detach().numpy(),
        np.ascontiguousarray(lanes.pressure.detach().numpy()),
        u.reshape(-1),
        v.reshape(-1),
        q.reshape(-1),
        z.reshape(-1, n),
        _columns(arm),
        _columns(normal),
        step_s,
        GAMMA,
        (MOST_EVALUATIONS, PATIENCE),
        every,
        ago,
        out,
        incipient,
    )
    rows = [torch.from_numpy(values).reshape(num_rows, *shape) for values in (*out, incipient)]
    return tuple(rows), LaneState(*map(torch.from_numpy, (u, v, q, z)))


def _columns(rows: Tensor) -> Array:
    """What drives the stages, as one column if all lanes are driven alike; ``[2 K, 1 or L]``."""
    sides = zip(rows.stride()[1:], rows.shape[1:], strict=True)
    alike = all(step == 0 or size == 1 for step, size in sides)
    rows = rows.detach().reshape(len(rows), rows.shape[1:].numel())
    return rows[:, : 1 if alike else None].contiguous().numpy()
