"""From a second pass to a machine, in any order, on any number of workers and processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import torch
import torch.distributed
from torch import Tensor

from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.ledger import Ledger, content_digest
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Head, Polynomial, QuadraticForm
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.training.selection import Plan, Progress


class TrainingPass:
    """What a plan needs of the training bins, gathered recording by recording.

    Sums of fixed size for polynomial kernels and many bins; the bins themselves where they are few
    or the kernel is another.

    Args:
        plan: what was decided.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.ledger = Ledger()
        self.bins: dict[str, tuple[Tensor, ...]] = {}
        self.stats: SufficientStats | None = None
        if plan.adds_up:
            assert isinstance(plan.kernel, Polynomial)
            self.stats = SufficientStats(plan.frame.size, degree=plan.kernel.degree)

    def update(
        self, recording: str, features: Tensor, is_slip: Tensor, scene: str = PAPER_SCENE
    ) -> None:
        """Add the training bins of a recording, ``[N, F]`` and ``[N]``.

        Raises:
            ValueError: if the recording is there already.
        """
        plan = self.plan
        z, labels = training_part(plan, recording, features, is_slip)
        of_class = torch.tensor(plan.scene_weights.get(scene, (1.0, 1.0)), dtype=torch.float64)
        each = plan.stands_for / (2.0 if plan.drop_channels > 0 else 1.0)  # two copies
        weights = of_class[labels.long()] * each
        if self.stats is not None:
            self.stats.update(recording, z, labels, weights)
            return
        self.ledger.add(recording, content_digest(z, labels))
        self.bins[recording] = (z, labels, weights)

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
            ValueError: if a class is absent, or the system cannot be told in float64.
        """
        plan = self.plan
        if self.stats is not None:
            return solve_sums(plan, self.stats)
        parts = [self.bins[name] for name in sorted(self.bins)]
        z, is_slip, weights = (torch.cat(part) for part in zip(*parts, strict=True))
        if _balance(plan) == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights = weights * (len(z) / (2 * counts.double()))[is_slip.long()]
        return fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)


def training_part(
    plan: Plan, recording: str, features: Tensor, is_slip: Tensor
) -> tuple[Tensor, Tensor]:
    """Scaled columns and labels of the bins of a recording that are trained on.

    With ``plan.drop_channels`` they come twice, without some channels the second time, each copy
    counting half.
    """
    kept = _is_kept(recording, is_slip, plan.shares)
    z = plan.frame(features[kept])
    pooling = plan.frame.pooling
    if plan.drop_channels == 0 or pooling is None:
        return z, is_slip[kept]
    num = len(pooling.hand)
    keys = bin_keys(f"{recording}, channels", num + 1)
    most = math.floor(plan.drop_channels * num)
    left_out = keys[1:].argsort()[: math.floor(float(keys[0]) * (most + 1))]
    is_missing = torch.zeros(num, dtype=torch.bool)
    is_missing[left_out] = True
    fewer = plan.frame(features[kept], is_missing.expand(len(z), num))
    return torch.cat([z, fewer]), is_slip[kept].repeat(2)


def solve_sums(plan: Plan, stats: SufficientStats) -> QuadraticForm:
    """The machine of sums.

    Raises:
        ValueError: if the plan's kernel is of another degree than the sums, a class is absent, or
            the system cannot be told in float64.
    """
    if not isinstance(plan.kernel, Polynomial) or plan.kernel.degree != stats.degree:
        raise ValueError(
            f"these sums need a polynomial kernel of degree {stats.degree}, the plan has "
            f"{plan.kernel}"
        )
    return stats.solve(plan.penalty, plan.kernel.offset, balance=_balance(plan))


def solve_facts(head: Head) -> dict[str, Any]:
    """How a machine was solved for, JSON-able: method, condition, error (``SolveReport``)."""
    return {} if head.solved is None else head.solved.facts()


def _balance(plan: Plan) -> Literal["weights", "none"]:
    """How classes are balanced when a machine is solved; weights of scenes hold it already."""
    return "weights" if plan.balance == "weights" and not plan.scene_weights else "none"


def _is_kept(recording: str, is_slip: Tensor, shares: Sequence[float]) -> Tensor:
    """Undersampling that depends on the bin alone, so on no order and no worker."""
    if all(share >= 1 for share in shares):
        return torch.ones_like(is_slip)
    place = bin_keys(recording, len(is_slip))  # [N] in [0, 1)
    return place < torch.tensor(shares, dtype=torch.float64)[is_slip.long()]


Made = TypeVar("Made")


def _num_ranks() -> int:
    ready = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if ready else 1


def of_all_ranks(own: Made) -> list[Made]:
    """What every process holds, in the order of their ranks."""
    if _num_ranks() == 1:
        return [own]
    parts: list[Any] = [None] * _num_ranks()
    torch.distributed.all_gather_object(parts, own)
    return parts


def from_first_rank(make: Callable[[], Made]) -> Made:
    """What the first process makes, in every process; its error as well, so that none waits."""
    if _num_ranks() == 1:
        return make()
    box: list[Any] = [None, None]
    if torch.distributed.get_rank() == 0:
        try:
            box[0] = make()
        except Exception as error:
            box[1] = error
    torch.distributed.broadcast_object_list(box)
    if box[1] is not None:
        raise box[1]
    made: Made = box[0]
    return made


def sum_over_ranks(gathered: TrainingPass) -> None:
    """Put together what every process gathered in the second pass; sums by one all-reduce."""
    if _num_ranks() == 1:
        return
    if gathered.stats is None:
        for rank, part in enumerate(of_all_ranks(gathered)):
            if rank != torch.distributed.get_rank():
                gathered.merge(part)
        return
    stats = gathered.stats
    parts = of_all_ranks((stats.ledger, stats.count))
    stats.ledger = Ledger()
    for ledger, _ in parts:
        stats.ledger.merge(ledger)  # refuses a recording that two of them saw
    stats.count = torch.stack([count for _, count in parts]).sum(0)
    torch.distributed.all_reduce(stats.sums)
