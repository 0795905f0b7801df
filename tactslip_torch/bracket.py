"""Where on the line of difficulty to try next: a bracketed search that stays where facts hold.

What is searched for costs a minute a point, so the search is a function of the points tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

RESOLUTION = 0.02
"""How closely a target is bracketed on the line of difficulty."""

FACTS_RESOLUTION = 0.1
"""How closely the place is bracketed where the facts begin to fail."""


@dataclass(frozen=True)
class Point:
    """One place on the line of difficulty that was tried.

    Args:
        difficulty: prior standard deviations from the starting values.
        accuracy: seen-material test accuracy, the mean over seeds.
        holds: whether all qualitative facts hold.
    """

    difficulty: float
    accuracy: float
    holds: bool


def next_difficulty(
    points: Sequence[Point],
    target: float,
    tolerance: float,
    bounds: tuple[float, float],
    step: float = 1.0,
) -> float | None:
    """Where to try next, or ``None`` when there is nothing left to try.

    Begins at 0 and steps towards the target until it is crossed, the facts fail or the bound is
    reached; then narrows the bracket, by a secant kept off its ends if it crosses the target, by
    halves if facts alone fail at its far end. Of points where the facts fail none is returned to.
    Places are whole hundredths, except a bound that is none; a step is ``RESOLUTION`` or more.

    Example:
        >>> next_difficulty([Point(0.0, 0.99, True)], 0.96, 0.001, (-3, 3))
        1.0
        >>> tried = [Point(0.0, 0.99, True), Point(1.0, 0.95, True)]
        >>> next_difficulty(tried, 0.96, 0.001, (-3, 3))
        0.75
    """
    if not points:
        return 0.0
    start = min(points, key=lambda point: abs(point.difficulty))
    if not start.holds or any(_is_met(point, target, tolerance) for point in points):
        return None
    way = 1 if start.accuracy > target else -1
    bound = abs(bounds[1] if way > 0 else bounds[0])
    ahead = sorted((point for point in points), key=lambda point: way * point.difficulty)
    near = start
    for point in ahead:
        if way * point.difficulty <= way * near.difficulty:
            continue
        if not (point.holds and way * (point.accuracy - target) > 0):
            return _between(near, point, target, way)
        near = point
    reached = way * near.difficulty
    if reached >= bound:
        return None
    return way * min(round(reached + max(step, RESOLUTION), 2), bound)


def _is_met(point: Point, target: float, tolerance: float) -> bool:
    return point.holds and abs(point.accuracy - target) <= tolerance


def _between(near: Point, far: Point, target: float, way: int) -> float | None:
    """A place within the bracket, or ``None`` if it is too narrow."""
    low, high = way * near.difficulty, way * far.difficulty
    crosses = way * (far.accuracy - target) <= 0
    if high - low <= (RESOLUTION if crosses else FACTS_RESOLUTION):
        return None
    share = 0.5
    if crosses:
        share = (near.accuracy - target) / (near.accuracy - far.accuracy)
    place = low + min(max(share, 0.1), 0.9) * (high - low)
    return way * round(min(max(place, low + RESOLUTION / 2), high - RESOLUTION / 2), 2)


def chosen_point(points: Sequence[Point], target: float) -> int | None:
    """Index of the point to keep: the closest to the target of those where the facts hold."""
    holding = [index for index, point in enumerate(points) if point.holds]
    if not holding:
        return None
    return min(holding, key=lambda i: (abs(points[i].accuracy - target), abs(points[i].difficulty)))
