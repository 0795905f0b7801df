import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from tactslip_torch.model.cholesky import (
    cholesky_,
    cholesky_solve,
    forward_solve,
    from_above,
    mirror_,
    refine,
    symmetric_product,
)


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


def definite(rng, num, dtype=np.float64):
    x = rng.standard_normal((num, num + 5))
    return (x @ x.T / num + np.eye(num)).astype(dtype)


def lower_of(factor):
    return np.tril(factor.numpy())


# 384 and 256 are the edges of panels and tiles, 512 of bands
@given(num=st.integers(1, 120), seed=st.integers(0, 99))
@example(num=384, seed=0)
@example(num=385, seed=0)
@example(num=640, seed=0)
@example(num=641, seed=0)
@example(num=1100, seed=0)
def test_factor_equals_lapacks(num, seed):
    matrix = definite(np.random.default_rng(seed), num)
    factor = torch.from_numpy(matrix.copy())
    cholesky_(factor)
    expected = scipy.linalg.cholesky(matrix, lower=True)
    np.testing.assert_allclose(lower_of(factor), expected, rtol=1e-12, atol=1e-12)


def test_what_stands_above_the_diagonal_does_not_matter_and_stays(rng):
    matrix = definite(rng, 900)
    right = torch.from_numpy(rng.standard_normal((900, 3)))
    whole, half = torch.from_numpy(matrix.copy()), torch.from_numpy(matrix.copy())
    above = torch.ones(900, 900, dtype=torch.bool).triu_(1)
    half[above] = torch.nan
    cholesky_(whole)
    cholesky_(half)
    assert torch.equal(whole.tril(), half.tril())
    assert half[above].isnan().all()
    assert torch.equal(whole[above], torch.from_numpy(matrix)[above])
    assert torch.equal(forward_solve(half, right), forward_solve(whole, right))
    assert torch.equal(cholesky_solve(half, right), cholesky_solve(whole, right))


def test_factor_in_a_larger_storage(rng):
    # a row-major view, as factor[o:, o:] is
    matrix = definite(rng, 450)
    storage = torch.zeros(460, 470, dtype=torch.float64)
    view = storage[7:457, 11:461]
    view.copy_(torch.from_numpy(matrix))
    cholesky_(view)
    expected = scipy.linalg.cholesky(matrix, lower=True)
    np.testing.assert_allclose(lower_of(view), expected, rtol=1e-12, atol=1e-12)
    assert storage[:7].count_nonzero() == 0
    assert storage[:, :11].count_nonzero() == 0
    assert storage[457:].count_nonzero() == 0
    assert storage[:, 461:].count_nonzero() == 0


@pytest.mark.parametrize("num_right", [0, 1, 2, 6, 257, 600])
@pytest.mark.parametrize("num", [1, 40, 512, 513, 1100])
def test_solves_equal_scipys(rng, num, num_right):
    factor = np.tril(rng.standard_normal((num, num)) / num) + np.eye(num)
    right = rng.standard_normal((num, num_right))
    given_right = torch.from_numpy(right.copy())
    half = forward_solve(torch.from_numpy(factor), given_right)
    whole = cholesky_solve(torch.from_numpy(factor), given_right)
    assert half.shape == whole.shape == (num, num_right)
    if num_right:
        np.testing.assert_allclose(
            half.numpy(), scipy.linalg.solve_triangular(factor, right, lower=True), atol=1e-11
        )
        expected = scipy.linalg.cho_solve((factor, True), right)
        np.testing.assert_allclose(whole.numpy(), expected, atol=1e-11)
    assert np.array_equal(given_right.numpy(), right)


def test_one_right_hand_side_may_be_a_vector(rng):
    factor = torch.from_numpy(np.tril(rng.standard_normal((600, 600)) / 600) + np.eye(600))
    right = torch.from_numpy(rng.standard_normal(600))
    one = cholesky_solve(factor, right)
    assert one.shape == (600,)
    np.testing.assert_allclose(one.numpy(), cholesky_solve(factor, right[:, None])[:, 0].numpy())


def test_solves_with_a_corner_of_a_factor(rng):
    factor = torch.from_numpy(np.tril(rng.standard_normal((700, 700)) / 700) + np.eye(700))
    right = torch.from_numpy(rng.standard_normal((640, 5)))
    corner = factor[60:, 60:]
    np.testing.assert_allclose(
        forward_solve(corner, right).numpy(),
        scipy.linalg.solve_triangular(corner.numpy(), right.numpy(), lower=True),
        atol=1e-11,
    )
    strided = torch.from_numpy(rng.standard_normal((5, 640))).mT
    np.testing.assert_allclose(
        cholesky_solve(corner, strided).numpy(),
        scipy.linalg.cho_solve((corner.numpy(), True), strided.numpy()),
        atol=1e-11,
    )


