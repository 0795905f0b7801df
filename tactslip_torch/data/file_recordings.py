"""Folders of recordings in files as one source: looked at as a whole, refused with every reason.

Each file is opened once for its channels, clock and unit and checked against the others; then
``FileRecordings`` loads recordings one by one. ``hand_file`` opens one for a detector.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, TypeVar, get_args

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.data.clock import (
    Clock,
    Gap,
    GapRule,
    even_clock,
    nominal_rate,
    snapped_rate,
)
from tactslip_torch.data.formats import (
    Archived,
    Opened,
    Reading,
    Samples,
    file_of,
    open_file,
    pieces,
)
from tactslip_torch.data.formats._names import bare
from tactslip_torch.data.formats._reading import MM_S
from tactslip_torch.data.labels import slip_by_speed
from tactslip_torch.data.manifest import Entry, Listing, Problem, manifest_of, read_manifest
from tactslip_torch.data.recording import (
    MOMENTS,
    SPANS,
    STRETCHES,
    Recording,
    RecordingId,
    Stretch,
    Timeline,
)
from tactslip_torch.hand import KNOWN_KINDS, Adapting, Channel, HandLayout
from tactslip_torch.runtime import check_choice, check_number, in_processes
from tactslip_torch.signals.resampling import resample

log = logging.getLogger(__name__)

_NOWHERE = "unknown"
"""The finger and segment of a channel of which nobody said them."""
_RATES_HZ = 1.0, 1e6
"""Sample rates that are believed; beyond, times are in another unit than they are taken for."""
_RATE_ERROR = 0.01
"""By so much a rate that time stamps tell may differ from that of the set."""
_WANTED_RATE_ERROR = 0.001  # and from that of a detector, as what is told in seconds errs
_ROUNDING = 1e-9
_MOST_CUT_S = 0.1  # by so much may streams that belong together end apart
_BEFORE_ONSET_S = 1.01
"""What ``labels=whole_slide`` takes as non-slip before an onset."""
_REACH = 11
"""Samples of the lower rate on either side that a resampled one may hang on."""
_FEW = 16  # files that are looked at by one process
_PIECE = 1 << 16  # samples that are looked at at a time
_MOST_SHOWN = 5


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of all files of a folder with their names.

    Of an episode: of the table that it is in, and its name.

    A file is read once by a process, as long as its size and the time of its last change stay.

    Raises:
        FileNotFoundError: if there is none.
    """
    if path.is_dir():
        whole = hashlib.sha256()
        for inner in sorted(inner for inner in path.rglob("*") if inner.is_file()):
            name = inner.relative_to(path).as_posix()
            whole.update(f"{name}\0{file_digest(inner)}\n".encode())
        return whole.hexdigest()
    if (table := file_of(path)) != path:
        return hashlib.sha256(f"{path.name}\0{file_digest(table)}".encode()).hexdigest()
    found = path.stat()
    return _digest(str(path.absolute()), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=100_000)
def _digest(path: str, changed_ns: int, size: int) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# The truth on the time of a recording -----------------------------------------------------------


def on_time(
    truth: Timeline,
    duration_s: float,
    *,
    skip_s: float = 0.0,
    slide_s: float = 0.5,
    slack_s: float = 0.0,
    missing_s: Iterable[Stretch] = (),
) -> tuple[Timeline, list[str]]:
    """A truth on the time of its recording, and what does not fit there.

    Args:
        truth: as somebody said it.
        duration_s: of the recording.
        skip_s: at the start that a label of all of it does not stand for.
        slide_s: how long a slide lasts of which only the onset is known; it ends before that with
            the next onset, stretch without slip, or the recording.
        slack_s: by which a stretch may leave the recording; it is cut then.
        missing_s: further stretches without samples, of the file.
    """
    problems = []
    for name in SPANS:
        for start, end in getattr(truth, name):
            if start >= duration_s or (end > duration_s + slack_s and end != math.inf):
                span = f"{start:g}-{'end' if end == math.inf else format(end, 'g')} s"
                problems.append(f"{name}: {span} leaves the recording of {duration_s:.4g} s")
    for name in ("onsets_s", "annotated_onsets_s"):
        late = [onset for onset in getattr(truth, name) if onset >= duration_s]
        problems += [f"{name}: {onset:g} s is behind the end, {duration_s:.4g} s" for onset in late]
    if truth.label and skip_s >= duration_s:
        problems.append(
            f"label: of {duration_s:.4g} s nothing is left behind the first {skip_s:g} s; "
            "lower skip_s"
        )
    if problems:
        return Timeline(duration_s=duration_s), problems
    onsets = truth.onsets_s
    cut: dict[str, Any] = {
        name: tuple((start, min(end, duration_s)) for start, end in getattr(truth, name))
        for name in SPANS
    }
    if not cut["sliding_s"]:
        stops = [*onsets, duration_s, *(start for start, _ in truth.non_slip_s)]
        ends = [min([onset + slide_s, *(s for s in stops if s > onset)]) for onset in onsets]
        cut["sliding_s"] = tuple(zip(onsets, ends, strict=True))
    if truth.label is not None:
        cut["slip_s" if truth.label == "slip" else "non_slip_s"] = ((skip_s, duration_s),)
    cut["missing_s"] = tuple(sorted({*cut["missing_s"], *missing_s}))
    speeds = truth.speeds_mm_s if len(truth.speeds_mm_s) == len(onsets) else (0.0,) * len(onsets)
    annotated = truth.annotated_onsets_s or onsets
    return Timeline(onsets, annotated, speeds, **cut, duration_s=duration_s), []


