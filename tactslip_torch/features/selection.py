"""Which features to keep: those that match, the best by a t-test, or the best together.

The t-test is the paper's (section IV-D); forward selection is ours.

Moments are gathered in passes over recordings and merge.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.hand import HandLayout

CLASS_NAMES = ("non-slip", "slip")
_ATTRIBUTES = ("kind", "finger", "channel", "component", "domain", "descriptor")


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


def t_scores(moments: ClassMoments) -> Tensor:
    """Absolute two-sample t statistic of every feature, of the pooled variance.

    Where both variances are 0 the score is 0 for equal means and +inf otherwise.

    Args:
        moments: of the training bins.

    Shape:
        - output: ``[F]``, float64

    Raises:
        ValueError: if a class has no bin (named).

    Reference:
        ``scipy.stats.ttest_ind(..).statistic``, absolute; MATLAB's ``rankfeatures``.
    """
    for name, count in zip(CLASS_NAMES, moments.count.tolist(), strict=True):
        if count < 1:
            raise ValueError(f"ranking features needs bins of both classes, got no {name} bin")
    count = moments.count[:, None]
    freedom = (moments.count.sum() - 2).clamp(min=1)
    square = moments.sum_sq_dev.sum(0) / freedom * (1 / count).sum(0)
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


def matching(
    hand: HandLayout, names: Sequence[FeatureName], wanted: Mapping[str, str | Sequence[str]]
) -> Tensor:
    """Which features have, for every attribute that is named, one of its values, ``[F]``, bool.

    Args:
        hand: gives kind and finger of a channel.
        names: of the features.
        wanted: of each attribute a value or several, such as ``{"kind": "SG"}``.

    Raises:
        ValueError: for an unknown attribute, a value that no feature has, or values that no
            feature has together.
    """
    mask = torch.ones(len(names), dtype=torch.bool)
    checked = checked_attributes("wanted", wanted)
    for attribute, values in checked.items():
        having = [_attribute(hand, name, attribute) for name in names]
        for value in values:
            if value not in having:
                known = ", ".join(dict.fromkeys(having))
                raise ValueError(f"no feature has {attribute}={value!r}, expected some of {known}")
        mask &= torch.tensor([value in values for value in having], dtype=torch.bool)
    if not bool(mask.any()):
        together = ", ".join(f"{name}={'|'.join(values)}" for name, values in checked.items())
        raise ValueError(f"no feature has {together} together; ask for less")
    return mask


def checked_attributes(what: str, given: object) -> dict[str, tuple[str, ...]]:
    """Values by attribute of features, each as several.

    Raises:
        ValueError: if it is none of these, or empty; named ``what`` in the message.
    """
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"{what} must be like {{kind: SG, domain: [time, freq]}}, got {given!r}")
    found = {}
    for attribute, values in given.items():
        if attribute not in _ATTRIBUTES:
            known = ", ".join(_ATTRIBUTES)
            raise ValueError(f"{what}: unknown {attribute!r}, expected some of {known}")
        several = (values,) if isinstance(values, str) else values
        is_list = isinstance(several, Sequence) and all(isinstance(value, str) for value in several)
        if not is_list or not several:
            raise ValueError(f"{what}.{attribute} must be a name or several, got {values!r}")
        found[attribute] = tuple(several)
    return found


def _attribute(hand: HandLayout, name: FeatureName, attribute: str) -> str:
    if attribute in ("kind", "finger"):
        return str(getattr(hand.channel(name.channel), attribute))
    return str(getattr(name, attribute))


_LEFT = 1e-6  # of a column's square; what is below is explained by the columns before


class ColumnCosts(NamedTuple):
    """What columns cost that share parts of the work, each paid once.

    Attributes:
        needs: which parts each column needs, ``[S, P]``, 0 or 1.
        of_part: the cost of each part, ``[P]``.
        of_column: what any column costs itself.
    """

    needs: Tensor
    of_part: Tensor
    of_column: float


def forward_selection(
    columns: Tensor,
    targets: Tensor,
    weights: Tensor,
    num: int,
    ridge: float = 1.0,
    costs: ColumnCosts | None = None,
) -> list[int]:
    """Columns that explain targets best together, best first: greedy least squares.

    Each step takes the column that lowers the error of the ridge machine (with a free intercept) of
    all taken so far the most, by orthogonalising the others to it. Ends early where nothing is left
    to explain.

    Args:
        columns: of spread about 1.
        targets: one or several of each bin.
        weights: of bins.
        num: of columns to take, at most.
        ridge: added to the square of each column.
        costs: of the columns (``cost.WorkCosts``). Then the column is taken whose gain is largest
            for what it adds to the cost; parts that columns before it need as well add nothing.

    Shape:
        - columns: ``[N, S]``, float64; targets: ``[N, R]``; weights: ``[N]``

    Reference:
        Chen, Billings and Luo (1989), International Journal of Control 50(5), 1873-1896.
    """
    root = weights.sqrt()[:, None]
    share = weights / weights.sum()
    x, t = (root * (each - share @ each) for each in (columns, targets))
    square = x.square().sum(0) + ridge
    whole, cross = square.clone(), x.mT @ t
    taken, rows = list[int](), x.new_empty(min(num, x.shape[1]), x.shape[1])
    for step in range(len(rows)):
        gain = cross.square().sum(1) / square.clamp(min=1e-300)
        gain = torch.where(square > _LEFT * whole, gain, -1.0)
        gain[taken] = -1.0
        if costs is not None:
            is_paid = costs.needs[taken].amax(0) if taken else 0 * costs.of_part
            added = costs.needs @ (costs.of_part * (1 - is_paid))
            gain = gain / (costs.of_column + added)
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        row = x.mT @ x[:, best]
        row[best] += ridge
        row -= rows[:step].mT @ rows[:step, best]
        row /= square[best].sqrt()
        taken.append(best)
        rows[step] = row
        cross -= row[:, None] * (cross[best] / row[best])
        square -= row.square()
    return taken
