import numpy as np
import oracles
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

from tactslip_torch.model.kernel_elm import (
    solve_kernel_elm,
    solve_kernel_elm_,
    solve_normal_equations,
    solve_normal_equations_,
    solve_primal,
)
from tactslip_torch.model.kernels import PAPER_KERNEL
from tactslip_torch.model.quadratic import quadratic_features

PENALTIES = [0.05, 0.3, 3.0, 1000.0]


def draw(rng, num_bins=40, num_features=5):
    z = rng.uniform(-1, 1, (num_bins, num_features))
    targets = np.where(rng.uniform(size=num_bins) < 0.4, 1.0, -1.0)
    weights = rng.uniform(0.2, 3, num_bins)
    return z, targets, weights


def tensors(*arrays):
    return tuple(torch.from_numpy(a) for a in arrays)


def close(actual, expected, tolerance=1e-10):
    """Relative to the largest expected value: a solve mixes all of them."""
    np.testing.assert_allclose(
        actual.numpy(), expected, rtol=tolerance, atol=tolerance * np.abs(expected).max()
    )


# Dual solve ----------------------------------------------------------------------------------


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("weighted", [False, True])
def test_dual_equals_sklearn(penalty, weighted, rng):
    z, targets, weights = draw(rng)
    ridge = KernelRidge(kernel="poly", degree=2, gamma=1, coef0=0.5, alpha=1 / penalty)
    ridge.fit(z, targets, sample_weight=weights if weighted else None)
    zt, tt, wt = tensors(z, targets, weights)
    beta = solve_kernel_elm(PAPER_KERNEL(zt, zt), tt, penalty, wt if weighted else None)
    close(beta, ridge.dual_coef_, 1e-8 if penalty > 100 else 1e-10)
    new = rng.uniform(-1, 1, (11, 5))
    close(PAPER_KERNEL(torch.from_numpy(new), zt) @ beta, ridge.predict(new))


@pytest.mark.parametrize("penalty", PENALTIES)
def test_dual_equals_the_oracle_and_solves_its_equation(penalty, rng):
    z, targets, weights = draw(rng)
    gram = oracles.kernel(z, z)
    beta = solve_kernel_elm(*tensors(gram, targets), penalty, torch.from_numpy(weights))
    close(beta, oracles.kernel_elm(gram, targets, penalty, weights), 1e-9)
    residual = gram @ beta.numpy() + beta.numpy() / (penalty * weights) - targets
    assert np.abs(residual).max() < 1e-10


