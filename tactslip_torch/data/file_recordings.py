"""Folders of recordings in files as one source: looked at as a whole, refused with every reason.

Each file is opened once for its channels, clock and unit, on one clock resampled where that is
asked for, and checked against the others; what was seen is remembered. ``FileRecordings`` then
loads recordings one by one.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import math
import os
import re
import time
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from tactslip_torch.data.clock import (
    GAP_RULES,
    Clock,
    EvenSamples,
    Gap,
    GapRule,
    even_clock,
    nominal_rate,
    refuse_gaps,
    snapped_rate,
)
from tactslip_torch.data.formats import (
    Opened,
    Reading,
    Samples,
    is_number,
    open_file,
    pieces,
)
from tactslip_torch.data.manifest import (
    MOMENTS,
    STRETCHES,
    Entry,
    Listing,
    Problem,
    Stretch,
    Truth,
    manifest_of,
    read_manifest,
)
from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.hand import KNOWN_KINDS, Adapting, Channel, HandLayout
from tactslip_torch.runtime import in_processes, whole_file
from tactslip_torch.signals.resampling import resample


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of all files of a folder with their names.

    A file is read once by a process, as long as its size and the time of its last change stay.

    Raises:
        FileNotFoundError: if there is none.
    """
    if not path.is_dir():
        return _of_file(path)
    whole = hashlib.sha256()
    for inner in sorted(inner for inner in path.rglob("*") if inner.is_file()):
        whole.update(f"{inner.relative_to(path).as_posix()}\0{_of_file(inner)}\n".encode())
    return whole.hexdigest()


def _of_file(path: Path) -> str:
    found = path.stat()
    return _read(str(path.absolute()), found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=100_000)
def _read(path: str, changed_ns: int, size: int) -> str:
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class FileTimeline(Truth):
    """A truth on the time of its recording: all is known and lies inside; a ``Timeline``."""

    duration_s: float = 0.0


def on_time(
    truth: Truth,
    duration_s: float,
    *,
    skip_s: float = 0.0,
    slide_s: float = 0.5,
    slack_s: float = 0.0,
    missing_s: Iterable[Stretch] = (),
) -> tuple[FileTimeline, list[str]]:
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
    for name in STRETCHES:
        for start, end in getattr(truth, name):
            if start >= duration_s or (end > duration_s + slack_s and end != math.inf):
                span = f"{start:g}-{'end' if end == math.inf else format(end, 'g')} s"
                problems.append(f"{name}: {span} leaves the recording of {duration_s:.4g} s")
    for name in ("onsets_s", "annotated_onsets_s"):
        for onset in getattr(truth, name):
            if onset >= duration_s:
                problems.append(f"{name}: {onset:g} s is behind the end, {duration_s:.4g} s")
    if truth.label and skip_s >= duration_s:
        problems.append(
            f"label: of {duration_s:.4g} s nothing is left behind the first {skip_s:g} s; "
            "lower skip_s"
        )
    if problems:
        return FileTimeline(duration_s=duration_s), problems
    onsets = truth.onsets_s
    cut: dict[str, Any] = {
        name: tuple((start, min(end, duration_s)) for start, end in getattr(truth, name))
        for name in STRETCHES
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
    return FileTimeline(onsets, annotated, speeds, **cut, duration_s=duration_s), []


def scaled(truth: Truth, factor: float) -> Truth:
    """A truth told by a clock that runs ``factor`` times as fast as the one wanted."""
    changes: dict[str, Any] = {
        name: tuple(moment * factor for moment in getattr(truth, name))
        for name in ("onsets_s", "annotated_onsets_s")
    }
    for name in STRETCHES:
        spans = getattr(truth, name)
        changes[name] = tuple((start * factor, end * factor) for start, end in spans)
    return replace(truth, **changes)


_NOWHERE = "unknown"
"""The finger and segment of a channel of which nobody said them."""
_LABEL_NAMES = ("label", "labels", "slip", "is_slip", "contact", "trial", "material", "class")
"""Names of columns, in small letters, that are no channel unless a person says so."""
_TRUTH = (*MOMENTS, "sliding_s", "slip_s", "non_slip_s")
_UNIT = re.compile(r"\s*(?:\([^()]*\)|\[[^\[\]]*\])$")
_NAME_THEM = "name its columns so, or list them in the order of the hand as reading.channels"


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
    """

    name: str = ""
    reading: Reading = field(default_factory=Reading)
    channels: HandLayout | None = None
    kind: str = "electrode"
    adapting: Adapting | None = None
    units: str = "V"


class Found(NamedTuple):
    """What one file says of a stream before its samples are wanted.

    Args:
        clock: of its samples; one that is missing is a gap.
        is_measured: whether the rate is what its timestamps say, not stated.
        num_channels: in the file.
        names: of its channels, if it says.
        own: of a file of ours its ``channels``, ``units``, ``material``, ``provenance`` and truth,
            as plain values.
    """

    clock: Clock
    is_measured: bool
    num_channels: int
    names: tuple[str, ...] | None = None
    own: dict[str, Any] | None = None

    @property
    def hand(self) -> HandLayout | None:
        """The channels of a file of ours."""
        return HandLayout.from_rows(self.own["channels"]) if self.own else None

    @property
    def truth(self) -> Truth | None:
        """What a file of ours says, if it says anything."""
        truth = Truth(**{name: _tuples(self.own[name]) for name in _TRUTH}) if self.own else None
        return truth if truth is not None and truth.is_labelled else None


def _tuples(value: Any) -> Any:
    """Lists, and those in them, as tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, (list, tuple)) else value


