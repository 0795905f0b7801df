"""From a second pass to a machine, in any order and on any number of workers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.ledger import Ledger, content_digest
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.planning import Plan, Progress

Head = QuadraticForm | KernelSum


class TrainingPass:
    """What a plan needs of the training bins, gathered recording by recording.

    Sums of fixed size for the kernel of degree 2 and many bins; the bins themselves where they are
    few or the kernel is another.

    Args:
        plan: what was decided.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.ledger = Ledger()
        self.bins: dict[str, tuple[Tensor, Tensor]] = {}
        self.stats: SufficientStats | None = None
        if plan.adds_up:
            self.stats = SufficientStats(len(plan.frame.selected))

    def update(self, recording: str, features: Tensor, is_slip: Tensor) -> None:
        """Add the training bins of a recording, ``[N, F]`` and ``[N]``.

        Raises:
            ValueError: if the recording is there already.
        """
        z, labels = training_part(self.plan, recording, features, is_slip)
        if self.stats is not None:
            self.stats.update(recording, z, labels)
            return
        self.ledger.add(recording, content_digest(z, labels))
        self.bins[recording] = (z, labels)

    def merge(self, other: TrainingPass) -> None:
        """Take over what another worker gathered.

        Raises:
            ValueError: if a recording is in both.
        """
        if self.stats is not None and other.stats is not None:
            self.stats.merge(other.stats)
            return
        self.ledger.merge(other.ledger)
        self.bins |= other.bins

    def solve(self, progress: Progress | None = None) -> Head:
        """The machine.

        Raises:
            ValueError: if a class is absent, a number is not finite, or the sums are too coarse
            for this penalty.
        """
        plan = self.plan
        if self.stats is not None:
            return solve_sums(plan, self.stats)
        parts = [self.bins[name] for name in sorted(self.bins)]
        z = torch.cat([part[0] for part in parts])
        is_slip = torch.cat([part[1] for part in parts])
        weights = torch.full((len(z),), plan.stands_for, dtype=torch.float64)
        if plan.balance == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights *= (len(z) / (2 * counts.double()))[is_slip.long()]
        return fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)


def training_part(
    plan: Plan, recording: str, features: Tensor, is_slip: Tensor
) -> tuple[Tensor, Tensor]:
    """Scaled selected features and labels of the bins of a recording that are trained on."""
    kept = _is_kept(recording, is_slip, plan.shares)
    return plan.frame(features[kept]), is_slip[kept]


def solve_sums(plan: Plan, stats: SufficientStats) -> QuadraticForm:
    """The machine of sums.

    Raises:
        ValueError: if the plan's kernel is not of degree 2, a class is absent, a number is
            not finite, or the sums are too coarse for this penalty.
    """
    if not isinstance(plan.kernel, Polynomial) or plan.kernel.degree != 2:
        raise ValueError(f"sums need a polynomial kernel of degree 2, the plan has {plan.kernel}")
    balance: Literal["weights", "none"] = "weights" if plan.balance == "weights" else "none"
    return stats.solve(plan.penalty, plan.kernel.offset, balance=balance)


def solve_facts(head: Head) -> dict[str, Any]:
    """How a machine was solved for, JSON-able: method, condition, error (``SolveReport``)."""
    return {} if head.solved is None else head.solved.facts()


def _is_kept(recording: str, is_slip: Tensor, shares: Sequence[float]) -> Tensor:
    """Undersampling that depends on the bin alone, so on no order and no worker."""
    if all(share >= 1 for share in shares):
        return torch.ones_like(is_slip)
    place = bin_keys(recording, len(is_slip))  # [N] in [0, 1)
    return place < torch.tensor(shares, dtype=torch.float64)[is_slip.long()]
