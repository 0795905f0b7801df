import numpy as np
import pytest
import torch
from test_held_out import draw, grouped
from torch import Tensor

from tactslip_torch.model import held_out_gradient, left_out
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.held_out_gradient import held_out_scores
from tactslip_torch.model.kernels import Polynomial

GROUPS = ("bins", "cycles", "materials", "mixed")


@pytest.fixture(params=[None, 4])
def tiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles and chunks as they are, and so small that groups and chunks take several."""
    if request.param:
        monkeypatch.setattr(left_out, "TILE", request.param)
        monkeypatch.setattr(left_out, "_CHUNK", 3 * request.param - 1)
        monkeypatch.setattr(held_out_gradient, "_ROWS", request.param)
        monkeypatch.setattr(held_out_gradient, "_TOGETHER", 3)


def refitted(
    z: Tensor, is_slip: Tensor, groups: Tensor, penalty: Tensor, offset: Tensor, weights: Tensor
) -> Tensor:
    """Delete the group, solve, predict: by autograd through every solve."""
    targets = torch.where(is_slip, 1.0, -1.0).double()
    scores = torch.zeros_like(targets)
    for name in groups.unique():
        own, out = groups == name, groups != name
        gram = (z[out] @ z[out].mT + offset) ** 2
        beta = torch.linalg.solve(gram + torch.diag(1 / (penalty * weights[out])), targets[out])
        scores = scores.index_put((own,), ((z[own] @ z[out].mT + offset) ** 2) @ beta)
    return scores


def inputs_of(
    rng: np.random.Generator, num_bins: int, num_features: int, kind: str
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Features, labels, groups, C, c and weights; a gradient is wanted of all that have one."""
    bins, groups = draw(rng, num_bins, num_features, weighted=True), grouped(rng, num_bins, kind)
    numbers = [torch.tensor(value, dtype=torch.float64) for value in (0.7, 0.4)]
    z, weights = bins.features.requires_grad_(), bins.weights.requires_grad_()
    penalty, offset = [number.requires_grad_() for number in numbers]
    return z, bins.is_slip, groups, penalty, offset, weights


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("kind", GROUPS)
def test_the_scores_are_those_of_held_out_bit_for_bit(kind, weighted, rng):
    bins, groups = draw(rng, 60, 12, weighted), grouped(rng, 60, kind)
    expected = HeldOut(bins, groups, Polynomial(2, 0.3), route="dual").at(0.7).scores
    actual = held_out_scores(bins.features, bins.is_slip, groups, 0.7, 0.3, bins.weights)
    assert torch.equal(actual, expected)


@pytest.mark.usefixtures("tiled")
@pytest.mark.parametrize("kind", GROUPS)
def test_gradients_are_those_through_refits(kind, rng):
    inputs = inputs_of(rng, 60, 12, kind)
    wanted = [inputs[0], *inputs[3:]]
    pull = torch.from_numpy(rng.standard_normal(60))
    actual = torch.autograd.grad(held_out_scores(*inputs), wanted, pull)
    expected = torch.autograd.grad(refitted(*inputs), wanted, pull)
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("kind", ["cycles", "materials"])
def test_gradcheck(kind, rng):
    """With more bins than monomials, and fewer."""
    for num_features in (2, 6):
        z, is_slip, groups, *numbers = inputs_of(rng, 18, num_features, kind)
        assert torch.autograd.gradcheck(
            lambda z, *numbers, is_slip=is_slip, groups=groups: held_out_scores(
                z, is_slip, groups, *numbers
            ),
            (z, *numbers),
        )


@pytest.mark.parametrize("curved", [False, True])
def test_a_second_derivative_raises(curved, rng):
    """Even where z is reached another way, which would do for autograd."""
    z, is_slip, groups, penalty, offset, weights = inputs_of(rng, 20, 2, "materials")
    scores = held_out_scores(z, is_slip, groups, penalty, offset, weights)
    loss = (scores.square() if curved else scores).sum()
    for wanted in (z, penalty, offset, weights):
        (pull,) = torch.autograd.grad(loss, wanted, create_graph=True)
        with pytest.raises(RuntimeError, match="held_out_scores can be differentiated once"):
            torch.autograd.grad(pull.sum() + z.sum(), z)


def test_what_is_not_asked_for_does_not_move_what_is(rng):
    """C alone, and numbers that are no tensors."""
    z, is_slip, groups, penalty, offset, weights = inputs_of(rng, 30, 3, "cycles")
    everything = held_out_scores(z, is_slip, groups, penalty, offset, weights).square().sum()
    expected = torch.autograd.grad(everything, [z, penalty])
    fixed = z.detach(), is_slip, groups, penalty, offset.item(), weights.detach()
    actual = torch.autograd.grad(held_out_scores(*fixed).square().sum(), penalty)[0]
    torch.testing.assert_close(actual, expected[1], rtol=1e-12, atol=0)
    others = z, is_slip, groups, penalty.item(), offset.item(), weights.detach()
    actual = torch.autograd.grad(held_out_scores(*others).square().sum(), z)[0]
    torch.testing.assert_close(actual, expected[0], rtol=1e-12, atol=0)


def test_float32_features_get_their_gradient_in_float32(rng):
    z, is_slip, groups, *_ = inputs_of(rng, 30, 3, "cycles")
    single = z.detach().float().requires_grad_()
    scores = held_out_scores(single, is_slip, groups, 0.7)
    assert scores.dtype == torch.float64
    (actual,) = torch.autograd.grad(scores.sum(), single)
    double = single.detach().double().requires_grad_()
    (expected,) = torch.autograd.grad(held_out_scores(double, is_slip, groups, 0.7).sum(), double)
    assert torch.equal(actual, expected.float())


@pytest.mark.parametrize("penalty", [0.0, -1.0, float("inf"), float("nan")])
def test_a_penalty_must_be_positive_and_finite(penalty, rng):
    bins = draw(rng, 20)
    with pytest.raises(ValueError, match=r"positive and finite penalty .*, got"):
        held_out_scores(bins.features, bins.is_slip, torch.arange(20) % 4, penalty)


def test_bad_input_is_refused(rng):
    z, is_slip, groups = (bins := draw(rng, 20)).features, bins.is_slip, torch.arange(20) % 4
    with pytest.raises(ValueError, match=r"one N, got \(20, 3\), \(19,\)"):
        held_out_scores(z, is_slip[1:], groups, 1.0)
    with pytest.raises(ValueError, match="at least two groups"):
        held_out_scores(z, is_slip, torch.zeros_like(groups), 1.0)
    with pytest.raises(ValueError, match=r"offset .* at least 0, got -0.5"):
        held_out_scores(z, is_slip, groups, 1.0, -0.5)
    with pytest.raises(ValueError, match="weights must be positive"):
        held_out_scores(z, is_slip, groups, 1.0, weights=torch.zeros(20))


def test_tensors_of_the_caller_are_kept(rng):
    bins, groups = draw(rng, 30, 3, weighted=True), grouped(rng, 30, "mixed")
    kept = TrainingBins(bins.features.clone(), bins.is_slip.clone(), bins.weights.clone())
    before = groups.clone()
    z = bins.features.requires_grad_()
    held_out_scores(z, bins.is_slip, groups, 0.7, weights=bins.weights).sum().backward()
    assert torch.equal(z, kept.features)
    assert torch.equal(bins.is_slip, kept.is_slip)
    assert torch.equal(bins.weights, kept.weights)
    assert torch.equal(groups, before)
