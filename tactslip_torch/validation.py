"""How good choices of K, kernel and C are on held-out groups, in closed form."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from torch import Tensor

from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Kernel
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.recipe import recalls_mean

log = logging.getLogger(__name__)

Progress = Callable[[Iterable[Any], str], Iterable[Any]]


def validate(
    bins: TrainingBins,
    groups: Tensor,
    names: Sequence[str],
    choices: Sequence[tuple[int, Kernel, float]],
    progress: Progress,
) -> list[dict[str, Any]]:
    """Balanced accuracy of each held-out group for each choice of K, kernel and C, in order.

    Args:
        bins: training bins, as many features as the largest K, best first.
        groups: ``[N]``, which group each bin is of, an index into ``names``.
        names: of the groups.
        choices: in any order; those of one K and kernel that stand together cost least.
        progress: wraps what is gone through.

    Returns:
        One row per choice; ``mean`` is over the groups that have bins of both classes.

    Raises:
        ValueError: if no group has, or held-out scores cannot be told (``HeldOut``).
    """
    rows = []
    machine: HeldOut | None = None
    made_of: Any = None
    for number in progress(range(len(choices)), "choose C on held-out groups"):
        size, kernel, penalty = choices[number]
        if made_of != (size, kernel):
            few = TrainingBins(bins.features[:, :size], bins.is_slip, bins.weights)
            machine, made_of = HeldOut(few, groups, kernel), (size, kernel)
        assert machine is not None
        scores = machine.at(penalty).scores
        says_slip = scores >= 0
        by_group = {
            name: recalls_mean(says_slip[groups == index], bins.is_slip[groups == index])
            for index, name in enumerate(names)
        }
        known = [value for value in by_group.values() if value is not None]
        if not known:
            raise ValueError(
                "no validation group has bins of both classes; take another recipe.group_by, or "
                "one value of recipe.penalties"
            )
        rows.append(
            {
                "num_features": size,
                "kernel": kernel.to_dict(),
                "penalty": penalty,
                "mean": sum(known) / len(known),
                "balanced_accuracy": by_group,
                "calibration": _calibration(scores, bins),
            }
        )
    return rows


def _calibration(scores: Tensor, bins: TrainingBins) -> dict[str, Any] | None:
    """What held-out scores tell of slip, as plain values; None if they tell it backwards."""
    try:
        return fit_platt(scores, bins.is_slip, bins.weights).to_dict()
    except ValueError as error:
        log.warning("scores are not calibrated: %s", error)
        return None
