"""Groups of features: kinds of channels, fingers, components, definitions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.features.descriptors import ORDERED
from tactslip_torch.features.names import FeatureName
from tactslip_torch.hand import HandLayout

Channels = Literal["all", "films", "gauges"]
Components = Literal[
    "all", "unsorted", "deep_spectra", "time", "steady", "moments", "time_moments", "spreads"
]
JUMPING = ("mode", "cv", "entropy")
"""Descriptors that the least rounding can move far: ``mode`` to another of nearly equal counts,
``cv`` to the other sign where the mean is 0, ``entropy`` by what a value adds to a cell."""
_SPREADS = frozenset({"std", "range"})
ATTRIBUTES = ("kind", "finger", "channel", "component", "domain", "descriptor")
_DEEP = 3  # from this level on a branch has a rank below a fifth of the bin


def allowed(
    hand: HandLayout, names: Sequence[FeatureName], channels: str, components: str
) -> Tensor:
    """Which features are of a group of channels and of a group of components, ``[F]``, bool.

    Gauges are the channels that adapt slowly, films those that adapt fast, whatever their kind.

    Raises:
        ValueError: for an unknown group.
    """
    ways = {"all": ("slow", "fast"), "films": ("fast",), "gauges": ("slow",)}
    if channels.split(" without ")[0] not in ways or components not in get_args(Components):
        raise ValueError(
            f"unknown group {channels!r} or {components!r}, expected one of "
            f"{', '.join(get_args(Channels))} and one of {', '.join(get_args(Components))}"
        )
    adapting = {channel.name: channel.adapting for channel in hand.channels}
    return torch.tensor(
        [
            adapting[name.channel] in ways[channels.split(" without ")[0]]
            and _is_of(name, components)
            for name in names
        ]
    )


def of_fingers(hand: HandLayout, names: Sequence[FeatureName], fingers: Iterable[str]) -> Tensor:
    """Which features are of channels in these fingers, ``[F]``, bool."""
    finger_of, wanted = {channel.name: channel.finger for channel in hand.channels}, set(fingers)
    return torch.tensor([finger_of[name.channel] in wanted for name in names])


def matching(
    hand: HandLayout, names: Sequence[FeatureName], wanted: Mapping[str, str | Sequence[str]]
) -> Tensor:
    """Which features have, for every attribute that is named, one of its values, ``[F]``, bool.

    Args:
        hand: gives kind and finger of a channel.
        names: of the features.
        wanted: of each attribute a value or several, such as ``{"kind": "SG"}``.

    Raises:
        ValueError: for an unknown attribute, a value that no feature has, or values that no
            feature has together.
    """
    mask = torch.ones(len(names), dtype=torch.bool)
    checked = checked_attributes("wanted", wanted)
    for attribute, values in checked.items():
        having = [_attribute(hand, name, attribute) for name in names]
        for value in values:
            if value not in having:
                known = ", ".join(dict.fromkeys(having))
                raise ValueError(f"no feature has {attribute}={value!r}, expected some of {known}")
        mask &= torch.tensor([value in values for value in having], dtype=torch.bool)
    if not bool(mask.any()):
        together = ", ".join(f"{name}={'|'.join(values)}" for name, values in checked.items())
        raise ValueError(f"no feature has {together} together; ask for less")
    return mask


def checked_attributes(what: str, given: object) -> dict[str, tuple[str, ...]]:
    """Values by attribute of features, each as several.

    Raises:
        ValueError: if it is none of these, or empty; named ``what`` in the message.
    """
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"{what} must be like {{kind: SG, domain: [time, freq]}}, got {given!r}")
    found = {}
    for attribute, values in given.items():
        if attribute not in ATTRIBUTES:
            known = ", ".join(ATTRIBUTES)
            raise ValueError(f"{what}: unknown {attribute!r}, expected some of {known}")
        several = (values,) if isinstance(values, str) else values
        is_list = isinstance(several, Sequence) and all(isinstance(value, str) for value in several)
        if not is_list or not several:
            raise ValueError(f"{what}.{attribute} must be a name or several, got {values!r}")
        found[attribute] = tuple(several)
    return found


def _attribute(hand: HandLayout, name: FeatureName, attribute: str) -> str:
    if attribute in ("kind", "finger"):
        return str(getattr(hand.channel(name.channel), attribute))
    return str(getattr(name, attribute))


def _is_of(name: FeatureName, components: str) -> bool:
    if components == "unsorted":
        return name.descriptor not in ORDERED
    if components == "deep_spectra":
        return name.domain == "time" or int(name.component[1:]) >= _DEEP
    if components in ("steady", "moments", "time_moments"):
        is_left_out = name.descriptor in JUMPING
        if components != "steady":
            is_left_out |= name.descriptor in ORDERED
        return not is_left_out and (components != "time_moments" or name.domain == "time")
    if components == "spreads":
        return name.domain == "time" and name.descriptor in _SPREADS
    return components == "all" or name.domain == "time"
