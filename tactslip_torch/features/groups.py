"""Groups of features that a robot may do without: kinds of channels, fingers, components."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.features.names import FeatureName
from tactslip_torch.hand import HandLayout

Channels = Literal["all", "films", "gauges"]
Components = Literal["all", "unsorted", "deep_spectra", "time"]
_SORTED_OR_COUNTED = frozenset({"median", "mode", "iqr", "entropy"})
_DEEP = 3  # from this level on a branch has a rank below a fifth of the bin


def allowed(
    hand: HandLayout, names: Sequence[FeatureName], channels: str, components: str
) -> Tensor:
    """Which features are of a group of channels and of a group of components, ``[F]``, bool.

    Raises:
        ValueError: for an unknown group.
    """
    kinds = {"all": ("SG", "PVDF"), "films": ("PVDF",), "gauges": ("SG",)}
    if channels.split(" without ")[0] not in kinds or components not in get_args(Components):
        raise ValueError(
            f"unknown group {channels!r} or {components!r}, expected one of "
            f"{', '.join(get_args(Channels))} and one of {', '.join(get_args(Components))}"
        )
    kind_of = {channel.name: channel.kind for channel in hand.channels}
    return torch.tensor(
        [
            kind_of[name.channel] in kinds[channels.split(" without ")[0]]
            and _is_of(name, components)
            for name in names
        ]
    )


def of_fingers(hand: HandLayout, names: Sequence[FeatureName], fingers: Iterable[str]) -> Tensor:
    """Which features are of channels in these fingers, ``[F]``, bool."""
    finger_of, wanted = {channel.name: channel.finger for channel in hand.channels}, set(fingers)
    return torch.tensor([finger_of[name.channel] in wanted for name in names])


def _is_of(name: FeatureName, components: str) -> bool:
    if components == "unsorted":
        return name.descriptor not in _SORTED_OR_COUNTED
    if components == "deep_spectra":
        return name.domain == "time" or int(name.component[1:]) >= _DEEP
    return components == "all" or name.domain == "time"
