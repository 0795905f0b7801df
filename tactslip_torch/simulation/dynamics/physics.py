"""From a grasp to skin and bristles: what the dynamic rungs share with the kinematic one.

Static friction and presliding travel say how stiff skin and bristles are in series, resonance and
damping ratio how heavy and how damped the skin is, its relaxation which part of it is a Maxwell
arm. Part of the damping of sliding goes with friction, as what feeds stick-slip does: a damping
ratio alone is too little for some skins or too much for others. PHYSICS.md, *Chain per sensing
element*. SI units from here on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from tactslip_torch.simulation.dynamics.lanes import Lanes, hertz_pressure
from tactslip_torch.simulation.grasp import Grasp, Surface
from tactslip_torch.simulation.randomness import Array
from tactslip_torch.simulation.scene import Scene

LEAST_STIFFNESS_SHARE = 0.01
"""Of the skin's stiffness, what stays however much relaxes (ours)."""


class Skins(NamedTuple):
    """Skin and bristles of the touching elements of a recording, ``[E]`` each but the last.

    The fields are those of ``Lanes``; the bristles share one pressure.
    """

    mass_kg: Array
    stiffness_n_m: Array
    relaxing_n_m: Array
    relaxation_time_s: Array
    damping_n_s_m: Array
    mu_s: Array
    mu_k: Array
    stribeck_m_s: Array
    bristle_stiffness_n_m: Array
    bristle_damping_n_s_m: Array
    viscous_n_s_m: Array
    num_bristles: int

    def columns(self) -> dict[str, Array]:
        """All but the number of bristles, by name."""
        return {name: getattr(self, name) for name in self._fields[:-1]}

    def only(self, elements: slice) -> Skins:
        """Some of the elements."""
        own = {name: column[elements] for name, column in self.columns().items()}
        return Skins(**own, num_bristles=self.num_bristles)


def skins(scene: Scene, grasp: Grasp) -> Skins:
    """Skin and bristles of every touching element.

    ``mu_s N0`` over the presliding travel is the stiffness of skin and bristles in series. The
    bristles of the ``"patch"`` rung take ``bristle_share`` of the travel, the single one of the
    ``"lugre"`` rung what its stiffness leaves it, at most as much.
    """
    knobs, down, surface = scene.dynamics, grasp.touching, grasp.surface
    static_n, presliding_m = grasp.friction_n[down], 1e-3 * grasp.presliding_mm[down]
    series_n_m = static_n / presliding_m
    if scene.fidelity == "patch":
        share, num_bristles = np.full(len(down), knobs.bristle_share), knobs.num_bristles
    else:
        share = np.minimum(series_n_m / knobs.bristle_stiffness_n_m, knobs.bristle_share)
        num_bristles = 1
    bristles, skin = series_n_m / share, series_n_m / (1.0 - share)
    omega = 2 * np.pi * grasp.resonance_hz[down]
    mass = skin / omega**2
    relaxing = np.minimum(grasp.relaxation[down], 1.0 - LEAST_STIFFNESS_SHARE)
    same = np.ones(len(down))
    return Skins(
        mass_kg=mass,
        stiffness_n_m=(1.0 - relaxing) * skin,
        relaxing_n_m=relaxing * skin,
        relaxation_time_s=grasp.relaxation_time_s[down],
        damping_n_s_m=2.0 * (knobs.sliding_damping + grasp.damping[down]) * mass * omega
        + knobs.sliding_damping_s_m * static_n,
        mu_s=surface.mu_s * same,
        mu_k=_fast_ratio(scene, surface) * surface.mu_s * same,
        stribeck_m_s=1e-3 * surface.material.stribeck_mm_s * same,
        bristle_stiffness_n_m=bristles,
        bristle_damping_n_s_m=2.0 * knobs.bristle_damping * np.sqrt(bristles * mass),
        viscous_n_s_m=knobs.viscous_n_s_m * same,
        num_bristles=num_bristles,
    )


def _fast_ratio(scene: Scene, surface: Surface) -> float:
    """Kinetic over static friction far above the Stribeck speed."""
    fast, (low, high) = surface.material.fast_ratio, surface.material.mu_ratio
    if fast is None or scene.contact.mu_k is not None:
        return surface.mu_ratio
    return float(np.interp(surface.mu_ratio, (low, high), fast))


def lanes_of(each: list[Skins], dtype: torch.dtype, device: torch.device) -> Lanes:
    """Lanes of several recordings, one after the other; they have equally many bristles."""
    columns = [skin.columns() for skin in each]
    values = {
        name: torch.from_numpy(np.concatenate([own[name] for own in columns])).to(device, dtype)
        for name in columns[0]
    }
    pressure = hertz_pressure(each[0].num_bristles, dtype=torch.float64)
    return Lanes(**values, pressure=pressure.to(device, dtype))
