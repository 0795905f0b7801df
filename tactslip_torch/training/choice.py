"""Nested validation: the choice of features, degree and penalty by groups that are left out.

A candidate is a structure (features of channels, pooled ones, or both; all or the best K; a kernel)
and a penalty C. In each fold everything that is learned, compression constants, ranking and scaling
included, is learned without the group that is left out. Of the candidates within a tolerance of the
best, the simplest machine with the strongest penalty is taken. The choice itself is evaluated by
leaving out two groups: for each group the same choice is made without it, and that machine is
evaluated on it. Many groups are joined, so that there are few to leave out.

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
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.features.sensing import Sensing, SpanFeatures
from tactslip_torch.model.calibration import fit_platt
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import for_each, one_thread, steps, trim_memory
from tactslip_torch.training.bins import SampledBins

log = logging.getLogger(__name__)

TRAINING_BINS = 100
"""Bins of each stratum that a validation fold is fitted to, at most, so that machines with more
columns than bins can be solved; it is scored on all sampled ones. Where every candidate is of
pooled features at degree 1, all sampled bins are taken."""
MOST_TRAINING_BINS = 2000
"""Of all strata together: many kinds of scenes have fewer bins each."""
MOST_EXTENSIONS = 3
"""Decades by which a grid of penalties that ends at its edge is extended, at either end."""
TAIL = 0.01
"""Part of the training bins beyond the scaled range on either side; they are clipped."""
_SCALED_BINS = 256  # at a time, which fits the cache of a processor


@dataclass(frozen=True)
class FeatureSelection:
    """Which features, and how they are scaled.

    Args:
        selected: indices of the features that are read, best first.
        scaler: of the columns.
        pooling: from those features to the columns; ``None``: they are the columns.
        silence: what tells which channels are silent, and what is known of them; they are left out
            of their pools. ``None``: none is.
    """

    selected: tuple[int, ...]
    scaler: FeatureScaler
    pooling: ChannelPooling | None = None
    silence: tuple[SpanFeatures, Sensing] | None = None

    @property
    def size(self) -> int:
        """Number of columns, K."""
        return len(self.scaler.minimum)

    def __call__(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """Scaled columns in float64, ``[N, F] -> [N, K]``, without channels ``[N, C]`` or with."""
        columns = features[:, list(self.selected)].double()
        if self.pooling is not None:
            if self.silence is not None:
                spans, sensing = self.silence
                silent = spans.is_silent(spans(features), sensing)
                is_lost = silent if is_lost is None else silent | is_lost
            columns = self.pooling(columns, is_lost)
        scaled: Tensor = self.scaler(columns)
        return scaled


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
    """Outcome of a nested validation.

    Args:
        structure: that was chosen.
        penalty: that was chosen.
        rows: one for each candidate, JSON-able: ``use``, ``num_features``, ``kernel``, ``penalty``,
            ``mean``, ``balanced_accuracy`` by group and ``worst``, the group with the least; of
            the one that is chosen also ``chosen`` and ``calibration``.
        nested: balanced accuracy of the whole procedure on each group that it did not see, and
            their mean; ``None`` with fewer than three groups.
    """

    structure: Structure
    penalty: float
    rows: list[dict[str, Any]] = field(default_factory=list)
    nested: dict[str, Any] | None = None


def choose_model(
    bins: CandidateBins,
    structures: Sequence[Structure],
    penalties: Sequence[float],
    tolerance: float,
    *,
    is_nested: bool = True,
    show: bool = False,
) -> Choice:
    """Choose a structure and a penalty.

    Args:
        bins: sampled training bins, of which two groups or more have both classes.
        structures: to choose from, the simplest first.
        penalties: to choose from, ascending.
        tolerance: of balanced accuracy, within which a simpler candidate is as good.
        is_nested: whether to evaluate the choice itself by leaving out two groups.
        show: a progress bar.
    """
    groups = bins.whole_groups()
    if not all(each.use == "pooled" and each.kernel.degree == 1 for each in structures):
        bins = bins.thinned()
    folds = [frozenset([group]) for group in groups]
    if is_nested := is_nested and len(groups) > 2:
        folds += [frozenset(pair) for pair in itertools.combinations(groups, 2)]
    table = _Table(bins)
    with steps("validation, groups left out", "step", len(folds), show=show) as shown:

        def leave_out(fold: frozenset[int]) -> None:
            table.leave_out(fold, structures, penalties)
            trim_memory()  # of what the fold has left, in each thread
            shown.update()

        for_each(leave_out, folds)
    if len(penalties) > 1:
        table.extend(groups, tolerance)
    accuracy = table.accuracies(groups)
    chosen = _best(accuracy, tolerance)
    order = sorted(accuracy[groups[0]], key=lambda key: (structures.index(key[0]), key[1]))
    rows = [table.row(key, accuracy) for key in order]
    rows[order.index(chosen)] |= {"chosen": True, "calibration": table.calibration(chosen, groups)}
    nested = None
    if is_nested:
        by_name = {}
        for group in groups:
            inner = table.accuracies([other for other in groups if other != group], group)
            by_name[bins.group_names[group]] = accuracy[group][_best(inner, tolerance)]
        nested = {"mean": sum(by_name.values()) / len(by_name), "balanced_accuracy": by_name}
    return Choice(*chosen, rows, nested)


class CandidateBins:
    """Sampled bins of the features that may be used, many groups of them joined.

    Args:
        sample: the bins.
        weights: of each of them, ``[n]``.
        pool: of the features.
        allowed: which features may be used, ``[F]``, bool.
        pooling: statistics over channels, as ``ChannelPooling.fit`` takes them.
    """

    def __init__(
        self,
        sample: SampledBins,
        weights: Tensor,
        pool: FeaturePool,
        allowed: Tensor,
        pooling: str | Sequence[str] | None = None,
    ) -> None:
        self.sample, self.weights, self.pooling = sample.joined(), weights, pooling
        self.is_slip, self.groups = sample.is_slip, self.sample.group
        self.group_names = self.sample.group_names
        self.hand = pool.hand
        self.span_features = SpanFeatures(pool.hand, pool.names, pool.bin_samples)
        self.spans = self.span_features(sample.features)
        places = allowed.nonzero()[:, 0]
        self.places = places.tolist()
        self.names = [pool.names[place] for place in self.places]
        self.features = sample.features[:, places]
        self.is_kept = torch.ones_like(sample.is_slip)

    def whole_groups(self) -> list[int]:
        """The groups with bins of both classes, of which validation needs two."""
        numbers = range(len(self.group_names))
        return [g for g in numbers if has_both_classes(self.is_slip[self.groups == g])]

    def thinned(self) -> CandidateBins:
        """The same, to be fitted to fewer bins of each stratum; those that stay weigh more."""
        strata = self.sample.stratum.unique().tolist()
        most = min(TRAINING_BINS, max(MOST_TRAINING_BINS // len(strata), 10))
        is_kept, weights = torch.zeros_like(self.is_kept), self.weights.clone()
        for one in strata:
            rows = (self.sample.stratum == one).nonzero()[:, 0]
            # bins are sorted by recording; spread those that are kept over all of them
            kept = torch.linspace(0, len(rows) - 1, min(len(rows), most)).round().long()
            is_kept[rows[kept]] = True
            weights[rows] *= len(rows) / len(kept)
        thinned = object.__new__(CandidateBins)
        thinned.__dict__.update(self.__dict__, is_kept=is_kept, weights=weights)
        return thinned

    @one_thread()
    def select(self, structure: Structure) -> FeatureSelection:
        """Compression, ranking and scaling of a structure, learned from all of these bins."""
        everything = torch.ones_like(self.is_slip)
        columns = _Columns(self, everything, everything, structure.parts)
        chosen = columns.places(structure)
        names = inputs = [columns.names[place] for place in chosen.tolist()]
        layer, silence = columns.pooling, None
        if layer is not None:
            if structure.use == "both":
                layer = layer.with_channels(self.names)
            layer = layer.select([layer.names.index(name) for name in names])
            inputs, silence = list(layer.inputs), (self.span_features, columns.sensing)
        index = dict(zip(self.names, self.places, strict=True))
        selected = tuple(index[name] for name in inputs)
        x = self.sample.features[:, list(selected)].double()
        x = x if layer is None else layer(x, columns.is_lost)
        scaler = FeatureScaler.fit(x, compress=True, tail=TAIL)
        return FeatureSelection(selected, scaler, layer, silence)


class _Columns:
    """Scaled columns of some sampled bins, learned from the training bins among them.

    Attributes:
        z: the columns of training bins, ``[n, K]``, those of channels before pooled ones.
        left_out: the columns of the others, ``[m, K]``.
        names: of the columns.
        pooling: that made the pooled ones.
        sensing: of the training bins, for pooled columns.
        is_lost: silent channels, ``[n + m, C]``, left out of the pools; training bins come first.
    """

    sensing: Sensing
    is_lost: Tensor

    def __init__(
        self, bins: CandidateBins, rows: Tensor, train: Tensor, parts: Sequence[str]
    ) -> None:
        rows = torch.cat([train.nonzero()[:, 0], (rows & ~train).nonzero()[:, 0]])
        num = int(train.sum())
        self._is_slip, self._groups = bins.is_slip[train], bins.groups[train]
        features, scaled = bins.features[rows], list[Tensor]()
        self.names, self.pooling = list[FeatureName](), None
        self._places, self._products = dict[str, Tensor](), dict[str, Tensor]()
        for part in sorted(parts):
            x, names = features, bins.names
            if part == "pooled":
                assert bins.pooling is not None  # General
                spans = bins.spans[rows]
                self.sensing = Sensing.fit(spans[:num], 1, 1)
                self.is_lost = bins.span_features.is_silent(spans, self.sensing)
                known, lost = features[:num], self.is_lost[:num]
                layer = ChannelPooling.fit(bins.hand, names, known, bins.pooling, lost)
                place = {name: index for index, name in enumerate(names)}
                inputs = [place[name] for name in layer.inputs]
                x, names = layer(features[:, inputs].double(), self.is_lost), list(layer.names)
                self.pooling = layer
            x = x.double()
            scaler = FeatureScaler.fit(x[:num], compress=True, tail=TAIL)
            for few in x.split(_SCALED_BINS):
                few.copy_(scaler(few))
            scaled.append(x)
            self._places[part] = torch.arange(len(names)) + len(self.names)
            self.names += names
        self.z, self.left_out = torch.cat(scaled, 1).tensor_split([num])

    def places(self, structure: Structure) -> Tensor:
        """Which columns a structure takes, best first; all in their order."""
        places = torch.cat([self._places[part] for part in structure.parts])
        if structure.num_features is None:
            return places
        order = self._scores[places].argsort(descending=True, stable=True)
        return places[order[: structure.num_features]]

    def taken(self, structure: Structure) -> tuple[Tensor, Tensor]:
        """The columns that a structure takes, of training bins and of the others."""
        places = self.places(structure)
        if structure.num_features is not None:
            return self.z[:, places], self.left_out[:, places]
        neighbours = slice(int(places[0]), int(places[-1]) + 1)  # nothing is copied
        return self.z[:, neighbours], self.left_out[:, neighbours]

    def products(self, structure: Structure) -> Tensor:
        """Inner products of the training bins, ``[n, n]``."""
        if structure.num_features is not None:
            z, _ = self.taken(structure)
            return z @ z.mT
        for part in structure.parts:
            if part not in self._products:
                z, _ = self.taken(structure._replace(use=part))
                self._products[part] = z @ z.mT
        first, *others = (self._products[part] for part in structure.parts)
        return sum(others, first)

    @cached_property
    def _scores(self) -> Tensor:
        return group_scores(self.z, self._is_slip, self._groups)


def group_scores(columns: Tensor, is_slip: Tensor, groups: Tensor) -> Tensor:
    """How well each feature separates the classes in every group, ``[F]``: larger is better.

    ``|mean effect| / sqrt(within-class variance + variance of the effect + of the level)``, the
    last two between groups: a feature whose threshold moves from material to material is worth
    less, which a t-test does not know. 0 for a constant feature. Groups of one class tell nothing;
    if all are, the bins are one group.

    Shape:
        - columns: ``[N, F]``; is_slip: ``[N]``, bool; groups: ``[N]``, whole numbers
    """
    effects, levels, spreads = [], [], []
    members = [groups == group for group in groups.unique().tolist()]
    whole = [mine for mine in members if has_both_classes(is_slip[mine])]
    for mine in whole or [torch.ones_like(is_slip)]:
        quiet, slip = columns[mine & ~is_slip], columns[mine & is_slip]
        effects.append(slip.mean(0) - quiet.mean(0))
        levels.append((slip.mean(0) + quiet.mean(0)) / 2)
        spreads.append((slip.var(0, correction=0) + quiet.var(0, correction=0)) / 2)
    effect, level = torch.stack(effects), torch.stack(levels)
    square = torch.stack(spreads).mean(0)
    if len(effects) > 1:
        square = square + effect.var(0) + level.var(0)
    return torch.where(square > 0, effect.mean(0).abs() / square.sqrt(), 0.0)


Accuracies = Mapping[int, Mapping[Candidate, float]]
"""Balanced accuracy by group and candidate."""


class _Table:
    """Scores of the bins of left-out groups, by the groups left out and by candidate."""

    def __init__(self, bins: CandidateBins) -> None:
        self.bins = bins
        self.scores: dict[frozenset[int], dict[int, dict[Candidate, Tensor]]] = {}

    def leave_out(
        self, fold: frozenset[int], structures: Sequence[Structure], penalties: Sequence[float]
    ) -> None:
        """Score each group of a fold by machines that saw no group of it."""
        bins = self.bins
        is_out = torch.isin(bins.groups, torch.tensor(sorted(fold)))
        train = bins.is_kept & ~is_out
        parts = sorted({part for structure in structures for part in structure.parts})
        columns = _Columns(bins, train | is_out, train, parts)
        targets = torch.where(bins.is_slip, 1.0, -1.0).double()[train]
        member = bins.groups[is_out]
        found = self.scores.setdefault(fold, {group: {} for group in fold})
        for structure in structures:
            by_penalty = _ridge_scores(columns, structure, targets, bins.weights[train], penalties)
            for penalty, scores in zip(penalties, by_penalty, strict=True):
                for group in fold:
                    found[group][structure, penalty] = scores[member == group]

    def extend(self, groups: Sequence[int], tolerance: float) -> None:
        """Extend a grid of penalties whose end was chosen, or is best, and log it."""
        added = list[str]()
        for is_low in (True, False):
            for _ in range(MOST_EXTENSIONS):
                accuracy = self.accuracies(groups)
                means = _means(accuracy)
                best = _best(accuracy, tolerance) if is_low else max(means, key=means.__getitem__)
                own = [penalty for structure, penalty in means if structure == best[0]]
                if best[1] != (min(own) if is_low else max(own)):
                    break
                beyond = best[1] / 10 if is_low else best[1] * 10
                each = partial(self.leave_out, structures=best[:1], penalties=[beyond])
                for_each(each, list(self.scores))
                added.append(f"{beyond:g}")
        if added:
            log.info("recipe.penalties ended at its edge and was extended by %s", ", ".join(added))

    def accuracies(self, groups: Sequence[int], *others: int) -> Accuracies:
        """Balanced accuracy on each group, by the machines without it and without the others."""
        table = {}
        for group in groups:
            is_slip = self.bins.is_slip[self.bins.groups == group]
            scores = self.scores[frozenset([group, *others])][group]
            table[group] = {key: _accuracy(own >= 0, is_slip) for key, own in scores.items()}
        return table

    def calibration(self, key: Candidate, groups: Sequence[int]) -> dict[str, Any] | None:
        """Platt's calibration of a candidate's held-out scores."""
        bins = self.bins
        scores = torch.cat([self.scores[frozenset([group])][group][key] for group in groups])
        places = torch.cat([(bins.groups == group).nonzero()[:, 0] for group in groups])
        return platt_or_none(scores, bins.is_slip[places], bins.weights[places])

    def row(self, key: Candidate, accuracies: Accuracies) -> dict[str, Any]:
        """A candidate and its scores, for files."""
        structure, penalty = key
        names = self.bins.group_names
        by_group = {names[group]: of[key] for group, of in accuracies.items()}
        worst = min(by_group, key=by_group.__getitem__)
        return {
            "use": structure.use,
            "num_features": structure.num_features,
            "kernel": structure.kernel.to_dict(),
            "penalty": penalty,
            "mean": sum(by_group.values()) / len(by_group),
            "balanced_accuracy": by_group,
            "worst": {"group": worst, "balanced_accuracy": by_group[worst]},
        }


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
    kernel, (z, left_out) = structure.kernel, columns.taken(structure)
    is_primal = kernel.degree == 1 and z.shape[1] < len(z)
    if is_primal:
        constant = math.sqrt(kernel.offset)
        z, left_out = (torch.nn.functional.pad(x, (0, 1), value=constant) for x in (z, left_out))
        system, right = z.mT @ (z * weights[:, None]), z.mT @ (weights * targets)
    else:
        system = (columns.products(structure) + kernel.offset) ** kernel.degree
        right = targets
    diagonal, ridge = system.diagonal().clone(), torch.ones(()) if is_primal else 1 / weights
    solved = []
    for penalty in penalties:
        system.diagonal().copy_(diagonal + ridge / penalty)
        factor, info = torch.linalg.cholesky_ex(system)
        if int(info):  # a weak penalty on columns that repeat each other
            found = torch.linalg.lstsq(system, right[:, None], driver="gelsd").solution
        else:
            found = torch.cholesky_solve(right[:, None], factor)
        solved.append(found)
    unknowns = torch.cat(solved, 1)
    if is_primal:
        return (left_out @ unknowns).mT
    if kernel.degree == 1:  # by the weights of the columns: fewer products than with every bin
        return (left_out @ (z.mT @ unknowns) + kernel.offset * unknowns.sum(0)).mT
    return ((left_out @ z.mT + kernel.offset) ** kernel.degree @ unknowns).mT


def _means(table: Accuracies) -> dict[Candidate, float]:
    first = next(iter(table.values()))
    return {key: sum(of[key] for of in table.values()) / len(table) for key in first}


def _best(table: Accuracies, tolerance: float) -> Candidate:
    """Of those within the tolerance: no selection, the lower degree, fewer features, least C."""
    means = _means(table)
    least = max(means.values()) - tolerance
    uses = ("pooled", "channel", "both")  # by their number, of the paper's hand

    def order(key: Candidate) -> tuple[bool, int, int, int, float]:
        (use, size, kernel), penalty = key
        return size is not None, kernel.degree, size or 0, uses.index(use), penalty

    return min((key for key, mean in means.items() if mean >= least), key=order)


def recalls(says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None) -> list[float]:
    """Recall of non-slip and of slip, of decisions and truths ``[N]``; absent classes left out."""
    is_right = says_slip == is_slip
    weights = torch.ones(len(is_slip), dtype=torch.float64) if weights is None else weights
    return [
        float(weights[mine & is_right].sum() / weights[mine].sum())
        for mine in (~is_slip, is_slip)
        if bool(mine.any())
    ]


def balanced_accuracy(
    says_slip: Tensor, is_slip: Tensor, weights: Tensor | None = None
) -> float | None:
    """Mean recall of both classes, of decisions and truths ``[N]``; ``None`` if one is absent."""
    found = recalls(says_slip, is_slip, weights)
    return sum(found) / 2 if len(found) == 2 else None


def _accuracy(says_slip: Tensor, is_slip: Tensor) -> float:
    found = balanced_accuracy(says_slip, is_slip)
    assert found is not None  # whole_groups
    return found


def has_both_classes(is_slip: Tensor) -> bool:
    """Whether bins ``[N]`` are of slip and of non-slip."""
    return bool(is_slip.any()) and not bool(is_slip.all())


def platt_or_none(scores: Tensor, is_slip: Tensor, weights: Tensor | None) -> dict[str, Any] | None:
    """Platt's calibration of held-out scores, JSON-able; ``None``, logged, if they are reversed."""
    try:
        return fit_platt(scores, is_slip, weights).to_dict()
    except ValueError as error:
        log.warning("scores are not calibrated: %s", error)
        return None
