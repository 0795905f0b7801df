import json
import math

import numpy as np
import oracles
import pytest
import torch
from scipy.spatial.distance import cdist

from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    KernelSum,
    Polynomial,
    QuadraticForm,
    RadialBasis,
    collapse,
    kernel_from_dict,
    machine_of,
)

KERNELS = [
    PAPER_KERNEL,
    Polynomial(1, 0.7),
    RadialBasis(0.02),
    RadialBasis(1.3),
]


def by_definition(kernel, a, b):
    if isinstance(kernel, Polynomial):
        return oracles.kernel(a, b, kernel.degree, kernel.offset)
    return np.exp(-kernel.gamma * cdist(a, b, "sqeuclidean"))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_kernel_is_its_definition_with_derivatives_and_comes_back_from_json(kernel, rng):
    a, b = (torch.from_numpy(rng.standard_normal((num, 3))) for num in (3, 4))
    expected = by_definition(kernel, a.numpy(), b.numpy())
    found = kernel(a, b).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    assert torch.autograd.gradcheck(kernel, (a.requires_grad_(), b.requires_grad_()))
    assert torch.autograd.gradgradcheck(kernel, (a, b))
    assert torch.autograd.gradcheck(lambda a: kernel(a, a), a)
    assert kernel_from_dict(json.loads(json.dumps(kernel.to_dict()))) == kernel


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "must be one of polynomial, radial basis, got None"),
        ({"kind": "radial basis"}, "{} does not describe a radial basis kernel"),
        ({"kind": "polynomial", "degree": "2"}, "does not describe a polynomial kernel"),
        ({"kind": "polynomial", "degree": 0}, "degree of the kernel .* got 0"),
        ({"kind": "polynomial", "offset": math.nan}, "offset .* at least 0, got nan"),
        ({"kind": "radial basis", "gamma": 0.0}, "gamma .* positive and finite, got 0"),
    ],
)
def test_what_describes_no_kernel_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        kernel_from_dict(values)


# Heads ----------------------------------------------------------------------------------------


def drawn(rng, num_bins=20, num_features=4):
    support = torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features)))
    return support, torch.from_numpy(rng.standard_normal(num_bins))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_head_is_the_sum_over_its_bins(kernel, rng, device):
    support, beta = drawn(rng)
    head = machine_of(support, beta, kernel).to(device)
    assert isinstance(head, QuadraticForm if kernel.collapses else KernelSum)
    z = torch.from_numpy(rng.uniform(-1, 1, (6, 4))).to(device)
    terms = by_definition(kernel, z.cpu().numpy(), support.numpy()) * beta.numpy()
    error = np.abs(head(z).cpu().numpy() - terms.sum(-1))
    assert (error <= 1e-11 * np.abs(terms).sum(-1)).all()
    single = machine_of(support, beta, kernel).to(device).float()
    oracles.assert_manners(lambda z: (head if z.dtype == torch.float64 else single)(z), z)
    assert torch.autograd.gradcheck(head, z.requires_grad_())
    bad = torch.zeros(2, 4, dtype=torch.float64, device=device)
    bad[1, 2] = torch.nan
    assert head(bad).isnan().tolist() == [False, True]
    numbers = sum(value.numel() for value in head.state_dict().values())
    assert (head.num_features, head.cost.num_bytes) == (4, 8 * numbers)


def test_a_form_is_folded_in_float64_and_gradients_reach_its_bins(rng):
    """20 000 terms that cancel: sums in float32 would be off in the third digit."""
    support = torch.from_numpy(rng.uniform(-1, 1, (20000, 3))).float()
    beta = torch.from_numpy(rng.choice([-1e4, 1e4], 20000)).float()
    z = torch.from_numpy(rng.uniform(-1, 1, (5, 3)))
    terms = PAPER_KERNEL(z, support.double()) * beta
    error = (collapse(support, beta)(z) - terms.sum(-1)).abs()
    assert bool((error <= 1e-10 * terms.abs().sum(-1)).all())
    few = [part.requires_grad_() for part in drawn(rng, 5, 3)]
    for kernel in (PAPER_KERNEL, Polynomial(1), RadialBasis(0.3)):
        assert torch.autograd.gradcheck(lambda s, b, k=kernel: machine_of(s, b, k)(z), few)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: collapse(torch.zeros(2, 3), torch.ones(2), Polynomial(3)), r"does not fold .*Sum"),
        (lambda: KernelSum(torch.zeros(5, 2), torch.zeros(4), Polynomial(3)), r"\(5, 2\) and \(4,"),
        (
            lambda: QuadraticForm(*map(torch.zeros, ((2, 3), (3,), ()))),
            r"\(2, 3\), \(3,\) and \(\)",
        ),
    ],
)
def test_what_makes_no_head_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