def stream_of(own: Mapping[str, Any], name: str = "") -> Stream:
    """A stream from plain values: ``reading`` and ``channels`` as mappings, the rest as they are.

    Raises:
        ValueError: for a key or value that is none.
    """
    given = dict(own)
    known = [one.name for one in fields(Reading)]
    reading = given.pop("reading", None) or {}
    if not isinstance(reading, Mapping) or set(reading) - set(known):
        raise ValueError(f"reading must be of {', '.join(known)}, got {reading!r}")
    rows = given.pop("channels", None)
    options = [one.name for one in fields(Stream) if one.name != "name"]
    if unknown := set(given) - set(options):
        raise ValueError(f"a stream has {', '.join(options)}, got {', '.join(sorted(unknown))}")
    return Stream(name, Reading(**reading), _hand_from(rows), **given)


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


def look(path: Path, stream: Stream, stated_hz: float | None = None) -> Found:
    """What a file says of a stream; of its samples only times are read.

    Args:
        path: of the file.
        stream: to look for.
        stated_hz: its rate, if it was said of this file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read, its times are none of an even clock, or nobody says
            its rate.
    """
    with open_file(path, stream.reading) as opened:
        return _look_at(opened, path, stream, stated_hz)


def _look_at(opened: Opened, path: Path, stream: Stream, stated_hz: float | None = None) -> Found:
    samples, archived = opened.samples, opened.archived
    num = samples.num_samples
    if not num:
        raise ValueError(f"{path} holds no samples")
    if archived:
        recording = archived.recording
        own = {name: getattr(recording, name) for name in (*_TRUTH, "units", "material")}
        own |= {"channels": archived.hand.to_rows(), "provenance": dict(recording.provenance)}
        clock, own = Clock(snapped_rate(recording.sample_rate_hz), num), json.loads(json.dumps(own))
        return Found(clock, False, samples.num_channels, archived.hand.names, own)
    stated = stated_hz or opened.sample_rate_hz or stream.reading.sample_rate_hz
    stated = stated and snapped_rate(stated)
    if opened.times is not None:
        clock = even_clock(opened.times, num, stated, str(path))
    elif stated is not None:
        clock = Clock(stated, num)
    else:
        raise ValueError(
            f"{path} says no rate and has no times; give reading.sample_rate_hz=..., or name "
            "the column of times as reading.time=..."
        )
    return Found(clock, stated is None, samples.num_channels, opened.names)


def _hand_of(found: Found, stream: Stream) -> tuple[HandLayout, list[int]]:
    """The channels of a stream, and in which row of a file each of them is.

    Rows that a person gave are found by the names the file has, whatever their case and the unit
    in brackets behind them. If it has no names, or a person said which columns they are, they
    stand in that order.

    Raises:
        ValueError: if channels are given and the file has others, or names are none or twice.
    """
    own = list(found.names or ())
    if stream.channels is not None:
        return stream.channels, _rows_of(stream.channels, own, found, stream)
    every = list(range(found.num_channels))
    if found.hand is not None:
        return found.hand, every
    told = [name for name in own if _bare(name) in _LABEL_NAMES]
    if told and stream.reading.channels is None:
        raise ValueError(
            f"has a column {told[0]!r}, which may be what a detector is to find out; list the "
            "columns that are channels as reading.channels"
        )
    adapting = stream.adapting or KNOWN_KINDS.get(stream.kind, "slow")
    names: Sequence[str] = own or [f"ch{number + 1}" for number in every]
    before = f"{stream.name}_" if stream.name else ""
    channels = [Channel(before + n, stream.kind, _NOWHERE, _NOWHERE, adapting) for n in names]
    return HandLayout(tuple(channels)), every


def _rows_of(hand: HandLayout, own: Sequence[str], found: Found, stream: Stream) -> list[int]:
    """In which row of a file each channel of a hand is."""
    places = [_place_of(name, own) for name in hand.names]
    rows = [place for place in places if place is not None]
    if len(rows) == len(hand) == len(set(rows)):
        return rows
    is_ordered = not own or (found.hand is None and stream.reading.channels is not None)
    if is_ordered and len(hand) == found.num_channels:
        return list(range(len(hand)))
    has = _some(own) if own else f"{found.num_channels} without names"
    if rows and not is_ordered:
        lacking = [name for name, place in zip(hand.names, places, strict=True) if place is None]
        what = f"no channel {_some(lacking)}" if lacking else "a column that is two channels"
        raise ValueError(f"has {what} of data.channels; it has {has}")
    how = "" if is_ordered or found.hand is not None else f"; {_NAME_THEM}"
    raise ValueError(
        f"has the channels {has}, not the {len(hand)} of data.channels, {_some(hand.names)}{how}"
    )


def _place_of(name: str, own: Sequence[str]) -> int | None:
    """Where a name stands among others: as it is written or, if one alone is alike, by that."""
    if name in own:
        return list(own).index(name)
    alike = [place for place, other in enumerate(own) if _bare(other) == _bare(name)]
    return alike[0] if len(alike) == 1 else None


