"""The dynamic rungs' own knobs: bristles, skin damping, step."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.simulation.knobs.checks import require_finite


@dataclass(frozen=True)
class Dynamics:
    """Friction and steps of the rungs ``"lugre"`` and ``"patch"``; the kinematic one has none.

    Stiffness, mass and damping of the skin follow from what both rungs share: the presliding
    travel, the resonance and its damping ratio. PHYSICS.md, *Stiffness*.

    Args:
        step_us: of the integration; a whole number of steps makes a sample.
        bristle_share: share of the presliding travel that the bristles of the ``"patch"`` rung
            take, the skin behind them the rest (prior, ours). It sets how long incipient slip is,
            and how gently the patch lets go: a bristle's friction falls with the patch's speed.
        num_bristles: of the ``"patch"`` rung, under a Hertz pressure.
        bristle_stiffness_n_m: of the single bristle of the ``"lugre"`` rung.
        sliding_damping: damping ratio of the skin beyond that with which the kinematic rung rings
            (prior, ours).
        sliding_damping_s_m: more of it, in N s/m per newton of static friction (prior, ours).
            Friction that falls with speed feeds a slide, at 20 mm/s with up to 1.8 of these for a
            smooth material and 8 for a tacky one: between them the one slides smoothly on any skin
            and the other sticks and slips, but for the softest skins of all, and for most of the
            ``"patch"`` rung's.
        bristle_damping: damping ratio of the bristles with the skin's mass (prior, ours).
        viscous_n_s_m: viscous friction, which the kinematic rung does not have.
        release_v_per_n: PVDF volts per newton of the skin's inertia: what a film at the
            surface hears when the skin lets go (prior, ours: so that the bursts of M2 to M5
            stand out of their slides on the ``"lugre"`` rung, REFERENCE.md section 6, *signals*).

    Raises:
        ValueError: if a knob is negative or not finite, a step is longer than 5 ms or zero, or
            there are no bristles.
    """

    step_us: float = 250.0
    bristle_share: float = 0.15
    num_bristles: int = 24
    bristle_stiffness_n_m: float = 1e5
    sliding_damping: float = 0.5
    sliding_damping_s_m: float = 1.8
    bristle_damping: float = 1.0
    viscous_n_s_m: float = 0.0
    release_v_per_n: float = 14.0

    def __post_init__(self) -> None:
        require_finite(self)
        if not 0 < self.step_us <= 5000:
            raise ValueError(f"Dynamics.step_us must lie in (0, 5000], got {self.step_us}")
        if not 0 < self.bristle_share < 1:
            raise ValueError(f"Dynamics.bristle_share must lie in (0, 1), got {self.bristle_share}")
        if not (self.num_bristles == int(self.num_bristles) >= 1):
            raise ValueError(f"Dynamics.num_bristles must be 1 or more, got {self.num_bristles}")
        if not self.bristle_stiffness_n_m > 0:
            raise ValueError(
                f"Dynamics.bristle_stiffness_n_m must be positive, got {self.bristle_stiffness_n_m}"
            )
