"""C, the kernel's c and a scale for each feature, learned by gradient through the closed-form fit.

A stage of training, between a first fit, which chooses by a grid, and a second. What is minimised
is the log loss of held-out scores in closed form (``held_out_scores``), every group and class
alike. What is learned by gradient can fit the training materials too closely, as any choice can. So
each group is held out from a descent of its own, all of which go down in step with the one on all
groups; they stop when the mean loss of held groups no longer falls, and the step at which it was
least is taken. If that is none, the point of the grid stays from which they start: that of least
loss, which need not be the most accurate one that a recipe takes.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from tactslip_torch.data.splits import Split
from tactslip_torch.features.bin_sample import SampledBins, bin_keys
from tactslip_torch.model.calibration import Platt, fit_platt
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.leave_one_group_out import HeldOut, held_out_scores
from tactslip_torch.model.scaling import FeatureScaler, signed_log
from tactslip_torch.runtime import bar
from tactslip_torch.training.datamodule import FeatureMaker
from tactslip_torch.training.learner import SlipLearner
from tactslip_torch.training.recipe import FeatureSelection, Recipe
from tactslip_torch.training.selection import Plan

_Setting = Literal["penalty", "offset", "scales"]
SETTINGS: tuple[_Setting, ...] = get_args(_Setting)


class Tuned(NamedTuple):
    """What tuning found.

    Attributes:
        selection: features and ranges.
        penalty: C.
        offset: the kernel's c.
        facts: JSON-able: curves, the grid, what was learned, seconds.
    """

    selection: FeatureSelection
    penalty: float
    offset: float
    facts: dict[str, Any]


@dataclass(frozen=True)
class Tuning:
    """How settings are learned.

    Args:
        learn: which: ``penalty``, ``offset``, ``scales``.
        bins: of each group and class, at most; a step costs the cube of their number in all.
        steps: at most.
        patience: steps without gain on held groups after which descents stop.
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
        if not is_list or not self.learn or any(name not in SETTINGS for name in self.learn):
            raise ValueError(
                f"tuning.learn must be a list of some of {', '.join(SETTINGS)}, got {self.learn!r}"
            )
        for name in ("bins", "steps", "patience"):
            if type(value := getattr(self, name)) is not int or value < 1:
                raise ValueError(f"tuning.{name} must be a positive whole number, got {value!r}")
        if type(self.rate) not in (int, float) or not 0 < self.rate < math.inf:
            raise ValueError(f"tuning.rate must be a positive number, got {self.rate!r}")

    def check(self, recipe: Recipe, split: Split) -> None:
        """Refuse before any work what could not be tuned behind it.

        Raises:
            ValueError: if the recipe is nested or not of degree 2, there are fewer than three
                groups to hold some out, or something to be learned has no place to start from.
        """
        if recipe.validation == "nested":
            raise ValueError(
                "tuning needs a machine of degree 2 on features of channels, which "
                f"recipe={recipe.name} does not always make; take recipe=robust or recipe=paper"
            )
        for kernel in recipe.kernels:
            if not isinstance(kernel, Polynomial) or kernel.degree != 2:
                raise ValueError(f"tuning needs a polynomial kernel of degree 2, got {kernel}")
            if "offset" in self.learn and not kernel.offset > 0:
                raise ValueError("tuning learns log c, which needs recipe.offsets above 0")
        if not math.isfinite(recipe.penalties_ascending[-1]):
            raise ValueError("tuning needs finite recipe.penalties to start from")
        groups = sorted({recipe.group(recording) for recording in split.having("train")})
        if len(groups) < 3:
            raise ValueError(
                f"tuning needs three groups to hold some out, got {', '.join(groups)}; take "
                "recipe.group_by=cycle, or more materials"
            )

    def __call__(
        self,
        plan: Plan,
        recipe: Recipe,
        sample: SampledBins,
        weights: Tensor,
        names: Sequence[str],
    ) -> Tuned:
        """Tune a plan on training bins alone.

        Args:
            plan: of the first fit.
            recipe: that made it.
            sample: bins of the first pass over the training recordings, and of no other.
            weights: with which they stand for all that are trained on, ``[n]``.
            names: of the pool's features.

        Raises:
            ValueError: if scores of groups left out tell slip backwards.
        """
        started = time.perf_counter()
        bins = tuning_bins(sample, plan.selection.selected, weights, self.bins)
        groups = range(len(bins.names))
        grids = {
            held: grid_points(
                plan.selection.scaler,
                bins.without(held),
                recipe.penalties_ascending,
                _offsets(recipe),
            )
            for held in (None, *groups)
        }
        scaler = plan.selection.scaler
        *rotations, final = descents = [
            _Descent(self.learn, least_loss(grids[held]), scaler, bins, held)
            for held in (*groups, None)
        ]
        states = self._descend(descents)
        losses = _mean_losses(rotations)
        steps = losses.index(min(losses))
        settings = final.settings.requires_grad_(False)
        settings.load_state_dict(states[steps])
        penalty, offset = float(settings.penalty), float(settings.offset)
        selected = [names[index] for index in plan.selection.selected]
        facts: dict[str, Any] = {
            "learned": list(self.learn),
            "bins": len(bins.is_slip),
            "steps": steps,
            "penalty": penalty,
            "offset": offset,
            "scales": dict(zip(selected, settings.scales.tolist(), strict=True)),
            "grid": [asdict(point) | {"loss": _number(point.loss)} for point in grids[None]],
            "start": asdict(least_loss(grids[None])),
            "history": final.history,
            "held": [
                _held_facts(
                    rotations,
                    held,
                    _Descent((), most_accurate(grids[held]), scaler, bins, held),
                )
                for held in groups
            ],
            "seconds": time.perf_counter() - started,
        }
        return Tuned(
            FeatureSelection(plan.selection.selected, settings.scaler()), penalty, offset, facts
        )

    def _descend(self, descents: Sequence[_Descent]) -> list[dict[str, Tensor]]:
        """All descents, until held groups no longer gain; states of the last one, step by step."""
        *rotations, final = descents
        learned = [p for descent in descents for p in descent.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(learned, lr=self.rate)
        states = [copy.deepcopy(final.settings.state_dict())]
        try:
            for _ in bar(range(self.steps), "tune", "step"):
                optimizer.zero_grad()
                torch.stack([descent() for descent in descents]).sum().backward()
                optimizer.step()
                states.append(copy.deepcopy(final.settings.state_dict()))
                losses = _mean_losses(rotations)
                if len(losses) - 1 - losses.index(min(losses)) >= self.patience:
                    break
            with torch.no_grad():
                for descent in descents:
                    descent()
        except ValueError as error:
            raise ValueError(
                f"tuning: {error}, after {len(states) - 1} steps; take smaller tuning.rate, more "
                "tuning.bins, or tuning=none"
            ) from error
        return states


def settled_learner(
    first: SlipLearner,
    maker: FeatureMaker,
    selection: FeatureSelection,
    penalty: float,
    offset: float,
) -> SlipLearner:
    """A learner with nothing left to choose.

    Args:
        first: whose recipe it takes else.
        maker: of its features.
        selection: which, and how scaled.
        penalty: C.
        offset: the kernel's c.
    """
    num = len(selection.selected)
    recipe = replace(first.recipe, num_features=num, penalties=penalty, offsets=offset)
    return SlipLearner(
        maker.pool,
        maker.channel_filter,
        recipe,
        selection=selection,
        abstaining=first.abstaining,
        with_baselines=first.with_baselines,
    )


# The bins ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TuningBins:
    """Bins of several groups.

    Args:
        features: selected, unscaled, float64.
        is_slip: their truth.
        weights: with which they stand for all bins that are trained on, so that C means the same.
        group: index into ``names``.
        names: of the groups.

    Shape:
        - features: ``[N, K]``; is_slip, weights, group: ``[N]``
    """

    features: Tensor
    is_slip: Tensor
    weights: Tensor
    group: Tensor
    names: tuple[str, ...]

    def of(self, group: int) -> TuningBins:
        """The bins of one group; they stand for as much as before."""
        return self._where(self.group == group)

    def without(self, group: int | None) -> TuningBins:
        """Those of the other groups, or all."""
        return self if group is None else self._where(self.group != group)

    def _where(self, own: Tensor) -> TuningBins:
        return replace(
            self,
            features=self.features[own],
            is_slip=self.is_slip[own],
            weights=self.weights[own],
            group=self.group[own],
        )


def tuning_bins(
    sample: SampledBins, selected: Sequence[int], weights: Tensor, most: int
) -> TuningBins:
    """At most so many sampled bins of every group and class: those of smallest key.

    Args:
        sample: of the first pass over the training recordings, and of no other.
        selected: pool indices of the features.
        weights: with which sampled bins stand for all that are trained on, ``[n]``.
        most: bins of each group and class.
    """
    keys = torch.zeros(len(sample.is_slip), dtype=torch.float64)
    for place, name in enumerate(sample.recording_names):
        own = sample.recording == place
        index = sample.bin_index[own]
        keys[own] = bin_keys(name, int(index.max()) + 1)[index]
    kept = []
    for group in range(len(sample.group_names)):
        for kind in (False, True):
            rows = ((sample.group == group) & (sample.is_slip == kind)).nonzero().flatten()
            kept.append(rows[keys[rows].argsort(stable=True)[:most]])
    rows = torch.cat(kept).sort().values
    is_slip, own_weights = sample.is_slip[rows], weights[rows]
    for kind in (False, True):  # those that are kept stand for the others
        own = is_slip == kind
        own_weights[own] *= weights[sample.is_slip == kind].sum() / own_weights[own].sum()
    features = sample.features[rows][:, list(selected)].double()
    return TuningBins(features, is_slip, own_weights, sample.group[rows], sample.group_names)


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

    Scores become probabilities by one slope, ``llr = slope * score``: a detector decides at a score
    of 0, so a machine that leans to one side has to pay for it here. The slope is the one of least
    loss (but for Platt's targets), so that it counts as a constant on the way back.

    Args:
        scores: of bins.
        is_slip: their truth.
        groups: whole numbers.
        calibration: by default the slope fitted to these scores; of bins that were held out from
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
    cell = 2 * torch.unique(groups, return_inverse=True)[1] + is_slip  # a group and class
    _, place, counts = torch.unique(cell, return_inverse=True, return_counts=True)
    weights = (1 / (len(counts) * counts[place].double())).to(scores)
    if calibration is None:  # every bin beside its mirror image: there is nothing to offset
        mirrored = torch.cat([scores, -scores]).detach()
        both, twice = torch.cat([is_slip, ~is_slip]), torch.cat([weights, weights])
        calibration = Platt(fit_platt(mirrored, both, twice * len(weights)).slope, 0.0)
    llr = calibration.llr(scores)
    losses = softplus(torch.where(is_slip, -llr, llr))
    is_right = (scores.detach() >= 0) == is_slip
    return GroupedLoss((weights * losses).sum(), float(weights[is_right].sum()), calibration)


@dataclass(frozen=True)
class GridPoint:
    """A choice, and how good it is on groups left out one at a time.

    Attributes:
        penalty: C.
        offset: the kernel's c.
        loss: ``grouped_loss`` of held-out scores.
        balanced_accuracy: of the same.
    """

    penalty: float
    offset: float
    loss: float
    balanced_accuracy: float


def grid_points(
    scaler: FeatureScaler, bins: TuningBins, penalties: Sequence[float], offsets: Sequence[float]
) -> list[GridPoint]:
    """Every choice of C and c; an infinite loss where held-out scores tell slip backwards.

    Raises:
        ValueError: if they do at every choice.
    """
    points = []
    training = TrainingBins(scaler(bins.features), bins.is_slip, bins.weights)
    for offset in offsets:
        machine = HeldOut(training, bins.group, Polynomial(2, offset))
        for penalty in penalties:
            try:
                found = grouped_loss(machine.at(penalty).scores, bins.is_slip, bins.group)
            except ValueError:
                points.append(GridPoint(penalty, offset, math.inf, 0.0))
                continue
            points.append(GridPoint(penalty, offset, float(found.loss), found.balanced_accuracy))
    if math.isinf(least_loss(points).loss):
        raise ValueError(
            "tuning has no place to start: at every C and c of the recipe held-out scores "
            "tell slip backwards or cannot be told; look at the labels, or take tuning=none"
        )
    return points


def least_loss(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of least loss, the first of equals."""
    return min(points, key=lambda point: point.loss)


def most_accurate(points: Sequence[GridPoint]) -> GridPoint:
    """The choice of the best balanced accuracy, the first of equals: what a recipe takes."""
    return max(points, key=lambda point: point.balanced_accuracy)


def _offsets(recipe: Recipe) -> list[float]:
    return [kernel.offset for kernel in recipe.kernels if isinstance(kernel, Polynomial)]


# Descents ----------------------------------------------------------------------------------------


class LearnedSettings(nn.Module):
    """C, the kernel's c and a scale for each feature, as logarithms that start at a grid's point.

    A scale below 1 narrows a feature in the kernel, and one of 0 would leave it out: soft
    selection. It divides the width of the range that becomes [-1, 1], so that a scaler holds it:
    below 1 less of a feature's tails is clipped, above 1 more.

    Args:
        learn: which of ``SETTINGS``; the others stay.
        penalty: C to start from.
        offset: c to start from, positive if it is learned.
        scaler: ranges of the features.
    """

    def __init__(
        self, learn: Sequence[str], penalty: float, offset: float, scaler: FeatureScaler
    ) -> None:
        super().__init__()
        self._start, self._offset = scaler, offset
        zeros = torch.zeros_like(scaler.minimum, dtype=torch.float64)
        starts = {
            "penalty": torch.tensor(penalty, dtype=torch.float64).log(),
            "offset": torch.tensor(offset or 1.0, dtype=torch.float64).log(),
            "scales": zeros,
        }
        self.logs = nn.ParameterDict(
            {name: nn.Parameter(log, requires_grad=name in learn) for name, log in starts.items()}
        )

    @property
    def penalty(self) -> Tensor:
        """C, ``[]``."""
        penalty: Tensor = self.logs["penalty"].exp()
        return penalty

    @property
    def offset(self) -> Tensor:
        """The kernel's c, ``[]``."""
        log: Tensor = self.logs["offset"]
        return log.exp() if self._offset > 0 else log

    @property
    def scales(self) -> Tensor:
        """Of the features, 1 at first: ``[K]``."""
        scales: Tensor = self.logs["scales"].exp()
        return scales

    def scaled(self, features: Tensor) -> Tensor:
        """Features in the kernel, ``[N, K]`` in [-1, 1]; what ``scaler()`` makes of them."""
        start = self._start
        if start.knee is not None:
            features = signed_log(features, start.knee)
        width = start.maximum - start.minimum
        is_point = width == 0
        relative = (features - start.minimum) / torch.where(is_point, 1.0, width)
        return torch.where(is_point, 0.0, self.scales * (2 * relative - 1)).clamp(-1, 1)

    def scaler(self) -> FeatureScaler:
        """The ranges that stand for the scales as they are now."""
        start, scales = self._start, self.scales.detach()
        middle = (start.minimum + start.maximum) / 2
        half = (start.maximum - start.minimum) / 2 / scales
        return FeatureScaler(middle - half, middle + half, start.knee)


class _Descent(nn.Module):
    """Settings that are learned on some groups, while a held one is looked at and sets nothing.

    Attributes:
        name: of the held group.
        history: a row for each state, the first before any step: ``loss`` and
            ``balanced_accuracy``, of a held group ``held_loss`` and ``held_accuracy``.
    """

    def __init__(
        self,
        learn: Sequence[str],
        start: GridPoint,
        scaler: FeatureScaler,
        bins: TuningBins,
        held: int | None = None,
    ) -> None:
        super().__init__()
        self.settings = LearnedSettings(learn, start.penalty, start.offset, scaler)
        self.bins = bins.without(held)
        self.held = None if held is None else bins.of(held)
        self.name = "" if held is None else bins.names[held]
        self.history: list[dict[str, float]] = []

    def forward(self) -> Tensor:
        """The loss as settings are now, ``[]``; written down."""
        settings, bins = self.settings, self.bins
        z = settings.scaled(bins.features)
        scores = held_out_scores(
            z, bins.is_slip, bins.group, settings.penalty, settings.offset, bins.weights
        )
        found = grouped_loss(scores, bins.is_slip, bins.group)
        row = {"loss": float(found.loss.detach()), "balanced_accuracy": found.balanced_accuracy}
        if self.held is not None:
            held = _held_loss(settings, bins, self.held, found.calibration)
            row |= {"held_loss": float(held.loss), "held_accuracy": held.balanced_accuracy}
        self.history.append(row)
        return found.loss


@torch.no_grad()
def _held_loss(
    settings: LearnedSettings, bins: TuningBins, held: TuningBins, calibration: Platt
) -> GroupedLoss:
    """What a held group gets by the machine of the others and their calibration."""
    training = TrainingBins(settings.scaled(bins.features), bins.is_slip, bins.weights)
    kernel = Polynomial(2, float(settings.offset))
    scores = fit_machine(training, float(settings.penalty), kernel)(settings.scaled(held.features))
    return grouped_loss(scores, held.is_slip, held.group, calibration)


def _mean_losses(rotations: Sequence[_Descent]) -> list[float]:
    """Mean loss over held groups after each number of steps."""
    rows = [[row["held_loss"] for row in descent.history] for descent in rotations]
    return [sum(step) / len(step) for step in zip(*rows, strict=True)]


def _held_facts(rotations: Sequence[_Descent], held: int, by_accuracy: _Descent) -> dict[str, Any]:
    """Of a held group: what the grid gets on it, and descending as far as the others tell to.

    To stop where its own loss is least would be a choice by what it is evaluated by. The descents
    of the others have seen it, though, and K was chosen with it: what is held out is C, c and
    scales.
    """
    own = rotations[held]
    losses = _mean_losses([other for other in rotations if other is not own])
    steps = losses.index(min(losses))
    with torch.no_grad():
        by_accuracy()

    def at(row: dict[str, float]) -> dict[str, float]:
        return {"loss": row["held_loss"], "balanced_accuracy": row["held_accuracy"]}

    return {
        "held": own.name,
        "history": own.history,
        "recipe": at(by_accuracy.history[0]),
        "grid": at(own.history[0]),
        "tuned": {"steps": steps, **at(own.history[steps])},
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None  # JSON has no infinity