def scaled(truth: Timeline, factor: float) -> Timeline:
    """A truth told by a clock that runs ``factor`` times as fast as the one wanted."""
    changes: dict[str, Any] = {
        name: tuple(moment * factor for moment in getattr(truth, name))
        for name in ("onsets_s", "annotated_onsets_s")
    }
    for name in SPANS:
        spans = getattr(truth, name)
        changes[name] = tuple((start * factor, end * factor) for start, end in spans)
    return replace(truth, **changes)


# What one file says -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Stream:
    """How a set of channels is read from files that do not say it.

    Args:
        name: stands before the names of channels where there are several streams; or empty.
        reading: what files do not say.
        channels: of the hand; ``None`` for what files say, of one kind.
        kind: of channels that have no row.
        adapting: of those; ``None`` as their kind does, if it is known, else slow.
        units: of samples of files that do not say it.
        speed_over: the speed in mm/s above which slip is, by the column ``reading.speed``.
    """

    name: str = ""
    reading: Reading = field(default_factory=Reading)
    channels: HandLayout | None = None
    kind: str = "electrode"
    adapting: Adapting | None = None
    units: str = "V"
    speed_over: float | None = None

    @property
    def how(self) -> Reading:
        """How to open its files: columns that are called as its channels are, are channels."""
        hand = () if self.channels is None else self.channels.names
        return replace(self.reading, hand=hand)


class _Part(NamedTuple):
    """One stream of one file.

    Args:
        clock: of its samples; one that is missing is a gap.
        is_measured: whether the rate is what its time stamps say, not stated.
        num_channels: in the file.
        hand: the channels of the stream.
        rows: of the file, in the order of the hand.
        units: of the samples.
        own: all but the samples of a file of ours.
        rate_hz: of the stream in its set; a measured one is that of the set if it is near.
        by_speed: what the speed of slip tells, if it is wanted.
        left_out: names of columns that are taken for no channels.
    """

    clock: Clock
    is_measured: bool
    num_channels: int
    hand: HandLayout
    rows: tuple[int, ...]
    units: str
    own: Archived | None
    rate_hz: float
    by_speed: Timeline | None = None
    left_out: tuple[str, ...] = ()

    @property
    def truth(self) -> Timeline:
        """What a file of ours says."""
        if self.own is None:
            return Timeline()
        told = self.own.recording
        return Timeline(**{name: getattr(told, name) for name in (*MOMENTS, *STRETCHES)})


def look(path: Path, stream: Stream, stated_hz: float | None = None) -> _Part:
    """What a file says of a stream; of its samples only times are read.

    Args:
        path: of the file.
        stream: to look for.
        stated_hz: its rate, if it was said of this file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read, its times are none of an even clock, nobody says its
            rate, or it has other channels than the stream.
    """
    with open_file(path, stream.how) as opened:
        return _part_of(opened, path, stream, stated_hz)


