import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.features.exact_sums import MOST_ROWS, ExactSums

LARGEST = float(np.finfo(np.float32).max)
SMALLEST = float(np.finfo(np.float32).smallest_subnormal)
any_float32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
tables = st.lists(st.tuples(any_float32, any_float32, st.booleans()), max_size=12)


def exact(values):
    """Sum, mean and squared deviations in rational numbers, each rounded once."""
    values = [Fraction(value) for value in values]
    total = sum(values, Fraction(0))
    mean = total / max(len(values), 1)
    return [float(total), float(mean), float(sum((v - mean) ** 2 for v in values))]


def split(table):
    values = torch.tensor([row[:2] for row in table], dtype=torch.float32).reshape(-1, 2)
    return values, torch.tensor([row[2] for row in table], dtype=torch.bool)


def sums_of(values, of_class=None, num_classes=2):
    sums = ExactSums(values.shape[1], num_classes)
    sums.update(values, of_class)
    return sums


def is_same(a, b):
    a, b = a.state_dict(), b.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@given(table=tables)
def test_totals_are_the_exact_ones_rounded_once(table):
    values, of_class = split(table)
    sums = sums_of(values, of_class)
    totals = sums.totals()
    assert sums.count.tolist() == [len(values) - of_class.sum(), of_class.sum()]
    for label in (0, 1):
        for column in (0, 1):
            expected = exact(values[of_class == bool(label), column].tolist())
            assert [part[label, column].item() for part in totals] == expected
    assert all(part.dtype == torch.float64 for part in totals)


def test_a_recording_of_bins_equals_rational_numbers(rng):
    """More rows than a chunk, and as many columns as make chunks of few rows."""
    values = rng.standard_normal((200, 700)) * 10.0 ** rng.integers(-9, 9, 700)
    values = torch.from_numpy(values.astype(np.float32))
    of_class = torch.from_numpy(rng.uniform(size=200) < 0.7)
    totals = sums_of(values, of_class).totals()
    for label in (False, True):
        for column in rng.choice(700, 20, replace=False):
            expected = exact(values[of_class == label, column].tolist())
            assert [part[int(label), column].item() for part in totals] == expected


def test_sums_that_floats_would_lose():
    values = torch.tensor([[LARGEST], [SMALLEST], [1.0], [-1.0], [-LARGEST]])
    totals = sums_of(values, num_classes=1).totals()
    assert totals.sum.item() == SMALLEST
    shifted = torch.tensor([[1e6], [1e6 + 0.0625], [1e6 - 0.0625]])
    assert sums_of(shifted, num_classes=1).totals().sum_sq_dev.item() == 2 * 0.0625**2


@pytest.mark.parametrize("level", [0.0, -0.0, 0.1, -1 / 3, LARGEST, SMALLEST, 1e-40])
def test_a_constant_has_no_spread(level):
    values = torch.full((701, 1), level)
    totals = sums_of(values, torch.arange(701) % 3, num_classes=4).totals()
    assert totals.sum_sq_dev.tolist() == [[0.0]] * 4
    assert totals.mean[:3].tolist() == [[values[0, 0].item()]] * 3
    assert totals.mean[3].item() == 0


@given(table=tables, order=st.randoms(use_true_random=False), num_shards=st.integers(1, 4))
def test_any_order_and_sharding_gives_the_same_bits(table, order, num_shards):
    whole = sums_of(*split(table))
    order.shuffle(table)
    shards = [sums_of(*split(table[i::num_shards])) for i in range(num_shards)]
    order.shuffle(shards)
    merged = ExactSums(2, 2)
    for shard in shards:
        merged.merge(shard)
    assert is_same(merged, whole)
    one_by_one = ExactSums(2, 2)
    for row in table:
        one_by_one.update(*split([row]))
    assert is_same(one_by_one, whole)
    assert is_same(ExactSums.from_state_dict(whole.state_dict()), whole)
    for shard in range(num_shards - 1):
        merged.remove(*split(table[shard::num_shards]))
    assert is_same(merged, sums_of(*split(table[num_shards - 1 :: num_shards])))


def test_merge_changes_the_left_side_alone(rng):
    values = torch.from_numpy(rng.standard_normal((6, 2)).astype(np.float32))
    a, b = sums_of(values[:3]), sums_of(values[3:])
    before = sums_of(values[3:])
    a.merge(b)
    a.update(values)
    assert is_same(b, before)


def test_the_state_is_compact_and_apart_from_the_sums():
    sums = sums_of(torch.tensor([[1.0, 0.0], [2.0, 0.0]]))
    state = sums.state_dict()
    assert state["words"].shape == (3, 1)  # 0 fills no bucket, 1 and 2 share one
    again = ExactSums.from_state_dict(state)
    sums.update(torch.ones(1, 2))
    again.update(torch.ones(1, 2))
    assert is_same(sums, again)
    assert state["count"].tolist() == [2, 0]
    assert torch.equal(state["words"], sums_of(torch.tensor([[1.0], [2.0]])).state_dict()["words"])


