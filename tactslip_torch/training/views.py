"""Three views of the same bins, a machine for each, and the mean of their scores.

Each view has columns of its own (``columns.py``), standardised so that its kernel has a mean
diagonal of 1, and a ridge machine with class weights and a free intercept: of degree 1 of simple
statistics and of pooled features, of degree 2 of the features of channels. Its penalty is chosen by
leaving out each group of training bins in turn, everything that labels decide fitted anew. The
score of a bin is the mean of the views' scores; a view that is right more often weighs more, and
one that does no good is dropped.

The form was found on two real sets and on the simulated hand, which are development data for it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.selection import ColumnCosts, forward_selection
from tactslip_torch.features.sensing import SpanFeatures
from tactslip_torch.model.calibration import platt_or_none
from tactslip_torch.model.kernels import (
    PAPER_KERNEL,
    Polynomial,
    QuadraticForm,
    coordinates_of,
    factors_of,
)
from tactslip_torch.model.ridge import ClassSums, balanced_weights, class_targets, solve_dual
from tactslip_torch.runtime import one_thread, steps, trim_memory
from tactslip_torch.training.bins import even_places
from tactslip_torch.training.columns import FeatureSelection, joined, view_columns

log = logging.getLogger(__name__)

DEGREE = {"simple": 1, "channel": 2, "pooled": 1}
SHARPNESS = 40.0
"""Of the weights of views, per unit of balanced accuracy."""
NO_WORSE, LITTLE = 0.001, 0.1
"""A view of less weight is dropped where balanced accuracy without it is at most so much lower."""
MOST_KERNEL_BINS, MOST_CHOICE_BINS = 4000, 2000
"""A machine of degree 2 is fitted to so many bins, drawn by group and class, and chosen by so
many."""
MOST_SUMMED = 2000
"""With more columns machines of degree 1 are chosen by the dual of the bins in memory: the products
of each group would take too much of it."""
MOST_FACTORS, LEFT_OUT = 32, 0.01
"""Of a quadratic part so many factors are kept at most: the fewest that leave out so small a part
of its spread."""
_NO_SPREAD = 1e-9
THRESHOLDS = {"zero": 0.0, "half": 0.5, "full": 1.0}
"""Part of the validated shift of the threshold that is applied."""


@dataclass(frozen=True)
class ViewBins:
    """Training bins that choices are made by, all in memory.

    Args:
        features: of the bins.
        labels: their class, whole numbers from 0.
        groups: that are left out as a whole, whole numbers.
        group_names: of the groups.
        weights: of the bins, before classes are balanced, of mean 1.
        stratum: group, class and kind of scene of each as one number.
        is_lost: channels that second copies of the bins are without; ``None``: no copies.

    Shape:
        - features: ``[N, F]``; labels, groups, weights, stratum: ``[N]``; is_lost: ``[N, C]``
    """

    features: Tensor
    labels: Tensor
    groups: Tensor
    group_names: tuple[str, ...]
    weights: Tensor
    stratum: Tensor
    is_lost: Tensor | None = None

    @cached_property
    def num_classes(self) -> int:
        """L, at least 2."""
        return max(int(self.labels.max()) + 1, 2)

    def thinned(self, most: int) -> tuple[Tensor, Tensor]:
        """Places of some of the bins and weights, as ``even_places`` has them."""
        return even_places(self.stratum, self.weights, most)


@dataclass(frozen=True)
class View:
    """A view: its standardised columns, ``u = (z - center) * gain``, and what validation says.

    Args:
        name: one of ``columns.VIEWS``.
        selection: of its scaled columns ``z``.
        center: ``[S]``.
        gain: ``[S]``.
        held_out: score of each bin, and of its second copy if it has one, by the machine without
            its group, for each penalty, ``[1 or 2, P, N, R]``; NaN where there is none.
        sums: of the columns of all training bins, for degree 1; ``None``: those in memory are all.
        costs: of its columns; ``None``: they cost alike.
    """

    name: str
    selection: FeatureSelection
    center: Tensor
    gain: Tensor
    held_out: Tensor
    sums: ClassSums | None = None
    costs: ColumnCosts | None = None

    @property
    def degree(self) -> int:
        """Of its kernel."""
        return DEGREE[self.name]

    def units(self, features: Tensor, is_lost: Tensor | None = None) -> Tensor:
        """Standardised columns ``[N, S]`` of features ``[N, F]``."""
        return (self.selection.in_parts(features, is_lost) - self.center) * self.gain


class Decision(NamedTuple):
    """What held-out scores decide.

    Attributes:
        chosen: index of the penalty of each view.
        best: balanced accuracy of each view at its best penalty.
        weights: of the views, which add up to 1; 0 of one that is dropped.
        shift: threshold of the mean score that is best.
    """

    chosen: tuple[int, ...]
    best: tuple[float, ...]
    weights: tuple[float, ...]
    shift: float


@dataclass(frozen=True)
class Choice:
    """Views, their penalties and weights, and what to expect of their mean.

    Args:
        views: all of them.
        penalties: C of each.
        weights: of each; 0 of one that is dropped.
        shift: that is taken from the mean score.
        accuracy: balanced, of held-out bins; NaN where no group can be left out.
        rows: one for each view and penalty, JSON-able.
        nested: balanced accuracy on each group of what the others decide, and their mean;
            ``None`` with fewer than three groups.
        calibration: Platt's, of held-out scores, one for each target; ``None`` where they tell
            nothing.
    """

    views: tuple[View, ...]
    penalties: tuple[float, ...]
    weights: tuple[float, ...]
    shift: float = 0.0
    accuracy: float = math.nan
    rows: tuple[dict[str, Any], ...] = ()
    nested: dict[str, Any] | None = None
    calibration: tuple[dict[str, Any] | None, ...] = ()

    @property
    def shares(self) -> dict[str, float]:
        """The weight of each view, by its name."""
        return dict(zip((view.name for view in self.views), self.weights, strict=True))

    @property
    def penalty(self) -> float:
        """C of the view that weighs most."""
        return self.penalties[max(range(len(self.views)), key=self.weights.__getitem__)]

    def parts(self, bins: ViewBins) -> dict[str, list[Part]]:
        """The machines of the views that are kept, one for each target."""
        penalties = zip(self.views, self.penalties, strict=True)
        return {v.name: parts_of(v, bins, c) for v, c in penalties if self.shares[v.name]}

    def told(self) -> Choice:
        """Without what is large and no longer needed."""
        none = torch.zeros(0)
        return replace(self, views=tuple(replace(v, held_out=none, sums=None) for v in self.views))


@dataclass(frozen=True)
class ViewSettings:
    """How views are chosen; as ``recipe.General`` has them.

    Args:
        views: some of ``columns.VIEWS``.
        penalties: values of C, ascending: the strongest penalty first.
        tolerance: a stronger penalty is as good where it makes at most this part more errors.
        threshold: one of ``THRESHOLDS``.
        num_features: columns of each view, by forward selection; ``None``: all.
        pooling: statistics over channels.
    """

    views: Sequence[str]
    penalties: Sequence[float]
    tolerance: float
    threshold: str
    num_features: int | None = None
    pooling: str | Sequence[str] | None = None


def base_views(
    bins: ViewBins,
    pool: FeaturePool,
    allowed: Mapping[str, Tensor],
    settings: ViewSettings,
    costs: Callable[[Sequence[FeatureName]], ColumnCosts] | None = None,
) -> list[View]:
    """Views with all of their columns, standardised, before anything is chosen.

    Args:
        bins: that columns are learned from.
        pool: of their features.
        allowed: which features each view may use, ``[F]``, bool.
        settings: which views.
        costs: gives those of columns by their names; ``None``: columns cost alike.
    """
    made, spans = list[View](), SpanFeatures(pool.hand, pool.names, pool.bin_samples)
    for name in settings.views:
        args = allowed[name], bins.features, bins.weights, settings.pooling
        selection = view_columns(name, pool.hand, pool.names, spans, *args)
        center, gain = _standard(name, selection.in_parts(bins.features), bins.weights)
        view = View(name, selection, center, gain, gain.new_zeros(0))
        if costs is not None:
            view = replace(view, costs=costs(selection.column_names))
        made.append(view)
    return made


def sums_by_group(view: View, bins: ViewBins) -> list[ClassSums]:
    """Sums of a view of degree 1 by group, to be added to; of too many columns all in one."""
    num = len(bins.group_names) if view.selection.size <= MOST_SUMMED else 1
    return [ClassSums(bins.num_classes, view.selection.size) for _ in range(num)]


def choose_views(
    bins: ViewBins,
    views: Sequence[View],
    settings: ViewSettings,
    sums: Mapping[str, Sequence[ClassSums]] | None = None,
    show: bool = False,
) -> Choice:
    """Choose columns and penalties of views, and weigh them.

    Args:
        bins: of two classes or more.
        views: as ``base_views`` makes them.
        settings: how.
        sums: of views of degree 1, of all training bins, as ``sums_by_group`` lays them out; by
            default of the bins in memory.
        show: a progress bar.
    """
    given, part = sums or {}, THRESHOLDS[settings.threshold]
    bases, views = views, list[View]()
    with steps("validation, groups left out", "view", len(bases), show=show) as shown:
        for base in bases:
            views.append(_validated(base, bins, settings, given.get(base.name)))
            shown.update()
            trim_memory()
    penalties, labels = tuple(settings.penalties), bins.labels
    every = torch.ones_like(labels, dtype=torch.bool)
    known = _known([view.held_out for view in views], every)
    if len(labels[known].unique()) < bins.num_classes:
        log.warning(
            "no recordings are left out to choose by: that needs two groups with every class, got "
            "%d of %s; C=%g is taken, and views weigh alike",
            len(bins.group_names),
            ", ".join(bins.group_names),
            middle := penalties[len(penalties) // 2],
        )
        return Choice(tuple(views), (middle,) * len(views), (1 / len(views),) * len(views))
    helds = [view.held_out for view in views]
    found = _decided(helds, labels, every, settings.tolerance)
    kept = [held for held, weight in zip(helds, found.weights, strict=True) if weight]
    known = _known(kept, every)
    score = _mean_score(helds, found)[known] - part * found.shift
    truths = class_targets(bins.num_classes)[labels[known]] > 0
    calibration = tuple(
        platt_or_none(one, truth, bins.weights[known])
        for one, truth in zip(score.mT, truths.mT, strict=True)
    )
    return Choice(
        views=tuple(views),
        penalties=tuple(penalties[index] for index in found.chosen),
        weights=found.weights,
        shift=part * found.shift,
        accuracy=_accuracy(score, labels[known]),
        rows=tuple(
            _row(view, index, penalty, weight, bins, penalty == penalties[chosen])
            for view, chosen, weight in zip(views, found.chosen, found.weights, strict=True)
            for index, penalty in enumerate(penalties)
        ),
        nested=_nested(helds, bins, settings.tolerance, part),
        calibration=calibration,
    )


@one_thread()
def _validated(
    view: View, bins: ViewBins, settings: ViewSettings, sums: Sequence[ClassSums] | None
) -> View:
    """A view with its held-out scores, and of its columns those that are selected."""
    num = settings.num_features
    if num is not None and num >= view.selection.size:
        num = None
    rows = _Rows.of(view, bins, view.selection.in_parts(bins.features))
    if sums is None and view.degree == 1 and view.selection.size <= MOST_SUMMED:
        groups = range(len(bins.group_names))
        sums = [rows.sums(rows.groups == group, bins.num_classes) for group in groups]
    held_out = _left_out(rows, bins, settings.penalties, num, sums)
    whole = None if sums is None else ClassSums.added(sums)
    if num is None:
        return replace(view, held_out=held_out, sums=whole)
    taken = rows.best(torch.ones_like(rows.labels, dtype=torch.bool), num)
    factor = rows.unit(taken)
    return View(
        view.name,
        view.selection.take(taken),
        view.center[taken],
        view.gain[taken] * factor,
        held_out,
        None if whole is None else whole.take(taken, factor),
    )


def _standard(name: str, z: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Center and gain of scaled columns ``[N, S]``: a kernel whose diagonal is 1 in the mean."""
    share = weights / weights.sum()
    center = share @ z
    spread = (share @ (z - center).square()).sqrt()
    gain = torch.where(spread > _NO_SPREAD, 1 / spread, 0.0)
    return center, gain * _unit(name, (z - center) * gain, share)


