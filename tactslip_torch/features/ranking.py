"""Rankings that know more than each feature's own t statistic: what repeats, and what costs.

``rank_weighted`` is MATLAB's ``rankfeatures`` with ``CCWeighting``: a feature counts for less the
more it correlates with those already taken. ``rank_per_cost`` takes what tells most for what it
adds to the bill, where shared work (a branch, a spectrum, a sort) is free once it is paid for.
Either way the same bits come out for any number of threads.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tactslip_torch.features.selection import rank_features, unit_deviations

LARGEST_PRICE = 2**50
"""So that sums of prices, and of their products with 0 and 1, are exact in float64."""
_MOST_AT_ONCE = 4096  # features whose products fit into memory; of more, those with one at a time


def rank_weighted(scores: Tensor, features: Tensor, num: int, alpha: float = 0.7) -> Tensor:
    """The best features, each weighed by how little it repeats those before it, best first.

    The next is the one with the largest ``score * (1 - alpha * rho)``, where ``rho`` is the mean
    absolute correlation (Pearson's, over all bins of both classes) with those already taken; that
    of a constant is 0. Ties go by pool index. Correlations are exact sums on a grid, so the choice
    does not depend on the number of threads.

    Args:
        scores: of all features, not negative; NaN comes last.
        features: a sample of training bins, float32 and finite.
        num: how many features to take.
        alpha: in [0, 1]; 0 is ``rank_features``.

    Shape:
        - scores: ``[F]``
        - features: ``[n, F]``
        - output: ``[num]``, int64

    Raises:
        ValueError: if shapes disagree, or ``num`` or ``alpha`` is out of range.

    Reference:
        MATLAB, ``rankfeatures(X, group, "CCWeighting", alpha)``.
    """
    if not 0 <= alpha <= 1:
        raise ValueError(f"alpha must lie in 0..1, got {alpha}")
    if features.ndim != 2 or features.shape[1:] != scores.shape:
        raise ValueError(f"expected features [n, {len(scores)}], got {tuple(features.shape)}")
    rank_features(scores, num)  # refuses a num out of range
    units = unit_deviations(features, torch.zeros(len(features), dtype=torch.bool))
    size = units.square().sum(-1).sqrt()
    gram = units @ units.T if len(units) <= _MOST_AT_ONCE else None
    comparable = torch.where(scores.isnan(), -1.0, scores).double().cpu()
    repeated = torch.zeros_like(comparable)  # sum of correlations with those taken
    is_free = torch.ones_like(comparable, dtype=torch.bool)
    chosen: list[int] = []
    for count in range(num):
        share = 1 - alpha * (repeated / max(count, 1))
        value = torch.where(share > 0, comparable * share, comparable.clamp(max=0.0))
        best = int(torch.where(is_free, value, -torch.inf).argmax())
        chosen.append(best)
        is_free[best] = False
        both = size * size[best]
        product = units @ units[best] if gram is None else gram[best]
        rho = product.abs() / torch.where(both == 0, 1.0, both)
        repeated += torch.where(both == 0, 0.0, rho).clamp(max=1)
    return torch.tensor(chosen)


def rank_per_cost(
    scores: Tensor, needs: Tensor, prices: Tensor, num: int, power: float = 1.0
) -> Tensor:
    """The features that tell most for what they add to the bill, best first.

    The next is the one with the largest ``score / price^power``, where its price is the sum of
    those parts it needs that nobody before it has paid for. What adds nothing comes before all
    that costs, by score. Ties go by pool index. Prices are whole numbers, so sums are exact.

    Args:
        scores: of all features, not negative; NaN comes last.
        needs: which parts each feature needs.
        prices: of the parts, whole numbers of any unit, not negative.
        num: how many features to take.
        power: of the price, not negative; 0 is ``rank_features``.

    Shape:
        - scores: ``[F]``
        - needs: ``[F, P]``, bool
        - prices: ``[P]``, int64
        - output: ``[num]``, int64

    Raises:
        ValueError: if shapes or dtypes disagree, or ``num``, ``power`` or a price is out of range.

    Example:
        >>> needs = torch.tensor([[True, False], [True, True], [False, True]])
        >>> rank_per_cost(torch.tensor([4.0, 9.0, 3.0]), needs, torch.tensor([2, 9]), 3)
        tensor([0, 1, 2])
    """
    _check_bill(scores, needs, prices, power)
    rank_features(scores, num)
    comparable = torch.where(scores.isnan(), -1.0, scores).double().cpu()
    due = needs.double() @ prices.double()  # [F], whole numbers
    unpaid = torch.ones_like(prices, dtype=torch.bool)
    is_free = torch.ones_like(comparable, dtype=torch.bool)
    chosen: list[int] = []
    for _ in range(num):
        if power == 0:
            best = int(torch.where(is_free, comparable, -torch.inf).argmax())
        else:
            for_nothing = is_free & (due == 0)
            value = comparable / due.clamp(min=1) ** power
            value = torch.where(comparable < 0, comparable, value)
            among = for_nothing if bool(for_nothing.any()) else is_free
            best = int(torch.where(among, value, -torch.inf).argmax())
        chosen.append(best)
        is_free[best] = False
        bought = needs[best] & unpaid
        due -= needs[:, bought].double() @ prices[bought].double()
        unpaid &= ~bought
    return torch.tensor(chosen)


def _check_bill(scores: Tensor, needs: Tensor, prices: Tensor, power: float) -> None:
    if needs.shape != (len(scores), len(prices)) or needs.dtype != torch.bool:
        raise ValueError(
            f"expected needs [{len(scores)}, {len(prices)}] of bool, got {tuple(needs.shape)} of "
            f"{needs.dtype}"
        )
    if prices.dtype != torch.int64 or bool((prices < 0).any()):
        raise ValueError(f"prices must be whole numbers from 0 on, int64, got {prices.dtype}")
    if int(prices.sum()) > LARGEST_PRICE:
        raise ValueError("prices add up to more than 2^50; take a larger unit")
    if not power >= 0:
        raise ValueError(f"power must not be negative, got {power}")
