import math
import random

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.kernel_ridge import KernelRidge

from tactslip_torch.model.sufficient import FORMAT, SufficientStats
from tactslip_torch.runtime import load_table, save_table

NUM = 4
ABOUT = {"hand": {"name": "paper24", "channels": ["SG1", "PVDF1"]}, "scaler": "range"}


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


def make_batches(num=8, seed=0, num_features=NUM, most=12):
    """Name, features in [-1, 1], classes and weights; sizes from 0 on."""
    rng = np.random.default_rng(seed)
    batches = []
    for number in range(num):
        rows = slice(int(rng.integers(0, most)))
        z = torch.from_numpy(np.clip(rng.standard_normal((most, num_features)), -1, 1))
        is_slip = torch.from_numpy(rng.uniform(size=most) < 0.6)
        weights = torch.from_numpy(rng.uniform(0.1, 3, most))
        batches.append((f"M{number % 3}/{number}", z[rows], is_slip[rows], weights[rows]))
    return batches


def stats_of(batches, about=ABOUT, num_features=NUM):
    stats = SufficientStats(num_features, about)
    for batch in batches:
        stats.update(*batch)
    return stats


def bits_of(stats):
    return stats.sums.tolist(), stats.count.tolist(), dict(stats.ledger.entries), stats.about


def joined(batches):
    parts = [torch.cat([batch[i] for batch in batches]).numpy() for i in (1, 2, 3)]
    return parts[0], parts[1], parts[2]


def quadratic_map(z, offset):
    num = z.shape[1]
    columns = [
        z[:, i] * z[:, j] * (1 if i == j else np.sqrt(2)) for i in range(num) for j in range(i, num)
    ]
    columns += [np.sqrt(2 * offset) * z[:, i] for i in range(num)]
    return np.stack([*columns, np.full(len(z), offset)], axis=1)


def primal_scores(z, is_slip, weights, penalty, offset, at):
    """Scores at other bins, from explicit features and NumPy's solver."""
    x = quadratic_map(z, offset)
    system = (x.T * weights) @ x + np.eye(x.shape[1]) / penalty
    targets = np.where(is_slip, 1.0, -1.0)
    return quadratic_map(at, offset) @ np.linalg.solve(system, x.T @ (weights * targets))


def balanced(is_slip, weights):
    """Each class with half of the total weight."""
    out = weights.copy()
    for of in (is_slip, ~is_slip):
        out[of] *= weights.sum() / (2 * weights[of].sum())
    return out


def assert_relative(actual, expected, tolerance):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance * np.abs(expected).max())


# ------------------------------------------------------------------------------ what is summed
def test_sums_are_those_of_each_class_on_the_grid(rng):
    batches = make_batches(5)
    stats = stats_of(batches)
    z, is_slip, weights = joined(batches)
    assert stats.count.tolist() == [(~is_slip).sum(), is_slip.sum()]
    for label, total in enumerate(stats.sums):
        of = is_slip == bool(label)
        rows = np.c_[np.ones(of.sum()), z[of]]
        products = np.einsum("n,ni,nj,nk,nl->ijkl", weights[of], rows, rows, rows, rows)
        held = total.double().numpy() * 2.0**-38
        # every product is there, and nothing else; 5 batches are off by half a step each at most
        gap = np.abs(held[:, None] - products.reshape(1, -1))
        assert gap.min(axis=0).max() <= 5 * 2.0**-39 + 1e-13
        assert gap.min(axis=1).max() <= 5 * 2.0**-39 + 1e-13
        assert held[0] == pytest.approx(weights[of].sum(), abs=5 * 2.0**-39)
    expected = [weights[~is_slip].sum(), weights[is_slip].sum()]
    np.testing.assert_allclose(stats.weight.numpy(), expected, rtol=0, atol=5 * 2.0**-39)
    assert (stats.sums.dtype, stats.count.dtype) == (torch.int64, torch.int64)


