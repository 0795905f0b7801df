"""What features cost on this machine, group by group of work, shared parts counted once.

A feature needs parts: a film that is read, a branch that is formed, its spectrum, a sort, a
column. What a selection costs is the sum over the parts it needs, each counted once, and over the
groups of parts it needs at all: a group has a price of its own, for calls that happen once however
many rows there are. Pooling over channels has a price, and one more for each feature it reads.
Prices are fitted to timings of ``FeatureExtractor`` with one bin and one thread. The model prunes a
search; what is promised is timed as a whole (``timing``).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.deadline.timing import (
    Timing,
    one_thread,
    single_bins,
    time_calls,
    time_detector,
)
from tactslip_torch.features.extractor import EngineName, FeatureExtractor
from tactslip_torch.features.plan import ORDERED, Plan, make_plan
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling, pooled_names
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

GROUPS: Mapping[str, str] = {
    "gauges": "a gauge read and described",
    "films": "a film read",
    "branches": "a wavelet branch formed",
    "spectra": "a spectrum of a branch formed",
    "energies": "energies of all branches of a film",
    "moments": "mean, spread, shape and extremes of a row",
    "sorts": "a row sorted, for median, mode and iqr",
    "histograms": "entropy of a row",
    "correlations": "correlation of a branch with its film",
    "lines": "centroid and spread of a spectrum",
    "columns": "a column written",
}
"""Groups of work, and what one part of each is."""
_OF_ROW = {"gauge": "gauges", "time": "branches", "freq": "spectra"}
_OF_DESCRIPTOR = dict.fromkeys(ORDERED, "sorts") | {
    "entropy": "histograms",
    "correlation": "correlations",
    "spectral_centroid": "lines",
    "spectral_spread": "lines",
}
_SWEEPS = 3000

Part = tuple[str, tuple[object, ...]]  # a group, and which of it; none of it: the group as such


@dataclass(frozen=True)
class CostModel:
    """What a call with one bin costs, by what it needs.

    Args:
        base_us: of a call that does nothing.
        group_us: by group, once if any of its parts is needed.
        part_us: by group, of each of its parts.
        rest_us: what filter, scaling, head and checks add.
        rest_of_one_us: and more for each number that the machine takes.
        tail: p99 over p50, usually.
        error: median relative error on the timings it was fitted to.
        pooling_us: what pooling over channels adds.
        pooling_of_one_us: and more for each feature that is pooled.
    """

    base_us: float
    group_us: Mapping[str, float]
    part_us: Mapping[str, float]
    rest_us: float
    rest_of_one_us: float
    tail: float
    error: float
    pooling_us: float = 0.0
    pooling_of_one_us: float = 0.0

    def features_us(self, parts: set[Part]) -> float:
        """Median time of the features that need these parts."""
        return self.base_us + sum(self._price(part) for part in parts)

    def compute_us(self, parts: set[Part], num_columns: int, num_pooled: int = 0) -> float:
        """p99 of a whole call, from raw samples to the decision.

        Args:
            parts: that the features need.
            num_columns: numbers that the machine takes.
            num_pooled: features that they are pooled of; 0 if they are features themselves.
        """
        rest_us = self.rest_us + num_columns * self.rest_of_one_us
        if num_pooled:
            rest_us += self.pooling_us + num_pooled * self.pooling_of_one_us
        return self.tail * (self.features_us(parts) + rest_us)

    def bill(self, needed: Sequence[set[Part]]) -> tuple[Tensor, Tensor]:
        """What ``rank_per_cost`` takes: which parts each feature needs, and their prices.

        A column's price holds its share of the rest, and is never nothing.

        Shape:
            - first output: ``[F, P]``, bool
            - second output: ``[P]``, whole nanoseconds
        """
        parts = sorted(set().union(*needed), key=repr)
        place = {part: index for index, part in enumerate(parts)}
        needs = torch.zeros(len(needed), len(parts), dtype=torch.bool)
        for row, own in enumerate(needed):
            needs[row, [place[part] for part in own]] = True
        prices = [round(1000 * self._price(part)) for part in parts]
        for index, (group, which) in enumerate(parts):
            if group == "columns" and which:
                prices[index] += max(round(1000 * self.rest_of_one_us), 1)
        return needs, torch.tensor(prices)

    def facts(self) -> dict[str, Any]:
        """All prices, JSON-able."""
        return {
            "base_us": self.base_us,
            "groups": {
                name: {"group_us": self.group_us[name], "part_us": self.part_us[name], "part": what}
                for name, what in GROUPS.items()
            },
            "rest_us": self.rest_us,
            "rest_of_one_us": self.rest_of_one_us,
            "pooling_us": self.pooling_us,
            "pooling_of_one_us": self.pooling_of_one_us,
            "p99_over_p50": self.tail,
            "median_relative_error": self.error,
        }

    def _price(self, part: Part) -> float:
        group, which = part
        return self.part_us[group] if which else self.group_us[group]


def parts_of(plan: Plan) -> list[set[Part]]:
    """The parts that each column of a plan needs; those of several features are the union."""
    needed: list[set[Part]] = [{("columns", (place,))} for place in range(plan.num_features)]
    for wanted in plan.wanted:
        row = plan.rows[wanted.row]
        own = needed[wanted.place]
        own.add((_OF_ROW[row.kind], (row.channel, row.branch)))
        if row.kind != "gauge":
            own.add(("films", (row.channel,)))
        own.add((_OF_DESCRIPTOR.get(wanted.descriptor, "moments"), tuple(row)))
    for share in plan.shares:
        needed[share.place] |= {("films", (share.channel,)), ("energies", (share.channel,))}
    return [own | {(group, ()) for group, _ in own} for own in needed]


def measure_costs(
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    sizes: Sequence[int],
    engine: EngineName = "auto",
    statistics: Sequence[str] = (),
    *,
    calls: int = 100,
    watch: Callable[[Sequence[Any], str], Any] = lambda items, what: items,
) -> CostModel:
    """Fit the model to timings on this machine.

    Args:
        pool: what features there are.
        channel_filter: of the hand.
        sizes: numbers of features for which the rest is timed.
        engine: what computes features.
        statistics: over channels, whose pooling is timed; none: it is not.
        calls: of each selection, in each of three runs.
        watch: shows progress.
    """
    needed = parts_of(make_plan(pool.hand, pool.level, pool.names))
    bins = single_bins(pool, pool.bin_samples)
    timings, sizes = [], sorted(set(sizes))
    layers = list(_layers(pool, statistics)) if statistics else []
    designs = list(_designs(needed, sizes))
    with one_thread():
        for selected in watch(designs, "cost of feature groups"):
            extractor = FeatureExtractor(pool, selected, engine)
            timings.append(time_calls(extractor, bins, calls))

        def whole(selected: Sequence[int], layer: ChannelPooling | None = None) -> Timing:
            return time_detector(stand_in(pool, channel_filter, selected, engine, layer), calls)

        rest, tails, pooling = [], [], []
        for size in sizes:
            some = _spread(range(len(pool.names)), size)
            of_features = time_calls(FeatureExtractor(pool, some, engine), bins, calls)
            of_all = whole(some)
            tails.append(of_all.p99_us / of_all.p50_us)
            rest.append(of_all.p50_us - of_features.p50_us)
        rest_us, rest_of_one_us = _line(sizes, rest)
        for layer in layers:
            some = [pool.names.index(name) for name in layer.inputs]
            of_features = time_calls(FeatureExtractor(pool, some, engine), bins, calls)
            of_head_us = rest_us + len(layer.names) * rest_of_one_us
            pooling.append(whole(some, layer).p50_us - of_features.p50_us - of_head_us)
    lengths = [len(layer.inputs) for layer in layers]
    pooling_us, pooling_of_one_us = _line(lengths, pooling) if layers else (0.0, 0.0)
    taken = torch.tensor([timing.p50_us for timing in timings], dtype=torch.float64)
    counts = torch.stack([_counted(set().union(*(needed[i] for i in s))) for s in designs])
    prices = _nonnegative(counts / taken[:, None])
    names = list(GROUPS)
    return CostModel(
        base_us=float(prices[0]),
        group_us=dict(zip(names, prices[1 : 1 + len(names)].tolist(), strict=True)),
        part_us=dict(zip(names, prices[1 + len(names) :].tolist(), strict=True)),
        rest_us=rest_us,
        rest_of_one_us=rest_of_one_us,
        tail=median(tails),
        error=float(((counts @ prices) / taken - 1).abs().median()),
        pooling_us=pooling_us,
        pooling_of_one_us=pooling_of_one_us,
    )


def stand_in(
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    selected: Sequence[int],
    engine: EngineName = "auto",
    layer: ChannelPooling | None = None,
) -> SlipDetector:
    """A detector that nobody trained, which takes as long as one that somebody did."""
    num = len(selected) if layer is None else len(layer.names)
    generator = torch.Generator().manual_seed(num)
    bend = torch.randn(num, num, generator=generator, dtype=torch.float64)
    ends = torch.ones(num, dtype=torch.float64)
    head = QuadraticForm(bend + bend.T, bend[0].clone(), torch.tensor(0.5, dtype=torch.float64))
    scaler = FeatureScaler(-ends, ends, ends)
    return SlipDetector(pool, channel_filter, selected, scaler, head, pooling=layer, engine=engine)


def _layers(pool: FeaturePool, statistics: Sequence[str]) -> Iterator[ChannelPooling]:
    """Layers that nobody fitted, of few to many columns."""
    names = pooled_names(pool.hand, pool.names, statistics)
    kinds = len(pool.hand.kinds)
    for number in (8, 60, 240):
        some = [names[index] for index in _spread(range(len(names)), max(number, kinds))]
        families = {(n.channel, n.component, n.domain, n.descriptor) for n in some}
        used = {name.channel for name in some}
        zeros = torch.zeros(len(some)), torch.zeros(len(used))
        yield ChannelPooling(pool.hand, some, torch.ones(len(families)), *zeros)


def _designs(needed: Sequence[set[Part]], sizes: Sequence[int]) -> Iterator[list[int]]:
    """Selections that tell the groups apart: each group with one, some and all of its parts."""
    for group in GROUPS:
        first: dict[Part, int] = {}  # of each part of the group, the feature that needs fewest
        for index, own in enumerate(needed):
            for part in own:
                if part[0] == group and part[1]:
                    known = first.setdefault(part, index)
                    first[part] = min(known, index, key=lambda i: len(needed[i]))
        places = sorted(set(first.values()))
        for number in sorted({1, 4, 16, min(len(places), 80)}):
            if 0 < number <= len(places):
                yield _spread(places, number)
    generator = torch.Generator().manual_seed(0)
    for size in sizes:
        for _ in range(3):
            order = torch.randperm(len(needed), generator=generator)
            yield order[:size].sort().values.tolist()


def _spread(places: Sequence[int], number: int) -> list[int]:
    """So many of the places, evenly."""
    return [places[index * len(places) // number] for index in range(min(number, len(places)))]


def _counted(parts: set[Part]) -> Tensor:
    """How many of each group there are, behind a 1 for the call and 0 or 1 for each group."""
    counts = [1.0]
    counts += [float((group, ()) in parts) for group in GROUPS]
    counts += [float(sum(p[0] == group and p[1] != () for p in parts)) for group in GROUPS]
    return torch.tensor(counts, dtype=torch.float64)


def _line(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Height at 0 and slope, neither negative: medians, which one bad timing does not move.

    Reference:
        Sen (1968), Journal of the American Statistical Association 63, 1379-1389.
    """
    points = list(zip(x, y, strict=True))
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.combinations(points, 2)]
    slope = max(median(slopes), 0.0) if slopes else 0.0
    return max(median(height - slope * place for place, height in points), 0.0), slope


def _nonnegative(rows: Tensor) -> Tensor:
    """The x, none negative, with ``rows @ x`` closest to 1: least squares by coordinates."""
    gram, pull = rows.T @ rows, rows.sum(0)
    x = torch.zeros_like(pull)
    for _ in range(_SWEEPS):
        for i in range(len(x)):
            if gram[i, i] > 0:
                x[i] = (x[i] + (pull[i] - gram[i] @ x) / gram[i, i]).clamp(min=0)
    return x
