"""A stream graph against ``StreamingDetector`` in float64, in whatever pieces samples come."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.graph.bin_check import WORST_DEGENERATE_SD, WORST_PROBABILITY, WORST_SD
from tactslip_torch.graph.form import Form
from tactslip_torch.graph.runs import Run
from tactslip_torch.graph.stream import Timing
from tactslip_torch.graph.trials import dead_masks, simulated_stream, unit_of
from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.missing_channels import ChannelMask
from tactslip_torch.onset.settings import AlarmSettings
from tactslip_torch.onset.streaming import StreamingDetector

Columns = dict[str, NDArray[Any]]

FLAGS = ("valid", "alarm", "on")
TIMES = ("time_s", "onset_s")
NUMBERS = ("score", "probability", "statistic")
_DECISIONS = 12  # that are made at least
_FEWEST_BINS = 4  # that a slip lasts at least
_LONGEST_HOP = 20_000  # samples; of more, a stream of that many decisions takes much memory
_LATE_S = 1e-9  # by which times may differ
_STATISTIC = {"float32": 1e-3, "float64": 1e-8}  # share of its range by which one may differ


def check_stream(run: Run, detector: SlipDetector, form: Form) -> dict[str, Any]:
    """Hold a stream graph against the detector on a simulated slip, whole and broken.

    Args:
        run: the graph.
        detector: that it was made of, with alarm settings.
        form: of the graph.

    Returns:
        What was measured, in JSON types.

    Raises:
        ValueError: for the first thing that is wrong, in one line.
    """
    double = copy.deepcopy(detector).double()
    settings = AlarmSettings.of(detector)
    dtype = torch.float32 if form.precision == "float32" else torch.float64
    timing = Timing.of(detector, settings)
    hand, rate = detector.pool.hand, detector.pool.sample_rate_hz
    slip = simulated_stream(hand, rate, dtype, _FEWEST_BINS * max(timing.first, timing.frame)).T
    pooling = detector.pooling
    unit = unit_of(None if pooling is None else pooling.least_range)
    whole = slowed(unit * slip, timing)
    expected = _columns(double, settings, whole)
    sd = float(expected["score"].std()) or 1.0
    worst = WORST_SD[form.precision]
    samples = whole.numpy()
    host = _Host(run, samples.shape[1], form, timing)
    found = 0.0
    ways = cuts(len(samples), timing.hop)
    for name, sizes in ways.items():
        got = host.watch(samples, sizes)
        found = max(found, _compare(got, expected, settings, sd, worst, form, f"cut {name}"))
    middling = replace(settings, threshold=middle_threshold(expected["statistic"]))
    at_middle = _columns(double, middling, whole)
    got = host.watch(samples, ways["by hop"], middling.threshold)
    _compare(got, at_middle, middling, sd, worst, form, "another threshold")
    broken = broken_stream(whole, detector.needed_index.tolist())
    of_broken = _columns(double, settings, broken)
    got = host.watch(broken.numpy(), ways["by hop"])
    worst = WORST_DEGENERATE_SD[form.precision]
    lost = _compare(got, of_broken, settings, sd, worst, form, "broken sensors")
    dead = dead_masks(hand, detector.needed_index)["every other"]
    of_dead = _columns(double, settings, whole, dead)
    host.masked_channels = dead.numpy()
    got = host.watch(samples, ways["by hop"])
    without = _compare(got, of_dead, settings, sd, worst, form, "dead sensors")
    return {
        "score_sd": sd,
        "simulated": True,
        "decisions": len(expected["score"]),
        "alarms": int(expected["alarm"].sum()),
        "alarms_at_another_threshold": int(at_middle["alarm"].sum()),
        "worst_sd": found,
        "broken": {"not_valid": int((~of_broken["valid"]).sum()), "worst_sd": lost},
        "dead": {"not_valid": int((~of_dead["valid"]).sum()), "worst_sd": without},
    }


def slowed(samples: Tensor, timing: Timing) -> Tensor:
    """The same, or what a long hop leaves of it: each decision sees another part.

    Args:
        samples: ``[T, C]``.
        timing: of the decisions.

    Raises:
        ValueError: if the hop is so long that the stream would be too large.
    """
    num, hop = len(samples), timing.hop
    if timing.decisions(num) >= _DECISIONS:
        return samples
    if hop > _LONGEST_HOP:
        raise ValueError(
            f"a hop of {hop} samples is too long to be checked, at most {_LONGEST_HOP}; train with "
            "a shorter onset.hop_ms"
        )
    places = torch.arange(max(timing.first, timing.frame) + hop * (_DECISIONS - 1))
    return samples[(places - places // hop * (hop - num // _DECISIONS)) % num]


def cuts(num: int, hop: int) -> dict[str, list[int]]:
    """Ways to cut a stream into pieces, by name: lengths, which may be 0."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(0, 400, (num,), generator=generator).tolist()
    drawn[1::5] = [0] * len(drawn[1::5])
    singles = [1] * min(num, 300)
    ways = {
        "whole": [num],
        "by hop": [hop] * (num // hop),
        "by sample": singles,
        "anyhow": [int(size) for size in drawn],
    }
    return {name: _ending_at(num, sizes) for name, sizes in ways.items()}


def _ending_at(num: int, sizes: Sequence[int]) -> list[int]:
    """The first of them up to a total, with a last one that reaches it."""
    ends = np.minimum(np.cumsum([0, *sizes]), num)
    kept = [int(last - first) for first, last in pairwise(ends) if first < num]
    return kept + [num - sum(kept)] * (sum(kept) < num)


def middle_threshold(statistic: NDArray[Any]) -> float:
    """A threshold that the statistic crosses, in the widest gap between its middling values."""
    low, high = np.quantile(statistic, [0.5, 0.95])
    values = np.unique(statistic[(low <= statistic) & (statistic <= high)])
    if len(values) < 2:
        return float(low)
    widest = int(np.diff(values).argmax())
    return float(values[widest : widest + 2].mean())


def broken_stream(samples: Tensor, needed: Sequence[int]) -> Tensor:
    """The same with a channel that dies, one that tears off and instants that never came.

    Args:
        samples: ``[T, C]``, volts.
        needed: channels in use.
    """
    broken = samples.clone()
    sixth = len(samples) // 6
    broken[sixth : 2 * sixth, needed[0]] = broken[sixth, needed[0]]
    broken[3 * sixth : 4 * sixth, needed[-1]] = torch.inf
    broken[5 * sixth : 5 * sixth + 30] = torch.nan
    return broken


class _Host:
    """A graph and what it remembers, as every host has them."""

    def __init__(self, run: Run, num_channels: int, form: Form, timing: Timing) -> None:
        self.run, self.form, self.timing = run, form, timing
        self.num_channels = num_channels
        self.masked_channels: NDArray[np.bool_] | None = None
        self.reset()

    def reset(self) -> None:
        self.tail: NDArray[Any] = np.empty((0, self.num_channels), self.form.dtype)
        self.state: NDArray[Any] = np.empty(0, np.float64)
        self.seen = self.made = 0

    def push(self, samples: NDArray[Any], threshold: float | None = None) -> Columns:
        given = np.array([] if threshold is None else [threshold], np.float64)
        feeds = {"samples": samples, "tail": self.tail, "state": self.state, "threshold": given}
        asked = {} if self.masked_channels is None else {"masked_channels": self.masked_channels}
        columns = self.run(feeds | asked)
        wanted = {*FLAGS, *TIMES, *NUMBERS, "next_tail", "next_state"}
        if columns.keys() != wanted:
            found = ", ".join(sorted(columns.keys() ^ wanted))
            raise ValueError(f"its outputs are not those of a stream graph: {found}")
        self.tail, self.state = columns.pop("next_tail"), columns.pop("next_state")
        self._check_memory()
        self.seen, self.made = self.seen + len(samples), self.made + len(columns["score"])
        if self.made != (due := self.timing.decisions(self.seen)):
            raise ValueError(
                f"it has made {self.made} decisions of {self.seen} samples, its facts say {due}"
            )
        return columns

    def _check_memory(self) -> None:
        tail = f"{self.form.dtype}{[self.timing.tail, self.num_channels]}"
        state = f"float64{[self.timing.state_size]}"
        for name, kept, wanted in (
            ("next_tail", self.tail, tail),
            ("next_state", self.state, state),
        ):
            if (found := f"{kept.dtype}{list(kept.shape)}") != wanted:
                raise ValueError(f"{name} is {found}, expected {wanted} always")

    def watch(
        self, samples: NDArray[Any], sizes: Sequence[int], threshold: float | None = None
    ) -> Columns:
        """A whole stream, from the start, in pieces."""
        self.reset()
        parts = [self.push(piece, threshold) for piece in _pieces(samples, sizes)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _pieces(samples: NDArray[Any], sizes: Sequence[int]) -> Iterator[NDArray[Any]]:
    for first, last in pairwise(np.cumsum([0, *sizes])):
        yield samples[first:last]


def _columns(
    detector: SlipDetector, settings: AlarmSettings, samples: Tensor, dead: ChannelMask = ()
) -> Columns:
    """What the streaming detector says of samples ``[T, C]``, under the graph's names."""
    double = StreamingDetector(detector, settings, dtype=torch.float64, masked_channels=dead)
    decisions = double.push(samples)
    # a sensor is trusted by what its samples resolve in the precision they come in
    trusted = StreamingDetector(detector, settings, dtype=samples.dtype, masked_channels=dead)
    is_valid = trusted.push(samples).is_valid
    named = {
        "score": decisions.score,
        "probability": decisions.probability,
        "statistic": decisions.statistic,
        "valid": is_valid,
        "alarm": decisions.is_alarm,
        "on": decisions.is_on,
        "time_s": decisions.available_s,
        "onset_s": decisions.onset_s,
    }
    return {name: column.numpy() for name, column in named.items()}


def _compare(
    got: Columns,
    expected: Columns,
    settings: AlarmSettings,
    sd: float,
    worst: float,
    form: Form,
    what: str,
) -> float:
    """The worst score error, in standard deviations.

    Raises:
        ValueError: if anything differs by more than it may.
    """
    num = len(expected["score"])
    for name, column in got.items():
        wanted = bool if name in FLAGS else np.float64 if name in TIMES else form.dtype
        if column.dtype != wanted or column.shape != (num,):
            raise ValueError(
                f"{what}: {name} is {column.dtype}{list(column.shape)}, expected "
                f"{np.dtype(wanted)}[{num}]"
            )
    for name in FLAGS:
        if places := np.flatnonzero(got[name] != expected[name]).tolist():
            raise ValueError(
                f"{what}: {name} differs from torch at {len(places)} of {num} decisions, the "
                f"first at {expected['time_s'][places[0]]:.3f} s"
            )
    for name in TIMES:
        _refuse(np.abs(got[name] - expected[name]), _LATE_S, "s", f"{what}: {name}")
    error = np.abs(got["score"].astype(np.float64) - expected["score"]) / sd
    _refuse(error, worst, "standard deviations", f"{what}: score")
    tells = got["statistic"] > -1e30  # before that a rule has seen too few decisions
    statistic = expected["statistic"][tells]
    span = float(np.ptp(statistic)) if len(statistic) else 0.0
    off = np.abs(got["statistic"][tells] - statistic) / (span or 1.0)
    _refuse(off, _STATISTIC[form.precision], "of its range", f"{what}: statistic")
    llr = settings.calibration.llr(torch.from_numpy(got["score"].astype(np.float64)))
    stated = probability(llr, settings.slip_share).numpy()
    off = np.abs(got["probability"] - stated)[got["valid"]]
    _refuse(off, WORST_PROBABILITY[form.precision], "", f"{what}: probability")
    return float(error.max(initial=0.0))


def _refuse(off: NDArray[Any], most: float, unit: str, what: str) -> None:
    if not (found := float(off.max(initial=0.0))) <= most:
        raise ValueError(f"{what} differs from torch by {found:.1e} {unit}, more than {most:g}")
