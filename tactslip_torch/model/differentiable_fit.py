"""The machine of degree 2 as a differentiable function of its bins, C, c and weights.

``fit_machine`` with a way back. Both routes go back by the factor of the way forward
(``differentiable_solve``), and nothing of the size of that factor is made again:

- *Dual*: ``G = K + diag(1 / (C w))`` with ``K_ij = (z_i . z_j + c)^2``, so that ``K x`` is a
  quadratic form of the bins, and ``u' G x`` one of K by K numbers.
- *Primal*: ``A = Phi' W Phi + I / C``, so that ``u' A x`` is a sum over bins of two quadratic
  forms. The monomials are taken at ``c = 1/2`` and scaled, which leaves c to a few factors.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import cholesky_solve
from tactslip_torch.model.differentiable_solve import System, solve_by_factor
from tactslip_torch.model.downdate import Monomials
from tactslip_torch.model.fit import Route, TrainingBins, goes_dual
from tactslip_torch.model.kernel_elm import solve_kernel_elm_, solve_normal_equations_
from tactslip_torch.model.kernels import Polynomial, lower_gram
from tactslip_torch.model.quadratic import (
    QuadraticForm,
    from_primal,
    num_quadratic_features,
    sum_of_quadratic_features,
)

_MOST_CONDITION = 1e12  # up to which a plain Cholesky solves; the way back needs its factor


def fit_quadratic(
    z: Tensor,
    targets: Tensor,
    penalty: Tensor | float,
    offset: Tensor | float = 0.5,
    weights: Tensor | None = None,
    route: Route = "auto",
) -> QuadraticForm:
    """The machine of ``fit_machine`` with ``Polynomial(2, offset)``, differentiable.

    Its numbers, and so its scores, know where they come from: any number of times differentiable
    in ``z``, real ``targets``, ``penalty``, ``offset`` and ``weights``. Going back costs a few
    products of the features with themselves and a solve by the factor, and keeps that alone.

    Args:
        z: scaled features of the bins; promoted to float64.
        targets: +1 for slip and -1 for non-slip, or any numbers; bool is taken as ``is_slip``.
        penalty: the paper's ``C``, positive and finite; a number or a tensor of one.
        offset: the kernel's ``c``, at least 0; likewise; positive if the primal is to
            have a derivative by it.
        weights: positive weight of each bin; default 1.
        route: ``"auto"``, which is that of ``fit_machine``, or the one to take.

    Shape:
        - z: ``[N, K]``; targets, weights: ``[N]``

    Raises:
        ValueError: if shapes disagree, a value is outside its range or not finite, or the system
            is too close to singular for a plain Cholesky.

    Example:
        >>> z = torch.tensor([[0.9], [0.2], [-0.7]]).double()
        >>> penalty = torch.tensor(1.0, requires_grad=True)
        >>> machine = fit_quadratic(z, torch.tensor([True, True, False]), penalty)
        >>> (slope,) = torch.autograd.grad(machine(z).square().sum(), penalty)
        >>> bool(slope > 0)  # a larger C follows the targets more closely
        True
    """
    z = z.double()
    if targets.dtype == torch.bool:
        targets = torch.where(targets, 1.0, -1.0)
    targets = targets.to(z)
    penalty, offset = (
        torch.as_tensor(number, dtype=z.dtype, device=z.device) for number in (penalty, offset)
    )
    fixed = None if weights is None else weights.detach()
    bins = TrainingBins(z.detach(), targets.detach() > 0, fixed).double()
    kernel, strength = Polynomial(2, offset.item()), penalty.item()
    if len(z) == 0 or not 0 < strength < math.inf:
        raise ValueError(
            f"a fit to be differentiated needs bins and a positive and finite penalty (the paper's "
            f"C), got {len(z)} bins and C={strength}; fit_machine takes an infinite one"
        )
    weights = torch.ones_like(targets) if weights is None else weights.double()
    solve = _solve_dual if goes_dual(bins, strength, kernel, route) else _solve_primal
    return solve(z, targets, penalty, offset, weights)


# Dual ----------------------------------------------------------------------------------------
def _solve_dual(
    z: Tensor, targets: Tensor, penalty: Tensor, offset: Tensor, weights: Tensor
) -> QuadraticForm:
    factor = lower_gram(Polynomial(2, offset.item()), z.detach())
    fixed = targets.detach(), penalty.item(), weights.detach()
    _, report = solve_kernel_elm_(factor, *fixed, most_condition=_MOST_CONDITION)
    ridge = 1 / (penalty * weights)
    beta = solve_by_factor(_DUAL, factor, targets, z, offset, ridge)
    bend, pull, total = _sums(z, beta)
    machine = QuadraticForm(bend, 2 * offset * pull, offset**2 * total)
    machine.solved = report
    return machine


def _pull_gram(
    u: Tensor, x: Tensor, z: Tensor, offset: Tensor, ridge: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """What ``-u' (K + diag(ridge)) x`` says of z, c and the ridge."""
    (bend_u, pull_u, total_u), (bend_x, pull_x, total_x) = _sums(z, u), _sums(z, x)
    slope_u, slope_x = z @ bend_u + offset * pull_u, z @ bend_x + offset * pull_x
    z_pull = -2 * (u[:, None] * slope_x + x[:, None] * slope_u)
    offset_pull = -2 * (pull_u @ pull_x + offset * total_u * total_x)
    return z_pull, offset_pull, -u * x


