"""The search that tuning starts from and is held against: a grid of C and c, by held-out loss."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
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
    penalties: Sequence[float],
    offsets: Sequence[float],
) -> list[GridPoint]:
    """Every choice of C and c.

    Shape:
        - z: ``[N, K]``; is_slip, groups: ``[N]``

    Raises:
        ValueError: as ``HeldOut``, or if held-out scores tell slip backwards.
    """
    points = []
    for offset in offsets:
        machine = HeldOut(TrainingBins(z, is_slip), groups, Polynomial(2, offset))
        for penalty in penalties:
            with torch.no_grad():
                found = grouped_loss(machine.at(penalty).scores, is_slip, groups)
            points.append(GridPoint(penalty, offset, float(found.loss), found.balanced_accuracy))
    return points


def least_loss(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of least loss, the first of equals."""
    return min(points, key=lambda point: point.loss)


def most_accurate(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of the best balanced accuracy, the first of equals: what a recipe takes."""
    return max(points, key=lambda point: point.balanced_accuracy)