def _unit(name: str, u: Tensor, share: Tensor) -> Tensor:
    """By what to multiply columns; of degree 2 ``(u.u' + 1/2)^2`` is then 1 on the diagonal."""
    size = share @ u.square().sum(1) * (2 if DEGREE[name] == 2 else 1)
    return size.clamp(min=1e-300).rsqrt()


@dataclass(frozen=True)
class _Rows:
    """Standardised training rows of a view: bins, then second copies of them, if there are.

    Attributes:
        name: of the view.
        u: ``[n, S]``.
        place: which bin each row is; labels, groups, weights: of it; all ``[n]``.
        num_bins: rows before the copies.
        costs: of the columns.
    """

    name: str
    u: Tensor
    place: Tensor
    labels: Tensor
    groups: Tensor
    weights: Tensor
    num_bins: int
    costs: ColumnCosts | None

    @classmethod
    def of(cls, view: View, bins: ViewBins, z: Tensor, most: int = MOST_CHOICE_BINS) -> _Rows:
        """Of scaled columns ``[N, S]``; of degree 2 thinned to so many bins."""
        places, weights = bins.thinned(most if view.degree == 2 else len(z))
        u, num = (z[places] - view.center) * view.gain, len(places)
        if bins.is_lost is not None and view.name == "pooled":
            u = torch.cat([u, view.units(bins.features[places], bins.is_lost[places])])
            places, weights = places.repeat(2), weights.repeat(2) / 2
        labels, groups = bins.labels[places], bins.groups[places]
        return cls(view.name, u, places, labels, groups, weights, num, view.costs)

    @property
    def kernel(self) -> Polynomial:
        """Of the standardised columns; the intercept is free, so degree 1 has no offset."""
        return _kernel_of(self.name)

    def best(self, is_in: Tensor, num: int) -> list[int]:
        """Columns by forward selection from some of the rows."""
        labels, weights = self.labels[is_in], self.weights[is_in]
        num_classes = int(self.labels.max()) + 1
        balanced = balanced_weights(labels, weights, num_classes)
        u = self.u[is_in]
        u = u / u.std(0).clamp(min=_NO_SPREAD)
        targets = class_targets(num_classes)[labels]
        return forward_selection(u, targets, balanced, num, costs=self.costs)

    def unit(self, columns: Sequence[int]) -> Tensor:
        """By what some of the columns are multiplied to be of unit size."""
        u, share = self.u[:, columns], self.weights / self.weights.sum()
        return _unit(self.name, u - share @ u, share)

    def sums(self, mask: Tensor, num_classes: int) -> ClassSums:
        """Sums of some of the rows."""
        sums = ClassSums(num_classes, self.u.shape[1])
        sums.update(self.u[mask], self.labels[mask], self.weights[mask])
        return sums


