import numpy as np
import oracles
import pytest
import torch

from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import Polynomial, RadialBasis
from tactslip_torch.model.quadratic import QuadraticForm

KERNELS = [Polynomial(3, 0.5), Polynomial(4, 1.0), RadialBasis(0.3)]


def draw(rng, num_bins=20, num_features=4):
    return (
        torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features))),
        torch.from_numpy(rng.standard_normal(num_bins)),
    )


def by_definition(kernel, z, support, beta):
    score = 0.0
    for one, weight in zip(support, beta, strict=True):
        if isinstance(kernel, Polynomial):
            score += weight * (np.dot(z, one) + kernel.offset) ** kernel.degree
        else:
            score += weight * np.exp(-kernel.gamma * ((z - one) ** 2).sum())
    return score


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_the_machine_is_the_sum(kernel, rng):
    support, beta = draw(rng)
    z = rng.uniform(-1, 1, (6, 4))
    expected = [by_definition(kernel, one, support.numpy(), beta.numpy()) for one in z]
    actual = KernelSum(support, beta, kernel)(torch.from_numpy(z))
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_manners_and_gradcheck(kernel, rng, device):
    machine = KernelSum(*draw(rng), kernel).to(device)
    single = KernelSum(*draw(rng), kernel).to(device).float()
    z = torch.from_numpy(rng.uniform(-1, 1, (6, 4))).to(device)
    oracles.assert_manners(lambda z: (machine if z.dtype == torch.float64 else single)(z), z)
    assert machine(z[0]).shape == ()
    assert torch.autograd.gradcheck(machine, z.requires_grad_())


def test_gradients_reach_the_training_bins(rng):
    parts = [part.requires_grad_() for part in draw(rng, 5, 3)]
    z = torch.from_numpy(rng.uniform(-1, 1, (2, 3)))
    assert torch.autograd.gradcheck(lambda s, b: KernelSum(s, b, RadialBasis(0.3))(z), parts)


def test_nan_in_a_feature_is_nan_in_the_score(rng):
    for kernel in KERNELS:
        z = torch.zeros(2, 4, dtype=torch.float64)
        z[1, 2] = torch.nan
        assert KernelSum(*draw(rng), kernel)(z).isnan().tolist() == [False, True]


def test_it_costs_what_it_keeps(rng):
    """Counted in the machine itself: every number it keeps is multiplied once a bin."""
    for num_bins in (30, 3000):
        machine = KernelSum(*draw(rng, num_bins, 120), Polynomial(3))
        numbers = sum(value.numel() for value in machine.state_dict().values())
        assert machine.cost == (numbers, 8 * numbers)
        assert machine.float().cost == (numbers, 4 * numbers)
    assert machine.num_features == 120


def test_the_note_names_kernel_bins_and_cost(rng):
    note = KernelSum(*draw(rng, 100, 9), RadialBasis(0.25)).cost_note
    for part in ("RadialBasis(gamma=0.25)", "100 training bins", "1.0 k multiply-adds", "8.0 kB"):
        assert part in note
    assert "\n" not in note


def test_a_quadratic_form_is_smaller_beyond_its_crossover(rng):
    """A form of K features costs what a sum of K training bins does, and stays there."""
    form = QuadraticForm(torch.eye(4).double(), torch.zeros(4).double(), torch.zeros(()).double())
    sums = [KernelSum(*draw(rng, num_bins), Polynomial(3)) for num_bins in (4, 5, 50)]
    assert sums[0].cost.multiply_adds == form.cost.multiply_adds
    assert sums[0].cost.num_bytes < form.cost.num_bytes < sums[1].cost.num_bytes
    assert sums[2].cost.num_bytes == 10 * sums[1].cost.num_bytes


@pytest.mark.parametrize(
    ("support", "beta", "shapes"),
    [((5, 2), (4,), r"\(5, 2\) and \(4,\)"), ((5,), (5,), r"\(5,\) and \(5,\)")],
)
def test_shapes_must_agree(support, beta, shapes):
    with pytest.raises(ValueError, match=f"one N, got {shapes}"):
        KernelSum(torch.zeros(support), torch.zeros(beta), Polynomial(3))
