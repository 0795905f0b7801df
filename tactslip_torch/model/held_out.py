"""What each training bin would score had its whole group been left out, without refitting.

The weights of the machine are redone; features, scaling and bin weights stay. A group is a bin, a
cycle, a material: whatever must not stand on both sides of a validation. With ``G = K +
diag(1 / (C w))`` and ``beta = G^-1 t`` the residuals of a group under the machine without it are
``e_g = ((G^-1)_gg)^-1 beta_g``; in the primal ``e_g = (I - H_gg)^-1 (t - Phi v)_g`` with the hat
matrix ``H = Phi A^-1 Phi' W``. Either way one Cholesky factor serves all groups.

Reference:
    Rasmussen and Williams, Gaussian Processes for Machine Learning, section 5.4.2, and An, Liu and
    Venkatesh (2007), Pattern Recognition 40(8), 2154-2162, for blocks.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.cholesky import forward_solve
from tactslip_torch.model.downdate import Monomials, residuals_by_block, residuals_by_iteration
from tactslip_torch.model.fit import Route, TrainingBins, machine_of, takes_dual
from tactslip_torch.model.kernel_elm import solve_normal_equations_
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import PAPER_KERNEL, Kernel, Polynomial, lower_gram
from tactslip_torch.model.left_out import (
    MOST_CONDITION,
    TILE,
    Groups,
    check_penalty,
    chunks_of,
    leave_out_,
    order_groups,
    products_within,
)
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.runtime import for_each

_ITERATIONS = 60  # that conjugate gradients usually take
_WAIT = 30  # groups whose triangular solves take as long as reading a factor does


class HeldOutFit(NamedTuple):
    """A machine, and what its training bins would score without their groups.

    Attributes:
        head: the machine of all bins.
        scores: ``[N]``, each from the machine that never met the bin's group.
    """

    head: QuadraticForm | KernelSum
    scores: Tensor


class HeldOut:
    """Exact leave-one-group-out scores for any number of values of C.

    Through the primal or the dual as ``fit_machine``. The matrix that does not depend on C is kept,
    ``[P, P]`` or ``[N, N]``, and ``at`` takes another one of that size. Beyond the fit it costs
    about one and a half factorisations in the dual. In the primal all large groups together cost
    two triangular solves an iteration, of which there are some 30 to 200, more with C; a bin of
    the small ones costs ``P^2 / 2`` multiply-adds.

    Args:
        bins: scaled training bins; float32 is promoted exactly.
        groups: ``[N]``, whole numbers; bins of one group need not stand together.
        kernel: of the machine.
        route: ``"auto"``, or the one to take.

    Raises:
        ValueError: if shapes disagree, all bins are one group, leaving a group (named)
            out leaves one class, or the primal is asked of a kernel that does not fold.
    """

    def __init__(
        self,
        bins: TrainingBins,
        groups: Tensor,
        kernel: Kernel = PAPER_KERNEL,
        route: Route = "auto",
    ) -> None:
        bins = bins.double()
        order, self._groups = order_groups(groups, bins.is_slip)
        self._order, self._kernel = order, kernel
        self._z, self._targets = bins.features[order], bins.targets[order]
        weights = torch.ones_like(bins.targets) if bins.weights is None else bins.weights
        self._weights = weights[order]
        self._monomials = _monomials_of(kernel, self._z, route)
        if self._monomials is None:
            self._system = lower_gram(kernel, self._z)
        else:
            self._system = self._monomials.normal_matrix(self._z, self._weights)

    def at(self, penalty: float) -> HeldOutFit:
        """The machine and the held-out scores for one value of C, from one factorisation.

        The scores are right to 100 eps times the condition of the system of all bins.

        Args:
            penalty: the paper's ``C``, positive and finite.

        Raises:
            ValueError: if the penalty is not that, the condition is above ``MOST_CONDITION``, or
                the machine without a group (named) cannot be told in float64.
        """
        check_penalty(penalty)
        if self._monomials is None:
            head, residuals = self._dual(penalty)
        else:
            head, residuals = self._primal(penalty, self._monomials)
        scores = torch.empty_like(residuals)
        scores[self._order] = self._targets - residuals
        return HeldOutFit(head, scores)

    def _dual(self, penalty: float) -> tuple[QuadraticForm | KernelSum, Tensor]:
        left_out = leave_out_(
            self._system.clone(), self._targets, penalty, self._weights, self._groups
        )
        head = machine_of(self._z, left_out.beta, self._kernel)
        head.solved = left_out.report
        return head, left_out.residuals

    def _primal(self, penalty: float, monomials: Monomials) -> tuple[QuadraticForm, Tensor]:
        factor, z = self._system.clone(), self._z
        moment = monomials.gather(z, self._weights * self._targets)
        weights, report = solve_normal_equations_(
            factor, moment, penalty, most_condition=MOST_CONDITION
        )
        head = monomials.head(weights)
        head.solved = report
        roots = self._weights.sqrt()
        right = roots * (self._targets - head(z))
        solved = torch.empty_like(right)
        small = _num_small(self._groups, monomials.number)
        for groups, part in chunks_of(self._groups[:small]):
            left = _left_within(factor, monomials, z[part], roots[part], groups)
            solved[part] = residuals_by_block(left, right[part], groups)
        if small < len(self._groups):
            groups = self._groups[small:]
            part = slice(len(z) - sum(size for _, size in groups), len(z))
            solved[part] = residuals_by_iteration(
                factor, monomials, z[part], roots[part], right[part], groups
            )
        return head, solved / roots


def _monomials_of(kernel: Kernel, z: Tensor, route: Route) -> Monomials | None:
    """The primal's unknowns; none for the dual."""
    if not isinstance(kernel, Polynomial) or not kernel.collapses:
        if route == "primal":
            raise ValueError(f"{kernel} has no primal of fixed size; take route='dual' or 'auto'")
        return None
    monomials = Monomials(kernel, z.shape[1])
    cheaper = takes_dual(kernel, len(z), z.shape[1])
    return None if route == "dual" or (route == "auto" and cheaper) else monomials


def _num_small(groups: Groups, num_monomials: int) -> int:
    """How many of the groups, by ascending size, cost less as blocks than by iterations.

    In units of ``P^2 / 2`` multiply-adds a block costs a triangular solve for each bin, products
    of those, and a factor; an iteration two triangular solves, a quadratic form and its transpose.
    """
    savings = []
    for _, size in groups:
        share = size / num_monomials
        block = size * (1 + share + share**2 / 3)
        savings.append(block - _ITERATIONS * (2 + 8 * share))
    large = [saving for saving in savings if saving > 0]
    return len(groups) - (len(large) if sum(large) > _ITERATIONS * 2 * _WAIT else 0)


def _left_within(
    factor: Tensor, monomials: Monomials, z: Tensor, roots: Tensor, groups: Groups
) -> Tensor:
    """``I - W^1/2 Phi (L L')^-1 Phi' W^1/2`` between bins of one group, 0 across; lower triangle.

    Shape:
        - factor: ``[P, P]``; z: ``[n, K]``; roots: ``[n]``; output: ``[n, n]``
    """
    columns = factor.new_empty(len(z), len(factor))

    def fill(start: int) -> None:
        tile = slice(start, start + TILE)
        scaled = monomials.of(z[tile]) * roots[tile, None]
        columns[tile] = forward_solve(factor, scaled.mT).mT

    for_each(fill, range(0, len(z), TILE))
    left = products_within(columns, groups, triangular=False).neg_()
    left.diagonal().add_(1)
    return left