def _kernel_of(view: str) -> Polynomial:
    """The kernel of a view's standardised columns."""
    return PAPER_KERNEL if DEGREE[view] == 2 else Polynomial(1, 0.0)


def _left_out(
    rows: _Rows,
    bins: ViewBins,
    penalties: Sequence[float],
    num_features: int | None,
    sums: Sequence[ClassSums] | None,
) -> Tensor:
    """Held-out scores for each penalty, ``[1 or 2, P, N, R]``: of bins, then of their copies.

    With ``num_features`` columns are selected anew without each group.
    """
    targets, ridges = class_targets(bins.num_classes), [1 / penalty for penalty in penalties]
    is_copy = torch.arange(len(rows.u)) >= rows.num_bins
    shape = 1 + int(is_copy.any()), len(penalties), len(bins.labels), targets.shape[1]
    held = rows.u.new_full(shape, torch.nan)
    groups = rows.groups.unique().tolist()
    is_dual = DEGREE[rows.name] == 2 or rows.u.shape[1] > MOST_SUMMED
    whole, gram = None, None
    if not is_dual and sums is not None:
        whole = ClassSums.added(sums)
    elif num_features is None:
        gram = rows.kernel(rows.u, rows.u)
    for group in groups:
        is_in = rows.groups != group
        if len(rows.labels[is_in].unique()) < len(targets):
            continue
        u, taken, factor = rows.u, None, torch.tensor(1.0)
        if num_features is not None:
            taken = rows.best(is_in, num_features)
            factor = rows.unit(taken)
            u = u[:, taken] * factor
        out = (~is_in).nonzero()[:, 0]
        across = u[out]
        if whole is not None and sums is not None:
            rest = whole.without(sums[group])
            solved = (rest if taken is None else rest.take(taken, factor)).solve(ridges, targets)
        else:
            inner = rows.kernel(u[is_in], u[is_in]) if gram is None else gram[is_in][:, is_in]
            solved = solve_dual(inner, rows.labels[is_in], rows.weights[is_in], ridges, targets)
            across = rows.kernel(across, u[is_in])
        for index, each in enumerate(solved):
            held[is_copy[out].long(), index, rows.place[out]] = (
                across @ each.weights + each.intercept
            )
    return held


