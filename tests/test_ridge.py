"""The ridge machine of classes: primal, dual and NumPy's solve of the minimum that is stated."""

from functools import partial

import numpy as np
import oracles
import pytest
import torch

from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial
from tactslip_torch.model.ridge import ClassSums, balanced_weights, class_targets, solve_dual

RIDGES = [0.03, 1.0, 20.0]


def draw(rng, num_classes, num=40, num_columns=5):
    """Columns, labels of classes of unlike size and unlike weights; two columns are nearly one."""
    labels = np.minimum(rng.geometric(0.6, num) - 1, num_classes - 1)
    labels[:num_classes] = range(num_classes)
    u = rng.standard_normal((num, num_columns)) + 0.7 * labels[:, None]
    u[:, 1] = u[:, 0] + 1e-4 * rng.standard_normal(num)
    return tuple(map(torch.from_numpy, (u, labels, rng.uniform(0.2, 3.0, num))))


def primal(u, labels, weights, ridges, targets):
    sums = ClassSums(len(targets), u.shape[1])
    sums.update(u, labels, weights)
    return list(sums.solve(ridges, targets))


@pytest.mark.parametrize("num_classes", [2, 3])
def test_primal_and_dual_are_the_minimum_that_is_stated(num_classes, rng):
    u, labels, weights = draw(rng, num_classes)
    targets = class_targets(num_classes)
    assert targets.shape == (num_classes, 1 if num_classes == 2 else num_classes)
    arrays = [x.numpy() for x in (u, labels, weights)]
    by_sums = primal(u, labels, weights, RIDGES, targets)
    by_kernel = solve_dual(u @ u.mT, labels, weights, RIDGES, targets)
    for ridge, one, other in zip(RIDGES, by_sums, by_kernel, strict=True):
        slopes, intercept = oracles.class_ridge(*arrays, ridge, targets.numpy())
        np.testing.assert_allclose(one.weights, slopes, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(one.intercept, intercept, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(u.mT @ other.weights, slopes, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(other.intercept, intercept, rtol=1e-9, atol=1e-11)


def test_the_dual_of_degree_2_is_the_minimum_on_monomials(rng):
    u, labels, weights = draw(rng, 2)
    kernel, targets = Polynomial(2, 0.5), class_targets(2)
    (found,) = solve_dual(kernel(u, u), labels, weights, [0.3], targets)
    given = (x.numpy() for x in (kernel.monomials(u), labels, weights))
    slopes, intercept = oracles.class_ridge(*given, 0.3, targets.numpy())
    score = kernel(u, u) @ found.weights + found.intercept
    expected = kernel.monomials(u).numpy() @ slopes + intercept
    np.testing.assert_allclose(score, expected, rtol=1e-7)


def test_bins_of_a_class_count_alike_however_many_they_are(rng):
    """Of unlike classes without slopes the score is in the middle of the targets."""
    labels = torch.tensor([0] * 3 + [1] * 30)
    u, weights = torch.zeros(33, 2, dtype=torch.float64), torch.ones(33, dtype=torch.float64)
    (found,) = primal(u, labels, weights, [1.0], class_targets(2))
    assert found.intercept.item() == pytest.approx(0.0, abs=1e-12)
    balanced = balanced_weights(labels, weights, 2)
    assert balanced.sum().item() == pytest.approx(33)
    assert balanced[labels == 0].sum().item() == pytest.approx(33 / 2)


def test_sums_add_up_and_come_apart_by_bins(rng):
    u, labels, weights = draw(rng, 3, num=60)
    parts = []
    for some in torch.arange(60).split(17):
        part = ClassSums(3, u.shape[1])
        part.update(u[some], labels[some], weights[some])
        parts.append(part)
    whole, targets = ClassSums.added(parts), class_targets(3)
    (found,) = whole.solve([1.0], targets)
    (straight,) = primal(u, labels, weights, [1.0], targets)
    torch.testing.assert_close(found, straight, rtol=1e-8, atol=1e-10)
    (rest,) = whole.without(parts[0]).solve([1.0], targets)
    (others,) = primal(u[17:], labels[17:], weights[17:], [1.0], targets)
    torch.testing.assert_close(rest, others, rtol=1e-8, atol=1e-10)


def test_a_class_without_bins_is_refused(rng):
    u, labels, weights = draw(rng, 2)
    labels[labels == 2] = 1
    sums = ClassSums(3, u.shape[1])
    sums.update(u, labels, weights)
    with pytest.raises(ValueError, match="bins of every class"):
        list(sums.solve([1.0], class_targets(3)))
    with pytest.raises(ValueError, match="bins of every class"):
        list(solve_dual(u @ u.mT, labels, weights, [1.0], class_targets(3)))
    whole = ClassSums(2, u.shape[1])
    whole.update(u, labels, weights)
    slips = ClassSums(2, u.shape[1])
    slips.update(u[labels == 1], labels[labels == 1], weights[labels == 1])
    assert whole.has_all
    assert not whole.without(slips).has_all  # what rounding leaves of its weight is no bin


def score_by_sums(u, new, labels, weights):
    (found,) = primal(u, labels, weights, [0.5], class_targets(2))
    return new @ found.weights + found.intercept


def score_by_kernel(u, new, labels, weights, kernel):
    (found,) = solve_dual(kernel(u, u), labels, weights, [0.5], class_targets(2))
    return kernel(new, u) @ found.weights + found.intercept


SCORES = [
    score_by_sums,
    partial(score_by_kernel, kernel=Polynomial(1, 0.0)),
    partial(score_by_kernel, kernel=PAPER_KERNEL),
]


@pytest.mark.parametrize("score", SCORES, ids=["primal", "dual", "dual of degree 2"])
def test_scores_are_differentiable_in_training_bins_new_bins_and_weights(score, rng):
    u, labels, weights = draw(rng, 2, num=12, num_columns=3)
    new = torch.from_numpy(rng.standard_normal((4, 3)))
    given = [x.clone().requires_grad_() for x in (u, new, weights)]
    assert torch.autograd.gradcheck(lambda u, new, w: score(u, new, labels, w), given)
