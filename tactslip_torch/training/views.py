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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.selection import forward_selection
from tactslip_torch.model.kernels import PAPER_KERNEL, Polynomial, QuadraticForm, factors_of
from tactslip_torch.model.ridge import ClassSums, balanced_weights, class_targets, solve_dual
from tactslip_torch.runtime import one_thread, steps, trim_memory
from tactslip_torch.training.bins import even_places
from tactslip_torch.training.choice import platt_or_none
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
        held_out: score of each bin by the machine without its group, for each penalty,
            ``[P, N, R]``; NaN of a group that cannot be left out.
    """

    name: str
    selection: FeatureSelection
    center: Tensor
    gain: Tensor
    held_out: Tensor

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


@dataclass(frozen=True)
class ViewSettings:
    """How views are chosen; as ``recipe.General`` has them.

    Args:
        views: some of ``columns.VIEWS``.
        penalties: values of C, ascending: the strongest penalty first.
        tolerance: of balanced accuracy, within which a stronger penalty is as good.
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


def choose_views(
    bins: ViewBins,
    pool: FeaturePool,
    allowed: Mapping[str, Tensor],
    settings: ViewSettings,
    show: bool = False,
) -> Choice:
    """Fit the columns of views, choose their penalties, weigh them.

    Args:
        bins: of two classes or more.
        pool: of their features.
        allowed: which features each view may use, ``[F]``, bool.
        settings: how.
        show: a progress bar.
    """
    views, part = list[View](), THRESHOLDS[settings.threshold]
    with steps("validation, groups left out", "view", len(settings.views), show=show) as shown:
        for name in settings.views:
            views.append(_fit_view(name, bins, pool, allowed[name], settings))
            shown.update()
            trim_memory()
    penalties, labels = tuple(settings.penalties), bins.labels
    known = torch.stack([view.held_out.isfinite().all(-1).all(0) for view in views]).all(0)
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
    found = _decided(helds, labels, known, settings.tolerance)
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
            _row(view, index, penalty, weight, bins, known, penalty == penalties[chosen])
            for view, chosen, weight in zip(views, found.chosen, found.weights, strict=True)
            for index, penalty in enumerate(penalties)
        ),
        nested=_nested(helds, bins, known, settings.tolerance, part),
        calibration=calibration,
    )


@one_thread()
def _fit_view(
    name: str, bins: ViewBins, pool: FeaturePool, allowed: Tensor, settings: ViewSettings
) -> View:
    selection = view_columns(name, pool, allowed, bins.features, bins.weights, settings.pooling)
    z, num = selection.in_parts(bins.features), settings.num_features
    unknown = z.new_zeros(0)
    if num is not None and num < selection.size:
        rows = _Rows.of(View(name, selection, *_standard(name, z, bins.weights), unknown), bins, z)
        held_out = _left_out(rows, bins, settings.penalties, num)
        taken = rows.best(torch.ones_like(rows.labels, dtype=torch.bool), num)
        selection, z = selection.take(taken), z[:, taken]
        return View(name, selection, *_standard(name, z, bins.weights), held_out)
    view = View(name, selection, *_standard(name, z, bins.weights), unknown)
    return replace(view, held_out=_left_out(_Rows.of(view, bins, z), bins, settings.penalties))


