"""The search for detectors that trade accuracy for time.

For each alignment of the filter, over groups of channels and of components, features are ranked in
several ways; heads of several sizes and degrees are scored by closed-form validation, a material
left out at a time, on a bounded sample of training bins. Ranking and scaling saw that material.
Beside them, features pooled over channels, all or the best of them, validated by
``model_selection``: everything is learned without the material left out. These scores choose, so
that of the one chosen is a little too good. Costs are modelled (``cost``).
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.deadline.cost import CostModel, parts_of
from tactslip_torch.deadline.front import Candidate
from tactslip_torch.deadline.latency import Latency, check_number, look_ahead_samples, shortest_hop
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.groups import Channels, Components, allowed, of_fingers
from tactslip_torch.features.plan import make_plan
from tactslip_torch.features.pool import Arithmetic, FeaturePool
from tactslip_torch.features.pooling import STATISTICS
from tactslip_torch.features.ranking import rank_per_cost, rank_weighted
from tactslip_torch.features.selection import rank_distinct, rank_features, t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.model.fit import TrainingBins
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.model_selection import Structure, choose_model, fitted_frame
from tactslip_torch.recipe import Frame, Recipe, fit_frame, stand_for
from tactslip_torch.signals.filtering import Align, ChannelFilter
from tactslip_torch.threads import for_each
from tactslip_torch.validation import validate

Ranking = Literal["t", "ccweighting", "per_cost"]
Watch = Callable[[Iterable[Any], str], Iterable[Any]]
_NAMES = {
    "channels": Channels,
    "components": Components,
    "pooled_components": Components,
    "rankings": Ranking,
    "aligns": Align,
    "arithmetics": Arithmetic,
}


@dataclass(frozen=True)
class Search:
    """What is searched, as in ``conf/search``.

    Args:
        sizes: numbers of features.
        channels: groups: ``"all"``, ``"films"``, ``"gauges"``.
        drop_fingers: leave out one finger after the other, from the best candidate on.
        components: groups: ``"all"``; ``"unsorted"``, without median, mode, iqr and entropy;
            ``"deep_spectra"``, spectra of levels 3 and on only; ``"time"``, no spectra;
            ``"steady"``, without mode, cv and entropy, which jump on the last digit;
            ``"moments"``, nor median and iqr, so that nothing is sorted; ``"time_moments"``, of
            those no spectra; ``"spreads"``, standard deviation and range without spectra.
        rankings: ``"t"``, as the recipe ranks; ``"ccweighting"``; ``"per_cost"``.
        degrees: of the head: 1 is linear, 2 quadratic.
        aligns: of the filter.
        arithmetics: of the pool: ``"double"``, or ``"native"``, statistics in float32.
        hops_ms: between bins.
        penalties: values of C.
        bins: of each material and class that are searched on.
        alpha: of ``rank_weighted``.
        cost_power: of ``rank_per_cost``.
        most_timed: candidates at most that are timed, beside those that may be named.
        calls: of each timing, in each of its runs.
        pooled_components: groups, as above, of what is pooled over channels.
        statistics: over channels, each a list of ``pooling.STATISTICS``; none: nothing is pooled.
        pooled_sizes: numbers of pooled columns; ``None`` takes all: of many training bins
            with degree 1 alone (``model_selection.candidates``).

    Raises:
        ValueError: for a name that is none, an empty list, or a number out of range.
    """

    sizes: Sequence[int]
    channels: Sequence[Channels]
    drop_fingers: bool
    components: Sequence[Components]
    rankings: Sequence[Ranking]
    degrees: Sequence[int]
    aligns: Sequence[Align]
    arithmetics: Sequence[Arithmetic]
    hops_ms: Sequence[float]
    penalties: Sequence[float]
    bins: int = 100
    alpha: float = 0.7
    cost_power: float = 0.5
    most_timed: int = 16
    calls: int = 400
    pooled_components: Sequence[Components] = ("moments",)
    statistics: Sequence[Sequence[str]] = ()
    pooled_sizes: Sequence[int | None] = (None,)

    def __post_init__(self) -> None:
        lists = (*_NAMES, "sizes", "degrees", "hops_ms", "penalties", "statistics", "pooled_sizes")
        for name in lists:
            given = getattr(self, name)
            if isinstance(given, str) or not isinstance(given, Sequence):
                raise ValueError(f"search.{name} must be a list in brackets, got {given!r}")
            if not given and name != "statistics":
                raise ValueError(f"search.{name} is empty, expected at least one value")
            known = get_args(_NAMES[name]) if name in _NAMES else given
            unknown = [value for value in given if value not in known]
            if unknown:
                raise ValueError(
                    f"search.{name}: unknown {unknown[0]!r}, expected some of {', '.join(known)}"
                )
        for name in ("sizes", "degrees", "hops_ms", "penalties"):
            for value in getattr(self, name):
                check_number(f"search.{name}", value, whole=name in ("sizes", "degrees"))
        for size in self.pooled_sizes:
            if size is not None:
                check_number("search.pooled_sizes", size, whole=True)
        for some in self.statistics:
            if isinstance(some, str) or not some or set(some) - set(STATISTICS):
                raise ValueError(
                    f"search.statistics must be lists of some of {', '.join(STATISTICS)}, such as "
                    f"[[mean, std]], got {list(self.statistics)}"
                )
        for name in ("bins", "most_timed", "calls"):
            check_number(f"search.{name}", getattr(self, name), whole=True)
        for name in ("alpha", "cost_power"):
            check_number(f"search.{name}", getattr(self, name), least=0)
        if self.alpha > 1:
            raise ValueError(f"search.alpha must be at most 1, got {self.alpha}")
        if max(self.degrees) > 2:
            raise ValueError(f"search.degrees must be of 1 and 2, got {list(self.degrees)}")
        if not isinstance(self.drop_fingers, bool):
            raise ValueError(f"search.drop_fingers must be true or false, got {self.drop_fingers}")

    def groups(self, pool: FeaturePool) -> list[tuple[str, str, Tensor]]:
        """Groups of channels and components that differ and are large enough, with their masks.

        Raises:
            ValueError: if there is none.
        """
        found = [
            group
            for group in self._masks(pool, self.components)
            if int(group[2].sum()) >= min(self.sizes)
        ]
        if not found:
            raise ValueError(
                "an empty selection: no group of this hand, search.channels="
                f"{list(self.channels)} by search.components={list(self.components)}, has "
                f"{min(self.sizes)} features, the least of search.sizes; add a group or a size"
            )
        return found

    def pooled_groups(self, pool: FeaturePool) -> list[tuple[str, str, Tensor]]:
        """Groups of channels and components that are pooled, with their masks."""
        return self._masks(pool, self.pooled_components) if self.statistics else []

    def _masks(
        self, pool: FeaturePool, groups: Sequence[Components]
    ) -> list[tuple[str, str, Tensor]]:
        """Those that differ and are not empty."""
        found: list[tuple[str, str, Tensor]] = []
        for channels, components in itertools.product(self.channels, groups):
            mask = allowed(pool.hand, pool.names, channels, components)
            is_new = not any(torch.equal(mask, other) for _, _, other in found)
            if is_new and bool(mask.any()):
                found.append((channels, components, mask))
        return found


class Searcher:
    """Scores candidates on surveys of the training recordings.

    Args:
        search: what is searched.
        recipe: how features are scaled, classes balanced, and ``"t"`` ranks.
        pool: what features there are.
        costs: of features on this machine.
        surveys: of the training recordings, by alignment of the filter.
        filters: by alignment.
    """

    def __init__(
        self,
        search: Search,
        recipe: Recipe,
        pool: FeaturePool,
        costs: CostModel,
        surveys: Mapping[Align, Survey],
        filters: Mapping[Align, ChannelFilter],
    ) -> None:
        self.search, self.recipe, self.pool, self.costs = search, recipe, pool, costs
        self.surveys, self.filters = surveys, filters
        self._samples = {align: survey.sample.bins() for align, survey in surveys.items()}
        self._needed = parts_of(make_plan(pool.hand, pool.level, pool.names))
        self._needs, self._prices = costs.bill(self._needed)
        self._channel_of = [pool.hand.names.index(name.channel) for name in pool.names]

    def candidates(self, watch: Watch) -> list[Candidate]:
        """All candidates, in an order that does not depend on the number of threads.

        Raises:
            ValueError: if training bins do not allow validation.
        """
        search, jobs = self.search, []
        for align in search.aligns:
            jobs += [
                partial(self._scored, align, *group, ranking, search.degrees)
                for group in search.groups(self.pool)
                for ranking in search.rankings
            ]
            jobs += [
                partial(self._pooled, align, *group, statistics)
                for group in search.pooled_groups(self.pool)
                for statistics in search.statistics
            ]
        return [each for scored in self._all(jobs, watch) for each in scored]

    def without_fingers(self, best: Candidate, watch: Watch) -> list[Candidate]:
        """Candidates like the best with one finger after the other left out, greedily."""
        hand = self.pool.hand
        found: list[Candidate] = []
        used = {self._channel_of[index] for index in best.selected}
        fingers = sorted({hand.channels[channel].finger for channel in used})
        kept = allowed(hand, self.pool.names, best.channels, best.components)
        dropped: list[str] = []
        while len(dropped) < len(fingers) - 1:
            others = sorted(set(fingers) - set(dropped))
            jobs = []
            for finger in others:
                mask = kept & ~of_fingers(hand, self.pool.names, [*dropped, finger])
                label = f"{best.channels} without {' and '.join([*dropped, finger])}"
                as_best = (best.components, mask, best.ranking, [best.degree])
                jobs.append(partial(self._scored, best.align, label, *as_best))
            trials = self._all(jobs, watch)
            tops = [max((each.balanced_accuracy for each in own), default=-1.0) for own in trials]
            if max(tops) < 0:  # too few features are left for any size
                break
            dropped.append(others[tops.index(max(tops))])
            found += [each for own in trials for each in own]
        return found

    def _all(
        self, jobs: Sequence[Callable[[], list[Candidate]]], watch: Watch
    ) -> list[list[Candidate]]:
        """What each job finds, in their order; every job is done by one thread."""
        found: list[list[Candidate]] = [[] for _ in jobs]
        ticking = threading.Lock()

        def work(number: int) -> None:
            found[number] = jobs[number]()
            with ticking:
                next(ticks)

        with closing(tick for tick in watch(range(len(jobs)), "search, groups")) as ticks:
            for_each(work, range(len(jobs)))
            for _ in ticks:  # shows that all is done
                pass
        return found

    def _scored(
        self,
        align: Align,
        channels: str,
        components: str,
        mask: Tensor,
        ranking: str,
        degrees: Sequence[int],
    ) -> list[Candidate]:
        """The candidates of one ranking: of each degree and size the best C."""
        places = mask.nonzero().flatten()
        sizes = [size for size in sorted(self.search.sizes) if size <= len(places)]
        if not sizes:
            return []
        sample, survey = self._samples[align], self.surveys[align]
        order = places[self._ranked(ranking, survey, sample, places, sizes[-1])].tolist()
        weights = stand_for(sample, self.recipe, survey.moments.count.tolist())
        frame = fit_frame(self.recipe, survey, order)
        bins = TrainingBins(frame(sample.features), sample.is_slip, weights)
        found = []
        for degree, size in itertools.product(degrees, sizes):
            kernel = Polynomial(degree, offset_of(self.recipe))
            choices = [(size, kernel, penalty) for penalty in self.search.penalties]
            rows = validate(bins, sample.group, sample.group_names, choices, _quietly)
            best = max(rows, key=lambda row: float(row["mean"]))
            found.append(
                Candidate(
                    align,
                    channels,
                    components,
                    "channel",
                    ranking,
                    degree,
                    best["penalty"],
                    frame.first(size),
                    best["mean"],
                    best["balanced_accuracy"],
                    self._latency(align, frame.first(size)),
                )
            )
        return found

    def _pooled(
        self,
        align: Align,
        channels: str,
        components: str,
        mask: Tensor,
        statistics: Sequence[str],
    ) -> list[Candidate]:
        """The candidates of a pooled group, by degree and size.

        Of the C within the recipe's tolerance of the best, the strongest penalty.
        """
        recipe = replace(
            self.recipe,
            validation="nested",
            use="pooled",
            pooling=tuple(statistics),
            kernel="polynomial",
            num_features=tuple(self.search.pooled_sizes),
            degree=tuple(self.search.degrees),
            offsets=offset_of(self.recipe),
            penalties=tuple(self.search.penalties),
        )
        sample, counts = self._samples[align], self.surveys[align].moments.count.tolist()
        rows = choose_model(
            recipe,
            self.pool,
            sample,
            stand_for(sample, recipe, counts),
            _quietly,
            num_bins=round(sum(counts)),
            allowed=mask,
            is_nested=False,
        ).rows
        everything = Structure("pooled", len(self.pool.names) * len(STATISTICS), Polynomial(1))
        frame = fitted_frame(recipe, self.pool, sample, everything, mask)  # ranked
        found = []
        for (size, _), own in itertools.groupby(
            rows, lambda row: (row["num_features"], row["kernel"]["degree"])
        ):
            alike = list(own)
            least = max(row["mean"] for row in alike) - recipe.tolerance
            best = min(
                (row for row in alike if row["mean"] >= least), key=lambda row: row["penalty"]
            )
            first = frame if size is None else frame.first(min(size, frame.size))
            found.append(
                Candidate(
                    align,
                    channels,
                    components,
                    f"pooled {', '.join(statistics)}",
                    "none" if size is None else "gd",
                    best["kernel"]["degree"],
                    best["penalty"],
                    first,
                    best["mean"],
                    best["balanced_accuracy"],
                    self._latency(align, first),
                )
            )
        return found

    def _ranked(
        self, ranking: str, survey: Survey, sample: SampledBins, places: Tensor, num: int
    ) -> Tensor:
        """The best of these features, as places among them."""
        scores = t_scores(survey.moments, self.recipe.score_variance)[places]
        if ranking == "per_cost":
            return rank_per_cost(
                scores, self._needs[places], self._prices, num, self.search.cost_power
            )
        features = sample.features[:, places]
        if ranking == "ccweighting":
            return rank_weighted(scores, features, num, self.search.alpha)
        if self.recipe.most_correlation < 1:
            most = self.recipe.most_correlation
            return rank_distinct(scores, features, sample.is_slip, num, most)
        return rank_features(scores, num)

    def _latency(self, align: Align, frame: Frame) -> Latency:
        selected = frame.selected
        parts = set().union(*(self._needed[index] for index in selected))
        num_pooled = 0 if frame.pooling is None else len(selected)
        compute_us = self.costs.compute_us(parts, frame.size, num_pooled)
        used = {self._channel_of[index] for index in selected}
        ahead = look_ahead_samples(self.filters[align], used)
        rate = self.pool.sample_rate_hz / 1000
        hops = self.search.hops_ms
        parts_ms = Latency(ahead / rate, self.pool.bin_samples / rate, hops[0], compute_us)
        return shortest_hop(parts_ms, hops)


def offset_of(recipe: Recipe) -> float:
    """The polynomial's c: the first of the recipe's."""
    offsets = recipe.offsets
    return float(offsets[0] if isinstance(offsets, Sequence) else offsets)


def _quietly(items: Iterable[Any], what: str) -> Iterable[Any]:
    return items