def test_kinds_of_input_do_not_matter():
    name, z, is_slip, _ = make_batches(1, seed=3, most=40)[0]
    z = z.float()
    stats = stats_of([(name, z.double(), is_slip)])
    for features in (z, z.clone().requires_grad_(), z.mT.contiguous().mT):
        for labels in (is_slip, is_slip.long(), is_slip.float()):
            for weights in (None, torch.ones(len(z))):
                assert bits_of(stats_of([(name, features, labels, weights)])) == bits_of(stats)


# ---------------------------------------------------------------------- any order, any sharding
@given(
    seed=st.integers(0, 99),
    order=st.randoms(use_true_random=False),
    num_shards=st.integers(1, 5),
)
def test_any_order_and_sharding_gives_the_same_bits(seed, order, num_shards):
    batches = make_batches(seed=seed)
    whole = stats_of(batches)
    order.shuffle(batches)
    shards = [stats_of(batches[part::num_shards]) for part in range(num_shards)]
    while len(shards) > 1:  # any tree of merges
        order.shuffle(shards)
        other = shards.pop()
        shards[0].merge(other)
    assert bits_of(shards[0]) == bits_of(whole)


@given(seed=st.integers(0, 99), order=st.randoms(use_true_random=False), kept=st.integers(0, 8))
def test_batches_taken_out_leave_no_trace(seed, order, kept):
    batches = make_batches(seed=seed)
    order.shuffle(batches)
    stats = stats_of(batches)
    gone = batches[kept:]
    order.shuffle(gone)
    for batch in gone:
        stats.remove(*batch)
    assert bits_of(stats) == bits_of(stats_of(batches[:kept]))
    if gone:
        stats.update(*gone[0])
        assert bits_of(stats) == bits_of(stats_of([*batches[:kept], gone[0]]))


def test_bits_do_not_depend_on_the_number_of_threads():
    batches = make_batches(4, num_features=43, most=700)

    def made():
        stats = stats_of(batches, num_features=43)
        form = stats.solve(1.0)
        return [stats.sums, form.quadratic, form.linear, form.constant]

    one = made()
    for number in (2, 3):
        torch.set_num_threads(number)
        for a, b in zip(made(), one, strict=True):
            assert torch.equal(a, b)
        assert torch.get_num_threads() == number


# ----------------------------------------------------------------------------------- the solve
@given(
    penalty=st.sampled_from([0.01, 0.1, 1.0, 10.0]),
    offset=st.sampled_from([0.0, 0.5, 2.0]),
    balance=st.sampled_from(["weights", "none"]),
    used=st.sampled_from([None, 1, 3, 4]),
    seed=st.integers(0, 99),
)
def test_solve_equals_the_dual_and_the_primal(penalty, offset, balance, used, seed):
    rng = np.random.default_rng(seed)
    batches = make_batches(6, seed, most=20)
    two = torch.tensor([True, False])  # so that both classes are there
    batches += [("both", torch.rand(2, NUM).double(), two, torch.ones(2).double())]
    form = stats_of(batches).solve(penalty, offset, used, balance)
    z, is_slip, weights = joined(batches)
    z, at = z[:, :used], rng.uniform(-1, 1, (9, used or NUM))
    weights = balanced(is_slip, weights) if balance == "weights" else weights
    scores = form(torch.from_numpy(at)).numpy()
    gram = oracles.kernel(z, z, 2, offset)
    beta = oracles.kernel_elm(gram, np.where(is_slip, 1.0, -1.0), penalty, weights)
    assert_relative(scores, oracles.kernel(at, z, 2, offset) @ beta, 1e-9)
    assert_relative(scores, primal_scores(z, is_slip, weights, penalty, offset, at), 1e-9)
    assert form.num_features == (used or NUM)