def test_no_word_of_one_row_is_too_large_for_as_many_rows_as_promised(rng):
    values = torch.from_numpy(rng.uniform(0.5, 300, (1, 5000)).astype(np.float32))
    words = sums_of(torch.cat([values, torch.full((1, 1), -LARGEST)], dim=1)).words
    assert int(words.abs().max()) * MOST_ROWS < 2**63


def test_as_many_rows_as_promised_and_no_more():
    """Doubled 32 times, with the integers that fill a word most."""
    ends = [LARGEST, -LARGEST, float.fromhex("0x1.fffffep+1"), SMALLEST]
    sums = sums_of(torch.tensor([ends]))
    for _ in range(32):
        sums.merge(ExactSums.from_state_dict(sums.state_dict()))
    assert sums.count.tolist() == [MOST_ROWS, 0]
    totals = sums.totals()
    assert totals.mean[0].tolist() == ends
    assert totals.sum[0].tolist() == [end * MOST_ROWS for end in ends]
    assert totals.sum_sq_dev[0].tolist() == [0, 0, 0, 0]
    before = ExactSums.from_state_dict(sums.state_dict())
    with pytest.raises(ValueError, match="at most 4294967296 rows of a class, got 4294967297"):
        sums.update(torch.ones(1, 4))
    with pytest.raises(ValueError, match="got 4294967297"):
        sums.merge(sums_of(torch.ones(1, 4)))
    assert is_same(sums, before)
    sums.update(torch.ones(1, 4), torch.ones(1))


def test_the_processor_may_flush_what_lies_below_the_normal_range():
    values = torch.tensor([[1e-40, -1e-44], [3e-39, 1.0]])
    expected = sums_of(values)
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor cannot flush")
    try:
        flushed = sums_of(values)
    finally:
        torch.set_flush_denormal(False)
    assert is_same(flushed, expected)


def test_layout_and_gradients_of_the_input_do_not_matter(rng, device):
    values = torch.from_numpy(rng.standard_normal((6, 4)).astype(np.float32))
    strided = torch.stack([values, values + 1], dim=-1)[..., 0].to(device).requires_grad_()
    of_class = torch.tensor([0, 1, 1, 0, 1, 0])
    assert is_same(sums_of(strided, of_class.to(device)), sums_of(values, of_class))
    assert is_same(sums_of(values, of_class.bool()), sums_of(values, of_class))
    assert is_same(sums_of(values.T.contiguous().T, of_class), sums_of(values, of_class))


def test_nothing_is_an_empty_sum():
    sums = sums_of(torch.zeros(0, 3))
    assert is_same(sums, ExactSums(3, 2))
    assert [part.tolist() for part in sums.totals()] == [[[0.0] * 3] * 2] * 3
    assert is_same(ExactSums.from_state_dict(sums.state_dict()), sums)
    assert ExactSums(0, 2).totals().mean.shape == (2, 0)


@pytest.mark.parametrize(
    ("values", "of_class", "match"),
    [
        (torch.zeros(2, 3).double(), None, r"float32 values, got torch\.float64.*\.float\(\)"),
        (torch.zeros(2, 4), None, r"\[N, 3\], got \(2, 4\)"),
        (torch.zeros(3), None, r"\[N, 3\], got \(3,\)"),
        (torch.tensor([[0, 0, 0], [0, math.nan, 0]]), None, "got nan in row 1, column 1"),
        (torch.tensor([[0, 0, 0], [0, 0, -math.inf]]), None, "got -inf in row 1, column 2"),
        (torch.tensor([[0, math.inf, 0], [0, 0, 0]]), None, "got inf in row 0, column 1"),
        (torch.zeros(2, 3), torch.zeros(3), r"classes of 2 rows, got \(3,\)"),
        (torch.zeros(2, 3), torch.tensor([0, 2]), r"0\.\.1, got 0\.\.2"),
        (torch.zeros(2, 3), torch.tensor([-1, 0]), r"0\.\.1, got -1\.\.0"),
    ],
)
def test_what_is_refused_changes_nothing(values, of_class, match):
    sums = sums_of(torch.tensor([[1.0, -2.0, 3.0], [0.0, 1e-9, 4.0]]))
    before = ExactSums.from_state_dict(sums.state_dict())
    for change in (sums.update, sums.remove):
        with pytest.raises(ValueError, match=match) as error:
            change(values, of_class)
        assert "\n" not in str(error.value)
    assert is_same(sums, before)


def test_errors_of_merge_and_remove():
    sums = sums_of(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    before = ExactSums.from_state_dict(sums.state_dict())
    for other in (ExactSums(3, 2), ExactSums(2, 1)):
        with pytest.raises(ValueError, match=r"\[2, 2\] and \[\d, \d\] classes and columns"):
            sums.merge(other)
    for rows in (torch.tensor([[1.0, 1e9]]), torch.tensor([[1.0, 2.5]]), torch.zeros(3, 2)):
        with pytest.raises(ValueError, match="never added"):
            sums.remove(rows)
    assert is_same(sums, before)
