import json
import logging

import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_, cholesky_solve
from tactslip_torch.model.condition import SolveReport
from tactslip_torch.model.symmetric_solve import solve_symmetric_


@pytest.fixture(autouse=True)
def _one_thread_again():
    yield
    torch.set_num_threads(1)


def with_spectrum(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    basis = np.linalg.qr(rng.standard_normal((len(values), len(values))))[0]
    matrix = (basis * values) @ basis.T
    return (matrix + matrix.T) / 2


def singular(rng: np.random.Generator, num: int, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """A Gram matrix of lower rank, and a right-hand side in its span."""
    x = rng.standard_normal((num, rank))
    return x @ x.T, x @ rng.standard_normal(rank)


def lower(matrix: np.ndarray) -> Tensor:
    """Nothing sensible above the diagonal."""
    half = torch.from_numpy(matrix.copy())
    half[torch.ones_like(half, dtype=torch.bool).triu_(1)] = torch.nan
    return half


def tensors(*arrays: np.ndarray) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(array.copy()) for array in arrays)


def close(actual: Tensor, expected: np.ndarray, tolerance: float) -> None:
    assert actual.shape == expected.shape
    assert np.abs(actual.numpy() - expected).max() <= tolerance * np.abs(expected).max()


# A well-posed answer stays as it is ----------------------------------------------------------


@pytest.mark.parametrize(
    ("num", "decades"), [(1, 0), (2, 10), (40, 0), (40, 6), (40, 10), (390, 10), (650, 6)]
)
@pytest.mark.parametrize("weighted", [False, True])
def test_the_bits_are_those_of_a_plain_cholesky(num, decades, weighted, rng):
    matrix = with_spectrum(rng, np.geomspace(10.0**-decades, 1, num))
    right, weights = tensors(rng.standard_normal(num), 10.0 ** rng.uniform(-3, 3, num))
    penalty = 1e13
    plain = torch.from_numpy(matrix.copy())
    plain.diagonal().add_(1 / (penalty * weights) if weighted else 1 / penalty)
    cholesky_(plain)
    given = lower(matrix)
    x, report = solve_symmetric_(given, right, penalty, weights if weighted else None)
    assert torch.equal(x, cholesky_solve(plain, right))
    assert torch.equal(given.tril(), plain.tril())
    assert (report.method, report.rank, report.size) == ("cholesky", num, num)
    if not weighted:
        condition = np.linalg.cond(matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix))))
        assert condition / 4 <= report.condition <= condition * np.sqrt(num) * 1.01
        assert report.error == pytest.approx(2.0**-52 * report.condition)
    assert report.condition <= report.condition_bound


def test_units_of_the_unknowns_cost_nothing(rng):
    """Twelve decades of them: the condition is that of the matrix scaled to ones."""
    matrix, units = with_spectrum(rng, np.geomspace(0.01, 1, 30)), 10.0 ** rng.uniform(-6, 6, 30)
    graded = matrix * units * units[:, None]
    assert np.linalg.cond(graded) > 1e20
    right = units * rng.standard_normal(30)
    x, report = solve_symmetric_(lower(graded), torch.from_numpy(right), 1e30)
    assert (report.method, report.condition < 1e4) == ("cholesky", True)
    expected = np.linalg.solve(matrix, right / units)
    close(x * torch.from_numpy(units), expected, 1e-12)