# What held-out scores decide ---------------------------------------------------------------------


def _known(helds: Sequence[Tensor], rows: Tensor) -> Tensor:
    """Which of some bins have held-out scores of several views, ``[N]``, bool."""
    return torch.stack([rows, *(held[0].isfinite().all(-1).all(0) for held in helds)]).all(0)


def _decided(helds: Sequence[Tensor], labels: Tensor, rows: Tensor, tolerance: float) -> Decision:
    """Penalties, weights and threshold by the held-out scores of some bins.

    A penalty is chosen by bins and by their second copies, as it is trained on both; a view weighs
    by bins alone.
    """
    indices, best = list[int](), list[float]()
    for held in helds:
        own = _known([held], rows)
        each = torch.tensor([[_accuracy(s[own], labels[own]) for s in part] for part in held])
        mean = each.mean(0)
        least = mean.max() - tolerance * (1 - mean.max())
        indices.append(int((mean >= least).nonzero()[0]))
        best.append(float(each[0].max()))
    shared = _known(helds, rows)

    def of(weights: Sequence[float]) -> Decision:
        return Decision(tuple(indices), tuple(best), tuple(weights), 0.0)

    kept = set(range(len(helds)))
    weights = _shares(best, kept)

    def accuracy(some: set[int]) -> float:
        return _accuracy(_mean_score(helds, of(_shares(best, some)))[shared], labels[shared])

    for view in sorted(kept, key=weights.__getitem__):
        if weights[view] >= LITTLE or accuracy(kept - {view}) < accuracy(kept) - NO_WORSE:
            break
        kept.remove(view)
        weights = _shares(best, kept)
    shared = _known([held for held, weight in zip(helds, weights, strict=True) if weight], rows)
    score = _mean_score(helds, of(weights))[shared]
    shift = _best_shift(score[:, 0], labels[shared]) if score.shape[1] == 1 else 0.0
    return of(weights)._replace(shift=shift)


