"""Kernels, the machine that is fitted to training bins, and derivatives through the fit."""

import json
import math
import re

import numpy as np
import oracles
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge
from torch import nn

from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Polynomial,
    QuadraticForm,
    collapse,
    factors_of,
    kernel_from_dict,
)

KERNELS = [PAPER_KERNEL, Polynomial(2, 1.5), Polynomial(2, 0.0), Polynomial(1, 0.5)]


def by_definition(kernel, a, b):
    return oracles.kernel(a, b, kernel.degree, kernel.offset)


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
        ({}, "must be polynomial, got None"),
        ({"kind": "radial basis", "gamma": 0.1}, "must be polynomial, got 'radial basis'"),
        ({"kind": "polynomial", "degree": 3}, "degree of the kernel must be 1 or 2, got 3"),
        ({"kind": "polynomial", "gamma": 1.0}, "does not describe a polynomial kernel"),
        ({"kind": "polynomial", "degree": "2"}, "degree of the kernel must be 1 or 2, got 2"),
        ({"kind": "polynomial", "offset": math.nan}, "offset .* at least 0, got nan"),
    ],
)
def test_what_describes_no_kernel_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        kernel_from_dict(values)


# Heads ----------------------------------------------------------------------------------------


def terms_of(rng, num_bins=20, num_features=4):
    """Bins and the weight of each in a sum of kernels."""
    support = torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features)))
    return support, torch.from_numpy(rng.standard_normal(num_bins))


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_a_head_is_the_sum_over_its_bins(kernel, rng, device):
    support, beta = terms_of(rng)
    head = collapse(support, beta, kernel).to(device)
    z = torch.from_numpy(rng.uniform(-1, 1, (6, 4))).to(device)
    terms = by_definition(kernel, z.cpu().numpy(), support.numpy()) * beta.numpy()
    error = np.abs(head(z).cpu().numpy() - terms.sum(-1))
    assert (error <= 1e-11 * np.abs(terms).sum(-1)).all()
    single = collapse(support, beta, kernel).to(device).float()
    oracles.assert_manners(lambda z: (head if z.dtype == torch.float64 else single)(z), z)
    assert torch.autograd.gradcheck(head, z.requires_grad_())
    bad = torch.zeros(2, 4, dtype=torch.float64, device=device)
    bad[1, 2] = torch.nan
    assert head(bad).isnan().tolist() == [False, True]
    numbers = sum(value.numel() for value in head.state_dict().values())
    assert (head.num_features, head.cost.num_bytes) == (4, 8 * numbers)