def _bare(name: str) -> str:
    """A name without its case and the unit behind it: ``"G1 (mV)"`` is ``"g1"``."""
    return _UNIT.sub("", name.strip()).casefold()


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 7 else f"{', '.join(names[:5])} .. {names[-1]}"


_RATE_ERROR = 0.01
"""By so much a rate that timestamps tell may differ from that of the set."""
_Value = TypeVar("_Value", bound=Hashable)


class Part(NamedTuple):
    """One stream of one file, as its set has it.

    Args:
        found: what the file says.
        hand: the channels.
        rows: of the file, in the order of the hand.
        rate_hz: of the file; a measured one is that of the set if it is near.
        units: of the samples.
    """

    found: Found
    hand: HandLayout
    rows: tuple[int, ...]
    rate_hz: float
    units: str


def _agreed(
    stream: Stream, places: Sequence[str], founds: Sequence[Found], *, any_rate: bool
) -> list[Part | str]:
    """A stream of every file or, where it differs from most of the others, in what.

    Args:
        stream: as it is read.
        places: of the files, for what is said of them.
        founds: what each file says.
        any_rate: whether rates may differ, since all are resampled.
    """
    parts = [_part(found, stream, rate) for found, rate in zip(founds, _rates(founds), strict=True)]
    whole = [part if isinstance(part, Part) else None for part in parts]
    hand, at_hand = _most([part and part.hand for part in whole], places)
    rate, at_rate = _most([part and part.rate_hz for part in whole], places)
    units, at_units = _most([part and part.units for part in whole], places)
    checked: list[Part | str] = []
    for part in parts:
        if isinstance(part, str):
            checked.append(part)
        elif part.hand != hand:
            checked.append(f"{_difference(part.hand, hand)} as in {at_hand}")
        elif part.rate_hz != rate and not any_rate:
            checked.append(
                f"is of {part.rate_hz:g} Hz, {at_rate} of {rate:g} Hz; "
                "data.resample_hz=... brings all to one"
            )
        elif part.units != units:
            checked.append(f"is in {part.units}, {at_units} in {units}")
        else:
            checked.append(part)
    return checked


def _part(found: Found, stream: Stream, rate_hz: float) -> Part | str:
    try:
        hand, rows = _hand_of(found, stream)
    except ValueError as error:
        return str(error)
    units = found.own["units"] if found.own else stream.units
    return Part(found, hand, tuple(rows), rate_hz, units)


def _rates(founds: Sequence[Found]) -> list[float]:
    """The rate of each file; those that timestamps tell are one, as round as it can be."""
    measured = [found.clock.sample_rate_hz for found in founds if found.is_measured]
    stated = [found.clock.sample_rate_hz for found in founds if not found.is_measured]
    if not measured:
        return stated
    middle = median(measured)
    apart = [abs(own / middle - 1) for own in measured]
    spread = max((share for share in apart if share <= _RATE_ERROR), default=0.0)
    common = Counter(stated).most_common(1)[0][0] if stated else nominal_rate(middle, spread)
    rates = []
    for found in founds:
        own = found.clock.sample_rate_hz
        is_near = found.is_measured and abs(own / common - 1) <= _RATE_ERROR
        rates.append(common if is_near else own)
    return rates


def _most(values: Sequence[_Value | None], places: Sequence[str]) -> tuple[_Value | None, str]:
    """What most have, and who: where it is found first, and whether that is more than half."""
    known = Counter(value for value in values if value is not None)
    if not known:
        return None, ""
    most, count = known.most_common(1)[0]
    others = " and most others" if 2 * count > known.total() else ""
    return most, f"{places[values.index(most)]}{others}"


def _difference(own: HandLayout, others: HandLayout | None) -> str:
    """The first difference between channels."""
    if others is None or len(own) != len(others):
        return f"has {len(own)} channels, not {len(others or ())}"
    place = next(i for i in range(len(own)) if own.channels[i] != others.channels[i])
    one, other = own.channels[place], others.channels[place]
    if one.name != other.name:
        return f"has {one.name} as channel {place + 1}, not {other.name}"
    return f"has {one.name} of another kind or place, {one.to_row()}, not {other.to_row()}"


# What was seen of files is remembered -------------------------------------------------------------


class _Memory:
    """What files of a set said, for one way of reading it; in a file of the user's cache.

    Args:
        root: of the set.
        streams: how files are read.
        stated_hz: the rate that is said of each file, if one is.
    """

    def __init__(
        self, root: Path, streams: Iterable[Stream], stated_hz: Mapping[str, float | None]
    ) -> None:
        self._root, self._stated_hz = root, stated_hz
        code = hashlib.sha256()
        for path in sorted(Path(__file__).parent.rglob("*.py")):
            code.update(path.read_bytes())
        facts = [str(root.resolve()), [one.reading.key() for one in streams], code.hexdigest()]
        name = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:32]
        cache = os.environ.get("XDG_CACHE_HOME")
        folder = (Path(cache) if cache else Path.home() / ".cache") / "tactslip_torch" / "looks"
        self.path = folder / f"{name}.json"

    def recall(self) -> dict[str, tuple[Found, ...]]:
        """What is known of files that are as they were; nothing if the memory is damaged."""
        known = {}
        for file, (stamp, founds) in self._kept().items():
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                if file in self._stated_hz and stamp == self._stamp(file):
                    known[file] = tuple(map(_remembered, founds))
        return known

    def keep(self, seen: Mapping[str, tuple[Found, ...]]) -> None:
        """Remember these files beside others; where nothing can be written, none."""
        kept = self._kept()
        with contextlib.suppress(OSError):
            for file, founds in seen.items():
                if (self._root / file).is_file():  # of a folder the time of change says little
                    kept[file] = [self._stamp(file), founds]
            with whole_file(self.path) as temporary:
                temporary.write_text(json.dumps(kept))

    def _kept(self) -> dict[str, Any]:
        with contextlib.suppress(OSError, ValueError, RecursionError):
            kept = json.loads(self.path.read_text())
            if isinstance(kept, dict) and all(
                isinstance(one, list) and len(one) == 2 for one in kept.values()
            ):
                return kept
        return {}

    def _stamp(self, file: str) -> list[Any]:
        found = (self._root / file).stat()
        return [found.st_size, found.st_mtime_ns, self._stated_hz[file]]


