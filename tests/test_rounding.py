"""``model/rounding.py``: the bound against exact arithmetic, any order of sums, and a search."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from tactslip_torch.model import rounding
from tactslip_torch.model.kernels import QuadraticForm, collapse
from tactslip_torch.model.rounding import gamma, rounding_bound, worst_error

U = Fraction(1, 2**24)
TINY = Fraction(2) ** -126
SIZES = [1, 2, 3, 5, 17, 60, 120, 300]
KINDS = ["plain", "cancelling", "huge", "tiny", "mixed", "low rank", "flat", "fitted"]


def head_of(kind: str, num: int, rng: np.random.Generator) -> QuadraticForm:
    quadratic = rng.standard_normal((num, num))
    linear, constant = rng.standard_normal(num), rng.standard_normal()
    if kind == "cancelling":  # at the corner of ones the large terms give next to nothing
        quadratic -= quadratic.mean(1, keepdims=True)
        linear, constant = 1e-6 * linear, 1e-6 * constant
    if kind == "huge":
        quadratic, linear = 1e30 * quadratic, 1e30 * linear
    if kind == "tiny":
        quadratic, linear, constant = 1e-42 * quadratic, 1e-44 * linear, 0.0
    if kind == "mixed":
        quadratic *= 10.0 ** rng.uniform(-12, 6, (num, num))
    if kind == "low rank":
        vector = rng.standard_normal(num)
        quadratic = np.outer(vector, vector)
    if kind == "flat":
        quadratic = np.full((num, num), 0.1)
    if kind == "fitted":
        support = torch.from_numpy(rng.uniform(-1, 1, (4 * num, num)))
        return collapse(support, torch.from_numpy(rng.standard_normal(4 * num)))
    quadratic = (quadratic + quadratic.T) / 2
    return QuadraticForm(
        torch.from_numpy(quadratic),
        torch.from_numpy(linear),
        torch.tensor(constant, dtype=torch.float64),
    )


def stored(head: QuadraticForm, dtype: torch.dtype) -> QuadraticForm:
    return QuadraticForm(head.quadratic.to(dtype), head.linear.to(dtype), head.constant.to(dtype))


def exact_score(head: QuadraticForm, z: list[float]) -> Fraction:
    point = [Fraction(value) for value in z]
    total = Fraction(float(head.constant))
    for value, slope, row in zip(point, head.linear.tolist(), head.quadratic.tolist(), strict=True):
        inner = sum((Fraction(q) * x for q, x in zip(row, point, strict=True)), Fraction(slope))
        total += value * inner
    return total


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num", SIZES)
def test_the_bound_is_at_least_the_worst_that_a_search_finds(kind, num, rng):
    head = head_of(kind, num, rng)
    bound = rounding_bound(head)
    seen = worst_error(head, seed=num)
    assert not bound.overflows
    assert 0 <= seen <= bound.error + rounding_bound(head, torch.float64).error


@pytest.mark.parametrize("kind", ["plain", "cancelling", "low rank", "flat", "fitted"])
@pytest.mark.parametrize("num", [60, 120])
def test_the_bound_is_no_more_than_ten_thousand_times_the_worst(kind, num, rng):
    head = head_of(kind, num, rng)
    seen = worst_error(head)
    assert rounding_bound(head).error <= 1e4 * seen


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num", [1, 4, 12])
def test_the_bound_holds_against_exact_arithmetic(kind, num, rng):
    head = head_of(kind, num, rng)
    bounds = {dtype: rounding_bound(head, dtype) for dtype in (torch.float32, torch.float64)}
    points = rng.choice([-1.0, 1.0, *rng.uniform(-1, 1, 20)], (30, num)).astype(np.float32)
    for z in torch.from_numpy(points):
        exact = exact_score(head, z.tolist())
        for dtype, bound in bounds.items():
            error = abs(Fraction(float(stored(head, dtype)(z.to(dtype)))) - exact)
            assert error <= Fraction(bound.error)


@pytest.mark.parametrize("num", [3, 20])
def test_the_bound_is_of_no_order_of_summation(num, rng):
    """Plain float32 loops in NumPy, terms in another order each time."""
    head = head_of("plain", num, rng)
    single = stored(head, torch.float32)
    quadratic, linear = single.quadratic.numpy(), single.linear.numpy()
    errors = []
    for _ in range(40):
        z = rng.choice(np.float32([-1, 1]), num)
        pull = [one_by_one([*(row * z), b], rng) for row, b in zip(quadratic, linear, strict=True)]
        score = one_by_one([*(np.array(pull) * z), single.constant.numpy()], rng)
        assert score.dtype == np.float32
        errors.append(abs(Fraction(float(score)) - exact_score(head, z.tolist())))
    assert 0 < max(errors) <= Fraction(rounding_bound(head).error)


def one_by_one(terms, rng: np.random.Generator) -> np.float32:
    total = np.float32(0)
    for place in rng.permutation(len(terms)):
        total = np.float32(total + terms[place])
    return total


def by_hand(quadratic: float, linear: float, constant: float) -> Fraction:
    """K = 1: q is stored, multiplied, added, multiplied, added; l all but a product; a the last."""
    five, four, two = (n * U / (1 - n * U) for n in (5, 4, 2))
    lost = 7 * TINY * (1 + five)
    q, b, c = (abs(Fraction(value)) for value in (quadratic, linear, constant))
    return five * q + four * b + two * c + lost


@pytest.mark.parametrize(
    "parts", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-3.0, 7, -0.1)]
)
def test_one_feature_by_hand(parts):
    quadratic, linear, constant = (torch.tensor(p, dtype=torch.float64) for p in parts)
    head = QuadraticForm(quadratic.reshape(1, 1), linear.reshape(1), constant)
    expected = by_hand(*parts)
    bound = Fraction(rounding_bound(head).error)
    assert expected <= bound <= expected * (1 + Fraction(1, 10**12))


@pytest.mark.parametrize("num", [1, 2, 60])
def test_larger_coefficients_and_more_features_raise_the_bound(num, rng):
    head = head_of("plain", num, rng)
    bound = rounding_bound(head).error
    louder = QuadraticForm(1.001 * head.quadratic, head.linear, head.constant)
    steeper = QuadraticForm(head.quadratic, 1.001 * head.linear, head.constant)
    higher = QuadraticForm(head.quadratic, head.linear, 1.001 * head.constant)
    wider = QuadraticForm(
        torch.nn.functional.pad(head.quadratic, (0, 1, 0, 1)),
        torch.nn.functional.pad(head.linear, (0, 1)),
        head.constant,
    )
    for other in (louder, steeper, higher, wider):
        assert rounding_bound(other).error > bound
    assert rounding_bound(stored(head, torch.float64), torch.float64).error < 1e-8 * bound


def test_signs_do_not_matter(rng):
    head = head_of("plain", 30, rng)
    size = QuadraticForm(head.quadratic.abs(), -head.linear.abs(), head.constant.abs())
    assert rounding_bound(size) == rounding_bound(head)


@pytest.mark.parametrize(
    ("quadratic", "linear", "constant"),
    [(1e39, 0.0, 0.0), (0.0, 1e39, 0.0), (0.0, 0.0, 1e39), (1e38, 0.0, 0.0), (math.inf, 0.0, 0.0)],
)
def test_overflow_is_told(quadratic, linear, constant):
    """1e38 fits float32, the sum of 2 x 2 of them does not."""
    head = QuadraticForm(
        torch.full((2, 2), quadratic, dtype=torch.float64),
        torch.full((2,), linear, dtype=torch.float64),
        torch.tensor(constant, dtype=torch.float64),
    )
    assert rounding_bound(head) == (math.inf, True)
    assert worst_error(head) == math.inf
    if math.isfinite(quadratic):
        assert not rounding_bound(head, torch.float64).overflows


def test_nan_is_refused():
    head = QuadraticForm(torch.full((1, 1), math.nan), torch.zeros(1), torch.tensor(0.0))
    with pytest.raises(ValueError, match="coefficient of the head is NaN; fit it again"):
        rounding_bound(head)


def test_gamma():
    for count in (1, 2, 243, 5167):
        expected = count * U / (1 - count * U)
        assert expected <= Fraction(gamma(count, torch.float32)) <= expected * (1 + U * U)
    assert gamma(2**24, torch.float32) == math.inf


def test_the_search_looks_at_the_points_it_is_given(rng, monkeypatch):
    seen = []
    errors = rounding._errors
    monkeypatch.setattr(
        rounding, "_errors", lambda *parts: seen.append(parts[-1]) or errors(*parts)
    )
    points = torch.from_numpy(rng.uniform(-1, 1, (3, 7)).astype(np.float32))
    worst_error(head_of("plain", 7, rng), also=points)
    for point in points:
        assert (seen[0] == point).all(1).any()


def test_the_search_repeats_itself_and_grows(rng):
    head = head_of("plain", 25, rng)
    assert worst_error(head, seed=3) == worst_error(head, seed=3)
    drawn = torch.from_numpy(rng.uniform(-1, 1, (5000, 25)))
    single = drawn.float()
    errors = stored(head, torch.float32)(single).double() - head(single.double())
    assert worst_error(head) > float(errors.abs().max())  # better than points at random


@pytest.mark.parametrize("points", [torch.zeros(3, 4), torch.zeros(5), torch.full((1, 5), 1.5)])
def test_points_outside_the_box_are_refused(points, rng):
    with pytest.raises(ValueError, match=r"expected points \[N, 5\] within \[-1, 1\], got"):
        worst_error(head_of("plain", 5, rng), also=points)


def test_the_head_may_carry_a_gradient(rng):
    support = torch.from_numpy(rng.uniform(-1, 1, (9, 4))).requires_grad_()
    head = collapse(support, torch.from_numpy(rng.standard_normal(9)))
    assert 0 < worst_error(head) <= rounding_bound(head).error
