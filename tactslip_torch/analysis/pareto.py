"""Detectors that nothing else beats in latency, compute time and accuracy: search, timing, fit.

For each alignment of the filter, over groups of channels and of components, features are ranked in
several ways; heads of several sizes and degrees are scored by closed-form validation, a material
left out at a time, on a bounded sample of training bins. Ranking and scaling saw that material.
Beside them, features pooled over channels, all or the best of them, validated by
``training.plan``: everything is learned without the material left out. These scores choose, so
that of the one chosen is a little too good. Costs are modelled (``analysis.latency``) until the few
that are left are timed, fitted and evaluated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.analysis.latency import (
    CostModel,
    Latency,
    Limits,
    Timing,
    detector_parts,
    measure_costs,
    parts_of,
    single_bins,
    time_calls,
    time_detector,
)
from tactslip_torch.analysis.old.bin_sample import SampledBins
from tactslip_torch.analysis.old.plan import (
    Structure,
    TrainingPass,
    choose_model,
    fitted_selection,
    plan_detector,
    solve_metadata,
    validate,
)
from tactslip_torch.analysis.old.recipe import (
    FeatureSelection,
    Recipe,
    balanced_accuracy,
    sample_weight,
    scaled_selection,
)
from tactslip_torch.analysis.old.statistics import TrainingStatistics
from tactslip_torch.analysis.raw_bins import bins_inside
from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import Split
from tactslip_torch.deploy.bins import bin_graph
from tactslip_torch.deploy.check import session_of
from tactslip_torch.features.bank import make_plan
from tactslip_torch.features.groups import Channels, Components, allowed, of_fingers
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import Arithmetic, FeaturePool
from tactslip_torch.features.pooling import STATISTICS
from tactslip_torch.features.selection import (
    rank_distinct,
    rank_per_cost,
    rank_weighted,
    t_scores,
)
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.runtime import bar, check_number, one_thread, steps, thread_map
from tactslip_torch.signals.filtering import Align
from tactslip_torch.training.datamodule import FeatureMaker, SlipDataModule, training_origin

_MODEL_ERRS = (1.5, 1.0, 1 / 1.5)  # modelled compute over what will be measured
_FEW_NUMBERS = 20
_LESS_ACCURATE = 0.01
_LESS_COMPUTE = 1 / 3
_UNTIMED = Timing(math.nan, math.nan, math.nan, 0)


class Group(NamedTuple):
    """Which features candidates may be of.

    Attributes:
        align: of the filter.
        channels: which channels, in words.
        components: which components and descriptors.
        mask: ``[F]``, bool, the features of the pool.
    """

    align: Align
    channels: str
    components: str
    mask: Tensor


@dataclass(frozen=True, eq=False)
class Candidate:
    """A detector that might be made.

    Args:
        group: which features it may be of.
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
        latency: worst case with the shortest hop that compute at p99 fits into; compute is
            modelled until timed.
        modelled_us: that compute.
        arithmetic: of its pool.
        timing: of a call with one raw bin, once timed.
        graph_us: median of its ONNX graph in onnxruntime, once timed, of samples in float32; of the
            pool in float64.
    """

    group: Group
    columns: str
    ranking: str
    degree: int
    penalty: float
    selection: FeatureSelection
    balanced_accuracy: float
    by_group: Mapping[str, float | None]
    latency: Latency
    modelled_us: float
    arithmetic: Arithmetic = "double"
    timing: Timing = _UNTIMED
    graph_us: float = math.nan

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
        return self.group.align, self.degree, self.penalty, frozenset(columns)


# Which candidates are worth more -----------------------------------------------------------------
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
    for index in sorted(range(len(points)), key=lambda index: (tuple(points[index]), index)):
        own = points[index]
        if not any(all(a <= b for a, b in zip(points[k], own, strict=True)) for k in kept):
            kept.append(index)
    return sorted(kept)


def landmarks(timed: Sequence[Candidate]) -> dict[str, Candidate | None]:
    """The detectors that a user asks for first; of several equally accurate ones the quickest.

    Returns:
        ``"most_accurate"``; ``"cheap"``, at most 1 point worse, with at most a third of its
        compute as a graph; ``"few"``, of at most 20 numbers. ``None`` where there is none.
    """
    best_first = sorted(timed, key=lambda each: (-each.balanced_accuracy, each.graph_us))
    top = next(iter(best_first), None)
    cheap = (
        each
        for each in best_first
        if top is not None
        and each.graph_us <= _LESS_COMPUTE * top.graph_us
        and each.balanced_accuracy >= top.balanced_accuracy - _LESS_ACCURATE
    )
    few = (each for each in best_first if each.selection.size <= _FEW_NUMBERS)
    return {"most_accurate": top, "cheap": next(cheap, None), "few": next(few, None)}


def worth_naming(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that may be ``landmarks``: the best of few numbers, and of each group.

    What compute a graph takes is not modelled; it depends on the descriptors first.
    """
    best: dict[object, Candidate] = {}
    for each in sorted(candidates, key=lambda each: -each.balanced_accuracy):
        best.setdefault((each.columns == "channel", each.group.components), each)
        if each.selection.size <= _FEW_NUMBERS:
            best.setdefault(_FEW_NUMBERS, each)
    return list(dict.fromkeys(best.values()))