def _remembered(plain: list[Any]) -> Found:
    (rate_hz, num_samples, gaps, jitter_s), is_measured, num_channels, names, own = plain
    clock = Clock(rate_hz, num_samples, tuple(Gap(*gap) for gap in gaps), jitter_s)
    return Found(clock, is_measured, num_channels, _tuples(names), own)


# Samples as they are wanted ----------------------------------------------------------------------

_REACH = 11
"""Samples of the lower rate on either side that a resampled one may hang on."""


@dataclass(frozen=True)
class _Treatment:
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
        object.__setattr__(self, "tare_s", _tare_of(self.tare_s, "data.tare_s"))

    def num_recorded(self, part: Part) -> int:
        """How many samples of a stream the recording has."""
        num = part.found.clock.num_samples
        if self.resample_hz is None:
            return num
        return int(num * self.resample_hz / part.rate_hz + 1e-6)

    def missing_s(self, part: Part) -> list[Stretch]:
        """The stretches without samples, wider by what resampling draws from them."""
        rate_hz, most = part.rate_hz, self.most_bridged(part.rate_hz)
        reach_s = _REACH / min(rate_hz, self.resample_hz) if self.resample_hz else 0.0
        return [
            (max(gap.start / rate_hz - reach_s, 0.0), (gap.start + gap.missing) / rate_hz + reach_s)
            for gap in part.found.clock.gaps
            if gap.missing > most
        ]

    def most_bridged(self, rate_hz: float) -> int:
        """The most samples of a gap that is bridged."""
        return int(self.bridge_ms * rate_hz / 1000 + 1e-6) if self.gaps == "bridge" else 0


def _tare_of(value: object, name: str) -> Stretch | None:
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


class _HandSamples:
    """Some rows of samples in the order of a hand, on their clock, a level taken off each."""

    def __init__(self, samples: Samples, rows: Sequence[int], level: Tensor | None) -> None:
        self.num_channels, self.num_samples = len(rows), samples.num_samples
        self.dtype = samples.dtype
        self._samples, self._rows, self._level = samples, list(rows), level

    def read(self, first: int, stop: int) -> Tensor:
        """Samples from ``first`` to before ``stop``, ``[C, n]``."""
        return self.exact(first, stop).to(self.dtype)

    def exact(self, first: int, stop: int) -> Tensor:
        """The same, in float64 if a level is taken off."""
        read = self._samples.read(first, stop)[self._rows]
        return read if self._level is None else read - self._level


def _of_hand(
    samples: Samples,
    found: Found,
    rows: Sequence[int],
    rate_hz: float,
    path: Path,
    tare_s: Sequence[float] | None = None,
    most_bridged: int = 0,
) -> _HandSamples:
    """Samples of an open file as a hand has them; NaN in gaps that are not bridged.

    Raises:
        ValueError: if the file is not what it was when it was looked at, ends before the stretch
            that is tared on, or has nothing finite there.
    """
    missing = sum(gap.missing for gap in found.clock.gaps)
    shape = (samples.num_channels, samples.num_samples + missing)
    if shape != (found.num_channels, found.clock.num_samples):
        raise ValueError(f"{path} has changed since it was looked at; start again")
    if missing:
        samples = EvenSamples(samples, found.clock, most_bridged)
    if tare_s is None:
        return _HandSamples(samples, rows, None)
    first, stop = (round(moment * rate_hz) for moment in tare_s)
    if not first < stop <= samples.num_samples:
        raise ValueError(
            f"{path} has {samples.num_samples} samples, too few for tare_s={list(tare_s)}"
        )
    read = samples.read(first, stop)[list(rows)].double()
    level = read.where(read.isfinite(), torch.nan).nanmean(-1, keepdim=True)
    broken = level.isnan().flatten().nonzero().flatten().tolist()
    if broken:
        raise ValueError(
            f"{path} has nothing finite in its column {rows[broken[0]] + 1} to tare on from "
            f"{tare_s[0]:g} to {tare_s[1]:g} s; give another tare_s"
        )
    return _HandSamples(samples, rows, level)


