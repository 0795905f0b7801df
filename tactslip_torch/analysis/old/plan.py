"""A plan: what is chosen before the second pass, and the machine that its training bins make.

``plan_detector`` decides from the statistics of the first pass; ``TrainingPass`` gathers the bins
of the second in any order and solves. Features, K, degree, c and C are chosen by groups of
recordings that are left out.

**Held** (``_choose_held``): features are ranked and scaled once; a held-out score is that of the
machine refitted without the bin's group, in closed form (``HeldOut``). Ranking and scaling have
seen the group, so these scores choose, and are not what may be reported.

**Nested** (``choose_model``): a candidate is a set of features (of channels, pooled, or both; all
or the best K), a degree and a penalty C. In each fold everything that is learned, compression
constants, ranking and scaling included, is learned without the group that is left out. Of the
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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.analysis.old.bin_sample import SampledBins, bin_keys
from tactslip_torch.analysis.old.recipe import (
    FeatureSelection,
    Recipe,
    balanced_accuracy,
    best_threshold,
    class_fractions,
    number_of_bins,
    sample_groups,
    sample_weight,
    scene_weights,
    select_features,
)
from tactslip_torch.analysis.old.statistics import TrainingStatistics
from tactslip_torch.data.splits import PAPER_SCENE
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import (
    Sensing,
    SpanFeatures,
    least_alive,
    most_stuck_samples,
)
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.detector import SlipDetector, counted_channels
from tactslip_torch.model.fit import HeldOut, TrainingBins, fit_machine
from tactslip_torch.model.kernels import Head, Polynomial, kernel_from_dict
from tactslip_torch.model.moments import SufficientStats
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import SeenBatches, bar, content_digest, for_each, steps
from tactslip_torch.signals.filtering import ChannelFilter

log = logging.getLogger(__name__)

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
_SCALED_BINS = 256  # at a time, which fits the cache of a processor


# Held validation --------------------------------------------------------------------------


def _choose_held(
    recipe: Recipe,
    selection: FeatureSelection,
    sample: SampledBins,
    *,
    show: bool = False,
) -> tuple[list[dict[str, Any]], int, Polynomial, float]:
    """Rows of the validation, and the K, kernel and C of the best of them.

    Args:
        recipe: what to choose from.
        selection: features ranked and scaled, as many as the largest K.
        sample: of the training bins.
        show: a progress bar.
    """
    sizes = sorted({min(size, selection.size) for size in recipe.sizes})
    if sizes[-1] < recipe.sizes[-1]:
        log.warning(
            "recipe.num_features=%d is cut to %d: no more match", recipe.sizes[-1], sizes[-1]
        )
    penalties = recipe.penalties_ascending
    choices = list(itertools.product(sizes, recipe.kernels, penalties))
    if len(sample.group_names) < 2 or len(choices) == 1:
        # of the most features and the last kernel
        chosen = choices[len(choices) - len(penalties) + len(penalties) // 2]
        if len(choices) > 1:
            log.warning("K=%d, %s, C=%g are taken unvalidated: one group", *chosen)
        return [], *chosen
    bins = TrainingBins(selection(sample.features), sample.is_slip, sample_weight(recipe, sample))
    rows = validate(bins, sample.group, sample.group_names, choices, show=show)
    place = max(range(len(rows)), key=lambda i: rows[i]["mean"])
    rows[place]["chosen"] = True
    return rows, *choices[place]


def validate(
    bins: TrainingBins,
    groups: Tensor,
    names: Sequence[str],
    choices: Sequence[tuple[int, Polynomial, float]],
    *,
    show: bool = False,
) -> list[dict[str, Any]]:
    """Balanced accuracy of each held-out group for each choice of K, kernel and C, in order.

    Args:
        bins: training bins, as many features as the largest K, best first.
        groups: ``[N]``, which group each bin is of, an index into ``names``.
        names: of the groups.
        choices: in any order; those of one K and kernel that stand together cost least.
        show: a progress bar.

    Returns:
        One row per choice; ``mean`` is over the groups that have bins of both classes.

    Raises:
        ValueError: if no group has, or held-out scores cannot be told (``HeldOut``).
    """
    rows = []
    machine, made_of = None, None
    for size, kernel, penalty in bar(choices, "choose C on held-out groups", show=show):
        if machine is None or made_of != (size, kernel):
            few = TrainingBins(bins.features[:, :size], bins.is_slip, bins.weights)
            machine, made_of = HeldOut(few, groups, kernel), (size, kernel)
        scores = machine.at(penalty).scores
        by_group = {
            name: balanced_accuracy(scores[groups == index] >= 0, bins.is_slip[groups == index])
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

    @property
    def parts(self) -> tuple[str, ...]:
        """The kinds of columns it takes."""
        return ("channel", "pooled") if self.use == "both" else (self.use,)


Candidate = tuple[Structure, float]
"""A structure and its penalty."""


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
    """

    structure: Structure
    penalty: float
    rows: list[dict[str, Any]]
    nested: dict[str, Any] | None


