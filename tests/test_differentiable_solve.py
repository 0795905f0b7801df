import numpy as np
import pytest
import torch
from torch import Tensor

from tactslip_torch.model.differentiable_solve import DENSE, System, solve_by_factor
from tactslip_torch.model.kernel_elm import solve_kernel_elm

# torch's own, in forward mode
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.script. is deprecated")


def drawn(rng: np.random.Generator, *batch: int) -> tuple[Tensor, Tensor]:
    """A root of a well-posed matrix, and a right-hand side."""
    root = torch.from_numpy(rng.standard_normal((*batch, 5, 4)))
    return root.requires_grad_(), torch.from_numpy(
        rng.standard_normal((*batch, 5))
    ).requires_grad_()


def matrix_of(root: Tensor) -> Tensor:
    return root @ root.mT + torch.eye(5).double()


def by_factor(root: Tensor, right: Tensor) -> Tensor:
    matrix = matrix_of(root)
    return solve_by_factor(DENSE, torch.linalg.cholesky(matrix.detach()), right, matrix)


def by_autograd(root: Tensor, right: Tensor) -> Tensor:
    return torch.linalg.solve(matrix_of(root), right)


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_derivatives_of_every_kind(batch, rng):
    """Backwards, forwards, batched and twice: the factor moves with the matrix."""
    inputs = drawn(rng, *batch)
    assert torch.autograd.gradcheck(
        by_factor, inputs, check_forward_ad=True, check_batched_grad=True
    )
    assert torch.autograd.gradgradcheck(by_factor, inputs)


def test_third_derivatives_are_those_through_the_factorisation(rng):
    inputs, draws = drawn(rng), [torch.from_numpy(rng.standard_normal((5, 4))) for _ in range(2)]

    def third(solve):
        value = solve(*inputs).square().sum()
        for draw in draws:
            (slope,) = torch.autograd.grad(value, inputs[0], create_graph=True)
            value = (slope * draw).sum()
        return torch.autograd.grad(value, inputs)

    for actual, expected in zip(third(by_factor), third(by_autograd), strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-10)


def test_transforms_of_functions_see_through(rng):
    root, right = (tensor.detach() for tensor in drawn(rng))
    for transform in (torch.func.jacrev, torch.func.jacfwd, torch.func.hessian):
        actual, expected = (transform(solve)(root, right) for solve in (by_factor, by_autograd))
        torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-10)


def test_the_gradient_of_a_matrix_is_symmetric(rng):
    root, right = (tensor.detach() for tensor in drawn(rng))
    matrix = matrix_of(root).requires_grad_()
    solve_kernel_elm(matrix, right, penalty=2.0).square().sum().backward()
    assert torch.equal(matrix.grad, matrix.grad.mT)
    assert float(matrix.grad.norm()) > 0.01


def test_the_way_back_factorises_nothing(rng, monkeypatch):
    root, right = drawn(rng)
    x = solve_kernel_elm(matrix_of(root), right, penalty=2.0)
    for name in ("cholesky", "cholesky_ex", "solve", "pinv"):
        monkeypatch.setattr(torch.linalg, name, None)
    (slope,) = torch.autograd.grad(x.square().sum(), root, create_graph=True)
    torch.autograd.grad(slope.square().sum(), [root, right])


def test_a_system_without_tangents_says_so(rng):
    root, right = (tensor.detach() for tensor in drawn(rng))
    backwards = System(DENSE.solve, DENSE.pulls)
    factor = torch.linalg.cholesky(matrix_of(root))

    def solve(matrix: Tensor) -> Tensor:
        return solve_by_factor(backwards, factor, right, matrix)

    with pytest.raises(NotImplementedError, match="taken backwards alone"):
        torch.func.jvp(solve, (matrix_of(root),), (torch.eye(5).double(),))