def _part_of(opened: Opened, path: Path, stream: Stream, stated_hz: float | None = None) -> _Part:
    samples, own = opened.samples, opened.archived
    if not samples.num_samples:
        raise ValueError(f"{path} holds no samples")
    stated = opened.sample_rate_hz
    if own is None:
        stated = stated_hz or stated or stream.reading.sample_rate_hz
    stated = stated and snapped_rate(stated)
    times, per_row = opened.times(), 1 if own else stream.reading.samples_per_row
    if times is not None:
        rows = even_clock(times, stated and stated / per_row, str(path))
    elif stated is not None:
        rows = Clock(stated / per_row, samples.num_samples // per_row)
    else:
        raise ValueError(
            f"{path} says no rate and has no times; give reading.sample_rate_hz=..., or name "
            "the column of times as reading.time=..."
        )
    try:
        hand, places = _hand_of(opened, stream)
    except ValueError as error:
        raise ValueError(f"{path} {error}") from None
    units = own.recording.units if own else stream.units
    is_measured = times is not None and stated is None
    clock = rows.times(per_row)
    rate = stated or clock.sample_rate_hz
    if not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        raise ValueError(
            f"{path} is of {rate:g} Hz, which is no sample rate of tactile sensors, 1 Hz to 1 MHz; "
            "if its times are in another unit, say reading.time_unit=s, ms, us or ns"
        )
    told = None
    if stream.speed_over is not None and opened.speed is not None:
        told = _by_speed(EvenSamples(opened.speed, rows), rows, stream)
    num, left = samples.num_channels, () if stream.channels else opened.left_out
    return _Part(clock, is_measured, num, hand, tuple(places), units, own, rate, told, left)


def _by_speed(speed: EvenSamples, clock: Clock, stream: Stream) -> Timeline:
    """What the column of speed tells of slip."""
    mm_s = speed.exact(0, speed.num_samples)[0].double() * MM_S[stream.reading.speed_unit]
    return slip_by_speed(mm_s.numpy(), clock.sample_rate_hz, stream.speed_over or 0.0)


def _hand_of(opened: Opened, stream: Stream) -> tuple[HandLayout, list[int]]:
    """The channels of a stream, and in which row of a file each of them is.

    Rows that a person gave are found by the names the file has, whatever their case and the unit
    in brackets behind them. If it has no names, or a person said which columns they are, they
    stand in that order.

    Raises:
        ValueError: if channels are given and the file has others, or names are none or twice.
    """
    own, every = list(opened.names or ()), list(range(opened.samples.num_channels))
    if stream.channels is not None:
        return stream.channels, _rows_of(stream.channels, own, opened, stream)
    if opened.archived is not None:
        return opened.archived.hand, every
    adapting = stream.adapting or KNOWN_KINDS.get(stream.kind, "slow")
    before = f"{stream.name}_" if stream.name else ""
    names = [before + name for name in own or [f"ch{number + 1}" for number in every]]
    channels = [Channel(name, stream.kind, _NOWHERE, _NOWHERE, adapting) for name in names]
    return HandLayout(tuple(channels)), every


def _rows_of(hand: HandLayout, own: Sequence[str], opened: Opened, stream: Stream) -> list[int]:
    """In which row of a file each channel of a hand is."""
    places = [place_of(name, own) for name in hand.names]
    rows = [place for place in places if place is not None]
    if len(rows) == len(hand) == len(set(rows)):
        return rows
    num, is_ours = opened.samples.num_channels, opened.archived is not None
    is_ordered = not own or (not is_ours and stream.reading.channels is not None)
    if is_ordered and len(hand) == num:
        return list(range(num))
    has = _some(own) if own else f"{num} without names"
    if rows and not is_ordered:
        lacking = [name for name, place in zip(hand.names, places, strict=True) if place is None]
        what = f"no channel {_some(lacking)}" if lacking else "a column that is two channels"
        raise ValueError(f"has {what} of data.channels; it has {has}")
    how = "; name its columns so, or list them in the order of the hand as reading.channels"
    raise ValueError(
        f"has the channels {has}, not the {len(hand)} of data.channels, "
        f"{_some(hand.names)}{'' if is_ordered or is_ours else how}"
    )


def place_of(name: str, own: Sequence[str]) -> int | None:
    """Where a name stands among others: as it is written or, if one alone is alike, by that."""
    if name in own:
        return list(own).index(name)
    alike = [place for place, other in enumerate(own) if bare(other) == bare(name)]
    return alike[0] if len(alike) == 1 else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 7 else f"{', '.join(names[:5])} .. {names[-1]}"


# Samples as they are wanted ---------------------------------------------------------------------


class EvenSamples(Samples):
    """Samples of a file on an even clock.

    Args:
        samples: of the file.
        clock: of its times.
        most_bridged: gaps of at most so many samples are crossed by a straight line; others are
            NaN.
        rows: of the file, that are wanted; ``None`` for all.

    Attributes:
        level: that is taken off each channel, ``[C, 1]``, if any is.
    """

    def __init__(
        self,
        samples: Samples,
        clock: Clock,
        most_bridged: int = 0,
        rows: Sequence[int] | None = None,
    ) -> None:
        self.num_samples, self.dtype = clock.num_samples, samples.dtype
        self.num_channels = samples.num_channels if rows is None else len(rows)
        self._inner, self._most, self._wanted = samples, most_bridged, rows
        self.level: Tensor | None = None
        self._gaps = clock.gaps
        edges = [(gap.start, gap.missing) for gap in clock.gaps]
        self._starts, missing = np.array([(0, 0), *edges]).T
        self._lost = missing.cumsum()  # samples, up to the end of each gap
        self._ends = self._starts + missing

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop`` on the clock, ``[C, n]``."""
        return self.exact(first, stop).to(self.dtype)

    def exact(self, first: int, stop: int) -> Tensor:
        """The same, in float64 if a level is taken off."""
        ticks = np.arange(max(first, 0), min(stop, self.num_samples))
        behind = np.searchsorted(self._starts, ticks, "right") - 1  # the gap before each
        is_there = ticks >= self._ends[behind]
        places = (ticks - self._lost[behind])[is_there]  # in the file, one after the other
        found = torch.full((self._inner.num_channels, len(ticks)), torch.nan, dtype=self.dtype)
        if len(places):
            read = self._inner.read(int(places[0]), int(places[-1]) + 1)
            found[:, slice(None) if is_there.all() else torch.from_numpy(is_there)] = read
        for number in np.unique(behind[~is_there]):
            gap = self._gaps[number - 1]
            if gap.missing <= self._most:
                within = torch.from_numpy(~is_there & (behind == number))
                found[:, within] = self._line(gap, torch.from_numpy(ticks)[within])
        found = found if self._wanted is None else found[list(self._wanted)]
        return found if self.level is None else found - self.level

    def _line(self, gap: Gap, ticks: Tensor) -> Tensor:
        """The straight line across a gap, at those ticks of it."""
        ends = self._inner.read(gap.place - 1, gap.place + 1).double()
        weight = (ticks.double() - (gap.start - 1)) / (gap.missing + 1)
        return (ends[:, :1] + (ends[:, 1:] - ends[:, :1]) * weight).to(self.dtype)


def _of_hand(
    opened: Opened,
    path: Path,
    part: _Part,
    tare_s: Sequence[float] | None = None,
    most_bridged: int = 0,
) -> EvenSamples:
    """Samples of an open file as a hand has them; NaN in gaps that are not bridged.

    Raises:
        ValueError: if the file is not what it was when it was looked at, ends before the stretch
            that is tared on, or has nothing finite there.
    """
    clock, found = part.clock, opened.samples
    missing = sum(gap.missing for gap in clock.gaps)
    shape = found.num_channels, found.num_samples + missing
    if shape != (part.num_channels, clock.num_samples):
        raise ValueError(f"{path} has changed since it was looked at; start again")
    samples = EvenSamples(found, clock, most_bridged, part.rows)
    if tare_s is None:
        return samples
    first, stop = (round(moment * part.rate_hz) for moment in tare_s)
    if not first < stop <= samples.num_samples:
        raise ValueError(
            f"{path} has {samples.num_samples} samples, too few for tare_s={list(tare_s)}"
        )
    read = samples.read(first, stop).double()
    level = read.where(read.isfinite(), torch.nan).nanmean(-1, keepdim=True)
    broken = level.isnan().flatten().nonzero().flatten().tolist()
    if broken:
        raise ValueError(
            f"{path} has nothing finite in its column {part.rows[broken[0]] + 1} to tare on from "
            f"{tare_s[0]:g} to {tare_s[1]:g} s; give another tare_s"
        )
    samples.level = level
    return samples


def _tare_of(value: object, name: str) -> Stretch | None:
    """The stretch that is tared on, as somebody said it.

    Raises:
        ValueError: naming the setting, if that is no start and end of a stretch.
    """
    if value is None:
        return None
    parts = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else []
    are_numbers = len(parts) == 2 and all(type(part) in (int, float) for part in parts)
    if not are_numbers or not 0 <= parts[0] < parts[1] < math.inf:
        raise ValueError(f"{name} must be [start, end] in seconds, got {parts or value!r}")
    return float(parts[0]), float(parts[1])


@contextmanager
def hand_file(
    path: Path,
    hand: HandLayout,
    sample_rate_hz: float,
    reading: Reading,
    units: str,
    tare_s: Sequence[float] | None = None,
) -> Iterator[Opened]:
    """Open a recording of a hand, ours or another's, to watch it by stretches.

    Its samples are those of the hand's channels; NaN where time stamps show a gap.

    Args:
        path: of the file.
        hand: its channels; a file that names them all may have them in another order, and more.
        sample_rate_hz: that is wanted.
        reading: what the file does not say.
        units: that are wanted; of a file that does not say its own, they are taken for granted.
        tare_s: start and end of the stretch whose mean is taken off each channel, as it was for
            training.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, of another hand, rate or unit, or nobody says its rate.
    """
    tare = _tare_of(tare_s, "tare_s")
    stream = Stream(reading=reading, channels=hand, units=units)
    with open_file(path, stream.how) as opened:
        own, num = opened.archived, opened.samples.num_channels
        if (own or (opened.names is None and reading.channels is None)) and num != len(hand):
            raise ValueError(f"{path} has {num} channels, not {len(hand)}")
        theirs = own.hand.channels if own else hand.channels
        for place, (found, wanted) in enumerate(zip(theirs, hand.channels, strict=True), 1):
            if (found.name, found.kind) != (wanted.name, wanted.kind):
                raise ValueError(
                    f"channel {place} of {path} is {found.name} ({found.kind}), not {wanted.name} "
                    f"({wanted.kind}); give recordings of the detector's hand"
                )
        part = _part_of(opened, path, stream)
        error = abs(part.rate_hz / sample_rate_hz - 1)
        if error > (_WANTED_RATE_ERROR if part.is_measured else 0.0):
            raise ValueError(
                f"{path} is of {part.rate_hz:g} Hz, the detector of {sample_rate_hz:g} Hz; "
                "resample it"
            )
        if part.units != units:
            raise ValueError(
                f"{path} is in {part.units}, the detector was trained on {units}; give it "
                f"recordings in {units}, or train one on {part.units}"
            )
        part = part._replace(rate_hz=sample_rate_hz)
        yield opened._replace(samples=_of_hand(opened, path, part, tare))


# What all files must agree in -------------------------------------------------------------------

_Value = TypeVar("_Value", bound=Hashable)


def _with_rates(parts: Sequence[_Part]) -> list[_Part]:
    """The parts with rates that time stamps tell as one, as round as it can be."""
    measured = [part.rate_hz for part in parts if part.is_measured]
    stated = [part.rate_hz for part in parts if not part.is_measured]
    if not measured:
        return list(parts)
    middle = median(measured)
    apart = [abs(own / middle - 1) for own in measured]
    spread = max((off for off in apart if off <= _RATE_ERROR), default=0.0)
    common = Counter(stated).most_common(1)[0][0] if stated else nominal_rate(middle, spread)
    return [
        part._replace(rate_hz=common)
        if part.is_measured and abs(part.rate_hz / common - 1) <= _RATE_ERROR
        else part
        for part in parts
    ]


def _differences(
    parts: Sequence[_Part], places: Sequence[str], *, any_rate: bool
) -> list[str | None]:
    """Of each file in what it differs from most of the others; ``None`` where it does not.

    Of rates the first file that differs says all, the others are empty.

    Args:
        parts: the same stream of every file.
        places: of the files, for what is said of them.
        any_rate: whether rates may differ, since all are resampled.
    """
    hand, at_hand = _most([part.hand for part in parts], places)
    rate, at_rate = _most([part.rate_hz for part in parts], places)
    units, at_units = _most([part.units for part in parts], places)
    others = Counter(part.rate_hz for part in parts if part.rate_hz != rate and part.hand == hand)
    found: list[str | None] = []
    is_said = False
    for part in parts:
        what = None
        if part.hand != hand:
            what = f"{_difference(part.hand, hand)} as in {at_hand}"
        elif part.rate_hz != rate and not any_rate:
            counts = ", ".join(f"{count} of {hz:g} Hz" for hz, count in others.items())
            all_of_them = f" (in all {counts})" if others.total() > 1 else ""
            what = (
                f"is of {part.rate_hz:g} Hz, {at_rate} of {rate:g} Hz{all_of_them}; "
                "data.resample_hz=... brings all to one"
            )
            what, is_said = "" if is_said else what, True
        elif part.units != units:
            what = f"is in {part.units}, {at_units} in {units}"
        found.append(what)
    return found


def _most(values: Sequence[_Value], places: Sequence[str]) -> tuple[_Value, str]:
    """What most have, and who: where it is found first, and whether that is more than half."""
    most, count = Counter(values).most_common(1)[0]
    others = " and most others" if 2 * count > len(values) else ""
    return most, f"{places[values.index(most)]}{others}"


def _difference(own: HandLayout, others: HandLayout) -> str:
    """The first difference between channels."""
    if len(own) != len(others):
        return f"has {len(own)} channels, not {len(others)}"
    place = next(i for i in range(len(own)) if own.channels[i] != others.channels[i])
    one, other = own.channels[place], others.channels[place]
    if one.name != other.name:
        return f"has {one.name} as channel {place + 1}, not {other.name}"
    return f"has {one.name} of another kind or place, {one.to_row()}, not {other.to_row()}"


# All files of a set -----------------------------------------------------------------------------


class _File(NamedTuple):
    """A recording that can be read: each of its streams, and when things happen in it."""

    entry: Entry
    parts: tuple[_Part, ...]
    times: Timeline


def _doubts(recording: _File) -> list[str]:
    """What is worth a look in a recording that can be read."""
    entry, parts, times = recording
    doubts = []
    if not (times.onsets_s or times.slip_s or times.non_slip_s):
        doubts.append("has no label, so no bin is taken from it")
    if times.onsets_s and times.onsets_s[0] < _BEFORE_ONSET_S:
        doubts.append(
            f"slips at {times.onsets_s[0]:g} s already; labels=whole_slide takes as non-slip the "
            "second before an onset, as far as it was recorded"
        )
    for part in parts:
        if part.left_out:
            doubts.append(
                f"has columns that are taken for no channels, {_some(part.left_out)}; if they are, "
                "list all channels as reading.channels"
            )
        if gaps := part.clock.gaps:
            lost = sum(gap.missing for gap in gaps)
            first_s = gaps[0].start / part.rate_hz
            doubts.append(f"lacks {lost} samples in {len(gaps)} gaps, first at {first_s:.4g} s")
        if part.clock.jitter_s * part.rate_hz > 1:
            doubts.append(
                f"has times that are early or late by {1000 * part.clock.jitter_s:.3g} ms; "
                "samples are taken as even"
            )
    own, material = parts[0].own, entry.recording.material
    if own and own.recording.material != material:
        doubts.append(f"itself says {own.recording.material!r}, not {material!r}")
    return doubts


class FileRecordings:
    """A ``RecordingSource`` of the files of a folder.

    Times are seconds from a file's first sample. Streams of one file are taken to begin together.
    Where time stamps tell rates, those of all files are taken as one, as round as it can be, and
    the truth follows each file's own clock.

    Args:
        root: the folder.
        manifest: the list of its recordings, relative to the folder; ``None`` for
            ``manifest.csv`` or ``manifest.yaml`` there. Or a listing that was made otherwise.
        materials: those wanted; ``None`` for all.
        cycles: of each material and scene the first so many trials; ``None`` for all.
        channels: rows for ``HandLayout.from_rows``; ``None`` for what files say.
        kind: of channels of files that do not say it.
        adapting: of those; ``None`` as their kind does, if it is known, else slow.
        units: of samples of files that do not say it.
        reading: as ``Reading`` has it, of files that do not say it.
        gaps: ``"refuse"`` files in which samples are missing, let them be ``"missing"`` (bins that
            need them are left out), or ``"bridge"`` short gaps by a straight line.
        bridge_ms: the longest gap that is bridged; longer ones are missing.
        resample_hz: the rate that all files are brought to; ``None`` for their own.
        tare_s: start and end of the stretch whose mean is taken off each channel.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
        speed_over: the speed in mm/s above which slip is, by the column ``reading.speed`` (see
            ``labels.slip_by_speed``), of recordings of which the manifest says nothing.
        streams: by name, sets of channels of each file that have a ``reading``, ``channels``,
            ``kind``, ``adapting`` or ``units`` of their own; ``None`` for one.
        skip_failed: leave out files that cannot be read or differ, with a warning each.
        strict: refuse a set with problems; else they are in ``problems``, and what is fine is
            in ``ids``.

    Attributes:
        problems: what was found wrong, each with its place.
        warnings: what is worth a look.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if a value cannot be, or the set has problems: the first few, and how many.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        manifest: str | Listing | None = None,
        materials: Sequence[str] | None = None,
        cycles: int | None = None,
        channels: Iterable[Mapping[str, str]] | None = None,
        kind: str = "electrode",
        adapting: Adapting | None = None,
        units: str = "V",
        reading: Mapping[str, Any] | None = None,
        gaps: GapRule = "refuse",
        bridge_ms: float = 10.0,
        resample_hz: float | None = None,
        tare_s: Sequence[float] | None = None,
        skip_s: float = 0.0,
        slide_s: float = 0.5,
        speed_over: float | None = None,
        streams: Mapping[str, Mapping[str, Any]] | None = None,
        skip_failed: bool = False,
        strict: bool = True,
    ) -> None:
        self.root = Path(root)
        shared = {"channels": channels, "kind": kind, "adapting": adapting, "units": units}
        if speed_over is not None:
            check_number("labels.speed_over", speed_over)
        self.speed_over = speed_over
        self._streams = _streams_of({**shared, "speed_over": speed_over}, reading, streams)
        if speed_over is not None and all(s.reading.speed is None for s in self._streams):
            raise ValueError(
                f"labels.speed_over={speed_over:g} needs the column of speed: "
                "data.reading.speed=NAME"
            )
        self._tare_s = _tare_of(tare_s, "data.tare_s")
        check_choice("data.gaps", gaps, get_args(GapRule))
        check_number("data.skip_s", skip_s, least=0)
        check_number("data.slide_s", slide_s, least=0)
        check_number("data.bridge_ms", bridge_ms)
        if resample_hz is not None:
            check_number("data.resample_hz", resample_hz)
        self._gaps, self._bridge_ms, self._resample_hz = gaps, bridge_ms, resample_hz
        self._skip_s, self._slide_s = skip_s, slide_s
        if not isinstance(manifest, Listing):
            manifest = read_manifest(manifest_of(self.root, manifest), self.root)
        self._files: dict[RecordingId, _File] = {}
        problems, warnings = self._look_at_all(_chosen(manifest.entries, materials, cycles))
        self.problems = (*manifest.problems, *problems)
        self.warnings = (*manifest.warnings, *warnings)
        self.ids = tuple(self._files)
        if strict:
            self._refuse(manifest.problems if skip_failed else self.problems)
            for problem in problems:
                log.warning("left out: %s", problem)
            if not self.ids:
                raise ValueError(f"no recording of {self.root} is left: {self.problems[0]}")

    def _look_at_all(self, entries: Sequence[Entry]) -> tuple[list[Problem], list[Problem]]:
        """Look at every file; those that can be read and agree with most others are kept.

        Returns:
            The problems of those that are left out, and what is worth a look in the others.

        Raises:
            ValueError: if streams of several rates are not to be resampled.
        """
        looked: Iterable[tuple[_Part, ...] | str] = map(self._look_at, entries)
        if len(entries) > _FEW:
            looked = in_processes(self._look_at, entries, "looking at files", "file")
        found = list(looked)
        wrong = [[what] if isinstance(what, str) else [] for what in found]
        seen = [number for number, what in enumerate(found) if not isinstance(what, str)]
        places = [entries[number].place for number in seen]
        streams = [_with_rates(parts) for parts in zip(*(found[n] for n in seen), strict=True)]
        for parts in streams:
            differences = _differences(parts, places, any_rate=self._resample_hz is not None)
            for number, what in zip(seen, differences, strict=True):
                if what is not None and what not in wrong[number]:
                    wrong[number].append(what)
        warnings: list[Problem] = []
        for number, *own in zip(seen, *streams, strict=True):
            if not wrong[number]:
                entry = entries[number]
                file, wrong[number] = self._timed(entry, tuple(own))
                if not wrong[number]:
                    self._files.setdefault(entry.recording, file)
                    warnings += map(entry.problem, _doubts(file))
        problems = [
            problem
            for entry, each in zip(entries, wrong, strict=True)
            for problem in map(entry.problem, filter(None, each))
        ]
        rates = [part.rate_hz for part in self._any.parts] if self._files else []
        if self._resample_hz is None and len(set(rates)) > 1:
            named = zip(self._streams, rates, strict=True)
            told = ", ".join(f"{stream.name} has {rate:g} Hz" for stream, rate in named)
            raise ValueError(f"the streams must be brought to one rate, {told}: resample_hz=...")
        return problems, warnings

    def _look_at(self, entry: Entry) -> tuple[_Part, ...] | str:
        """What the file of an entry says of each stream, or why it cannot be read."""
        path = self.root / entry.file
        try:
            return tuple(look(path, stream, entry.sample_rate_hz) for stream in self._streams)
        except (ValueError, OSError) as error:
            return str(error).replace(f"{self.root}{os.sep}", "")

    def _timed(self, entry: Entry, parts: tuple[_Part, ...]) -> tuple[_File, list[str]]:
        """A recording with its truth on its time, and what does not fit."""
        wrong, missing_s = [], []
        for part in parts:
            if self._resample_hz is not None:
                try:  # refuses ratios that cannot be
                    resample(torch.zeros(1, 1), part.rate_hz, self._resample_hz)
                except ValueError as error:
                    wrong.append(str(error))
            if self._gaps == "refuse" and (gaps := part.clock.gaps):
                wrong.append(
                    f"{sum(gap.missing for gap in gaps)} samples are missing in {len(gaps)} gaps, "
                    f"first {gaps[0].missing} at {gaps[0].start / part.clock.sample_rate_hz:.4f} "
                    "s; give gaps=missing, or gaps=bridge with bridge_ms"
                )
            missing_s += self._missing_s(part)
        ends_s = [self._num_recorded(part) / (self._resample_hz or part.rate_hz) for part in parts]
        duration_s = min(ends_s)
        if max(ends_s) - duration_s > _MOST_CUT_S:
            wrong.append(
                f"its streams last {duration_s:.4g} to {max(ends_s):.4g} s; cut the longer one"
            )
        if self._tare_s is not None:
            first_s, last_s = self._tare_s
            if last_s > duration_s:
                wrong.append(f"lasts {duration_s:.4g} s, tare_s wants {last_s:g} s")
            if any(start <= first_s and last_s <= end for start, end in missing_s):
                wrong.append(f"nothing is there to tare on from {first_s:g} to {last_s:g} s")
        by_speed = next((part.by_speed for part in parts if part.by_speed), None)
        truth = entry.truth or by_speed or parts[0].truth
        pace = parts[0].clock.sample_rate_hz / parts[0].rate_hz
        if parts[0].is_measured and abs(pace - 1) > _ROUNDING:  # a person read the file's own times
            truth = scaled(truth, pace)
        times, misfits = on_time(
            truth,
            duration_s,
            skip_s=self._skip_s,
            slide_s=self._slide_s,
            slack_s=math.inf if entry.is_nominal or by_speed else 1.0 / parts[0].rate_hz,
            missing_s=missing_s,
        )
        return _File(entry, parts, times), [*wrong, *misfits]

    def _num_recorded(self, part: _Part) -> int:
        """How many samples of a stream the recording has."""
        num = part.clock.num_samples
        if self._resample_hz is None:
            return num
        return int(num * self._resample_hz / part.rate_hz + 1e-6)

    def _most_bridged(self, rate_hz: float) -> int:
        """The most samples of a gap that is bridged."""
        return int(self._bridge_ms * rate_hz / 1000 + 1e-6) if self._gaps == "bridge" else 0

    def _missing_s(self, part: _Part) -> list[Stretch]:
        """The stretches without samples, wider by what resampling draws from them."""
        rate_hz, most = part.rate_hz, self._most_bridged(part.rate_hz)
        reach_s = _REACH / min(rate_hz, self._resample_hz) if self._resample_hz else 0.0
        return [
            (max(gap.start / rate_hz - reach_s, 0.0), (gap.start + gap.missing) / rate_hz + reach_s)
            for gap in part.clock.gaps
            if gap.missing > most
        ]

    @property
    def hand(self) -> HandLayout:
        """The channels of every recording: those of all streams, one after the other."""
        return HandLayout(tuple(c for part in self._any.parts for c in part.hand.channels))

    @property
    def sample_rate_hz(self) -> float:
        """Of every recording."""
        return float(self._resample_hz or self._any.parts[0].rate_hz)

    @property
    def units(self) -> str:
        """Of every sample; of streams with several, all of them."""
        return ", ".join(dict.fromkeys(part.units for part in self._any.parts))

    @property
    def is_simulated(self) -> bool:
        """Whether any file says that it comes from a simulation."""
        owns = [part.own for file in self._files.values() for part in file.parts]
        return any(own.recording.provenance.get("simulated") for own in owns if own)

    def entry(self, recording: RecordingId) -> Entry:
        """Where a recording is, and what was said of it."""
        return self._files[recording].entry

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen in a recording; nothing is read for it."""
        return self._files[recording].times

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """What determines the samples: what the file holds, not its name, and how it is read."""
        one = self._files[recording]
        return {
            "sha256": file_digest(self.root / one.entry.file),
            "channels": self.hand.to_rows(),
            "treatment": {
                "gaps": self._gaps,
                "bridge_ms": self._bridge_ms,
                "resample_hz": self._resample_hz,
                "tare_s": self._tare_s,
            },
            "streams": [
                {"reading": stream.reading.key(), "rows": part.rows, "rate_hz": part.rate_hz}
                for stream, part in zip(self._streams, one.parts, strict=True)
            ],
        }

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Read a recording, or the stretches of it that are asked for.

        What is resampled is read whole; of the rest no more than the windows and what is tared on.

        Raises:
            FileNotFoundError: if its file is gone.
            ValueError: if it is damaged, or has changed.
        """
        one = self._files[recording]
        times, own = one.times, one.parts[0].own
        num_samples = round(times.duration_s * self.sample_rate_hz)
        return Recording(
            torch.cat([part[:, :num_samples] for part in self._read(one, windows)]),
            self.sample_rate_hz,
            recording.material,
            **{name: getattr(times, name) for name in (*MOMENTS, *STRETCHES)},
            provenance=own.recording.provenance
            if own
            else {"simulated": False, "file": one.entry.file},
            units=self.units,
        )

    def _read(self, one: _File, windows: Sequence[tuple[float, float]] | None) -> Iterator[Tensor]:
        """The samples of each stream as the recording has them, NaN outside of windows."""
        wanted_hz = self._resample_hz
        for part, samples in self._opened(one, self._tare_s):
            rate_hz, num = part.rate_hz, samples.num_samples
            if wanted_hz is not None and wanted_hz != rate_hz:
                even = resample(samples.exact(0, num).double(), rate_hz, wanted_hz)
                yield even[:, : self._num_recorded(part)].to(samples.dtype)
                continue
            kept = torch.full((samples.num_channels, num), torch.nan, dtype=samples.dtype)
            for start, end in windows if windows is not None else [(0.0, num / rate_hz)]:
                first, stop = math.floor(start * rate_hz), math.ceil(end * rate_hz)
                first, stop = max(first, 0), min(stop, num)
                kept[:, first:stop] = samples.read(first, stop)
            yield kept

    def _opened(
        self, one: _File, tare_s: Stretch | None = None
    ) -> Iterator[tuple[_Part, EvenSamples]]:
        """Each stream of a recording with its samples, open until the next."""
        path = self.root / one.entry.file
        for stream, part in zip(self._streams, one.parts, strict=True):
            with open_file(path, stream.how) as opened:
                most = self._most_bridged(part.rate_hz)
                yield part, _of_hand(opened, path, part, tare_s, most)

    def inspect(self, recording: RecordingId) -> Inspected:
        """All samples of a recording looked at once, by stretches, as they stand in its file.

        Raises:
            FileNotFoundError: if its file is gone.
            ValueError: if it is damaged.
        """
        one = self._files[recording]
        found = Inspected([], [], {})
        for part, samples in self._opened(one):
            rate_hz, above = part.rate_hz, len(found.least)
            low = torch.full((samples.num_channels,), torch.inf, dtype=torch.float64)
            high = -low
            is_missing = torch.zeros(samples.num_samples, dtype=torch.bool)
            for start_s, end_s in one.times.missing_s:
                is_missing[round(start_s * rate_hz) : round(end_s * rate_hz)] = True
            for number, piece in enumerate(pieces(samples, _PIECE)):
                seen = number * _PIECE
                is_fine, values = piece.isfinite(), piece.double()
                low = torch.minimum(low, values.where(is_fine, torch.inf).amin(-1))
                high = torch.maximum(high, values.where(is_fine, -torch.inf).amax(-1))
                is_bad = ~is_fine & ~is_missing[seen : seen + piece.shape[-1]]
                for row in is_bad.any(-1).nonzero().flatten().tolist():
                    first_s = (seen + int(is_bad[row].int().argmax())) / rate_hz
                    count, first_s = found.broken.get(above + row, (0, first_s))
                    found.broken[above + row] = count + int(is_bad[row].sum()), first_s
            is_known = low <= high
            found.least.extend(low.where(is_known, torch.nan).tolist())
            found.greatest.extend(high.where(is_known, torch.nan).tolist())
        return found

    @property
    def _any(self) -> _File:
        for one in self._files.values():
            return one
        raise ValueError(f"no recording of {self.root} can be read: {self.problems[0]}")

    def _refuse(self, problems: Sequence[Problem]) -> None:
        if problems:
            shown = "; ".join(map(str, problems[:_MOST_SHOWN]))
            more = len(problems) - _MOST_SHOWN
            rest = f"; and {more} more" if more > 0 else ""
            raise ValueError(
                f"{len(problems)} problem{'s' * (len(problems) > 1)} in {self.root}: {shown}{rest} "
                "(python -m tactslip_torch data action=check lists them by line)"
            )


