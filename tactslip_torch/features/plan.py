"""The least work that yields a set of features: which channels, branches and spectra, and for what.

A plan is names and places only. The backends carry it out; what nobody
wants is not read, formed, sorted or counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from tactslip_torch.features.names import FeatureName, pool_names
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.wavelet import branch_names

RowKind = Literal["gauge", "time", "freq"]
ROW_KINDS: tuple[RowKind, ...] = ("gauge", "time", "freq")
ORDERED = frozenset({"median", "mode", "iqr"})
"""Descriptors that need sorted values."""


class Row(NamedTuple):
    """Values that are described together: a gauge's bin, a film's branch, or its spectrum.

    Attributes:
        kind: which of the three.
        channel: index in the hand.
        branch: index in ``branch_names``; -1 for a gauge.
    """

    kind: RowKind
    channel: int
    branch: int


class Wanted(NamedTuple):
    """A descriptor of a row, and the column it goes to."""

    row: int
    descriptor: str
    place: int


class Share(NamedTuple):
    """A band energy ratio of a film, and the column it goes to."""

    channel: int
    branch: int
    place: int


@dataclass(frozen=True)
class Plan:
    """What has to be done for a set of features.

    Args:
        channels: indices in the hand of the channels that are read, ascending.
        rows: what is formed and described: gauges, branches, spectra, each by channel and branch.
        wanted: descriptors, in the order of their columns.
        shares: band energy ratios, in the order of their columns. Their energies are of all
            branches of the film, whether or not those are rows.
        num_features: number of columns.
    """

    channels: tuple[int, ...]
    rows: tuple[Row, ...]
    wanted: tuple[Wanted, ...]
    shares: tuple[Share, ...]
    num_features: int

    @property
    def share_channels(self) -> tuple[int, ...]:
        """Films of which band energy ratios are wanted, ascending."""
        return tuple(sorted({share.channel for share in self.shares}))


def make_plan(hand: HandLayout, level: int, names: Sequence[FeatureName | str]) -> Plan:
    """The least work for these features, which come out in this order.

    Args:
        hand: the channels, in the order in which bins hold them.
        level: number of wavelet levels.
        names: any features of the pool, as names or as their text; repeats are allowed.

    Raises:
        ValueError: if there is no name, or one is none of the pool.

    Example:
        >>> make_plan(HandLayout.paper24(), 4, ["PVDF3 A2 freq kurtosis"]).rows
        (Row(kind='freq', channel=16, branch=2),)
    """
    known = {str(name): name for name in pool_names(hand, level)}
    if not names:
        raise ValueError("an empty selection, expected at least one feature; name some of the pool")
    unknown = [str(name) for name in names if str(name) not in known]
    if unknown:
        example = next(iter(known))
        raise ValueError(
            f"unknown feature {unknown[0]!r}, expected one of the pool's {len(known)} names, such "
            f"as {example!r}; pool.names lists them"
        )
    branches = {name: index for index, name in enumerate(branch_names(level))} | {"raw": -1}
    channel_of = {name: index for index, name in enumerate(hand.names)}
    found: list[tuple[Row, str]] = []
    for name in (known[str(name)] for name in names):
        branch = branches[name.component]
        kind: RowKind = "gauge" if branch < 0 else "time" if name.domain == "time" else "freq"
        found.append((Row(kind, channel_of[name.channel], branch), name.descriptor))
    is_share = [descriptor == "band_energy_ratio" for _, descriptor in found]
    rows = sorted(
        {row for (row, _), shared in zip(found, is_share, strict=True) if not shared},
        key=lambda row: (ROW_KINDS.index(row.kind), row.channel, row.branch),
    )
    place_of = {row: index for index, row in enumerate(rows)}
    wanted, shares = [], []
    for place, ((row, descriptor), shared) in enumerate(zip(found, is_share, strict=True)):
        if shared:
            shares.append(Share(row.channel, row.branch, place))
        else:
            wanted.append(Wanted(place_of[row], descriptor, place))
    channels = tuple(sorted({row.channel for row, _ in found}))
    return Plan(channels, tuple(rows), tuple(wanted), tuple(shares), len(found))
