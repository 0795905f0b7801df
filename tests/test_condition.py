import json
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.model.cholesky import cholesky_
from tactslip_torch.model.condition import (
    SolveReport,
    inverse_growth,
    inverse_norm,
    scaled_norm,
)

SPECTRA = ("geometric", "arithmetic", "one small", "one large", "two clusters")


def spectrum(kind: str, num: int, condition: float) -> np.ndarray:
    if kind == "geometric":
        return np.geomspace(1 / condition, 1, num)
    if kind == "arithmetic":
        return np.linspace(1 / condition, 1, num)
    values = np.ones(num)
    if kind == "one small":
        values[0] = 1 / condition
    elif kind == "one large":
        values[1:] /= condition
    else:
        values[: num // 2] /= condition
    return values


def matrix_of(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    basis = np.linalg.qr(rng.standard_normal((len(values), len(values))))[0]
    matrix = (basis * values) @ basis.T
    return (matrix + matrix.T) / 2


def factor_of(matrix: np.ndarray) -> torch.Tensor:
    factor = torch.from_numpy(matrix.copy())
    cholesky_(factor)
    return factor


@given(
    kind=st.sampled_from(SPECTRA),
    num=st.integers(1, 60),
    decades=st.sampled_from([0, 2, 6, 10, 12]),
    graded=st.booleans(),
    seed=st.integers(0, 9),
)
def test_condition_is_numpys_within_a_factor(kind, num, decades, graded, seed):
    """Never above it (but for rounding), and at least a third of it."""
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-8, 8, num) if graded else np.ones(num)
    plain = matrix_of(rng, spectrum(kind, max(num, 2), 10.0**decades)[-num:])
    matrix = plain * scale * scale[:, None]
    factor, turned = factor_of(matrix), torch.from_numpy(scale)
    estimate = scaled_norm(torch.from_numpy(matrix), turned) * inverse_norm(factor, turned)
    expected = np.linalg.cond(plain, 1)
    slack = 1 + 1e-14 * num * expected
    assert expected / 3 / slack <= estimate <= expected * slack
    quick = scaled_norm(torch.from_numpy(matrix), turned) * inverse_norm(factor, turned, 1)
    assert expected / 10 / slack <= quick <= expected * slack


@pytest.mark.parametrize("num", [1, 2, 255, 256, 257, 512, 513, 900])
def test_norm_is_numpys(num, rng):
    matrix = rng.standard_normal((num, num))
    matrix += matrix.T
    scale = 10.0 ** rng.uniform(-3, 3, num)
    half = torch.from_numpy(matrix.copy())
    half[torch.ones(num, num, dtype=torch.bool).triu_(1)] = torch.nan
    expected = np.abs(matrix / scale / scale[:, None]).sum(0).max()
    assert scaled_norm(half, torch.from_numpy(scale)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [(0, 0), (299, 0), (299, 299), (40, 39), (298, 260)])
def test_norm_shows_what_is_not_finite(place, bad):
    matrix = torch.eye(300, dtype=torch.float64)
    matrix[place] = bad
    assert not math.isfinite(scaled_norm(matrix, torch.ones(300, dtype=torch.float64)))


@pytest.mark.parametrize("kind", SPECTRA)
@pytest.mark.parametrize("decades", [0, 3, 8])
def test_growth_is_a_lower_bound_of_the_inverse(kind, decades, rng):
    """The solution is that of any right-hand side; of a random one it is nearly the bound."""
    scale = 10.0 ** rng.uniform(-2, 2, 50)
    plain = matrix_of(rng, spectrum(kind, 50, 10.0**decades))
    factor, right = factor_of(plain * scale * scale[:, None]), rng.standard_normal(50) * scale
    solution = torch.from_numpy(np.linalg.solve(plain * scale * scale[:, None], right))
    expected = 1 / np.linalg.eigvalsh(plain)[0]
    found = inverse_growth(factor, torch.from_numpy(scale), solution)
    assert expected / 2.5 <= found <= expected * (1 + 1e-6)
    assert inverse_growth(factor, torch.from_numpy(scale), 0 * solution) == 0.0


def test_numbers_do_not_depend_on_the_number_of_threads(rng):
    matrix = matrix_of(rng, np.geomspace(1e-6, 1, 700))
    factor, whole = factor_of(matrix), torch.from_numpy(matrix)
    scale, solution = whole.diagonal().sqrt(), torch.from_numpy(rng.standard_normal(700))
    found = []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            growth = inverse_growth(factor, scale, solution)
            found.append((scaled_norm(whole, scale), inverse_norm(factor, scale), growth))
    finally:
        torch.set_num_threads(1)
    assert found[0] == found[1] == found[2]


def test_a_report_is_what_json_holds_and_a_line():
    report = SolveReport("eigen", "float64", 40, math.inf, math.nan, None, 12, 0.5)
    text = json.dumps(report.facts(), allow_nan=False)
    assert json.loads(text)["penalty"] == "inf"
    assert json.loads(text)["condition"] == "nan"
    assert json.loads(text)["condition_bound"] is None
    assert "\n" not in str(report)
    assert "12 of them kept" in str(report)
    refined = SolveReport("jittered", "float64", 9, 1e12, 1e13, 1e14, 9, 1e-8, 1e-8, 3, 1e-12)
    assert "3 refinements" in str(refined)
    assert pickle.loads(pickle.dumps(refined)) == refined
