"""How long from the onset of slip to the decision: plain arithmetic of samples.

The worst case is that of an onset just behind the start of a bin. That bin is not wholly in slip,
so the next one decides, a hop later: hop + bin + look-ahead of the filter + compute. The four are
kept apart everywhere, for what one robot may ignore (the look-ahead of a film, 2.5 ms) another may
not. Bins that straddle the onset often say slip earlier; nothing here counts on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class Limits:
    """What a detector has to keep.

    Args:
        deadline_ms: from the onset of slip to the decision, at worst.
        compute_us: from the last sample to the decision, p99.
        hops_ms: between bins, to choose from.

    Raises:
        ValueError: for limits that are no finite positive numbers.
    """

    deadline_ms: float
    compute_us: float
    hops_ms: Sequence[float]

    def __post_init__(self) -> None:
        check_number("deadline_ms", self.deadline_ms)
        check_number("compute_us", self.compute_us)

    def latency(self, parts: Latency, compute_us: float, headroom: float = 1.0) -> Latency:
        """The same parts with another compute, and the longest hop that keeps the limits.

        Where a hop keeps them with ``headroom`` times the compute as well, the longest of those.
        """
        for factor in (headroom, 1.0):
            given = replace(parts, compute_us=factor * compute_us)
            found = longest_hop(given, self.hops_ms, self.deadline_ms, self.compute_us)
            if not self.misses(found):
                break
        return replace(found, compute_us=compute_us)

    def misses(self, latency: Latency) -> list[str]:
        """Which limits are not kept, in words."""
        return latency.misses(self.deadline_ms, self.compute_us)

    def headroom(self, latency: Latency) -> float:
        """How many times its compute a detector could take; less than 1 if it misses a limit."""
        left_us = 1000 * min(self.deadline_ms - latency.samples_ms, latency.hop_ms)
        return min(self.compute_us, left_us) / latency.compute_us


def check_number(
    name: str, value: object, *, least: float | None = None, whole: bool = False
) -> None:
    """Refuse what is no finite number, positive or of at least so much, and whole if it has to be.

    Raises:
        ValueError: that names it.

    Example:
        >>> check_number("tries", 0, whole=True)
        Traceback (most recent call last):
        ValueError: tries must be a positive whole number, got 0
    """
    kinds = int if whole else (int, float)
    if isinstance(value, kinds) and not isinstance(value, bool) and math.isfinite(value):
        is_enough = value > 0 if least is None else value >= least
        if is_enough:
            return
    kind = "whole number" if whole else "finite number"
    wanted = f"a positive {kind}" if least is None else f"a {kind} of at least {least:g}"
    raise ValueError(f"{name} must be {wanted}, got {value!r}")


def check_hops(hops_ms: Sequence[float], sample_rate_hz: float) -> None:
    """Refuse hops that are no whole number of samples.

    Raises:
        ValueError: that names the first.
    """
    for hop in hops_ms:
        samples = hop * sample_rate_hz / 1000
        if not math.isclose(samples, round(samples), rel_tol=1e-9):
            raise ValueError(
                f"search.hops_ms: {hop:g} ms are {samples:g} samples at {sample_rate_hz:g} Hz, "
                f"expected a whole number; give a multiple of {1000 / sample_rate_hz:g} ms"
            )


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
