"""The latency of a detector: waiting, which is exact, and computing, which is measured here.

*Waiting* is plain arithmetic of samples. The worst case is that of an onset just behind the start
of a bin. That bin is not wholly in slip, so the next one decides, a hop later: hop + bin +
look-ahead of the filter + compute. The four are kept apart everywhere, for what one robot may
ignore (the look-ahead of a film, 2.5 ms) another may not. Bins that straddle the onset often say
slip earlier; nothing here counts on it.

*Computing* is timed with one bin and one thread, as a live loop calls it, from raw samples to the
decision. Calls in which the system gave the processor to someone else (an involuntary context
switch, where the system counts them) are left out, and their fraction is reported, as is the p99 of
all calls with them: what they took says how busy the machine was, and a robot keeps a processor for
its loop. The bins are ordinary ones: one with a NaN goes another way, which takes longer.

*A cost model* prunes searches. A detector needs parts: a film that is read, a branch that is
formed, its spectrum, a sort, a number that the machine takes. It costs the sum over the parts it
needs, each counted once, and a price for each group of which it needs any part, for calls that
happen once however many rows there are. Prices are fitted to timings of whole detectors with one
bin and one thread; what is stated of a detector is timed by itself.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from statistics import median, median_high
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from tactslip_torch.features.bank import Plan, make_plan
from tactslip_torch.features.descriptors import ORDERED
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling, pooled_names
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import QuadraticForm
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import bar, check_number, one_thread
from tactslip_torch.signals.filtering import ChannelFilter

DEFINITION = (
    "worst case, from the onset of slip to the decision of the first bin that lies wholly in slip: "
    "look-ahead of the filter for the channels in use + bin + hop (the onset falls just behind a "
    "bin's start) + compute (p99 of a call with one bin, one thread, on a processor of its own)"
)


@dataclass(frozen=True)
class Latency:
    """What the time from onset to decision is made of.

    Args:
        look_ahead_ms: samples behind the bin that the filter waits for.
        bin_ms: until a bin is full.
        hop_ms: between bins; a decision every so often, so compute must be shorter.
        compute_us: from the last sample to the decision.

    Raises:
        ValueError: if a part is negative, or bin or hop is nothing.

    Example:
        >>> Latency(2.5, 50.0, 5.0, 300.0).worst_ms
        57.8
    """

    look_ahead_ms: float
    bin_ms: float
    hop_ms: float
    compute_us: float

    def __post_init__(self) -> None:
        for name in ("bin_ms", "hop_ms"):
            check_number(name, getattr(self, name))
        for name in ("look_ahead_ms", "compute_us"):
            check_number(name, getattr(self, name), least=0)

    @property
    def samples_ms(self) -> float:
        """The part that no faster computer shortens: look-ahead, bin and hop."""
        return self.look_ahead_ms + self.bin_ms + self.hop_ms

    @property
    def worst_ms(self) -> float:
        """From onset to decision, at worst."""
        return self.samples_ms + self.compute_us / 1000

    @property
    def load(self) -> float:
        """Fraction of one processor that computing takes."""
        return self.compute_us / 1000 / self.hop_ms

    def to_dict(self) -> dict[str, float]:
        """All parts and what they come to, JSON-able."""
        return {"worst_ms": self.worst_ms, **asdict(self), "load": self.load}

    def with_shortest_hop(self, hops_ms: Sequence[float]) -> Latency:
        """The same with the shortest hop that compute fits into; the longest of all if none."""
        hops = sorted(hops_ms)
        hop = next((each for each in hops if self.compute_us / 1000 < each), hops[-1])
        return replace(self, hop_ms=hop)


@dataclass(frozen=True)
class Limits:
    """The limits that a detector has to keep.

    Args:
        deadline_ms: from the onset of slip to the decision, at worst.
        compute_us: from the last sample to the decision, p99.
        hops_ms: between bins, to choose from.

    Raises:
        ValueError: for limits that are no finite positive numbers.
    """

    deadline_ms: float
    compute_us: float
    hops_ms: Sequence[float]

    def __post_init__(self) -> None:
        check_number("deadline_ms", self.deadline_ms)
        check_number("compute_us", self.compute_us)

    def check_hops(self, sample_rate_hz: float) -> None:
        """Refuse hops that are no whole number of samples.

        Raises:
            ValueError: that names the first.
        """
        for hop in self.hops_ms:
            samples = hop * sample_rate_hz / 1000
            if not math.isclose(samples, round(samples), rel_tol=1e-9):
                raise ValueError(
                    f"search.hops_ms: {hop:g} ms are {samples:g} samples at {sample_rate_hz:g} Hz, "
                    f"expected a whole number; give a multiple of {1000 / sample_rate_hz:g} ms"
                )

    def latency(self, parts: Latency, compute_us: float, headroom: float = 1.0) -> Latency:
        """The same parts with another compute, and the longest hop that keeps the limits.

        A long hop spares the processor. Where a hop keeps the limits with ``headroom`` times the
        compute as well, it is the longest of those; where none keeps them, the shortest that
        compute fits into.
        """
        for factor in (headroom, 1.0):
            longest_first = (
                replace(parts, hop_ms=hop, compute_us=factor * compute_us)
                for hop in sorted(self.hops_ms, reverse=True)
            )
            if kept := next((each for each in longest_first if not self.misses(each)), None):
                return replace(kept, compute_us=compute_us)
        return replace(parts, compute_us=compute_us).with_shortest_hop(self.hops_ms)

    def misses(self, latency: Latency) -> list[str]:
        """Which limits are not kept, in words; none if all are."""
        found = []
        if latency.worst_ms > self.deadline_ms:
            found.append(
                f"latency {latency.worst_ms:.2f} ms above deadline_ms={self.deadline_ms:g}"
            )
        if latency.compute_us > self.compute_us:
            found.append(
                f"compute {latency.compute_us:.0f} us above compute_us={self.compute_us:g}"
            )
        if latency.load >= 1:
            us, hop_ms = latency.compute_us, latency.hop_ms
            found.append(f"compute {us:.0f} us not below the hop {hop_ms:g} ms")
        return found

    def headroom(self, latency: Latency) -> float:
        """How many times its compute a detector could take; less than 1 if it misses a limit."""
        left_us = 1000 * min(self.deadline_ms - latency.samples_ms, latency.hop_ms)
        return min(self.compute_us, left_us) / latency.compute_us


try:
    from resource import RUSAGE_THREAD, getrusage
except ImportError:  # only Linux counts for each thread
    getrusage = None  # type: ignore[assignment]


class Timing(NamedTuple):
    """Microseconds of a call: of several runs, the median of their medians and of their p99.

    Attributes:
        p50_us: half of the calls take no longer.
        p99_us: 99 of 100 calls take no longer.
        p99_all_us: the same with the calls that were interrupted.
        calls: counted in each run.
        interrupted: fraction of all calls that were interrupted, and not counted.
    """

    p50_us: float
    p99_us: float
    p99_all_us: float
    calls: int
    interrupted: float = 0.0


def time_calls(
    call: Callable[[Tensor], object], inputs: Sequence[Tensor], calls: int, runs: int = 3
) -> Timing:
    """Time a call on one input after the other, each by itself.

    Of a machine so busy that hardly a call is left alone, interrupted ones count too.
    """
    for given in inputs:
        call(given)
    middles, ends, ends_of_all, lost, made = [], [], [], 0, 0
    for _ in range(runs):
        taken: list[int] = []
        spoilt: list[int] = []
        while len(taken) < calls and len(spoilt) < calls:
            given = inputs[made % len(inputs)]
            switches = _interruptions()
            started = time.perf_counter_ns()
            call(given)
            spent = time.perf_counter_ns() - started
            (taken if _interruptions() == switches else spoilt).append(spent)
            made += 1
        lost += len(spoilt)
        counted = taken if len(taken) == calls else taken + spoilt
        middles.append(median_high(counted) / 1000)
        ends.append(_p99(counted))
        ends_of_all.append(_p99(taken + spoilt))
    return Timing(median(middles), median(ends), median(ends_of_all), calls, lost / made)


def time_detector(detector: SlipDetector, calls: int, runs: int = 3) -> Timing:
    """Time ``predict_raw`` of one ordinary bin, float32, as a live loop calls it."""
    pool = detector.pool
    inputs = single_bins(pool, pool.bin_samples + 2 * detector.channel_filter.context)
    with torch.inference_mode():
        return time_calls(detector.predict_raw, inputs, calls, runs)


def time_in_fresh_process(
    path: str | os.PathLike[str], calls: int, backend: BackendName = "auto"
) -> Timing:
    """``time_detector`` of a saved detector in a process that has done nothing else.

    That process imports the program that calls this, whose own work must therefore stand behind
    ``if __name__ == "__main__":``.

    Raises:
        ValueError: if that process ends without a result.
        Exception: what it raised.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context) as process:
        try:
            return process.submit(_time_saved, path, calls, backend).result()
        except BrokenProcessPool:
            raise ValueError(
                f"the process that was to time {os.fspath(path)} ended; is there memory for it, "
                'and does the program call this behind if __name__ == "__main__":?'
            ) from None


