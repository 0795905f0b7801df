"""What is traded, and the front of those that nothing beats: latency, compute, accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tactslip_torch.deadline.latency import Latency
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


def worth_timing(candidates: Sequence[Candidate], most: int) -> list[Candidate]:
    """The candidates on the modelled front, then those that would be without them, and so on.

    A model errs, so what is close to the front is timed as well. Of a layer that is too large
    those are taken that are spread over it by compute, from the cheapest to the dearest.
    """
    chosen: list[Candidate] = []
    left = list(candidates)
    while left and len(chosen) < most:
        places = nondominated([each.point for each in left])
        layer = sorted((left[place] for place in places), key=lambda each: each.point[1])
        room = most - len(chosen)
        if len(layer) > room:
            steps = max(room - 1, 1)
            layer = [layer[number * (len(layer) - 1) // steps] for number in range(room)]
        chosen += layer
        left = [each for place, each in enumerate(left) if place not in set(places)]
    return chosen
