import itertools

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from tactslip_torch.model.fourth_moments import (
    ProductSums,
    add_products_,
    from_grid,
    moment_vector,
    normal_matrix,
)


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


def quadratic_map(z, offset):
    """Squares and products row by row, then the features, then the constant."""
    num = z.shape[1]
    columns = [
        z[:, i] * z[:, j] * (1 if i == j else np.sqrt(2)) for i in range(num) for j in range(i, num)
    ]
    columns += [np.sqrt(2 * offset) * z[:, i] for i in range(num)]
    return np.stack([*columns, np.full(len(z), offset)], axis=1)


def sums_of(z, weights=None, grid_bits=None, sign=1):
    dtype = torch.float64 if grid_bits is None else torch.int64
    total = torch.zeros(ProductSums(z.shape[1]).num_held, dtype=dtype)
    weights = None if weights is None else torch.from_numpy(weights)
    add_products_(total, torch.from_numpy(z), weights, grid_bits, sign)
    return total


def bins(rng, num, num_features):
    return rng.uniform(-1, 1, (num, num_features))


@pytest.mark.parametrize("num_features", [1, 2, 7, 8, 15, 20])
def test_every_sum_is_held_and_few_twice(rng, num_features):
    # primes for features: every product of four is another number
    primes = [p for p in range(2, 80) if all(p % d for d in range(2, p))][:num_features]
    variables = [1, *primes]
    expected = {a * b * c * d for a, b, c, d in itertools.product(variables, repeat=4)}
    layout = ProductSums(num_features)
    total = sums_of(np.array([primes], dtype=np.float64))
    assert {int(value) for value in total} == expected
    assert layout.num_distinct == len(expected)
    assert total[0] == 1  # the sum of the weights


def test_few_sums_are_held_twice_at_the_papers_size():
    layout = ProductSums(120)
    assert layout.num_pairs == 7381
    assert layout.num_distinct < layout.num_held < 1.13 * layout.num_distinct


@given(
    num_features=st.integers(1, 18),
    num_bins=st.integers(0, 40),
    offset=st.sampled_from([0.0, 0.5, 3.0]),
    weighted=st.booleans(),
    grid_bits=st.sampled_from([None, 38]),
    seed=st.integers(0, 99),
    data=st.data(),
)
def test_normal_matrix_equals_the_plain_products(
    num_features, num_bins, offset, weighted, grid_bits, seed, data
):
    rng = np.random.default_rng(seed)
    z = bins(rng, num_bins, num_features)
    weights = rng.uniform(0.1, 5, num_bins) if weighted else None
    used = data.draw(st.integers(1, num_features))
    total = sums_of(z, weights, grid_bits)
    total = total if grid_bits is None else from_grid(total, grid_bits)
    x = quadratic_map(z[:, :used], offset)
    ones = np.ones(num_bins) if weights is None else weights
    matrix = normal_matrix(total, num_features, offset, used)
    moment = moment_vector(total, num_features, offset, used)
    assert (matrix.dtype, moment.dtype) == (torch.float64, torch.float64)
    tolerance = 1e-10 if grid_bits else 1e-12  # the grid's half step is 2e-12, times 2 or 9
    np.testing.assert_allclose(matrix.numpy(), (x.T * ones) @ x, rtol=1e-12, atol=tolerance)
    np.testing.assert_allclose(moment.numpy(), x.T @ ones, rtol=1e-12, atol=tolerance)
    assert torch.equal(matrix, matrix.mT)


@pytest.mark.parametrize("used", [None, 23, 32])
def test_normal_matrix_of_several_tiles_and_chunks(rng, used):
    # 703 and more pairs are several tiles of the mirror; 600 bins are three chunks
    z = bins(rng, 600, 36)
    total = sums_of(z)
    x = quadratic_map(z[:, :used], 0.5)
    matrix = normal_matrix(total, 36, 0.5, used)
    np.testing.assert_allclose(matrix.numpy(), x.T @ x, rtol=1e-11, atol=1e-10)
    assert torch.equal(matrix, matrix.mT)


def test_sums_on_a_grid_are_rounded_chunk_by_chunk_half_to_even():
    # sums of one feature and 1: w, w z, w z^2, w z^3, w z^4; products of powers of 2 are exact
    z = np.full((257, 1), 0.5)
    weights = np.zeros(257)
    weights[:2] = [3.0, 0.125]
    weights[256] = 1.5
    bits = 2
    exact = [[3.125 * 0.5**power, 1.5 * 0.5**power] for power in range(5)]
    expected = {float(sum(np.rint(np.array(terms) * 2**bits))) for terms in exact}
    assert {float(value) for value in sums_of(z, weights, bits)} == expected
    assert expected == {18.0, 9.0, 5.0, 3.0, 1.0}  # of 12.5 + 6, 6.25 + 3, 3.125 + 1.5, ..
    negative = {float(value) for value in sums_of(-z, weights, bits)}
    assert negative == {18.0, -9.0, 5.0, -3.0, 1.0}


@pytest.mark.parametrize("bits", [10, 38, 42])
def test_a_sum_on_a_grid_is_within_half_a_step(rng, bits):
    z = bins(rng, 250, 12)
    exact, rounded = sums_of(z), sums_of(z, grid_bits=bits)
    error = np.abs(from_grid(rounded, bits).numpy() - exact.numpy())
    assert error.max() <= 0.5 * 2.0**-bits + 1e-12


