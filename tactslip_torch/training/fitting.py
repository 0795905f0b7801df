"""From a second pass to a machine, in any order and on any number of workers."""

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
from tactslip_torch.model.cholesky import from_above
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernel_elm import solve_normal_equations_
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.training.selection import Plan, Progress

Head = QuadraticForm | KernelSum
GRID_BITS = 38  # of sums that hold 2^24 bins


class LinearSums:
    """Sums of fixed size that a machine of degree 1 is solved from, in either class.

    Whole multiples of ``2 ** -GRID_BITS``, rounded once for each batch of bins: the same bits in
    any order and on any number of workers.

    Args:
        num_features: K.
    """

    def __init__(self, num_features: int) -> None:
        size = num_features + 1
        self.sums = torch.zeros(2, size, size, dtype=torch.int64)

    def update(self, z: Tensor, is_slip: Tensor, weights: Tensor) -> None:
        """Add bins.

        Shape:
            - z: ``[N, K]``, in ``[-1, 1]``; is_slip: ``[N]``, bool; weights: ``[N]``

        Raises:
            ValueError: if a number is not finite, or the grid has no room.
        """
        x = torch.cat([z, torch.ones_like(z[:, :1])], 1)
        for kind, mine in enumerate((~is_slip, is_slip)):
            products = (x[mine] * weights[mine, None]).mT @ x[mine]
            if not bool((products.abs() + self.count[kind] < 2.0 ** (62 - GRID_BITS)).all()):
                raise ValueError("sums of degree 1 take finite features of 16 million bins at most")
            self.sums[kind] += (products * 2.0**GRID_BITS).round().long()

    @property
    def count(self) -> Tensor:
        """Weight of the bins of non-slip and of slip, ``[2]``."""
        return self.sums[:, -1, -1].double() / 2.0**GRID_BITS

    def merge(self, other: LinearSums) -> None:
        """Add the bins of another."""
        self.sums += other.sums

    def solve(self, penalty: float, offset: float, balance: str) -> QuadraticForm:
        """The machine.

        Raises:
            ValueError: if a class is absent or a number is not finite.
        """
        all_products = self.sums.double() / 2.0**GRID_BITS
        count = self.count
        if not bool((count > 0).all()):
            raise ValueError("training needs bins of both classes; add recordings with the other")
        weight = torch.ones(2, dtype=torch.float64)
        if balance == "weights":
            weight = count.sum() / (2 * count)
        unit = torch.ones(all_products.shape[1], dtype=torch.float64)
        unit[-1] = math.sqrt(offset)  # of the constant
        normal = (all_products * weight[:, None, None]).sum(0) * unit * unit[:, None]
        sums = all_products[:, :, -1] * weight[:, None]
        solved, report = solve_normal_equations_(
            normal, (sums[1] - sums[0]) * unit, penalty, restore=from_above
        )
        head = QuadraticForm(solved.new_zeros(0, 0), solved[:-1], unit[-1] * solved[-1])
        head.solved = report
        return head


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
        self.linear = LinearSums(plan.frame.size) if plan.is_linear else None
        self.stats = SufficientStats(plan.frame.size) if plan.adds_up else None

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
        if self.linear is None:
            self.bins[recording] = (z, labels, weights)
        else:
            self.linear.update(z, labels, weights)

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
        if self.linear is not None and other.linear is not None:
            self.linear.merge(other.linear)

    def solve(self, progress: Progress | None = None) -> Head:
        """The machine.

        Raises:
            ValueError: if a class is absent, a number is not finite, or the sums are too coarse
            for this penalty.
        """
        plan = self.plan
        if self.stats is not None:
            return solve_sums(plan, self.stats)
        is_balanced = plan.balance == "weights" and not plan.scene_weights  # which hold balance
        if self.linear is not None:
            assert isinstance(plan.kernel, Polynomial)  # is_linear
            balance = "weights" if is_balanced else "none"
            return self.linear.solve(plan.penalty, plan.kernel.offset, balance)
        parts = [self.bins[name] for name in sorted(self.bins)]
        z, is_slip, weights = (torch.cat(part) for part in zip(*parts, strict=True))
        if is_balanced:
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
    shares = of_all_ranks((stats.ledger, stats.count, stats.sums[:, 0].tolist()))
    stats.ledger = Ledger()
    for ledger, _, _ in shares:
        stats.ledger.merge(ledger)  # refuses a recording that two of them saw
    own = torch.distributed.get_rank()
    others = [brought for rank, (_, _, brought) in enumerate(shares) if rank != own]
    stats.check_capacity([sum(of_class) for of_class in zip(*others, strict=True)])
    stats.count = torch.stack([count for _, count, _ in shares]).sum(0)
    torch.distributed.all_reduce(stats.sums)
