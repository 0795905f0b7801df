"""What each feature of the pool is, and of what."""

from __future__ import annotations

from dataclasses import dataclass

SIMPLE_STATISTICS = ("mean", "std", "rms", "range", "mean_abs_change")
"""Descriptors of the filtered bin itself that every channel has, fast ones too; in volts."""


@dataclass(frozen=True)
class FeatureName:
    """What a feature is, and of what.

    Args:
        channel: channel name, such as ``"PVDF3"``; of a pooled feature the kind, ``"PVDF"``.
        component: ``"raw"`` (the filtered bin) or, of a fast channel, a branch, ``"A1"`` to
            ``"D4"``.
        domain: ``"time"`` or ``"freq"``.
        descriptor: name in ``descriptors.py``, or ``"band_energy_ratio"``.
        statistic: over the channels of the kind, such as ``"std"`` (``pooling.py``); empty for a
            feature of one channel.

    Example:
        >>> str(FeatureName("PVDF3", "A2", "freq", "kurtosis"))
        'PVDF3 A2 freq kurtosis'
        >>> str(FeatureName("PVDF", "A2", "freq", "kurtosis", "std"))
        'PVDF A2 freq kurtosis [std]'
    """

    channel: str
    component: str
    domain: str
    descriptor: str
    statistic: str = ""

    def __str__(self) -> str:
        statistic = f" [{self.statistic}]" if self.statistic else ""
        return f"{self.channel} {self.component} {self.domain} {self.descriptor}{statistic}"

    @property
    def is_pooled(self) -> bool:
        """Whether it is a statistic over channels."""
        return bool(self.statistic)

    @property
    def is_simple(self) -> bool:
        """Whether it is one of ``SIMPLE_STATISTICS`` of the filtered bin, or pooled of such."""
        return self.component == "raw" and self.descriptor in SIMPLE_STATISTICS
