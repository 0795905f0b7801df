"""Moments of the classes, and rankings of features against plain loops over NumPy's numbers."""

import itertools
import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.selection import (
    ClassMoments,
    rank_distinct,
    rank_features,
    t_scores,
)

VARIANCES = ["pooled", "welch"]


def draw(rng, num_bins=80, num_features=12, share=0.3):
    labels = (rng.uniform(size=num_bins) < share).astype(int)
    labels[:4] = 0, 0, 1, 1
    features = rng.standard_normal((num_bins, num_features)) * 10.0 ** rng.integers(-3, 4, 12)
    features += labels[:, None] * rng.uniform(-1, 1, num_features) * features.std(0)
    return features.astype(np.float32), labels


def moments_of(features, labels):
    moments = ClassMoments(features.shape[1])
    moments.update(torch.as_tensor(features).float(), torch.as_tensor(labels))
    return moments


def double(features):
    """What the moments saw, for references in float64."""
    return np.asarray(features, dtype=np.float32).astype(np.float64)


def assert_same(actual, expected):
    """To rounding, in units of the largest value of each feature."""
    assert torch.equal(actual.count, expected.count)
    torch.testing.assert_close(actual.mean, expected.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(actual.sum_sq_dev, expected.sum_sq_dev, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("variance", VARIANCES)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_scores_equal_scipy(variance, share, rng):
    features, labels = draw(rng, share=share)
    actual = t_scores(moments_of(features, labels), variance)
    expected = oracles.t_scores(double(features), labels, variance)
    np.testing.assert_allclose(actual, expected, rtol=1e-10)


@given(
    cuts=st.lists(st.integers(0, 80), max_size=6),
    order=st.randoms(use_true_random=False),
    seed=st.integers(0, 20),
    offset=st.sampled_from([0.0, 1e6]),
)
def test_merged_parts_equal_the_whole_in_any_split_and_order(cuts, order, seed, offset):
    features, labels = draw(np.random.default_rng(seed))
    features = (features + offset).astype(np.float32)
    edges = [0, *sorted(cuts), 80]
    parts = [moments_of(features[a:b], labels[a:b]) for a, b in itertools.pairwise(edges)]
    whole = moments_of(features, labels)
    order.shuffle(parts)
    merged = ClassMoments(12)
    for part in parts:
        merged.merge(part)
    assert_same(merged, whole)
    grown = ClassMoments(12)
    for a, b in itertools.pairwise(edges):
        grown.update(torch.from_numpy(features[a:b]), torch.from_numpy(labels[a:b]))
        assert_same(grown, moments_of(features[:b], labels[:b]))  # also between updates


@pytest.mark.parametrize("variance", VARIANCES)
def test_a_feature_that_never_moves(variance):
    labels = torch.tensor([0, 0, 0, 1, 1])
    features = torch.zeros(5, 3)
    features[:, 1] = 7.0
    features[3:, 2] = 1.0
    assert t_scores(moments_of(features, labels), variance).tolist() == [0, 0, math.inf]


some_scores = st.sampled_from([0.0, 1.0, 2.5, math.inf, math.nan]) | st.floats(0, 9)


@given(scores=st.lists(some_scores, min_size=1), data=st.data())
def test_ranking_is_by_score_then_index_with_nan_last(scores, data):
    num = data.draw(st.integers(1, len(scores)))
    numbers = [i for i, score in enumerate(scores) if not math.isnan(score)]
    missing = [i for i, score in enumerate(scores) if math.isnan(score)]
    rounded = np.float32(scores)
    expected = (sorted(numbers, key=lambda i: (-rounded[i], i)) + missing)[:num]
    ranked = rank_features(torch.tensor(scores, dtype=torch.float64), num)
    assert ranked.dtype == torch.long
    assert ranked.tolist() == expected


# -------------------------------------------------------------------------------- rank_distinct
def within_class_correlation(features, is_slip):
    """NumPy's, of what is left without class means; 0 for a constant."""
    features = double(features)
    for label in (False, True):
        if (is_slip == label).any():
            features[is_slip == label] -= features[is_slip == label].mean(0)
    features[:, np.abs(features).max(0) < 1e-12] = 0
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.abs(np.corrcoef(features, rowvar=False)))


def distinct(scores, features, is_slip, num, most_correlation):
    """The definition, one feature at a time."""
    correlation = within_class_correlation(features, is_slip)
    order = sorted(range(len(scores)), key=lambda i: (-scores[i], i))
    taken = []
    for i in order:
        if all(correlation[i, j] <= most_correlation for j in taken):
            taken.append(i)
    return (taken + [i for i in order if i not in taken])[:num]


def families(rng, num_bins, num_features, num_sources=9):
    """Features that repeat a few sources, with classes far apart, and a column of each kind."""
    is_slip = rng.uniform(size=num_bins) < 0.6
    sources = rng.standard_normal((num_bins, num_sources))
    noise = rng.choice([0.1, 0.5, 2.0], num_features) * rng.standard_normal(
        (num_bins, num_features)
    )
    features = sources[:, rng.integers(num_sources, size=num_features)] + noise
    features *= rng.choice([-1, 1], num_features) * 10.0 ** rng.integers(-9, 9, num_features)
    features += 5 * is_slip[:, None] * features.std(0)  # between classes, which does not count
    features[:, num_features // 2] = 0.1
    return features.astype(np.float32), is_slip


@pytest.mark.parametrize("most_correlation", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("num", [1, 9, 40, 300])
def test_distinct_features_equal_the_definition(most_correlation, num, rng):
    """300 features: more than one block of candidates."""
    features, is_slip = families(rng, 120, 300)
    scores = rng.permutation(300) / 7
    given = map(torch.from_numpy, (scores, features, is_slip))
    actual = rank_distinct(*given, num, most_correlation)
    assert actual.dtype == torch.long
    assert actual.tolist() == distinct(scores, features, is_slip, num, most_correlation)


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


def labelled(*labels):
    return moments_of(torch.randn(len(labels), 3), torch.tensor(labels))


def updated(features, labels=5):
    return ClassMoments(3).update(features, torch.zeros(labels))


ONES = torch.ones(3)
BINS = torch.ones(5, 3)
BROKEN = torch.zeros(5, 3).index_put((torch.tensor(4), torch.tensor(2)), torch.tensor(math.nan))


REFUSED = [
    (t_scores, [labelled(1, 1, 1)], "no non-slip bin"),
    (t_scores, [labelled(0, 0, 0)], "no slip bin"),
    (t_scores, [labelled(0, 1), "student"], "'pooled' or 'welch', got 'student'"),
    (updated, [torch.zeros(5, 4)], r"\[N, 3\] and .*\(5, 4\) and \(5,\)"),
    (updated, [BINS, 4], r"\[N, 3\] and .*\(5, 3\) and \(4,\)"),
    (updated, [BINS, (5, 1)], r"\(5, 3\) and \(5, 1\)"),
    (updated, [BINS, ()], r"\(5, 3\) and \(\)"),
    (updated, [BINS.double()], r"float64; hand float32, as the data module does"),
    (updated, [BROKEN], "got nan in row 4, column 2"),
    *((rank_features, [ONES, num], rf"1\.\.3, got {num}") for num in (4, 0, -1)),
    (rank_distinct, [ONES, BINS, torch.zeros(5), 0, 0.9], r"1\.\.3, got 0"),
    *(
        (rank_distinct, [ONES, BINS, torch.zeros(5), 2, most], rf"lie in 0\.\.1, got {most}")
        for most in (-0.1, 1.1, math.nan)
    ),
    (rank_distinct, [ONES, BINS, torch.zeros(6), 2, 0.9], r"\[6, 3\], got \(5, 3\)"),
]


@pytest.mark.parametrize(("call", "arguments", "message"), REFUSED)
def test_what_cannot_be_ranked_is_named(call, arguments, message):
    with pytest.raises(ValueError, match=message):
        call(*arguments)
