"""The equations of skin and bristles in plain NumPy, for SciPy's Radau, and elements to test with.

Written from PHYSICS.md and the model's definition; nothing of the scheme is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.integrate import solve_ivp

from tactslip_torch.simulation._bristles import (
    EngineName,
    Lanes,
    LaneState,
    Trace,
    integrate,
    stage_times_s,
)

Drive = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""From times in s to the arm's speeds and loads."""


@dataclass(frozen=True)
class Element:
    """PHYSICS.md's skin on a smooth surface; SI units."""

    m: float = 5e-3
    k: float = 1e3
    k1: float = 200.0
    tau: float = 0.5
    c: float = 1.0
    mu_s: float = 0.8
    mu_k: float = 0.7
    vs: float = 0.01
    sigma: float = 1e5
    d0: float = (1e5 * 5e-3) ** 0.5
    sigma2: float = 0.0
    pressure: tuple[float, ...] = (1.0,)

    def lanes(self, dtype: torch.dtype = torch.float64, **other: object) -> Lanes:
        """As one lane, or as many as the values in ``other`` have."""
        values = vars(self) | other  # in the order of Lanes
        return Lanes(*(torch.as_tensor(value, dtype=dtype) for value in values.values()))

    def rates(self, v: float, z: np.ndarray, load: float) -> tuple[np.ndarray, float]:
        """How fast bristles bend, and with what force they pull."""
        w = np.array(self.pressure)
        s, d0 = self.sigma / len(w), self.d0 / len(w)
        mu = self.mu_k + (self.mu_s - self.mu_k) * np.exp(-((v / self.vs) ** 2))
        z_rate = v - s * abs(v) * z / (w * load * mu)
        d = d0 / (1.0 + d0 * abs(v) / (w * self.mu_k * load))
        return z_rate, float((s * z + d * z_rate).sum() + self.sigma2 * v)

    def radau(
        self,
        arm: Callable[[float], float],
        load: Callable[[float], float],
        times_s: np.ndarray,
        start: np.ndarray | None = None,
    ) -> dict[str, np.ndarray]:
        """The solution from rest, or from ``start`` (u, v, q, z), at some times."""

        def right(t: float, y: np.ndarray) -> np.ndarray:
            u, v, q = y[:3]
            w = arm(t)
            z_rate, pull = self.rates(v, y[3:], load(t))
            v_rate = (self.k * u + q + self.c * (w - v) - pull) / self.m
            return np.r_[w - v, v_rate, self.k1 * (w - v) - q / self.tau, z_rate]

        start = np.zeros(3 + len(self.pressure)) if start is None else start
        found = solve_ivp(
            right,
            (0.0, times_s[-1]),
            start,
            method="Radau",
            rtol=1e-9,
            atol=1e-13,
            t_eval=times_s,
            max_step=1e-3,
        )
        assert found.success
        u, v, q = found.y[:3]
        return {"u": u, "v": v, "q": q, "z": found.y[3:], "friction": self.k * u + q}


SMOOTH = Element()
TACKY = replace(SMOOTH, mu_s=1.1, mu_k=0.85, vs=0.05)


def ramped(arm_m_s: float) -> Callable[[float], float]:
    """An arm that starts at 2 ms and is at speed at 22 ms."""
    return lambda t: arm_m_s * min(max((t - 0.002) / 0.02, 0.0), 1.0)


def driven(arm: Callable[[float], float], load: Callable[[float], float]) -> Drive:
    """The same drive for lanes ``[L]``, all alike."""

    def drive(times: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        assert times.dtype == torch.float64
        values = [[arm(t), load(t)] for t in times.tolist()]
        columns = torch.tensor(values, dtype=torch.float64)
        return columns[:, :1], columns[:, 1:]

    return drive


def carry(
    lanes: Lanes,
    state: LaneState,
    drive: Drive,
    num_steps: int,
    step_s: float,
    every: int = 1,
    first_step: int = 0,
    engine: EngineName = "auto",
) -> tuple[Trace, LaneState]:
    """``integrate`` under a drive that is a function of time."""
    arm, load = drive(stage_times_s(num_steps, step_s, first_step))
    return integrate(lanes, state, arm, load, step_s, every, engine)