def test_solve_equals_kernel_ridge(rng):
    z = rng.uniform(-1, 1, (600, 12))  # two chunks in each batch
    is_slip = (z[:, 0] * z[:, 1] + 0.3 * rng.standard_normal(600)) > 0.1
    weights = rng.uniform(0.5, 2, 600)
    stats = SufficientStats(12)
    for start in range(0, 600, 300):
        part = slice(start, start + 300)
        stats.update(str(start), *(torch.from_numpy(a[part]) for a in (z, is_slip, weights)))
    at = rng.uniform(-1, 1, (50, 12))
    for balance, of_bins in (("none", weights), ("weights", balanced(is_slip, weights))):
        ridge = KernelRidge(alpha=2.0, kernel="poly", degree=2, gamma=1, coef0=0.5)
        ridge.fit(z, np.where(is_slip, 1.0, -1.0), sample_weight=of_bins)
        form = stats.solve(0.5, balance=balance)
        assert_relative(form(torch.from_numpy(at)).numpy(), ridge.predict(at), 1e-9)


def test_solve_at_the_papers_size(rng):
    # 7381 unknowns, few bins: the dual is small
    z = np.clip(rng.standard_normal((150, 120)), -1, 1)
    is_slip = rng.uniform(size=150) < 0.7
    stats = SufficientStats(120)
    stats.update("one", torch.from_numpy(z), torch.from_numpy(is_slip))
    form = stats.solve(0.1, num_features=30)
    z = z[:, :30]
    gram, targets = oracles.kernel(z, z), np.where(is_slip, 1.0, -1.0)
    beta = oracles.kernel_elm(gram, targets, 0.1, balanced(is_slip, np.ones(150)))
    assert_relative(form(torch.from_numpy(z)).numpy(), gram @ beta, 1e-9)


def test_solve_leaves_the_sums_alone():
    stats = stats_of(make_batches())
    before = bits_of(stats)
    stats.solve(1.0)
    assert bits_of(stats) == before


def test_infinite_penalty_is_least_squares(rng):
    z = rng.uniform(-1, 1, (200, 3))
    is_slip = rng.uniform(size=200) < 0.5
    stats = SufficientStats(3)
    stats.update("one", torch.from_numpy(z), torch.from_numpy(is_slip))
    x = quadratic_map(z, 0.5)
    expected = x @ np.linalg.lstsq(x, np.where(is_slip, 1.0, -1.0), rcond=None)[0]
    form = stats.solve(math.inf, balance="none")
    assert_relative(form(torch.from_numpy(z)).numpy(), expected, 1e-9)


def test_one_class_is_not_enough():
    name, z, _, weights = make_batches(1, seed=3)[0]
    everything, nothing = torch.ones(len(z)).bool(), torch.zeros(len(z)).bool()
    for labels, missing in ((everything, "non-slip"), (nothing, "slip")):
        stats = stats_of([(name, z, labels, weights)])
        with pytest.raises(ValueError, match=f"^there is no {missing} bin in these sums; add .*$"):
            stats.solve(1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"penalty": 0.0}, r"penalty \(the paper's C\) must be positive, got 0.0"),
        ({"penalty": math.nan}, "must be positive, got nan"),
        ({"penalty": 1.0, "offset": -0.5}, r"offset \(the kernel's c\) must be 0 or more"),
        ({"penalty": 1.0, "offset": math.nan}, r"offset \(the kernel's c\) must be 0 or more"),
        ({"penalty": 1.0, "num_features": 5}, "use_features must be in 1..4, got 5"),
        ({"penalty": 1.0, "num_features": 0}, "use_features must be in 1..4, got 0"),
        ({"penalty": 1.0, "balance": "undersample"}, "balance must be 'weights' or 'none', got"),
    ],
)
def test_solve_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        stats_of(make_batches(1, seed=3)).solve(**arguments)


def test_a_system_that_is_not_positive_definite_is_refused():
    stats = stats_of(make_batches(1, seed=3))
    stats.sums[:, 1] = 2 * stats.sums[:, 0]  # a feature of mean 2 whose square has mean 1 at most
    with pytest.raises(
        ValueError, match=r"^X'WX \+ I/C at penalty=100: .* not positive definite at row \d+ .*$"
    ):
        stats.solve(100.0)


# ------------------------------------------------------------------------- refused, unchanged
def with_value(z, value):
    z = z.clone()
    z[5, 2] = value
    return z


