"""One element by ``scipy.integrate.solve_ivp``: the equations written again, in plain NumPy.

PHYSICS.md: a mass behind a spring, a damper and a Maxwell arm, carried by LuGre bristles. Nothing
of the package's integrator is in here; the element's constants come as numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


def right_hand_side(
    constants: Mapping[str, float],
    pressure: Array,
    arm: Callable[[float], float],
    load: Callable[[float], float],
) -> Callable[[float, Array], Array]:
    """Rates of stretch, speed, Maxwell force and bristles.

    Args:
        constants: named as the fields of ``Lanes``.
        pressure: share of the load of every bristle.
        arm: speed at a time.
        load: at a time.
    """
    own, num = constants, len(pressure)
    stiffness = own["bristle_stiffness_n_m"] / num
    damping = own["bristle_damping_n_s_m"] / num

    def rates(time_s: float, y: Array) -> Array:
        u, v, q, z = y[0], y[1], y[2], y[3:]
        held = pressure * load(time_s)
        fade = np.exp(-((v / own["stribeck_m_s"]) ** 2))
        limit = held * (own["mu_k"] + (own["mu_s"] - own["mu_k"]) * fade)
        z_rate = v - stiffness * abs(v) * z / limit
        passive = damping / (1.0 + damping * abs(v) / (own["mu_k"] * held))
        friction = float(np.sum(stiffness * z + passive * z_rate)) + own["viscous_n_s_m"] * v
        stretching = arm(time_s) - v
        force = own["stiffness_n_m"] * u + q + own["damping_n_s_m"] * stretching
        relaxing = own["relaxing_n_m"] * stretching - q / own["relaxation_time_s"]
        return np.concatenate([[stretching, (force - friction) / own["mass_kg"], relaxing], z_rate])

    return rates


def radau(
    constants: Mapping[str, float],
    pressure: Array,
    arm: Callable[[float], float],
    load: Callable[[float], float],
    until_s: float,
) -> Callable[[Array], tuple[Array, Array]]:
    """The solution from rest, as a function of times: spring force and slip speed.

    Raises:
        RuntimeError: if Radau gives up.
    """
    rates = right_hand_side(constants, pressure, arm, load)
    found: Any = solve_ivp(
        rates,
        (0.0, until_s),
        np.zeros(3 + len(pressure)),
        method="Radau",
        rtol=1e-9,
        atol=1e-13,
        max_step=1e-3,
        dense_output=True,
    )
    if not found.success:
        raise RuntimeError(f"Radau gave up at {found.t[-1]:g} s: {found.message}")

    def at(time_s: Array) -> tuple[Array, Array]:
        y = found.sol(time_s)
        z_rates = np.array([rates(t, row)[3:] for t, row in zip(time_s, y.T, strict=True)])
        return constants["stiffness_n_m"] * y[0] + y[2], y[1] - z_rates @ pressure

    return at