def candidates(recipe: Recipe, num_bins: int) -> list[Structure]:
    """All structures of a recipe for a machine of so many training bins, the simplest first.

    Raises:
        ValueError: if there is none.
    """
    sizes: list[int | None] = [None] if recipe.takes_all else []
    may_grow = num_bins <= MOST_DUAL_BINS
    found = [
        Structure(use, size, kernel)
        for size in [*sizes, *recipe.sizes]
        for kernel in recipe.kernels
        for use in recipe.uses
        if kernel.degree == 1 or may_grow or (size is not None and not recipe.scene_weights)
    ]
    if not found:
        raise ValueError(
            "no candidate is left: degree 2 needs recipe.num_features and no scene_weights; add "
            "degree 1"
        )
    return found


def choose_model(
    recipe: Recipe,
    pool: FeaturePool | None,
    sample: SampledBins,
    allowed: Tensor | None = None,
    *,
    is_nested: bool = True,
    show: bool = False,
) -> Choice:
    """Choose among the candidates of a recipe.

    Args:
        recipe: with ``validation="nested"``.
        pool: the features of the sampled bins; ``None`` for others, which are not pooled.
        sample: of the training bins.
        allowed: which features may be used, ``[F]``, bool; by default those the recipe allows.
        is_nested: whether to evaluate the choice itself by leaving out two groups.
        show: a progress bar.

    Raises:
        ValueError: if no group has bins of both classes, or there is one group only.
    """
    bins = _Bins(recipe, pool, sample, allowed)
    groups = bins.whole_groups()
    structures = candidates(recipe, number_of_bins(recipe, sample))
    if not all(each.use == "pooled" and each.kernel.degree == 1 for each in structures):
        bins.thin_out()
    folds = [frozenset([group]) for group in groups]
    if is_nested := is_nested and len(groups) > 2:
        folds += [frozenset(pair) for pair in itertools.combinations(groups, 2)]
    with steps("validation, groups left out", "step", len(folds), show=show) as shown:

        def leave_out(fold: frozenset[int]) -> None:
            bins.leave_out(fold, structures, recipe.penalties_ascending)
            shown.update()

        for_each(leave_out, folds)
    _extend_grid(bins, groups)
    accuracy = bins.accuracies(groups)
    chosen = _best(accuracy, recipe.tolerance)
    order = sorted(accuracy[groups[0]], key=lambda key: (structures.index(key[0]), key[1]))
    rows = []
    for key in order:
        by_group = {group: of[key] for group, of in accuracy.items()}
        rows.append(_row(bins, key, by_group))
        if key == chosen:
            scores = torch.cat([bins.scores[frozenset([group])][group][key] for group in groups])
            places = torch.cat([bins.of(group) for group in groups])
            calibration = _calibration(scores, bins.is_slip[places], bins.weights[places])
            rows[-1] |= {"chosen": True, "calibration": calibration}
    nested = None
    if is_nested:
        by_name = {}
        for group in groups:
            inner = bins.accuracies([other for other in groups if other != group], group)
            by_name[bins.names[group]] = accuracy[group][_best(inner, recipe.tolerance)]
        nested = {"mean": sum(by_name.values()) / len(by_name), "balanced_accuracy": by_name}
    return Choice(*chosen, rows, nested)


