"""From the training bins of a plan to its machine, in any order, on any number of processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import torch
import torch.distributed
from torch import Tensor

from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Head, Polynomial
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.runtime import SeenBatches, content_digest
from tactslip_torch.training.selection import Plan

Made = TypeVar("Made")


class TrainingPass:
    """What a plan needs of the training bins, gathered recording by recording.

    Sums of fixed size for polynomial kernels and many bins; the bins themselves where they are few
    or the kernel is another.

    Args:
        plan: what was decided.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.seen_batches = SeenBatches()
        self.bins: dict[str, tuple[Tensor, ...]] = {}
        self.stats: SufficientStats | None = None
        if plan.adds_up:
            assert isinstance(plan.kernel, Polynomial)
            self.stats = SufficientStats(plan.selection.size, degree=plan.kernel.degree)

    def update(
        self, recording: str, features: Tensor, is_slip: Tensor, scene: str = PAPER_SCENE
    ) -> None:
        """Add the training bins of a recording, ``[N, F]`` and ``[N]``.

        With ``recipe.drop_channels`` they come twice, without some channels the second time, each
        copy counting half.

        Raises:
            ValueError: if the recording is there already.
        """
        plan = self.plan
        kept = is_kept(recording, is_slip, plan.fractions)
        features, is_slip = features[kept], is_slip[kept].bool()
        z, pooling = plan.selection(features), plan.selection.pooling
        of_class = torch.tensor(plan.scene_weights.get(scene, (1.0, 1.0)), dtype=torch.float64)
        weights = plan.bin_weight * of_class[is_slip.long()]
        if plan.recipe.drop_channels > 0 and pooling is not None:
            is_missing = _dropped(recording, len(pooling.hand), plan.recipe.drop_channels)
            fewer = plan.selection(features, is_missing.expand(len(z), -1))
            z, is_slip, weights = torch.cat([z, fewer]), is_slip.repeat(2), weights.repeat(2) / 2
        if self.stats is not None:
            self.stats.update(recording, z, is_slip, weights)
            return
        self.seen_batches.add(recording, content_digest(z, is_slip))
        self.bins[recording] = (z, is_slip, weights)

    def merge_processes(self) -> None:
        """Put together what every process of a distributed fit gathered.

        Raises:
            ValueError: if two of them saw one recording.
        """
        if _num_processes() == 1:
            return
        stats = self.stats
        if stats is None:
            parts = of_all_processes((self.seen_batches, self.bins))
            self.seen_batches = _merged(seen for seen, _ in parts)
            self.bins = {name: own for _, bins in parts for name, own in bins.items()}
            return
        stats.seen_batches = _merged(of_all_processes(stats.seen_batches))
        for total in (stats.sums, stats.count):
            torch.distributed.all_reduce(total)

    def solve(self) -> Head:
        """The machine.

        Raises:
            ValueError: if a class is absent, or the system cannot be told in float64.
        """
        plan = self.plan
        balance: Literal["weights", "none"] = "none"
        if plan.recipe.balance == "weights" and not plan.scene_weights:  # which are balanced
            balance = "weights"
        if self.stats is not None:
            assert isinstance(plan.kernel, Polynomial)
            return self.stats.solve(plan.penalty, plan.kernel.offset, balance=balance)
        parts = [self.bins[name] for name in sorted(self.bins)]
        z, is_slip, weights = (torch.cat(part) for part in zip(*parts, strict=True))
        if balance == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights = weights * (len(z) / (2 * counts.double()))[is_slip.long()]
        return fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)


def solve_metadata(head: Head) -> dict[str, Any]:
    """How a machine was solved for, JSON-able: method, condition, error (``SolveReport``)."""
    return {} if head.solved is None else head.solved.facts()


def is_kept(recording: str, is_slip: Tensor, fractions: Sequence[float]) -> Tensor:
    """Which bins ``[N]`` of a recording are trained on; it depends on the bin alone."""
    if all(fraction >= 1 for fraction in fractions):
        return torch.ones_like(is_slip, dtype=torch.bool)
    keys = bin_keys(recording, len(is_slip))  # [N] in [0, 1)
    return keys < torch.tensor(fractions, dtype=torch.float64)[is_slip.long()]


def _dropped(recording: str, num: int, largest: float) -> Tensor:
    """Channels that the second copy of a recording is without, ``[num]``, bool."""
    keys = bin_keys(f"{recording}, channels", num + 1)
    order = keys[1:].argsort()[: math.floor(float(keys[0]) * (math.floor(largest * num) + 1))]
    return torch.zeros(num, dtype=torch.bool).index_fill(0, order, True)


# Processes of a distributed fit -------------------------------------------------------------


def _num_processes() -> int:
    ready = torch.distributed.is_available() and torch.distributed.is_initialized()
    return torch.distributed.get_world_size() if ready else 1


def of_all_processes(own: Made) -> list[Made]:
    """What every process holds, in the order of their ranks."""
    if _num_processes() == 1:
        return [own]
    parts: list[Any] = [None] * _num_processes()
    torch.distributed.all_gather_object(parts, own)
    return parts


def from_first_process(make: Callable[[], Made]) -> Made:
    """What the first process makes, in every process; its error as well, so that none waits."""
    if _num_processes() == 1:
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


def _merged(parts: Any) -> SeenBatches:
    whole = SeenBatches()
    for seen in parts:
        whole.merge(seen)  # refuses a recording that two of them saw
    return whole
