"""One set of channels of every file of a set: how it is read, and what it is called.

Most files hold one. Where a hand has sensors of several rates, each rate is a stream of its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import torch

from tactslip_torch.data.clock import Clock, even_clock, snapped_rate
from tactslip_torch.data.formats import AS_IT_SAYS, Opened, Reading, open_file
from tactslip_torch.data.recording import Recording
from tactslip_torch.data.sets.truth import Truth
from tactslip_torch.hand import KNOWN_KINDS, Adapting, Channel, HandLayout

NOWHERE = "unknown"
"""The finger and segment of a channel of which nobody said them."""
LABEL_NAMES = ("label", "labels", "slip", "is_slip", "contact", "trial", "material", "class")
"""Names of columns, in small letters, that are no channel unless a person says so."""
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
    reading: Reading = AS_IT_SAYS
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
        dtype: of its samples.
        names: of its channels, if it says.
        hand: of its channels, if it is one of ours.
        units: if it is one of ours.
        truth: if it is one of ours and has any.
        material: if it is one of ours.
        provenance: if it is one of ours.
    """

    clock: Clock
    is_measured: bool
    num_channels: int
    dtype: torch.dtype
    names: tuple[str, ...] | None = None
    hand: HandLayout | None = None
    units: str | None = None
    truth: Truth | None = None
    material: str | None = None
    provenance: Mapping[str, Any] | None = None


def stream_of(own: Mapping[str, Any], name: str = "") -> Stream:
    """A stream from plain values: ``reading`` and ``channels`` as mappings, the rest as they are.

    Raises:
        ValueError: for a key or value that is none.
    """
    given = dict(own)
    known = [field.name for field in fields(Reading)]
    reading = given.pop("reading", None) or {}
    if not isinstance(reading, Mapping) or set(reading) - set(known):
        raise ValueError(f"reading must be of {', '.join(known)}, got {reading!r}")
    rows = given.pop("channels", None)
    options = [field.name for field in fields(Stream) if field.name != "name"]
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
        return look_at(opened, path, stream, stated_hz)


def look_at(opened: Opened, path: Path, stream: Stream, stated_hz: float | None = None) -> Found:
    """``look`` at a file that is open.

    Raises:
        ValueError: as ``look``.
    """
    samples, archived = opened.samples, opened.archived
    num = samples.num_samples
    if not num:
        raise ValueError(f"{path} holds no samples")
    if archived:
        recording = archived.recording
        return Found(
            Clock(snapped_rate(recording.sample_rate_hz), num),
            False,
            samples.num_channels,
            samples.dtype,
            archived.hand.names,
            archived.hand,
            recording.units,
            _truth(recording),
            recording.material,
            recording.provenance,
        )
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
    return Found(clock, stated is None, samples.num_channels, samples.dtype, opened.names)


def hand_of(found: Found, stream: Stream) -> tuple[HandLayout, list[int]]:
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
    told = [name for name in own if _bare(name) in LABEL_NAMES]
    if told and stream.reading.channels is None:
        raise ValueError(
            f"has a column {told[0]!r}, which may be what a detector is to find out; list the "
            "columns that are channels as reading.channels"
        )
    adapting = stream.adapting or KNOWN_KINDS.get(stream.kind, "slow")
    names: Sequence[str] = own or [f"ch{number + 1}" for number in every]
    before = f"{stream.name}_" if stream.name else ""
    channels = [Channel(before + n, stream.kind, NOWHERE, NOWHERE, adapting) for n in names]
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


def _truth(recording: Recording) -> Truth | None:
    """What a recording of ours says; ``None`` if nobody said anything."""
    truth = Truth(
        recording.onsets_s,
        recording.annotated_onsets_s,
        recording.speeds_mm_s,
        recording.sliding_s,
        recording.slip_s,
        recording.non_slip_s,
    )
    return truth if truth.is_labelled else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 7 else f"{', '.join(names[:5])} .. {names[-1]}"
