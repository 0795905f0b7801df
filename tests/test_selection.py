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
    forward_selection,
    rank_features,
    t_scores,
)


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
    """To rounding: deviations are known no better than the means that they are taken from."""
    assert torch.equal(actual.count, expected.count)
    torch.testing.assert_close(actual.mean, expected.mean, rtol=1e-12, atol=1e-12)
    close = {"rtol": 1e-9, "atol": 1e-12 + 1e-14 * float(expected.mean.abs().max())}
    torch.testing.assert_close(actual.sum_sq_dev, expected.sum_sq_dev, **close)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_scores_equal_scipy(share, rng):
    features, labels = draw(rng, share=share)
    actual = t_scores(moments_of(features, labels))
    expected = oracles.t_scores(double(features), labels)
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


def test_a_feature_that_never_moves():
    labels = torch.tensor([0, 0, 0, 1, 1])
    features = torch.zeros(5, 3)
    features[:, 1] = 7.0
    features[3:, 2] = 1.0
    assert t_scores(moments_of(features, labels)).tolist() == [0, 0, math.inf]


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


# ---------------------------------------------------------------------------- forward selection
def penalised_error(x, targets, weights, ridge):
    """Least weighted square error, with a free intercept and ``ridge`` times squared slopes."""
    root = np.sqrt(weights)[:, None]
    rows = np.vstack([root * np.column_stack([x, np.ones(len(x))]),
                      np.sqrt(ridge) * np.eye(x.shape[1], x.shape[1] + 1)])  # fmt: skip
    wanted = np.vstack([root * targets, np.zeros((x.shape[1], targets.shape[1]))])
    slopes = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return float(np.square(wanted - rows @ slopes).sum())


def greedy(x, targets, weights, num, ridge):
    """The column that lowers the error most, again and again, every machine solved anew."""
    taken = []
    for _ in range(num):
        rest = [i for i in range(x.shape[1]) if i not in taken]
        errors = [penalised_error(x[:, [*taken, i]], targets, weights, ridge) for i in rest]
        taken.append(rest[int(np.argmin(errors))])
    return taken


@pytest.mark.parametrize("num_targets", [1, 3])
@pytest.mark.parametrize("ridge", [0.01, 1.0, 30.0])
def test_forward_selection_takes_what_lowers_the_error_of_the_ridge_machine_most(
    num_targets, ridge, rng
):
    """Of columns that repeat each other, on offsets, and of sizes that the ridge sees."""
    x = rng.standard_normal((50, 9)) * rng.uniform(0.3, 2, 9)
    x[:, 5:] = x[:, :4] + 0.3 * rng.standard_normal((50, 4))
    targets = x[:, :num_targets] + x[:, [5]] + rng.standard_normal((50, num_targets))
    x, weights = x + rng.uniform(-3, 3, 9), rng.uniform(0.1, 2.0, 50)
    given = map(torch.from_numpy, (x, targets, weights))
    expected = greedy(x, targets, weights, 6, ridge)
    assert forward_selection(*given, 6, ridge) == expected
    by_themselves = [penalised_error(x[:, [i]], targets, weights, ridge) for i in range(9)]
    assert expected != np.argsort(by_themselves)[:6].tolist()  # columns that repeat wait


def test_forward_selection_ends_where_nothing_is_left(rng):
    x = torch.zeros(30, 5, dtype=torch.float64)
    x[:, [1, 3]] = torch.from_numpy(rng.standard_normal((30, 2)))
    targets, weights = x[:, [1]] + 0.1 * x[:, [3]], torch.ones(30, dtype=torch.float64)
    assert forward_selection(x, targets, weights, 5) == [1, 3]
    assert forward_selection(x[:, [0, 2]], targets, weights, 5) == []
    assert sorted(forward_selection(x[:, [3, 1]], targets, weights, 9)) == [0, 1]


def test_bins_without_weight_decide_nothing_in_forward_selection(rng):
    """The first column explains some of the bins, the second the others."""
    x = torch.from_numpy(rng.standard_normal((40, 2)))
    targets = torch.cat([x[:20, [0]], 2 * x[20:, [1]]])
    for weight, best in ((0.0, 0), (1.0, 1)):
        weights = torch.cat([torch.ones(20), torch.full((20,), weight)]).double()
        assert forward_selection(x, targets, weights, 1) == [best]


# ------------------------------------------------------------------------------------- refusals
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
    (updated, [torch.zeros(5, 4)], r"\[N, 3\] and .*\(5, 4\) and \(5,\)"),
    (updated, [BINS, 4], r"\[N, 3\] and .*\(5, 3\) and \(4,\)"),
    (updated, [BINS, (5, 1)], r"\(5, 3\) and \(5, 1\)"),
    (updated, [BINS, ()], r"\(5, 3\) and \(\)"),
    (updated, [BINS.double()], r"float64; hand float32, as the data module does"),
    (updated, [BROKEN], "got nan in row 4, column 2"),
    *((rank_features, [ONES, num], rf"1\.\.3, got {num}") for num in (4, 0, -1)),
]


@pytest.mark.parametrize(("call", "arguments", "message"), REFUSED)
def test_what_cannot_be_ranked_is_named(call, arguments, message):
    with pytest.raises(ValueError, match=message):
        call(*arguments)