BATCH = ("b", torch.rand(9, NUM).double(), torch.arange(9) % 2 == 0, torch.ones(9).double())


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (1, with_value(BATCH[1], torch.nan), r"z must be within \[-1, 1\], got nan at bin 5, fe"),
        (1, with_value(BATCH[1], torch.inf), r"got inf at bin 5, feature 2; scale it and clip"),
        (1, with_value(BATCH[1], -1.0001), r"got -1.0001 at bin 5, feature 2"),
        (3, torch.ones(9).index_fill(0, torch.tensor(4), 0.0), "positive, got 0 at bin 4"),
        (3, torch.ones(9).index_fill(0, torch.tensor(4), torch.nan), "positive, got nan at bin 4"),
        (3, torch.ones(9).index_fill(0, torch.tensor(4), torch.inf), "may sum to inf"),
        (3, torch.ones(9).index_fill(0, torch.tensor(3), 9e3), "4 bins .* may sum to 9003"),
        (3, torch.ones(9).index_fill(0, torch.tensor(4), 9e3), "5 bins .* may sum to 9004"),
        (1, BATCH[1][:, :3], r"expected z \[N, 4\], .* got \(9, 3\), \(9,\), \(9,\)"),
        (1, BATCH[1][None], r"expected z \[N, 4\], .* got \(1, 9, 4\), \(9,\), \(9,\)"),
        (2, BATCH[2][:8], r"expected z \[N, 4\], .* got \(9, 4\), \(8,\), \(9,\)"),
        (3, BATCH[3][:, None], r"expected z \[N, 4\], .* got \(9, 4\), \(9,\), \(9, 1\)"),
    ],
)
def test_a_batch_that_is_refused_changes_nothing(place, value, message):
    stats = stats_of([("a", *BATCH[1:])])
    before = bits_of(stats)
    batch = list(BATCH)
    batch[place] = value
    with pytest.raises(ValueError, match=rf"^batch 'b': .*{message}"):
        stats.update(*batch)
    assert bits_of(stats) == before


def test_a_batch_is_added_once_and_taken_out_as_it_was():
    stats = stats_of([BATCH])
    before = bits_of(stats)
    name, z, is_slip, weights = BATCH
    with pytest.raises(ValueError, match="batch 'b' is in these statistics already; add it once"):
        stats.update(name, z / 2, is_slip)
    with pytest.raises(ValueError, match="batch 'a' was never added"):
        stats.remove("a", z, is_slip, weights)
    for other in (
        (z.flip(0), is_slip, weights),
        (z, ~is_slip, weights),
        (z, is_slip, weights * 2),
        (z[:8], is_slip[:8], weights[:8]),
    ):
        with pytest.raises(ValueError, match="batch 'b' was added with other content"):
            stats.remove(name, *other)
    assert bits_of(stats) == before
    stats.remove(*BATCH)
    with pytest.raises(ValueError, match="batch 'b' was never added"):
        stats.remove(*BATCH)
    assert bits_of(stats) == bits_of(SufficientStats(NUM, ABOUT))


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (SufficientStats(3, ABOUT), "num_features: 4 and 3"),
        (SufficientStats(NUM, ABOUT, grid_bits=30), "grid_bits: 38 and 30"),
        (SufficientStats(NUM), "about.hand: .* and nothing"),
        (
            SufficientStats(NUM, ABOUT | {"scaler": "quantile"}),
            'about.scaler: "range" and "quantile"',
        ),
        (
            SufficientStats(NUM, ABOUT | {"hand": {"name": "paper24", "channels": ["SG1", "SG2"]}}),
            'about.hand.channels.1: "PVDF1" and "SG2"',
        ),
        (
            SufficientStats(NUM, ABOUT | {"names": ["x" * 99]}),
            r"about.names: nothing and \[\"x+\.+",
        ),
        (stats_of(make_batches()), "8 batches are in both statistics, such as 'M0/0'"),
    ],
)
def test_sums_that_do_not_merge_stay_as_they_are(other, message):
    stats = stats_of(make_batches())
    before, other_before = bits_of(stats), bits_of(other)
    with pytest.raises(ValueError, match=message):
        stats.merge(other)
    assert bits_of(stats) == before
    assert bits_of(other) == other_before


