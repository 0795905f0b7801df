"""C, the kernel's c and a scale for each feature, learned by gradient through the closed-form fit.

A stage of training between a first fit, which chooses by a grid, and a second. What is minimised is
the log loss of held-out scores in closed form, every group and class alike, starting from the
grid's point of least loss. To stop in time, each group is also held out from a descent of its own.
All descents take their steps together, until the mean loss of the held-out groups no longer falls.
The step at which it was least is taken; if that is step 0, the grid's point stays.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from tactslip_torch.data.splits import Split
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.model.calibration import Platt, fit_platt
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine, held_out_scores
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import bar, check_number
from tactslip_torch.training.plan import Plan
from tactslip_torch.training.recipe import FeatureSelection, Recipe, sample_weight

SETTINGS = ("penalty", "offset", "scales")
"""What can be learned."""


class Tuned(NamedTuple):
    """What tuning found.

    Attributes:
        selection: features and ranges.
        penalty: C.
        offset: the kernel's c.
        metadata: JSON-able: curves, the grid, what was learned, seconds.
    """

    selection: FeatureSelection
    penalty: float
    offset: float
    metadata: dict[str, Any]


@dataclass(frozen=True)
class Tuning:
    """How settings are learned.

    Args:
        learn: some of ``SETTINGS``.
        bins: of each group and class, at most; a step costs the cube of their number in all.
        steps: at most.
        patience: steps without gain on held-out groups after which descents stop.
        rate: step length of Adam, for logarithms of C, c and scales.

    Raises:
        ValueError: if nothing or something unknown is to be learned, or a number is not positive.
    """

    learn: Sequence[str] = SETTINGS
    bins: int = 100
    steps: int = 40
    patience: int = 8
    rate: float = 0.05

    def __post_init__(self) -> None:
        is_list = isinstance(self.learn, Sequence) and not isinstance(self.learn, str)
        if not is_list or not self.learn or not set(self.learn) <= set(SETTINGS):
            raise ValueError(
                f"tuning.learn must be a list of some of {', '.join(SETTINGS)}, got {self.learn!r}"
            )
        for name in ("bins", "steps", "patience"):
            check_number(f"tuning.{name}", getattr(self, name), whole=True)
        check_number("tuning.rate", self.rate)

    def check(self, recipe: Recipe, split: Split) -> None:
        """Refuse before any work what could not be tuned after it.

        Raises:
            ValueError: if the recipe is nested or not of degree 2, there are fewer than three
                groups, or something to be learned has no finite, positive value to start from.
        """
        recipe.check_quadratic("tuning")
        if "offset" in self.learn and not all(k.to_dict()["offset"] > 0 for k in recipe.kernels):
            raise ValueError("tuning learns log c, which needs recipe.offsets above 0")
        groups = sorted({recipe.group(recording) for recording in split.having("train")})
        if len(groups) < 3:
            raise ValueError(
                f"tuning needs three groups to hold some out, got {', '.join(groups)}; take "
                "recipe.group_by=cycle, or more materials"
            )

    def __call__(self, plan: Plan, sample: SampledBins, names: Sequence[str]) -> Tuned:
        """Tune a plan on training bins alone.

        Args:
            plan: of the first fit.
            sample: bins of the first pass over the training recordings, and of no other.
            names: of the pool's features.

        Raises:
            ValueError: if scores of groups left out tell slip backwards.
        """
        started = time.perf_counter()
        scaler, selected = plan.selection.scaler, plan.selection.selected
        bins = tuning_bins(sample, selected, sample_weight(plan.recipe, sample), self.bins)
        masks = [bins.group == group for group in range(len(sample.group_names))]
        parts = [(bins.where(~mask), bins.where(mask)) for mask in masks]
        grids = [grid_points(scaler, others, plan.recipe) for others, _ in parts]
        grid = grid_points(scaler, bins, plan.recipe)
        final = _Descent(LearnedSettings(self.learn, least_loss(grid), scaler), bins)
        held_out = [
            _Descent(LearnedSettings(self.learn, least_loss(points), scaler), *part)
            for points, part in zip(grids, parts, strict=True)
        ]
        states = self._descend(final, held_out)
        steps = _best_step(held_out)
        settings = final.settings.requires_grad_(False)
        settings.load_state_dict(states[steps])
        penalty, offset = float(settings.penalty), float(settings.offset)
        scales = zip((names[i] for i in selected), settings.scales.tolist(), strict=True)
        reports = []
        for name, points, part, own in zip(sample.group_names, grids, parts, held_out, strict=True):
            of_recipe = _Descent(LearnedSettings((), most_accurate(points), scaler), *part)
            with torch.no_grad():
                of_recipe.loss()
            history = own.history
            own_steps = _best_step([other for other in held_out if other is not own])
            reports.append(
                {
                    "held": name,
                    "history": history,
                    "recipe": _held_numbers(of_recipe.history[0]),
                    "grid": _held_numbers(history[0]),
                    # to stop where its own loss is least would choose by what it is evaluated by
                    "tuned": _held_numbers(history[own_steps]) | {"steps": own_steps},
                }
            )
        metadata: dict[str, Any] = {
            "learned": list(self.learn),
            "bins": len(bins.is_slip),
            "steps": steps,
            "penalty": penalty,
            "offset": offset,
            "scales": dict(scales),
            "grid": [
                point._asdict() | {"loss": point.loss if math.isfinite(point.loss) else None}
                for point in grid
            ],
            "start": least_loss(grid)._asdict(),
            "history": final.history,
            "held": reports,
            "seconds": time.perf_counter() - started,
        }
        return Tuned(FeatureSelection(selected, settings.scaler()), penalty, offset, metadata)

    def _descend(self, final: _Descent, held_out: Sequence[_Descent]) -> list[dict[str, Tensor]]:
        """Step until held-out groups no longer gain; states of ``final`` after each step."""
        descents = [*held_out, final]
        learned = [p for own in descents for p in own.settings.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(learned, lr=self.rate)
        states = [copy.deepcopy(final.settings.state_dict())]
        try:
            for _ in bar(range(self.steps), "tune", "step"):
                optimizer.zero_grad()
                torch.stack([descent.loss() for descent in descents]).sum().backward()
                optimizer.step()
                states.append(copy.deepcopy(final.settings.state_dict()))
                if len(final.history) - 1 - _best_step(held_out) >= self.patience:
                    break
            with torch.no_grad():
                for descent in descents:
                    descent.loss()
        except ValueError as error:
            raise ValueError(
                f"tuning: {error}, after {len(states) - 1} steps; take smaller tuning.rate, more "
                "tuning.bins, or tuning=none"
            ) from error
        return states


def _best_step(held_out: Sequence[_Descent]) -> int:
    """The number of steps after which the mean loss of held-out groups was least."""
    losses = [
        sum(row["held_loss"] for row in rows)
        for rows in zip(*(descent.history for descent in held_out), strict=True)
    ]
    return losses.index(min(losses))


def _held_numbers(row: dict[str, float]) -> dict[str, float]:
    return {"loss": row["held_loss"], "balanced_accuracy": row["held_accuracy"]}


# The bins ----------------------------------------------------------------------------------------


class _TuningBins(NamedTuple):
    """Bins of several groups.

    Attributes:
        features: selected, unscaled, float64.
        is_slip: their truth.
        weights: each bin's weight for all bins that are trained on, so that C means the same.
        group: index into the names of the groups.

    Shape:
        - features: ``[N, K]``; is_slip, weights, group: ``[N]``
    """

    features: Tensor
    is_slip: Tensor
    weights: Tensor
    group: Tensor

    def where(self, rows: Tensor) -> _TuningBins:
        """Some of them, by a mask ``[N]``."""
        return _TuningBins(*(x[rows] for x in self))


def tuning_bins(
    sample: SampledBins, selected: Sequence[int], weights: Tensor, most: int
) -> _TuningBins:
    """At most so many sampled bins of every group and class: those of smallest key.

    Args:
        sample: of the first pass over the training recordings, and of no other.
        selected: pool indices of the features.
        weights: of sampled bins, ``[n]``; the total of each class is kept.
        most: bins of each group and class.
    """
    order = sample.keys.argsort(stable=True)
    strata = (2 * sample.group + sample.is_slip)[order]
    kept = [order[strata == stratum][:most] for stratum in strata.unique()]
    rows = torch.cat(kept).sort().values
    is_slip, own_weights = sample.is_slip[rows], weights[rows]
    for kind in (False, True):
        own = is_slip == kind
        own_weights[own] *= weights[sample.is_slip == kind].sum() / own_weights[own].sum()
    features = sample.features[rows][:, list(selected)].double()
    return _TuningBins(features, is_slip, own_weights, sample.group[rows])


# The loss, and the grid that tuning starts from --------------------------------------------------


class GroupedLoss(NamedTuple):
    """How good held-out scores are.

    Attributes:
        loss: ``[]``, mean log loss in nats of probabilities at equal weights of slip and non-slip,
            first over the bins of each group and class, then over these; differentiable.
        balanced_accuracy: mean of the recalls of the same.
        calibration: by which scores became probabilities.
    """

    loss: Tensor
    balanced_accuracy: float
    calibration: Platt


def grouped_loss(
    scores: Tensor, is_slip: Tensor, groups: Tensor, calibration: Platt | None = None
) -> GroupedLoss:
    """The loss of scores that each come from a machine without the bin's group.

    Scores become probabilities by one slope, ``llr = slope * score``. A detector decides at a score
    of 0, so there is no offset: a machine that leans to one side has a larger loss. The slope is
    the one of least loss, so that it counts as a constant in the gradient.

    Args:
        scores: of bins.
        is_slip: their truth.
        groups: whole numbers.
        calibration: by default the slope fitted to these scores; for bins that were held out from
            tuning altogether, that of the others.

    Shape:
        - scores, is_slip (bool), groups: ``[N]``

    Raises:
        ValueError: if a class is absent, or slip has the lower scores.

    Example:
        >>> scores = torch.tensor([1.0, -1.0, 2.0, 0.5], dtype=torch.float64)
        >>> is_slip, groups = torch.tensor([True, False, True, False]), torch.tensor([0, 0, 1, 1])
        >>> grouped_loss(scores, is_slip, groups, Platt(1.0, 0.0)).balanced_accuracy
        0.75
    """
    stratum = 2 * torch.unique(groups, return_inverse=True)[1] + is_slip
    _, place, counts = torch.unique(stratum, return_inverse=True, return_counts=True)
    weights = (1 / (len(counts) * counts[place].double())).to(scores)
    if calibration is None:  # with every bin's mirror image the offset is 0
        mirrored = torch.cat([scores, -scores]).detach()
        both, twice = torch.cat([is_slip, ~is_slip]), torch.cat([weights, weights])
        calibration = Platt(fit_platt(mirrored, both, twice * len(weights)).slope, 0.0)
    llr = calibration.llr(scores)
    losses = softplus(torch.where(is_slip, -llr, llr))
    is_right = (scores.detach() >= 0) == is_slip
    return GroupedLoss((weights * losses).sum(), float(weights[is_right].sum()), calibration)


class GridPoint(NamedTuple):
    """A choice of C and c, and how good it is on groups left out one at a time.

    Attributes:
        penalty: C.
        offset: the kernel's c.
        loss: ``grouped_loss`` of held-out scores; infinite where they tell slip backwards.
        balanced_accuracy: of the same.
    """

    penalty: float
    offset: float
    loss: float
    balanced_accuracy: float


def grid_points(scaler: FeatureScaler, bins: _TuningBins, recipe: Recipe) -> list[GridPoint]:
    """Every choice of C and c of a recipe.

    Raises:
        ValueError: if held-out scores tell slip backwards at every choice.
    """
    points = []
    training = TrainingBins(scaler(bins.features), bins.is_slip, bins.weights)
    for kernel in recipe.kernels:
        assert isinstance(kernel, Polynomial)  # Tuning.check
        machine = HeldOut(training, bins.group, kernel)
        for penalty in recipe.penalties_ascending:
            try:
                found = grouped_loss(machine.at(penalty).scores, bins.is_slip, bins.group)
                numbers = float(found.loss), found.balanced_accuracy
            except ValueError:
                numbers = math.inf, 0.0
            points.append(GridPoint(penalty, kernel.offset, *numbers))
    if math.isinf(least_loss(points).loss):
        raise ValueError(
            "tuning has no place to start: at every C and c of the recipe held-out scores "
            "tell slip backwards or cannot be told; look at the labels, or take tuning=none"
        )
    return points


def least_loss(points: Iterable[GridPoint]) -> GridPoint:
    """The choice of least loss, the first of equals."""
    return min(points, key=lambda point: point.loss)


def most_accurate(points: Iterable[GridPoint]) -> GridPoint:
    """The choice of the best balanced accuracy, the first of equals: what a recipe takes."""
    return max(points, key=lambda point: point.balanced_accuracy)


# Descents ----------------------------------------------------------------------------------------


class LearnedSettings(nn.Module):
    """C, the kernel's c and a scale for each feature, as logarithms that start at a grid's point.

    A scale below 1 narrows a feature in the kernel; 0 would leave it out. It divides the width of
    the range that becomes [-1, 1], so a scaler can hold it: below 1 less of a feature's tails is
    clipped, above 1 more.

    Args:
        learn: which of ``SETTINGS``; the others stay.
        start: C and c to start from; c positive if it is learned.
        scaler: ranges of the features.
    """

    def __init__(self, learn: Sequence[str], start: GridPoint, scaler: FeatureScaler) -> None:
        super().__init__()
        self._scaler, self._has_offset = scaler, start.offset > 0
        logs = {
            "penalty": torch.tensor(start.penalty, dtype=torch.float64).log(),
            "offset": torch.tensor(start.offset or 1.0, dtype=torch.float64).log(),
            "scales": torch.zeros_like(scaler.minimum, dtype=torch.float64),
        }
        self.logs = nn.ParameterDict(
            {name: nn.Parameter(log, requires_grad=name in learn) for name, log in logs.items()}
        )

    @property
    def penalty(self) -> Tensor:
        """C, ``[]``."""
        return torch.exp(self.logs["penalty"])

    @property
    def offset(self) -> Tensor:
        """The kernel's c, ``[]``."""
        return torch.exp(self.logs["offset"]) * self._has_offset

    @property
    def scales(self) -> Tensor:
        """Of the features, 1 at first: ``[K]``."""
        return torch.exp(self.logs["scales"])

    def scaler(self) -> FeatureScaler:
        """The ranges that hold the scales as they are now, differentiable."""
        start, scales = self._scaler, self.scales
        middle = (start.minimum + start.maximum) / 2
        half = (start.maximum - start.minimum) / 2 / scales
        return FeatureScaler(middle - half, middle + half, start.knee)


