import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.model.kernel_elm import solve_kernel_elm, solve_primal
from tactslip_torch.model.kernels import Polynomial, RadialBasis
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    collapse,
    from_primal,
    quadratic_features,
    sum_of_quadratic_features,
)


def assert_sum_close(actual, terms):
    """Within 1e-10 of the sum of magnitudes: what a sum in another order may differ by."""
    error = np.abs(actual.numpy() - terms.sum(-1))
    assert (error <= 1e-10 * np.abs(terms).sum(-1)).all(), error.max()


@given(
    num_bins=st.integers(1, 60),
    num_features=st.integers(1, 12),
    degree=st.sampled_from([1, 2]),
    offset=st.sampled_from([0.0, 0.5, 3.0]),
    seed=st.integers(0, 99),
)
def test_collapse_equals_the_kernel_sum(num_bins, num_features, degree, offset, seed):
    rng = np.random.default_rng(seed)
    support, z = (
        rng.standard_normal((num_bins, num_features)),
        rng.standard_normal((7, num_features)),
    )
    beta = rng.standard_normal(num_bins) * 10.0 ** rng.integers(-3, 3, num_bins)
    kernel = Polynomial(degree, offset)
    form = collapse(torch.from_numpy(support), torch.from_numpy(beta), kernel)
    assert_sum_close(form(torch.from_numpy(z)), oracles.kernel(z, support, degree, offset) * beta)


def test_collapse_at_the_papers_size(rng):
    support, z = rng.uniform(-1, 1, (300, 120)), rng.uniform(-1, 1, (20, 120))
    beta = rng.standard_normal(300)
    form = collapse(torch.from_numpy(support), torch.from_numpy(beta))
    assert form.quadratic.shape == (120, 120)
    assert_sum_close(form(torch.from_numpy(z)), oracles.kernel(z, support) * beta)
    torch.testing.assert_close(form.quadratic, form.quadratic.T, rtol=1e-12, atol=1e-12)
    z0 = torch.zeros(120, dtype=torch.float64)
    assert form(z0).item() == pytest.approx(0.25 * beta.sum(), rel=1e-12)


@given(
    num_features=st.integers(1, 10),
    offset=st.sampled_from([0.0, 0.5, 3.0]),
    seed=st.integers(0, 99),
)
def test_explicit_features_multiply_to_the_kernel(num_features, offset, seed):
    z = np.random.default_rng(seed).standard_normal((6, num_features))
    phi = quadratic_features(torch.from_numpy(z), offset)
    assert phi.shape == (6, (num_features + 1) * (num_features + 2) // 2)
    expected = oracles.kernel(z, z, 2, offset)
    norms = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs((phi @ phi.T).numpy() - expected) <= 1e-12 * norms + 1e-15).all()


@given(
    num_features=st.integers(1, 10),
    offset=st.sampled_from([0.0, 0.5, 3.0]),
    seed=st.integers(0, 99),
)
def test_explicit_features_are_summed_without_making_them(num_features, offset, seed):
    rng = np.random.default_rng(seed)
    z, beta = rng.standard_normal((6, num_features)), rng.standard_normal(6)
    terms = quadratic_features(torch.from_numpy(z), offset).numpy().T * beta
    total = sum_of_quadratic_features(torch.from_numpy(z), torch.from_numpy(beta), offset)
    assert_sum_close(total, terms)


def test_7381_features_of_the_papers_120():
    assert quadratic_features(torch.zeros(2, 120), 0.5).shape == (2, 7381)


@pytest.mark.parametrize("offset", [0.5, 2.0])
@pytest.mark.parametrize("num_features", [1, 2, 7])
def test_from_primal_is_the_linear_machine_on_explicit_features(offset, num_features, rng):
    num_weights = (num_features + 1) * (num_features + 2) // 2
    weights, z = rng.standard_normal(num_weights), rng.standard_normal((9, num_features))
    form = from_primal(torch.from_numpy(weights), num_features, offset)
    terms = quadratic_features(torch.from_numpy(z), offset).numpy() * weights
    assert_sum_close(form(torch.from_numpy(z)), terms)


@pytest.mark.parametrize("weighted", [False, True])
def test_both_roads_lead_to_one_form(weighted, rng):
    z, targets = torch.from_numpy(rng.uniform(-1, 1, (50, 4))), torch.ones(50, dtype=torch.float64)
    targets[::3] = -1
    weights = torch.from_numpy(rng.uniform(0.5, 2, 50)) if weighted else None
    gram = torch.from_numpy(oracles.kernel(z.numpy(), z.numpy()))
    dual = collapse(z, solve_kernel_elm(gram, targets, 0.3, weights))
    primal = from_primal(solve_primal(quadratic_features(z, 0.5), targets, 0.3, weights), 4, 0.5)
    for name in ("quadratic", "linear", "constant"):
        torch.testing.assert_close(
            getattr(primal, name), getattr(dual, name), rtol=1e-9, atol=1e-11, msg=name
        )


def random_form(rng, num_features):
    q = rng.standard_normal((num_features, num_features))
    return (
        q + q.T,
        rng.standard_normal(num_features),
        rng.standard_normal(()),
    )


