"""Detectors that nothing else beats in latency, compute time and accuracy: search, timing, fit.

For each alignment of the filter, over groups of channels and of components, features are ranked in
several ways; heads of several sizes and degrees are scored by closed-form validation, a material
left out at a time, on a bounded sample of training bins. Ranking and scaling saw that material.
Beside them, features pooled over channels, all or the best of them, validated by
``training.selection``: everything is learned without the material left out. These scores choose, so
that of the one chosen is a little too good. Costs are modelled (``analysis.latency``) until the few
that are left are timed, fitted and evaluated.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from tactslip_torch.analysis.latency import (
    CostModel,
    Latency,
    Limits,
    Timing,
    look_ahead_samples,
    measure_costs,
    parts_of,
    single_bins,
    time_calls,
    time_detector,
)
from tactslip_torch.analysis.raw_bins import bins_inside
from tactslip_torch.data.splits import Split
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.cache import cache_key
from tactslip_torch.features.groups import Channels, Components, allowed, of_fingers
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.plan import make_plan
from tactslip_torch.features.pool import Arithmetic, FeaturePool
from tactslip_torch.features.pooling import STATISTICS
from tactslip_torch.features.ranking import rank_per_cost, rank_weighted
from tactslip_torch.features.selection import rank_distinct, rank_features, t_scores
from tactslip_torch.features.survey import Survey
from tactslip_torch.graph.bins import bin_graph
from tactslip_torch.graph.form import Form
from tactslip_torch.graph.runs import session_of
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.runtime import Ticker, bar, check_number, in_parts, one_thread
from tactslip_torch.signals.filtering import Align, ChannelFilter
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule
from tactslip_torch.training.fitting import TrainingPass, solve_metadata
from tactslip_torch.training.recipe import (
    FeatureSelection,
    Recipe,
    balanced_accuracy,
    sample_weight,
    scaled_selection,
)
from tactslip_torch.training.selection import (
    Structure,
    choose_model,
    fitted_selection,
    plan_detector,
    validate,
)

_MODEL_ERRS = (1.5, 1.0, 1 / 1.5)  # modelled compute over what will be measured
_FEW_NUMBERS = 20
_LESS_ACCURATE = 0.01
_LESS_COMPUTE = 1 / 3


class Candidate(NamedTuple):
    """A detector that might be made.

    Attributes:
        align: of the filter.
        channels: which channels features may be of, in words.
        components: which components and descriptors.
        columns: what the machine takes: ``"channel"`` features, or statistics over channels, such
            as ``"pooled mean, std"``.
        ranking: how they were ranked; ``"none"`` if all are taken.
        degree: of the head.
        penalty: its C, the best of those tried.
        selection: which features are read, and how its numbers are made of them, best first.
        balanced_accuracy: on held-out groups, mean over them. A little too good: it chose. Of
            pooled columns everything is learned without the held-out group; ranking and scaling of
            channel features saw it too, and only the machine is refitted.
        by_group: of each held-out group.
        latency: worst case with the shortest hop, compute modelled until timed.
    """

    align: Align
    channels: str
    components: str
    columns: str
    ranking: str
    degree: int
    penalty: float
    selection: FeatureSelection
    balanced_accuracy: float
    by_group: Mapping[str, float | None]
    latency: Latency

    @property
    def point(self) -> tuple[float, float, float]:
        """What is traded, smaller is better: latency, compute, errors."""
        return self.latency.worst_ms, self.latency.compute_us, -self.balanced_accuracy

    @property
    def selected(self) -> tuple[int, ...]:
        """Pool indices of the features that are read."""
        return self.selection.selected

    @property
    def detector(self) -> tuple[Align, int, float, frozenset[int | FeatureName]]:
        """What its detector is made of, however its features were found."""
        layer = self.selection.pooling
        columns = self.selected if layer is None else layer.names
        return self.align, self.degree, self.penalty, frozenset(columns)


def distinct(candidates: Iterable[Candidate]) -> list[Candidate]:
    """One candidate a detector, the first: two groups of features may have the same best ones."""
    first: dict[object, Candidate] = {}
    for each in candidates:
        first.setdefault(each.detector, each)
    return list(first.values())


def nondominated(points: Sequence[Sequence[float]]) -> list[int]:
    """Places of the points that no other beats, smaller being better; of equal ones the first.

    Example:
        >>> nondominated([(1, 5), (2, 2), (3, 2), (4, 1), (2, 2)])
        [0, 1, 3]
    """
    kept: list[int] = []
    order = sorted(range(len(points)), key=lambda index: (tuple(points[index]), index))
    for index in order:
        own = points[index]
        if not any(all(a <= b for a, b in zip(points[k], own, strict=True)) for k in kept):
            kept.append(index)
    return sorted(kept)


def landmarks(timed: Sequence[Timed]) -> dict[str, Timed | None]:
    """The detectors that a user asks for first; of several equally accurate ones the quickest.

    Returns:
        ``"most_accurate"``; ``"cheap"``, at most 1 point worse, with at most a third of its
        compute as a graph; ``"few"``, of at most 20 numbers. ``None`` where there is none.
    """

    def best(some: Iterable[Timed]) -> Timed | None:
        return min(some, key=lambda each: (-each.accuracy, each.graph_us), default=None)

    if (top := best(timed)) is None:
        return dict.fromkeys(("most_accurate", "cheap", "few"))
    most, least = _LESS_COMPUTE * top.graph_us, top.accuracy - _LESS_ACCURATE
    cheap = (each for each in timed if each.graph_us <= most and each.accuracy >= least)
    few = (each for each in timed if each.candidate.selection.size <= _FEW_NUMBERS)
    return {"most_accurate": top, "cheap": best(cheap), "few": best(few)}


def worth_naming(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that may be ``landmarks``: the best of few numbers, and of each group.

    What compute a graph takes is not modelled; it depends on the descriptors first.
    """
    best: dict[object, Candidate] = {}
    for each in candidates:
        groups: list[object] = [(each.columns == "channel", each.components)]
        if each.selection.size <= _FEW_NUMBERS:
            groups.append(_FEW_NUMBERS)
        for group in groups:
            other = best.setdefault(group, each)
            if each.balanced_accuracy > other.balanced_accuracy:
                best[group] = each
    return list(best.values())