class Inspected(NamedTuple):
    """What the samples of a recording are, as they stand in its file.

    Args:
        least: of each channel, in the order of the hand; NaN if none of it is finite.
        greatest: the same.
        broken: of each channel that has any, how many samples are not finite, missing ones apart,
            and when the first of them is, in seconds.
    """

    least: list[float]
    greatest: list[float]
    broken: dict[int, tuple[int, float]]

    def oddities(self, names: Sequence[str]) -> list[str]:
        """What in the samples is worth a look, a line each; ``names`` are those of the channels."""
        odd = [
            f"{names[row]} is not finite in {count} samples, first at {first_s:.4f} s; leave the "
            "stretch out as missing_s, or repair it"
            for row, (count, first_s) in sorted(self.broken.items())
        ]
        ranges = zip(names, self.least, self.greatest, strict=True)
        still = [(name, least) for name, least, greatest in ranges if least == greatest]
        return odd + [f"{name} never changes, it is {value:g} throughout" for name, value in still]


def _streams_of(
    shared: Mapping[str, Any],
    reading: Mapping[str, Any] | None,
    streams: Mapping[str, Mapping[str, Any]] | None,
) -> tuple[Stream, ...]:
    """The streams of a set: what is said of all of them, and over it what is said of one.

    Raises:
        ValueError: for a key or value that is none.
    """
    if not isinstance(reading, Mapping | None):
        raise ValueError(f"data.reading must be what is said of files, got {reading!r}")
    each = {"": {}} if streams is None else streams
    if not isinstance(each, Mapping) or not all(isinstance(own, Mapping) for own in each.values()):
        raise ValueError(
            "data.streams must be sets of channels by name, each with a reading, channels, kind, "
            f"adapting or units of its own, got {streams!r}"
        )
    made = []
    options = [one.name for one in fields(Stream) if one.name not in ("name", "speed_over")]
    for name, own in each.items():
        if unknown := set(own) - set(options):
            raise ValueError(f"a stream has {', '.join(options)}, got {', '.join(sorted(unknown))}")
        given = {**shared, **own}
        given["reading"] = Reading.of({**(reading or {}), **(own.get("reading") or {})})
        made.append(Stream(name, **given | {"channels": _hand_from(given["channels"])}))
    return tuple(made)


