import itertools
import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.selection import ClassMoments, rank_features, t_scores

VARIANCES = ["pooled", "welch"]


def draw(rng, num_bins=80, num_features=12, share=0.3):
    labels = (rng.uniform(size=num_bins) < share).astype(int)
    labels[:4] = 0, 0, 1, 1
    features = rng.standard_normal((num_bins, num_features)) * 10.0 ** rng.integers(-3, 4, 12)
    features += labels[:, None] * rng.uniform(-1, 1, num_features) * features.std(0)
    return features, labels


def moments_of(features, labels):
    moments = ClassMoments(features.shape[1])
    moments.update(torch.as_tensor(features), torch.as_tensor(labels))
    return moments


def assert_same(actual, expected):
    """Up to rounding: means of size s are known to eps s, which moves a sum of n squared
    deviations Q by up to 2 eps s sqrt(n Q) when parts are put together."""
    assert torch.equal(actual.count, expected.count)
    size = expected.mean.abs().amax(0) + expected.sum_sq_dev.sqrt()
    assert ((actual.mean - expected.mean).abs() <= 1e-14 * size).all()
    count = expected.count.sum()
    rounding = 20 * oracles.EPS * size * (expected.sum_sq_dev * count).sqrt()
    error = (actual.sum_sq_dev - expected.sum_sq_dev).abs()
    assert (error <= 1e-12 * expected.sum_sq_dev + rounding).all()


@pytest.mark.parametrize("as_type", [torch.long, torch.bool, torch.float64])
def test_moments_equal_numpy(as_type, rng):
    features, labels = draw(rng)
    moments = moments_of(features, torch.from_numpy(labels).to(as_type))
    for label in (0, 1):
        of_class = features[labels == label]
        assert moments.count[label] == len(of_class)
        np.testing.assert_allclose(moments.mean[label], of_class.mean(0), rtol=1e-12, atol=1e-12)
        expected = of_class.var(0) * len(of_class)
        np.testing.assert_allclose(moments.sum_sq_dev[label], expected, rtol=1e-12)
    assert moments.mean.dtype == moments.sum_sq_dev.dtype == torch.float64


@pytest.mark.parametrize("variance", VARIANCES)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.8])
def test_scores_equal_scipy(variance, share, rng):
    features, labels = draw(rng, share=share)
    actual = t_scores(moments_of(features, labels), variance)
    expected = oracles.t_scores(features, labels, variance)
    np.testing.assert_allclose(actual, expected, rtol=1e-10)


def test_the_default_is_pooled_and_both_agree_on_balanced_classes(rng):
    features, _ = draw(rng)
    moments = moments_of(features, np.arange(80) < 30)
    assert torch.equal(t_scores(moments), t_scores(moments, "pooled"))
    assert ((t_scores(moments, "welch") - t_scores(moments)).abs() > 1e-6).any()
    balanced = moments_of(features, np.arange(80) % 2)
    torch.testing.assert_close(t_scores(balanced, "welch"), t_scores(balanced), rtol=1e-12, atol=0)


@pytest.mark.parametrize("variance", VARIANCES)
def test_scores_do_not_depend_on_unit_or_offset(variance, rng):
    features, labels = draw(rng)
    before = t_scores(moments_of(features / features.std(0), labels), variance)
    after = t_scores(moments_of(1e5 - 3 * features / features.std(0), labels), variance)
    torch.testing.assert_close(after, before, rtol=1e-8, atol=1e-8)


@given(
    cuts=st.lists(st.integers(0, 80), max_size=6),
    order=st.randoms(use_true_random=False),
    seed=st.integers(0, 20),
    offset=st.sampled_from([0.0, 1e6]),
)
def test_merged_parts_equal_the_whole_in_any_split_and_order(cuts, order, seed, offset):
    features, labels = draw(np.random.default_rng(seed))
    features = features + offset
    edges = [0, *sorted(cuts), 80]
    parts = [moments_of(features[a:b], labels[a:b]) for a, b in itertools.pairwise(edges)]
    whole = moments_of(features, labels)
    order.shuffle(parts)
    assert_same(ClassMoments.merged(parts), whole)
    updated = ClassMoments(12)
    for a, b in itertools.pairwise(edges):
        updated.update(torch.from_numpy(features[a:b]), torch.from_numpy(labels[a:b]))
    assert_same(updated, whole)


