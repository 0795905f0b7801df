"""The scheme of ``_bristles`` as a kernel that numba compiles: float64, on the CPU.

Lanes are carried in blocks of 16, each with the steps of Newton that the eager engine takes; those
that are done wait for the slowest. What belongs to a block lies in one array, 16 numbers for each
quantity, so that LLVM sees that none overlap and uses vectors; loops over fewer it would unroll
first. A block is always full, so that no lane's bits depend on its place or its neighbours. All
that is compiled stands in this file: numba looks for changes here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

Array = np.ndarray[Any, Any]
Function = TypeVar("Function", bound=Callable[..., Any])

_SIDE = 16  # lanes in a block
_FADED = 6.5
_EPS = float(np.finfo(np.float64).eps)
_CLOSE = _EPS**0.5
_FLOOR = float(np.finfo(np.float64).tiny) ** 0.25
_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"reassoc", "contract", "nsz", "arcp"},
}

# Where the numbers of a quantity start; the first twelve are given, the next three the state.
_M, _K, _K1, _TAU, _C, _MU_S, _MU_K, _VS, _S, _D0, _RELAXED, _INERTIA = range(0, 12 * _SIDE, _SIDE)
_U, _V, _Q, _U0, _V0, _Q0, _START, _RATE_V = range(12 * _SIDE, 20 * _SIDE, _SIDE)
_ARM, _LOAD, _TURN, _OFFSET, _LOW, _HIGH, _X, _TRIED = range(20 * _SIDE, 28 * _SIDE, _SIDE)
_DONE, _MU, _MU_SLOPE, _FORCE, _SLOPE, _END = range(28 * _SIDE, 34 * _SIDE, _SIDE)


def _inner(function: Function) -> Function:
    return cast(Function, numba.njit(forceinline=True, **_OPTIONS)(function))


def _kernel(function: Function) -> Function:
    try:
        return cast(Function, numba.njit(cache=True, **_OPTIONS)(function))
    except RuntimeError:  # no folder that numba may write to
        return cast(Function, numba.njit(**_OPTIONS)(function))


@_inner
def _friction(at: Array) -> None:
    """Friction coefficient and slope at the speeds; ``exp(-r^2)`` as a power, in vectors."""
    for b in range(_SIDE):
        ratio = at[_X + b] / at[_VS + b]
        ratio = ratio if ratio < _FADED else _FADED
        y = ratio * ratio * (-1.0 / 256.0)
        power = 1.0
        for k in range(11, 0, -1):
            power = 1.0 + y / k * power
        for _ in range(8):
            power *= power
        power = power if ratio < _FADED else 0.0
        fading = (at[_MU_S + b] - at[_MU_K + b]) * power
        at[_MU + b] = at[_MU_K + b] + fading
        at[_MU_SLOPE + b] = fading * (-2.0 * ratio / at[_VS + b])
        at[_FORCE + b] = 0.0
        at[_SLOPE + b] = 0.0


@_inner
def _pull(at: Array, bent: Array, weight: float, i: int, a: float) -> None:
    """Add a bristle's force and slope: ``_bristles._Stage.pull``."""
    for b in range(_SIDE):
        x, s, d0, load = at[_X + b], at[_S + b], at[_D0 + b], at[_LOAD + b] * weight
        base, lag = bent[i, b], a * s
        most, g, g_slope = load * at[_MU_K + b], load * at[_MU + b], load * at[_MU_SLOPE + b]
        below = g + lag * x if load > 0.0 else 1.0
        damped = most + d0 * x if load > 0.0 else 1.0
        both = 1.0 / (below * damped)
        share, damped = damped * both, below * both
        reached = base + a * x
        bristle = g * reached * share
        free = g - s * base
        rate = x * free * share
        damping = d0 * most * damped
        at[_FORCE + b] += s * bristle + damping * rate
        at[_SLOPE + b] += (
            s * (g_slope * reached + g * a - bristle * (g_slope + lag))
            + damping * (free + x * g_slope - rate * (g_slope + lag))
        ) * share - damping * d0 * damped * rate