def test_a_weight_of_two_is_a_bin_seen_twice(rng):
    z, targets, _ = draw(rng)
    weights = rng.integers(1, 4, len(z))
    new = torch.from_numpy(rng.uniform(-1, 1, (9, 5)))

    def scores(z, targets, weights=None):
        beta = solve_kernel_elm(PAPER_KERNEL(z, z), targets, 0.3, weights)
        return PAPER_KERNEL(new, z) @ beta

    zt, tt = tensors(z, targets)
    repeated = tensors(np.repeat(z, weights, axis=0), np.repeat(targets, weights))
    weighted = scores(zt, tt, torch.from_numpy(weights.astype(float)))
    torch.testing.assert_close(weighted, scores(*repeated), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("num_bins", [10, 60])
def test_an_infinite_penalty_is_the_pseudo_inverse(num_bins, rng):
    """With 60 bins and 21 monomials the matrix is singular: the minimum-norm solution."""
    z, targets, _ = draw(rng, num_bins)
    gram = oracles.kernel(z, z)
    beta = solve_kernel_elm(*tensors(gram, targets), float("inf"))
    expected = np.linalg.lstsq(gram, targets, rcond=1e-12)[0]
    close(beta, expected, 1e-7)
    if num_bins < 21:
        np.testing.assert_allclose(gram @ beta.numpy(), targets, rtol=1e-8)


def test_dual_is_batched(rng):
    problems = [draw(rng) for _ in range(6)]
    grams = np.stack([oracles.kernel(z, z) for z, _, _ in problems]).reshape(2, 3, 40, 40)
    targets = np.stack([t for _, t, _ in problems]).reshape(2, 3, 40)
    weights = np.stack([w for _, _, w in problems]).reshape(2, 3, 40)
    together = solve_kernel_elm(*tensors(grams, targets), 0.3, torch.from_numpy(weights))
    assert together.shape == (2, 3, 40)
    for i in np.ndindex(2, 3):
        close(together[i], oracles.kernel_elm(grams[i], targets[i], 0.3, weights[i]))
    infinite = solve_kernel_elm(*tensors(grams, targets), float("inf"))
    single = solve_kernel_elm(*tensors(grams[1, 2], targets[1, 2]), np.inf)
    close(infinite[1, 2], single.numpy(), 1e-7)


def test_inputs_are_kept_and_dtype_is_followed(rng):
    z, targets, weights = tensors(*draw(rng))
    gram = PAPER_KERNEL(z, z)
    copies = [t.clone() for t in (gram, targets, weights)]
    expected = solve_kernel_elm(gram, targets, 0.3, weights)
    solve_primal(quadratic_features(z), targets, 0.3, weights)
    for tensor, copy in zip((gram, targets, weights), copies, strict=True):
        assert torch.equal(tensor, copy)
    actual = solve_kernel_elm(gram.float(), targets.float(), 0.3, weights.float())
    assert actual.dtype == torch.float32
    torch.testing.assert_close(actual.double(), expected, rtol=1e-3, atol=1e-4)
    strided = torch.stack([gram, gram], -1)[..., 0]
    torch.testing.assert_close(solve_kernel_elm(strided, targets, 0.3, weights), expected)


@pytest.mark.parametrize("penalty", [0.3, float("inf")])
def test_gradcheck_through_the_features(penalty, rng):
    """Through the features: Cholesky reads one triangle, so the Gram matrix alone cannot."""
    z, targets, weights = draw(rng, 8, 3)
    new = torch.from_numpy(rng.uniform(-1, 1, (4, 3)))

    def scores(z, targets, weights):
        beta = solve_kernel_elm(
            PAPER_KERNEL(z, z), targets, penalty, None if penalty == np.inf else weights
        )
        return PAPER_KERNEL(new, z) @ beta

    inputs = [t.requires_grad_() for t in tensors(z, targets)]
    weights = torch.from_numpy(weights).requires_grad_(penalty != np.inf)
    assert torch.autograd.gradcheck(scores, (*inputs, weights))


# Primal --------------------------------------------------------------------------------------


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("num_bins", [12, 40, 200])
def test_primal_equals_dual(penalty, weighted, num_bins, rng):
    z, targets, weights = tensors(*draw(rng, num_bins))
    weights = weights if weighted else None
    features = quadratic_features(z, 0.5)
    primal = features @ solve_primal(features, targets, penalty, weights)
    gram = PAPER_KERNEL(z, z)
    dual = gram @ solve_kernel_elm(gram, targets, penalty, weights)
    close(primal, dual.numpy(), 1e-9)


def test_primal_solves_its_equation(rng):
    x, targets, weights = (
        rng.standard_normal((30, 6)),
        rng.standard_normal(30),
        rng.uniform(1, 2, 30),
    )
    w = np.linalg.solve(
        x.T @ np.diag(weights) @ x + np.eye(6) / 0.3, x.T @ np.diag(weights) @ targets
    )
    close(solve_primal(*tensors(x, targets), 0.3, torch.from_numpy(weights)), w)


def test_gradcheck_of_the_primal(rng):
    inputs = [t.requires_grad_() for t in tensors(*draw(rng, 9, 3))]
    assert torch.autograd.gradcheck(lambda x, t, w: solve_primal(x, t, 0.5, w), inputs)


# In place ------------------------------------------------------------------------------------


def lower(matrix):
    """What an in-place solve gets: nothing sensible above the diagonal."""
    return torch.where(torch.ones_like(matrix, dtype=torch.bool).tril(), matrix, torch.nan)


@pytest.mark.parametrize("penalty", [*PENALTIES, np.inf])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_dual_in_place_equals_the_oracle(penalty, weighted, rng):
    """Two hundred bins of 21 monomials: the kernel matrix alone is singular."""
    z, targets, weights = draw(rng, 200)
    weights = weights if weighted else np.ones(200)
    gram = lower(torch.from_numpy(oracles.kernel(z, z)))
    beta, report = solve_kernel_elm_(
        gram, torch.from_numpy(targets), penalty, torch.from_numpy(weights)
    )
    assert report.method == ("eigen" if np.isinf(penalty) else "cholesky")
    if np.isinf(penalty):
        root = np.sqrt(weights)
        across = root[:, None] * oracles.kernel(z, z) * root
        expected = root * np.linalg.lstsq(across, root * targets, rcond=1e-12)[0]
    else:
        expected = oracles.kernel_elm(oracles.kernel(z, z), targets, penalty, weights)
    close(beta, expected, 1e-7 if penalty > 100 else 1e-9)


@pytest.mark.parametrize("penalty", [*PENALTIES, np.inf])
def test_normal_equations_in_place_equal_those_that_keep_their_matrix(penalty, rng):
    x, targets = rng.standard_normal((30, 6)), rng.standard_normal(30)
    normal, moment = tensors(x.T @ x, x.T @ targets)
    expected = np.linalg.solve(x.T @ x + np.eye(6) / penalty, x.T @ targets)
    close(solve_normal_equations(normal, moment, penalty), expected)
    close(solve_normal_equations_(lower(normal), moment, penalty).x, expected)


def test_there_is_no_second_matrix(rng):
    """The factor lies where the matrix was, and only targets and weights are kept."""
    z, targets, weights = tensors(*draw(rng))
    gram = PAPER_KERNEL(z, z)
    system = gram + torch.diag(1 / (0.3 * weights))
    copies = targets.clone(), weights.clone()
    solve_kernel_elm_(gram, targets, 0.3, weights)
    torch.testing.assert_close(gram.tril() @ gram.tril().mT, system, rtol=1e-12, atol=1e-12)
    assert torch.equal(targets, copies[0])
    assert torch.equal(weights, copies[1])


def test_errors_in_place_are_those_of_the_others():
    bad = torch.diag(torch.tensor([1.0, -4.0], dtype=torch.float64))
    ones = torch.ones(2, dtype=torch.float64)
    message = "is not positive semi-definite: it has the eigenvalue -4 beside 1; it must be a sum"
    for solve, name in (
        (solve_kernel_elm_, "gram"),
        (solve_normal_equations_, "X'WX"),
        (solve_kernel_elm, "gram"),
        (solve_normal_equations, "X'WX"),
    ):
        with pytest.raises(ValueError, match=f"^{name} {message}"):
            solve(bad.clone(), ones, 1.0)
        with pytest.raises(ValueError, match=rf"^{name} must be finite, got nan at \[0, 0\]; "):
            solve(torch.full((2, 2), torch.nan), torch.ones(2), 1.0)
        with pytest.raises(
            ValueError, match=rf"^right-hand side of {name} must be .* inf at \[1\]"
        ):
            solve(torch.eye(2), torch.tensor([1.0, torch.inf]), 1.0)
    for penalty in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"positive, got {penalty}"):
            solve_kernel_elm_(torch.eye(2), torch.ones(2), penalty)
        with pytest.raises(ValueError, match=f"positive, got {penalty}"):
            solve_normal_equations_(torch.eye(2), torch.ones(2), penalty)
    with pytest.raises(ValueError, match=r"\(2, 2\).*\(3,\)"):
        solve_kernel_elm_(torch.eye(2), torch.ones(3), 1.0)
    with pytest.raises(ValueError, match="weights must be positive"):
        solve_kernel_elm_(torch.eye(2), torch.ones(2), 1.0, torch.tensor([1.0, 0.0]))


