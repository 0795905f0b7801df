"""The search that tuning starts from and is held against: a grid of C and c, by held-out loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.tuning.objective import grouped_loss


class GridPoint(NamedTuple):
    """A choice, and how good it is on groups left out one at a time.

    Attributes:
        penalty: C.
        offset: the kernel's c.
        loss: ``grouped_loss`` of held-out scores.
        balanced_accuracy: of the same.
    """

    penalty: float
    offset: float
    loss: float
    balanced_accuracy: float


def grid_points(
    z: Tensor,
    is_slip: Tensor,
    groups: Tensor,
    weights: Tensor,
    penalties: Sequence[float],
    offsets: Sequence[float],
) -> list[GridPoint]:
    """Every choice of C and c.

    One whose held-out scores cannot be told, or tell slip backwards, has an infinite loss.

    Shape:
        - z: ``[N, K]``; is_slip, groups, weights: ``[N]``
    """
    points = []
    for offset in offsets:
        machine = HeldOut(TrainingBins(z, is_slip, weights), groups, Polynomial(2, offset))
        for penalty in penalties:
            try:
                found = grouped_loss(machine.at(penalty).scores, is_slip, groups)
            except ValueError:
                points.append(GridPoint(penalty, offset, math.inf, 0.0))
                continue
            points.append(GridPoint(penalty, offset, float(found.loss), found.balanced_accuracy))
    return points


def least_loss(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of least loss, the first of equals."""
    return min(points, key=lambda point: point.loss)


def most_accurate(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of the best balanced accuracy, the first of equals: what a recipe takes."""
    return max(points, key=lambda point: point.balanced_accuracy)