def _recorded(
    path: Path,
    stream: Stream,
    part: Part,
    how: _Treatment,
    windows: Sequence[Stretch] | None = None,
) -> Tensor:
    """The samples of a stream as the recording has them.

    What is resampled is read whole; of the rest no more than the windows and what is tared on.

    Args:
        path: of the file.
        stream: how it is read.
        part: what the file said when it was looked at.
        how: samples are treated.
        windows: start and end of what is wanted, seconds; ``None`` for all.

    Shape:
        - output: ``[C, T]``, NaN where nothing is known and outside the windows

    Raises:
        ValueError: if the file is damaged, or is not what it was when it was looked at.
    """
    rate_hz, most = part.rate_hz, how.most_bridged(part.rate_hz)
    with open_file(path, stream.reading) as opened:
        samples = _of_hand(opened.samples, part.found, part.rows, rate_hz, path, how.tare_s, most)
        num = samples.num_samples
        if how.resample_hz is not None and how.resample_hz != rate_hz:
            even = resample(samples.exact(0, num).double(), rate_hz, how.resample_hz)
            return even[:, : how.num_recorded(part)].to(samples.dtype)
        kept = torch.full((samples.num_channels, num), torch.nan, dtype=samples.dtype)
        for start, end in windows if windows is not None else [(0.0, num / rate_hz)]:
            first, stop = max(math.floor(start * rate_hz), 0), min(math.ceil(end * rate_hz), num)
            kept[:, first:stop] = samples.read(first, stop)
        return kept


_BEFORE_ONSET_S = 1.01
"""What ``labels=whole_slide`` takes as non-slip before an onset."""
_PATIENCE_S = 2.0  # what takes longer is done by several processes, and not again
_ROUNDING = 1e-9
_MOST_CUT_S = 0.1  # by so much may files that belong together end apart


@dataclass(frozen=True)
class _Plan:
    """How all files of a set are read and labelled.

    Args:
        root: their folder.
        streams: of each file, at least one.
        treatment: of their samples.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
    """

    root: Path
    streams: tuple[Stream, ...]
    treatment: _Treatment
    skip_s: float = 0.0
    slide_s: float = 0.5


class _Surveyed(NamedTuple):
    """A recording that can be read: each of its streams, and when things happen in it."""

    entry: Entry
    parts: tuple[Part, ...]
    times: FileTimeline


class _Survey(NamedTuple):
    """What was found in a set.

    Args:
        recordings: those that can be read and agree with most of the others.
        problems: of the files that were left out, at the places of their entries.
        warnings: what is worth a look in the others.
    """

    recordings: tuple[_Surveyed, ...]
    problems: tuple[Problem, ...]
    warnings: tuple[Problem, ...]


def _survey(plan: _Plan, entries: Sequence[Entry]) -> _Survey:
    """Look at every file of a set.

    Raises:
        ValueError: if streams of several rates are not to be resampled.
    """
    problems: list[Problem] = []
    seen: list[tuple[Entry, tuple[Found, ...]]] = []
    for entry, found in zip(entries, _look_at_all(plan, entries), strict=True):
        if isinstance(found, str):
            problems.append(_at(entry, found))
        else:
            seen.append((entry, found))
    places = [entry.place for entry, _ in seen]
    any_rate = plan.treatment.resample_hz is not None
    columns = [
        _agreed(stream, places, [found[number] for _, found in seen], any_rate=any_rate)
        for number, stream in enumerate(plan.streams)
    ]
    recordings: list[_Surveyed] = []
    warnings: list[Problem] = []
    for (entry, _), *parts in zip(seen, *columns, strict=True):
        whole = tuple(part for part in parts if isinstance(part, Part))
        wrong = list(dict.fromkeys(part for part in parts if isinstance(part, str)))
        if not wrong:
            recording, wrong = _timed(plan, entry, whole)
            if not wrong:
                recordings.append(recording)
                warnings += [_at(entry, doubt) for doubt in _doubts(recording)]
        problems += [_at(entry, what) for what in wrong]
    _refuse_several_rates(plan, recordings)
    return _Survey(tuple(recordings), tuple(problems), tuple(warnings))


def _look_at_all(plan: _Plan, entries: Sequence[Entry]) -> Iterable[tuple[Found, ...] | str]:
    """What each file says, or why it cannot be read; by several processes if that takes long."""

    def look_at(entry: Entry) -> tuple[Found, ...] | str:
        path = plan.root / entry.file
        try:
            return tuple(look(path, stream, entry.sample_rate_hz) for stream in plan.streams)
        except (ValueError, OSError) as error:
            return str(error).replace(f"{plan.root}{os.sep}", "")

    stated_hz = {entry.file: entry.sample_rate_hz for entry in entries}
    memory = _Memory(plan.root, plan.streams, stated_hz)
    known = memory.recall()
    unknown = [entry for entry in entries if entry.file not in known]
    looked, seconds = [], 0.0
    for entry in unknown[:2]:  # the first waits for libraries that are not yet loaded
        started = time.perf_counter()
        looked.append(look_at(entry))
        seconds = time.perf_counter() - started
    is_slow = seconds * len(unknown) >= _PATIENCE_S
    if is_slow:
        looked += in_processes(look_at, unknown[2:], "looking at files", "file")
    else:
        looked += map(look_at, unknown[2:])
    seen = {entry.file: found for entry, found in zip(unknown, looked, strict=True)}
    if is_slow:
        memory.keep({file: one for file, one in seen.items() if not isinstance(one, str)})
    return [(seen | known)[entry.file] for entry in entries]