def dual(*arguments):
    return solve_kernel_elm_(*arguments).x


BOTH = pytest.mark.parametrize("solve", [solve_kernel_elm, dual], ids=["kept", "in place"])


@BOTH
def test_a_light_bin_is_no_noise(solve):
    """Of weight 1e-20, beside one it has nothing to do with; in a singular system it is refused."""
    eye, targets = torch.eye(2).double(), torch.tensor([1.0, -1.0]).double()
    weights = torch.tensor([1e-20, 1.0]).double()
    assert solve(eye.clone(), targets, np.inf, weights).tolist() == [1.0, -1.0]
    twice = torch.block_diag(eye[:1, :1], torch.ones(2, 2).double())
    weights = torch.tensor([1e-20, 1.0, 1.0]).double()
    with pytest.raises(ValueError, match=r"weights from 1\.0e-20 to 1\.0e\+00 too far apart"):
        solve(twice, torch.tensor([1.0, -1.0, 1.0]).double(), np.inf, weights)


@BOTH
def test_a_solution_that_leaves_its_dtype_is_refused(solve):
    targets = torch.tensor([1e5, -1e5])
    with pytest.raises(ValueError, match=r"solution for gram leaves float32: an entry is 1e\+44;"):
        solve(1e-39 * torch.eye(2), targets, np.inf)
    with pytest.raises(ValueError, match="solution for gram leaves float64"):
        solve(1e-310 * torch.eye(2).double(), targets.double(), np.inf)
    with pytest.raises(ValueError, match=r"1 / \(C w\) is finite, got 1e-310"):
        solve(torch.eye(2).double(), targets.double(), 1e-310)