def worth_timing(candidates: Sequence[Candidate], most: int, limits: Limits) -> list[Candidate]:
    """The candidates on the modelled front, then those that would be without them, and so on.

    A model errs, so what is close to the front is timed as well. Of a layer that is too large:
    the most accurate; up to half of the room, in order of accuracy, those that keep the limits
    though modelled 1.5 times too slow, as modelled, or modelled 1.5 times too quick, in turn; and
    of the rest those that are spread by compute, from the cheapest to the dearest.
    """
    chosen: list[Candidate] = []
    left = list(candidates)
    while left and len(chosen) < most:
        places = nondominated([each.point for each in left])
        layer = [left[place] for place in places]
        room = most - len(chosen)
        chosen += layer if len(layer) <= room else _thinned(layer, room, limits)
        left = [each for place, each in enumerate(left) if place not in set(places)]
    return chosen


def _thinned(layer: Sequence[Candidate], room: int, limits: Limits) -> list[Candidate]:
    """So many of a layer: the most accurate, those close to the limits, and a spread."""
    best_first = sorted(layer, key=lambda each: (-each.balanced_accuracy, each.point))
    taken = best_first[:1]
    near = [[each for each in best_first if _keeps(each, limits, factor)] for factor in _MODEL_ERRS]
    for number in range(len(layer)):
        for some in near:
            if number < len(some) and some[number] not in taken and len(taken) < (room + 1) // 2:
                taken.append(some[number])
    rest = sorted((each for each in layer if each not in taken), key=lambda each: each.point[1])
    room -= len(taken)
    steps = max(room - 1, 1)
    return taken + [rest[number * (len(rest) - 1) // steps] for number in range(room)]


def _keeps(candidate: Candidate, limits: Limits, factor: float) -> bool:
    """Whether it keeps the limits if its compute is modelled so many times too long."""
    compute_us = candidate.latency.compute_us / factor
    return not limits.misses(limits.latency(candidate.latency, compute_us))


Ranking = Literal["t", "ccweighting", "per_cost"]
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
            with degree 1 alone (``training.selection.candidates``).

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

    def candidates(self) -> list[Candidate]:
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
        return [each for scored in self._all(jobs) for each in scored]

    def without_fingers(self, best: Candidate) -> list[Candidate]:
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
            trials = self._all(jobs)
            tops = [max((each.balanced_accuracy for each in own), default=-1.0) for own in trials]
            if max(tops) < 0:  # too few features are left for any size
                break
            dropped.append(others[tops.index(max(tops))])
            found += [each for own in trials for each in own]
        return found

    def _all(self, jobs: Sequence[Callable[[], list[Candidate]]]) -> list[list[Candidate]]:
        """What each job finds, in their order; every job is done by one thread."""
        with Ticker("search, groups", "step", len(jobs)) as ticker:

            def work(job: Callable[[], list[Candidate]]) -> list[Candidate]:
                found = job()
                ticker.tick()
                return found

            return in_parts(work, jobs)

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
        weights = sample_weight(self.recipe, sample)
        selection = scaled_selection(self.recipe, survey, order)
        bins = TrainingBins(selection(sample.features), sample.is_slip, weights)
        found = []
        for degree, size in itertools.product(degrees, sizes):
            kernel = Polynomial(degree, _offset_of(self.recipe))
            choices = [(size, kernel, penalty) for penalty in self.search.penalties]
            rows = validate(bins, sample.group, sample.group_names, choices)
            best = max(rows, key=lambda row: float(row["mean"]))
            said = align, channels, components, "channel", ranking
            found.append(self._candidate(*said, best, selection.first(size)))
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
            offsets=_offset_of(self.recipe),
            penalties=tuple(self.search.penalties),
        )
        sample = self._samples[align]
        rows = choose_model(recipe, self.pool, sample, mask, is_nested=False).rows
        everything = Structure("pooled", len(self.pool.names) * len(STATISTICS), Polynomial(1))
        selection = fitted_selection(recipe, self.pool, sample, everything, mask)  # ranked
        found = []
        for (size, _), own in itertools.groupby(
            rows, lambda row: (row["num_features"], row["kernel"]["degree"])
        ):
            alike = list(own)
            least = max(row["mean"] for row in alike) - recipe.tolerance
            best = min(
                (row for row in alike if row["mean"] >= least), key=lambda row: row["penalty"]
            )
            first = selection if size is None else selection.first(min(size, selection.size))
            columns, ranking = f"pooled {', '.join(statistics)}", "none" if size is None else "gd"
            said = align, channels, components, columns, ranking
            found.append(self._candidate(*said, best, first))
        return found

    def _candidate(
        self,
        align: Align,
        channels: str,
        components: str,
        columns: str,
        ranking: str,
        chosen: Mapping[str, Any],
        selection: FeatureSelection,
    ) -> Candidate:
        """The candidate of a row of validation, its latency modelled."""
        selected = selection.selected
        parts = set().union(*(self._needed[index] for index in selected))
        num_pooled = 0 if selection.pooling is None else len(selected)
        used = {self._channel_of[index] for index in selected}
        rate = self.pool.sample_rate_hz / 1000
        latency = Latency(
            look_ahead_ms=look_ahead_samples(self.filters[align], used) / rate,
            bin_ms=self.pool.bin_samples / rate,
            hop_ms=self.search.hops_ms[0],
            compute_us=self.costs.compute_us(parts, selection.size, num_pooled),
        )
        return Candidate(
            align=align,
            channels=channels,
            components=components,
            columns=columns,
            ranking=ranking,
            degree=chosen["kernel"]["degree"],
            penalty=chosen["penalty"],
            selection=selection,
            balanced_accuracy=chosen["mean"],
            by_group=chosen["balanced_accuracy"],
            latency=latency.with_shortest_hop(self.search.hops_ms),
        )

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


def _offset_of(recipe: Recipe) -> float:
    """The polynomial's c: the first of the recipe's."""
    offsets = recipe.offsets
    return float(offsets[0] if isinstance(offsets, Sequence) else offsets)


@dataclass(frozen=True)
class Timed:
    """A candidate by the clock.

    Args:
        candidate: what it is.
        arithmetic: of its pool.
        timing: of a call with one raw bin.
        latency: with the shortest hop that compute at p99 fits into.
        graph_us: median of its ONNX graph in onnxruntime, of samples in float32; of the pool in
            float64.
    """

    candidate: Candidate
    arithmetic: Arithmetic
    timing: Timing
    latency: Latency
    graph_us: float

    @property
    def accuracy(self) -> float:
        """Balanced accuracy in validation."""
        return self.candidate.balanced_accuracy

    @property
    def point(self) -> tuple[float, float, float]:
        """What is traded, smaller is better: latency, compute, errors."""
        return self.latency.worst_ms, self.timing.p99_us, -self.accuracy


class Workshop:
    """Makes, times and evaluates detectors of candidates.

    Args:
        makers: of features, by alignment of the filter; one source, pool and backend.
        fold: who is trained on.
        search: what is searched.
        recipe: how features are scaled and classes balanced.
        most_summed: features up to which a quadratic head is fitted to all training bins.
        num_workers: processes that make features.

    Raises:
        ValueError: if the recipe restricts its features, as the search does in its own way.

    Attributes:
        surveys: of the training recordings, by alignment, once ``look`` has been called.
    """

    def __init__(
        self,
        makers: Mapping[Align, FeatureMaker],
        fold: Split,
        search: Search,
        recipe: Recipe,
        most_summed: int = 120,
        num_workers: int | None = None,
    ) -> None:
        if recipe.feature_filter is not None:
            raise ValueError(
                "recipe.feature_filter is not for a search; use search.channels and "
                "search.components"
            )
        self.makers, self.fold, self.search = makers, fold, search
        self.recipe = replace(recipe, sample_bins=search.bins)
        self.most_summed = most_summed
        self.surveys: dict[Align, Survey] = {}
        self._data = {
            align: SlipDataModule(maker, fold, num_workers) for align, maker in makers.items()
        }

    @property
    def pool(self) -> FeaturePool:
        """What features there are."""
        return next(iter(self.makers.values())).pool

    def look(self) -> None:
        """One pass over the training recordings for each alignment."""
        for align, data in self._data.items():
            survey = Survey(len(self.pool.names), self.search.bins)
            with one_thread():  # the processors belong to those who make features
                for batch in bar(data.loader(["train"]), f"features, {align}", "recording"):
                    mask, group = batch.roles["train"], self.recipe.group(batch.recording)
                    name = str(batch.recording)
                    survey.update(name, group, batch.features[mask], batch.is_slip[mask])
            self.surveys[align] = survey

    def costs(self) -> CostModel:
        """Of groups of features, on this machine."""
        maker = next(iter(self.makers.values()))
        sizes = [size for size in self.search.sizes if size <= len(self.pool.names)]
        calls = max(self.search.calls // 4, 10)
        return measure_costs(
            self.pool,
            maker.channel_filter,
            sizes,
            maker.extractor.backend,
            max(self.search.statistics, key=len, default=()),
            calls=calls,
        )

    def timed(self, candidates: Sequence[Candidate]) -> list[Timed]:
        """Detectors of the candidates, fitted to the sample, in every arithmetic, by the clock."""
        found = []
        for candidate in bar(candidates, "timing the front", "detector"):
            graph_us = _time_graph(self.make(candidate, "double"), self.search.calls).p50_us
            for arithmetic in self.search.arithmetics:
                with one_thread():
                    timing = time_detector(self.make(candidate, arithmetic), self.search.calls)
                latency = replace(candidate.latency, compute_us=timing.p99_us)
                latency = latency.with_shortest_hop(self.search.hops_ms)
                found.append(Timed(candidate, arithmetic, timing, latency, graph_us))
        return found

    def make(
        self, candidate: Candidate, arithmetic: Arithmetic, *, from_all: bool = False
    ) -> SlipDetector:
        """The detector of a candidate, fitted to the sample or to all training bins."""
        survey, data = self.surveys[candidate.align], self._data[candidate.align]
        recipe = replace(
            self.recipe,
            num_features=candidate.selection.size,
            kernel="polynomial",
            degree=candidate.degree,
            offsets=_offset_of(self.recipe),
            penalties=candidate.penalty,
        )
        plan = plan_detector(recipe, survey, self.pool, candidate.selection)
        is_bounded = candidate.degree == 2 and plan.selection.size > self.most_summed
        if from_all and not is_bounded:
            gathered = TrainingPass(plan)
            with one_thread():
                for batch in bar(data.loader(["train"]), "the machine, all bins", "recording"):
                    mask, name = batch.roles["train"], str(batch.recording)
                    gathered.update(name, batch.features[mask], batch.is_slip[mask])
            head, bins = gathered.solve(), "all training bins"
        else:
            training = plan.training_bins(survey.sample.bins())
            head = fit_machine(training, plan.penalty, plan.kernel)
            bins = f"{self.search.bins} training bins of each material and class"
        trained, source = self.fold.having("train"), data.maker.source
        info = plan.metadata | {
            "fitted_to": bins,
            "solve": solve_metadata(head),
            "simulated": source.is_simulated,
            "split": self.fold.name,
            "features_dtype": "float32" if arithmetic == "native" else "float64",
            "train_materials": sorted({recording.material for recording in trained}),
            "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
        }
        pool = FeaturePool(self.pool.hand, **self.pool.facts() | {"arithmetic": arithmetic})
        backend = data.maker.extractor.backend
        return plan.detector(pool, data.maker.channel_filter, head, info, backend)

    def evaluated(self, detector: SlipDetector) -> dict[str, Any]:
        """Balanced accuracy on raw bins of the test cycles, scored as a live loop would."""
        maker = self.makers[detector.channel_filter.align]
        says, truth = [], []
        for recording in bar(self.fold.having("test"), "the chosen one, test", "recording"):
            bins, inside = bins_inside(maker, self.fold, recording, "test")
            raw = maker.raw_bins(recording, inside)
            with torch.inference_mode():
                says.append(detector.predict_raw(raw.float()).score >= 0)
            truth.append(bins.is_slip[inside])
        is_slip = torch.cat(truth)
        return {
            "balanced_accuracy": balanced_accuracy(torch.cat(says), is_slip),
            "num_bins": len(is_slip),
        }


def _time_graph(detector: SlipDetector, calls: int) -> Timing:
    """Time the ONNX graph of a detector in onnxruntime, one ordinary bin and one thread."""
    session = session_of(bin_graph(detector, Form()).model({}))
    samples = next(each for each in session.get_inputs() if each.name == "samples")
    bins = single_bins(detector.pool, samples.shape[-1])

    def call(given: Tensor) -> object:
        return session.run(None, {"samples": given.numpy()})

    return time_calls(call, bins, calls)
