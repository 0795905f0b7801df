import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model.differentiable_fit import fit_quadratic
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial

ROUTES = pytest.mark.parametrize("route", ["primal", "dual"])


def drawn(rng: np.random.Generator, num_bins: int, num_features: int) -> tuple[Tensor, ...]:
    """Features, targets that are any numbers, C, c and weights; a gradient is wanted of all."""
    z = torch.from_numpy(rng.uniform(-1, 1, (num_bins, num_features)))
    targets, weights = rng.standard_normal(num_bins), rng.uniform(0.2, 3, num_bins)
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (0.7, 0.4)]
    inputs = z, torch.from_numpy(targets), *numbers, torch.from_numpy(weights)
    return tuple(tensor.requires_grad_() for tensor in inputs)


def scores(route: str, new: Tensor):
    """Of new bins, as a function of everything the machine is made of."""
    return lambda *inputs: fit_quadratic(*inputs, route=route)(new)


def by_autograd(new: Tensor):
    """The same from the whole Gram matrix and through the solve."""

    def solve(z, targets, penalty, offset, weights):
        gram = (z @ z.mT + offset) ** 2
        beta = torch.linalg.solve(gram + torch.diag(1 / (penalty * weights)), targets)
        return (new @ z.mT + offset) ** 2 @ beta

    return solve


# Numbers -------------------------------------------------------------------------------------
@ROUTES
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("penalty", [1e-3, 0.3, 1e4])
@pytest.mark.parametrize("num_bins", [12, 60])
def test_the_machine_is_that_of_fit_machine(num_bins, penalty, weighted, route, rng):
    """With 15 monomials; up to how a product with c is rounded."""
    z, targets, _, _, weights = (tensor.detach() for tensor in drawn(rng, num_bins, 4))
    bins = TrainingBins(z, targets > 0, weights if weighted else None)
    expected = fit_machine(bins, penalty, Polynomial(2, 0.3), route=route)
    actual = fit_quadratic(z, bins.is_slip, penalty, 0.3, bins.weights, route)
    assert actual.solved == expected.solved
    for name in ("quadratic", "linear", "constant"):
        whole = float(getattr(expected, name).abs().max())
        torch.testing.assert_close(
            getattr(actual, name), getattr(expected, name), rtol=0, atol=1e-11 * max(1.0, whole)
        )


@pytest.mark.parametrize(("num_bins", "route"), [(12, "dual"), (60, "primal")])
def test_the_route_is_that_of_fit_machine(num_bins, route, rng):
    z, targets, *_ = (tensor.detach() for tensor in drawn(rng, num_bins, 4))
    machine = fit_quadratic(z, targets, 0.7)
    assert machine.solved.size == (15 if route == "primal" else num_bins)


def test_single_precision_is_promoted_and_gets_its_gradient(rng):
    z, targets, *_ = (tensor.detach().float() for tensor in drawn(rng, 12, 4))
    machine = fit_quadratic(z.requires_grad_(), targets, 0.7)
    assert machine.linear.dtype == torch.float64
    (slope,) = torch.autograd.grad(machine.quadratic.sum(), z)
    double = z.detach().double().requires_grad_()
    (expected,) = torch.autograd.grad(fit_quadratic(double, targets, 0.7).quadratic.sum(), double)
    assert torch.equal(slope, expected.float())


# Derivatives ---------------------------------------------------------------------------------
@ROUTES
@pytest.mark.parametrize(("num_bins", "num_features"), [(12, 2), (5, 3)])
def test_gradients_are_right_once_and_twice(num_bins, num_features, route, rng):
    """More bins than monomials, and fewer; the second derivative sees the factor move."""
    new = torch.from_numpy(rng.uniform(-1, 1, (3, num_features)))
    inputs = drawn(rng, num_bins, num_features)
    assert torch.autograd.gradcheck(scores(route, new), inputs)
    assert torch.autograd.gradgradcheck(scores(route, new), inputs)


@ROUTES
@pytest.mark.parametrize("penalty", [0.01, 1.0, 100.0])
def test_derivatives_are_those_through_the_gram_matrix(penalty, route, rng):
    new, pull, draw = (torch.from_numpy(rng.uniform(-1, 1, n)) for n in ((6, 3), 6, (30, 3)))
    z, targets, _, offset, weights = drawn(rng, 30, 3)
    inputs = z, targets, torch.tensor(penalty).double().requires_grad_(), offset, weights

    def both(solve):
        first = torch.autograd.grad(solve(*inputs) @ pull, inputs, create_graph=True)
        return *first, *torch.autograd.grad((first[0] * draw).sum(), inputs)

    for actual, expected in zip(both(scores(route, new)), both(by_autograd(new)), strict=True):
        whole = expected.abs().max().item()
        torch.testing.assert_close(actual, expected, rtol=0, atol=1e-8 * whole)