def test_bits_do_not_depend_on_the_number_of_threads(rng):
    matrix = torch.from_numpy(definite(rng, 1300))
    few = torch.from_numpy(rng.standard_normal((1300, 3)))
    many = torch.from_numpy(rng.standard_normal((1300, 300)))

    def everything():
        factor = matrix.clone()
        cholesky_(factor)
        return [
            factor,
            *(solve(factor, b) for solve in (forward_solve, cholesky_solve) for b in (few, many)),
        ]

    one = everything()
    for number in (2, 3, 4):
        torch.set_num_threads(number)
        for a, b in zip(everything(), one, strict=True):
            assert torch.equal(a, b)
        assert torch.get_num_threads() == number


def test_single_precision(rng):
    matrix = definite(rng, 500, np.float32)
    right = torch.from_numpy(rng.standard_normal(500).astype(np.float32))
    factor = torch.from_numpy(matrix.copy())
    cholesky_(factor)
    solved = cholesky_solve(factor, right)
    assert (factor.dtype, solved.dtype) == (torch.float32, torch.float32)
    expected = np.linalg.solve(matrix.astype(np.float64), right.numpy())
    np.testing.assert_allclose(solved.numpy(), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("row", [0, 17, 383, 384, 600])
def test_the_row_that_is_not_positive_is_named(rng, row, number):
    torch.set_num_threads(number)
    matrix = torch.from_numpy(definite(rng, 650))
    matrix[row, row] = -1e6
    with pytest.raises(ValueError, match=rf"^matrix is not positive definite at row {row} .*\w+"):
        cholesky_(matrix)


def test_a_number_that_is_none_is_no_positive_definite_matrix(rng):
    matrix = torch.from_numpy(definite(rng, 50))
    matrix[30, 20] = torch.nan
    with pytest.raises(ValueError, match="not positive definite"):
        cholesky_(matrix)


def test_works_in_inference_mode(rng):
    torch.set_num_threads(2)
    matrix = definite(rng, 700)
    with torch.inference_mode():
        factor = torch.from_numpy(matrix.copy())
        cholesky_(factor)
    expected = scipy.linalg.cholesky(matrix, lower=True)
    np.testing.assert_allclose(lower_of(factor), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (torch.zeros(3, 4), r"matrix must be \[n, n\] and row-major, got \(3, 4\)"),
        (torch.eye(4).expand(2, 4, 4), r"matrix must be \[n, n\]"),
        (torch.randn(4, 4).mT, r"row-major, got \(4, 4\) with strides \(1, 4\)"),
        (torch.eye(4, dtype=torch.int64), "matrix must be floating, got torch.int64"),
    ],
)
def test_what_is_no_matrix_is_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        cholesky_(matrix)


@pytest.mark.parametrize("solve", [forward_solve, cholesky_solve])
def test_right_hand_sides_that_do_not_fit_are_refused(solve):
    for right in (torch.zeros(5, 2), torch.zeros(4, 2, dtype=torch.float64), torch.zeros(1, 4, 2)):
        with pytest.raises(ValueError, match=r"right must have 4 rows of torch.float32"):
            solve(torch.eye(4), right)
    with pytest.raises(ValueError, match="factor must be"):
        solve(torch.zeros(4, 3), torch.zeros(4, 1))


# The system above its factor -----------------------------------------------------------------


@pytest.mark.parametrize("num", [1, 2, 255, 256, 257, 600])
def test_a_system_comes_back_from_above_its_factor(rng, num):
    matrix = definite(rng, num)
    half = torch.from_numpy(np.where(np.tri(num, dtype=bool), matrix, np.nan))
    mirror_(half)
    assert np.array_equal(half.numpy(), matrix)
    vector = rng.standard_normal(num)
    diagonal = half.diagonal().clone()
    cholesky_(half)
    product = symmetric_product(half, diagonal, torch.from_numpy(vector))
    np.testing.assert_allclose(product.numpy(), matrix @ vector, rtol=1e-12, atol=1e-12)
    from_above(half)
    half.diagonal().copy_(diagonal)
    assert np.array_equal(half.numpy(), matrix)


@pytest.mark.parametrize("num", [5, 600])
def test_refinement_solves_the_system_and_not_its_neighbour(rng, num):
    matrix, right = definite(rng, num), rng.standard_normal(num)
    system = torch.from_numpy(matrix.copy())
    diagonal = system.diagonal().clone()
    system.diagonal().mul_(1.01)
    cholesky_(system)
    far = cholesky_solve(system, torch.from_numpy(right)).numpy()
    x, steps, error = refine(system, diagonal, torch.from_numpy(right))
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(x.numpy(), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert np.abs(far - expected).max() > 1e-4 * np.abs(expected).max()
    assert 3 <= steps <= 10
    assert error <= 1e-10
    zero = refine(system, diagonal, torch.zeros(num, dtype=torch.float64))
    assert (zero[0].abs().max(), zero[1:]) == (0, (0, 0.0))


def test_refinement_stops_where_it_leads_nowhere(rng):
    """A neighbour that is far from the system: the error is told."""
    matrix, right = definite(rng, 20), torch.from_numpy(rng.standard_normal(20))
    system = torch.from_numpy(matrix.copy())
    diagonal = system.diagonal().clone()
    system.diagonal().mul_(30)
    cholesky_(system)
    _, steps, error = refine(system, diagonal, right)
    assert steps <= 20
    assert error > 1e-2