def worth_timing(candidates: Sequence[Candidate], most: int, limits: Limits) -> list[Candidate]:
    """The candidates on the modelled front, then those that would be without them, and so on.

    A model errs, so what is close to the front is timed as well. Of a layer that is too large:
    the most accurate; up to half of that number, in order of accuracy, those that keep the limits
    though modelled 1.5 times too slow, as modelled, or modelled 1.5 times too quick, in turn; and
    of the rest those that are spread by compute, from the cheapest to the dearest.
    """
    chosen: list[Candidate] = []
    left = list(candidates)
    while left and (room := most - len(chosen)) > 0:
        places = set(nondominated([each.point for each in left]))
        layer = [left[place] for place in sorted(places)]
        chosen += layer if len(layer) <= room else _thinned(layer, room, limits)
        left = [each for place, each in enumerate(left) if place not in places]
    return chosen


def _thinned(layer: Sequence[Candidate], room: int, limits: Limits) -> list[Candidate]:
    """So many of a layer: the most accurate, those close to the limits, and a spread."""

    def keeps(each: Candidate, factor: float) -> bool:
        return not limits.misses(limits.latency(each.latency, each.latency.compute_us / factor))

    best_first = sorted(layer, key=lambda each: (-each.balanced_accuracy, each.point))
    near = [[each for each in best_first if keeps(each, factor)] for factor in _MODEL_ERRS]
    in_turn = [each for row in itertools.zip_longest(*near) for each in row if each is not None]
    taken = list(dict.fromkeys([best_first[0], *in_turn]))[: (room + 1) // 2]
    rest = sorted((each for each in layer if each not in taken), key=lambda each: each.point[1])
    room -= len(taken)
    steps = max(room - 1, 1)
    return taken + [rest[number * (len(rest) - 1) // steps] for number in range(room)]


# What is searched --------------------------------------------------------------------------------
Ranking = Literal["t", "ccweighting", "per_cost"]


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
            with degree 1 alone (``training.plan.candidates``).

    Raises:
        ValueError: for a name that is none, an empty list, or a number out of range.
    """

    sizes: Sequence[int]
    channels: Sequence[Channels]
    drop_fingers: bool
    components: Sequence[Components]
    rankings: Sequence[Ranking]
    degrees: Sequence[Literal[1, 2]]
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
        for name, hint in get_type_hints(type(self)).items():
            _check(f"search.{name}", getattr(self, name), hint, least=0)
        if self.alpha > 1:
            raise ValueError(f"search.alpha must be at most 1, got {self.alpha}")

    def groups(self, pool: FeaturePool, components: Sequence[str]) -> list[Group]:
        """Groups of channels and of components that differ and are not empty."""
        found: list[Group] = []
        for channels, some in itertools.product(self.channels, components):
            mask = allowed(pool.hand, pool.names, channels, some)
            is_new = not any(torch.equal(mask, other.mask) for other in found)
            if is_new and bool(mask.any()):
                found.append(Group(self.aligns[0], channels, some, mask))
        return [group._replace(align=align) for align in self.aligns for group in found]

    def channel_groups(self, pool: FeaturePool) -> list[Group]:
        """Groups of channel features that are large enough.

        Raises:
            ValueError: if there is none.
        """
        groups = self.groups(pool, self.components)
        if found := [group for group in groups if int(group.mask.sum()) >= min(self.sizes)]:
            return found
        raise ValueError(
            "an empty selection: no group of this hand, search.channels="
            f"{list(self.channels)} by search.components={list(self.components)}, has "
            f"{min(self.sizes)} features, the least of search.sizes; add a group or a size"
        )


def _check(name: str, value: Any, hint: Any, least: float | None = None) -> None:
    """Refuse what is not as annotated. Numbers in lists are positive, text is a statistic.

    A list of lists may be empty.
    """
    words = STATISTICS if hint is str else get_args(hint)
    if get_origin(hint) is Sequence:
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ValueError(f"{name} must be a list in brackets, got {value!r}")
        if not value and get_origin(words[0]) is not Sequence:
            raise ValueError(f"{name} is empty, expected at least one value")
        inner = f"each of {name}" if get_origin(words[0]) is Sequence else name
        for each in value:
            _check(inner, each, words[0])
    elif hint is str or get_origin(hint) is Literal:
        if type(value) is not type(words[0]) or value not in words:  # 2.0 and True are no degree
            known = ", ".join(map(str, words))
            raise ValueError(f"{name}: unknown {value!r}, expected some of {known}")
    elif type(None) in words:
        if value is not None:
            _check(name, value, words[0])
    elif hint is not bool:
        check_number(name, value, least=None if hint is int else least, whole=hint is int)


class ParetoSearch:
    """Scores candidates on training recordings; makes, times and evaluates their detectors.

    Args:
        makers: of features, by alignment of the filter; one source, pool and backend.
        fold: who is trained on.
        search: what is searched.
        recipe: how features are scaled, classes balanced, and ``"t"`` ranks.
        most_summed: features up to which a quadratic head is fitted to all training bins.
        num_workers: processes that make features.

    Raises:
        ValueError: if the recipe restricts its features, as the search does in its own way, or no
            group of features is large enough.

    Attributes:
        training_statistics: by alignment of the filter, once ``read`` has been called.
        costs: of groups of features on this machine, once ``read`` has been called.
    """

    costs: CostModel

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
        self._offset = float(np.ravel(recipe.offsets)[0])
        self.recipe = replace(recipe, sample_bins=search.bins, offsets=self._offset)
        self.most_summed = most_summed
        self.training_statistics: dict[Align, TrainingStatistics] = {}
        self._samples: dict[Align, SampledBins] = {}
        self._data = {
            align: SlipDataModule(maker, [fold], num_workers) for align, maker in makers.items()
        }
        first = next(iter(makers.values()))
        self.pool, self.source, self.backend = first.pool, first.source, first.extractor.backend
        self._needed = parts_of(make_plan(self.pool.hand, self.pool.level, self.pool.names))
        self._channel_of = [self.pool.hand.names.index(name.channel) for name in self.pool.names]
        search.channel_groups(self.pool)  # refuses an empty selection before any work

    def read(self) -> None:
        """One pass over the training recordings for each alignment; then measure costs."""
        for align in self._data:
            statistics = TrainingStatistics(len(self.pool.names), self.search.bins)
            for recording, features, is_slip in self._training(align, f"features, {align}"):
                group = self.recipe.group(recording)
                statistics.update(str(recording), group, features, is_slip)
            self.training_statistics[align] = statistics
            self._samples[align] = statistics.sample.bins()
        self.costs = measure_costs(
            self.pool,
            next(iter(self.makers.values())).channel_filter,
            [size for size in self.search.sizes if size <= len(self.pool.names)],
            self.backend,
            max(self.search.statistics, key=len, default=()),
            calls=max(self.search.calls // 4, 10),
        )
        self._bill = self.costs.bill(self._needed)

    def _training(self, align: Align, what: str) -> Iterator[tuple[RecordingId, Tensor, Tensor]]:
        """Features of the training bins of each recording, and whether they are slip."""
        with one_thread():  # the processors belong to those who make features
            self._data[align].setup()
            for batch in bar(self._data[align].features("train"), what, "recording"):
                mask = batch.roles["train"]
                yield batch.recording, batch.features[mask], batch.is_slip[mask]

    def candidates(self) -> list[Candidate]:
        """All candidates, in an order that does not depend on the number of threads.

        Raises:
            ValueError: if training bins do not allow validation.
        """
        search = self.search
        jobs = [
            partial(self._of_channels, group, ranking, search.degrees)
            for group in search.channel_groups(self.pool)
            for ranking in search.rankings
        ]
        if search.statistics:
            pooled = search.groups(self.pool, search.pooled_components)
            jobs += [
                partial(self._pooled, *job) for job in itertools.product(pooled, search.statistics)
            ]
        return list(itertools.chain(*self._all(jobs)))

    def without_fingers(self, best: Candidate) -> list[Candidate]:
        """Candidates like the best with one finger after the other left out, greedily."""
        hand, names, group = self.pool.hand, self.pool.names, best.group
        found: list[Candidate] = []
        left = sorted({hand.channels[self._channel_of[index]].finger for index in best.selected})
        mask = allowed(hand, names, group.channels, group.components)
        dropped: list[str] = []
        while len(left) > 1:
            jobs = []
            for finger in left:
                without = [*dropped, finger]
                fewer = group._replace(
                    channels=f"{group.channels} without {' and '.join(without)}",
                    mask=mask & ~of_fingers(hand, names, without),
                )
                jobs.append(partial(self._of_channels, fewer, best.ranking, [best.degree]))
            trials = self._all(jobs)
            tops = [max((each.balanced_accuracy for each in own), default=-1.0) for own in trials]
            if max(tops) < 0:  # too few features are left for any size
                break
            dropped.append(left.pop(tops.index(max(tops))))
            found += itertools.chain(*trials)
        return found

    def _all(self, jobs: Sequence[Callable[[], list[Candidate]]]) -> list[list[Candidate]]:
        """What each job finds, in their order; every job is done by one thread."""
        with steps("search, groups", "step", len(jobs)) as shown:

            def work(job: Callable[[], list[Candidate]]) -> list[Candidate]:
                found = job()
                shown.update()
                return found

            return thread_map(work, jobs)

    def _of_channels(self, group: Group, ranking: str, degrees: Sequence[int]) -> list[Candidate]:
        """The candidates of one ranking: of each degree and size the best C."""
        places = group.mask.nonzero().flatten()
        sizes = [size for size in sorted(self.search.sizes) if size <= len(places)]
        if not sizes:
            return []
        sample, statistics = self._samples[group.align], self.training_statistics[group.align]
        order = places[self._ranked(ranking, statistics, sample, places, sizes[-1])].tolist()
        selection = scaled_selection(self.recipe, statistics, order)
        weights = sample_weight(self.recipe, sample)
        bins = TrainingBins(selection(sample.features), sample.is_slip, weights)
        found = []
        for degree, size in itertools.product(degrees, sizes):
            kernel = Polynomial(degree, self._offset)
            choices = [(size, kernel, penalty) for penalty in self.search.penalties]
            rows = validate(bins, sample.group, sample.group_names, choices)
            best = max(rows, key=lambda row: float(row["mean"]))
            found.append(self._candidate(group, "channel", ranking, best, selection.first(size)))
        return found

    def _pooled(self, group: Group, statistics: Sequence[str]) -> list[Candidate]:
        """The candidates of a pooled group, by degree and size.

        Of the C within the recipe's tolerance of the best, the strongest penalty.
        """
        recipe = replace(
            self.recipe,
            validation="nested",
            use="pooled",
            pooling=tuple(statistics),
            num_features=tuple(self.search.pooled_sizes),
            degree=tuple(self.search.degrees),
            penalties=tuple(self.search.penalties),
        )
        sample, mask = self._samples[group.align], group.mask
        rows = choose_model(recipe, self.pool, sample, mask, is_nested=False).rows
        everything = Structure("pooled", len(self.pool.names) * len(STATISTICS), Polynomial(1))
        ranked = fitted_selection(recipe, self.pool, sample, everything, mask)
        by_head = itertools.groupby(
            rows, lambda row: (row["num_features"], row["kernel"]["degree"])
        )
        columns, found = f"pooled {', '.join(statistics)}", []
        for (size, _), own in by_head:
            strongest_first = sorted(own, key=lambda row: float(row["penalty"]))
            least = max(row["mean"] for row in strongest_first) - recipe.tolerance
            best = next(row for row in strongest_first if row["mean"] >= least)
            first = ranked if size is None else ranked.first(min(size, ranked.size))
            ranking = "none" if size is None else "gd"
            found.append(self._candidate(group, columns, ranking, best, first))
        return found

    def _candidate(
        self,
        group: Group,
        columns: str,
        ranking: str,
        chosen: Mapping[str, Any],
        selection: FeatureSelection,
    ) -> Candidate:
        """The candidate of a row of validation, its latency modelled."""
        selected = selection.selected
        num_pooled = None if selection.pooling is None else selection.size
        parts = detector_parts(self._needed, selected, num_pooled)
        reaches = self.makers[group.align].channel_filter.reaches
        rate = self.pool.sample_rate_hz / 1000
        latency = Latency(
            look_ahead_ms=max(reaches[self._channel_of[index]][1] for index in selected) / rate,
            bin_ms=self.pool.bin_samples / rate,
            hop_ms=self.search.hops_ms[0],
            compute_us=self.costs.compute_us(parts),
        )
        return Candidate(
            group=group,
            columns=columns,
            ranking=ranking,
            degree=chosen["kernel"]["degree"],
            penalty=chosen["penalty"],
            selection=selection,
            balanced_accuracy=chosen["mean"],
            by_group=chosen["balanced_accuracy"],
            latency=latency.with_shortest_hop(self.search.hops_ms),
            modelled_us=latency.compute_us,
        )

    def _ranked(
        self,
        ranking: str,
        statistics: TrainingStatistics,
        sample: SampledBins,
        places: Tensor,
        num: int,
    ) -> Tensor:
        """The best of these features, as places among them."""
        scores = t_scores(statistics.moments, self.recipe.score_variance)[places]
        if ranking == "per_cost":
            needs, prices = self._bill
            return rank_per_cost(scores, needs[places], prices, num, self.search.cost_power)
        features, most = sample.features[:, places], self.recipe.most_correlation
        if ranking == "ccweighting":
            return rank_weighted(scores, features, num, self.search.alpha)
        return rank_distinct(scores, features, sample.is_slip, num, most)

    def timed(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Detectors of the candidates, fitted to the sample, in every arithmetic, by the clock."""
        found, calls = [], self.search.calls
        for candidate in bar(candidates, "timing the front", "detector"):
            graph_us = _time_graph(self.make(candidate), calls).p50_us
            for arithmetic in self.search.arithmetics:
                each = replace(candidate, arithmetic=arithmetic, graph_us=graph_us)
                with one_thread():
                    timing = time_detector(self.make(each), calls)
                latency = replace(candidate.latency, compute_us=timing.p99_us)
                latency = latency.with_shortest_hop(self.search.hops_ms)
                found.append(replace(each, timing=timing, latency=latency))
        return found

    def make(self, candidate: Candidate, *, from_all: bool = False) -> SlipDetector:
        """The detector of a candidate, fitted to the sample or to all training bins."""
        align, size = candidate.group.align, candidate.selection.size
        statistics = self.training_statistics[align]
        recipe = replace(
            self.recipe, num_features=size, degree=candidate.degree, penalties=candidate.penalty
        )
        plan = plan_detector(recipe, statistics, self.pool, candidate.selection)
        if from_all and not (candidate.degree == 2 and size > self.most_summed):
            gathered = TrainingPass(plan)
            for recording, features, is_slip in self._training(align, "the machine, all bins"):
                gathered.update(str(recording), features, is_slip)
            head, bins = gathered.solve(), "all training bins"
        else:
            training = plan.training_bins(self._samples[align])
            head = fit_machine(training, plan.penalty, plan.kernel)
            bins = f"{self.search.bins} training bins of each material and class"
        info = plan.metadata | training_origin(self.source, self.fold)
        info |= {
            "fitted_to": bins,
            "solve": solve_metadata(head),
            "features_dtype": "float32" if candidate.arithmetic == "native" else "float64",
        }
        options = self.pool.config() | {"arithmetic": candidate.arithmetic}
        pool = FeaturePool(self.pool.hand, **options)
        channel_filter = self.makers[align].channel_filter
        return plan.detector(pool, channel_filter, head, info, self.backend)

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
    session = session_of(bin_graph(detector).model())
    samples = next(each for each in session.get_inputs() if each.name == "samples")
    bins = single_bins(detector.pool, samples.shape[-1])
    return time_calls(lambda given: session.run(None, {"samples": given.numpy()}), bins, calls)
