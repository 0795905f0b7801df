"""What the hand slides on: the material table of PHYSICS.md as priors.

None of these values was measured on this hand. Each session draws its own friction, roughness
and wavelength from the ranges here; see ``grasp.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Character = Literal["smooth", "textured", "rough", "tacky"]
"""How sliding sounds. ``rough``: sustained vibration. ``tacky``: sustained stick-slip."""


@dataclass(frozen=True)
class Material:
    """A surface, as ranges to draw a session from.

    Args:
        title: the name in words.
        mu_s: static friction coefficient, the centre of its lognormal prior; dimensionless.
        mu_ratio: lowest and highest kinetic over static friction, dimensionless.
        ra_um: lowest and highest roughness Ra; with ``texture_mv`` it sets how strongly the
            material vibrates (a session rougher than the middle of its range vibrates more).
        wavelength_mm: shortest and longest dominant wavelength, or ``None`` without one. For a
            tacky material: travel per stick-slip cycle.
        line_bandwidth: relative spread of the wavelengths around the dominant one.
        line_share: share of the texture's power at the dominant wavelength; the rest is the
            broad ``k^-a`` part.
        texture_mv: rms of the texture's vibration at 40 mm/s and 1 N at a PVDF film (prior, ours).
        character: see ``Character``.
        stribeck_mm_s: speed over which static becomes kinetic friction on the dynamic rungs;
            near the speeds of sliding it makes a material stick and slip (PHYSICS.md).
        fast_ratio: kinetic over static friction far above that speed, on the dynamic rungs, where
            it is not ``mu_ratio``: a tacky material's is the mean over sticking and slipping at
            the speeds of sliding. The range is drawn with ``mu_ratio``, low with low.

    Raises:
        ValueError: if friction is not positive, kinetic exceeds static friction, or a range is
            empty.
    """

    title: str
    mu_s: float
    mu_ratio: tuple[float, float]
    ra_um: tuple[float, float]
    wavelength_mm: tuple[float, float] | None
    line_bandwidth: float
    line_share: float
    texture_mv: float
    character: Character
    stribeck_mm_s: float = 10.0
    fast_ratio: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.mu_s > 0:
            raise ValueError(f"{self.title}: mu_s must be positive, got {self.mu_s}")
        low, high = self.mu_ratio
        if not 0 < low <= high:
            raise ValueError(f"{self.title}: mu_ratio must be 0 < low <= high, got {self.mu_ratio}")
        if high > 1:
            raise ValueError(
                f"{self.title}: mu_k must not exceed mu_s, got a ratio mu_k/mu_s of up to {high}"
            )


def _prior(
    title: str,
    mu_s: float,
    ra_um: tuple[float, float],
    texture_mv: float,
    character: Character = "smooth",
    wavelength_mm: tuple[float, float] | None = None,
    line_bandwidth: float = 0.1,
) -> Material:
    """A row of the table; the kinetic ratio is .75 to .95 for every material."""
    line_share = 0.0 if wavelength_mm is None else (0.5 if character == "tacky" else 0.4)
    return Material(
        title,
        mu_s,
        (0.75, 0.95),
        ra_um,
        wavelength_mm,
        line_bandwidth,
        line_share,
        texture_mv,
        character,
        *((50.0, (0.4, 0.55)) if character == "tacky" else (10.0, None)),
    )


# Friction, Ra and wavelengths: PHYSICS.md's table. Texture levels: rough 150 mV and smooth 10 mV
# (its starting knobs), the materials between by roughness and softness (prior, ours). The tacky
# fast_ratio: with it the force oscillates by about a quarter (prior, ours).
MATERIALS: dict[str, Material] = {
    "M1": _prior("ABS", 0.8, (5.0, 12.0), 150.0, "rough", (0.18, 0.22), 0.05),
    "M2": _prior("aluminium foil", 0.7, (0.15, 0.25), 10.0),
    "M3": _prior("fibreglass aluminium foil", 0.7, (2.5, 3.5), 14.0, "textured", (0.5, 1.5)),
    "M4": _prior("oil paper", 0.5, (3.0, 5.0), 12.0, "textured", (0.05, 0.5), 0.5),
    "M5": _prior("acrylic", 1.0, (0.02, 0.1), 8.0),
    "M6": _prior("PVC tape", 1.1, (1.0, 2.0), 120.0, "tacky", (0.8, 2.0), 0.03),
    "iron": _prior("iron", 0.7, (0.8, 3.0), 12.0),
    "cloth": _prior("duct tape", 0.8, (10.0, 20.0), 60.0, "rough", (0.5, 1.0)),
    "copper": _prior("copper", 0.6, (0.2, 0.8), 10.0),
    "wood": _prior("wood", 0.6, (3.0, 10.0), 25.0, "textured", (0.1, 1.0), 0.3),
}
"""Every known material by the short id used everywhere else."""

SEEN_MATERIALS = ("M1", "M2", "M3", "M4", "M5", "M6")
"""The paper's training materials, in its order."""

UNSEEN_MATERIALS = ("iron", "cloth", "copper", "wood")
"""The paper's held-out materials. Nothing is tuned on them."""
