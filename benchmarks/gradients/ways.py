"""The ways that ``benchmarks.gradients`` measures: each makes a loss from what can be learned."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from benchmarks.gradients.sizes import Kind
from benchmarks.model.synthetic import SyntheticBins
from tactslip_torch.model.fit import Route, TrainingBins, fit_machine, fit_quadratic
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.leave_one_group_out import HeldOut, held_out_scores

BASE, OURS, PEER = "forward alone", "differentiable", "autograd"


class Subject(NamedTuple):
    """What a loss is made from.

    Attributes:
        z: features of the training bins, ``[N, K]``.
        penalty: the paper's ``C``, a scalar.
        offset: the paper's ``c``, a scalar.
        weights: of the bins, ``[N]``.
        is_slip: of the bins, ``[N]``.
        groups: of the bins, ``[N]``.
        new: features of other bins, ``[M, K]``.
        new_is_slip: of those, ``[M]``.
    """

    z: Tensor
    penalty: Tensor
    offset: Tensor
    weights: Tensor
    is_slip: Tensor
    groups: Tensor
    new: Tensor
    new_is_slip: Tensor

    @classmethod
    def made(
        cls,
        num_bins: int,
        num_features: int,
        groups: int,
        scored: int,
        penalty: float,
        offset: float,
    ) -> Subject:
        """Synthetic bins; a gradient is wanted of features, C, c and weights."""
        source = SyntheticBins(num_features)
        z, is_slip = source.training(num_bins)
        strength, shift = (torch.tensor(of, dtype=torch.float64) for of in (penalty, offset))
        weights = torch.linspace(0.5, 1.5, num_bins, dtype=torch.float64)
        group = torch.arange(num_bins) % groups
        subject = cls(z, strength, shift, weights, is_slip, group, *source.held_out(scored))
        for tensor in subject.learned:
            tensor.requires_grad_()
        return subject

    @property
    def learned(self) -> tuple[Tensor, ...]:
        """What a gradient is wanted of."""
        return self[:4]

    @property
    def bins(self) -> TrainingBins:
        """Without a gradient."""
        return TrainingBins(self.z.detach(), self.is_slip, self.weights.detach())

    @property
    def kernel(self) -> Polynomial:
        """Without a gradient."""
        return Polynomial(2, self.offset.item())


def loss_of(scores: Tensor, is_slip: Tensor) -> Tensor:
    """Mean logistic loss."""
    return softplus(torch.where(is_slip, -scores, scores)).mean()


def fitted(subject: Subject, route: Route) -> Tensor:
    """Loss on other bins, without a way back."""
    machine = fit_machine(subject.bins, subject.penalty.item(), subject.kernel, route=route)
    return loss_of(machine(subject.new), subject.new_is_slip)


def fitted_with_way_back(subject: Subject, route: Route) -> Tensor:
    """The same with one."""
    z, penalty, offset, weights = subject.learned
    machine = fit_quadratic(z, subject.is_slip, penalty, offset, weights, route)
    return loss_of(machine(subject.new), subject.new_is_slip)


def fitted_by_autograd(subject: Subject, route: Route) -> Tensor:
    """The same as anybody would write it first: through the Gram matrix and its factor."""
    z, penalty, offset, weights = subject.learned
    targets = torch.where(subject.is_slip, 1.0, -1.0).double()
    system = (z @ z.mT + offset) ** 2 + torch.diag(1 / (penalty * weights))
    beta = torch.cholesky_solve(targets[:, None], torch.linalg.cholesky(system))[:, 0]
    return loss_of((subject.new @ z.mT + offset) ** 2 @ beta, subject.new_is_slip)


def left_out(subject: Subject, route: Route) -> Tensor:
    """Loss of groups left out, without a way back."""
    machine = HeldOut(subject.bins, subject.groups, subject.kernel, route)
    return loss_of(machine.at(subject.penalty.item()).scores, subject.is_slip)


def left_out_with_way_back(subject: Subject, route: Route) -> Tensor:
    """The same with one."""
    z, penalty, offset, weights = subject.learned
    scores = held_out_scores(z, subject.is_slip, subject.groups, penalty, offset, weights)
    return loss_of(scores, subject.is_slip)


def left_out_by_autograd(subject: Subject, route: Route) -> Tensor:
    """The same as anybody would write it first: a fit without each group."""
    z, penalty, offset, weights = subject.learned
    targets = torch.where(subject.is_slip, 1.0, -1.0).double()
    scores = torch.zeros_like(targets)
    for name in subject.groups.unique():
        own, out = subject.groups == name, subject.groups != name
        system = (z[out] @ z[out].mT + offset) ** 2 + torch.diag(1 / (penalty * weights[out]))
        beta = torch.cholesky_solve(targets[out, None], torch.linalg.cholesky(system))[:, 0]
        scores = scores.index_put((own,), (z[own] @ z[out].mT + offset) ** 2 @ beta)
    return loss_of(scores, subject.is_slip)


Way = Callable[[Subject, Route], Tensor]
_FITTED: dict[str, Way] = {
    BASE: fitted,
    OURS: fitted_with_way_back,
    PEER: fitted_by_autograd,
}
_LEFT_OUT: dict[str, Way] = {
    BASE: left_out,
    OURS: left_out_with_way_back,
    PEER: left_out_by_autograd,
}


def way_of(kind: Kind, name: str) -> Callable[[Subject], Tensor]:
    """A way by its name: from a subject to a loss."""
    if kind == "left out":
        return lambda subject: _LEFT_OUT[name](subject, "dual")
    return lambda subject: _FITTED[name](subject, kind)
