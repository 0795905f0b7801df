"""Which features to keep: a t-test on class moments (paper section IV-D, REFERENCE.md section 5).

Moments are gathered in passes over recordings and merge, so a ranking needs one look at each bin,
and the ranking of a validation fold is a merge of what the other groups gathered.

``rank_distinct``, ``rank_weighted`` and ``rank_per_cost`` know more than each feature's own score:
what repeats, and what costs. Any number of threads gives the same ranking.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

ScoreVariance = Literal["pooled", "welch"]
CLASS_NAMES = ("non-slip", "slip")
_BLOCK = 128  # features whose correlations are looked at together
LARGEST_PRICE = 2**50
"""So that sums of prices, and of their products with 0 and 1, are exact in float64."""
_MOST_AT_ONCE = 4096  # features whose products fit into memory; of more, those with one at a time


class ClassMoments:
    """Count, mean and sum of squared deviations of every feature in both classes.

    The order of bins, and how they are sharded, shows in the last digits alone; a constant feature
    has no spread at all.

    Args:
        num_features: length of a feature vector.

    Attributes:
        count: bins of each class so far, ``[2]``, float64, non-slip first.
        mean: ``[2, F]``, float64; 0 without bins.
        sum_sq_dev: sums of squared deviations from the mean, ``[2, F]``, float64.

    Reference:
        Chan, Golub and LeVeque (1983), The American Statistician 37(3), 242-247, for the merge.
    """

    def __init__(self, num_features: int) -> None:
        self.count = torch.zeros(2, dtype=torch.float64)
        self.mean = torch.zeros(2, num_features, dtype=torch.float64)
        self.sum_sq_dev = torch.zeros_like(self.mean)

    @property
    def num_features(self) -> int:
        """Length of a feature vector."""
        return self.mean.shape[1]

    def update(self, features: Tensor, labels: Tensor) -> None:
        """Add bins; nothing on an error.

        Shape:
            - features: ``[N, F]``, float32, finite
            - labels: ``[N]``, 1 or True for slip

        Raises:
            ValueError: for another shape or dtype, or a value that is not finite.
        """
        if labels.ndim != 1 or features.shape != (len(labels), self.num_features):
            raise ValueError(
                f"expected features [N, {self.num_features}] and labels [N], "
                f"got {tuple(features.shape)} and {tuple(labels.shape)}"
            )
        if features.dtype != torch.float32:
            raise ValueError(
                f"moments are those of float32 features, got {features.dtype}; "
                "hand float32, as the data module does"
            )
        features, labels = features.detach().cpu(), labels.cpu().bool()
        if not bool(features.isfinite().all()):
            row, column = (~features.isfinite()).nonzero()[0].tolist()
            raise ValueError(
                f"expected finite values, got {float(features[row, column])} in row {row}, "
                f"column {column}"
            )
        part = ClassMoments(self.num_features)
        for label, own in enumerate((features[~labels].double(), features[labels].double())):
            if len(own):
                away = own - own[0]  # exactly 0 if constant
                part.count[label], part.mean[label] = len(own), own[0] + away.mean(0)
                part.sum_sq_dev[label] = (away - away.mean(0)).square().sum(0)
        self.merge(part)

    def merge(self, other: ClassMoments) -> None:
        """Add the bins of other moments, of as many features."""
        count = self.count + other.count
        share = (other.count / count.clamp(min=1))[:, None]
        apart = other.mean - self.mean
        between = apart.square() * share * self.count[:, None]
        self.sum_sq_dev = self.sum_sq_dev + other.sum_sq_dev + between
        self.mean = torch.where(self.count[:, None] > 0, self.mean + apart * share, other.mean)
        self.count = count


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

    Scores are compared in float32, so that the rounding of sums decides between no two features.

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
    comparable = torch.where(scores.isnan(), -1.0, scores).float()
    return comparable.argsort(descending=True, stable=True)[:num]


def rank_distinct(
    scores: Tensor, features: Tensor, is_slip: Tensor, num: int, most_correlation: float
) -> Tensor:
    """The best features that do not repeat each other, best first.

    Goes down the ranking and skips a feature whose correlation with one already taken exceeds
    ``most_correlation``. Where fewer than ``num`` remain, the best of the skipped ones follow.
    Correlation is the absolute one of Pearson within classes: of deviations from the mean of the
    bin's class, over all bins; that of a constant is 0.

    Args:
        scores: of all features, as for ``rank_features``.
        features: a sample of training bins, float32 and finite.
        is_slip: their classes.
        num: how many features to take.
        most_correlation: in [0, 1]; 1 skips none.

    Shape:
        - scores: ``[F]``
        - features: ``[n, F]``
        - is_slip: ``[n]``
        - output: ``[num]``, int64

    Raises:
        ValueError: if shapes disagree, or ``num`` or ``most_correlation`` is out of range.
    """
    if not 0 <= most_correlation <= 1:
        raise ValueError(f"most_correlation must lie in 0..1, got {most_correlation}")
    if features.shape != (len(is_slip), len(scores)):
        raise ValueError(
            f"expected features [{len(is_slip)}, {len(scores)}], got {tuple(features.shape)}"
        )
    best = rank_features(scores, num)
    if most_correlation == 1:
        return best
    taken = torch.empty(num, len(features), dtype=torch.float64)
    chosen: list[int] = []
    skipped: list[int] = []
    for block in rank_features(scores, len(scores)).split(_BLOCK):
        units = unit_deviations(features[:, block], is_slip)
        repeats = (_correlation(units, taken[: len(chosen)]) > most_correlation).any(-1)
        is_near = _correlation(units, units) > most_correlation
        for row, index in enumerate(block.tolist()):
            if repeats[row]:
                skipped.append(index)
                continue
            taken[len(chosen)] = units[row]
            chosen.append(index)
            if len(chosen) == num:
                return torch.tensor(chosen)
            repeats |= is_near[row]
    return torch.tensor(chosen + skipped[: num - len(chosen)])


def unit_deviations(features: Tensor, is_slip: Tensor) -> Tensor:
    """Deviations from class means, of norm 1 or, of a constant, 0: ``[F, n]``, float64."""
    moments = ClassMoments(features.shape[1])
    moments.update(features, is_slip)
    size = moments.sum_sq_dev.sum(0).sqrt()
    deviations = features.cpu() - moments.mean[is_slip.cpu().long()]
    return (deviations / torch.where(size == 0, 1.0, size)).T.contiguous()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Absolute correlations of unit deviations ``[A, n]`` and ``[B, n]``, at most 1, ``[A, B]``."""
    size = a.square().sum(-1).sqrt()[:, None] * b.square().sum(-1).sqrt()
    return torch.where(size == 0, 0.0, (a @ b.T).abs() / size).clamp(max=1)