@_inner
def _newton(at: Array, a: float, halve: bool, may_try: bool) -> float:
    """One step for each speed, as in ``_bristles._Stage.root``; how many lanes are not done."""
    still = 0.0
    for b in range(_SIDE):
        x, low, high, done = at[_X + b], at[_LOW + b], at[_HIGH + b], at[_DONE + b]
        offset, force, inertia = at[_OFFSET + b], at[_FORCE + b], at[_INERTIA + b]
        left = inertia * x + offset + a * force
        exact = abs(left) <= 4.0 * _EPS * (inertia * x + abs(offset) + a * abs(force))
        low, high = (x, high) if left < 0.0 else (low, x)
        wanted = x - left / (inertia + a * at[_SLOPE + b])
        inside = (wanted >= low) & (wanted <= high) & (not halve)
        to_low = (not inside) & (not exact) & may_try & (at[_TRIED + b] == 0.0)
        close = exact | (inside & (abs(wanted - x) <= _CLOSE * x))
        half = low + 0.5 * (high - low)
        close |= not ((half > low) & (half < high))  # no number between, or NaN
        other = low if to_low else half
        other = x if exact else other
        wanted = wanted if inside else other
        at[_X + b] = x if done > 0.0 else wanted
        at[_LOW + b] = low
        at[_HIGH + b] = high
        at[_TRIED + b] = 1.0 if to_low else at[_TRIED + b]
        done = 1.0 if close else done
        at[_DONE + b] = done
        still += 1.0 - done
    return still


@_inner
def _begin(at: Array, z: Array, bent: Array, pressure: Array, a: float) -> None:
    """Set up a stage: loads, what bristles start from, the side of the root and its bracket."""
    for b in range(_SIDE):
        ahead = at[_RELAXED + b] * (at[_Q0 + b] + a * at[_K1 + b] * at[_ARM + b])
        pulled = at[_K + b] * (at[_U0 + b] + a * at[_ARM + b]) + ahead
        at[_OFFSET + b] = -at[_M + b] * at[_V0 + b] - a * (pulled + at[_C + b] * at[_ARM + b])
        at[_FORCE + b] = 0.0
        load = at[_LOAD + b]
        at[_LOAD + b] = load if load > _FLOOR else 0.0
    for i in range(pressure.shape[0]):
        for b in range(_SIDE):
            most = at[_LOAD + b] * pressure[i] * (at[_MU_S + b] / at[_S + b])
            base = z[i, b]
            base = base if base > -most else -most
            base = base if base < most else most
            bent[i, b] = base
            at[_FORCE + b] += at[_S + b] * base
    for b in range(_SIDE):
        offset = at[_OFFSET + b]
        turn = -1.0 if offset + a * at[_FORCE + b] > 0.0 else 1.0
        offset *= turn
        high = (3.0 * a * at[_MU_S + b] * at[_LOAD + b] - offset) / at[_INERTIA + b]
        high = high if high > 0.0 else 0.0
        x = turn * at[_X + b]
        x = x if x > 0.0 else 0.0
        at[_X + b] = x if x < high else high
        at[_TURN + b], at[_OFFSET + b], at[_HIGH + b] = turn, offset, high
        at[_LOW + b], at[_TRIED + b], at[_DONE + b] = 0.0, 0.0, 0.0
    for i in range(pressure.shape[0]):
        for b in range(_SIDE):
            bent[i, b] *= at[_TURN + b]


