"""Rankings by redundancy and by cost against plain loops over NumPy's numbers."""

import numpy as np
import pytest
import torch

from tactslip_torch.features import selection
from tactslip_torch.features.selection import rank_features, rank_per_cost, rank_weighted


def related(rng, num_bins=80, num_features=30):
    """Features of a few causes, some constant, some the same up to sign and gain."""
    causes = rng.standard_normal((num_bins, 5))
    features = causes @ rng.standard_normal((5, num_features))
    features += 0.5 * rng.standard_normal((num_bins, num_features))
    features[:, 3] = 7.0
    features[:, 8] = -2 * features[:, 9] + 1
    features[:, 11] = 1e6 + 1e-2 * features[:, 11]
    return features.astype(np.float32)


def weighted(scores, features, num, alpha):
    """MATLAB's rule, by numpy.corrcoef; a constant correlates with nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rho = np.nan_to_num(np.abs(np.corrcoef(features.astype(np.float64).T)))
    taken = [int(np.argmax(scores))]
    while len(taken) < num:
        value = scores * (1 - alpha * rho[:, taken].mean(1))
        value[taken] = -np.inf
        taken.append(int(np.argmax(value)))
    return taken


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.7, 1.0])
def test_weighted_is_matlabs_rule(alpha, rng):
    scores, features = rng.uniform(0, 9, 30), related(rng)
    found = rank_weighted(torch.from_numpy(scores), torch.from_numpy(features), 30, alpha)
    assert found.tolist() == weighted(scores, features, 30, alpha)
    if alpha == 0:
        assert torch.equal(found, rank_features(torch.from_numpy(scores), 30))


def test_weighted_does_not_depend_on_threads_or_units(rng, monkeypatch):
    features = torch.from_numpy(related(rng, 500, 60))
    scores = torch.from_numpy(rng.uniform(0, 9, 60))
    one = rank_weighted(scores, features, 60)
    try:
        torch.set_num_threads(2)
        assert torch.equal(rank_weighted(scores, features, 60), one)
    finally:
        torch.set_num_threads(1)
    assert torch.equal(rank_weighted(scores, 2.0**20 * features, 60), one)
    assert torch.equal(rank_weighted(scores, features.flip(0), 60), one)
    monkeypatch.setattr(selection, "_MOST_AT_ONCE", 59)
    assert torch.equal(rank_weighted(scores, features, 60), one)


def test_extreme_scores_have_their_place(rng):
    features = torch.from_numpy(related(rng, num_features=12))
    scores = torch.tensor([1.0, torch.nan, torch.inf, 0.0, 2.0, *[0.5] * 7])
    found = rank_weighted(scores, features, 12, 1.0).tolist()
    assert found[0] == 2
    assert found[-1] == 1
    needs, prices = torch.eye(12, dtype=torch.bool), torch.full((12,), 3)
    found = rank_per_cost(scores, needs, prices, 12).tolist()
    assert found[:3] == [2, 4, 0]
    assert found[-1] == 1


def per_cost(scores, needs, prices, num, power):
    taken, paid = [], set()
    for _ in range(num):
        best, best_value = None, None
        for i in range(len(scores)):
            if i in taken:
                continue
            price = sum(int(prices[p]) for p in np.flatnonzero(needs[i]) if p not in paid)
            rank = (price == 0, scores[i] if price == 0 else scores[i] / price**power)
            if power == 0:
                rank = (False, scores[i])
            if best is None or rank > best_value:
                best, best_value = i, rank
        taken.append(best)
        paid |= set(np.flatnonzero(needs[best]).tolist())
    return taken


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_per_cost_is_the_greedy_rule(power, rng):
    scores = rng.uniform(0.1, 9, 40)
    needs = rng.random((40, 12)) < 0.3
    needs[5] = False  # needs nothing: free
    prices = rng.integers(1, 10_000, 12)
    found = rank_per_cost(
        torch.from_numpy(scores), torch.from_numpy(needs), torch.from_numpy(prices), 40, power
    )
    assert found.tolist() == per_cost(scores, needs, prices, 40, power)
    assert sorted(found.tolist()) == list(range(40))


def test_errors_name_the_value():
    scores, features = torch.ones(3), torch.ones(5, 3)
    needs, prices = torch.ones(3, 2, dtype=torch.bool), torch.tensor([1, 2])
    with pytest.raises(ValueError, match=r"alpha must lie in 0\.\.1, got 1\.5"):
        rank_weighted(scores, features, 2, 1.5)
    with pytest.raises(ValueError, match=r"expected features \[n, 3\], got \(5, 4\)"):
        rank_weighted(scores, torch.ones(5, 4), 2)
    with pytest.raises(ValueError, match=r"num must lie in 1\.\.3, got 4"):
        rank_weighted(scores, features, 4)
    with pytest.raises(ValueError, match=r"num must lie in 1\.\.3, got 0"):
        rank_per_cost(scores, needs, prices, 0)
    with pytest.raises(ValueError, match=r"needs \[3, 2\] of bool, got \(3, 2\) of torch.float32"):
        rank_per_cost(scores, needs.float(), prices, 2)
    with pytest.raises(ValueError, match="prices must be whole numbers"):
        rank_per_cost(scores, needs, -prices, 2)
    with pytest.raises(ValueError, match="prices must be whole numbers"):
        rank_per_cost(scores, needs, prices.double(), 2)
    with pytest.raises(ValueError, match=r"more than 2\^50"):
        rank_per_cost(scores, needs, prices * 2**50, 2)
    with pytest.raises(ValueError, match="power must not be negative, got -1"):
        rank_per_cost(scores, needs, prices, 2, -1)
