"""The hand: which tactile channels there are, in file order, and where each one sits.

Section III-A of the paper (REFERENCE.md section 1). Everything that depends on the number or the
kind of channels asks a ``HandLayout``, so another hand is another layout and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

ChannelKind = Literal["SG", "PVDF"]
"""``"SG"``: strain gauge, slowly adapting. ``"PVDF"``: piezoelectric film, fast adapting."""


@dataclass(frozen=True)
class Channel:
    """One sensing element.

    Args:
        name: unique in its hand, such as ``"PVDF7"``.
        kind: ``"SG"`` or ``"PVDF"``; decides the filter and the features of the channel.
        finger: the finger it sits in, such as ``"index"``.
        segment: the part of the finger, such as ``"distal"``.

    Raises:
        ValueError: if ``kind`` is neither.
    """

    name: str
    kind: ChannelKind
    finger: str
    segment: str

    def __post_init__(self) -> None:
        if self.kind not in get_args(ChannelKind):
            raise ValueError(
                f"channel {self.name!r}: kind must be one of {list(get_args(ChannelKind))}, "
                f"got {self.kind!r}"
            )


@dataclass(frozen=True)
class HandLayout:
    """The channels of a hand, in the order in which recordings hold them.

    Args:
        channels: at least one, names unique.

    Raises:
        ValueError: if there is no channel or a name occurs twice.

    Example:
        >>> hand = HandLayout.paper24()
        >>> len(hand), hand.names[0], hand.names[-1]
        (24, 'SG1', 'PVDF10')
        >>> hand.indices("PVDF")[:3]
        (14, 15, 16)
    """

    channels: tuple[Channel, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
        if not self.channels:
            raise ValueError("a hand needs at least one channel, got none")
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise ValueError(f"channel names must be unique, got {twice} more than once")

    def __len__(self) -> int:
        return len(self.channels)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Channel names in file order."""
        return tuple(channel.name for channel in self.channels)

    def indices(self, kind: ChannelKind) -> tuple[int, ...]:
        """Positions of the channels of one kind, in file order."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.kind == kind)

    def channel(self, name: str) -> Channel:
        """The channel of that name.

        Raises:
            KeyError: if the hand has no such channel.
        """
        for channel in self.channels:
            if channel.name == name:
                return channel
        raise KeyError(f"no channel {name!r} in this hand; it has {', '.join(self.names)}")

    @classmethod
    def paper24(cls) -> HandLayout:
        """The paper's hand: SG1 to SG14, then PVDF1 to PVDF10.

        Each of the four fingers carries an SG and a PVDF in its distal and in its middle segment
        and an SG alone in its proximal one; the thumb carries two pairs. The order of segments
        within a finger, from the tip inwards, is ours: the paper does not state it.
        """
        places = [
            (finger, segment)
            for finger in ("little", "ring", "middle", "index")
            for segment in ("distal", "middle", "proximal")
        ] + [("thumb", "distal"), ("thumb", "proximal")]
        with_film = [place for place in places if place[0] == "thumb" or place[1] != "proximal"]
        gauges = [Channel(f"SG{i}", "SG", *place) for i, place in enumerate(places, 1)]
        films = [Channel(f"PVDF{i}", "PVDF", *place) for i, place in enumerate(with_film, 1)]
        return cls(tuple(gauges + films))

    @classmethod
    def from_rows(cls, rows: Iterable[Mapping[str, str]]) -> HandLayout:
        """A hand from plain rows with ``name``, ``kind``, ``finger``, ``segment`` (configuration).

        Raises:
            ValueError: if a row lacks one of the four or has another key, named with its row.
        """
        channels = []
        for number, row in enumerate(rows, 1):
            if set(row) != {"name", "kind", "finger", "segment"}:
                raise ValueError(
                    f"channel row {number}: expected name, kind, finger, segment, got {sorted(row)}"
                )
            channels.append(Channel(**row))  # type: ignore[arg-type]  # kind is checked there
        return cls(tuple(channels))

    def to_rows(self) -> list[dict[str, str]]:
        """The plain rows that ``from_rows`` reads."""
        return [
            {"name": c.name, "kind": c.kind, "finger": c.finger, "segment": c.segment}
            for c in self.channels
        ]