def _shares(best: Sequence[float], kept: set[int]) -> list[float]:
    """Weights of views by their balanced accuracies; 0 of those that are not kept."""
    most = max(best[view] for view in kept)
    raw = [math.exp(SHARPNESS * (b - most)) if i in kept else 0.0 for i, b in enumerate(best)]
    return [each / sum(raw) for each in raw]


def _mean_score(helds: Sequence[Tensor], decision: Decision) -> Tensor:
    """Weighted mean of the views' held-out scores, ``[N, R]``."""
    parts = zip(helds, decision.chosen, decision.weights, strict=True)
    return torch.stack([held[0, index] * weight for held, index, weight in parts if weight]).sum(0)


def _accuracy(scores: Tensor, labels: Tensor) -> float:
    """Mean recall of the classes there are, of scores ``[N, R]`` and labels ``[N]``."""
    says = (scores[:, 0] >= 0).long() if scores.shape[1] == 1 else scores.argmax(1)
    is_right = (says == labels).double()
    return float(torch.stack([is_right[labels == one].mean() for one in labels.unique()]).mean())


def _best_shift(scores: Tensor, labels: Tensor) -> float:
    """The threshold of the best balanced accuracy of scores ``[N]``; of equal ones next to 0."""
    order = scores.sort()
    is_slip = (labels[order.indices] == 1).double()
    zero = scores.new_zeros(1)
    missed = torch.cat([zero, is_slip.cumsum(0)]) / is_slip.sum()
    right = torch.cat([zero, (1 - is_slip).cumsum(0)]) / (1 - is_slip).sum()
    gain = right - missed  # of a threshold above the first so many scores
    edges = torch.cat([order.values[:1], order.values, order.values[-1:]])
    is_best = gain >= gain.max() - 1e-12
    middle = ((edges[:-1] + edges[1:]) / 2)[is_best]
    return float(middle[middle.abs().argmin()])


