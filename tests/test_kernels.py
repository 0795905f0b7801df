import json
import math

import numpy as np
import oracles
import pytest
import torch
from scipy.spatial.distance import cdist

from tactslip_torch.model import kernels
from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Cost,
    Polynomial,
    RadialBasis,
    kernel_from_dict,
    lower_gram,
)

KERNELS = [
    PAPER_KERNEL,
    Polynomial(1, 0.0),
    Polynomial(1, 0.7),
    Polynomial(3, 1.5),
    Polynomial(5, 0.5),
    RadialBasis(0.02),
    RadialBasis(1.3),
]


def by_definition(kernel, a, b):
    if isinstance(kernel, Polynomial):
        return oracles.kernel(a, b, kernel.degree, kernel.offset)
    return np.exp(-kernel.gamma * cdist(a, b, "sqeuclidean"))


# Values --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_kernel_equals_the_oracle(kernel, rng):
    a, b = rng.standard_normal((7, 4)), rng.standard_normal((9, 4))
    expected = by_definition(kernel, a, b)
    actual = kernel(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_manners(kernel, rng, device):
    a = torch.from_numpy(rng.standard_normal((6, 7, 4))).to(device)
    b = torch.from_numpy(rng.standard_normal((9, 4))).to(device)
    oracles.assert_manners(lambda a: kernel(a, b.to(a)), a, num_axes=2)
    batched = kernel(a, torch.stack([b + i for i in range(6)]))
    for i in range(6):
        torch.testing.assert_close(batched[i], kernel(a[i], b + i), rtol=1e-12, atol=1e-12)


def test_the_papers_kernel_is_the_default():
    assert Polynomial() == PAPER_KERNEL == Polynomial(2, 0.5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_distance_is_negative(dtype, rng):
    """Squares and products of far bins cancel to less than nothing; the kernel is at most 1."""
    z = torch.from_numpy(1000 + rng.standard_normal((50, 6))).to(dtype)
    squares = z.square().sum(-1)
    distance = squares[:, None] + squares - 2 * (z @ z.mT)
    assert bool((distance < 0).any())  # else the next line proves nothing
    assert float(RadialBasis(5.0)(z, z).max()) <= 1.0


# Gradients -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_gradcheck(kernel, rng):
    a = torch.from_numpy(rng.standard_normal((3, 2))).requires_grad_()
    b = torch.from_numpy(rng.standard_normal((4, 2))).requires_grad_()
    assert torch.autograd.gradcheck(kernel, (a, b))
    assert torch.autograd.gradgradcheck(kernel, (a, b))
    assert torch.autograd.gradcheck(lambda a: kernel(a, a), a)


def test_gradients_where_bins_coincide(rng):
    """The slope is 0 there and the curvature -2 gamma, also where a distance rounds below 0."""
    kernel = RadialBasis(0.7)
    b = torch.from_numpy(10 * rng.standard_normal((40, 5)))

    def diagonal(a):
        return kernel(a, b).diagonal().sum()

    slope = torch.autograd.functional.jacobian(diagonal, b)
    torch.testing.assert_close(slope, torch.zeros_like(b), rtol=0, atol=1e-12)
    curvature = torch.autograd.functional.hessian(diagonal, b).reshape(200, 200)
    torch.testing.assert_close(
        curvature, -1.4 * torch.eye(200, dtype=torch.float64), rtol=0, atol=1e-9
    )


# The triangle --------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("num_bins", [1, 8, 9, 20])
def test_the_lower_triangle_is_that_of_the_kernel(kernel, num_bins, rng, monkeypatch):
    """Eight rows are filled at a time: below one block, one whole one, more than two."""
    monkeypatch.setattr(kernels, "_GRAM_ROWS", 8)
    z = rng.uniform(-1, 1, (num_bins, 3))
    actual = lower_gram(kernel, torch.from_numpy(z)).tril()
    np.testing.assert_allclose(actual, np.tril(by_definition(kernel, z, z)), rtol=0, atol=1e-12)


def test_the_triangle_follows_the_dtype_and_has_no_gradient(rng):
    z = torch.from_numpy(rng.standard_normal((5, 3))).float().requires_grad_()
    gram = lower_gram(PAPER_KERNEL, z)
    assert gram.dtype == torch.float32
    assert not gram.requires_grad


# What they are -------------------------------------------------------------------------------


def test_only_polynomials_of_degree_1_and_2_collapse():
    folding = [kernel for kernel in KERNELS if kernel.collapses]
    assert folding == [Polynomial(2, 0.5), Polynomial(1, 0.0), Polynomial(1, 0.7)]


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_kernel_comes_back_from_json(kernel):
    assert kernel_from_dict(json.loads(json.dumps(kernel.to_dict()))) == kernel


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "must be one of polynomial, radial basis, got None"),
        ({"kind": "sigmoid"}, "must be one of polynomial, radial basis, got 'sigmoid'"),
        ({"kind": ["polynomial"]}, "must be one of polynomial, radial basis, got"),
        ({"kind": "radial basis"}, "{} does not describe a radial basis kernel"),
        ({"kind": "polynomial", "gamma": 1.0}, "does not describe a polynomial kernel"),
        ({"kind": "polynomial", "degree": "2"}, "does not describe a polynomial kernel"),
        ({"kind": "polynomial", "degree": 0}, "degree of the kernel .* got 0"),
    ],
)
def test_what_describes_no_kernel_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        kernel_from_dict(values)


@pytest.mark.parametrize("degree", [0, -1, 1.5, math.nan])
def test_a_degree_is_a_whole_number_from_1(degree):
    with pytest.raises(ValueError, match=f"degree .* at least 1, got {degree}"):
        Polynomial(degree)


@pytest.mark.parametrize("offset", [-0.1, math.inf, math.nan])
def test_an_offset_is_not_negative(offset):
    with pytest.raises(ValueError, match=f"offset .* at least 0, got {offset}"):
        Polynomial(2, offset)


@pytest.mark.parametrize("gamma", [0.0, -1.0, math.inf, math.nan])
def test_gamma_is_positive(gamma):
    with pytest.raises(ValueError, match=f"gamma .* positive and finite, got {gamma}"):
        RadialBasis(gamma)


def test_a_cost_reads_as_words():
    assert str(Cost(14520, 58084)) == "14.5 k multiply-adds a bin and 58.1 kB"
