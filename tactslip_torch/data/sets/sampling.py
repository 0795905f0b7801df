"""From the samples in a file to those of a recording: laid evenly, chosen, tared, resampled.

In that order, and each only as it was asked for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from tactslip_torch.data.clock import GAP_RULES, EvenSamples, GapRule
from tactslip_torch.data.formats import Samples, is_number, open_file
from tactslip_torch.data.sets.stream import Found, Stream
from tactslip_torch.data.sets.truth import Stretch
from tactslip_torch.signals.resampling import resample

REACH = 11
"""Samples of the lower rate on either side that a resampled one may hang on."""


@dataclass(frozen=True)
class Treatment:
    """What is done to the samples of every file of a set.

    Args:
        gaps: ``"refuse"`` files in which samples are missing, let them be ``"missing"`` (bins that
            need them are left out), or ``"bridge"`` short gaps by a straight line.
        bridge_ms: the longest gap that is bridged; longer ones are missing.
        resample_hz: the rate wanted; ``None`` for that of the files.
        tare_s: start and end of the stretch whose mean is taken off each channel.

    Raises:
        ValueError: for a value that cannot be.
    """

    gaps: GapRule = "refuse"
    bridge_ms: float = 10.0
    resample_hz: float | None = None
    tare_s: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.gaps not in GAP_RULES:
            known = ", ".join(GAP_RULES)
            raise ValueError(f"data.gaps must be one of {known}, got {self.gaps!r}")
        if not (is_number(self.bridge_ms) and self.bridge_ms > 0):
            raise ValueError(f"data.bridge_ms must be a positive number, got {self.bridge_ms!r}")
        rate = self.resample_hz
        if rate is not None and not (is_number(rate) and 0 < rate < math.inf):
            raise ValueError(f"data.resample_hz must be a positive number or null, got {rate!r}")
        object.__setattr__(self, "tare_s", tare_of(self.tare_s, "data.tare_s"))

    def most_bridged(self, rate_hz: float) -> int:
        """The most samples of a gap that is bridged."""
        return int(self.bridge_ms * rate_hz / 1000 + 1e-6) if self.gaps == "bridge" else 0


def tare_of(value: object, name: str) -> Stretch | None:
    """The stretch that is tared on, as somebody said it.

    Raises:
        ValueError: naming the setting, if that is no start and end of a stretch.
    """
    if value is None:
        return None
    parts = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else []
    if len(parts) != 2 or not all(map(is_number, parts)) or not 0 <= parts[0] < parts[1] < math.inf:
        got = parts or value
        raise ValueError(f"{name} must be [start, end] in seconds, got {got!r}")
    return float(parts[0]), float(parts[1])


def num_recorded(found: Found, rate_hz: float, how: Treatment) -> int:
    """How many samples of a stream the recording has."""
    if how.resample_hz is None:
        return found.clock.num_samples
    return int(found.clock.num_samples * how.resample_hz / rate_hz + 1e-6)


def refuse_ratio(rate_hz: float, how: Treatment) -> None:
    """Raise if samples of that rate cannot be resampled as it was asked for.

    Raises:
        ValueError: as ``resample``.
    """
    if how.resample_hz is not None:
        resample(torch.zeros(1, 1), rate_hz, how.resample_hz)


def missing_of(found: Found, rate_hz: float, how: Treatment) -> tuple[Stretch, ...]:
    """The stretches of a recording without samples, wider by what resampling draws from them."""
    most, to_hz = how.most_bridged(rate_hz), how.resample_hz
    reach_s = REACH / min(rate_hz, to_hz) if to_hz else 0.0
    return tuple(
        (max(gap.start / rate_hz - reach_s, 0.0), (gap.start + gap.missing) / rate_hz + reach_s)
        for gap in found.clock.gaps
        if gap.missing > most
    )


@contextmanager
def even_samples(
    path: Path, stream: Stream, found: Found, most_bridged: int = 0
) -> Iterator[Samples]:
    """All channels of a file on their clock, to be read by stretches; NaN in gaps.

    Raises:
        ValueError: if the file is damaged, or is not what it was when it was looked at.
    """
    with open_file(path, stream.reading) as opened:
        samples: Samples = opened.samples
        missing = sum(gap.missing for gap in found.clock.gaps)
        shape = (samples.num_channels, samples.num_samples + missing)
        if shape != (found.num_channels, found.clock.num_samples):
            raise ValueError(f"{path} has changed since it was looked at; start again")
        yield EvenSamples(samples, found.clock, most_bridged) if missing else samples


def recorded(
    path: Path,
    stream: Stream,
    found: Found,
    rows: Sequence[int],
    rate_hz: float,
    how: Treatment,
    windows: Sequence[Stretch] | None = None,
) -> Tensor:
    """The samples of a stream as the recording has them.

    What is resampled is read whole; of the rest no more than the windows and what is tared on.

    Args:
        path: of the file.
        stream: how it is read.
        found: what the file said when it was looked at.
        rows: of the file, in the order of the hand.
        rate_hz: of the file.
        how: samples are treated.
        windows: start and end of what is wanted, seconds; ``None`` for all.

    Shape:
        - output: ``[C, T]``, NaN where nothing is known and outside the windows

    Raises:
        ValueError: if the file is damaged, or is not what it was when it was looked at.
    """
    with even_samples(path, stream, found, how.most_bridged(rate_hz)) as samples:
        chosen = list(rows)
        num = samples.num_samples
        level = tare_level(samples, chosen, rate_hz, how.tare_s, path)
        if how.resample_hz is not None and how.resample_hz != rate_hz:
            whole = samples.read(0, num)[chosen] - level
            even = resample(whole, rate_hz, how.resample_hz)
            return even[:, : num_recorded(found, rate_hz, how)].to(samples.dtype)
        kept = torch.full((len(chosen), num), torch.nan, dtype=samples.dtype)
        for start, end in windows if windows is not None else [(0.0, num / rate_hz)]:
            first, stop = math.floor(start * rate_hz), math.ceil(end * rate_hz)
            first, stop = max(first, 0), min(stop, num)
            read = samples.read(first, stop)[chosen]
            kept[:, first:stop] = read if how.tare_s is None else (read - level).to(samples.dtype)
        return kept


def tare_level(
    samples: Samples,
    rows: Sequence[int],
    rate_hz: float,
    tare_s: Sequence[float] | None,
    path: Path,
) -> Tensor:
    """What is taken off each channel: the mean of what is finite in a stretch.

    Args:
        samples: of the file.
        rows: of the channels.
        rate_hz: of the samples.
        tare_s: start and end of the stretch; ``None`` for nothing to take off.
        path: of the file, for messages.

    Shape:
        - output: ``[C, 1]``, float64

    Raises:
        ValueError: if the file ends before the stretch, or a channel has nothing finite in it.
    """
    if tare_s is None:
        return torch.zeros(len(rows), 1, dtype=torch.float64)
    first, stop = (round(moment * rate_hz) for moment in tare_s)
    if not first < stop <= samples.num_samples:
        raise ValueError(
            f"{path} has {samples.num_samples} samples, too few for tare_s={list(tare_s)}"
        )
    read = samples.read(first, stop)[list(rows)].double()
    level = read.where(read.isfinite(), torch.nan).nanmean(-1, keepdim=True)
    dead = level.isnan().flatten().nonzero().flatten().tolist()
    if dead:
        raise ValueError(
            f"{path} has nothing finite in its column {rows[dead[0]] + 1} to tare on from "
            f"{tare_s[0]:g} to {tare_s[1]:g} s; give another tare_s"
        )
    return level