def test_a_quadratic_part_of_the_first_features_leaves_the_others_linear(rng):
    quadratic, linear = (torch.from_numpy(rng.standard_normal(s)) for s in ((2, 2), (5,)))
    quadratic += quadratic.mT.clone()
    head = QuadraticForm(quadratic, linear, torch.tensor(0.3, dtype=torch.float64))
    z = torch.from_numpy(rng.standard_normal((3, 4, 5))).requires_grad_()
    filled = nn.functional.pad(quadratic, (0, 3, 0, 3))
    whole = QuadraticForm(filled, linear, head.constant)
    torch.testing.assert_close(head(z), whole(z), rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(head, z)
    assert (head.num_features, head.is_linear, head.cost) == (5, False, (5 + 3, 80))


@pytest.mark.parametrize(
    "shapes",
    [((2, 3), (3,), ()), ((4, 4), (3,), ()), ((3,), (3,), ()), ((3, 3), (3,), (1,))],
    ids=str,
)
def test_a_head_whose_parts_disagree_is_refused_with_their_shapes(shapes):
    with pytest.raises(ValueError, match=re.escape("{}, {} and {}".format(*shapes))):
        QuadraticForm(*map(torch.zeros, shapes))


def test_factors_of_the_first_features_are_the_form_that_they_add_up_to(rng):
    factors, linear = (torch.from_numpy(rng.standard_normal(s)) for s in ((2, 3), (5,)))
    signs, constant = torch.tensor([1.0, -1.0]), torch.tensor(0.3, dtype=torch.float64)
    head = QuadraticForm(factors, linear, constant, signs)
    matrix = torch.outer(factors[0], factors[0]) - torch.outer(factors[1], factors[1])
    z = torch.from_numpy(rng.standard_normal((3, 4, 5))).requires_grad_()
    dense = QuadraticForm(matrix, linear, constant)
    torch.testing.assert_close(head(z), dense(z), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(head.matrix, dense.matrix, rtol=1e-12, atol=1e-12)
    assert torch.autograd.gradcheck(head, z)
    assert torch.autograd.gradgradcheck(head, z)
    assert (head.num_features, head.is_linear, head.cost) == (5, False, (13, 8 * 14))
    none = QuadraticForm(factors[:0], linear, constant, signs[:0])
    torch.testing.assert_close(none(z), z @ linear + 0.3, rtol=1e-12, atol=1e-12)
    assert none.is_linear


@pytest.mark.parametrize(
    ("shape", "signs", "message"),
    [
        (
            (2, 3),
            [1.0],
            "signs [r], linear [K], m at most K, and a scalar constant, got (2, 3), (1",
        ),
        ((2, 6), [1.0, 1.0], "got (2, 6), (2,), (5,) and ()"),
        ((2, 3), [[1.0, 1.0]], "got (2, 3), (1, 2), (5,) and ()"),
        ((2, 3), [1.0, 0.5], "signs of factors must be 1 or -1, got 0.5"),
        ((2, 3), [math.nan, 1.0], "signs of factors must be 1 or -1, got nan"),
    ],
)
def test_factors_and_signs_that_make_no_form_are_refused_in_one_line(shape, signs, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        QuadraticForm(torch.zeros(shape), torch.zeros(5), torch.tensor(0.0), torch.tensor(signs))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["fewer bins", "more bins", "bins twice", "no weight"])
def test_all_factors_are_the_whole_sum(kind, rng):
    support, beta = terms_of(rng, 30 if kind == "more bins" else 12, 20)
    if kind == "bins twice":
        support[6:] = support[:6]
    if kind == "no weight":
        beta.zero_()
    factors, signs = factors_of(support, beta, tolerance=0.0)
    rank = {"fewer bins": 12, "more bins": 20, "bins twice": 6, "no weight": 0}[kind]
    assert factors.shape == (rank, 20)
    head = QuadraticForm(factors, torch.zeros(20).double(), torch.tensor(0.0).double(), signs)
    expected = np.einsum("i,ij,ik->jk", beta, support, support)
    np.testing.assert_allclose(head.matrix.numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_bins", [15, 60])
def test_factors_are_the_fewest_within_the_tolerance_and_at_most_so_many(num_bins, rng):
    support, beta = terms_of(rng, num_bins, 25)
    support *= 0.7 ** torch.arange(25)
    values, vectors = np.linalg.eigh(np.einsum("i,ij,ik->jk", beta, support, support))
    order = np.argsort(-np.abs(values))
    terms = (support.numpy() @ vectors[:, order]) ** 2 * values[order]
    spread = terms.sum(1).std()
    errors = [np.sqrt(np.mean(terms[:, num:].sum(1) ** 2)) / spread for num in range(25)]
    for tolerance in (0.1, 0.005):
        factors, signs = factors_of(support, beta, tolerance=tolerance)
        assert 0 < len(factors) == len(signs) == np.argmax(np.array(errors) <= tolerance) < 15
    few, signs_of_few = factors_of(support, beta, most=2)
    np.testing.assert_allclose((few**2).sum(1), np.abs(values[order[:2]]), rtol=1e-9)
    assert signs_of_few.tolist() == np.sign(values[order[:2]]).tolist()


@pytest.mark.parametrize(
    ("shapes", "options", "message"),
    [
        (((3, 2), (2,)), {}, r"expected support \[N, m\] .* got \(3, 2\) and \(2,\)"),
        (((0, 2), (0,)), {}, r"N at least 1, got \(0, 2\) and \(0,\)"),
        (((3, 2), (3,)), {"most": 0}, "most must be at least 1 .* got 0 and 0.005"),
        (((3, 2), (3,)), {"tolerance": math.nan}, "tolerance at least 0, got 64 and nan"),
    ],
)
def test_what_has_no_factors_is_refused_in_one_line(shapes, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        factors_of(*map(torch.ones, shapes), **options)
    assert "\n" not in str(caught.value)


# Fit -----------------------------------------------------------------------------------------


def draw(rng, num_bins, num_features=3, weighted=False):
    z = torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features)))
    is_slip = torch.from_numpy(rng.uniform(size=num_bins) < 0.6)
    is_slip[:2] = torch.tensor([True, False])
    weights = torch.from_numpy(rng.uniform(0.3, 2, num_bins)) if weighted else None
    return TrainingBins(z, is_slip, weights)


def ridge(bins, penalty, kernel, new):
    """What the same machine of scikit-learn says of new bins."""
    own = bins.features.numpy()
    weights = None if bins.weights is None else bins.weights.numpy()
    model = KernelRidge(alpha=1 / penalty, kernel="precomputed")
    model.fit(by_definition(kernel, own, own), bins.targets.numpy(), sample_weight=weights)
    return model.predict(by_definition(kernel, new, own))


@pytest.mark.parametrize(
    ("is_slip", "weights", "message"),
    [
        (torch.ones(4, dtype=torch.bool), None, r"one N, got \(5, 2\), \(4,\)$"),
        (torch.ones(5, dtype=torch.bool), torch.ones(4), r"got \(5, 2\), \(5,\), \(4,\)$"),
        (torch.ones(5, dtype=torch.bool), torch.arange(5.0), "positive and finite, got 0"),
    ],
)
def test_bins_that_do_not_fit_together_are_refused(is_slip, weights, message):
    with pytest.raises(ValueError, match=message):
        TrainingBins(torch.zeros(5, 2), is_slip, weights)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
@pytest.mark.parametrize("num_bins", [10, 60])
def test_every_machine_equals_kernel_ridge(num_bins, kernel, weighted, rng):
    """Three features have ten monomials: the dual up to ten bins, the primal above."""
    assert PAPER_KERNEL.num_monomials(3) == 10
    bins = draw(rng, num_bins, weighted=weighted)
    new = rng.uniform(-1, 1, (20, 3))
    for penalty in (0.05, 3.0):
        machine = fit_machine(bins, penalty, kernel)
        expected = ridge(bins, penalty, kernel, new)
        actual = machine(torch.from_numpy(new)).numpy()
        np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("kernel", "crossover"), [(PAPER_KERNEL, 16), (Polynomial(1, 0.5), 4)])