def _hand_from(rows: object) -> HandLayout | None:
    """The channels that a person gave, if any."""
    if rows is None:
        return None
    listed: list[Any] = list(rows) if isinstance(rows, Iterable) else [rows]
    if not all(isinstance(row, Mapping) for row in listed):
        raise ValueError(
            "data.channels must be a list of rows of name, kind, finger, segment and adapting, "
            f"got {rows!r}"
        )
    return HandLayout.from_rows(listed)


def _chosen(
    entries: Sequence[Entry], materials: Sequence[str] | None, cycles: int | None
) -> list[Entry]:
    """The entries of some materials and, of each in each scene and session, the first trials.

    Raises:
        ValueError: if a material is none of the set's, or the number is none.
    """
    known = list(dict.fromkeys(entry.recording.material for entry in entries))
    unknown = [material for material in materials or () if material not in known]
    if unknown and entries:
        raise ValueError(
            f"no recording of data.materials {', '.join(unknown)}; the set has {', '.join(known)}"
        )
    if cycles is not None and not (isinstance(cycles, int) and cycles > 0):
        raise ValueError(f"data.cycles must be a number of trials or null, got {cycles!r}")
    taken: Counter[RecordingId] = Counter()
    kept = set()
    for entry in sorted(entries, key=lambda entry: entry.recording):
        group = replace(entry.recording, cycle=0)
        is_wanted = materials is None or group.material in materials
        if is_wanted and taken[group] < (cycles or math.inf):
            taken[group] += 1
            kept.add(entry)
    return [entry for entry in entries if entry in kept]
