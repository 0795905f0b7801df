"""What each feature of the pool is, and of what."""

from __future__ import annotations

from dataclasses import dataclass

from tactslip_torch.features.descriptors import (
    COMMON_DESCRIPTORS,
    SPECTRUM_DESCRIPTORS,
    TIME_DESCRIPTORS,
)
from tactslip_torch.hand import HandLayout


@dataclass(frozen=True)
class FeatureName:
    """What a feature is, and of what.

    Args:
        channel: channel name, such as ``"PVDF3"``.
        component: ``"raw"`` (of a slowly adapting channel) or a branch, ``"A1"`` to ``"D4"``.
        domain: ``"time"`` or ``"freq"``.
        descriptor: name in ``descriptors.py``, or ``"band_energy_ratio"``.

    Example:
        >>> str(FeatureName("PVDF3", "A2", "freq", "kurtosis"))
        'PVDF3 A2 freq kurtosis'
    """

    channel: str
    component: str
    domain: str
    descriptor: str

    def __str__(self) -> str:
        return f"{self.channel} {self.component} {self.domain} {self.descriptor}"


def pool_names(hand: HandLayout, level: int) -> tuple[FeatureName, ...]:
    """Names of all features of a hand, in the paper's order (REFERENCE.md section 4)."""
    names = [
        FeatureName(hand.names[i], "raw", "time", descriptor)
        for i in hand.slow
        for descriptor in COMMON_DESCRIPTORS
    ]
    domains = (("time", TIME_DESCRIPTORS), ("freq", SPECTRUM_DESCRIPTORS))
    for channel in (hand.names[i] for i in hand.fast):
        names += [
            FeatureName(channel, f"{kind}{m}", domain, descriptor)
            for m in range(1, level + 1)
            for domain, descriptors in domains
            for kind in "AD"
            for descriptor in descriptors
        ]
        names += [
            FeatureName(channel, f"{kind}{m}", "freq", "band_energy_ratio")
            for kind in "AD"
            for m in range(1, level + 1)
        ]
    return tuple(names)
