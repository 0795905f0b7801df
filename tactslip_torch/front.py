"""What is traded, and the front of those that nothing beats: latency, compute, accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tactslip_torch.latency import Latency
from tactslip_torch.signals.filtering import Align


class Candidate(NamedTuple):
    """A detector that might be made.

    Attributes:
        align: of the filter.
        channels: which channels features may be of, in words.
        components: which components.
        ranking: how features were ranked.
        degree: of the head.
        penalty: its C, the best of those tried.
        selected: pool indices of its features, best first.
        balanced_accuracy: on held-out groups, mean over them. It chose, so it is a little too good.
        by_group: of each held-out group.
        latency: worst case with the shortest hop, compute modelled until timed.
    """

    align: Align
    channels: str
    components: str
    ranking: str
    degree: int
    penalty: float
    selected: tuple[int, ...]
    balanced_accuracy: float
    by_group: Mapping[str, float | None]
    latency: Latency

    @property
    def point(self) -> tuple[float, float, float]:
        """What is traded, smaller is better: latency, compute, errors."""
        return self.latency.worst_ms, self.latency.compute_us, -self.balanced_accuracy


def nondominated(points: Sequence[Sequence[float]]) -> list[int]:
    """Places of the points that no other beats, smaller being better; of equal ones the first.

    Example:
        >>> nondominated([(1, 5), (2, 2), (3, 2), (4, 1), (2, 2)])
        [0, 1, 3]
    """
    kept: list[int] = []
    order = sorted(range(len(points)), key=lambda index: (tuple(points[index]), index))
    for index in order:
        own = points[index]
        if not any(all(a <= b for a, b in zip(points[k], own, strict=True)) for k in kept):
            kept.append(index)
    return sorted(kept)


def worth_timing(
    candidates: Sequence[Candidate], deadline_ms: float, compute_us: float, most: int
) -> list[Candidate]:
    """The candidates on the modelled front; of too many those that meet the limits come first.

    Half of the places go to those that meet the limits, most accurate first; the others are spread
    over the rest by compute, so that the front is known beyond the limits too.
    """
    front = [candidates[index] for index in nondominated([each.point for each in candidates])]
    meeting = [each for each in front if not each.latency.misses(deadline_ms, compute_us)]
    meeting.sort(key=lambda each: -each.balanced_accuracy)
    first = meeting[: -(-most // 2)]
    rest = sorted((each for each in front if each not in first), key=lambda each: each.point[1])
    places = min(most - len(first), len(rest))
    if places == 1:
        return [*first, rest[-1]]
    return first + [rest[i * (len(rest) - 1) // (places - 1)] for i in range(places)]
