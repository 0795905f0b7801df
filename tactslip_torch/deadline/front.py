"""What is traded, and the front of those that nothing beats: latency, compute, accuracy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from tactslip_torch.deadline.latency import Latency, Limits
from tactslip_torch.features.names import FeatureName
from tactslip_torch.recipe import Frame
from tactslip_torch.signals.filtering import Align

_MODEL_ERRS = (1.5, 1.0, 1 / 1.5)  # modelled compute over what will be measured
FEW_NUMBERS = 20
LESS_ACCURATE = 0.01
LESS_COMPUTE = 1 / 3

_T = TypeVar("_T")


class Candidate(NamedTuple):
    """A detector that might be made.

    Attributes:
        align: of the filter.
        channels: which channels features may be of, in words.
        components: which components and descriptors.
        columns: what the machine takes: ``"channel"`` features, or statistics over channels, such
            as ``"pooled mean, std"``.
        ranking: how they were ranked; ``"none"`` if all are taken.
        degree: of the head.
        penalty: its C, the best of those tried.
        frame: which features are read, and how its numbers are made of them, best first.
        balanced_accuracy: on held-out groups, mean over them. A little too good: it chose. Of
            pooled columns everything is learned without the held-out group; ranking and scaling of
            channel features saw it too, and only the machine is refitted.
        by_group: of each held-out group.
        latency: worst case with the shortest hop, compute modelled until timed.
    """

    align: Align
    channels: str
    components: str
    columns: str
    ranking: str
    degree: int
    penalty: float
    frame: Frame
    balanced_accuracy: float
    by_group: Mapping[str, float | None]
    latency: Latency

    @property
    def point(self) -> tuple[float, float, float]:
        """What is traded, smaller is better: latency, compute, errors."""
        return self.latency.worst_ms, self.latency.compute_us, -self.balanced_accuracy

    @property
    def selected(self) -> tuple[int, ...]:
        """Pool indices of the features that are read."""
        return self.frame.selected

    @property
    def detector(self) -> tuple[Align, int, float, frozenset[int | FeatureName]]:
        """What its detector is made of, however its features were found."""
        layer = self.frame.pooling
        columns = self.selected if layer is None else layer.names
        return self.align, self.degree, self.penalty, frozenset(columns)


def distinct(candidates: Iterable[Candidate]) -> list[Candidate]:
    """One candidate a detector, the first: two groups of features may have the same best ones."""
    first: dict[object, Candidate] = {}
    for each in candidates:
        first.setdefault(each.detector, each)
    return list(first.values())


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


def landmarks(
    detectors: Sequence[_T],
    accuracy: Callable[[_T], float],
    compute: Callable[[_T], float],
    size: Callable[[_T], int],
) -> dict[str, _T | None]:
    """The detectors that a user asks for first, of several equally accurate ones the quickest.

    Args:
        detectors: at least one.
        accuracy: of a detector.
        compute: of a detector.
        size: how many numbers its machine takes.

    Returns:
        ``"most_accurate"``; ``"cheap"``, at most 1 point worse, with at most a third of its
        compute; ``"few"``, of at most 20 numbers. ``None`` where there is no such detector.
    """

    def best(some: Sequence[_T]) -> _T | None:
        return min(some, key=lambda each: (-accuracy(each), compute(each)), default=None)

    top = best(detectors)
    assert top is not None
    most, least = LESS_COMPUTE * compute(top), accuracy(top) - LESS_ACCURATE
    cheap = [each for each in detectors if compute(each) <= most and accuracy(each) >= least]
    few = [each for each in detectors if size(each) <= FEW_NUMBERS]
    return {"most_accurate": top, "cheap": best(cheap), "few": best(few)}


def worth_naming(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that may be ``landmarks``: the best of few numbers, and of each group.

    What compute a graph takes is not modelled; it depends on the descriptors first.
    """
    best: dict[object, Candidate] = {}
    for each in candidates:
        groups: list[object] = [(each.columns == "channel", each.components)]
        if each.frame.size <= FEW_NUMBERS:
            groups.append(FEW_NUMBERS)
        for group in groups:
            other = best.setdefault(group, each)
            if each.balanced_accuracy > other.balanced_accuracy:
                best[group] = each
    return list(best.values())


def worth_timing(candidates: Sequence[Candidate], most: int, limits: Limits) -> list[Candidate]:
    """The candidates on the modelled front, then those that would be without them, and so on.

    A model errs, so what is close to the front is timed as well. Of a layer that is too large:
    the most accurate; up to half of the room, in order of accuracy, those that keep the limits
    though modelled 1.5 times too slow, as modelled, or modelled 1.5 times too quick, in turn; and
    of the rest those that are spread by compute, from the cheapest to the dearest.
    """
    chosen: list[Candidate] = []
    left = list(candidates)
    while left and len(chosen) < most:
        places = nondominated([each.point for each in left])
        layer = [left[place] for place in places]
        room = most - len(chosen)
        chosen += layer if len(layer) <= room else _thinned(layer, room, limits)
        left = [each for place, each in enumerate(left) if place not in set(places)]
    return chosen


def _thinned(layer: Sequence[Candidate], room: int, limits: Limits) -> list[Candidate]:
    """So many of a layer: the most accurate, those close to the limits, and a spread."""
    best_first = sorted(layer, key=lambda each: (-each.balanced_accuracy, each.point))
    taken = best_first[:1]
    near = [[each for each in best_first if _keeps(each, limits, factor)] for factor in _MODEL_ERRS]
    for number in range(len(layer)):
        for some in near:
            if number < len(some) and some[number] not in taken and len(taken) < (room + 1) // 2:
                taken.append(some[number])
    rest = sorted((each for each in layer if each not in taken), key=lambda each: each.point[1])
    room -= len(taken)
    steps = max(room - 1, 1)
    return taken + [rest[number * (len(rest) - 1) // steps] for number in range(room)]


def _keeps(candidate: Candidate, limits: Limits, factor: float) -> bool:
    """Whether it keeps the limits if its compute is modelled so many times too long."""
    compute_us = candidate.latency.compute_us / factor
    return not limits.misses(limits.latency(candidate.latency, compute_us))