@given(num_bins=st.integers(0, 30), num_features=st.integers(1, 12), seed=st.integers(0, 99))
@example(num_bins=700, num_features=9, seed=0)
def test_what_was_put_in_is_taken_out_to_the_last_bit(num_bins, num_features, seed):
    rng = np.random.default_rng(seed)
    before = sums_of(bins(rng, 20, num_features), grid_bits=38)
    total = before.clone()
    z, weights = bins(rng, num_bins, num_features), rng.uniform(0, 3, num_bins)
    arguments = torch.from_numpy(z), torch.from_numpy(weights), 38
    add_products_(total, *arguments)
    assert num_bins == 0 or not torch.equal(total, before)
    add_products_(total, *arguments, sign=-1)
    assert torch.equal(total, before)


def test_float_sums_are_taken_out_as_well(rng):
    z = bins(rng, 40, 6)
    total = sums_of(z[:30])
    add_products_(total, torch.from_numpy(z[30:]))
    add_products_(total, torch.from_numpy(z[:30]), sign=-1)
    np.testing.assert_allclose(total.numpy(), sums_of(z[30:]).numpy(), atol=1e-13)


@pytest.mark.parametrize("grid_bits", [None, 38])
def test_bits_do_not_depend_on_the_number_of_threads(rng, grid_bits):
    z, weights = bins(rng, 530, 43), rng.uniform(0, 2, 530)
    one = sums_of(z, weights, grid_bits)
    total = one if grid_bits is None else from_grid(one, grid_bits)
    matrix = normal_matrix(total, 43)
    for number in (2, 3):
        torch.set_num_threads(number)
        assert torch.equal(sums_of(z, weights, grid_bits), one)
        assert torch.equal(normal_matrix(total, 43), matrix)


def test_layout_of_the_input_does_not_matter(rng):
    z = bins(rng, 300, 11)
    padded = np.zeros((300, 40))
    padded[:, 3:25:2] = z
    assert torch.equal(sums_of(np.asfortranarray(z), grid_bits=38), sums_of(z, grid_bits=38))
    assert torch.equal(sums_of(padded[:, 3:25:2], grid_bits=38), sums_of(z, grid_bits=38))


def refused(message, total, z, *arguments):
    before = total.clone()
    with pytest.raises(ValueError, match=message):
        add_products_(total, z, *arguments)
    assert torch.equal(total, before)


def test_sums_the_grid_has_no_room_for_are_refused_before_any_is_added(rng):
    z = torch.from_numpy(bins(rng, 700, 3))
    z[:, 0] = 1.0
    total = torch.arange(ProductSums(3).num_held)
    weights = torch.ones(700, dtype=torch.float64)
    weights[512:] = 2.0**13 / 188
    message = r"^188 bins from 512 on may sum to 8192, and this grid holds sums below 8192; "
    refused(message, total, z, weights, 38)
    add_products_(total, z, weights, 37)
    z[100] = 8.0  # 8^4 is half the room, and what stands beside it the rest
    refused("256 bins from 0 on may sum to 4351", total, z, None, 39)
    refused(
        "256 bins from 256 on may sum to nan",
        total,
        z,
        weights.index_fill(0, torch.tensor(300), torch.nan),
        30,
    )


def test_the_largest_sum_with_room_is_exact():
    total = sums_of(np.ones((1, 1)), np.array([2.0**13 - 2.0**-38]), 38)
    assert set(total.tolist()) == {2**51 - 1}
    total = sums_of(-np.ones((1, 1)), np.array([2.0**13 - 2.0**-38]), 38)
    assert set(total.tolist()) == {2**51 - 1, 1 - 2**51}


def test_what_does_not_fit_is_refused(rng):
    z = torch.from_numpy(bins(rng, 5, 3))
    total = torch.zeros(ProductSums(3).num_held, dtype=torch.float64)
    refused(r"sums of 3 features must be \d+ contiguous torch.int64, got", total, z, None, 38)
    refused(r"sums of 3 features must be \d+ contiguous torch.float64", total.long(), z)
    refused(r"sums of 2 features must be", total, z[:, :2])
    message = r"expected float64 z \[N, K\] and weights \[N\], got "
    refused(message + r"\(5, 3\) torch.float64 and \(4,\)", total, z, torch.ones(4).double())
    refused(message + r"\(1, 5, 3\)", total, z[None])
    refused(message + r"\(5, 3\) torch.float32", total, z.float())
    refused(message + r".* and \(5,\) torch.float32$", total, z, torch.ones(5))
    with pytest.raises(ValueError, match=r"use_features must be in 1..3, got 4"):
        normal_matrix(total, 3, 0.5, 4)
    with pytest.raises(ValueError, match=r"use_features must be in 1..3, got 0"):
        moment_vector(total, 3, 0.5, 0)
    with pytest.raises(ValueError, match=r"sums of 4 features must be"):
        normal_matrix(total, 4)
    with pytest.raises(ValueError, match="num_features must be 1 or more, got 0"):
        ProductSums(0)
