"""Which channels of a bin sense something, and whether they are enough for a decision.

Each channel of a filtered bin is one of three:

- *missing*: a sample that its filter takes in is not finite. Recordings and streams also make a
  channel NaN that keeps one value for too long, a rail or any other (``StuckChannels``);
- *silent*: its span, the largest less the smallest filtered sample, is within rounding of the
  largest raw sample, or below a tenth of the smallest span at rest in training. A bin of fewer than
  16 samples is never silent;
- *alive* otherwise.

Channels that are missing or silent are *lost*: pools leave them out, and their own columns take the
mean of training. A decision on which fewer than ``min_alive`` channels are alive is not valid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.features.descriptors import FeatureName
from tactslip_torch.hand import HandLayout

SILENT_FRACTION = 0.1
"""Of the smallest span at rest in training, below which a channel is silent."""
FEWEST_SAMPLES = 16
"""Of a bin whose span can tell that a channel is silent."""
RANGE_FACTOR = 3.0
"""By which a span may lie outside those of training and still count as in range."""
LEVEL_FACTOR = 10.0
"""By which levels at rest must differ from those of training to be reported."""
LARGEST_SAMPLE = torch.finfo(torch.float64).max / 64
"""Volts; what is larger counts as Inf, because its branches and spectra may leave float64."""
REST_QUANTILE = 0.01
"""Of the spans of training bins: the smallest span at rest, without the odd bin."""
_STUCK_S = (0.1, 1.0)
_SLOW_STUCK_S = 0.01  # in place of .1: known before a step of all channels at once raises an alarm
_STUCK_SAMPLES = 20
_RANGE_OF = {"slow": "raw", "fast": "A1"}  # the component whose range is the span in training

Array = NDArray[Any]
Bools = TypeVar("Bools", bound=Any)
"""A tensor, or a value of an ONNX graph."""


@dataclass(frozen=True)
class Sensing:
    """What a classifier learned of channels that work.

    Args:
        rest_span: of each channel, the smallest span of a filtered bin at rest in training, in the
            unit of the samples; 0: not known.
        most_span: the largest; infinite: not known.
        min_alive: how many of the channels that count must be alive for a valid decision.
        stuck_samples: equal samples in a row beyond which a channel counts as missing.

    Raises:
        ValueError: if the spans differ in number, are negative or NaN, or a number is below 1.
    """

    rest_span: tuple[float, ...]
    most_span: tuple[float, ...]
    min_alive: int
    stuck_samples: int

    def __post_init__(self) -> None:
        for name in ("rest_span", "most_span"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        spans = [*self.rest_span, *self.most_span]
        if len(self.rest_span) != len(self.most_span) or not all(span >= 0 for span in spans):
            raise ValueError("rest_span and most_span must be one span of at least 0 a channel")
        for name in ("min_alive", "stuck_samples"):
            value = getattr(self, name)
            if type(value) is not int or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")

    @classmethod
    def unknown(cls, num_channels: int, num_counted: int, sample_rate_hz: float) -> Sensing:
        """Without training: a channel is silent within rounding alone; half must be alive."""
        stuck = most_stuck_samples(sample_rate_hz)
        rest, most = (0.0,) * num_channels, (math.inf,) * num_channels
        return cls(rest, most, least_alive(num_counted), stuck)

    @classmethod
    def fit(cls, spans: Tensor, min_alive: int, stuck_samples: int) -> Sensing:
        """Of spans of training bins, ``[N, C]``, at least one."""
        ascending, last = spans.sort(0).values, len(spans) - 1
        rest, most = (ascending[math.floor(q * last)] for q in (REST_QUANTILE, 1 - REST_QUANTILE))
        most = torch.where(most.isfinite(), most, torch.inf)
        of_rest, of_most = tuple(rest.nan_to_num(0.0).tolist()), tuple(most.tolist())
        return cls(of_rest, of_most, min_alive, stuck_samples)

    def is_silent(self, spans: Tensor, bin_samples: int) -> Tensor:
        """Which channels of training bins are silent, by their spans: ``[N, C]``, bool."""
        if bin_samples < FEWEST_SAMPLES:
            return torch.zeros_like(spans, dtype=torch.bool)
        return (spans < torch.tensor(self.floor).double()) | (spans == 0)

    @property
    def floor(self) -> tuple[float, ...]:
        """Span below which each channel is silent."""
        return tuple(SILENT_FRACTION * span for span in self.rest_span)

    @property
    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and largest span of each channel that is in range."""
        least = tuple(span / RANGE_FACTOR for span in self.rest_span)
        return least, tuple(RANGE_FACTOR * span for span in self.most_span)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types; ``None`` for an infinite span."""
        most = [None if math.isinf(span) else span for span in self.most_span]
        return {
            "rest_span": list(self.rest_span),
            "most_span": most,
            "min_alive": self.min_alive,
            "stuck_samples": self.stuck_samples,
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Sensing:
        """What ``to_dict`` wrote."""
        most = [math.inf if span is None else span for span in plain["most_span"]]
        return cls(plain["rest_span"], tuple(most), plain["min_alive"], plain["stuck_samples"])


def least_alive(num_counted: int, fraction: float = 0.5) -> int:
    """Channels that must be alive of so many: a fraction, never all of several, at least one.

    Example:
        >>> least_alive(10), least_alive(3), least_alive(1), least_alive(4, fraction=1.0)
        (5, 1, 1, 3)
    """
    return max(1, min(math.floor(fraction * num_counted), num_counted - 1))


def most_stuck_samples(
    sample_rate_hz: float, longest_run: int | None = None, *, has_fast: bool = True
) -> int:
    """Equal samples in a row that a working channel may have.

    Twice the longest run in training, at least .1 s (.01 s on a hand without fast channels), at
    most 1 s or 20 samples, whichever is longer; without training that most.
    """
    shortest_s, longest_s = _STUCK_S if has_fast else (_SLOW_STUCK_S, _STUCK_S[1])
    shortest, longest = (math.ceil(round(s * sample_rate_hz, 6)) for s in (shortest_s, longest_s))
    longest = max(longest, _STUCK_SAMPLES)
    return longest if longest_run is None else min(max(2 * longest_run, shortest, 1), longest)


def run_lengths(samples: Tensor) -> Tensor:
    """Equal samples in a row that end at each sample, ``[*, C, T]``, int64."""
    x = samples.detach().cpu().numpy()
    is_new = np.ones(x.shape, bool)
    is_new[..., 1:] = x[..., 1:] != x[..., :-1]
    place = np.arange(x.shape[-1])
    return torch.from_numpy(place - np.maximum.accumulate(np.where(is_new, place, 0), -1) + 1)


def longest_run_of(runs: Tensor) -> int:
    """The longest of ``run_lengths`` ``[*, C, T]`` of the channels that move; 0 if none does."""
    if not runs.numel():
        return 0
    longest = runs.amax(-1)
    return int(longest.where(longest < runs.shape[-1], 0).max())


def is_alive(span: Bools, loudest: Bools, is_known: Bools, inverse: Tensor, floor: Tensor) -> Bools:
    """Which channels are alive; in operations that tensors and values of an ONNX graph share.

    Args:
        span: of the filtered bin, float64.
        loudest: size of the largest sample that it was filtered from.
        is_known: whether all of these are finite.
        inverse: one over the least span that is more than rounding, as a part of ``loudest``.
        floor: span below which a channel is silent.

    Shape:
        - span, loudest, is_known, output: ``[*, C]``; inverse, floor: ``[C]``
    """
    alive: Bools = (span * inverse > loudest) & (span >= floor) & is_known
    return alive


def is_enough(
    alive: Bools, span: Bools, counted: Tensor, sensing: Sensing, channels: Sequence[int]
) -> tuple[Bools, Bools]:
    """Whether decisions are valid, and whether the hand is in the range of training.

    In range are those with at least half of the living channels that count within ``RANGE_FACTOR``
    of the spans of training.

    Args:
        alive: which channels are.
        span: of the filtered bin; anything finite where not alive.
        counted: 1 for channels that count, else 0, float64.
        sensing: of all channels of the hand.
        channels: of the hand that these are.

    Shape:
        - alive, span: ``[*, C]``; counted: ``[C]``; output: ``[*]`` each
    """
    low, high = (torch.tensor(bound).double()[list(channels)] for bound in sensing.bounds)
    largest = torch.finfo(torch.float64).max
    low, high = low.to(counted.device), high.clamp(max=largest).to(counted.device)
    num = (alive.double() * counted).sum(-1)
    fits = alive & (span >= low) & (span <= high)
    num_fits = (fits.double() * counted).sum(-1)
    valid = num >= float(sensing.min_alive)
    return valid, valid & (num_fits * 2.0 >= num)


class SpanFeatures:
    """Spans of training bins by their features, which tell the channels that are silent.

    That of a slow channel is the range of the bin, that of a fast one the range of its first
    approximation ``A1``, which holds all but the upper half of the band.

    Args:
        hand: the channels.
        names: of the features.
        bin_samples: length of a bin.
    """

    def __init__(self, hand: HandLayout, names: Sequence[FeatureName], bin_samples: int) -> None:
        place = {name: index for index, name in enumerate(names)}
        wanted = [
            FeatureName(channel.name, _RANGE_OF[str(channel.adapting)], "time", "range")
            for channel in hand.channels
        ]
        self._places = torch.tensor([place.get(name, -1) for name in wanted])
        self._bin_samples = bin_samples

    def __call__(self, features: Tensor) -> Tensor:
        """Spans of bins, ``[N, F] -> [N, C]``, float64; NaN where the range is no feature."""
        return features[:, self._places].double().masked_fill(self._places < 0, torch.nan)

    def is_silent(self, spans: Tensor, sensing: Sensing) -> Tensor:
        """Which channels of bins are silent, by their spans: ``[N, C]``, bool."""
        return sensing.is_silent(spans, self._bin_samples)


class StuckChannels:
    """Makes samples NaN that repeat one value for too long, as a stream comes.

    The first ``most`` equal samples are as they came: that a channel is stuck is known only then.
    A peak that is clipped for less is no fault.

    Args:
        most: equal samples in a row that are let pass.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._last: Array | None = None
        self._run = np.zeros(0, np.int64)

    def __call__(self, x: Array) -> Array:
        """Samples ``[C, n]`` with NaN where a channel is stuck; the same array if none is."""
        if not x.shape[-1]:
            return x
        if self._last is None:
            self._last, self._run = np.full(len(x), np.nan, x.dtype), np.zeros(len(x), np.int64)
        is_short = self._run.max(initial=0) + x.shape[-1] <= self._most
        if is_short and x.shape[-1] > 1 and (x[:, -1] != x[:, -2]).all():  # as nearly always
            self._last, self._run = x[:, -1].copy(), np.ones(len(x), np.int64)
            return x
        before = np.concatenate([self._last[:, None], x[:, :-1]], -1)
        is_new, place = x != before, np.arange(x.shape[-1])
        began = np.maximum.accumulate(np.where(is_new, place, -1), -1)
        run = place + 1 - np.where(began < 0, -self._run[:, None], began)
        self._last, self._run = x[:, -1].copy(), run[:, -1]
        is_stuck = run > self._most
        return np.where(is_stuck, x.dtype.type(np.nan), x) if is_stuck.any() else x