def test_the_form_is_what_it_says(rng):
    q, linear, constant = random_form(rng, 5)
    form = QuadraticForm(*(torch.as_tensor(part) for part in (q, linear, constant)))
    z = rng.standard_normal((6, 5))
    expected = [one @ q @ one + linear @ one + constant for one in z]
    np.testing.assert_allclose(form(torch.from_numpy(z)), expected, rtol=1e-12, atol=1e-12)


def test_manners_and_gradcheck(rng, device):
    parts = [torch.as_tensor(part) for part in random_form(rng, 5)]
    form = QuadraticForm(*parts).to(device)
    z = torch.from_numpy(rng.standard_normal((6, 5))).to(device)
    double = {"double": form, "single": QuadraticForm(*parts).to(device).float()}

    def operator(z):
        return double["double" if z.dtype == torch.float64 else "single"](z)

    oracles.assert_manners(operator, z)
    assert torch.autograd.gradcheck(form, z.requires_grad_())
    gradient = torch.autograd.grad(form(z[0]), z)[0][0]
    by_hand = 2 * form.quadratic @ z[0] + form.linear
    torch.testing.assert_close(gradient, by_hand, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2])
def test_gradcheck_of_collapse(degree, rng):
    support = torch.from_numpy(rng.standard_normal((6, 3))).requires_grad_()
    beta = torch.from_numpy(rng.standard_normal(6)).requires_grad_()
    z = torch.from_numpy(rng.standard_normal((4, 3)))
    kernel = Polynomial(degree, 0.5)
    assert torch.autograd.gradcheck(lambda s, b: collapse(s, b, kernel)(z), (support, beta))


def test_gradcheck_of_the_explicit_features(rng):
    z = torch.from_numpy(rng.standard_normal((6, 3))).requires_grad_()
    assert torch.autograd.gradcheck(lambda z: quadratic_features(z, 0.5), z)


@pytest.mark.parametrize("degree", [1, 2])
def test_a_form_is_folded_in_double_precision_whatever_comes_in(degree, rng):
    """20 000 terms that cancel: sums in float32 would be off in the third digit."""
    support = torch.from_numpy(rng.uniform(-1, 1, (20000, 3))).float()
    beta = torch.from_numpy(rng.choice([-1e4, 1e4], 20000)).float()
    z = rng.uniform(-1, 1, (5, 3))
    form = collapse(support, beta, Polynomial(degree, 0.5))
    assert {value.dtype for value in form.state_dict().values()} == {torch.float64}
    kernel = (z @ support.double().numpy().T + 0.5) ** degree
    assert_sum_close(form(torch.from_numpy(z)), kernel * beta.double().numpy())


@pytest.mark.parametrize("kernel", [Polynomial(3), RadialBasis(0.1)], ids=str)
def test_a_kernel_that_does_not_fold_is_named(kernel):
    with pytest.raises(ValueError, match=r"does not fold .* KernelSum") as caught:
        collapse(torch.zeros(2, 3), torch.ones(2), kernel)
    assert str(kernel) in str(caught.value)


def test_the_papers_head_costs_14520_multiply_adds_and_58_kilobytes(rng):
    """Whatever the number of training bins; 120 features, in single precision."""
    costs = set()
    for num_bins in (3, 300):
        support = torch.from_numpy(rng.uniform(-1, 1, (num_bins, 120)))
        form = collapse(support, torch.ones(num_bins))
        numbers = sum(value.numel() for value in form.state_dict().values())
        assert form.cost == (120 * 120 + 120, 8 * numbers)
        assert form.num_features == 120
        costs.add(form.float().cost)
    (cost,) = costs
    assert cost.num_bytes < 60_000
    assert str(cost) == "14.5 k multiply-adds a bin and 58.1 kB"


def test_the_form_is_saved_with_its_state(rng):
    form = QuadraticForm(*(torch.as_tensor(part) for part in random_form(rng, 3)))
    other = QuadraticForm(torch.zeros(3, 3), torch.zeros(3), torch.zeros(())).double()
    other.load_state_dict(form.state_dict())
    z = torch.from_numpy(rng.standard_normal((4, 3)))
    assert torch.equal(other(z), form(z))


def test_nan_in_a_feature_is_nan_in_the_score():
    form = QuadraticForm(torch.eye(2), torch.zeros(2), torch.zeros(()))
    scores = form(torch.tensor([[1.0, 2.0], [float("nan"), 0.0]]))
    assert scores[0] == 5
    assert scores[1].isnan()


def test_errors_name_the_shapes():
    with pytest.raises(ValueError, match=r"\(2, 3\), \(3,\) and \(\)"):
        QuadraticForm(torch.zeros(2, 3), torch.zeros(3), torch.zeros(()))
    with pytest.raises(ValueError, match=r"\(3, 3\), \(3,\) and \(1,\)"):
        QuadraticForm(torch.zeros(3, 3), torch.zeros(3), torch.zeros(1))
    with pytest.raises(ValueError, match=r"15 weights for 4.*\(14,\)"):
        from_primal(torch.zeros(14), 4, 0.5)