@BOTH
def test_the_dtype_is_that_of_the_matrix(solve):
    for penalty in (1.0, 1e14, np.inf):
        beta = solve(torch.ones(2, 2).double(), torch.tensor([1, 1]), penalty)
        assert beta.dtype == torch.float64
        share = 1 / (2 + 1 / penalty)
        close(beta, np.array([share, share]), 1e-7)  # jittered
        single = solve(torch.eye(2), torch.ones(2).double(), penalty)
        assert single.dtype == torch.float32
    with pytest.raises(ValueError, match=r"gram must .* floating, got 2 of torch.int64"):
        solve(torch.ones(2, 2).long(), torch.ones(2), 1.0)
    with pytest.raises(ValueError, match=r"gram must have bins .* got 0"):
        solve(torch.ones(0, 0), torch.ones(0), 1.0)
    with pytest.raises(ValueError, match="too much for a matrix in float16"):
        solve(torch.ones(2, 2).half(), torch.ones(2).half(), 1e4)


def test_a_singular_matrix_does_not_spoil_its_batch():
    """The first is positive definite with its ridge, and no sum of squares without it."""
    first = torch.diag(torch.tensor([1.0, -1e-9]).double())
    batch = torch.stack([first, torch.full((2, 2), 1e16, dtype=torch.float64)])
    both = solve_kernel_elm(batch, torch.ones(2, 2).double(), 1e6)
    close(both[0], np.array([1 / (1 + 1e-6), 1 / (1e-6 - 1e-9)]), 1e-10)
    close(both[1], np.array([0.5e-16, 0.5e-16]), 1e-9)


# Errors and extremes -------------------------------------------------------------------------


def test_one_bin():
    beta = solve_kernel_elm(torch.tensor([[4.0]]), torch.tensor([1.0]), 0.5)
    assert beta.item() == pytest.approx(1 / 6)


@pytest.mark.parametrize("solve", [solve_kernel_elm, solve_kernel_elm_], ids=["kept", "in place"])
def test_single_precision_is_enough_up_to_a_condition(solve, rng):
    """The matrix carries 6e-8 of itself, so at 1 % of error the condition is 8e4."""
    x = rng.standard_normal((8, 8))
    basis = torch.from_numpy(np.linalg.qr(x)[0])
    targets = torch.from_numpy(rng.standard_normal(8))
    for condition, penalty in ((1e3, 1.0), (1e3, np.inf), (1e7, 1e9), (1e7, np.inf)):
        gram = (basis * torch.logspace(0, np.log10(condition), 8).double()) @ basis.mT
        single = gram.float(), targets.float(), penalty
        if condition > 1e5:
            with pytest.raises(
                ValueError, match=r"gram .* condition (?:of )?\d\.\de\+0[67], too much.*float32"
            ):
                solve(*single)
            continue
        beta = solve(*single)
        beta = beta if solve is solve_kernel_elm else beta.x
        assert beta.dtype == torch.float32
        expected = np.linalg.solve(gram.numpy() + np.eye(8) / penalty, targets.numpy())
        close(beta, expected, 1e3 * 1.2e-7)


