"""What tuning minimises: the log loss of held-out probabilities, every group and class alike.

Scores are those of the machine that never met the bin's group, in closed form
(``model.held_out_gradient``). They become probabilities by the logistic calibration of these very
scores (``fit_platt``). Its slope and offset minimise the loss themselves (but for Platt's targets),
so that they count as constants on the way back.
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
        calibration: by default the one fitted to these scores; of bins that were held out from
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
    if calibration is None:
        calibration = fit_platt(scores, is_slip)
    llr = calibration.llr(scores)
    loss = softplus(torch.where(is_slip, -llr, llr))
    is_right = (scores.detach() >= 0) == is_slip
    losses, recalls = [], []
    for group in groups.unique():
        for kind in (False, True):
            own = (groups == group) & (is_slip == kind)
            if bool(own.any()):
                losses.append(loss[own].mean())
                recalls.append(float(is_right[own].double().mean()))
    return GroupedLoss(torch.stack(losses).mean(), sum(recalls) / len(recalls), calibration)