def test_an_offset_of_nothing(rng):
    """The dual has a derivative there; the primal has one of everything else, or says so."""
    z, targets, penalty, _, weights = drawn(rng, 12, 2)
    new, nothing = torch.ones(1, 2).double(), torch.zeros(()).double().requires_grad_()
    inputs = z, targets, penalty, nothing, weights
    with pytest.raises(ValueError, match=r"no derivative by an offset .* of 0; .* route='dual'"):
        fit_quadratic(*inputs, route="primal")
    expected = torch.autograd.grad(by_autograd(new)(*inputs).sum(), inputs)
    dual = torch.autograd.grad(scores("dual", new)(*inputs).sum(), inputs)
    primal = fit_quadratic(z, targets, penalty, 0.0, weights, route="primal")(new).sum()
    for actual in (dual, torch.autograd.grad(primal, (z, targets, penalty, weights))):
        others = expected if len(actual) == 5 else [*expected[:3], expected[4]]
        for one, other in zip(actual, others, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


@ROUTES
def test_a_step_down_the_slope_lowers_a_loss(route, rng):
    """What it is for: C, c and a weight of each feature, learned on other bins."""
    z, new = (torch.from_numpy(rng.uniform(-1, 1, (n, 3))) for n in (25, 40))
    targets, wanted = (torch.sign(x[:, 0] - x[:, 1] ** 2) for x in (z, new))
    settings = [torch.zeros(n, dtype=torch.float64, requires_grad=True) for n in ((), (), 3)]

    def loss():
        penalty, offset, scales = (setting.exp() for setting in settings)
        machine = fit_quadratic(z * scales, targets, penalty, offset, route=route)
        return (machine(new * scales) - wanted).square().mean()

    before = loss()
    for setting, slope in zip(settings, torch.autograd.grad(before, settings), strict=True):
        setting.data -= 0.1 * slope / slope.norm()
    assert float(loss().detach()) < float(before.detach()) - 1e-3


@ROUTES
def test_the_way_back_factorises_nothing(route, rng, monkeypatch):
    inputs = drawn(rng, 20, 3)
    machine = fit_quadratic(*inputs, route=route)
    for name in ("cholesky", "cholesky_ex", "solve"):
        monkeypatch.setattr(torch.linalg, name, None)
    (slope,) = torch.autograd.grad(machine.quadratic.sum(), inputs[0], create_graph=True)
    torch.autograd.grad(slope.square().sum(), inputs)


# Refusals ------------------------------------------------------------------------------------
@pytest.mark.parametrize("penalty", [0.0, -1.0, float("inf"), float("nan")])
def test_a_penalty_must_be_positive_and_finite(penalty):
    with pytest.raises(ValueError, match=rf"positive and finite penalty .* C={penalty}; fit_mach"):
        fit_quadratic(torch.ones(2, 1), torch.tensor([True, False]), penalty)


@ROUTES
def test_bad_input_is_refused(route, rng):
    z, targets, *_ = (tensor.detach() for tensor in drawn(rng, 12, 3))
    with pytest.raises(ValueError, match=r"one N, got \(12, 3\), \(11,\)"):
        fit_quadratic(z, targets[1:], 1.0)
    with pytest.raises(ValueError, match=r"needs bins .* got 0 bins"):
        fit_quadratic(z[:0], targets[:0], 1.0)
    with pytest.raises(ValueError, match=r"offset .* at least 0, got -0.5"):
        fit_quadratic(z, targets, 1.0, -0.5)
    with pytest.raises(ValueError, match="weights must be positive"):
        fit_quadratic(z, targets, 1.0, weights=-torch.ones(12))
    with pytest.raises(ValueError, match="must be finite, got nan"):
        fit_quadratic(z, targets * torch.nan, 1.0, route=route)
    with pytest.raises(
        ValueError, match=r"penalty=1e\+18.*, wanted up to 1e\+12; lower the penalty"
    ):
        fit_quadratic(z.repeat(4, 1)[:, [0, 0]], targets.repeat(4), 1e18, route=route)
