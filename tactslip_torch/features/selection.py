"""Which features to keep: a t-test on class moments (paper section IV-D, REFERENCE.md section 5).

Moments are gathered in passes over recordings and merge exactly, so a ranking needs one look at
each bin, and the ranking of a validation fold is a merge of what the other groups gathered.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor

ScoreVariance = Literal["pooled", "welch"]
CLASS_NAMES = ("non-slip", "slip")


class ClassMoments:
    """Count, mean and sum of squared deviations of every feature in both classes, in float64.

    Args:
        num_features: length of a feature vector.

    Attributes:
        count: ``[2]``, non-slip first.
        mean: ``[2, F]``.
        sum_sq_dev: ``[2, F]``.

    Reference:
        Chan, Golub and LeVeque (1983), The American Statistician 37(3), 242-247.
    """

    def __init__(self, num_features: int) -> None:
        self.count = torch.zeros(2, dtype=torch.float64)
        self.mean = torch.zeros(2, num_features, dtype=torch.float64)
        self.sum_sq_dev = torch.zeros(2, num_features, dtype=torch.float64)

    def update(self, features: Tensor, labels: Tensor) -> None:
        """Add bins.

        Shape:
            - features: ``[N, F]``
            - labels: ``[N]``, 1 or True for slip

        Raises:
            ValueError: if shapes disagree.
        """
        if features.shape != (len(labels), self.mean.shape[-1]):
            raise ValueError(
                f"expected features [{len(labels)}, {self.mean.shape[-1]}], "
                f"got {tuple(features.shape)}"
            )
        fresh = ClassMoments(self.mean.shape[-1])
        for index in (0, 1):
            chosen = features[labels.bool() == bool(index)].to("cpu", torch.float64)
            if len(chosen):
                shifted = chosen - chosen[0]  # a constant has exactly its value and no spread
                mean = shifted.mean(0)
                fresh.count[index] = len(chosen)
                fresh.mean[index] = chosen[0] + mean
                fresh.sum_sq_dev[index] = (shifted - mean).square().sum(0)
        merged = self.merge(fresh)
        self.count, self.mean, self.sum_sq_dev = merged.count, merged.mean, merged.sum_sq_dev

    def merge(self, other: ClassMoments) -> ClassMoments:
        """The moments of both sets of bins together, as a new object.

        Raises:
            ValueError: if the numbers of features differ.
        """
        if self.mean.shape != other.mean.shape:
            raise ValueError(
                f"cannot merge moments of {self.mean.shape[-1]} and {other.mean.shape[-1]} features"
            )
        merged = ClassMoments(self.mean.shape[-1])
        merged.count = self.count + other.count
        share = (other.count / merged.count.clamp(min=1))[:, None]
        apart = other.mean - self.mean
        merged.mean = self.mean + apart * share
        between = apart.square() * self.count[:, None] * share
        merged.sum_sq_dev = self.sum_sq_dev + other.sum_sq_dev + between
        return merged

    @classmethod
    def merged(cls, parts: Iterable[ClassMoments]) -> ClassMoments:
        """All parts together.

        Raises:
            ValueError: if there is none.
        """
        parts = list(parts)
        if not parts:
            raise ValueError("no moments to merge")
        total = cls(parts[0].mean.shape[-1])
        for part in parts:
            total = total.merge(part)
        return total

    def state_dict(self) -> dict[str, Tensor]:
        """Plain tensors, for checkpoints."""
        return {"count": self.count, "mean": self.mean, "sum_sq_dev": self.sum_sq_dev}

    @classmethod
    def from_state_dict(cls, state: dict[str, Tensor]) -> ClassMoments:
        """The moments that ``state_dict`` described."""
        moments = cls(state["mean"].shape[-1])
        moments.count = state["count"]
        moments.mean = state["mean"]
        moments.sum_sq_dev = state["sum_sq_dev"]
        return moments


def t_scores(moments: ClassMoments, variance: ScoreVariance = "pooled") -> Tensor:
    """Absolute two-sample t statistic of every feature.

    Where both variances are 0 the score is 0 for equal means and +inf otherwise.

    Args:
        moments: of the training bins.
        variance: ``"pooled"`` (MATLAB's ``rankfeatures``) or ``"welch"``; they agree for balanced
            classes.

    Shape:
        - output: ``[F]``, float64

    Raises:
        ValueError: if a class has no bin (named) or the variance is unknown.

    Reference:
        ``scipy.stats.ttest_ind(equal_var=variance == "pooled").statistic``, absolute.
    """
    for name, count in zip(CLASS_NAMES, moments.count.tolist(), strict=True):
        if count < 1:
            raise ValueError(f"ranking features needs bins of both classes, got no {name} bin")
    count = moments.count[:, None]
    if variance == "pooled":
        freedom = (moments.count.sum() - 2).clamp(min=1)
        square = moments.sum_sq_dev.sum(0) / freedom * (1 / count).sum(0)
    elif variance == "welch":
        square = (moments.sum_sq_dev / (count - 1).clamp(min=1) / count).sum(0)
    else:
        raise ValueError(f"variance must be 'pooled' or 'welch', got {variance!r}")
    apart = (moments.mean[1] - moments.mean[0]).abs()
    both_still = torch.where(apart == 0, 0.0, torch.inf).to(apart)
    return torch.where(square == 0, both_still + apart, apart / square.sqrt())


def rank_features(scores: Tensor, num: int) -> Tensor:
    """The best features, best first; ties by pool index, NaN last.

    Shape:
        - scores: ``[F]``
        - output: ``[num]``, int64

    Raises:
        ValueError: if ``num`` is not in 1..F.

    Example:
        >>> rank_features(torch.tensor([1.0, float("nan"), 3.0, 3.0]), 3)
        tensor([2, 3, 0])
    """
    if not 1 <= num <= len(scores):
        raise ValueError(f"num must lie in 1..{len(scores)}, got {num}")
    comparable = torch.where(scores.isnan(), -1.0, scores)
    return comparable.argsort(descending=True, stable=True)[:num]