def test_many_bins_go_through_the_primal_and_few_do_not(kernel, crossover, rng):
    num = kernel.num_monomials(3)
    for num_bins, size in ((crossover, crossover), (crossover + 1, num)):
        assert fit_machine(draw(rng, num_bins), 0.3, kernel).solved.size == size
        assert fit_machine(draw(rng, num_bins), 0.3, kernel, "primal").solved.size == num
        assert fit_machine(draw(rng, num_bins), 0.3, kernel, "dual").solved.size == num_bins


def test_a_machine_of_fewer_bins_than_its_many_features_is_a_quadratic_form_too(rng):
    bins = draw(rng, 60, num_features=1001)
    machine = fit_machine(bins, 0.3)
    new = rng.uniform(-1, 1, (5, 1001))
    expected = ridge(bins, 0.3, PAPER_KERNEL, new)
    np.testing.assert_allclose(machine(torch.from_numpy(new)).numpy(), expected, rtol=1e-9)


NONE = TrainingBins(torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool))
SOME = TrainingBins(torch.eye(3), torch.tensor([True, False, True]))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((NONE, 1.0), r"^a machine needs training bins, got none; add"),
        ((SOME, 0.3, PAPER_KERNEL, "back"), "route must be 'auto', 'primal' or 'dual', got 'back'"),
    ],
)
def test_what_makes_no_machine_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        fit_machine(*given)