def test_sums_without_room_are_refused():
    def full(grid_bits=38):
        stats = SufficientStats(1, grid_bits=grid_bits)
        stats.sums[1] = 2**62 - 2 * 2**grid_bits  # room for two more slip bins
        return stats

    z, is_slip = torch.ones(4, 1), torch.tensor([True, True, False, False])
    three = torch.tensor([True, True, True, False])
    stats = full()
    stats.update("a", z, is_slip)
    assert stats.sums[1].max() == 2**62
    message = "^16777217 slip bins are too many: with grid_bits=38 sums have room for 16777216 of"
    stats = full()
    before = bits_of(stats)
    with pytest.raises(ValueError, match=message):
        stats.update("a", z, three)
    other = SufficientStats(1)
    other.update("a", z, three)
    with pytest.raises(ValueError, match=message):
        stats.merge(other)
    with pytest.raises(ValueError, match=message):
        other.merge(stats)
    assert bits_of(stats) == before
    with pytest.raises(ValueError, match="room for 2097152 of weight 1 in each class; take fewer"):
        full(41).update("a", z, three)


@pytest.mark.parametrize("grid_bits", [-1, 43])
def test_a_grid_without_room_for_a_batch_is_refused(grid_bits):
    with pytest.raises(ValueError, match=f"grid_bits must be in 0..42, got {grid_bits}"):
        SufficientStats(2, grid_bits=grid_bits)
    finest = SufficientStats(2, grid_bits=42)
    finest.update("a", torch.ones(600, 2), torch.arange(600) < 300)
    assert finest.weight.tolist() == [300, 300]


def test_about_is_what_json_holds():
    assert SufficientStats(2, {"window": (51, 11)}).about == {"window": [51, 11]}
    for about in ({"a": object()}, {"a": math.nan}):
        with pytest.raises(ValueError, match="about must be what JSON holds"):
            SufficientStats(2, about)


# -------------------------------------------------------------------------------------- files
def test_a_file_gives_the_same_sums_back(tmp_path):
    batches = make_batches()
    stats = stats_of(batches)
    stats.save(tmp_path / "a.stats")
    loaded = SufficientStats.load(tmp_path / "a.stats")
    assert bits_of(loaded) == bits_of(stats)
    assert (loaded.num_features, loaded.grid_bits) == (NUM, 38)
    loaded.remove(*batches[0])  # and is worked with as before
    loaded.merge(stats_of(batches[:1]))
    loaded.save(tmp_path / "b.stats")
    assert (tmp_path / "b.stats").read_bytes() == (tmp_path / "a.stats").read_bytes()
    random.Random(0).shuffle(batches)
    stats_of(batches).save(tmp_path / "c.stats")
    assert (tmp_path / "c.stats").read_bytes() == (tmp_path / "a.stats").read_bytes()


def test_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "a.stats"
    stats_of(make_batches()).save(path)
    whole = path.read_bytes()
    for content in (whole[:-1], whole[: len(whole) // 2], b"", b"text"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a.stats is damaged"):
            SufficientStats.load(path)
    place = whole.index(b"M0/0")
    path.write_bytes(whole[:place] + b"M9" + whole[place + 2 :])
    with pytest.raises(ValueError, match=r"a.stats is damaged"):
        SufficientStats.load(path)
    with pytest.raises(FileNotFoundError, match="no file at"):
        SufficientStats.load(tmp_path / "b.stats")


def test_a_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "a.stats"
    stats = stats_of(make_batches())
    stats.save(path)
    facts, tensors = load_table(path, FORMAT)
    save_table(path, "another 1", facts, tensors)
    with pytest.raises(ValueError, match=rf"must be of format '{FORMAT}', got 'another 1'"):
        SufficientStats.load(path)