def _nested(
    helds: Sequence[Tensor], bins: ViewBins, tolerance: float, part: float
) -> dict[str, Any] | None:
    """Balanced accuracy on each group of what is decided without it.

    The machines of other groups have seen it, so this is a little too good.
    """
    by_name, labels = dict[str, float](), bins.labels
    known = _known(helds, torch.ones_like(labels, dtype=torch.bool))
    for group, name in enumerate(bins.group_names):
        inside = (bins.groups == group) & known
        others = known & ~inside
        is_whole = all(len(labels[m].unique()) == bins.num_classes for m in (inside, others))
        if len(bins.group_names) < 3 or not is_whole:
            continue
        found = _decided(helds, labels, others, tolerance)
        score = _mean_score(helds, found)[inside] - part * found.shift
        by_name[name] = _accuracy(score, labels[inside])
    if not by_name:
        return None
    return {"mean": sum(by_name.values()) / len(by_name), "balanced_accuracy": by_name}


def _row(
    view: View,
    index: int,
    penalty: float,
    weight: float,
    bins: ViewBins,
    is_chosen: bool,
) -> dict[str, Any]:
    """A view at a penalty and its scores, for files."""
    held, labels = view.held_out[0, index], bins.labels
    known = held.isfinite().all(-1)
    by_group = {}
    for group, name in enumerate(bins.group_names):
        inside = (bins.groups == group) & known
        if len(labels[inside].unique()) == bins.num_classes:
            by_group[name] = _accuracy(held[inside], labels[inside])
    row = {
        "view": view.name,
        "num_features": view.selection.size,
        "kernel": _kernel_of(view.name).to_dict(),
        "penalty": penalty,
        "mean": _accuracy(held[known], labels[known]),
        "balanced_accuracy": by_group,
        "weight": weight,
    }
    if by_group:
        worst = min(by_group, key=by_group.__getitem__)
        row["worst"] = {"group": worst, "balanced_accuracy": by_group[worst]}
    return row | ({"chosen": True} if is_chosen and weight else {})


