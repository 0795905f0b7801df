"""What a rung of the ladder says of the contact, in one form for all of them.

A rung is a model of how elements stick, let go and slide. Truth, vibration and sensors are made
from what it says here, whichever it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from tactslip_torch.simulation.grid import Grid
from tactslip_torch.simulation.randomness import Array


@dataclass(frozen=True, eq=False)
class Slips:
    """Every slip of every element; arrays over S strokes that slide and E elements.

    One slip a stroke: where an element sticks and slips, from the first letting go to the last
    sticking, the stick phases between included.

    Args:
        start_s: when the element lets go, ``[S, E]``; NaN for elements that do not touch.
        end_s: when it sticks again for good, ``[S, E]``.
    """

    start_s: Array
    end_s: Array


@dataclass(frozen=True, eq=False)
class ElementContact:
    """One touching element's contact on a grid of blocks and on its history.

    Args:
        normal_n: newtons, on ``grid.history``.
        friction_n: newtons, on ``grid.history``; never above static friction.
        slide: slip speed over the speed between hand and object, on the grid: 0 sticking, or
            where nothing drives it; 1 sliding steadily; above 1 where the skin springs back, by
            much where the arm is slow.
        release_v: what a film of unit gain hears of letting go and sticking again, on the grid.
    """

    normal_n: Array
    friction_n: Array
    slide: Array
    release_v: Array


class ContactModel(Protocol):
    """A rung, for one scene."""

    @property
    def slips(self) -> Slips:
        """When each element slides, over all strokes that do."""

    @property
    def integrator(self) -> Mapping[str, str]:
        """What integrated it, by name and release; empty for formulas."""

    def on(self, grid: Grid) -> Callable[[int], ElementContact]:
        """What computes a touching element's contact on a grid."""