def _timed(plan: _Plan, entry: Entry, parts: tuple[Part, ...]) -> tuple[_Surveyed, list[str]]:
    """A recording with its truth on its time, and what does not fit."""
    how = plan.treatment
    wrong = []
    for part in parts:
        try:
            if how.resample_hz is not None:  # refuses ratios that cannot be
                resample(torch.zeros(1, 1), part.rate_hz, how.resample_hz)
            if how.gaps == "refuse":
                refuse_gaps(part.found.clock, "it")
        except ValueError as error:
            wrong.append(str(error).removeprefix("it: "))
    ends_s = [how.num_recorded(part) / (how.resample_hz or part.rate_hz) for part in parts]
    duration_s = min(ends_s)
    if max(ends_s) - duration_s > _MOST_CUT_S:
        wrong.append(
            f"its streams last {duration_s:.4g} to {max(ends_s):.4g} s; cut the longer one"
        )
    missing_s = [gap for part in parts for gap in how.missing_s(part)]
    if how.tare_s is not None:
        first_s, last_s = how.tare_s
        if last_s > duration_s:
            wrong.append(f"lasts {duration_s:.4g} s, tare_s wants {last_s:g} s")
        if any(start <= first_s and last_s <= end for start, end in missing_s):
            wrong.append(f"nothing is there to tare on from {first_s:g} to {last_s:g} s")
    found, rate_hz = parts[0].found, parts[0].rate_hz
    truth = entry.truth or found.truth or Truth()
    pace = found.clock.sample_rate_hz / rate_hz
    if found.is_measured and abs(pace - 1) > _ROUNDING:  # a person read the file's own times
        truth = scaled(truth, pace)
    times, misfits = on_time(
        truth,
        duration_s,
        skip_s=plan.skip_s,
        slide_s=plan.slide_s,
        slack_s=math.inf if entry.is_nominal else 1.0 / rate_hz,
        missing_s=missing_s,
    )
    return _Surveyed(entry, parts, times), [*wrong, *misfits]


def _doubts(recording: _Surveyed) -> list[str]:
    """What is worth a look in a recording that can be read."""
    entry, parts, times = recording
    doubts = []
    if not (times.onsets_s or times.slip_s or times.non_slip_s):
        doubts.append("has no label, so no bin is taken from it")
    early = [onset for onset in times.onsets_s if onset < _BEFORE_ONSET_S]
    if early:
        doubts.append(
            f"slips at {early[0]:g} s already; labels=whole_slide takes the second before an onset"
        )
    for number, part in enumerate(parts):
        clock = part.found.clock
        if clock.gaps:
            lost = sum(gap.missing for gap in clock.gaps)
            doubts.append(
                f"lacks {lost} samples in {len(clock.gaps)} gaps, first at "
                f"{clock.gaps[0].start / part.rate_hz:.4g} s"
            )
        if clock.jitter_s * part.rate_hz > 1:
            doubts.append(
                f"has times that are early or late by {1000 * clock.jitter_s:.3g} ms; "
                "samples are taken as even"
            )
        material = part.found.own["material"] if part.found.own else entry.recording.material
        if number == 0 and material != entry.recording.material:
            doubts.append(f"itself says {material!r}, not {entry.recording.material!r}")
    return doubts


def _at(entry: Entry, what: str) -> Problem:
    """What is said of an entry, its file named once."""
    said = what.removeprefix(entry.file).lstrip(":, ")
    return Problem(entry.place, said if entry.place == entry.file else f"{entry.file}: {said}")


def _refuse_several_rates(plan: _Plan, recordings: Sequence[_Surveyed]) -> None:
    if plan.treatment.resample_hz is None and recordings:
        rates = [part.rate_hz for part in recordings[0].parts]
        if len(set(rates)) > 1:
            told = ", ".join(
                f"{stream.name} has {rate:g} Hz"
                for stream, rate in zip(plan.streams, rates, strict=True)
            )
            raise ValueError(f"the streams must be brought to one rate, {told}: resample_hz=...")


log = logging.getLogger(__name__)
_MOST_SHOWN = 5