@_inner
def _end(
    at: Array, z: Array, bent: Array, rates: Array, pressure: Array, a: float, rest: float
) -> None:
    """Take the stage's end, and from there ``rest`` of its rates."""
    _friction(at)
    for i in range(pressure.shape[0]):
        for b in range(_SIDE):
            x, s, turn = at[_X + b], at[_S + b], at[_TURN + b]
            load, base = at[_LOAD + b] * pressure[i], bent[i, b]
            g = load * at[_MU + b]
            share = turn / (g + a * s * x if load > 0.0 else 1.0)
            rate = x * (g - s * base) * share
            rates[i, b] = rate
            z[i, b] = g * (base + a * x) * share + rest * rate
    for b in range(_SIDE):
        v = at[_TURN + b] * at[_X + b]
        stretching = at[_ARM + b] - v
        q = at[_RELAXED + b] * (at[_Q0 + b] + a * at[_K1 + b] * stretching)
        rate_v = (v - at[_V0 + b]) / a
        at[_U + b] = at[_U0 + b] + (a + rest) * stretching
        at[_V + b] = v + rest * rate_v
        at[_Q + b] = q + rest * (at[_K1 + b] * stretching - q / at[_TAU + b])
        at[_RATE_V + b] = rate_v


@_kernel
def carry_blocks(
    table: Array,
    states: Array,
    bristles: Array,
    pressure: Array,
    arm: Array,
    normal: Array,
    step_s: float,
    gamma: float,
    patience: int,
    every: int,
    out: Array,
) -> None:
    """Carry lanes through some steps; ``states [3, L]`` and ``bristles [L, n]`` in place.

    ``table [12, L]`` holds mass, k, k1, tau, c, mu_s, mu_k, vs, s and d0 of a bristle,
    ``1 / (1 + a / tau)`` and ``A``; ``arm`` and ``normal [2 K, L]`` have two rows a step;
    ``out [3, t, L]`` takes friction, inertia and slip.
    """
    num_lanes, n = bristles.shape
    at, z = np.zeros(_END), np.empty((n, _SIDE))
    bent, rates = np.empty((n, _SIDE)), np.empty((n, _SIDE))
    a = gamma * step_s
    for first in range(0, num_lanes, _SIDE):
        num = min(_SIDE, num_lanes - first)
        for b in range(_SIDE):  # the last lane fills up the last block
            lane = min(first + b, num_lanes - 1)
            for row in range(12):
                at[row * _SIDE + b] = table[row, lane]
            for row in range(3):
                at[_U + row * _SIDE + b] = states[row, lane]
            for i in range(n):
                z[i, b] = bristles[lane, i]
        for step in range(arm.shape[0] // 2):
            for b in range(_SIDE):
                at[_START + b] = at[_X + b] = at[_V + b]
            for which in range(2):
                for b in range(_SIDE):
                    lane = min(first + b, num_lanes - 1)
                    at[_ARM + b] = arm[2 * step + which, lane]
                    at[_LOAD + b] = normal[2 * step + which, lane]
                for b in range(3 * _SIDE):
                    at[_U0 + b] = at[_U + b]
                _begin(at, z, bent, pressure, a)
                number, still = 0, 1.0
                while still > 0.0:  # it ends: see _bristles._PATIENCE
                    _friction(at)
                    for i in range(n):
                        _pull(at, bent, pressure[i], i, a)
                    late = number >= patience
                    still = _newton(at, a, late and number % 2 == 1, not late)
                    number += 1
                _end(at, z, bent, rates, pressure, a, (1 - which) * (step_s - 2.0 * a))
                for b in range(_SIDE):
                    v = at[_TURN + b] * at[_X + b]
                    at[_X + b] = at[_START + b] + (v - at[_START + b]) / gamma
            number = step + 1
            if number % every == 0:
                for b in range(num):
                    row, lane = number // every - 1, first + b
                    slip = at[_V + b]
                    for i in range(n):
                        slip -= pressure[i] * rates[i, b]
                    out[0, row, lane] = at[_K + b] * at[_U + b] + at[_Q + b]
                    out[1, row, lane] = at[_M + b] * at[_RATE_V + b]
                    out[2, row, lane] = slip
        for b in range(num):
            for row in range(3):
                states[row, first + b] = at[_U + row * _SIDE + b]
            for i in range(n):
                bristles[first + b, i] = z[i, b]
