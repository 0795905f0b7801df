"""What every known bin scores by the machine without its recording, from one factor of the sums.

Without the bins of a group ``g`` the residuals are ``e_g = (I - H_gg)^-1 (t - f)_g`` with the hat
matrix of the machine of all bins (``model.held_out``). Here all bins are in the sums, and a group
is what is known of a recording: of one that was added all bins, of one trained on those sampled.
The rest of the latter stays in, so a score is a little better than that of a machine that never met
the recording; before and after a change alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.adapting.bins import KnownBins
from tactslip_torch.adapting.statistics import Machine, Statistics
from tactslip_torch.model.cholesky import forward_solve, from_above
from tactslip_torch.model.downdate import residuals_by_block
from tactslip_torch.model.left_out import MOST_CONDITION
from tactslip_torch.model.quadratic import QuadraticForm, from_primal, quadratic_features
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.model.symmetric_solve import solve_symmetric_

_CHUNK = 1024  # bins of whole recordings whose columns are solved at a time, unless one has more


class Solved(NamedTuple):
    """A machine, and what known bins score without their recordings.

    Attributes:
        head: the machine of all bins.
        known: the bins.
        scores: ``[n]``, of these.
    """

    head: QuadraticForm
    known: KnownBins
    scores: Tensor


def class_scales(sums: SufficientStats, machine: Machine) -> Tensor:
    """What the balance multiplies the weight of non-slip and of slip with, ``[2]``."""
    weight = sums.weight
    if machine.balance == "none":
        return torch.ones_like(weight)
    return weight.sum() / (2 * weight)


def solve(statistics: Statistics) -> Solved:
    """The machine of the sums, and the scores of known bins.

    Takes what ``SufficientStats.solve`` takes, and ``P^2 / 2`` multiply-adds for each known bin.

    Raises:
        ValueError: if a class is absent, the system is too ill-conditioned to tell machines without
            a recording, or a recording weighs so much that the machine without it cannot be told.
    """
    sums, machine, known = statistics.sums, statistics.machine, statistics.known()
    normal, moment, noise = sums.normal_equations(
        machine.penalty, machine.offset, None, machine.balance
    )
    weights, report = solve_symmetric_(
        normal,
        moment,
        machine.penalty,
        name="X'WX",
        restore=from_above,
        noise=noise,
        in_span=True,
        most_condition=MOST_CONDITION,
    )
    head = from_primal(weights, sums.num_features, machine.offset)
    head.solved = report
    scales = class_scales(sums, machine)
    roots = (scales[known.is_slip.long()] * known.weight).sqrt()
    targets = torch.where(known.is_slip, 1.0, -1.0).double()
    right = roots * (targets - head(known.z))
    residuals = torch.empty_like(right)
    for groups in _chunks(known.recording):
        rows = torch.cat(groups)
        scaled = quadratic_features(known.z[rows], machine.offset) * roots[rows, None]
        columns = forward_solve(normal, scaled.mT).mT  # the factor stands in the matrix
        parts = columns.split([len(group) for group in groups])
        for number, (group, part) in enumerate(zip(groups, parts, strict=True)):
            left = (part @ part.mT).neg_()
            left.diagonal().add_(1)
            residuals[group] = residuals_by_block(left, right[group], [(number, len(group))])
    return Solved(head, known, targets - residuals / roots)


def _chunks(recording: Tensor) -> Iterator[list[Tensor]]:
    """Rows of whole recordings, some at a time."""
    order = recording.argsort(stable=True)
    _, sizes = torch.unique(recording, return_counts=True)
    groups: list[Tensor] = []
    for rows in order.split(sizes.tolist()):
        if groups and sum(map(len, groups)) + len(rows) > _CHUNK:
            yield groups
            groups = []
        groups.append(rows)
    if groups:
        yield groups