def _time_saved(path: str | os.PathLike[str], calls: int, backend: BackendName) -> Timing:
    with one_thread():
        return time_detector(SlipDetector.load(path, backend), calls, runs=5)


def _p99(taken_ns: Sequence[int]) -> float:
    """What 99 of 100 calls do not exceed, in microseconds."""
    return float(np.percentile(taken_ns, 99, method="inverted_cdf")) / 1000


def _interruptions() -> int:
    """How often this thread has lost the processor against its will; 0 where nobody counts."""
    return 0 if getrusage is None else getrusage(RUSAGE_THREAD).ru_nivcsw


def single_bins(pool: FeaturePool, num_samples: int) -> list[Tensor]:
    """Single ordinary bins in volts, ``[1, C, num_samples]`` each, float32."""
    generator = torch.Generator().manual_seed(0)
    shape = (32, 1, len(pool.hand), num_samples)
    return list(0.1 * torch.randn(shape, generator=generator) + 1)


GROUPS: Mapping[str, str] = {
    "gauges": "a gauge read and described",
    "films": "a film read",
    "branches": "a wavelet branch formed",
    "spectra": "a spectrum of a branch formed",
    "energies": "energies of all branches of a film",
    "moments": "mean, spread, shape and extremes of a row",
    "sorts": "a row sorted, for order statistics",
    "histograms": "entropy of a row",
    "correlations": "correlation of a branch with its film",
    "lines": "centroid and spread of a spectrum",
    "pooled": "a feature pooled over channels",
    "columns": "a number that the machine takes",
}
"""Groups of work, and what one part of each is."""
_OF_ROW = {"gauge": "gauges", "time": "branches", "freq": "spectra"}
_OF_DESCRIPTOR = {
    "entropy": "histograms",
    "correlation": "correlations",
    "spectral_centroid": "lines",
    "spectral_spread": "lines",
}