class FileRecordings:
    """A ``RecordingSource`` of the files of a folder.

    Times are seconds from a file's first sample. Streams of one file are taken to begin together.
    Where timestamps tell rates, those of all files are taken as one, as round as it can be, and
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
        gaps: ``refuse``, ``missing`` or ``bridge``.
        bridge_ms: the longest gap that is bridged.
        resample_hz: the rate that all files are brought to; ``None`` for their own.
        tare_s: start and end of the stretch whose mean is taken off each channel.
        skip_s: what a label of a whole recording leaves out at its start.
        slide_s: how long a slide lasts of which only the onset is known.
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
        streams: Mapping[str, Mapping[str, Any]] | None = None,
        skip_failed: bool = False,
        strict: bool = True,
    ) -> None:
        self.root = Path(root)
        for name, value in (("skip_s", skip_s), ("slide_s", slide_s)):
            if not (is_number(value) and value >= 0):
                raise ValueError(f"data.{name} must be seconds from 0, got {value!r}")
        if not (reading is None or isinstance(reading, Mapping)):
            raise ValueError(f"data.reading must be what is said of files, got {reading!r}")
        if streams is not None and not _is_of_mappings(streams):
            raise ValueError(
                "data.streams must be sets of channels by name, each with a reading, channels, "
                f"kind, adapting or units of its own, got {streams!r}"
            )
        shared = {"channels": channels, "kind": kind, "adapting": adapting, "units": units}
        self._plan = _Plan(
            self.root,
            tuple(
                stream_of(shared | dict(own) | {"reading": _joined(reading, own)}, name)
                for name, own in (streams or {"": {}}).items()
            ),
            _Treatment(gaps, bridge_ms, resample_hz, tare_s),
            skip_s,
            slide_s,
        )
        if not isinstance(manifest, Listing):
            manifest = read_manifest(manifest_of(self.root, manifest), self.root)
        found = _survey(self._plan, _chosen(manifest.entries, materials, cycles))
        self.problems = (*manifest.problems, *found.problems)
        self.warnings = (*manifest.warnings, *found.warnings)
        if strict:
            self._refuse(manifest.problems if skip_failed else self.problems)
            for problem in found.problems:
                log.warning("left out: %s", problem)
            if not found.recordings:
                raise ValueError(f"no recording of {self.root} is left: {self.problems[0]}")
        self._recordings = {one.entry.recording: one for one in found.recordings}
        self.ids = tuple(self._recordings)

    @property
    def hand(self) -> HandLayout:
        """The channels of every recording: those of all streams, one after the other."""
        return HandLayout(tuple(c for part in self._any.parts for c in part.hand.channels))

    @property
    def sample_rate_hz(self) -> float:
        """Of every recording."""
        return float(self._plan.treatment.resample_hz or self._any.parts[0].rate_hz)

    @property
    def units(self) -> str:
        """Of every sample; of streams with several, all of them."""
        return ", ".join(dict.fromkeys(part.units for part in self._any.parts))

    @property
    def is_simulated(self) -> bool:
        """Whether any file says that it comes from a simulation."""
        return any(_is_simulated(one) for one in self._recordings.values())

    def entry(self, recording: RecordingId) -> Entry:
        """Where a recording is, and what was said of it."""
        return self._recordings[recording].entry

    def parts(self, recording: RecordingId) -> list[tuple[Stream, Part]]:
        """How each stream of a recording is read, and what its file says of it."""
        return list(zip(self._plan.streams, self._recordings[recording].parts, strict=True))

    def timeline(self, recording: RecordingId) -> FileTimeline:
        """When things happen in a recording; nothing is read for it."""
        return self._recordings[recording].times

    def key(self, recording: RecordingId) -> Mapping[str, Any]:
        """What determines the samples: what the file holds, not its name, and how it is read."""
        one = self._recordings[recording]
        return {
            "sha256": file_digest(self.root / one.entry.file),
            "channels": self.hand.to_rows(),
            "treatment": asdict(self._plan.treatment),
            "streams": [
                {"reading": stream.reading.key(), "rows": part.rows, "rate_hz": part.rate_hz}
                for stream, part in zip(self._plan.streams, one.parts, strict=True)
            ],
        }

    def load(
        self, recording: RecordingId, windows: Sequence[tuple[float, float]] | None = None
    ) -> Recording:
        """Read a recording, or the stretches of it that are asked for.

        Raises:
            FileNotFoundError: if its file is gone.
            ValueError: if it is damaged, or has changed.
        """
        one = self._recordings[recording]
        path, how, times = self.root / one.entry.file, self._plan.treatment, one.times
        parts = [
            _recorded(path, stream, part, how, windows)
            for stream, part in zip(self._plan.streams, one.parts, strict=True)
        ]
        num_samples = round(times.duration_s * self.sample_rate_hz)
        own = one.parts[0].found.own
        return Recording(
            torch.cat([part[:, :num_samples] for part in parts]),
            self.sample_rate_hz,
            recording.material,
            times.speeds_mm_s,
            times.onsets_s,
            times.sliding_s,
            times.annotated_onsets_s,
            times.non_slip_s,
            own["provenance"] if own else {"simulated": False, "file": one.entry.file},
            slip_s=times.slip_s,
            units=self.units,
        )

    @property
    def _any(self) -> _Surveyed:
        for one in self._recordings.values():
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
    taken: dict[tuple[str, str, str], int] = {}
    kept = set()
    for entry in sorted(entries, key=lambda entry: entry.recording):
        name = entry.recording
        place = name.material, name.scene, name.session
        number = taken.get(place, 0)
        if (materials is None or name.material in materials) and number < (cycles or math.inf):
            taken[place] = number + 1
            kept.add(entry.place)
    return [entry for entry in entries if entry.place in kept]


def _joined(reading: Mapping[str, Any] | None, own: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of all streams, and over it what is said of one."""
    return {**(reading or {}), **(own.get("reading") or {})}


def _is_of_mappings(value: object) -> bool:
    return isinstance(value, Mapping) and all(isinstance(one, Mapping) for one in value.values())


def _is_simulated(one: _Surveyed) -> bool:
    owns = [part.found.own for part in one.parts]
    return any(own["provenance"].get("simulated") for own in owns if own)


