"""The hand: which tactile channels there are, in file order, and where each one sits.

Section III-A of the paper. Everything that depends on the number or the
kind of channels asks a ``HandLayout``, so another hand is another layout and nothing else.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Literal, get_args

Adapting = Literal["slow", "fast"]
"""How a channel answers a touch that stays, after the afferents of skin.

``"slow"``: as long as it stays; described by the statistics of its bin. ``"fast"``: as long as it
changes; described by wavelet branches and their spectra.
"""
KNOWN_KINDS: Mapping[str, Adapting] = MappingProxyType({"SG": "slow", "PVDF": "fast"})
"""The paper's kinds, strain gauges and piezoelectric films: their word says how they adapt."""
_COLUMNS = ("name", "kind", "finger", "segment")
_REQUIRED = _COLUMNS[:2]
_NOWHERE = "unknown"
"""The finger and segment of a channel that nobody stated."""


@dataclass(frozen=True)
class Channel:
    """One sensing element.

    Args:
        name: unique in its hand, such as ``"PVDF7"``.
        kind: what it is, in one word, such as ``"SG"``, ``"PVDF"`` or ``"electrode"``; decides the
            filter of the channel.
        finger: the finger it sits in, such as ``"index"``.
        segment: the part of the finger, such as ``"distal"``.
        adapting: ``"slow"`` or ``"fast"``; decides the features of the channel. What the kind
            implies if it is one of ``KNOWN_KINDS`` and nothing else is given; never ``None`` once
            the channel is made.

    Raises:
        ValueError: if a name is no text, the kind is no single word, or how the channel adapts
            is neither given nor known.

    Example:
        >>> Channel("SG1", "SG", "index", "distal").adapting
        'slow'
        >>> Channel("E7", "electrode", "thumb", "distal", adapting="fast").adapting
        'fast'
    """

    name: str
    kind: str
    finger: str = _NOWHERE
    segment: str = _NOWHERE
    adapting: Adapting | None = None

    def __post_init__(self) -> None:
        for what in _COLUMNS:
            if not isinstance(getattr(self, what), str):
                raise ValueError(
                    f"channel {self.name!r}: {what} must be text, got {getattr(self, what)!r}; "
                    "put it in quotes"
                )
        if self.kind.split() != [self.kind]:
            raise ValueError(
                f"channel {self.name!r}: kind must be one word, such as SG, PVDF or electrode, "
                f"got {self.kind!r}"
            )
        if self.adapting is None:
            if self.kind not in KNOWN_KINDS:
                raise ValueError(
                    f"channel {self.name!r}: of kind {self.kind!r} it is not known how it adapts; "
                    "say adapting: slow (statistics of the bin) or adapting: fast (wavelet "
                    "branches and spectra)"
                )
            object.__setattr__(self, "adapting", KNOWN_KINDS[self.kind])
        if self.adapting not in get_args(Adapting):
            raise ValueError(
                f"channel {self.name!r}: adapting must be slow or fast, got {self.adapting!r}"
            )

    def to_row(self) -> dict[str, str]:
        """The plain row that ``HandLayout.from_rows`` reads.

        It holds ``adapting`` only where that is not what the kind implies.
        """
        row = {what: str(getattr(self, what)) for what in _COLUMNS}
        if self.adapting != KNOWN_KINDS.get(self.kind):
            row["adapting"] = str(self.adapting)
        return row


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
        >>> hand.fast[:3], hand.indices("PVDF")[:3]
        ((14, 15, 16), (14, 15, 16))
    """

    channels: tuple[Channel, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", tuple(self.channels))
        if not self.channels:
            raise ValueError("a hand needs at least one channel, got none")
        twice = sorted(name for name, count in Counter(self.names).items() if count > 1)
        if twice:
            raise ValueError(f"channel names must be unique, got {twice} more than once")

    def __len__(self) -> int:
        return len(self.channels)

    def __repr__(self) -> str:
        kinds = []
        for kind in self.kinds:
            own = self.indices(kind)
            kinds.append(f"{len(own)} {kind} ({self.channels[own[0]].adapting})")
        return f"HandLayout({len(self)} channels: {', '.join(kinds)})"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Channel names in file order."""
        return tuple(channel.name for channel in self.channels)

    @cached_property
    def slow(self) -> tuple[int, ...]:
        """Positions of the slowly adapting channels, in file order."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.adapting == "slow")

    @cached_property
    def fast(self) -> tuple[int, ...]:
        """Positions of the fast adapting channels, in file order."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.adapting == "fast")

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of channels, each once, in file order."""
        return tuple(dict.fromkeys(channel.kind for channel in self.channels))

    def indices(self, kind: str) -> tuple[int, ...]:
        """Positions of the channels of one kind, in file order; none if there is no such kind."""
        return tuple(i for i, channel in enumerate(self.channels) if channel.kind == kind)

    def channel(self, name: str) -> Channel:
        """The channel of that name.

        Raises:
            KeyError: if the hand has no such channel.
        """
        if name not in self._by_name:
            raise KeyError(f"no channel {name!r} in this hand; it has {', '.join(self.names)}")
        return self._by_name[name]

    @cached_property
    def _by_name(self) -> dict[str, Channel]:
        return {channel.name: channel for channel in self.channels}

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
        with_fast = [place for place in places if place[0] == "thumb" or place[1] != "proximal"]
        slow = [Channel(f"SG{i}", "SG", *place) for i, place in enumerate(places, 1)]
        fast = [Channel(f"PVDF{i}", "PVDF", *place) for i, place in enumerate(with_fast, 1)]
        return cls(tuple(slow + fast))

    @classmethod
    def from_rows(cls, rows: Iterable[Mapping[str, str]]) -> HandLayout:
        """A hand from plain rows of configuration or of a file.

        Args:
            rows: ``name``, ``kind`` and, where the kind does not say it, ``adapting``; ``finger``
                and ``segment`` where they are known.

        Raises:
            ValueError: if a row lacks one of the first two or has another key, or no channel can be
                made of it; named with its row.
        """
        channels = []
        for number, row in enumerate(rows, 1):
            if not set(_REQUIRED) <= set(row) <= {*_COLUMNS, "adapting"}:
                raise ValueError(
                    f"channel row {number}: expected {', '.join(_REQUIRED)}, for kinds other than "
                    f"{' and '.join(KNOWN_KINDS)} adapting, and if known finger and segment; got "
                    f"{sorted(map(str, row))}"
                )
            try:
                channels.append(Channel(**row))  # type: ignore[arg-type]  # checked there
            except ValueError as error:
                raise ValueError(f"channel row {number}: {error}") from None
        return cls(tuple(channels))

    def to_rows(self) -> list[dict[str, str]]:
        """The plain rows that ``from_rows`` reads."""
        return [channel.to_row() for channel in self.channels]
