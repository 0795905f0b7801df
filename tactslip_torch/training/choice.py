"""How decisions are counted: recall, balanced accuracy, Platt's calibration of held-out scores."""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.model.calibration import fit_platt

log = logging.getLogger(__name__)


def recalls(says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> list[float]:
    """Recall of non-slip and of slip, of decisions and truths ``[N]``; absent classes left out."""
    is_right = says_slip == is_slip
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    return [
        float(weights[mine & is_right].sum() / weights[mine].sum())
        for mine in (~is_slip, is_slip)
        if bool(mine.any())
    ]


def balanced_accuracy(
    says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> float | None:
    """Mean recall of both classes, of decisions and truths ``[N]``; ``None`` if one is absent."""
    found = recalls(says_slip, is_slip, weights)
    return sum(found) / 2 if len(found) == 2 else None


def has_both_classes(is_slip: Tensor) -> bool:
    """Whether bins ``[N]`` are of slip and of non-slip."""
    return bool(is_slip.any()) and not bool(is_slip.all())


def platt_or_none(scores: Tensor, is_slip: Tensor, weights: Tensor | None) -> dict[str, Any] | None:
    """Platt's calibration of held-out scores, JSON-able; ``None``, logged, if they are reversed."""
    try:
        return fit_platt(scores, is_slip, weights).to_dict()
    except ValueError as error:
        log.warning("scores are not calibrated: %s", error)
        return None