# Rungs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("restored", [False, True])
@pytest.mark.parametrize("num", [12, 300])
def test_a_consistent_system_is_refined_behind_a_jittered_factor(num, restored, rng, caplog):
    matrix, right = singular(rng, num, num // 3)
    given = lower(matrix)

    def restore(spoilt: Tensor) -> None:
        spoilt.copy_(torch.where(torch.ones_like(spoilt).tril() > 0, lower(matrix), spoilt))

    with caplog.at_level(logging.WARNING):
        x, report = solve_symmetric_(
            given, torch.from_numpy(right), 1e15, name="gram", restore=restore if restored else None
        )
    assert (report.method, report.rank) == ("jittered", num)
    assert 1 <= report.refinements <= 6
    assert report.residual < 1e-9
    close(x, np.linalg.pinv(matrix, rcond=1e-12, hermitian=True) @ right, 10 * report.error)
    close(torch.from_numpy(matrix) @ x, right, 1e-9)
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
    assert "gram + I/C at penalty=1e+15" in caplog.messages[0]
    assert str(report) in caplog.messages[1]


@pytest.mark.parametrize("penalty", [1e13, 1e20, 1e300, np.inf])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("num", [12, 300])
def test_what_is_null_is_left_out(num, weighted, penalty, rng):
    """Targets outside the span would fill the solution with rounding times C."""
    matrix = singular(rng, num, num // 3)[0]
    right = rng.choice([-1.0, 1.0], num)
    weights = 10.0 ** rng.uniform(-2, 2, num) if weighted else np.ones(num)
    root = np.sqrt(weights)
    x, report = solve_symmetric_(lower(matrix), *tensors(right), penalty, *tensors(weights))
    assert (report.method, report.rank) == ("eigen", num // 3)
    across = root[:, None] * matrix * root
    expected = root * (np.linalg.pinv(across, rcond=1e-12, hermitian=True) @ (root * right))
    close(x, expected, 1e-9)
    values = np.linalg.eigvalsh(across)[-(num // 3) :]
    assert report.condition == pytest.approx(values[-1] / values[0], rel=1e-6)
    assert (report.condition_bound is None) == np.isinf(penalty)


def test_the_ridge_stays_where_components_are_left_out(rng):
    """With eigenvalues near 1 / C, those that are not null shrink as they should."""
    values = np.r_[np.zeros(6), np.geomspace(1e-10, 100, 6)]
    matrix, right = with_spectrum(rng, values), rng.choice([-1.0, 1.0], 12)
    x, report = solve_symmetric_(lower(matrix), torch.from_numpy(right), 1e11)
    assert (report.method, report.rank) == ("eigen", 6)
    eigenvalues, vectors = np.linalg.eigh(matrix)
    shares = np.where(eigenvalues > 1e-11, eigenvalues / (eigenvalues + 1e-11), 0)
    scores = vectors @ (shares * (vectors.T @ right))
    close(torch.from_numpy(matrix) @ x, scores, 1e-4)
    assert abs(shares[6] - 1) > 0.01


def test_a_penalty_near_the_largest_number_is_as_good_as_infinite(rng):
    """More of the ridge overflowed, and a machine of zeros reported no error."""
    matrix, right = singular(rng, 12, 4)
    x, report = solve_symmetric_(lower(matrix), torch.from_numpy(right), 1e308)
    assert (report.method, report.rank) == ("eigen", 4)
    close(x, np.linalg.pinv(matrix, rcond=1e-12, hermitian=True) @ right, 1e-9)


def test_what_is_left_out_is_stated(rng):
    """An eigenvalue a of rounding's size adds a C / (1 + a C) of its share; null ones say so."""
    values = np.r_[2e-16, np.geomspace(0.1, 1, 7)]
    matrix, right = with_spectrum(rng, values), rng.choice([-1.0, 1.0], 8)
    report = solve_symmetric_(lower(matrix), torch.from_numpy(right), 2e13).report
    share = np.linalg.eigh(matrix)[1][:, 0] @ right
    assert abs(share) * 4e-3 / 1.004 / np.sqrt(8) <= report.left_out <= 0.1
    assert report.error == report.left_out
    assert str(report).endswith("unless what is left out is null")


@pytest.mark.parametrize("num", [40, 600])
@pytest.mark.parametrize("rung", ["cholesky", "jittered", "eigen"])
def test_bits_do_not_depend_on_the_number_of_threads(rung, num, rng):
    matrix, right = singular(rng, num, num // 3)
    penalty = 1.0 if rung == "cholesky" else 1e15
    if rung == "eigen":
        right = rng.choice([-1.0, 1.0], num)
    found = []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        found.append(solve_symmetric_(lower(matrix), torch.from_numpy(right), penalty))
    assert found[0].report.method == rung
    for x, report in found[1:]:
        assert torch.equal(x, found[0].x)
        assert report == found[0].report


@pytest.mark.parametrize("penalty", [1e-12, 1.0, 1e12, np.inf])
def test_nothing_in_is_nothing_out(penalty):
    zeros = torch.zeros(5, 5, dtype=torch.float64)
    ones = torch.ones(5, dtype=torch.float64)
    x, report = solve_symmetric_(zeros.clone(), ones, penalty)
    assert torch.equal(x, ones * (0 if np.isinf(penalty) else penalty))
    assert solve_symmetric_(torch.eye(5).double(), 0 * ones, penalty).x.tolist() == [0.0] * 5
    assert solve_symmetric_(ones.expand(5, 5).clone(), 0 * ones, 1e20).x.tolist() == [0.0] * 5
    json.dumps(report.facts(), allow_nan=False)


# Refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("penalty", [1.0, np.inf])
def test_a_number_that_is_none_is_named(penalty, rng):
    matrix, right = singular(rng, 300, 300)
    for bad in (np.nan, np.inf):
        spoilt = matrix.copy()
        spoilt[270, 3] = bad
        with pytest.raises(
            ValueError, match=rf"^gram must be finite, got {bad} at \[270, 3\]; leave"
        ):
            solve_symmetric_(
                torch.from_numpy(spoilt), torch.from_numpy(right), penalty, name="gram"
            )
    right[7] = np.nan
    with pytest.raises(ValueError, match=r"^right-hand side of gram must be .* nan at \[7\]"):
        solve_symmetric_(*tensors(matrix, right), penalty, name="gram")
    apart = np.array([[1e-300, 1e300], [1e300, 1e-300]])
    with pytest.raises(ValueError, match="overflows float64; scale the features"):
        solve_symmetric_(*tensors(apart, np.ones(2)), np.inf)


@pytest.mark.parametrize("penalty", [1e3, np.inf])
def test_what_is_no_sum_of_squares_is_refused(penalty, rng):
    matrix = with_spectrum(rng, np.r_[-0.5, np.ones(9)])
    with pytest.raises(
        ValueError, match=r"not positive semi-definite: .* eigenvalue -0.5 beside 1;"
    ):
        solve_symmetric_(*tensors(matrix, np.ones(10)), penalty)


@pytest.mark.parametrize("penalty", [0.0, -1.0, np.nan, 1e-320])
def test_a_penalty_without_a_ridge_is_refused(penalty):
    with pytest.raises(ValueError, match=rf"positive, and so large .*, got {penalty}"):
        solve_symmetric_(torch.eye(2).double(), torch.ones(2).double(), penalty)


def test_a_spectrum_that_runs_into_rounding_is_refused(rng):
    matrix, right = with_spectrum(rng, np.geomspace(1e-20, 1, 40)), rng.standard_normal(40)
    with pytest.raises(ValueError, match=r"rank \d+ of 40 and a condition of \d\.\de\+1[345]"):
        solve_symmetric_(*tensors(matrix, right), np.inf)


def test_a_caller_may_refuse_all_but_cholesky(rng):
    matrix, right = with_spectrum(rng, np.geomspace(1e-6, 1, 40)), rng.standard_normal(40)
    arguments = {"penalty": 1e9, "name": "gram"}
    solve_symmetric_(*tensors(matrix, right), **arguments, most_condition=1e8)
    with pytest.raises(
        ValueError, match=r"^gram \+ I/C at penalty=1e\+09 has condition .*to 1e\+04;"
    ):
        solve_symmetric_(*tensors(matrix, right), **arguments, most_condition=1e4)
    matrix, right = singular(rng, 40, 9)
    with pytest.raises(ValueError, match=r"not positive definite at row .*wanted up to 1e\+10;"):
        solve_symmetric_(*tensors(matrix, right), penalty=1e30, most_condition=1e10)


def test_errors_of_the_matrix_are_followed(rng):
    """Noise of 1e-9 beside eigenvalues from 1e-4: a part of 1e-5. Beside 1e-7 it is too much."""
    right = rng.standard_normal(40)
    for least, penalty, told in ((1e-4, 1e20, True), (1e-7, 1e20, False), (1e-7, 1e4, True)):
        matrix = with_spectrum(rng, np.geomspace(least, 1, 40))
        if told:
            report = solve_symmetric_(*tensors(matrix, right), penalty, noise=1e-9).report
            assert 1e-9 / (least + 1 / penalty) / 100 <= report.error <= 1e-3
            continue
        with pytest.raises(ValueError, match="too much for its error of 1e-09; lower the penalty"):
            solve_symmetric_(*tensors(matrix, right), penalty, noise=1e-9)
        with pytest.raises(
            ValueError, match=r"rank 40 of 40 .* too much for the error it came with"
        ):
            solve_symmetric_(*tensors(matrix, right), np.inf, noise=1e-9)
    with pytest.raises(ValueError, match=r"rank 12 of 40 and .* make it exactly"):
        solve_symmetric_(*tensors(singular(rng, 40, 12)[0], right), np.inf, noise=1e-9)


def test_single_precision_is_solved_in_double_or_refused(rng):
    right = rng.standard_normal(30).astype(np.float32)
    matrix = with_spectrum(rng, np.geomspace(1e-2, 1, 30)).astype(np.float32)
    for penalty in (10.0, np.inf):
        x, report = solve_symmetric_(*tensors(matrix, right), penalty)
        assert (x.dtype, report.dtype) == (torch.float32, "float32")
        assert report.error == pytest.approx(2.0**-23 * report.condition)
        system = matrix.astype(np.float64) + np.eye(30) / penalty
        close(x.double(), np.linalg.solve(system, right), 2.0**-22)
    steep = with_spectrum(rng, np.geomspace(1e-7, 1, 30)).astype(np.float32)
    for penalty in (1e6, np.inf):
        with pytest.raises(ValueError, match=r"condition .*float32"):
            solve_symmetric_(*tensors(steep, right), penalty)
    assert isinstance(solve_symmetric_(*tensors(steep, right), 10.0).report, SolveReport)
