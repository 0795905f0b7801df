"""What tuning minimises: the log loss of held-out probabilities, every group and class alike.

Scores are those of the machine that never met the bin's group, in closed form
(``model.held_out_gradient``). They become probabilities by one slope, ``llr = slope * score``: a
detector decides at a score of 0, so a machine that leans to one side has to pay for it here. The
slope is the one of least loss (but for Platt's targets), so that it counts as a constant on the way
back.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from tactslip_torch.model.calibration import Platt, fit_platt


class GroupedLoss(NamedTuple):
    """How good held-out scores are.

    Attributes:
        loss: ``[]``, mean log loss in nats of probabilities at equal shares of slip and non-slip,
            first over the bins of each group and class, then over these; differentiable.
        balanced_accuracy: mean of the recalls of the same.
        calibration: by which scores became probabilities.
    """

    loss: Tensor
    balanced_accuracy: float
    calibration: Platt


def grouped_loss(
    scores: Tensor, is_slip: Tensor, groups: Tensor, calibration: Platt | None = None
) -> GroupedLoss:
    """The loss of scores that each come from a machine that never met the bin's group.

    Args:
        scores: of bins.
        is_slip: their truth.
        groups: whole numbers.
        calibration: by default the slope fitted to these scores; of bins that were held out from
            tuning altogether, that of the others.

    Shape:
        - scores, is_slip (bool), groups: ``[N]``

    Raises:
        ValueError: if a class is absent, or slip has the lower scores.

    Example:
        >>> scores = torch.tensor([1.0, -1.0, 2.0, 0.5], dtype=torch.float64)
        >>> is_slip, groups = torch.tensor([True, False, True, False]), torch.tensor([0, 0, 1, 1])
        >>> grouped_loss(scores, is_slip, groups, Platt(1.0, 0.0)).balanced_accuracy
        0.75
    """
    shares = _shares(is_slip, groups).to(scores)
    if calibration is None:
        calibration = _slope(scores.detach(), is_slip, shares)
    llr = calibration.llr(scores)
    losses = softplus(torch.where(is_slip, -llr, llr))
    is_right = (scores.detach() >= 0) == is_slip
    return GroupedLoss((shares * losses).sum(), float(shares[is_right].sum()), calibration)


def _shares(is_slip: Tensor, groups: Tensor) -> Tensor:
    """The part of each bin in a mean over groups and classes, ``[N]``, float64."""
    cell = 2 * torch.unique(groups, return_inverse=True)[1] + is_slip
    _, place, counts = torch.unique(cell, return_inverse=True, return_counts=True)
    shares: Tensor = 1 / (len(counts) * counts[place].double())
    return shares


def _slope(scores: Tensor, is_slip: Tensor, shares: Tensor) -> Platt:
    """The slope alone: every bin beside its mirror image, so that there is nothing to offset."""
    both = torch.cat([scores, -scores]), torch.cat([is_slip, ~is_slip])
    found = fit_platt(*both, torch.cat([shares, shares]) * len(shares))
    return Platt(found.slope, 0.0)
