"""What several processes of one run learned, put together; one process is its own all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
import torch.distributed

from tactslip_torch.fitting import TrainingPass
from tactslip_torch.ledger import Ledger

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