def fitted_selection(
    recipe: Recipe,
    pool: FeaturePool | None,
    sample: SampledBins,
    structure: Structure,
    allowed: Tensor | None = None,
) -> FeatureSelection:
    """Compression, ranking and scaling of a structure, learned from a sample of training bins.

    ``pool`` and ``allowed`` as in ``choose_model``.
    """
    bins = _Bins(recipe, pool, sample, allowed)
    columns = _Columns(bins, torch.ones_like(bins.is_slip), bins.is_slip | True, structure.parts)
    names = inputs = [columns.names[place] for place in columns.places(structure).tolist()]
    layer = columns.pooling
    if layer is not None and any(name.is_pooled for name in names):
        if structure.use == "both":
            layer = layer.with_channels(bins.feature_names)
        layer = layer.select([layer.names.index(name) for name in names])
        inputs = list(layer.inputs)
    else:
        layer = None
    index = {name: place for place, name in enumerate(_names_of(pool, sample))}
    selected = [index[name] for name in inputs]
    x = sample.features[:, selected].double()
    is_lost, silence = None, None
    if layer is not None and bins.spans is not None:
        is_lost, sensing = columns.is_lost, columns.sensing
        silence = bins.span_features, sensing
    scaler = FeatureScaler.fit(x if layer is None else layer(x, is_lost), **bins.scaling)
    return FeatureSelection(tuple(selected), scaler, layer, silence)


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


def _names_of(pool: FeaturePool | None, sample: SampledBins) -> Sequence[Any]:
    """Names of the features of sampled bins; without a pool their places."""
    return range(sample.features.shape[1]) if pool is None else pool.names


class _Bins:
    """The sampled bins of the features that may be used, in their validation groups."""

    def __init__(
        self, recipe: Recipe, pool: FeaturePool | None, sample: SampledBins, allowed: Tensor | None
    ) -> None:
        self.recipe, self.hand = recipe, None if pool is None else pool.hand
        self.is_slip, self.weights = sample.is_slip, sample_weight(recipe, sample)
        self.groups, self.names = sample_groups(sample)
        allowed = recipe.allowed(pool) if allowed is None and pool is not None else allowed
        names = _names_of(pool, sample)
        self.spans: Tensor | None = None
        if pool is not None:
            self.span_features = SpanFeatures(pool.hand, pool.names, pool.bin_samples)
            self.spans = self.span_features(sample.features)
        places = torch.arange(len(names)) if allowed is None else allowed.nonzero().flatten()
        self.feature_names = [names[place] for place in places.tolist()]
        self.features = sample.features[:, places]
        self.is_kept = torch.ones_like(sample.is_slip)
        self.scaling: dict[str, Any] = {"compress": recipe.compress, "tail": recipe.tail}
        self.scores: dict[frozenset[int], dict[int, dict[Candidate, Tensor]]] = {}
        self._stratum = 2 * sample.group + sample.is_slip.long()

    def of(self, group: int) -> Tensor:
        """Places of the bins of a group."""
        return (self.groups == group).nonzero().flatten()

    def accuracies(self, groups: Sequence[int], *others: int) -> _Table:
        """Balanced accuracy on each group, by the machines without it and without the others."""
        table = {}
        for group in groups:
            is_slip = self.is_slip[self.of(group)]
            scores = self.scores[frozenset([group, *others])][group]
            found = {key: balanced_accuracy(own >= 0, is_slip) for key, own in scores.items()}
            table[group] = {key: value for key, value in found.items() if value is not None}
        return table

    def whole_groups(self) -> list[int]:
        """The groups with bins of both classes.

        Raises:
            ValueError: if there are not two.
        """
        whole = [
            group
            for group in range(len(self.names))
            if len(self.is_slip[self.of(group)].unique()) == 2
        ]
        if len(whole) < 2:
            raise ValueError(
                "validation leaves out groups and needs two with bins of both classes, got "
                f"{len(whole)} of {', '.join(self.names)}; add recordings or take another "
                "recipe.group_by"
            )
        return whole

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

    def leave_out(
        self, fold: frozenset[int], structures: Sequence[Structure], penalties: Sequence[float]
    ) -> None:
        """Score each group of a fold by machines that saw no group of it."""
        is_out = torch.isin(self.groups, torch.tensor(sorted(fold)))
        train = self.is_kept & ~is_out
        parts = sorted({part for structure in structures for part in structure.parts})
        columns = _Columns(self, train | is_out, train, parts)
        targets = torch.where(self.is_slip, 1.0, -1.0).double()[train]
        member = self.groups[is_out]
        found = self.scores.setdefault(fold, {group: {} for group in fold})
        for structure in structures:
            by_penalty = _ridge_scores(columns, structure, targets, self.weights[train], penalties)
            for penalty, scores in zip(penalties, by_penalty, strict=True):
                for group in fold:
                    found[group][structure, penalty] = scores[member == group]


