"""The kinematic rung: closed-form sticking and sliding, and bursts drawn where skin lets go."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tactslip_torch.simulation.contact import ElementContact
from tactslip_torch.simulation.friction import shear_share, sliding_gate, slips
from tactslip_torch.simulation.grasp import Grasp, recording_key
from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.load import normal_force
from tactslip_torch.simulation.motion import ArmStroke, Motion
from tactslip_torch.simulation.randomness import Array, generator, lognormal
from tactslip_torch.simulation.scene import Scene

SHARES = (1.0, -0.2)
"""Bursts of letting go and of sticking again, over that of letting go (ours)."""


class KinematicContact:
    """A ``ContactModel`` whose every sample is a formula; nothing is integrated.

    Args:
        scene: whose contact.
        grasp: how the hand touches.
        plan: the strokes that slide.
    """

    def __init__(self, scene: Scene, grasp: Grasp, plan: tuple[ArmStroke, ...]) -> None:
        self.slips = slips(grasp, plan)
        self.integrator: Mapping[str, str] = {}
        self._scene, self._grasp, self._plan = scene, grasp, plan

    def on(self, grid: Grid) -> Callable[[int], ElementContact]:
        """What computes a touching element's contact on a grid."""
        motion = Motion(self._plan, grid.history[0])
        return lambda element: self._element(grid, motion, element)

    def _element(self, grid: Grid, motion: Motion, element: int) -> ElementContact:
        """One element's contact; ``motion`` is on the grid's history."""
        scene, grasp = self._scene, self._grasp
        normal_n = normal_force(scene, grasp, element, motion.position_mm, motion.grid.time_s)
        share = shear_share(grasp, self.slips, motion, element, scene.contact.recoil_s)
        slide = np.zeros(grid.time_s.shape)
        for stroke in range(len(self._plan)):
            rows = grid.overlapping(
                self.slips.start_s[stroke, element], self.slips.end_s[stroke, element]
            )
            slide[rows] += sliding_gate(self.slips, element, stroke, grid.time_s[rows])
        friction_n = grasp.surface.mu_s * normal_n * share
        return ElementContact(normal_n, friction_n, slide, self._release(grid, element))

    def _release(self, grid: Grid, element: int) -> Array:
        """The ringing of the skin at each letting go and, weaker, at each sticking again."""
        scene, grasp, volts = self._scene, self._grasp, np.zeros(grid.time_s.shape)
        omega = 2 * np.pi * grasp.resonance_hz[element]
        decay = grasp.damping[element] * omega
        times_s = np.stack([self.slips.start_s[:, element], self.slips.end_s[:, element]], axis=1)
        places = [grid.overlapping(t, t + 12.0 / decay) for t in times_s.ravel().tolist()]
        if all(rows.start == rows.stop for rows in places):
            return volts
        rng = generator(*recording_key(scene, "onset pulse"), element)
        strengths = lognormal(rng, 0.3, times_s.shape)
        full_v = scene.contact.onset_pulse_v * grasp.friction_n[element]
        sizes = (np.array(SHARES) * full_v * strengths).ravel()
        for rows, start_s, size in zip(places, times_s.ravel(), sizes, strict=True):
            if rows.start == rows.stop:
                continue
            since = np.maximum(grid.time_s[rows] - start_s, 0.0)
            volts[rows] += size * (np.exp(-decay * since) * np.sin(omega * since))
        return volts
