"""Whether the files of a set agree in channels, rate and units; if not, the few are named.

What most files have is right; of as many, what the first has.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from statistics import median
from typing import NamedTuple, TypeVar

from tactslip_torch.data.clock import nominal_rate
from tactslip_torch.data.sets.stream import Found, Stream, hand_of
from tactslip_torch.hand import HandLayout

RATE_ERROR = 0.01
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


def agreed(
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
        hand, rows = hand_of(found, stream)
    except ValueError as error:
        return str(error)
    return Part(found, hand, tuple(rows), rate_hz, found.units or stream.units)


def _rates(founds: Sequence[Found]) -> list[float]:
    """The rate of each file; those that timestamps tell are one, as round as it can be."""
    measured = [found.clock.sample_rate_hz for found in founds if found.is_measured]
    stated = [found.clock.sample_rate_hz for found in founds if not found.is_measured]
    if not measured:
        return stated
    middle = median(measured)
    apart = [abs(own / middle - 1) for own in measured]
    spread = max((share for share in apart if share <= RATE_ERROR), default=0.0)
    common = Counter(stated).most_common(1)[0][0] if stated else nominal_rate(middle, spread)
    rates = []
    for found in founds:
        own = found.clock.sample_rate_hz
        is_near = found.is_measured and abs(own / common - 1) <= RATE_ERROR
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
