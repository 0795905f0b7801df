"""Folders of recordings in files as one source, and single files opened for a detector.

Each file is opened once for its channels, clock and unit. The first decides what all others must
have; then ``FileRecordings`` loads recordings one by one.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tactslip_torch.data.clock import Clock, even_clock, nominal_rate, snapped_rate
from tactslip_torch.data.formats import (
    Archived,
    Opened,
    Reading,
    Samples,
    file_of,
    open_file,
    pieces,
)
from tactslip_torch.data.formats._inference import bare, is_time
from tactslip_torch.data.labels import LabelColumn, LabelRule
from tactslip_torch.data.manifest import Entry, Listing, Problem, manifest_of, read_manifest
from tactslip_torch.data.recording import (
    MOMENTS,
    STRETCHES,
    Recording,
    RecordingId,
    Stretch,
    Timeline,
    on_time,
    scaled,
)
from tactslip_torch.hand import KNOWN_KINDS, Adapting, Channel, HandLayout
from tactslip_torch.runtime import check_number, in_processes, runs_of, setting, settings_in
from tactslip_torch.signals.resampling import resample

log = logging.getLogger(__name__)

_RATES_HZ = 1.0, 1e6
"""Sample rates that are believed; beyond, times are in another unit than they are taken for."""
_RATE_ERROR = 0.01
"""By so much a rate that time stamps tell may differ from that of the set."""
_WANTED_RATE_ERROR = 0.001  # and from that of a detector, as times in seconds err
_ROUNDING = 1e-9
_BEFORE_ONSET_S = 1.01
"""What ``labels=whole_slide`` takes as non-slip before an onset."""
_REACH = 11
"""Samples of the lower rate on either side that a resampled one may hang on."""
_FEW = 16  # files that are looked at by one process


def _file_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of all files of a folder with their names.

    Of an episode: of the table that it is in, and its name. A file is read once by a process, as
    long as its size and the time of its last change stay.

    Raises:
        FileNotFoundError: if there is none.
    """
    if path.is_dir():
        inner = sorted(inner for inner in path.rglob("*") if inner.is_file())
        lines = [f"{one.relative_to(path).as_posix()}\0{_file_digest(one)}\n" for one in inner]
        return hashlib.sha256("".join(lines).encode()).hexdigest()
    if (table := file_of(path)) != path:
        return hashlib.sha256(f"{path.name}\0{_file_digest(table)}".encode()).hexdigest()
    found = path.stat()
    return _digest(str(path.absolute()), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=100_000)
def _digest(path: str, changed_ns: int, size: int) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# One file ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Given:
    """What a person says of files that do not say it.

    Args:
        reading: how files are read.
        hand: the channels; ``None`` for what files say, of one kind.
        kind: of channels that have no row.
        adapting: of those; ``None`` as their kind does, if it is known, else slow.
        units: of samples of files that do not say it.
        label: the column of labels, if there is one.
        section: of the configuration that holds ``reading``, for messages; ``""``: it is on top.
    """

    reading: Reading = field(default_factory=Reading)
    hand: HandLayout | None = None
    kind: str = "electrode"
    adapting: Adapting | None = None
    units: str = "V"
    label: LabelColumn | None = None
    section: str = ""

    @contextmanager
    def open(self, path: Path) -> Iterator[Opened]:
        """Open a file; columns that are called as channels of the hand are channels."""
        names = () if self.hand is None else self.hand.names
        how = replace(self.reading, hand=names, label=self.label)
        with settings_in(self.section), open_file(path, how) as opened:
            yield opened


class _Head(NamedTuple):
    """All of a file but its samples.

    Args:
        clock: of its samples; one that is missing is a gap.
        is_measured: whether the rate is what its time stamps say, not stated.
        rate_hz: of the samples; a measured one is that of the set if it is near.
        hand: the channels.
        rows: of the file, in the order of the hand.
        num_rows: in the file.
        units: of the samples.
        own: all but the samples of a package file.
        left_out: names of columns that are taken for no channels.
        labels: of the column that is asked for, one of each row of the clock, until they are looked
            at.
        truth: when things happen in it, as far as anybody says.
        is_labelled: whether a column says so.
        missing: start and end, in samples, of what is missing or not finite in any channel and
            cannot be bridged.
        broken: what to say of samples that are not finite.
        is_whole: whether nothing is missing, bridged or not.
    """

    clock: Clock
    is_measured: bool
    rate_hz: float
    hand: HandLayout
    rows: tuple[int, ...]
    num_rows: int
    units: str
    own: Archived | None
    left_out: tuple[str, ...] = ()
    labels: NDArray[np.float64] | None = None
    truth: Timeline = Timeline()
    is_labelled: bool = False
    missing: tuple[tuple[int, int], ...] = ()
    broken: str = ""
    is_whole: bool = False