def without_stuck(samples: Tensor, most: int) -> Tensor:
    """Whole recordings ``[*, C, T]`` with NaN where a channel is stuck (``StuckChannels``)."""
    flat = samples.detach().cpu().flatten(0, -2).numpy()
    marked = StuckChannels(most)(flat)
    if marked is flat:
        return samples
    is_stuck = torch.from_numpy(np.isnan(marked)).reshape(samples.shape).to(samples.device)
    return samples.masked_fill(is_stuck, torch.nan)


def level_ratio(span: Tensor, sensing: Sensing) -> float | None:
    """Levels at rest as a part of those in training: the median over channels; None: not known.

    Args:
        span: of the bins of a recording or of the first seconds of a stream, NaN where missing.
        sensing: of the classifier.

    Shape:
        - span: ``[N, C]``
    """
    rest = torch.tensor(sensing.rest_span).double()
    own = torch.nanquantile(span.double(), 0.1, 0) if len(span) else rest * torch.nan
    ratio = (own / rest)[(rest > 0) & own.isfinite()]
    return float(ratio.median()) if len(ratio) else None


def level_message(ratio: float | None, unit: str) -> str:
    """One line on levels that are far from those of training; empty where they are not."""
    if ratio is None or 1 / LEVEL_FACTOR <= ratio <= LEVEL_FACTOR:
        return ""
    if not ratio:
        return "half of the channels or more do not move at all; is the hand connected?"
    power = round(math.log10(ratio) / 3)
    near = {-2: "a millionth", -1: "a thousandth", 1: "a thousand times", 2: "a million times"}
    is_unit = power in near and abs(math.log10(ratio) - 3 * power) <= 0.7
    size = f"{near[power]}" if is_unit else f"{ratio:.2g} times"
    those = "those" if "times" in size else "of those"
    hint = f"is the unit {unit}?" if is_unit else "is the gain another?"
    return f"levels at rest are about {size} {those} of training: {hint}"
