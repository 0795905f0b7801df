"""How the hand touches, and what sliding does to the skin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tactslip_torch.simulation.knobs.calibrated import CALIBRATED
from tactslip_torch.simulation.knobs.checks import require_finite

PAPER_FINGER_LOADS = (
    ("little", 0.6),
    ("ring", 0.8),
    ("middle", 0.8),
    ("index", 2.0),
    ("thumb", 0.6),
)
"""Relative normal load of each finger; fingers not named here carry 1."""


@dataclass(frozen=True)
class Contact:
    """How the hand touches, and what sliding does to the skin.

    Args:
        load_n: median normal force of an element on a finger of relative load 1 (prior, ours).
        finger_loads: ``(finger, relative load)`` pairs.
        session_share_spread: spread of the elements' load shares between sessions.
        recording_share_spread: the same between recordings of a session.
        lifted_fraction: probability that an element does not touch in a recording.
        touching: names of channels whose elements may touch; ``None`` for all. An element is a
            segment of a finger with all its channels.
        mu_s: static friction instead of the material's prior, without spread.
        mu_k: kinetic friction instead of the material's prior, without spread. A ``mu_s`` that
            is drawn is raised to it where it falls below.
        friction_spread: spread of ``mu_s`` between sessions (prior, ours; a fifth of it between
            recordings).
        presliding_mm: *calibrated.* Range of the travel that stretches the skin before a fresh
            contact lets go; log-uniform, drawn per recording.
        presliding_spread: spread of that travel between the elements of a recording (prior,
            ours), cut at a factor 1.5.
        relaxation: range of the share of shear that a long pause relaxes, at most 1.
        relaxation_time_s: range of its time constant.
        recoil_s: time constant of the shear's fall from static to kinetic (prior, ours). On the
            kinematic rung alone: the others integrate that fall.
        friction_noise_mv: *calibrated.* Broadband friction noise of every sliding element, rms
            at a PVDF film for mu = 1, 1 N and 40 mm/s.
        friction_noise_exponent: power of speed it grows with.
        friction_noise_low_share: share of its power below 25 Hz.
        texture_scale: factor on every material's texture (prior, ours).
        onset_pulse_v: first swing of the PVDF burst when an element lets go, per newton of
            friction. On the kinematic rung alone: see ``Dynamics.release_v_per_n``.
        runout: relative change of normal load along the travel.
        skin_resonance_hz: range of the skin's resonance, drawn per session.
        skin_damping: range of its damping ratio (prior, ours).

    Raises:
        ValueError: if a knob is negative or not finite, ``mu_k`` exceeds ``mu_s``, or no
            element could touch.
    """

    load_n: float = 1.0
    finger_loads: tuple[tuple[str, float], ...] = PAPER_FINGER_LOADS
    session_share_spread: float = 0.3
    recording_share_spread: float = 0.3
    lifted_fraction: float = 0.1
    touching: tuple[str, ...] | None = None
    mu_s: float | None = None
    mu_k: float | None = None
    friction_spread: float = 0.2
    presliding_mm: tuple[float, float] = CALIBRATED["presliding_mm"]
    presliding_spread: float = 0.2
    relaxation: tuple[float, float] = (0.1, 0.3)
    relaxation_time_s: tuple[float, float] = (0.2, 2.0)
    recoil_s: float = 0.008
    friction_noise_mv: float = CALIBRATED["friction_noise_mv"]
    friction_noise_exponent: float = 0.75
    friction_noise_low_share: float = 0.3
    texture_scale: float = 1.0
    onset_pulse_v: float = 0.5
    runout: float = 0.04
    skin_resonance_hz: tuple[float, float] = (40.0, 100.0)
    skin_damping: tuple[float, float] = (0.1, 0.3)

    def __post_init__(self) -> None:
        require_finite(self)
        if self.mu_s is not None and not self.mu_s > 0:
            raise ValueError(f"Contact.mu_s must be positive, got {self.mu_s}")
        if self.mu_s is not None and self.mu_k is not None and self.mu_k > self.mu_s:
            raise ValueError(
                f"Contact.mu_k must not exceed mu_s, got mu_k={self.mu_k} and mu_s={self.mu_s}"
            )
        if not self.recoil_s > 0:
            raise ValueError(f"Contact.recoil_s must be positive, got {self.recoil_s}")
        for name in ("friction_noise_low_share", "runout"):
            if getattr(self, name) > 1:
                raise ValueError(f"Contact.{name} must be at most 1, got {getattr(self, name)}")
        if self.relaxation[1] > 1:
            raise ValueError(f"Contact.relaxation must be at most 1, got {self.relaxation}")
        self._require_some_contact()

    def _require_some_contact(self) -> None:
        """Refuse a contact without contact."""
        for finger, load in self.finger_loads:
            if not 0 <= load < math.inf:
                raise ValueError(f"Contact.finger_loads of {finger} must be >= 0, got {load}")
        if self.lifted_fraction >= 1:
            raise ValueError(
                "no element in contact: lifted_fraction must be below 1, "
                f"got {self.lifted_fraction}"
            )
        if self.touching is not None and not self.touching:
            raise ValueError("no element in contact: touching names no channel")
        if self.load_n == 0:
            raise ValueError("no element in contact: load_n must be positive, got 0")
