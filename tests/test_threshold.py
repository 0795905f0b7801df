import itertools

import numpy as np
import pytest
import torch

from tactslip_torch.training.baselines import FeatureThreshold, best_threshold


def balanced_accuracy(says_slip, is_slip):
    return (says_slip[is_slip].mean() + (~says_slip[~is_slip]).mean()) / 2


def best_of_all(features, is_slip):
    """Every feature, every cut between two of its values or outside them, both directions."""
    scores = [0.5]
    for column in features.T:
        values = np.unique(column)
        for cut, sign in itertools.product((values[1:] + values[:-1]) / 2, (1, -1)):
            scores.append(balanced_accuracy(sign * column > sign * cut, is_slip))
    return max(scores)


@pytest.mark.parametrize("num_levels", [3, 1000])
@pytest.mark.parametrize("share", [0.5, 0.15])
def test_no_cut_is_better(num_levels, share, rng):
    """Few levels make ties: a cut between equal values is none."""
    for _ in range(6):
        features = rng.integers(0, num_levels, (17, 4)).astype(float)
        is_slip = rng.uniform(size=17) < share
        is_slip[:2] = True, False
        rule = best_threshold(torch.from_numpy(features), torch.from_numpy(is_slip))
        says_slip = rule(torch.from_numpy(features)).numpy()
        expected = best_of_all(features, is_slip)
        assert balanced_accuracy(says_slip, is_slip) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_sign_says_where_slip_lies(sign):
    noise, useful = torch.tensor([5.0, -5.0, 5.0, -5.0]), sign * torch.tensor([0.0, 1.0, 2.0, 4.0])
    is_slip = torch.tensor([False, False, True, True])
    rule = best_threshold(torch.stack([noise, useful], dim=-1).double(), is_slip)
    assert rule == FeatureThreshold(index=1, threshold=1.5 * sign, sign=sign)
    new = torch.tensor([[0.0, 1.4 * sign], [0.0, 1.6 * sign]])
    assert rule(new).tolist() == [False, True]


def test_classes_count_alike_however_many_bins_they_have():
    """By accuracy the cut above 1 would win, with 12 of 13 bins; by recalls it is the one at 0."""
    quiet, slip = torch.tensor([-1.0, -1.0]), torch.cat([torch.ones(8), -torch.ones(3)])
    features = torch.cat([quiet, slip])[:, None].double()
    is_slip = torch.arange(13) >= 2
    rule = best_threshold(features, is_slip)
    assert rule(features).tolist() == [False] * 2 + [True] * 8 + [False] * 3


def test_features_that_tell_nothing_still_give_a_rule():
    features = torch.ones(6, 2, dtype=torch.float64)
    is_slip = torch.arange(6) < 3
    says_slip = best_threshold(features, is_slip)(features)
    assert says_slip.all() or not says_slip.any()


def test_neighbouring_floats_are_told_apart():
    is_slip = torch.tensor([False, False, True, True])
    below = torch.tensor(1.0, dtype=torch.float64)
    for _ in range(4):
        above = torch.nextafter(below, torch.tensor(2.0, dtype=torch.float64))
        features = torch.stack([below, below, above, above])[:, None]
        for truth in (is_slip, ~is_slip):
            assert best_threshold(features, truth)(features).tolist() == truth.tolist()
        below = above


def test_an_absent_class_is_refused():
    with pytest.raises(ValueError, match="both classes; got only one"):
        best_threshold(torch.randn(4, 2), torch.ones(4).bool())