class _Columns:
    """Scaled columns of some sampled bins, with what the training bins among them taught.

    Attributes:
        train: which of the bins are training bins, ``[n]``.
        z: the columns, ``[n, K]``, those of channels before pooled ones.
        names: of the columns.
        pooling: that made the pooled ones.
        sensing: of the training bins, for pooled columns.
        is_lost: silent channels of the bins, ``[n, C]``, left out of the pools.
    """

    sensing: Sensing
    is_lost: Tensor

    def __init__(self, bins: _Bins, rows: Tensor, train: Tensor, parts: Sequence[str]) -> None:
        self.train = train[rows]
        self._is_slip, self._groups = bins.is_slip[train], bins.groups[train]
        features, scaled = bins.features[rows], list[Tensor]()
        self.names, self.pooling = list[Any](), None
        self._places, self._products = dict[str, Tensor](), dict[str, Tensor]()
        for part in sorted(parts):
            x, names = features, bins.feature_names
            if part == "pooled":
                setting = bins.recipe.pooling
                assert setting is not None  # recipe
                assert bins.hand is not None  # plan_detector
                assert bins.spans is not None
                spans, own = bins.spans[rows], features[self.train]
                self.sensing = Sensing.fit(spans[self.train], 1, 1)
                self.is_lost = bins.span_features.is_silent(spans, self.sensing)
                lost = self.is_lost[self.train]
                layer = self.pooling = ChannelPooling.fit(bins.hand, names, own, setting, lost)
                place = {name: index for index, name in enumerate(names)}
                inputs = [place[name] for name in layer.inputs]
                x = layer(features[:, inputs].double(), self.is_lost)
                names = list(layer.names)
            x = x.double()
            scaler = FeatureScaler.fit(x[self.train], **bins.scaling)
            scaled.append(torch.cat([scaler(few) for few in x.split(_SCALED_BINS)]))
            self._places[part] = torch.arange(len(names)) + len(self.names)
            self.names += names
        self.z = torch.cat(scaled, 1)

    def places(self, structure: Structure) -> Tensor:
        """Which columns a structure takes, best first; all in their order."""
        places = torch.cat([self._places[part] for part in structure.parts])
        if structure.num_features is None:
            return places
        order = self._scores[places].argsort(descending=True, stable=True)
        return places[order[: structure.num_features]]

    def products(self, structure: Structure) -> Tensor:
        """Inner products of all bins with the training bins, ``[n, train]``."""
        if structure.num_features is not None:
            z = self.z[:, self.places(structure)]
            return z @ z[self.train].mT
        for part in structure.parts:
            if part not in self._products:
                z = self.z[:, self._places[part]]
                self._products[part] = z @ z[self.train].mT
        first, *others = (self._products[part] for part in structure.parts)
        return sum(others, first)

    @cached_property
    def _scores(self) -> Tensor:
        return group_scores(self.z[self.train], self._is_slip, self._groups)


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
    places = columns.places(structure)
    if kernel.degree == 1 and len(places) < len(targets):
        z = columns.z[:, places]
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


_Table = Mapping[int, Mapping[Candidate, float]]
"""Balanced accuracy by group and candidate."""


def _means(table: _Table) -> dict[Candidate, float]:
    first = next(iter(table.values()))
    return {key: sum(of[key] for of in table.values()) / len(table) for key in first}


def _best(table: _Table, tolerance: float) -> Candidate:
    """Of those within the tolerance: no selection, the lower degree, fewer features, least C."""
    means = _means(table)
    least = max(means.values()) - tolerance
    uses = ("pooled", "channel", "both")  # by their number, of the paper's hand

    def order(key: Candidate) -> tuple[bool, int, int, int, float]:
        (use, size, kernel), penalty = key
        return size is not None, kernel.degree, size or 0, uses.index(use), penalty

    return min((key for key, mean in means.items() if mean >= least), key=order)


