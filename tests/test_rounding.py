"""The rounding bound of a quadratic form: exact arithmetic, any order of sums, and points."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from tactslip_torch.model.kernels import QuadraticForm, collapse
from tactslip_torch.model.rounding import rounding_bound, worst_error

KINDS = ["plain", "cancelling", "huge", "tiny", "mixed", "low rank", "flat", "fitted"]


def head_of(kind, num, rng):
    quadratic = rng.standard_normal((num, num))
    linear, constant = rng.standard_normal(num), rng.standard_normal()
    match kind:
        case "cancelling":  # at the corner of ones the large terms give next to nothing
            quadratic -= quadratic.mean(1, keepdims=True)
            linear, constant = 1e-6 * linear, 1e-6 * constant
        case "huge":
            quadratic, linear = 1e30 * quadratic, 1e30 * linear
        case "tiny":
            quadratic, linear, constant = 1e-42 * quadratic, 1e-44 * linear, 0.0
        case "mixed":
            quadratic *= 10.0 ** rng.uniform(-12, 6, (num, num))
        case "low rank":
            quadratic = np.outer(quadratic[0], quadratic[0])
        case "flat":
            quadratic = np.full((num, num), 0.1)
        case "fitted":
            support = torch.from_numpy(rng.uniform(-1, 1, (4 * num, num)))
            return collapse(support, torch.from_numpy(rng.standard_normal(4 * num)))
    quadratic = (quadratic + quadratic.T) / 2
    parts = torch.from_numpy(quadratic), torch.from_numpy(linear)
    return QuadraticForm(*parts, torch.tensor(constant, dtype=torch.float64))


def stored(head, dtype):
    return QuadraticForm(*(x.to(dtype) for x in (head.quadratic, head.linear, head.constant)))


def exact_score(head, z):
    point = [Fraction(value) for value in z]
    total = Fraction(float(head.constant))
    for value, slope, row in zip(point, head.linear.tolist(), head.quadratic.tolist(), strict=True):
        inner = sum((Fraction(q) * x for q, x in zip(row, point, strict=True)), Fraction(slope))
        total += value * inner
    return total


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num", [1, 12, 120])
def test_the_bound_is_above_the_worst_seen_and_exact_arithmetic_and_not_far(kind, num, rng):
    head = head_of(kind, num, rng)
    bounds = {dtype: rounding_bound(head, dtype) for dtype in (torch.float32, torch.float64)}
    seen = worst_error(head, seed=num)
    assert 0 <= seen <= sum(bounds.values()) < math.inf
    assert worst_error(head, seed=num) == seen
    if num == 120 and kind not in ("huge", "tiny", "mixed"):
        assert bounds[torch.float32] <= 1e4 * seen
    points = rng.choice([-1.0, 1.0, *rng.uniform(-1, 1, 20)], (30 if num < 120 else 0, num))
    for z in torch.from_numpy(points.astype(np.float32)):
        exact = exact_score(head, z.tolist())
        for dtype, bound in bounds.items():
            error = abs(Fraction(float(stored(head, dtype)(z.to(dtype)))) - exact)
            assert error <= Fraction(bound)


def test_what_overflows_and_what_is_nan():
    zero = torch.zeros(2).double()
    huge = QuadraticForm(torch.full((2, 2), 3e38).double(), zero, zero[0])
    assert rounding_bound(huge) == math.inf
    assert worst_error(huge) == math.inf
    assert rounding_bound(huge, torch.float64) < math.inf
    bad = QuadraticForm(torch.full((1, 1), math.nan), torch.zeros(1), torch.tensor(0.0))
    with pytest.raises(ValueError, match="a coefficient of the head is NaN"):
        rounding_bound(bad)