Part = tuple[str, tuple[object, ...]]
"""A group, and which of it; none of it: the group as such."""


@dataclass(frozen=True)
class CostModel:
    """What a call with one bin costs, by what it needs; all prices in microseconds.

    Args:
        base_us: of every call.
        group_us: by group, once if any of its parts is needed.
        part_us: by group, of each of its parts.
        tail: p99 over p50, usually.
        error: median relative error on the timings it was fitted to.
    """

    base_us: float
    group_us: Mapping[str, float]
    part_us: Mapping[str, float]
    tail: float = 1.0
    error: float = 0.0

    def compute_us(self, parts: set[Part]) -> float:
        """p99 of a call of a detector that needs these parts, from raw samples to the decision."""
        return self.tail * (self.base_us + sum(map(self._price, parts)))

    def bill(self, needed: Sequence[set[Part]]) -> tuple[Tensor, Tensor]:
        """What ``rank_per_cost`` takes: which parts each feature needs, and their prices.

        No column is free: of features that cost nothing else the one of higher score comes first.

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
        least = [int(group == "columns" and which != ()) for group, which in parts]
        return needs, torch.tensor(list(map(max, prices, least)))

    def to_dict(self) -> dict[str, Any]:
        """All prices, JSON-able."""
        groups = {
            name: {"group_us": self.group_us[name], "part_us": self.part_us[name], "part": what}
            for name, what in GROUPS.items()
        }
        return {
            "base_us": self.base_us,
            "groups": groups,
            "p99_over_p50": self.tail,
            "median_relative_error": self.error,
        }

    def _price(self, part: Part) -> float:
        group, which = part
        return self.part_us[group] if which else self.group_us[group]


def parts_of(plan: Plan) -> list[set[Part]]:
    """The parts that each feature of a plan needs; those of several features are the union."""
    needed: list[set[Part]] = [{("columns", (place,))} for place in range(plan.num_features)]
    for wanted in plan.wanted:
        row = plan.rows[wanted.row]
        own = needed[wanted.place]
        own.add((_OF_ROW[row.kind], (row.channel, row.branch)))
        if row.kind != "gauge":
            own.add(("films", (row.channel,)))
        is_ordered = wanted.descriptor in ORDERED
        if is_ordered:
            own.add(("sorts", tuple(row)))
        if not is_ordered or wanted.descriptor in _OF_DESCRIPTOR:
            own.add((_OF_DESCRIPTOR.get(wanted.descriptor, "moments"), tuple(row)))
    for share in plan.shares:
        needed[share.place] |= {("films", (share.channel,)), ("energies", (share.channel,))}
    return [own | {(group, ()) for group, _ in own} for own in needed]


def detector_parts(
    needed: Sequence[set[Part]], selected: Sequence[int], num_pooled: int | None = None
) -> set[Part]:
    """The parts that a detector needs.

    Args:
        needed: by each feature of the pool, as ``parts_of`` has it.
        selected: pool indices of the features that it reads.
        num_pooled: how many numbers it pools them into; ``None`` if it takes them as they are.
    """
    parts = set().union(*(needed[index] for index in selected))
    if num_pooled is None:
        return parts
    parts = {part for part in parts if part[0] != "columns"}
    parts |= {("columns", (place,)) for place in range(num_pooled)} | {("columns", ())}
    return parts | {("pooled", (index,)) for index in selected} | {("pooled", ())}


def measure_costs(
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    sizes: Sequence[int],
    backend: BackendName = "auto",
    statistics: Sequence[str] = (),
    *,
    calls: int = 100,
) -> CostModel:
    """Fit the model to timings of detectors that nobody trained, on this machine.

    Args:
        pool: what features there are.
        channel_filter: of the hand.
        sizes: numbers of features that are timed beside selections of one group of work each.
        backend: what computes features.
        statistics: over channels, whose pooling is timed; none: it is not.
        calls: of each detector, in each of three runs.
    """
    needed = parts_of(make_plan(pool.hand, pool.level, pool.names))
    designs: list[tuple[list[int], ChannelPooling | None]]
    designs = [(selected, None) for selected in _designs(needed, sorted(set(sizes)))]
    for layer in _layers(pool, statistics) if statistics else ():
        designs.append(([pool.names.index(name) for name in layer.inputs], layer))
    timings, rows = [], []
    with one_thread():
        for selected, layer in bar(designs, "cost of feature groups"):
            detector = _stand_in(pool, channel_filter, selected, backend, layer)
            timings.append(time_detector(detector, calls))
            num_pooled = None if layer is None else len(layer.names)
            parts = detector_parts(needed, selected, num_pooled)
            numbers = [sum(part[0] == group for part in parts) for group in GROUPS]
            # of each group one entry is the group as such
            rows.append([1, *map(bool, numbers), *(max(num - 1, 0) for num in numbers)])
    taken = np.array([timing.p50_us for timing in timings])
    counts = np.array(rows, dtype=float)
    prices, _ = nnls(counts / taken[:, None], np.ones(len(taken)), maxiter=10_000)  # relative
    base_us, *others = prices.tolist()
    return CostModel(
        base_us,
        dict(zip(GROUPS, others[: len(GROUPS)], strict=True)),
        dict(zip(GROUPS, others[len(GROUPS) :], strict=True)),
        tail=median(timing.p99_us / timing.p50_us for timing in timings),
        error=float(np.median(np.abs(counts @ prices / taken - 1))),
    )


def _stand_in(
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    selected: Sequence[int],
    backend: BackendName,
    layer: ChannelPooling | None,
) -> SlipDetector:
    """A detector that nobody trained, which takes as long as one that somebody did."""
    num = len(selected) if layer is None else len(layer.names)
    generator = torch.Generator().manual_seed(num)
    bend = torch.randn(num, num, generator=generator, dtype=torch.float64)
    ends = torch.ones(num, dtype=torch.float64)
    head = QuadraticForm(bend + bend.T, bend[0].clone(), torch.tensor(0.5, dtype=torch.float64))
    scaler = FeatureScaler(-ends, ends, ends)
    return SlipDetector(
        pool, channel_filter, selected, scaler, head, pooling=layer, backend=backend
    )


def _layers(pool: FeaturePool, statistics: Sequence[str]) -> Iterator[ChannelPooling]:
    """Layers that nobody fitted, of few to many columns."""
    names = pooled_names(pool.hand, pool.names, statistics)
    for number in (8, 60, 240):
        some = _spread(names, max(number, len(pool.hand.kinds)))
        families = {(n.channel, n.component, n.domain, n.descriptor) for n in some}
        yield ChannelPooling(pool.hand, some, torch.ones(len(families)), torch.zeros(len(some)))


def _designs(needed: Sequence[set[Part]], sizes: Sequence[int]) -> Iterator[list[int]]:
    """Selections that tell the groups apart: each group with one, some and all of its parts."""
    first: dict[Part, int] = {}  # of each part, the feature that needs fewest others
    for index in sorted(range(len(needed)), key=lambda index: len(needed[index])):
        for part in needed[index]:
            first.setdefault(part, index)
    for group in GROUPS:
        places = sorted({index for part, index in first.items() if part[0] == group and part[1]})
        for number in sorted({1, 4, 16, min(len(places), 80)}):
            if 0 < number <= len(places):
                yield _spread(places, number)
    generator = torch.Generator().manual_seed(0)
    for size in sizes:
        for _ in range(3):
            order = torch.randperm(len(needed), generator=generator)
            yield order[:size].sort().values.tolist()


def _spread(items: Sequence[Any], number: int) -> list[Any]:
    """So many of the items, evenly."""
    number = min(number, len(items))
    return [items[place * len(items) // number] for place in range(number)]
