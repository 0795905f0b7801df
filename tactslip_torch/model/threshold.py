"""The simplest detector: one feature and one threshold."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class FeatureThreshold:
    """Says slip where ``sign * feature > sign * threshold``.

    Args:
        index: position of the feature.
        threshold: in the feature's unit.
        sign: +1 if slip has the larger values, -1 otherwise.
    """

    index: int
    threshold: float
    sign: int

    def __call__(self, features: Tensor) -> Tensor:
        """Decisions: ``[*, K] -> [*]``, bool."""
        decision: Tensor = self.sign * features[..., self.index] > self.sign * self.threshold
        return decision


def best_threshold(
    features: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> FeatureThreshold:
    """The single feature and threshold of the best balanced accuracy on training bins.

    Shape:
        - features: ``[N, K]``, finite; is_slip: ``[N]``, bool
        - weights: ``[N]``, of each bin; 1 by default

    Raises:
        ValueError: if a class is absent.
    """
    if bool(is_slip.all()) or not bool(is_slip.any()):
        raise ValueError("a threshold needs bins of both classes")
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    slip, quiet = weights * is_slip, weights * ~is_slip
    step = slip / slip.sum() - quiet / quiet.sum()
    values, order = features.sort(dim=0)
    below = step[order].cumsum(0)[:-1]  # slip recall minus non-slip recall if cut above this value
    below = torch.where(values[1:] > values[:-1], below, 0.0)  # no cut between equal values
    best = below.abs().flatten().argmax()
    row, index = divmod(int(best), features.shape[1])
    sign = -1 if below[row, index] > 0 else 1
    lower, upper = float(values[row, index]), float(values[row + 1, index])
    threshold = lower + (upper - lower) / 2
    if threshold in (lower, upper):  # neighbouring floats: the side that is not slip
        threshold = lower if sign > 0 else upper
    return FeatureThreshold(index, threshold, sign)