_RATE_ERR = 0.001  # of a measured rate, as what is told in seconds errs; a stated one has none


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

    Its samples are those of the hand's channels; NaN where timestamps show a gap.

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
    stream = Stream(reading=reading, channels=hand)
    with open_file(path, reading) as opened:
        if opened.archived is not None or (opened.names is None and reading.channels is None):
            _refuse_other_channels(path, opened, hand.to_rows())
        found = _look_at(opened, path, stream)
        _refuse_others(path, found, sample_rate_hz, units)
        try:
            _, rows = _hand_of(found, stream)
        except ValueError as error:
            raise ValueError(f"{path} {error}") from None
        samples = _of_hand(opened.samples, found, rows, sample_rate_hz, path, tare)
        yield opened._replace(samples=samples)


def _refuse_other_channels(path: Path, opened: Opened, rows: Sequence[Mapping[str, str]]) -> None:
    """Raise if a recording is not of the hand with these channels, in this order.

    Of samples alone only the number of channels is known.

    Raises:
        ValueError: if there are others, naming the first.
    """
    theirs = opened.archived.hand.to_rows() if opened.archived else rows
    if opened.samples.num_channels != len(rows):
        raise ValueError(f"{path} has {opened.samples.num_channels} channels, not {len(rows)}")
    for place, (found, wanted) in enumerate(zip(theirs, rows, strict=True), 1):
        if any(found[what] != wanted[what] for what in ("name", "kind")):
            raise ValueError(
                f"channel {place} of {path} is {found['name']} ({found['kind']}), not "
                f"{wanted['name']} ({wanted['kind']}); give recordings of the detector's hand"
            )


def _refuse_others(path: Path, found: Found, sample_rate_hz: float, units: str) -> None:
    """Raise for another rate or unit than is wanted."""
    rate = found.clock.sample_rate_hz
    if rate != sample_rate_hz and not (
        found.is_measured and abs(rate / sample_rate_hz - 1) <= _RATE_ERR
    ):
        raise ValueError(
            f"{path} is of {rate:g} Hz, the detector of {sample_rate_hz:g} Hz; resample it"
        )
    own = found.own["units"] if found.own else units
    if own != units:
        raise ValueError(
            f"{path} is in {own}, the detector was trained on {units}; give it recordings "
            f"in {units}, or train one on {own}"
        )


_PIECE = 1 << 16
"""Samples that are looked at at a time."""


class Inspected(NamedTuple):
    """What the samples of a recording are, as they stand in its file.

    Args:
        least: of each channel, in the order of the hand; NaN if none of it is finite.
        greatest: the same.
        broken: of each channel that has any, how many samples are not finite, gaps apart, and
            when the first of them is, in seconds.
    """

    least: list[float]
    greatest: list[float]
    broken: dict[int, tuple[int, float]]


def inspected(source: FileRecordings, recording: RecordingId) -> Inspected:
    """All samples of a recording looked at once, by stretches.

    Raises:
        FileNotFoundError: if its file is gone.
        ValueError: if it is damaged.
    """
    path = source.root / source.entry(recording).file
    found = Inspected([], [], {})
    for stream, part in source.parts(recording):
        rate = part.rate_hz
        missing = [(gap.start, gap.start + gap.missing) for gap in part.found.clock.gaps]
        missing += [
            (round(start * rate), round(end * rate))
            for start, end in source.timeline(recording).missing_s
        ]
        low = torch.full((len(part.rows),), torch.inf, dtype=torch.float64)
        high, count = -low, torch.zeros(len(low), dtype=torch.int64)
        first = torch.full_like(count, -1)
        with open_file(path, stream.reading) as opened:
            samples = _of_hand(opened.samples, part.found, part.rows, rate, path)
            for number, piece in enumerate(pieces(samples, _PIECE)):
                seen = number * _PIECE
                is_fine = piece.isfinite()
                values = piece.double()
                low = torch.minimum(low, values.where(is_fine, torch.inf).amin(-1))
                high = torch.maximum(high, values.where(is_fine, -torch.inf).amax(-1))
                is_bad = ~is_fine & ~_inside(missing, seen, piece.shape[-1])
                is_first = (first < 0) & is_bad.any(-1)
                first = torch.where(is_first, seen + is_bad.int().argmax(-1), first)
                count += is_bad.sum(-1)
        for row in count.nonzero().flatten().tolist():
            place = len(found.least) + row
            found.broken[place] = (int(count[row]), int(first[row]) / rate)
        is_known = low <= high
        found.least.extend(low.where(is_known, torch.nan).tolist())
        found.greatest.extend(high.where(is_known, torch.nan).tolist())
    return found


def oddities(source: FileRecordings, found: Inspected) -> list[str]:
    """What in the samples is worth a look, a line each."""
    odd = []
    names = source.hand.names
    for row, (count, first_s) in found.broken.items():
        odd.append(
            f"{names[row]} is not finite in {count} samples, first at {first_s:.4f} s; leave the "
            "stretch out as missing_s, or repair it"
        )
    still = [
        (name, least)
        for name, least, greatest in zip(names, found.least, found.greatest, strict=True)
        if least == greatest
    ]
    odd += [f"{name} never changes, it is {value:g} throughout" for name, value in still]
    return odd


def _inside(stretches: Sequence[tuple[int, int]], first: int, num_samples: int) -> Tensor:
    """Which of so many samples from ``first`` on lie in a stretch, ``[n]``."""
    is_inside = torch.zeros(num_samples, dtype=torch.bool)
    for start, end in stretches:
        is_inside[max(start - first, 0) : max(end - first, 0)] = True
    return is_inside