# The machine -------------------------------------------------------------------------------------


class Part(NamedTuple):
    """The machine of a view on its standardised columns, for one target.

    Attributes:
        linear: ``[S]``.
        constant: scalar.
        factors: ``[r, S]``, of the quadratic part, ``r`` 0 where there is none.
        signs: ``[r]``.
    """

    linear: Tensor
    constant: Tensor
    factors: Tensor
    signs: Tensor


def parts_of(view: View, bins: ViewBins, penalty: float) -> list[Part]:
    """The machine of a view, one for each target: from its sums, else from bins in memory."""
    if view.sums is not None:
        return _primal_parts(view.sums, penalty)
    if view.degree == 2:
        return _dual_parts(view, bins, penalty)
    rows = _Rows.of(view, bins, view.selection.in_parts(bins.features))
    every = torch.ones_like(rows.labels, dtype=torch.bool)
    return _primal_parts(rows.sums(every, bins.num_classes), penalty)


def _dual_parts(view: View, bins: ViewBins, penalty: float) -> list[Part]:
    """The machine of degree 2 of a view, one for each target, from bins in memory."""
    z, targets = view.selection.in_parts(bins.features), class_targets(bins.num_classes)
    rows = _Rows.of(view, bins, z, MOST_KERNEL_BINS)
    gram = rows.kernel(rows.u, rows.u)
    (found,) = solve_dual(gram, rows.labels, rows.weights, [1 / penalty], targets)
    parts, offset = [], rows.kernel.offset
    coordinates, basis = coordinates_of(rows.u)  # once for all targets
    for beta, constant in zip(found.weights.mT, found.intercept, strict=True):
        factors, signs = factors_of(coordinates, beta, most=MOST_FACTORS, tolerance=LEFT_OUT)
        factors = factors if basis is None else factors @ basis
        linear = 2 * offset * (rows.u.mT @ beta)
        parts.append(Part(linear, constant + offset**2 * beta.sum(), factors, signs))
    return parts


def _primal_parts(sums: ClassSums, penalty: float) -> list[Part]:
    """The machine of degree 1 of a view, one for each target, from the sums of all bins."""
    (found,) = sums.solve([1 / penalty], class_targets(len(sums.weight)))
    none = found.weights.new_zeros(0, len(found.weights)), found.weights.new_zeros(0)
    columns = zip(found.weights.mT, found.intercept, strict=True)
    return [Part(linear, constant, *none) for linear, constant in columns]


def merged(
    choice: Choice, parts: Mapping[str, Sequence[Part]]
) -> tuple[FeatureSelection, list[QuadraticForm]]:
    """One selection and one head for each target, of all views that are kept.

    The columns of a quadratic part come first, as a head wants them.
    """
    kept = [view for view in choice.views if view.name in parts]
    kept.sort(key=lambda view: -view.degree)
    weight = {v.name: w for v, w in zip(choice.views, choice.weights, strict=True)}
    selection = joined([view.selection for view in kept])
    heads = []
    for target in range(len(next(iter(parts.values())))):
        linear, constant, factors = list[Tensor](), torch.tensor(-choice.shift).double(), None
        for view in kept:
            part, share = parts[view.name][target], weight[view.name]
            slope, level = part.linear * view.gain, part.constant
            if len(part.signs):
                rows = part.factors * view.gain
                away = rows @ view.center
                slope = slope - 2 * (part.signs * away) @ rows
                level = level + part.signs @ away.square()
                factors = rows * math.sqrt(share), part.signs
            linear.append(share * slope)
            constant = constant + share * (level - part.linear * view.gain @ view.center)
        none = constant.new_zeros(0, 0), None
        quadratic, signs = factors or none
        heads.append(QuadraticForm(quadratic, torch.cat(linear), constant, signs))
    return selection, heads