def _head_of(opened: Opened, path: Path, given: _Given, stated_hz: float | None = None) -> _Head:
    """What an open file says; of its samples only times are read.

    Args:
        opened: the file.
        path: of it.
        given: what it does not say.
        stated_hz: its rate, if it is stated of this file.

    Raises:
        ValueError: if its times are none of an even clock, nobody says its rate, or it has other
            channels than are wanted.
    """
    samples, own = opened.samples, opened.archived
    if not samples.num_samples:
        raise ValueError(f"{path} holds no samples")
    stated = opened.sample_rate_hz
    if own is None:
        stated = stated_hz or stated or given.reading.sample_rate_hz
    stated = stated and snapped_rate(stated)
    times, per_row = opened.times(), 1 if own else given.reading.samples_per_row
    if times is not None:
        of_rows = even_clock(times, stated and stated / per_row, str(path))
    elif stated is not None:
        of_rows = Clock(stated / per_row, samples.num_samples // per_row)
    else:
        raise ValueError(
            f"{path} says no rate and has no times; give {setting('reading.sample_rate_hz')}=..., "
            f"or name the column of times as {setting('reading.time')}=..."
        )
    try:
        hand, rows = _hand_of(opened, given)
    except ValueError as error:
        raise ValueError(f"{path} {error}") from None
    clock = of_rows.times(per_row)
    rate = stated or clock.sample_rate_hz
    if not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        raise ValueError(
            f"{path} is of {rate:g} Hz; tactile sensors have 1 Hz to 1 MHz: "
            f"if its times are in another unit, say {setting('reading.time_unit')}=s, ms, us or ns"
        )
    return _Head(
        clock,
        times is not None and stated is None,
        rate,
        hand,
        tuple(rows),
        samples.num_channels,
        own.recording.units if own else given.units,
        own,
        () if given.hand else opened.left_out,
        None if opened.labels is None else _labels_on(of_rows, opened.labels, given.reading),
    )


def _labels_on(clock: Clock, labels: Samples, reading: Reading) -> NDArray[np.float64]:
    """The labels of rows on an even clock; in a gap that is bridged the nearest, in others NaN."""
    found = np.full(clock.num_samples, np.nan)
    found[~_gaps_on(clock)] = labels.stored(0, labels.num_samples)[0].astype(np.float64)
    for start, missing, _ in clock.gaps:
        if missing <= _most_bridged(reading, clock.sample_rate_hz):
            half = start + (missing + 1) // 2
            found[start:half] = found[start - 1]
            found[half : start + missing] = found[start + missing]
    return found


def _hand_of(opened: Opened, given: _Given) -> tuple[HandLayout, Sequence[int]]:
    """The channels of a file, and in which row of it each of them is.

    Channels that a person gave are found by the names the file has, whatever their case and the
    unit in brackets behind them. If it has no names, or ``reading.channels`` lists them, they
    stand in that order.

    Raises:
        ValueError: if channels are given and the file has others, or names are none or twice.
    """
    own, num, is_native = opened.names or (), opened.samples.num_channels, opened.archived
    if given.hand is None:
        if opened.archived is not None:
            return opened.archived.hand, range(num)
        adapting = given.adapting or KNOWN_KINDS.get(given.kind, "slow")
        names = own or [f"ch{number + 1}" for number in range(num)]
        channels = [Channel(name, given.kind, adapting=adapting) for name in names]
        return HandLayout(tuple(channels)), range(num)
    wanted = given.hand.names
    places = {name: place_of(name, own) for name in wanted}
    rows = [place for place in places.values() if place is not None]
    if len(rows) == len(wanted) == len(set(rows)):
        return given.hand, rows
    is_ordered = not own or (not is_native and given.reading.channels is not None)
    if is_ordered and len(wanted) == num:
        return given.hand, range(num)
    has = _some(own) if own else f"{num} without names"
    if rows and not is_ordered:
        lacking = [name for name, place in places.items() if place is None]
        what = f"no channel {_some(lacking)}" if lacking else "one column for two channels"
        raise ValueError(f"has {what} of data.channels; it has {has}")
    how = (
        "; name its columns so, or list them in the order of the hand as "
        f"{setting('reading.channels')}"
    )
    raise ValueError(
        f"has the channels {has}, not the {len(wanted)} of data.channels, "
        f"{_some(wanted)}{'' if is_ordered or is_native else how}"
    )


def place_of(name: str, own: Sequence[str]) -> int | None:
    """Where a name stands among others: as it is written or, if one alone is alike, by that."""
    if name in own:
        return list(own).index(name)
    alike = [place for place, other in enumerate(own) if bare(other) == bare(name)]
    return alike[0] if len(alike) == 1 else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 7 else f"{', '.join(names[:5])} .. {names[-1]}"


class EvenSamples(Samples):
    """Samples of a file on an even clock, read by stretches.

    Args:
        samples: of the file.
        clock: of its times.
        most_bridged: gaps and samples that are not finite, of at most so many in a channel, are
            crossed by a straight line; in other gaps is NaN.
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
        all_rows = list(range(samples.num_channels))
        wanted = all_rows if rows is None else list(rows)
        self._rows = None if wanted == all_rows else wanted
        self.num_channels = len(wanted)
        self._inner = samples
        self.level: Tensor | None = None
        self._gaps, self._most_bridged = clock.gaps, most_bridged
        self._starts = [gap.start for gap in clock.gaps]

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop`` on the clock, ``[C, n]``."""
        return self.exact(first, stop).to(self.dtype)

    def exact(self, first: int, stop: int) -> Tensor:
        """The same, in float64 if a level is taken off."""
        first = min(max(first, 0), self.num_samples)
        stop = min(max(stop, first), self.num_samples)
        beside = self._most_bridged + 1 if self._most_bridged else 0  # what a line is drawn through
        start = max(first - beside, 0)
        found = self._on_clock(start, min(stop + beside, self.num_samples))
        found = found if self._rows is None else found[self._rows]
        if beside:
            found = _bridged(found.clone(), self._most_bridged)[:, first - start : stop - start]
        return found if self.level is None else found - self.level

    def _on_clock(self, first: int, stop: int) -> Tensor:
        """Samples of all rows of the file, ``[C, n]``: NaN in gaps."""
        if not self._gaps:
            return self._inner.read(first, stop)
        begins, ends = self._place(first), self._place(stop)
        read = self._inner.read(begins, ends)
        found = torch.full((len(read), stop - first), torch.nan, dtype=read.dtype)
        is_there = torch.ones(stop - first, dtype=torch.bool)
        since = max(bisect_right(self._starts, first) - 1, 0)
        for gap in self._gaps[since : bisect_left(self._starts, stop)]:
            is_there[max(gap.start - first, 0) : max(gap.start + gap.missing - first, 0)] = False
        found[:, is_there] = read
        return found

    def _place(self, moment: int) -> int:
        """How many samples of the file come before a moment of the clock."""
        number = bisect_left(self._starts, moment)
        if not number:
            return moment
        gap = self._gaps[number - 1]
        return gap.place + max(moment - gap.start - gap.missing, 0)


def _gaps_on(clock: Clock) -> NDArray[np.bool_]:
    """Where samples are missing, ``[T]`` on the clock."""
    is_missing = np.zeros(clock.num_samples, dtype=bool)
    for start, missing, _ in clock.gaps:
        is_missing[start : start + missing] = True
    return is_missing


def _to_bridge(is_missing: NDArray[np.bool_], most: int) -> NDArray[np.bool_]:
    """Which missing samples of a channel, ``[T]``, lie in runs so short that they are bridged."""
    starts, stops = runs_of(is_missing).T
    is_short = (stops - starts <= most) & (starts > 0) & (stops < len(is_missing))
    change = np.zeros(len(is_missing) + 1, dtype=np.int64)
    change[starts[is_short]], change[stops[is_short]] = 1, -1
    return change.cumsum()[:-1] > 0


def _bridged(whole: Tensor, most: int) -> Tensor:
    """Samples ``[C, T]`` with a straight line across what is missing or not finite for short."""
    if not most:
        return whole
    places = np.arange(whole.shape[1])
    for row in whole:
        is_there = row.isfinite().numpy()
        if is_there.all() or not is_there.any():
            continue
        chosen = _to_bridge(~is_there, most)
        known = row.double().numpy()[is_there]
        line = np.interp(places[chosen], places[is_there], known)
        row[torch.from_numpy(chosen)] = torch.from_numpy(line).to(row.dtype)
    return whole


_PIECE = 2**16  # samples at a time


def _not_finite(samples: Samples, rows: Sequence[int]) -> dict[int, NDArray[np.int64]]:
    """Of each channel, by its place in ``rows``, the samples of the file that are not finite."""
    found: dict[int, list[NDArray[np.int64]]] = {}
    if not samples.may_lack:
        return {}
    for number, piece in enumerate(pieces(samples, _PIECE)):
        is_broken = ~piece[list(rows)].isfinite()
        for channel in is_broken.any(-1).nonzero().flatten().tolist():
            places = is_broken[channel].nonzero().flatten().numpy() + number * _PIECE
            found.setdefault(channel, []).append(places)
    return {channel: np.concatenate(parts) for channel, parts in found.items()}


def _with_missing(head: _Head, samples: Samples, reading: Reading) -> _Head:
    """What is missing in a file, or not finite, all samples looked at."""
    clock, most = head.clock, _most_bridged(reading, head.rate_hz)
    broken = _not_finite(samples, head.rows)
    gaps = _gaps_on(clock)
    is_lost = gaps & ~_to_bridge(gaps, most)
    places = np.array([gap.place for gap in clock.gaps], dtype=np.int64)
    lost_before = np.concatenate([[0], np.cumsum([gap.missing for gap in clock.gaps], dtype=int)])
    text = ""
    for channel, own in sorted(broken.items()):
        on_clock = own + lost_before[np.searchsorted(places, own, side="right")]
        is_missing = gaps.copy()
        is_missing[on_clock] = True
        is_lost |= is_missing & ~_to_bridge(is_missing, most)
        if not text:
            name, first_s = head.hand.names[channel], on_clock[0] / clock.sample_rate_hz
            num = len(broken) - 1
            more = f" (and {num} more channel{'s' * (num > 1)})" if num else ""
            text = f"{name}{more} is not finite in {len(own)} samples, first at {first_s:.4f} s"
            if len(own) == samples.num_samples:
                text = f"{name}{more} is not finite in any sample"
    stretches = [(first, stop) for first, stop in runs_of(is_lost).tolist()]
    is_whole = not (broken or clock.gaps)
    return head._replace(missing=tuple(stretches), broken=text, is_whole=is_whole)


def _even(opened: Opened, path: Path, head: _Head, reading: Reading) -> EvenSamples:
    """Samples of an open file as a hand has them, gaps bridged and tared as ``reading`` says.

    Raises:
        ValueError: if the file is not what it was when it was looked at, ends before the stretch
            that is tared on, or has nothing finite there.
    """
    clock, found = head.clock, opened.samples
    shape = found.num_channels, found.num_samples + sum(gap.missing for gap in clock.gaps)
    if shape != (head.num_rows, clock.num_samples):
        raise ValueError(f"{path} has changed since it was looked at; start again")
    most = 0 if head.is_whole else _most_bridged(reading, head.rate_hz)
    samples = EvenSamples(found, clock, most, head.rows)
    if reading.tare_s is None:
        return samples
    first, stop = (round(moment * head.rate_hz) for moment in reading.tare_s)
    if not first < stop <= samples.num_samples:
        raise ValueError(
            f"{path} has {samples.num_samples} samples, too few for tare_s={list(reading.tare_s)}"
        )
    read = samples.read(first, stop).double()
    level = read.where(read.isfinite(), torch.nan).nanmean(-1, keepdim=True)
    broken = level.isnan().flatten().nonzero().flatten().tolist()
    if broken:
        raise ValueError(
            f"{path} has nothing finite in its column {head.rows[broken[0]] + 1} to tare on from "
            f"{reading.tare_s[0]:g} to {reading.tare_s[1]:g} s; give another tare_s"
        )
    samples.level = level
    return samples


def _most_bridged(reading: Reading, rate_hz: float) -> int:
    """The most samples of a gap that is bridged."""
    return int(reading.bridge_ms * rate_hz / 1000 + 1e-6) if reading.gaps == "bridge" else 0


class _Resampled(Samples):
    """Samples brought to another rate; they are read whole."""

    def __init__(self, samples: EvenSamples, rate_hz: float, wanted_hz: float) -> None:
        whole = samples.exact(0, samples.num_samples).double()
        self._whole = resample(whole, rate_hz, wanted_hz).to(samples.dtype)
        self.num_channels, self.num_samples = self._whole.shape
        self.dtype = samples.dtype

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        return self._whole[:, first : max(stop, first)]


@contextmanager
def hand_file(
    path: Path, hand: HandLayout, sample_rate_hz: float, reading: Reading, units: str
) -> Iterator[Opened]:
    """Open a recording of a hand, native or foreign, to watch it by stretches.

    Its samples are those of the hand's channels; NaN where time stamps show a gap, unless
    ``reading`` bridges it. Of another rate, they are brought to the one that is wanted if
    ``reading.resample_hz`` is that.

    Args:
        path: of the file.
        hand: its channels; a file that names them all may have them in another order, and more.
        sample_rate_hz: that is wanted.
        reading: what the file does not say, and what is done with its samples, as it was for
            training.
        units: that are wanted; of a file that does not say its own, they are taken for granted.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged, of another hand, rate or unit, or nobody says its rate.
    """
    given = _Given(reading, hand, units=units)
    with given.open(path) as opened:
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
        head = _head_of(opened, path, given)
        error = abs(head.rate_hz / sample_rate_hz - 1)
        is_other = error > (_WANTED_RATE_ERROR if head.is_measured else 0.0)
        if is_other and reading.resample_hz != sample_rate_hz:
            raise ValueError(
                f"{path} is of {head.rate_hz:g} Hz, the detector of {sample_rate_hz:g} Hz; set "
                f"{setting('reading.resample_hz')}={sample_rate_hz:g} to resample it"
            )
        if head.units != units:
            raise ValueError(
                f"{path} is in {head.units}, the detector was trained on {units}; give it "
                f"recordings in {units}, or train one on {head.units}"
            )
        if is_other:
            known = nominal_rate(head.rate_hz) if head.is_measured else head.rate_hz
            even = _even(opened, path, head._replace(rate_hz=known), reading)
            yield opened._replace(samples=_Resampled(even, known, sample_rate_hz))
        else:
            head = head._replace(rate_hz=sample_rate_hz)
            yield opened._replace(samples=_even(opened, path, head, reading))


# A folder ---------------------------------------------------------------------------------------


class _File(NamedTuple):
    """A recording that can be read: its file, and when things happen in it."""

    entry: Entry
    head: _Head
    times: Timeline


class FileRecordings:
    """A ``RecordingSource`` of the files of a folder.

    Times are seconds from a file's first sample. The first file decides channels, rate and unit.
    Rates that time stamps show are taken as one, as round as it can be, and the truth follows each
    file's own clock.

    Args:
        root: the folder.
        manifest: the list of its recordings, relative to the folder; ``None`` for
            ``manifest.csv`` there. Or a listing that was made otherwise.
        materials: those wanted; ``None`` for all.
        cycles: of each material and scene the first so many trials; ``None`` for all.
        channels: rows for ``HandLayout.from_rows``; ``None`` for what files say.
        kind: of channels of files that do not say it.
        adapting: of those; ``None`` as their kind does, if it is known, else slow.
        units: of samples of files that do not say it.
        reading: as ``Reading`` has it.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
        label_rule: of which ``column``, ``over``, ``unit`` and ``slip`` say which column of the
            files has labels. What else is said of a recording holds as well: stretches take
            precedence, a label of all of it stands where the column is empty.
        skip_failed: leave out files that cannot be read or differ, with a warning each.
        strict: refuse a set with problems; else they are in ``problems``, and what is fine is
            in ``ids``.

    Attributes:
        problems: what was found wrong, each with its place.
        warnings: what is worth a look.

    Raises:
        FileNotFoundError: if there is no such folder or manifest.
        ValueError: if a value cannot be, or the set has problems: the first, and how many.
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
        skip_s: float = 0.0,
        slide_s: float = 0.5,
        label_rule: LabelRule | None = None,
        skip_failed: bool = False,
        strict: bool = True,
    ) -> None:
        self.root = Path(root)
        self.label_column = None if label_rule is None else label_rule.label_column
        with settings_in("data"):
            how = Reading.of(reading)
        check_number("data.skip_s", skip_s, least=0)
        check_number("data.slide_s", slide_s, least=0)
        hand = _hand_from(channels)
        self._given = _Given(how, hand, kind, adapting, units, self.label_column, "data")
        self._skip_s, self._slide_s = skip_s, slide_s
        if not isinstance(manifest, Listing):
            manifest = read_manifest(manifest_of(self.root, manifest), self.root)
        if not (manifest.entries or manifest.problems):
            raise ValueError(f"no recording of {self.root} is listed; list one or more")
        self._files: dict[RecordingId, _File] = {}
        problems, warnings = self._look_at_all(_chosen(manifest.entries, materials, cycles))
        self.problems = (*manifest.problems, *problems)
        self.warnings = (*manifest.warnings, *warnings)
        self.ids = tuple(self._files)
        if strict:
            if wrong := manifest.problems if skip_failed else self.problems:
                more = f" (the first of {len(wrong)} problems)" if len(wrong) > 1 else ""
                raise ValueError(
                    f"{wrong[0]}{more}; python -m tactslip_torch data action=check "
                    f"root={self.root} lists all by line"
                )
            for problem in problems:
                log.warning("left out: %s", problem)
            if not self.ids:
                raise ValueError(f"no recording of {self.root} is left: {self.problems[0]}")

    def _look_at_all(self, entries: Sequence[Entry]) -> tuple[list[Problem], list[Problem]]:
        """Look at every file; those that can be read and agree with the first are kept.

        Returns:
            The problems of those that are left out, and what is worth a look in the others.
        """
        looked: Iterable[_Head | str] = map(self._look_at, entries)
        if len(entries) > _FEW:
            looked = in_processes(self._look_at, entries, "looking at files", "file")
        problems: list[Problem] = []
        warnings: list[Problem] = []
        heads: list[tuple[Entry, _Head]] = []
        for entry, found in zip(entries, looked, strict=True):
            if isinstance(found, str):
                problems.append(entry.problem(found))
            else:
                heads.append((entry, found))
        rate_hz = _common_rate([head for _, head in heads])
        for entry, head in heads:
            if head.is_measured:
                is_near = abs(head.rate_hz / rate_hz - 1) <= _RATE_ERROR
                head = head._replace(rate_hz=rate_hz if is_near else nominal_rate(head.rate_hz))
            wrong = self._difference(head, *heads[0], rate_hz)
            times, misfits = (Timeline(), [wrong]) if wrong else self._timed(entry, head)
            problems += map(entry.problem, misfits)
            if not misfits:
                file = self._files.setdefault(entry.recording, _File(entry, head, times))
                warnings += map(entry.problem, _doubts(file))
        order = {entry.place: number for number, entry in enumerate(entries)}
        return sorted(problems, key=lambda problem: order[problem.place]), warnings

    def _look_at(self, entry: Entry) -> _Head | str:
        """What the file of an entry says, or why it cannot be read."""
        path = self.root / entry.file
        try:
            with self._given.open(path) as opened:
                head = _head_of(opened, path, self._given, entry.sample_rate_hz)
                head = _with_missing(head, opened.samples, self._given.reading)
                return self._with_truth(entry, head)
        except (ValueError, OSError) as error:
            return str(error).replace(f"{self.root}{os.sep}", "")

    def _with_truth(self, entry: Entry, head: _Head) -> _Head:
        """When things happen in a file: what is listed of it, its column of labels, or itself."""
        told = entry.truth
        if head.own is not None:
            known = head.own.recording
            own = Timeline(**{name: getattr(known, name) for name in (*MOMENTS, *STRETCHES)})
            if told is None or told == Timeline(missing_s=told.missing_s):
                told = own if told is None else own.joined(told)
        elif head.labels is not None and self.label_column is not None:
            rate_hz = head.clock.sample_rate_hz / self._given.reading.samples_per_row
            given = (told or Timeline()).with_slides(len(head.labels) / rate_hz, self._slide_s)
            found = self.label_column.timeline(head.labels, rate_hz, given, self._skip_s)
            return head._replace(truth=found, labels=None, is_labelled=True)
        return head._replace(truth=told or Timeline())

    def _difference(self, own: _Head, entry: Entry, first: _Head, rate_hz: float) -> str | None:
        """In what a file differs from the first, which is that of ``entry``."""
        place = entry.place
        if len(own.hand) != len(first.hand):
            return f"has {len(own.hand)} channels, not {len(first.hand)} as in {place}"
        for number, (one, other) in enumerate(
            zip(own.hand.channels, first.hand.channels, strict=True), 1
        ):
            if one.name != other.name:
                return f"has {one.name} as channel {number}, not {other.name} as in {place}"
            if one != other:
                what = f"{one.to_row()}, not {other.to_row()} as in {place}"
                return f"has {one.name} of another kind or place, {what}"
        if own.rate_hz != rate_hz and self._given.reading.resample_hz is None:
            return (
                f"is of {own.rate_hz:g} Hz, {place} of {rate_hz:g} Hz; "
                "data.reading.resample_hz=... brings all to one"
            )
        return f"is in {own.units}, {place} in {first.units}" if own.units != first.units else None

    def _timed(self, entry: Entry, head: _Head) -> tuple[Timeline, list[str]]:
        """The truth of a recording on its time, and what does not fit."""
        how, rate_hz, wrong = self._given.reading, head.rate_hz, []
        if how.resample_hz is not None:
            try:  # refuses ratios that cannot be
                resample(torch.zeros(1, 1), rate_hz, how.resample_hz)
            except ValueError as error:
                wrong.append(str(error))
        truth = head.truth
        pace = head.clock.sample_rate_hz / rate_hz
        if head.is_measured and abs(pace - 1) > _ROUNDING:  # a person read the file's own times
            truth = scaled(truth, pace)
        if how.gaps == "refuse" and not _are_within(head.missing, truth.missing_s, rate_hz):
            what = head.broken or _gaps_text(head.clock)
            wrong.append(
                f"{what}; set data.reading.gaps=missing to leave out the bins that need them, or "
                "data.reading.gaps=bridge for a straight line across short gaps"
            )
        missing_s = self._missing_s(head)
        duration_s = self._num_recorded(head) / (how.resample_hz or rate_hz)
        if how.tare_s is not None:
            first_s, last_s = how.tare_s
            if last_s > duration_s:
                wrong.append(f"lasts {duration_s:.4g} s, tare_s wants {last_s:g} s")
            if any(start <= first_s and last_s <= end for start, end in missing_s):
                wrong.append(f"nothing is there to tare on from {first_s:g} to {last_s:g} s")
        times, misfits = on_time(
            truth,
            duration_s,
            skip_s=self._skip_s,
            slide_s=self._slide_s,
            slack_s=math.inf if entry.is_nominal or head.is_labelled else 1.0 / rate_hz,
            missing_s=missing_s,
        )
        return times, [*wrong, *misfits]

    def _num_recorded(self, head: _Head) -> int:
        """How many samples the recording has."""
        num, wanted_hz = head.clock.num_samples, self._given.reading.resample_hz
        return num if wanted_hz is None else int(num * wanted_hz / head.rate_hz + 1e-6)

    def _missing_s(self, head: _Head) -> list[Stretch]:
        """The stretches without samples, wider by what resampling draws from them."""
        how, rate_hz = self._given.reading, head.rate_hz
        reach_s = _REACH / min(rate_hz, how.resample_hz) if how.resample_hz else 0.0
        return [
            (max(start / rate_hz - reach_s, 0.0), stop / rate_hz + reach_s)
            for start, stop in head.missing
        ]

    @property
    def _first(self) -> _Head:
        for one in self._files.values():
            return one.head
        raise ValueError(f"no recording of {self.root} can be read: {self.problems[0]}")

    @property
    def hand(self) -> HandLayout:
        """The channels of every recording."""
        return self._first.hand

    @property
    def sample_rate_hz(self) -> float:
        """Of every recording."""
        return float(self._given.reading.resample_hz or self._first.rate_hz)

    @property
    def units(self) -> str:
        """Of every sample."""
        return self._first.units

    @property
    def is_simulated(self) -> bool:
        """Whether any file says that it comes from a simulation."""
        owns = [file.head.own for file in self._files.values()]
        return any(own.recording.provenance.get("simulated") for own in owns if own)

    def entry(self, recording: RecordingId) -> Entry:
        """Where a recording is, and what is listed of it."""
        return self._files[recording].entry

    def timeline(self, recording: RecordingId) -> Timeline:
        """When things happen in a recording; nothing is read for it."""
        return self._files[recording].times

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """What determines the samples: what the file holds, not its name, and how it is read."""
        entry, head, _ = self._files[recording]
        return {
            "sha256": _file_digest(self.root / entry.file),
            "channels": self.hand.to_rows(),
            "reading": self._given.reading.key(),
            "rows": head.rows,
            "rate_hz": head.rate_hz,
        }

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Read a recording, or the stretches of it that are asked for; NaN outside of them.

        What is resampled is read whole; of the rest no more than the windows and what is tared on.

        Raises:
            FileNotFoundError: if its file is gone.
            ValueError: if it is damaged, or has changed.
        """
        entry, head, times = self._files[recording]
        path, how, rate_hz = self.root / entry.file, self._given.reading, head.rate_hz
        with self._given.open(path) as opened:
            samples = _even(opened, path, head, how)
            num = samples.num_samples
            if how.resample_hz is not None and how.resample_hz != rate_hz:
                kept = _Resampled(samples, rate_hz, how.resample_hz).read(
                    0, self._num_recorded(head)
                )
            else:
                kept = torch.full((samples.num_channels, num), torch.nan, dtype=samples.dtype)
                for start, end in windows if windows is not None else [(0.0, num / rate_hz)]:
                    first, stop = math.floor(start * rate_hz), math.ceil(end * rate_hz)
                    first, stop = max(first, 0), min(stop, num)
                    kept[:, first:stop] = samples.read(first, stop)
        known = head.own.recording.provenance if head.own else None
        return Recording(
            kept,
            self.sample_rate_hz,
            recording.material,
            **{name: getattr(times, name) for name in (*MOMENTS, *STRETCHES)},
            provenance={"simulated": False, "file": entry.file} if known is None else known,
            units=self.units,
        )


def _are_within(
    missing: Sequence[tuple[int, int]], told_s: Sequence[Stretch], rate_hz: float
) -> bool:
    """Whether all that is missing, in samples, lies in stretches that somebody left out."""
    return all(
        any(
            start_s * rate_hz <= start + 0.5 and stop - 0.5 <= end_s * rate_hz
            for start_s, end_s in told_s
        )
        for start, stop in missing
    )


def _gaps_text(clock: Clock) -> str:
    lost, first = sum(gap.missing for gap in clock.gaps), clock.gaps[0]
    return (
        f"{lost} samples are missing in {len(clock.gaps)} gaps, first {first.missing} at "
        f"{first.start / clock.sample_rate_hz:.4f} s"
    )


def _common_rate(heads: Sequence[_Head]) -> float:
    """The rate of a set: that of its first file, as round as the spread of measured ones allows."""
    if not heads or not heads[0].is_measured:
        return heads[0].rate_hz if heads else 0.0
    apart = [abs(head.rate_hz / heads[0].rate_hz - 1) for head in heads]
    return nominal_rate(heads[0].rate_hz, max(off for off in apart if off <= _RATE_ERROR))


def _doubts(recording: _File) -> list[str]:
    """What is worth a look in a recording that can be read."""
    entry, head, times = recording
    doubts = []
    if not times.has_stretches:
        doubts.append("has no label, so no bin is taken from it")
    if times.onsets_s and times.onsets_s[0] < _BEFORE_ONSET_S and not head.is_labelled:
        doubts.append(
            f"slips at {times.onsets_s[0]:g} s already; labels=whole_slide takes as non-slip the "
            "second before an onset, as far as it was recorded"
        )
    if head.left_out:
        doubts.append(
            f"has columns that are taken for no channels, {_some(head.left_out)}; if they are, "
            "list all channels as data.reading.channels"
            + "; labels.column=NAME reads labels from one"
            * (not all(map(is_time, head.left_out)))
        )
    if head.clock.gaps:
        doubts.append(_gaps_text(head.clock))
    if head.broken:
        doubts.append(head.broken)
    if head.clock.jitter_s * head.rate_hz > 1:
        doubts.append(
            f"has times that are early or late by {1000 * head.clock.jitter_s:.3g} ms; "
            "samples are taken as even"
        )
    material = entry.recording.material
    if head.own and head.own.recording.material != material:
        doubts.append(f"itself says {head.own.recording.material!r}, not {material!r}")
    return doubts


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
    if entries and materials is not None and (unknown or not materials):
        none = "data.materials is empty" if not materials else "no recording of data.materials "
        raise ValueError(f"{none}{', '.join(unknown)}; the set has {', '.join(known)}")
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