def test_one_matrix_of_a_batch_may_be_singular(rng):
    """The others keep the bits that they have alone."""
    z, targets, weights = tensors(*draw(rng, 6, 3))
    twice = z.clone()
    twice[3:] = z[:3]
    grams = torch.stack([PAPER_KERNEL(z, z), PAPER_KERNEL(twice, twice), PAPER_KERNEL(z, z)])
    batch = grams, targets.expand(3, 6), 1e15, weights.expand(3, 6)
    together = solve_kernel_elm(*batch)
    alone = torch.cholesky_solve(
        targets[:, None], torch.linalg.cholesky(grams[0] + torch.diag(1 / (1e15 * weights)))
    )
    assert torch.equal(together[0], alone[:, 0])
    assert torch.equal(together[2], alone[:, 0])
    roots = weights.numpy() ** 0.5
    weighted = roots[:, None] * grams[1].numpy() * roots
    expected = roots * (np.linalg.pinv(weighted, rcond=1e-13) @ (roots * targets.numpy()))
    close(together[1], expected, 1e-9)


def test_derivatives_of_an_escalated_solve(rng):
    """Of the scores, at constant rank: bins that are there twice stay so."""
    z, targets, weights = draw(rng, 4, 3)
    targets = np.r_[targets, -targets[:2], targets[2:]]
    z, targets, weights, new = tensors(z, targets, np.r_[weights, weights], z[:2] / 2)

    def scores(z, targets, weights):
        twice = z.repeat(2, 1)
        beta = solve_kernel_elm(PAPER_KERNEL(twice, twice), targets, 1e14, weights)
        return PAPER_KERNEL(new, twice) @ beta

    inputs = [tensor.requires_grad_() for tensor in (z, targets, weights)]
    assert torch.autograd.gradcheck(scores, inputs)
    assert torch.autograd.gradgradcheck(scores, inputs, atol=1e-4)


@pytest.mark.parametrize("penalty", [0.0, -1.0, float("nan")])
def test_penalty_must_be_positive(penalty):
    with pytest.raises(ValueError, match=f"positive, got {penalty}"):
        solve_kernel_elm(torch.eye(2), torch.ones(2), penalty)
    with pytest.raises(ValueError, match=f"positive, got {penalty}"):
        solve_primal(torch.eye(2), torch.ones(2), penalty)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match=r"\(3, 2\).*\(2,\)"):
        solve_kernel_elm(torch.zeros(3, 2), torch.ones(2), 1.0)
    with pytest.raises(ValueError, match=r"\(2, 2\).*\(3,\)"):
        solve_kernel_elm(torch.eye(2), torch.ones(3), 1.0)
    with pytest.raises(ValueError, match=r"\(3, 2\).*\(2,\)"):
        solve_primal(torch.zeros(3, 2), torch.ones(2), 1.0)
    with pytest.raises(ValueError, match="weights"):
        solve_kernel_elm(torch.eye(3), torch.ones(3), 1.0, torch.ones(1))
    with pytest.raises(ValueError, match="weights"):
        solve_primal(torch.zeros(3, 2), torch.ones(3), 1.0, torch.ones(1))


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_weights_must_be_positive(bad):
    weights = torch.tensor([1.0, bad, 1.0])
    with pytest.raises(ValueError, match="weights must be positive"):
        solve_kernel_elm(10 * torch.eye(3), torch.ones(3), 1.0, weights)


@pytest.mark.parametrize("num_bins", [8, 40])
@pytest.mark.parametrize("weighted", [False, True])
def test_an_infinite_penalty_is_the_limit_of_large_ones_and_keeps_the_weights(
    rng, num_bins, weighted
):
    """Fewer bins than features, and more: minimum-norm (weighted) least squares either way."""
    features = torch.from_numpy(rng.standard_normal((num_bins, 12)))
    targets = torch.from_numpy(rng.choice([-1.0, 1.0], num_bins))
    weights = torch.from_numpy(rng.uniform(0.2, 3.0, num_bins)) if weighted else None
    root = np.sqrt(weights.numpy()) if weighted else np.ones(num_bins)
    expected, *_ = np.linalg.lstsq(
        features.numpy() * root[:, None], targets.numpy() * root, rcond=None
    )
    primal = solve_primal(features, targets, float("inf"), weights)
    beta = solve_kernel_elm(features @ features.T, targets, float("inf"), weights)
    np.testing.assert_allclose(primal.numpy(), expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose((features.T @ beta).numpy(), expected, rtol=1e-7, atol=1e-9)