def _extend_grid(bins: _Bins, groups: Sequence[int]) -> None:
    """Extend a grid of penalties whose end was chosen, or is best, and say so."""
    recipe, added = bins.recipe, list[str]()
    for is_low in (True, False) if len(recipe.penalties_ascending) > 1 else ():
        for _ in range(MOST_EXTENSIONS):
            table = bins.accuracies(groups)
            means = _means(table)
            best = _best(table, recipe.tolerance) if is_low else max(means, key=means.__getitem__)
            own = [penalty for structure, penalty in means if structure == best[0]]
            if best[1] != (min(own) if is_low else max(own)):
                break
            beyond = best[1] / 10 if is_low else best[1] * 10
            for_each(partial(bins.leave_out, structures=best[:1], penalties=[beyond]), bins.scores)
            added.append(f"{beyond:g}")
    if added:
        log.info("recipe.penalties ended at its edge and was extended by %s", ", ".join(added))


def _row(bins: _Bins, key: Candidate, by_group: Mapping[int, float]) -> dict[str, Any]:
    """What a file says of a candidate."""
    structure, penalty = key
    worst = min(by_group, key=by_group.__getitem__)
    scores = bins.scores[frozenset([worst])][worst][key][:, None]
    is_slip = bins.is_slip[bins.of(worst)]
    rule = best_threshold(scores, is_slip)
    return {
        "use": structure.use,
        "num_features": structure.num_features,
        "kernel": structure.kernel.to_dict(),
        "penalty": penalty,
        "mean": sum(by_group.values()) / len(by_group),
        "balanced_accuracy": {bins.names[group]: value for group, value in by_group.items()},
        "worst": {
            "group": bins.names[worst],
            "balanced_accuracy": by_group[worst],
            "best_threshold": rule.threshold,
            "at_best_threshold": balanced_accuracy(rule(scores), is_slip),
        },
    }


