"""From a first pass to a plan, from a second pass to a machine.

``plan_detector`` chooses features, scaling, K, c and C from what the first pass learned.
``TrainingPass`` gathers what the plan needs of every training bin, in any order and on any number
of workers, and solves.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import bin_keys
from tactslip_torch.features.survey import Survey
from tactslip_torch.ledger import Ledger, content_digest
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.held_out import HeldOut
from tactslip_torch.model.kernel_sum import KernelSum
from tactslip_torch.model.kernels import Kernel, Polynomial, kernel_from_dict
from tactslip_torch.model.quadratic import QuadraticForm, num_quadratic_features
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.model.sufficient import SufficientStats
from tactslip_torch.model.threshold import FeatureThreshold, best_threshold
from tactslip_torch.recipe import (
    Frame,
    Recipe,
    choose_frame,
    kept_shares,
    recalls_mean,
    stand_for,
)

log = logging.getLogger(__name__)

MOST_KEPT_BINS = 8192
"""So many bins at most where they are kept: their machine takes a matrix of bins by bins."""

Progress = Callable[[Iterable[Any], str], Iterable[Any]]
Head = QuadraticForm | KernelSum


@dataclass(frozen=True)
class Plan:
    """What is decided before the second pass.

    Args:
        frame: which features, how scaled.
        kernel: of the machine.
        penalty: the paper's ``C``.
        balance: how the classes are balanced.
        shares: of non-slip and slip bins that are trained on.
        num_bins: how many bins that will be; about, where shares are below 1.
        threshold: the best single selected feature, a rival to be reported beside.
        validation: one row per choice: what was chosen from, and the balanced accuracy of
            each held-out group.
    """

    frame: Frame
    kernel: Kernel
    penalty: float
    balance: str
    shares: tuple[float, float]
    num_bins: int
    threshold: FeatureThreshold
    validation: list[dict[str, Any]] = field(default_factory=list)

    @property
    def adds_up(self) -> bool:
        """Whether training bins become sums of fixed size; few bins, or other kernels, do not."""
        fewer = self.num_bins <= num_quadratic_features(len(self.frame.selected))
        return _is_quadratic(self.kernel) and not fewer

    def facts(self) -> dict[str, Any]:
        """JSON-able; ``Plan.of`` takes it together with the tensors of the scaler."""
        return {
            "selected": list(self.frame.selected),
            "kernel": self.kernel.to_dict(),
            "penalty": _json_number(self.penalty),
            "balance": self.balance,
            "shares": list(self.shares),
            "num_bins": self.num_bins,
            "rival": self.threshold.to_dict(),
            "validation": self.validation,
        }

    @classmethod
    def of(cls, facts: Mapping[str, Any], scaler: FeatureScaler) -> Plan:
        """The plan that ``facts`` described."""
        return cls(
            frame=Frame(tuple(facts["selected"]), scaler),
            kernel=kernel_from_dict(facts["kernel"]),
            penalty=float(facts["penalty"]),
            balance=facts["balance"],
            shares=(facts["shares"][0], facts["shares"][1]),
            num_bins=facts["num_bins"],
            threshold=FeatureThreshold(**facts["rival"]),
            validation=list(facts["validation"]),
        )


def plan_detector(recipe: Recipe, survey: Survey, progress: Progress) -> Plan:
    """Rank, scale, and choose K, c and C by closed-form validation on held-out groups.

    A held-out score is that of the machine refitted without the bin's group, from one
    factorisation per choice (``model.held_out``), with ranking and scaling held. So it chooses,
    but it is not what may be reported: for that, ranking and scaling are redone (``crossval``).

    Raises:
        ValueError: if a class is absent or a solve fails.
    """
    frame = choose_frame(recipe, survey)
    sample = survey.sample.bins()
    counts = survey.moments.count.tolist()
    weights = stand_for(sample, recipe, counts)
    choices = [
        (size, kernel, float(penalty))
        for size in recipe.sizes
        for kernel in recipe.kernels
        for penalty in _ascending(recipe.penalties)
    ]
    rows: list[dict[str, Any]] = []
    if len(choices) > 1 and len(sample.group_names) > 1:
        bins = TrainingBins(frame(sample.features), sample.is_slip, weights)
        rows = _validate(bins, sample.group, sample.group_names, choices, progress)
        best = max(row["mean"] for row in rows)
        place = next(i for i, row in enumerate(rows) if row["mean"] == best)
    else:
        place = len(choices) // 2
        if len(choices) > 1:
            log.warning(
                "C=%g is taken unvalidated: the training set is one group", choices[place][2]
            )
    size, kernel, penalty = choices[place]
    shares = kept_shares(recipe, counts)
    num_bins = sum(count * share for count, share in zip(counts, shares, strict=True))
    if num_bins > MOST_KEPT_BINS and not _is_quadratic(kernel):
        log.warning(
            "%s takes %d of %d training bins: only degree 2 adds up to sums of fixed size",
            kernel,
            MOST_KEPT_BINS,
            num_bins,
        )
        shares = [share * MOST_KEPT_BINS / num_bins for share in shares]
        num_bins = MOST_KEPT_BINS
    frame = frame.first(size)
    selected = sample.features[:, list(frame.selected)].double()
    return Plan(
        frame=frame,
        kernel=kernel,
        penalty=penalty,
        balance=recipe.balance,
        shares=(shares[0], shares[1]),
        num_bins=round(num_bins),
        threshold=best_threshold(selected, sample.is_slip),
        validation=rows,
    )


def _validate(
    bins: TrainingBins,
    groups: Tensor,
    names: Sequence[str],
    choices: Sequence[tuple[int, Kernel, float]],
    progress: Progress,
) -> list[dict[str, Any]]:
    rows = []
    machine: HeldOut | None = None
    made_of: Any = None
    for number in progress(range(len(choices)), "choose C on held-out groups"):
        size, kernel, penalty = choices[number]
        if made_of != (size, kernel):
            few = TrainingBins(bins.features[:, :size], bins.is_slip, bins.weights)
            machine, made_of = HeldOut(few, groups, kernel), (size, kernel)
        assert machine is not None
        says_slip = machine.at(penalty).scores >= 0
        by_group = {
            name: recalls_mean(says_slip[groups == index], bins.is_slip[groups == index])
            for index, name in enumerate(names)
        }
        known = [value for value in by_group.values() if value is not None]
        rows.append(
            {
                "num_features": size,
                "kernel": kernel.to_dict(),
                "penalty": penalty,
                "mean": sum(known) / len(known),
                "balanced_accuracy": by_group,
            }
        )
    return rows


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
            ValueError: if a class is absent or the system is not positive definite.
        """
        plan = self.plan
        if self.stats is not None:
            return solve_sums(plan, self.stats)
        parts = [self.bins[name] for name in sorted(self.bins)]
        z = torch.cat([part[0] for part in parts])
        is_slip = torch.cat([part[1] for part in parts])
        weights = None
        if plan.balance == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights = (len(z) / (2 * counts.double()))[is_slip.long()]
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
        ValueError: if the plan's kernel is not of degree 2, a class is absent or the system is not
            positive definite.
    """
    if not isinstance(plan.kernel, Polynomial) or plan.kernel.degree != 2:
        raise ValueError(f"sums need a polynomial kernel of degree 2, the plan has {plan.kernel}")
    balance: Literal["weights", "none"] = "weights" if plan.balance == "weights" else "none"
    return stats.solve(plan.penalty, plan.kernel.offset, balance=balance)


def _is_quadratic(kernel: Kernel) -> bool:
    return isinstance(kernel, Polynomial) and kernel.degree == 2


def _is_kept(recording: str, is_slip: Tensor, shares: Sequence[float]) -> Tensor:
    """Undersampling that depends on the bin alone, so on no order and no worker."""
    if all(share >= 1 for share in shares):
        return torch.ones_like(is_slip)
    place = bin_keys(recording, len(is_slip))  # [N] in [0, 1)
    return place < torch.tensor(shares, dtype=torch.float64)[is_slip.long()]


def _ascending(values: Any) -> list[float]:
    return sorted(float(value) for value in values)


def _json_number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf"  # JSON has no infinity
