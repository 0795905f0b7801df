"""Statistics of a detector that was just trained: ``train statistics=true``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from tactslip_torch.adapting.bins import Witnesses
from tactslip_torch.adapting.statistics import Machine, Statistics, detector_digest
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.fitting import TrainingPass
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.planning import adds_up
from tactslip_torch.recipe import Recipe


def check_recipe(recipe: Recipe) -> None:
    """That a detector made this way can be solved again from sums.

    Raises:
        ValueError: if its kernel does not add up, a penalty is not finite, or it is chosen nested.
    """
    if recipe.validation == "nested":
        raise ValueError(
            "statistics=true needs a machine of degree 2 on features of channels, which "
            f"recipe={recipe.name} does not always make; take recipe=robust or recipe=paper"
        )
    if not all(adds_up(kernel) for kernel in recipe.kernels):
        raise ValueError(
            "statistics=true needs recipe.kernel=polynomial recipe.degree=2, whose bins add up; "
            f"got {recipe.kernels[0]}"
        )
    if not math.isfinite(most := recipe.penalties_ascending[-1]):
        raise ValueError(
            f"statistics=true needs finite recipe.penalties, got {most:g}: without a ridge no "
            "machine without a recording can be told"
        )


def gathered_statistics(
    gathered: TrainingPass,
    sample: SampledBins,
    materials: Mapping[str, str],
    labels: Mapping[str, Any],
    detector: SlipDetector,
) -> Statistics:
    """What a second pass gathered, with a sample of its bins.

    A machine of few bins was solved from the bins themselves; their sums give the same to rounding.

    Args:
        gathered: the second pass, with its plan.
        sample: of the first pass.
        materials: of each training recording, by its name.
        labels: arguments of ``LabelRule``.
        detector: that was solved.

    Raises:
        ValueError: if there is no room for a sum.
    """
    plan = gathered.plan
    assert isinstance(plan.kernel, Polynomial)  # check_recipe
    sums = gathered.stats
    if sums is None:
        sums = SufficientStats(len(plan.frame.selected))
        for name in sorted(gathered.bins):
            sums.update(name, *gathered.bins[name])
    return Statistics(
        sums,
        Machine(
            plan.penalty,
            plan.kernel.offset,
            "weights" if plan.balance == "weights" else "none",
        ),
        dict(labels),
        Witnesses.of(plan, sample, materials),
        detector_digest(detector),
        {},
        {},
    )