def _standard(name: str, z: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Center and gain of scaled columns ``[N, S]``: a kernel whose mean diagonal is 1."""
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
    """

    name: str
    u: Tensor
    place: Tensor
    labels: Tensor
    groups: Tensor
    weights: Tensor
    num_bins: int

    @classmethod
    def of(cls, view: View, bins: ViewBins, z: Tensor, most: int = MOST_CHOICE_BINS) -> _Rows:
        """Of scaled columns ``[N, S]``; of degree 2 thinned to so many bins."""
        places, weights = bins.thinned(most if view.degree == 2 else len(z))
        u, num = (z[places] - view.center) * view.gain, len(places)
        if bins.is_lost is not None and view.name == "pooled":
            u = torch.cat([u, view.units(bins.features[places], bins.is_lost[places])])
            places, weights = places.repeat(2), weights.repeat(2) / 2
        labels, groups = bins.labels[places], bins.groups[places]
        return cls(view.name, u, places, labels, groups, weights, num)

    @property
    def kernel(self) -> Polynomial:
        """Of the standardised columns; the intercept is free, so degree 1 has no offset."""
        return kernel_of(self.name)

    def best(self, is_in: Tensor, num: int) -> list[int]:
        """Columns by forward selection from some of the rows."""
        labels, weights = self.labels[is_in], self.weights[is_in]
        num_classes = int(self.labels.max()) + 1
        balanced = balanced_weights(labels, weights, num_classes)
        u = self.u[is_in]
        u = u / u.std(0).clamp(min=_NO_SPREAD)
        return forward_selection(u, class_targets(num_classes)[labels], balanced, num)

    def take(self, columns: Sequence[int]) -> _Rows:
        """With some of the columns alone, of unit size again."""
        u = self.u[:, columns]
        share = self.weights / self.weights.sum()
        return replace(self, u=u * _unit(self.name, u - share @ u, share))

    def sums(self, mask: Tensor, num_classes: int) -> ClassSums:
        """Sums of some of the rows."""
        sums = ClassSums(num_classes, self.u.shape[1])
        sums.update(self.u[mask], self.labels[mask], self.weights[mask])
        return sums


def kernel_of(view: str) -> Polynomial:
    """The kernel of a view's standardised columns."""
    return PAPER_KERNEL if DEGREE[view] == 2 else Polynomial(1, 0.0)


def _left_out(
    rows: _Rows, bins: ViewBins, penalties: Sequence[float], num_features: int | None = None
) -> Tensor:
    """Held-out scores of all bins for each penalty, ``[P, N, R]``; NaN where there is none.

    With ``num_features`` columns are selected anew without each group.
    """
    targets, ridges = class_targets(bins.num_classes), [1 / penalty for penalty in penalties]
    held = rows.u.new_full((len(penalties), len(bins.labels), targets.shape[1]), torch.nan)
    groups = rows.groups.unique().tolist()
    is_dual = DEGREE[rows.name] == 2 or (num_features or rows.u.shape[1]) > len(rows.u)
    gram, sums = None, dict[int, ClassSums]()
    if num_features is None and is_dual:
        gram = rows.kernel(rows.u, rows.u)
    elif num_features is None:
        sums = {group: rows.sums(rows.groups == group, len(targets)) for group in groups}
        whole = ClassSums.added(list(sums.values()))
    for group in groups:
        is_in = rows.groups != group
        if len(rows.labels[is_in].unique()) < len(targets):
            continue
        own = rows if num_features is None else rows.take(rows.best(is_in, num_features))
        out = (~is_in[: rows.num_bins]).nonzero()[:, 0]
        across = own.u[out]
        if is_dual:
            u = own.u[is_in]
            inner = own.kernel(u, u) if gram is None else gram[is_in][:, is_in]
            solved = solve_dual(inner, own.labels[is_in], own.weights[is_in], ridges, targets)
            across = own.kernel(across, u)
        else:
            rest = whole.without(sums[group]) if sums else own.sums(is_in, len(targets))
            solved = rest.solve(ridges, targets)
        for index, each in enumerate(solved):
            held[index, rows.place[out]] = across @ each.weights + each.intercept
    return held


# What held-out scores decide ---------------------------------------------------------------------


def _decided(helds: Sequence[Tensor], labels: Tensor, known: Tensor, tolerance: float) -> Decision:
    """Penalties, weights and threshold by the held-out scores of the bins that are known."""
    indices, best = list[int](), list[float]()
    for held in helds:
        found = [_accuracy(scores[known], labels[known]) for scores in held]
        best.append(max(found))
        indices.append(next(i for i, each in enumerate(found) if each >= best[-1] - tolerance))

    def of(weights: Sequence[float]) -> Decision:
        return Decision(tuple(indices), tuple(best), tuple(weights), 0.0)

    kept = set(range(len(helds)))
    weights = _shares(best, kept)

    def accuracy(some: set[int]) -> float:
        return _accuracy(_mean_score(helds, of(_shares(best, some)))[known], labels[known])

    for view in sorted(kept, key=weights.__getitem__):
        if weights[view] >= LITTLE or accuracy(kept - {view}) < accuracy(kept) - NO_WORSE:
            break
        kept.remove(view)
        weights = _shares(best, kept)
    score = _mean_score(helds, of(weights))[known]
    shift = _best_shift(score[:, 0], labels[known]) if score.shape[1] == 1 else 0.0
    return of(weights)._replace(shift=shift)


def _shares(best: Sequence[float], kept: set[int]) -> list[float]:
    """Weights of views by their balanced accuracies; 0 of those that are not kept."""
    most = max(best[view] for view in kept)
    raw = [math.exp(SHARPNESS * (b - most)) if i in kept else 0.0 for i, b in enumerate(best)]
    return [each / sum(raw) for each in raw]


def _mean_score(helds: Sequence[Tensor], decision: Decision) -> Tensor:
    """Weighted mean of the views' held-out scores, ``[N, R]``."""
    parts = zip(helds, decision.chosen, decision.weights, strict=True)
    return torch.stack([held[index] * weight for held, index, weight in parts if weight]).sum(0)


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
    helds: Sequence[Tensor], bins: ViewBins, known: Tensor, tolerance: float, part: float
) -> dict[str, Any] | None:
    """Balanced accuracy on each group of what is decided without it.

    The machines of other groups have seen it, so this is a little too good.
    """
    by_name, labels = dict[str, float](), bins.labels
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
    known: Tensor,
    is_chosen: bool,
) -> dict[str, Any]:
    """A view at a penalty and its scores, for files."""
    held, labels = view.held_out[index], bins.labels
    by_group = {}
    for group, name in enumerate(bins.group_names):
        inside = (bins.groups == group) & known
        if len(labels[inside].unique()) == bins.num_classes:
            by_group[name] = _accuracy(held[inside], labels[inside])
    row = {
        "view": view.name,
        "num_features": view.selection.size,
        "kernel": kernel_of(view.name).to_dict(),
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
    """The machine of a view, one for each target, from bins in memory."""
    if view.degree == 2:
        return dual_parts(view, bins, penalty)
    rows = _Rows.of(view, bins, view.selection.in_parts(bins.features))
    every = torch.ones_like(rows.labels, dtype=torch.bool)
    return primal_parts(rows.sums(every, bins.num_classes), penalty)


def dual_parts(view: View, bins: ViewBins, penalty: float) -> list[Part]:
    """The machine of degree 2 of a view, one for each target, from bins in memory."""
    z, targets = view.selection.in_parts(bins.features), class_targets(bins.num_classes)
    rows = _Rows.of(view, bins, z, MOST_KERNEL_BINS)
    gram = rows.kernel(rows.u, rows.u)
    (found,) = solve_dual(gram, rows.labels, rows.weights, [1 / penalty], targets)
    parts = []
    for beta, constant in zip(found.weights.mT, found.intercept, strict=True):
        offset = rows.kernel.offset
        factors, signs = factors_of(rows.u, beta, most=MOST_FACTORS, tolerance=LEFT_OUT)
        linear = 2 * offset * (rows.u.mT @ beta)
        parts.append(Part(linear, constant + offset**2 * beta.sum(), factors, signs))
    return parts


def primal_parts(sums: ClassSums, penalty: float) -> list[Part]:
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
