"""Movements: who moves, how far, how fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

Moves = Literal["hand", "object", "both"]


@dataclass(frozen=True)
class Stroke:
    """One straight movement after a pause.

    Args:
        speed_mm_s: steady speed.
        distance_mm: travel from rest to rest.
        pause_s: rest before the stroke.
        moves: ``"hand"``: the arm draws the hand over the resting object, as in the paper.
            ``"object"``: the object is pulled along the resting hand; it slides and no motor runs.
            ``"both"``: the arm carries the hand with the object; motors run and nothing slides.

    Raises:
        ValueError: if speed or distance is not positive, the pause negative, or ``moves`` unknown.
    """

    speed_mm_s: float
    distance_mm: float = 100.0
    pause_s: float = 2.0
    moves: Moves = "hand"

    def __post_init__(self) -> None:
        for name in ("speed_mm_s", "distance_mm"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise ValueError(f"Stroke.{name} must be positive and finite, got {value}")
        if not 0 <= self.pause_s < math.inf:
            raise ValueError(f"Stroke.pause_s must be finite and not negative, got {self.pause_s}")
        if self.moves not in get_args(Moves):
            raise ValueError(
                f"Stroke.moves must be one of {', '.join(get_args(Moves))}, got {self.moves!r}"
            )

    @property
    def slides(self) -> bool:
        """Whether hand and object move against each other."""
        return self.moves != "both"
