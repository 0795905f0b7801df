"""How long from the onset of slip to the decision: plain arithmetic of samples.

The worst case is that of an onset just behind the start of a bin. That bin is not wholly in slip,
so the next one decides, a hop later: hop + bin + look-ahead of the filter + compute. The four are
kept apart everywhere, for what one robot may ignore (the look-ahead of a film, 2.5 ms) another may
not. Bins that straddle the onset often say slip earlier; nothing here counts on it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from tactslip_torch.signals.filtering import ChannelFilter

DEFINITION = (
    "worst case, from the onset of slip to the decision of the first bin that lies wholly in slip: "
    "look-ahead of the filter for the channels in use + bin + hop (the onset falls just behind a "
    "bin's start) + compute (p99 of a call with one bin, one thread, on a processor of its own)"
)


@dataclass(frozen=True)
class Latency:
    """What the time from onset to decision is made of.

    Args:
        look_ahead_ms: samples behind the bin that the filter waits for.
        bin_ms: until a bin is full.
        hop_ms: between bins; a decision every so often, so compute must be shorter.
        compute_us: from the last sample to the decision.

    Raises:
        ValueError: if a part is negative, or bin or hop is nothing.

    Example:
        >>> Latency(2.5, 50.0, 5.0, 300.0).worst_ms
        57.8
    """

    look_ahead_ms: float
    bin_ms: float
    hop_ms: float
    compute_us: float

    def __post_init__(self) -> None:
        for name in ("look_ahead_ms", "bin_ms", "hop_ms", "compute_us"):
            value = getattr(self, name)
            may_be_nothing = name in ("look_ahead_ms", "compute_us")
            if not (value > 0 or (value == 0 and may_be_nothing)):
                wanted = "not be negative" if may_be_nothing else "be positive"
                raise ValueError(f"{name} must {wanted}, got {value}")

    @property
    def samples_ms(self) -> float:
        """The part that no faster computer shortens: look-ahead, bin and hop."""
        return self.look_ahead_ms + self.bin_ms + self.hop_ms

    @property
    def worst_ms(self) -> float:
        """From onset to decision, at worst."""
        return self.samples_ms + self.compute_us / 1000

    @property
    def load(self) -> float:
        """Share of one processor that computing takes."""
        return self.compute_us / 1000 / self.hop_ms

    def misses(self, deadline_ms: float, compute_us: float) -> list[str]:
        """Which of the limits are not met, in words; none if all are.

        Args:
            deadline_ms: for ``worst_ms``.
            compute_us: for compute.
        """
        found = []
        if self.worst_ms > deadline_ms:
            found.append(f"latency {self.worst_ms:.2f} ms above deadline_ms={deadline_ms:g}")
        if self.compute_us > compute_us:
            found.append(f"compute {self.compute_us:.0f} us above compute_us={compute_us:g}")
        if self.load >= 1:
            found.append(f"compute {self.compute_us:.0f} us not below the hop {self.hop_ms:g} ms")
        return found

    def facts(self) -> dict[str, Any]:
        """All parts and what they come to, JSON-able."""
        return {
            "worst_ms": self.worst_ms,
            "look_ahead_ms": self.look_ahead_ms,
            "bin_ms": self.bin_ms,
            "hop_ms": self.hop_ms,
            "compute_us": self.compute_us,
            "load": self.load,
        }


def look_ahead_samples(channel_filter: ChannelFilter, channels: Iterable[int]) -> int:
    """Samples behind a bin that must be there before the channels in use can be filtered.

    Args:
        channel_filter: of the whole hand.
        channels: indices of those in use.

    Raises:
        ValueError: if there is no channel.

    Example:
        >>> look_ahead_samples(ChannelFilter([51, 11]), [1])
        5
    """
    used = list(channels)
    if not used:
        raise ValueError("no channel is in use, expected at least one; select a feature")
    return max(channel_filter.reaches[channel][1] for channel in used)


def least_latency_ms(bin_ms: float, hops_ms: Sequence[float], look_ahead_ms: float) -> float:
    """What no computer comes below: compute of nothing, at the shortest hop."""
    return Latency(look_ahead_ms, bin_ms, min(hops_ms), 0.0).worst_ms


def longest_hop(
    parts: Latency, hops_ms: Sequence[float], deadline_ms: float, compute_us: float
) -> Latency:
    """The same with the longest hop that meets the limits, which spares the processor most.

    The shortest hop that compute fits into where none does; the longest of all if none is longer
    than compute.

    Example:
        >>> longest_hop(Latency(12.5, 50.0, 5.0, 300.0), [5.0, 10.0, 25.0], 80.0, 500.0).hop_ms
        10.0
    """
    all_of_them = [
        Latency(parts.look_ahead_ms, parts.bin_ms, hop, parts.compute_us)
        for hop in sorted(hops_ms, reverse=True)
    ]
    meeting = [each for each in all_of_them if not each.misses(deadline_ms, compute_us)]
    if meeting:
        return meeting[0]
    return shortest_hop(parts, hops_ms)


def shortest_hop(parts: Latency, hops_ms: Sequence[float]) -> Latency:
    """The same with the shortest hop that compute fits into; the longest of all if into none."""
    hops = sorted(hops_ms)
    hop = next((each for each in hops if parts.compute_us / 1000 < each), hops[-1])
    return Latency(parts.look_ahead_ms, parts.bin_ms, hop, parts.compute_us)