# The plan -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plan:
    """What is decided before the second pass.

    Args:
        recipe: that it follows.
        selection: which features, how scaled.
        kernel: of the machine.
        penalty: the paper's ``C``.
        fractions: the part of non-slip and slip bins that is trained on.
        num_bins: how many bins are trained on; about, where fractions are below 1.
        imputation: mean of the scaled columns, both classes counting alike; for lost channels.
        sensing: what the training bins tell of channels that work; ``None`` without a pool.
        validation: one row per choice: what was chosen from, the balanced accuracy of each
            held-out group; of the one that was taken also ``chosen``, and the calibration of its
            held-out scores.
        nested: balanced accuracy of the whole choice on groups that it did not see, if it was
            evaluated.
        feature_filter: of a recipe that restricts the ranking: to what, how many features that
            leaves (``matching``), and the numbers chosen from after cutting them to it.
        scene_weights: weight of a bin by scene, non-slip and slip, classes balanced; empty if
            scenes are not weighed.
    """

    recipe: Recipe
    selection: FeatureSelection
    kernel: Polynomial
    penalty: float
    fractions: tuple[float, float]
    num_bins: int
    imputation: Tensor
    sensing: Sensing | None = None
    validation: list[dict[str, Any]] = field(default_factory=list)
    nested: dict[str, Any] | None = None
    feature_filter: dict[str, Any] | None = None
    scene_weights: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def uses_normal_equations(self) -> bool:
        """Whether training bins become sums of fixed size; few bins do not."""
        return self.num_bins > self.kernel.num_monomials(self.selection.size)

    @property
    def balance(self) -> Literal["weights", "none"]:
        """Of the classes in the solve; weights of scenes are balanced already."""
        is_weighted = self.recipe.balance == "weights" and not self.scene_weights
        return "weights" if is_weighted else "none"

    @property
    def calibration(self) -> dict[str, Any] | None:
        """By held-out scores of the choice that was taken; None if there was nothing to choose."""
        chosen = (row.get("calibration") for row in self.validation if row.get("chosen"))
        return next(chosen, None)

    @property
    def metadata(self) -> dict[str, Any]:
        """What was decided, for files, JSON-able."""
        return {
            "recipe": self.recipe.name,
            "kernel": self.kernel.to_dict(),
            "penalty": self.penalty if math.isfinite(self.penalty) else "inf",  # JSON has none
            "balance": self.recipe.balance,
            "num_bins": self.num_bins,
        }

    def training_bins(self, sample: SampledBins) -> TrainingBins:
        """Sampled bins, scaled, each with the weight of all that it was drawn from."""
        weights = sample_weight(self.recipe, sample)
        return TrainingBins(self.selection(sample.features), sample.is_slip, weights)

    def detector(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        head: Head,
        info: Mapping[str, Any],
        backend: BackendName | None = None,
    ) -> SlipDetector:
        """The detector of this plan with a machine that was solved for it; backend of the pool."""
        selection = self.selection
        return SlipDetector(
            pool,
            channel_filter,
            selection.selected,
            selection.scaler,
            head,
            info,
            self.imputation,
            selection.pooling,
            sensing=self.sensing,
            backend=backend or pool.backend,
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values and tensors, for a checkpoint; without the recipe."""
        plain = {k: v for k, v in vars(self).items() if k not in ("recipe", "selection")}
        pooling = self.selection.pooling
        return plain | {
            "selected": self.selection.selected,
            "scaler": dict(self.selection.scaler.state_dict()),
            "pooling": pooling and (pooling.to_dict(), dict(pooling.state_dict())),
            "kernel": self.kernel.to_dict(),
            "sensing": self.sensing and self.sensing.to_dict(),
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any], recipe: Recipe, pool: FeaturePool) -> Plan:
        """What ``to_dict`` described, of the same recipe and pool."""
        values = dict(plain)
        selected, scaler = values.pop("selected"), FeatureScaler(**values.pop("scaler"))
        pooling = values.pop("pooling")
        pooling = pooling and ChannelPooling.from_dict(pool.hand, *pooling)
        values["kernel"] = kernel_from_dict(values["kernel"])
        silence = None
        if values["sensing"] is not None:
            values["sensing"] = Sensing.from_dict(values["sensing"])
            spans = SpanFeatures(pool.hand, pool.names, pool.bin_samples)
            silence = spans, values["sensing"]
        return cls(recipe, FeatureSelection(tuple(selected), scaler, pooling, silence), **values)


def plan_detector(
    recipe: Recipe,
    statistics: TrainingStatistics | SampledBins,
    pool: FeaturePool | None = None,
    selection: FeatureSelection | None = None,
    *,
    is_nested: bool = True,
    show: bool = False,
) -> Plan:
    """Choose the features and the machine by validation on held-out groups.

    Of a recipe that leaves no choice nothing is validated.

    Args:
        recipe: what to choose from, and how.
        statistics: statistics of the training bins; for a nested validation the bins serve.
        pool: of the features; only without it may every feature be selected whatever its name.
            Features that are pooled over channels need it.
        selection: features that were ranked and scaled elsewhere.
        is_nested: whether to evaluate a nested choice itself.
        show: a progress bar.

    Raises:
        ValueError: if a class is absent, a solve fails, or the recipe needs the pool.
    """
    sample = statistics if isinstance(statistics, SampledBins) else statistics.sample.bins()
    allowed = None if pool is None else recipe.allowed(pool)
    fractions = class_fractions(recipe, sample)
    num_bins = number_of_bins(recipe, sample)
    nested = None
    if recipe.validation == "nested" and selection is None:
        if pool is None and set(recipe.uses) != {"channel"}:
            raise ValueError("recipe.use=pooled needs the pool of features; hand it over as pool=")
        if len(sample_groups(sample)[1]) > 1:
            choice = choose_model(recipe, pool, sample, is_nested=is_nested, show=show)
            structure, penalty = choice.structure, choice.penalty
            rows, nested = choice.rows, choice.nested
        else:
            penalties = recipe.penalties_ascending
            structure, penalty = candidates(recipe, num_bins)[0], penalties[len(penalties) // 2]
            rows = []
            log.warning("%s, C=%g are taken unvalidated: one group", structure, penalty)
        kernel = structure.kernel
        selection = fitted_selection(recipe, pool, sample, structure)
    else:
        if selection is None:
            if isinstance(statistics, SampledBins):
                raise ValueError("recipe.validation=held needs statistics of all training bins")
            selection = select_features(recipe, statistics, allowed)
        rows, size, kernel, penalty = _choose_held(recipe, selection, sample, show=show)
        selection = selection.first(size)
    z, weights = selection(sample.features), sample_weight(recipe, sample)
    means = [
        weights[own] @ z[own] / weights[own].sum() for own in (sample.is_slip, ~sample.is_slip)
    ]
    feature_filter = None
    if recipe.feature_filter is not None and allowed is not None:
        matching = int(allowed.sum())
        feature_filter = {
            "wanted": {name: list(values) for name, values in recipe.feature_filter.items()},
            "matching": matching,
            "num_features": sorted({min(size, matching) for size in recipe.sizes}),
        }
    return Plan(
        recipe=recipe,
        selection=selection,
        kernel=kernel,
        penalty=penalty,
        fractions=fractions,
        num_bins=num_bins,
        imputation=(means[0] + means[1]) / 2,
        sensing=None if pool is None else _sensing(recipe, pool, statistics, sample, selection),
        validation=rows,
        nested=nested,
        feature_filter=feature_filter,
        scene_weights=scene_weights(recipe, sample) if recipe.scene_weights else {},
    )


def _sensing(
    recipe: Recipe,
    pool: FeaturePool,
    statistics: TrainingStatistics | SampledBins,
    sample: SampledBins,
    selection: FeatureSelection,
) -> Sensing:
    """What the training bins tell of channels that work, for the machine of a selection."""
    place = {name: index for index, name in enumerate(pool.hand.names)}
    used = sorted({place[pool.names[index].channel] for index in selection.selected})
    is_pooled = selection.pooling is not None
    num_counted = len(counted_channels(pool.hand, used, is_pooled))
    fraction = 1 - recipe.drop_channels if is_pooled and recipe.drop_channels else 0.5
    run = statistics.longest_run if isinstance(statistics, TrainingStatistics) else None
    spans = SpanFeatures(pool.hand, pool.names, pool.bin_samples)(sample.features)
    return Sensing.fit(
        spans,
        recipe.min_alive or least_alive(num_counted, fraction),
        most_stuck_samples(pool.sample_rate_hz, run),
    )


# The second pass ---------------------------------------------------------------------------------


class TrainingPass:
    """What a plan needs of the training bins, gathered recording by recording.

    Sums of fixed size for polynomial kernels and many bins; the bins themselves where they are few
    or the kernel is another.

    Args:
        plan: what was decided.

    Attributes:
        seen_batches: recordings that are in, where bins themselves are kept.
        bins: of each recording columns ``[N, K]``, labels and weights ``[N]``.
        stats: the sums; None where bins themselves are kept.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.seen_batches = SeenBatches()
        self.bins: dict[str, tuple[Tensor, Tensor, Tensor]] = {}
        self.stats: SufficientStats | None = None
        if plan.uses_normal_equations:
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
        kept = _is_kept(recording, is_slip, plan.fractions)
        features, is_slip = features[kept], is_slip[kept].bool()
        z, pooling = plan.selection(features), plan.selection.pooling
        of_class = torch.tensor(plan.scene_weights.get(scene, (1.0, 1.0)), dtype=torch.float64)
        weights = of_class[is_slip.long()]
        if plan.recipe.drop_channels > 0 and pooling is not None:
            is_lost = _dropped(recording, len(pooling.hand), plan.recipe.drop_channels)
            fewer = plan.selection(features, is_lost.expand(len(z), -1))
            z, is_slip, weights = torch.cat([z, fewer]), is_slip.repeat(2), weights.repeat(2) / 2
        if self.stats is not None:
            self.stats.update(recording, z, is_slip, weights)
            return
        self.seen_batches.add(recording, content_digest(z, is_slip))
        self.bins[recording] = (z, is_slip, weights)

    def solve(self) -> Head:
        """The machine.

        Raises:
            ValueError: if a class is absent, or the system cannot be told in float64.
        """
        plan = self.plan
        if self.stats is not None:
            assert isinstance(plan.kernel, Polynomial)
            return self.stats.solve(plan.penalty, plan.kernel.offset, balance=plan.balance)
        columns = zip(*(self.bins[name] for name in sorted(self.bins)), strict=True)
        z, is_slip, weights = map(torch.cat, columns)
        if plan.balance == "weights":
            counts = torch.bincount(is_slip.long(), minlength=2).clamp(min=1)
            weights = weights * (len(z) / (2 * counts.double()))[is_slip.long()]
        return fit_machine(TrainingBins(z, is_slip, weights), plan.penalty, plan.kernel)


def solve_metadata(head: Head) -> dict[str, Any]:
    """How a machine was solved for, JSON-able: method, condition, error (``SolveReport``)."""
    return {} if head.solved is None else head.solved.metadata()


def _is_kept(recording: str, is_slip: Tensor, fractions: Sequence[float]) -> Tensor:
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
