"""Groups of features: kinds of channels, fingers, components, definitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tactslip_torch.features.names import FeatureName
from tactslip_torch.hand import HandLayout

JUMPING = ("mode", "cv", "entropy")
"""Descriptors that the least rounding can move far: ``mode`` to another of nearly equal counts,
``cv`` to the other sign where the mean is 0, ``entropy`` by what a value adds to a cell."""
ATTRIBUTES = ("kind", "finger", "channel", "component", "domain", "descriptor")


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