@dataclass
class _Descent:
    """Settings that are learned on some groups; a held-out one is only evaluated.

    Attributes:
        history: a row for each state, the first before any step: ``loss`` and
            ``balanced_accuracy``, of a held-out group ``held_loss`` and ``held_accuracy``.
    """

    settings: LearnedSettings
    bins: _TuningBins
    held: _TuningBins | None = None
    history: list[dict[str, float]] = field(default_factory=list)

    def loss(self) -> Tensor:
        """The loss as settings are now, ``[]``; adds a row to the history."""
        settings, bins = self.settings, self.bins
        z = settings.scaler()(bins.features)
        scores = held_out_scores(
            z, bins.is_slip, bins.group, settings.penalty, settings.offset, bins.weights
        )
        found = grouped_loss(scores, bins.is_slip, bins.group)
        row = {"loss": float(found.loss.detach()), "balanced_accuracy": found.balanced_accuracy}
        if self.held is not None:
            with torch.no_grad():
                training = TrainingBins(z.detach(), bins.is_slip, bins.weights)
                kernel = Polynomial(2, float(settings.offset))
                machine = fit_machine(training, float(settings.penalty), kernel)
                scores = machine(settings.scaler()(self.held.features))
                held = grouped_loss(scores, self.held.is_slip, self.held.group, found.calibration)
            row |= {"held_loss": float(held.loss), "held_accuracy": held.balanced_accuracy}
        self.history.append(row)
        return found.loss