def _sums(z: Tensor, shares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``Z' diag(shares) Z``, ``Z' shares`` and ``sum(shares)``."""
    return z.mT @ (z * shares[:, None]), z.mT @ shares, shares.sum()


_DUAL = System(cholesky_solve, _pull_gram)


# Primal --------------------------------------------------------------------------------------
def _solve_primal(
    z: Tensor, targets: Tensor, penalty: Tensor, offset: Tensor, weights: Tensor
) -> QuadraticForm:
    if offset.requires_grad and not offset.item() > 0:
        raise ValueError(
            f"through the primal the machine has no derivative by an offset (the paper's c) of "
            f"{offset.item():g}; take a positive one, or route='dual'"
        )
    monomials = Monomials(Polynomial(2, offset.item()), z.shape[1])
    factor = monomials.normal_matrix(z.detach(), weights.detach())
    moment = sum_of_quadratic_features(z, weights * targets) * _scale(offset, z.shape[1])
    _, report = solve_normal_equations_(
        factor, moment.detach(), penalty.item(), most_condition=_MOST_CONDITION
    )
    solved = solve_by_factor(_PRIMAL, factor, moment, z, offset, weights, penalty)
    machine = _form(solved, offset, z.shape[1])
    machine.solved = report
    return machine


def _pull_normal(
    u: Tensor, x: Tensor, z: Tensor, offset: Tensor, weights: Tensor, penalty: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What ``-u' (Phi' W Phi + I / C) x`` says of z, c, the weights and C."""
    form_u, form_x = _form(u, offset, z.shape[1]), _form(x, offset, z.shape[1])
    score_u, score_x = form_u(z), form_x(z)
    pull_u, pull_x = -weights * score_x, -weights * score_u  # of the scores of u and of x
    z_pull = pull_u[:, None] * _slope(form_u, z) + pull_x[:, None] * _slope(form_x, z)
    offset_pull = _offset_slope(u, z, pull_u, offset) + _offset_slope(x, z, pull_x, offset)
    return z_pull, offset_pull, -score_u * score_x, u @ x / penalty**2


def _form(solved: Tensor, offset: Tensor, num_features: int) -> QuadraticForm:
    """The quadratic form of weights of ``quadratic_features(z, offset)``."""
    return from_primal(solved * _scale(offset, num_features), num_features)


def _scale(offset: Tensor, num_features: int) -> Tensor:
    """``quadratic_features(z, offset)`` in units of ``quadratic_features(z)``: ``[P]``."""
    num_squares = num_quadratic_features(num_features) - num_features - 1
    parts = torch.ones_like(offset), (2 * offset).sqrt(), 2 * offset
    sizes = torch.tensor([num_squares, num_features, 1], device=offset.device)
    return torch.stack(parts).repeat_interleave(sizes)


def _slope(form: QuadraticForm, z: Tensor) -> Tensor:
    """Derivative of the score by z: ``[N, K]``."""
    return 2 * z @ form.dense_quadratic + form.linear


def _offset_slope(solved: Tensor, z: Tensor, shares: Tensor, offset: Tensor) -> Tensor:
    """Derivative of ``shares . quadratic_features(z, offset) solved`` by the offset."""
    linear, constant = solved[-1 - z.shape[1] : -1], solved[-1]
    return (z.mT @ shares) @ linear / (2 * offset).sqrt() + constant * shares.sum()


_PRIMAL = System(cholesky_solve, _pull_normal)
