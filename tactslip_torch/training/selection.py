"""From a first pass to a plan: features, scaling, K, degree, c and C, chosen on groups left out.

``plan_detector`` chooses by what the first pass learned of the training bins, in one of two ways.

**Held** (``validation="held"``): features are ranked and scaled once; a held-out score is that of
the machine refitted without the bin's group, in closed form.

**Nested** (``"nested"``): a candidate is a set of features (of channels, pooled, or both; all or
the best K), a degree and a penalty C. In each fold everything that is learned, compression
constants, ranking and scaling among it, is learned without the group that is left out. Of the
candidates within a tolerance of the best, the simplest machine with the strongest penalty is taken:
penalties over several decades tie in validation and differ by far on a material that was not
trained on. The choice itself is evaluated by leaving out two groups: for each group the same choice
is made without it, and that machine is evaluated on it. This nested score may be reported.

Reference:
    Cawley and Talbot (2010), Journal of Machine Learning Research 11, 2079-2107.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Kernel, Polynomial, kernel_from_dict
from tactslip_torch.model.leave_one_group_out import HeldOut
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.model.threshold import best_threshold
from tactslip_torch.runtime import for_each
from tactslip_torch.training.recipe import (
    Frame,
    Recipe,
    choose_frame,
    kept_shares,
    recalls_mean,
    sample_groups,
    scene_weights,
    stand_for,
)

log = logging.getLogger(__name__)

Progress = Callable[[Iterable[Any], str], Iterable[Any]]

TRAINING_BINS = 100
"""Bins of each stratum and class that a validation fold is fitted to, at most, so that machines
with more columns than bins can be solved; it is scored on all sampled ones. Where every candidate
is of pooled features at degree 1, all sampled bins are taken."""
MOST_TRAINING_BINS = 2000
"""Of all strata together: many kinds of scenes have fewer bins each."""
MOST_DUAL_BINS = 2500
"""Up to so many training bins a machine of degree 2 on all features is a candidate: it does not
fold, so its cost grows with the bins."""
MOST_EXTENSIONS = 3
"""Decades by which a grid of penalties that ends at its edge is extended, at either end."""
MOST_GAUSSIAN = 256
"""So many features at most have the expected score where channels are missing: its matrices are of
their number squared."""
MOST_KEPT_BINS = 8192
"""So many bins at most for a kernel that does not fold: its machine is a matrix of bins by bins."""


@dataclass(frozen=True)
class Plan:
    """What is decided before the second pass.

    Args:
        frame: which features, how scaled.
        kernel: of the machine.
        penalty: the paper's ``C``.
        balance: how the classes are balanced.
        shares: of non-slip and slip bins that are trained on.
        stands_for: how many bins each of those stands for, as in validation.
        num_bins: how many bins are trained on; about, where shares are below 1.
        imputation: mean of the scaled features, both classes counting alike; it stands in where a
            sensor is missing.
        validation: one row per choice: what was chosen from, the balanced accuracy of each
            held-out group, and the calibration of held-out scores.
        among: of a recipe that restricts the ranking: to what, how many features that leaves
            (``matching``), and the numbers chosen from after cutting them to it; else ``None``.
        abstain: thresholds for unsure answers, as ``Abstention.to_dict`` has them, if set.
        gaussians: of the scaled features, for sensors that are missing; of a kernel that folds and
            at most ``MOST_GAUSSIAN`` features of channels.
        nested: balanced accuracy of the whole choice on groups that it did not see, if it was
            judged.
        scene_weights: weight of a bin by scene, non-slip and slip, balance among it; empty if
            scenes are not weighed.
        drop_channels: the largest part of channels left out of second copies of recordings.
    """

    frame: Frame
    kernel: Kernel
    penalty: float
    balance: str
    shares: tuple[float, float]
    stands_for: float
    num_bins: int
    imputation: tuple[float, ...]
    validation: list[dict[str, Any]] = field(default_factory=list)
    among: dict[str, Any] | None = None
    abstain: dict[str, Any] | None = None
    gaussians: ClassGaussians | None = None
    nested: dict[str, Any] | None = None
    scene_weights: dict[str, tuple[float, float]] = field(default_factory=dict)
    drop_channels: float = 0.0

    @property
    def adds_up(self) -> bool:
        """Whether training bins become sums of fixed size; few bins, or other kernels, do not."""
        if not isinstance(self.kernel, Polynomial) or not self.kernel.collapses:
            return False
        return self.num_bins > self.kernel.num_monomials(self.frame.size)

    @property
    def calibration(self) -> dict[str, Any] | None:
        """By held-out scores of the choice that was taken; None if there was nothing to choose."""
        chosen = (self.frame.size, self.kernel.to_dict(), self.penalty)
        for row in self.validation:
            same = (row["num_features"], row["kernel"], row["penalty"]) == chosen
            if row.get("chosen", same and "use" not in row):
                return cast("dict[str, Any] | None", row.get("calibration"))
        return None

    def facts(self) -> dict[str, Any]:
        """JSON-able; ``Plan.of`` takes it together with the scaler and the Gaussians."""
        return {
            "selected": list(self.frame.selected),
            "kernel": self.kernel.to_dict(),
            "penalty": _json_number(self.penalty),
            "balance": self.balance,
            "shares": list(self.shares),
            "stands_for": self.stands_for,
            "num_bins": self.num_bins,
            "imputation": list(self.imputation),
            "validation": self.validation,
            "among": self.among,
            "abstain": self.abstain,
            "nested": self.nested,
            "scene_weights": self.scene_weights,
            "drop_channels": self.drop_channels,
        }

    def tensors(self) -> dict[str, Tensor]:
        """What ``facts`` leaves out: the scaler, and the Gaussians among it."""
        of_features = {} if self.gaussians is None else self.gaussians.tensors()
        return dict(self.frame.scaler.state_dict()) | of_features

    @classmethod
    def of(
        cls,
        facts: Mapping[str, Any],
        scaler: FeatureScaler,
        gaussians: ClassGaussians | None = None,
        pooling: ChannelPooling | None = None,
    ) -> Plan:
        """The plan that ``facts`` described."""
        return cls(
            frame=Frame(tuple(facts["selected"]), scaler, pooling),
            kernel=kernel_from_dict(facts["kernel"]),
            penalty=float(facts["penalty"]),
            balance=facts["balance"],
            shares=(facts["shares"][0], facts["shares"][1]),
            stands_for=facts["stands_for"],
            num_bins=facts["num_bins"],
            imputation=tuple(facts["imputation"]),
            validation=list(facts["validation"]),
            among=facts.get("among"),  # older plans know no such restriction
            abstain=facts.get("abstain"),  # nor unsure answers
            gaussians=gaussians,
            nested=facts.get("nested"),
            scene_weights={k: (v[0], v[1]) for k, v in facts.get("scene_weights", {}).items()},
            drop_channels=facts.get("drop_channels", 0.0),
        )


def plan_detector(
    recipe: Recipe,
    survey: Survey,
    progress: Progress,
    frame: Frame | None = None,
    allowed: Tensor | None = None,
    *,
    pool: FeaturePool | None = None,
    is_settled: bool = False,
    is_nested: bool = True,
) -> Plan:
    """Choose the features and the machine by validation on held-out groups.

    A recipe with ``validation="nested"`` chooses by ``choose_model`` and needs the ``pool``;
    ``is_nested=False`` does not evaluate the choice itself. For other recipes: rank, scale, and
    choose K, c and C by closed-form validation. Features that were ranked and scaled elsewhere come
    as a ``frame``; which ones may be selected here, for a recipe that restricts them, as
    ``allowed``, what ``recipe.allowed`` says.

    Of a recipe that leaves no choice nothing is validated, unless it ``is_settled``, by tuning:
    then held-out scores are wanted for what follows from them, such as a calibration.

    A held-out score is that of the machine refitted without the bin's group, from one
    factorisation per choice (``HeldOut``), with ranking and scaling held. So it chooses,
    but it is not what may be reported: for that, ranking and scaling are redone (``crossval``).

    Raises:
        ValueError: if a class is absent or a solve fails.
    """
    if recipe.validation == "nested" and frame is None:
        if pool is None:
            raise ValueError("recipe.validation=nested needs the pool; hand it over as pool=")
        return _plan_nested(recipe, survey, progress, pool, allowed, is_nested=is_nested)
    frame = frame or choose_frame(recipe, survey, allowed)
    sizes = sorted({min(size, frame.size) for size in recipe.sizes})
    if sizes[-1] < recipe.sizes[-1]:
        log.warning(
            "recipe.num_features=%d is cut to %d: no more match", recipe.sizes[-1], sizes[-1]
        )
    sample = survey.sample.bins()
    counts = survey.moments.count.tolist()
    weights = stand_for(sample, recipe, counts)
    choices = [
        (size, kernel, penalty)
        for size in sizes
        for kernel in recipe.kernels
        for penalty in recipe.penalties_ascending
    ]
    rows: list[dict[str, Any]] = []
    if (len(choices) > 1 or is_settled) and len(sample.group_names) > 1:
        bins = TrainingBins(frame(sample.features), sample.is_slip, weights)
        rows = validate(bins, sample.group, sample.group_names, choices, progress)
        best = max(row["mean"] for row in rows)
        place = next(i for i, row in enumerate(rows) if row["mean"] == best)
    else:
        num = len(recipe.penalties_ascending)  # of the most features and the last kernel
        place = len(choices) - num + num // 2
        if len(choices) > 1:
            log.warning("K=%d, %s, C=%g are taken unvalidated: one group", *choices[place])
    size, kernel, penalty = choices[place]
    shares = kept_shares(recipe, counts)
    num_bins = sum(count * share for count, share in zip(counts, shares, strict=True))
    stands_for = 1.0
    if num_bins > MOST_KEPT_BINS and not kernel.collapses:
        log.warning(
            "%s takes %d of %d training bins: its machine does not fold to a fixed size",
            kernel,
            MOST_KEPT_BINS,
            num_bins,
        )
        stands_for = num_bins / MOST_KEPT_BINS
        shares = [share / stands_for for share in shares]
        num_bins = MOST_KEPT_BINS
    frame = frame.first(size)
    z = frame(sample.features)
    has_gaussians = kernel.collapses and frame.pooling is None
    return Plan(
        frame=frame,
        kernel=kernel,
        penalty=penalty,
        balance=recipe.balance,
        shares=(shares[0], shares[1]),
        stands_for=stands_for,
        num_bins=round(num_bins),
        imputation=_imputation(z, sample.is_slip, weights),
        validation=rows,
        among=None if allowed is None else _narrowed(recipe, allowed, sizes),
        gaussians=ClassGaussians.fit(z, sample.is_slip, weights) if has_gaussians else None,
        drop_channels=0.0 if frame.pooling is None else recipe.drop_channels,
    )


def _plan_nested(
    recipe: Recipe,
    survey: Survey,
    progress: Progress,
    pool: FeaturePool,
    allowed: Tensor | None,
    *,
    is_nested: bool,
) -> Plan:
    """``plan_detector`` by nested validation."""
    sample = survey.sample.bins()
    counts = survey.moments.count.tolist()
    weights = stand_for(sample, recipe, counts)
    shares = kept_shares(recipe, counts)
    num_bins = round(sum(count * share for count, share in zip(counts, shares, strict=True)))
    structures = candidates(recipe, num_bins)
    rows: list[dict[str, Any]] = []
    nested = None
    structure = structures[0]
    penalty = recipe.penalties_ascending[len(recipe.penalties_ascending) // 2]
    if len(sample_groups(sample)[1]) > 1:
        options: dict[str, Any] = {"num_bins": num_bins, "allowed": allowed, "is_nested": is_nested}
        choice = choose_model(recipe, pool, sample, weights, progress, **options)
        structure, penalty = choice.structure, choice.penalty
        rows, nested = choice.rows, choice.nested
        if choice.edge:
            log.warning("%s", choice.edge)
    else:
        log.warning("%s, C=%g are taken unvalidated: one group", structure, penalty)
    frame = fitted_frame(recipe, pool, sample, structure, allowed)
    z = frame(sample.features)
    has_gaussians = frame.pooling is None and frame.size <= MOST_GAUSSIAN
    return Plan(
        frame=frame,
        kernel=structure.kernel,
        penalty=penalty,
        balance=recipe.balance,
        shares=(shares[0], shares[1]),
        stands_for=1.0,
        num_bins=num_bins,
        imputation=_imputation(z, sample.is_slip, weights),
        validation=rows,
        among=None if recipe.among is None or allowed is None else _narrowed(recipe, allowed, []),
        gaussians=ClassGaussians.fit(z, sample.is_slip, weights) if has_gaussians else None,
        nested=nested,
        scene_weights=scene_weights(recipe, sample) if recipe.scene_weights else {},
        drop_channels=recipe.drop_channels if frame.pooling is not None else 0.0,
    )


def _narrowed(recipe: Recipe, allowed: Tensor, sizes: Sequence[int]) -> dict[str, Any]:
    matching = int(allowed.sum())
    return {"wanted": recipe.facts()["among"], "matching": matching, "num_features": list(sizes)}


def _imputation(scaled: Tensor, is_slip: Tensor, weights: Tensor) -> tuple[float, ...]:
    """Mean of scaled features ``[N, K]``, both classes counting alike; K numbers."""
    means = [weights[mine] @ scaled[mine] / weights[mine].sum() for mine in (is_slip, ~is_slip)]
    return tuple(((means[0] + means[1]) / 2).tolist())


def adds_up(kernel: Kernel) -> bool:
    """Whether training bins add up to sums of fixed size, as they do for degree 2."""
    return isinstance(kernel, Polynomial) and kernel.degree == 2


def _json_number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf"  # JSON has no infinity


# Held validation --------------------------------------------------------------------------


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
                "calibration": _calibration(scores, bins.is_slip, bins.weights),
            }
        )
    return rows


def _calibration(scores: Tensor, is_slip: Tensor, weights: Tensor | None) -> dict[str, Any] | None:
    """What held-out scores tell of slip, as plain values; None if they tell it backwards."""
    try:
        return fit_platt(scores, is_slip, weights).to_dict()
    except ValueError as error:
        log.warning("scores are not calibrated: %s", error)
        return None


# Nested validation ------------------------------------------------------------------------


class Structure(NamedTuple):
    """A candidate without its penalty.

    Attributes:
        use: ``"channel"``, ``"pooled"`` or ``"both"``.
        num_features: the best so many of them; ``None``: all.
        kernel: of degree 1 or 2.
    """

    use: str
    num_features: int | None
    kernel: Polynomial


@dataclass(frozen=True)
class Choice:
    """What validation found.

    Args:
        structure: that was chosen.
        penalty: that was chosen.
        rows: one for each candidate, JSON-able: ``use``, ``num_features``, ``kernel``, ``penalty``,
            ``mean``, ``balanced_accuracy`` by group, and ``worst``: the group with the least
            balanced accuracy, and what it would be at that group's best threshold.
        nested: balanced accuracy of the whole procedure on each group that it did not see, and
            their mean; ``None`` with fewer than three groups.
        edge: what to say of a grid of penalties that ended at its edge; empty if it did not.
    """

    structure: Structure
    penalty: float
    rows: list[dict[str, Any]]
    nested: dict[str, Any] | None
    edge: str


def choose_model(
    recipe: Recipe,
    pool: FeaturePool,
    sample: SampledBins,
    weights: Tensor,
    progress: Progress,
    *,
    num_bins: int,
    allowed: Tensor | None = None,
    is_nested: bool = True,
) -> Choice:
    """Choose among the candidates of a recipe.

    Args:
        recipe: with ``validation="nested"``.
        pool: the features of the sampled bins.
        sample: of the training bins.
        weights: for how many training bins each sampled one stands, classes balanced, ``[n]``.
        progress: wraps the folds.
        num_bins: that the machine will be trained on.
        allowed: which features may be used, ``[F]``, bool.
        is_nested: whether to evaluate the choice itself by leaving out two groups.

    Raises:
        ValueError: if no group has bins of both classes, or there is one group only.
    """
    groups, names = sample_groups(sample)
    whole = [
        index
        for index in range(len(names))
        if bool(sample.is_slip[groups == index].any())
        and not bool(sample.is_slip[groups == index].all())
    ]
    if len(whole) < 2:
        lacking = [
            f"{name} has no {'non-slip' if bool(sample.is_slip[groups == index].all()) else 'slip'}"
            for index, name in enumerate(names)
            if index not in whole
        ]
        raise ValueError(
            "validation leaves out groups and needs two with bins of both classes, got "
            f"{len(whole)} ({', '.join(lacking) or 'there is one group'}); add recordings or take "
            "another recipe.group_by"
        )
    structures = candidates(recipe, num_bins)
    folds = [frozenset([group]) for group in whole]
    if is_nested and len(whole) > 2:
        folds += [frozenset(pair) for pair in itertools.combinations(whole, 2)]
    data = _Data(recipe, pool, sample, weights, groups, allowed)
    if not all(each.use == "pooled" and each.kernel.degree == 1 for each in structures):
        data.thin_out()
    penalties = list(recipe.penalties_ascending)
    found: dict[frozenset[int], _Scores] = {}
    steps, lock = iter(progress(folds, "validation, groups left out")), threading.Lock()

    def leave_out(fold: frozenset[int]) -> None:
        found[fold] = _Fold(data, fold, structures).at(penalties)
        with lock:
            next(steps, None)

    next(steps, None)  # shows the bar
    for_each(leave_out, folds)
    single = {group: found[frozenset([group])] for group in whole}
    edge = _extended(data, found, penalties, structures, whole, recipe.tolerance)

    def accuracy(fold: frozenset[int], group: int) -> Mapping[tuple[int, float], float]:
        return found[fold].accuracy[group]

    table = {group: accuracy(frozenset([group]), group) for group in whole}
    chosen = _best(table, structures, recipe.tolerance)
    by_key = {key: _row(structures, key, single, data, names) for key in sorted(_means(table))}
    rows, chosen_row = list(by_key.values()), by_key[chosen]
    scores = torch.cat([of.scores[group][chosen] for group, of in single.items()])
    rows_of = torch.cat([(groups == group).nonzero().flatten() for group in single])
    calibration = _calibration(scores, data.is_slip[rows_of], data.weights[rows_of])
    chosen_row |= {"chosen": True, "calibration": calibration}
    nested = None
    if is_nested and len(whole) > 2:
        by_group = {}
        for group in whole:
            others = [other for other in whole if other != group]
            inner = {other: accuracy(frozenset([group, other]), other) for other in others}
            by_group[names[group]] = table[group][_best(inner, structures, recipe.tolerance)]
        nested = {
            "mean": sum(by_group.values()) / len(by_group),
            "balanced_accuracy": by_group,
        }
    return Choice(structures[chosen[0]], chosen[1], rows, nested, edge)


def candidates(recipe: Recipe, num_bins: int) -> list[Structure]:
    """All structures of a recipe, the simplest first.

    Raises:
        ValueError: if there is none.
    """
    sizes: list[int | None] = [None] if recipe.takes_all else []
    sizes += recipe.sizes
    found = [
        Structure(use, size, kernel)
        for size in sizes
        for kernel in recipe.kernels
        if isinstance(kernel, Polynomial)
        for use in recipe.uses
        if kernel.degree == 1 or size is not None or num_bins <= MOST_DUAL_BINS
        if kernel.degree == 1 or not recipe.scene_weights or num_bins <= MOST_DUAL_BINS
    ]
    if not found:
        raise ValueError(
            "no candidate is left: degree 2 needs recipe.num_features and no scene_weights; add "
            "degree 1"
        )
    return found


def fitted_frame(
    recipe: Recipe,
    pool: FeaturePool,
    sample: SampledBins,
    structure: Structure,
    allowed: Tensor | None = None,
) -> Frame:
    """Compression, ranking and scaling of a structure, learned from a sample of training bins."""
    everything = torch.ones(len(sample.is_slip), dtype=torch.bool)
    weights = sample.represents
    groups, _ = sample_groups(sample)
    data = _Data(recipe, pool, sample, weights, groups, allowed)
    columns = _Columns(data, everything, everything, [structure.use])
    places = columns.ranked(structure)
    names = [columns.names(structure.use)[place] for place in places.tolist()]
    scaler = columns.scaler(structure.use, places)
    index = {name: place for place, name in enumerate(pool.names)}
    if not any(name.is_pooled for name in names):
        return Frame(tuple(index[name] for name in names), scaler)
    assert columns.pooling is not None  # something is pooled
    layer = columns.pooling
    if structure.use == "both":
        layer = layer.with_channels(data.names)
    layer = layer.select([layer.names.index(name) for name in names])
    return Frame(tuple(index[name] for name in layer.inputs), scaler, layer)


def group_scores(columns: Tensor, is_slip: Tensor, groups: Tensor) -> Tensor:
    """How well each feature separates the classes in every group, ``[F]``: larger is better.

    ``|mean effect| / sqrt(within-class variance + variance of the effect + of the level)``, the
    last two between groups: a feature whose threshold moves from material to material is worth
    less, which a t-test does not know. 0 for a constant feature.

    Shape:
        - columns: ``[N, F]``; is_slip: ``[N]``, bool; groups: ``[N]``, whole numbers
    """
    effects, levels, spreads = [], [], []
    for group in groups.unique().tolist():
        mine = groups == group
        quiet, slip = columns[mine & ~is_slip], columns[mine & is_slip]
        if not len(quiet) or not len(slip):
            continue
        effects.append(slip.mean(0) - quiet.mean(0))
        levels.append((slip.mean(0) + quiet.mean(0)) / 2)
        spreads.append((slip.var(0, correction=0) + quiet.var(0, correction=0)) / 2)
    effect, level = torch.stack(effects), torch.stack(levels)
    square = torch.stack(spreads).mean(0)
    if len(effects) > 1:
        square = square + effect.var(0) + level.var(0)
    found = effect.mean(0).abs() / square.sqrt()
    return torch.where(square > 0, found, 0.0)


class _Data:
    """The sampled bins of the features that may be used."""

    def __init__(
        self,
        recipe: Recipe,
        pool: FeaturePool,
        sample: SampledBins,
        weights: Tensor,
        groups: Tensor,
        allowed: Tensor | None,
    ) -> None:
        self.recipe, self.hand = recipe, pool.hand
        self.is_slip, self.groups = sample.is_slip, groups
        places = torch.arange(len(pool.names)) if allowed is None else allowed.nonzero().flatten()
        self.names = [pool.names[place] for place in places.tolist()]
        self.features = sample.features[:, places]
        self.weights = weights.clone()
        self.is_kept = torch.ones_like(sample.is_slip)
        self._stratum = 2 * sample.group + sample.is_slip.long()

    def thin_out(self) -> None:
        """Fit to fewer bins of each stratum; those that stay weigh more."""
        strata = self._stratum.unique().tolist()
        most = min(TRAINING_BINS, max(MOST_TRAINING_BINS // len(strata), 10))
        for one in strata:
            mine = (self._stratum == one).nonzero().flatten()
            # bins are sorted by recording; spread those that are kept over all of them
            kept = torch.linspace(0, len(mine) - 1, min(len(mine), most)).round().long()
            self.is_kept[mine] = False
            self.is_kept[mine[kept]] = True
            self.weights[mine] *= len(mine) / len(kept)


class _Columns:
    """Columns of some sampled bins, with what the training bins among them taught."""

    def __init__(self, data: _Data, rows: Tensor, train: Tensor, uses: Sequence[str]) -> None:
        self._data, features = data, data.features[rows]
        self.train = train[rows]
        self.is_slip, self.groups = data.is_slip[rows], data.groups[rows]
        self.pooling: ChannelPooling | None = None
        parts = {"channel": features} if set(uses) != {"pooled"} else {}
        if set(uses) != {"channel"}:
            setting = data.recipe.pooling
            assert setting is not None  # recipe
            own = features[self.train]
            self.pooling = layer = ChannelPooling.fit(data.hand, data.names, own, setting)
            place = {name: index for index, name in enumerate(data.names)}
            inputs = torch.tensor([place[name] for name in layer.inputs])
            parts["pooled"] = layer(features.index_select(1, inputs).double())
        compress, tail = data.recipe.compress, data.recipe.tail
        self._fitted: dict[str, FeatureScaler] = {}
        self._scaled: dict[str, Tensor] = {}
        for name, x in parts.items():
            x = x.double()
            scaler = FeatureScaler.fit(x[self.train], compress=compress, tail=tail)
            self._fitted[name], self._scaled[name] = scaler, scaler(x)
        self._ranks: dict[str, Tensor] = {}
        self._products: dict[str, Tensor] = {}

    def names(self, use: str) -> list[Any]:
        """Of the columns of a use."""
        pooled = [] if self.pooling is None else list(self.pooling.names)
        return [
            *(self._data.names if use != "pooled" else []),
            *(pooled if use != "channel" else []),
        ]

    def scaled(self, use: str) -> Tensor:
        """Scaled columns of all bins, ``[n, K]``."""
        if use == "both":
            return torch.cat([self._scaled["channel"], self._scaled["pooled"]], 1)
        return self._scaled[use]

    def num_columns(self, structure: Structure) -> int:
        """K of a structure."""
        num = sum(self._scaled[name].shape[1] for name in _parts(structure.use))
        return min(num, structure.num_features or num)

    def of(self, structure: Structure) -> Tensor:
        """Scaled columns of a structure, best first, ``[n, K]``."""
        z = self.scaled(structure.use)
        return z if structure.num_features is None else z[:, self.ranked(structure)]

    def products(self, structure: Structure) -> Tensor:
        """Inner products of all bins with the training bins, ``[n, train]``."""
        if structure.num_features is not None:
            z = self.of(structure)
            return z @ z[self.train].mT
        total: Tensor | None = None
        for name in _parts(structure.use):
            if name not in self._products:
                z = self._scaled[name]
                self._products[name] = z @ z[self.train].mT
            total = self._products[name] if total is None else total + self._products[name]
        assert total is not None  # of at least one part
        return total

    def scaler(self, use: str, places: Tensor) -> FeatureScaler:
        """Of some columns."""
        parts = [self._fitted[name] for name in _parts(use)]
        knees = [part.knee for part in parts if part.knee is not None]
        return FeatureScaler(
            torch.cat([part.minimum for part in parts])[places],
            torch.cat([part.maximum for part in parts])[places],
            torch.cat(knees)[places] if knees else None,
        )

    def ranked(self, structure: Structure) -> Tensor:
        """Places of the columns of a structure, best first; all in their order."""
        if structure.num_features is None:
            return torch.arange(len(self.names(structure.use)))
        own = _parts(structure.use)
        for name in own:
            if name not in self._ranks:
                z = self._scaled[name][self.train]
                is_slip, groups = self.is_slip[self.train], self.groups[self.train]
                self._ranks[name] = group_scores(z, is_slip, groups)
        scores = torch.cat([self._ranks[name] for name in own])
        return scores.argsort(descending=True, stable=True)[: structure.num_features]


def _parts(use: str) -> tuple[str, ...]:
    return ("channel", "pooled") if use == "both" else (use,)


@dataclass(frozen=True)
class _Scores:
    """Scores of the left-out groups, and their balanced accuracies."""

    scores: dict[int, dict[tuple[int, float], Tensor]]
    accuracy: dict[int, dict[tuple[int, float], float]]


class _Fold:
    """Machines without some groups.

    Columns are formed anew for other penalties rather than kept: they are large.
    """

    def __init__(self, data: _Data, left_out: frozenset[int], structures: list[Structure]) -> None:
        self._data, self._left_out, self._structures = data, left_out, structures

    def at(self, penalties: Sequence[float], places: Sequence[int] | None = None) -> _Scores:
        """Balanced accuracies for some penalties; of some structures, by default of all."""
        data = self._data
        places = range(len(self._structures)) if places is None else places
        is_out = torch.isin(data.groups, torch.tensor(sorted(self._left_out)))
        train = data.is_kept & ~is_out
        rows = train | is_out
        columns = _Columns(data, rows, train, sorted({self._structures[p].use for p in places}))
        targets = torch.where(data.is_slip, 1.0, -1.0).double()[train]
        is_train, truths = columns.train, columns.is_slip[~columns.train]
        of_group = {g: columns.groups[~is_train] == g for g in self._left_out}
        found = _Scores({g: {} for g in self._left_out}, {g: {} for g in self._left_out})
        for place in places:
            structure = self._structures[place]
            by_penalty = _ridge_scores(columns, structure, targets, data.weights[train], penalties)
            for penalty, scores in zip(penalties, by_penalty, strict=True):
                for group, mine in of_group.items():
                    accuracy = recalls_mean(scores[mine] >= 0, truths[mine])
                    assert accuracy is not None  # of groups with both classes
                    found.accuracy[group][place, penalty] = accuracy
                    found.scores[group][place, penalty] = scores[mine]
        return found


def _ridge_scores(
    columns: _Columns,
    structure: Structure,
    targets: Tensor,
    weights: Tensor,
    penalties: Sequence[float],
) -> Tensor:
    """Scores of the left-out bins by kernel ridge regression, ``[penalties, bins]``.

    Through the primal or the dual, whichever has fewer unknowns.
    """
    kernel, is_train = structure.kernel, columns.train
    num = columns.num_columns(structure)
    if kernel.degree == 1 and num < len(targets):
        z = columns.of(structure)
        x = torch.cat([z, torch.full_like(z[:, :1], math.sqrt(kernel.offset))], 1)
        system = x[is_train].mT @ (x[is_train] * weights[:, None])
        right, others, each = x[is_train].mT @ (weights * targets), x[~is_train], torch.ones(())
    else:
        gram = (columns.products(structure) + kernel.offset) ** kernel.degree
        system, right, others, each = gram[is_train], targets, gram[~is_train], 1 / weights
    solved = []
    for penalty in penalties:
        ridged = system.clone()
        ridged.diagonal().add_(each / penalty)
        factor, info = torch.linalg.cholesky_ex(ridged)
        if int(info):  # a weak penalty on columns that repeat each other
            found = torch.linalg.lstsq(ridged, right[:, None], driver="gelsd").solution
        else:
            found = torch.cholesky_solve(right[:, None], factor)
        solved.append(found)
    return (others @ torch.cat(solved, 1)).mT


Table = Mapping[int, Mapping[tuple[int, float], float]]
"""Balanced accuracy by group and candidate, a place among the structures with a penalty."""


def _means(table: Table) -> dict[tuple[int, float], float]:
    first = next(iter(table.values()))
    return {key: sum(of[key] for of in table.values()) / len(table) for key in first}


def _best(table: Table, structures: Sequence[Structure], tolerance: float) -> tuple[int, float]:
    """Of those within the tolerance: no selection, the lower degree, fewer features, least C."""
    means = _means(table)
    least = max(means.values()) - tolerance
    uses = ("pooled", "channel", "both")  # by their number, of the paper's hand

    def order(key: tuple[int, float]) -> tuple[bool, int, int, int, float]:
        structure, penalty = structures[key[0]], key[1]
        size = structure.num_features or 0
        by_use = uses.index(structure.use)
        return structure.num_features is not None, structure.kernel.degree, size, by_use, penalty

    return min((key for key, mean in means.items() if mean >= least), key=order)


def _extended(
    data: _Data,
    found: dict[frozenset[int], _Scores],
    penalties: list[float],
    structures: list[Structure],
    whole: Sequence[int],
    tolerance: float,
) -> str:
    """Extend a grid whose end was chosen, or is best; says what was done."""
    said = []
    for is_low in (True, False):
        for _ in range(MOST_EXTENSIONS):
            table = {group: found[frozenset([group])].accuracy[group] for group in whole}
            means = _means(table)
            chosen, best = _best(table, structures, tolerance), max(means, key=means.__getitem__)
            place, penalty = chosen if is_low else best
            own = [key[1] for key in means if key[0] == place]
            if penalty != (min(own) if is_low else max(own)) or len(penalties) < 2:
                break
            beyond = penalty / 10 if is_low else penalty * 10

            def extend(fold: frozenset[int], place: int = place, beyond: float = beyond) -> None:
                more = _Fold(data, fold, structures).at([beyond], [place])
                for group in fold:
                    found[fold].accuracy[group].update(more.accuracy[group])
                    found[fold].scores[group].update(more.scores[group])

            for_each(extend, list(found))
            said.append(f"{beyond:g}")
    if not said:
        return ""
    return f"recipe.penalties ended at its edge and was extended by {', '.join(said)}"


def _row(
    structures: Sequence[Structure],
    key: tuple[int, float],
    single: Mapping[int, _Scores],
    data: _Data,
    names: Sequence[str],
) -> dict[str, Any]:
    """What is told of a candidate."""
    structure, penalty = structures[key[0]], key[1]
    by_group = {group: of.accuracy[group][key] for group, of in single.items()}
    worst = min(by_group, key=by_group.__getitem__)
    scores, truth = single[worst].scores[worst][key], data.is_slip[data.groups == worst]
    rule = best_threshold(scores[:, None], truth)
    return {
        "use": structure.use,
        "num_features": structure.num_features,
        "kernel": structure.kernel.to_dict(),
        "penalty": penalty,
        "mean": sum(by_group.values()) / len(by_group),
        "balanced_accuracy": {names[group]: value for group, value in by_group.items()},
        "worst": {
            "group": names[worst],
            "balanced_accuracy": by_group[worst],
            "best_threshold": rule.threshold,
            "at_best_threshold": recalls_mean(rule(scores[:, None]), truth),
        },
    }
