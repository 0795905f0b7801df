"""Sums over training bins: what they hold, that they add, and the machines solved from them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.kernel_ridge import KernelRidge

from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.package_files import SUMS, load_table, save_table

NUM = 4


def make_batches(num=8, seed=0, most=12):
    """Name, features in [-1, 1], classes and weights; sizes from 0 on."""
    rng = np.random.default_rng(seed)
    batches = []
    for number in range(num):
        size = int(rng.integers(0, most))
        z = torch.from_numpy(np.clip(rng.standard_normal((size, NUM)), -1, 1))
        is_slip = torch.from_numpy(rng.uniform(size=size) < 0.6)
        weights = torch.from_numpy(rng.uniform(0.1, 3, size))
        batches.append((f"M{number % 3}/{number}", z, is_slip, weights))
    return batches


def stats_of(batches, degree=2):
    stats = SufficientStats(NUM, degree)
    for batch in batches:
        stats.update(*batch)
    return stats


def assert_same(one, other):
    torch.testing.assert_close(one.sums, other.sums, rtol=1e-12, atol=1e-12)
    assert torch.equal(one.count, other.count)
    assert one.seen_batches == other.seen_batches


# Sums in any order ----------------------------------------------------------------------------


@settings(max_examples=20)
@given(
    seed=st.integers(0, 99),
    order=st.randoms(use_true_random=False),
    num_shards=st.integers(1, 5),
    degree=st.sampled_from([1, 2]),
)
def test_any_order_and_sharding_gives_the_same_sums(seed, order, num_shards, degree):
    batches = make_batches(seed=seed)
    whole = stats_of(batches, degree=degree)
    order.shuffle(batches)
    shards = [stats_of(batches[part::num_shards], degree=degree) for part in range(num_shards)]
    while len(shards) > 1:  # any tree of merges
        order.shuffle(shards)
        other = shards.pop()
        shards[0].merge(other)
    assert_same(shards[0], whole)


@pytest.mark.parametrize("degree", [1, 2])
def test_sums_come_back_from_their_file(degree, tmp_path):
    stats = stats_of(make_batches(), degree=degree)
    stats.save(tmp_path / "sums.pt")
    again = SufficientStats.load(tmp_path / "sums.pt")
    assert_same(again, stats)
    assert torch.equal(again.sums, stats.sums)
    again.merge(stats_of([BATCH], degree=degree))
    assert load_table(tmp_path / "sums.pt", SUMS)[0]["degree"] == degree
    save_table(tmp_path / "other.pt", "tactslip_torch sums 1", {}, {})
    with pytest.raises(ValueError, match=r"made by version 0\.2\.0 or earlier"):
        SufficientStats.load(tmp_path / "other.pt")
    save_table(
        tmp_path / "other.pt",
        SUMS,
        {"num_features": 3, "degree": 1, "batches": []},
        {"sums": stats.sums},
    )
    with pytest.raises(
        ValueError, match=r"other\.pt is damaged: sums must be torch\.float64 of shape"
    ):
        SufficientStats.load(tmp_path / "other.pt")
    with pytest.raises(FileNotFoundError):
        SufficientStats.load(tmp_path / "nothing.pt")


@pytest.mark.parametrize("balance", ["weights", "none"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("penalty", "offset"), [(0.01, 0.5), (10.0, 0.0)])
def test_the_machine_is_that_of_scikit_learn(penalty, offset, degree, balance, rng):
    batches = make_batches(6, 1, most=20)
    stats = stats_of(batches, degree=degree)
    before = stats.sums.clone()
    form = stats.solve(penalty, offset, balance)
    assert torch.equal(stats.sums, before)
    z, is_slip, weights = (torch.cat(parts) for parts in list(zip(*batches, strict=True))[1:])
    if balance == "weights":  # each class has half of the total
        total = weights.sum() / 2
        for own in (is_slip, ~is_slip):
            weights[own] *= total / weights[own].sum()
    ridge = KernelRidge(alpha=1 / penalty, kernel="poly", degree=degree, gamma=1, coef0=offset)
    ridge.fit(z, np.where(is_slip, 1.0, -1.0), sample_weight=weights.numpy())
    at = rng.uniform(-1, 1, (9, NUM))
    expected = ridge.predict(at)
    actual = form(torch.from_numpy(at)).numpy()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


# Refusals -------------------------------------------------------------------------------------


def with_value(z, value):
    z = z.clone()
    z[5, 2] = value
    return z


BATCH = ("b", torch.rand(9, NUM).double(), torch.arange(9) % 2 == 0, torch.ones(9).double())


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (1, with_value(BATCH[1], torch.nan), r"z must be within \[-1, 1\], got nan at bin 5, fe"),
        (3, torch.ones(9).index_fill(0, torch.tensor(4), 0.0), "finite, got 0 at bin 4"),
        (0, "a", "is in these statistics already; add it once"),
        (1, BATCH[1][:, :3], r"expected z \[N, 4\], .* got \(9, 3\), \(9,\), \(9,\)"),
    ],
)
def test_a_batch_that_is_refused_changes_nothing(place, value, message):
    stats = stats_of([("a", *BATCH[1:])])
    batch = list(BATCH)
    batch[place] = value
    with pytest.raises(ValueError, match=rf"^batch '{batch[0]}':? .*{message}"):
        stats.update(*batch)
    assert_same(stats, stats_of([("a", *BATCH[1:])]))


def test_sums_that_do_not_merge_stay_as_they_are():
    stats = stats_of(make_batches())
    for other, message in (
        (SufficientStats(3), "num_features: 4 and 3"),
        (SufficientStats(NUM, 1), "degree: 2 and 1"),
        (stats, "8 batches are in both statistics, such as 'M0/0'"),
    ):
        with pytest.raises(ValueError, match=message):
            stats.merge(other)
        assert_same(stats, stats_of(make_batches()))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"penalty": 0.0}, r"penalty \(the paper's C\) must be positive"),
        (
            {"penalty": 1.0, "offset": -0.5},
            r"offset \(the paper's c\) must be finite and at least 0",
        ),
        ({"penalty": 1.0, "balance": "undersample"}, "balance must be 'weights' or 'none', got"),
    ],
)
def test_solve_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        stats_of(make_batches()).solve(**arguments)


def test_one_class_is_not_enough_and_neither_is_no_feature():
    stats = stats_of([("a", BATCH[1], torch.ones(9).bool(), BATCH[3])])
    with pytest.raises(ValueError, match=r"^there is no non-slip bin in these sums; add .*$"):
        stats.solve(1.0)
    with pytest.raises(ValueError, match="1 feature or more and degree 1 or 2, got 0 and 2"):
        SufficientStats(0)