def test_merge_is_a_tree_as_well_as_a_chain_and_changes_neither_part(rng):
    features, labels = draw(rng)
    a, b, c, d = (moments_of(features[i::4], labels[i::4]) for i in range(4))
    means = [part.mean.clone() for part in (a, b, c, d)]
    assert_same(a.merge(b).merge(c.merge(d)), moments_of(features, labels))
    assert_same(d.merge(a).merge(c).merge(b), moments_of(features, labels))
    for part, mean in zip((a, b, c, d), means, strict=True):
        assert torch.equal(part.mean, mean)


def test_moments_do_not_cancel_on_a_large_offset(rng):
    features = 1e6 + 1e-3 * rng.standard_normal((50, 3))
    labels = np.arange(50) % 2
    expected = oracles.t_scores(features - 1e6, labels)
    np.testing.assert_allclose(t_scores(moments_of(features, labels)), expected, rtol=1e-5)


def test_float32_features_are_gathered_in_float64(rng):
    features, labels = draw(rng)
    moments = moments_of(features.astype(np.float32), labels)
    assert_same(moments, moments_of(features.astype(np.float32).astype(np.float64), labels))


@pytest.mark.parametrize("variance", VARIANCES)
def test_a_feature_that_never_moves(variance):
    labels = torch.tensor([0, 0, 0, 1, 1])
    features = torch.zeros(5, 3, dtype=torch.float64)
    features[:, 1] = 7.0
    features[3:, 2] = 1.0
    assert t_scores(moments_of(features, labels), variance).tolist() == [0, 0, math.inf]


@pytest.mark.parametrize("variance", VARIANCES)
@pytest.mark.parametrize("level", [0.1, 1 / 3, 2.736, -1e-3, 1e17 / 7])
@pytest.mark.parametrize("num_parts", [1, 7])
def test_a_constant_of_any_value_never_outranks_a_feature(variance, level, num_parts, rng):
    """A dead channel's features are equal in every bin, whatever the rounding of their mean."""
    features = torch.full((701, 1), level, dtype=torch.float64)
    labels = torch.from_numpy(rng.uniform(size=701) < 0.3)
    parts = [moments_of(features[i::num_parts], labels[i::num_parts]) for i in range(num_parts)]
    assert t_scores(ClassMoments.merged(parts), variance).tolist() == [0]


@pytest.mark.parametrize("variance", VARIANCES)
def test_a_nan_feature_has_a_nan_score_and_spoils_no_other(variance, rng):
    features, labels = draw(rng)
    clean = t_scores(moments_of(features, labels), variance)
    features[5, 3] = math.nan
    scores = t_scores(moments_of(features, labels), variance)
    assert scores[3].isnan()
    others = [i for i in range(12) if i != 3]
    torch.testing.assert_close(scores[others], clean[others], rtol=1e-12, atol=0)


@given(
    scores=st.lists(
        st.sampled_from([0.0, 1.0, 2.5, math.inf, math.nan]) | st.floats(0, 9), min_size=1
    ),
    data=st.data(),
)
def test_ranking_is_by_score_then_index_with_nan_last(scores, data):
    num = data.draw(st.integers(1, len(scores)))
    numbers = [i for i, score in enumerate(scores) if not math.isnan(score)]
    missing = [i for i, score in enumerate(scores) if math.isnan(score)]
    expected = (sorted(numbers, key=lambda i: (-scores[i], i)) + missing)[:num]
    ranked = rank_features(torch.tensor(scores, dtype=torch.float64), num)
    assert ranked.dtype == torch.long
    assert ranked.tolist() == expected


def test_errors():
    one_class = moments_of(torch.randn(5, 3), torch.ones(5, dtype=torch.long))
    with pytest.raises(ValueError, match="no non-slip bin"):
        t_scores(one_class)
    with pytest.raises(ValueError, match="no slip bin"):
        t_scores(moments_of(torch.randn(5, 3), torch.zeros(5, dtype=torch.long)))
    both = moments_of(torch.randn(5, 3), torch.tensor([0, 1, 0, 1, 1]))
    with pytest.raises(ValueError, match="'pooled' or 'welch', got 'student'"):
        t_scores(both, "student")
    for num in (4, 0, -1):
        with pytest.raises(ValueError, match=rf"1\.\.3, got {num}"):
            rank_features(torch.zeros(3), num)
    with pytest.raises(ValueError, match=r"5, 3.*\(5, 4\)"):
        ClassMoments(3).update(torch.zeros(5, 4), torch.zeros(5))
    with pytest.raises(ValueError, match="3 and 4 features"):
        ClassMoments(3).merge(ClassMoments(4))
    with pytest.raises(ValueError, match="no moments"):
        ClassMoments.merged([])
