"""Choosing inside a fold: training objects are left out in turn, and the best choice is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.real.scores import balanced
from benchmarks.real.windows import Array

Trial = Callable[[Array, Array], Sequence[Array]]
"""From masks of windows to fit and to judge, to the scores of the latter under every choice."""


def best_choice(trial: Trial, is_slip: Array, objects: Array, most: int) -> tuple[int, float]:
    """The choice with the highest balanced accuracy on windows of objects left out.

    Args:
        trial: fits and scores; all that it fits, it fits to the windows of the first mask.
        is_slip: ``[n]``, of training windows.
        objects: ``[n]``.
        most: groups at most that the objects are put into.

    Returns:
        Its place, the first of equals, and that accuracy.
    """
    groups = inner_groups(objects, most)
    parts: list[tuple[Array, Sequence[Array]]] = []
    for group in range(groups.max() + 1):
        held = groups == group
        parts.append((held, trial(~held, held)))
    values = []
    for choice in range(len(parts[0][1])):
        scores = np.empty(len(is_slip))
        for held, found in parts:
            scores[held] = found[choice]
        values.append(balanced(scores, is_slip))
    best = int(np.argmax(values))
    return best, values[best]


def inner_groups(objects: Array, most: int) -> Array:
    """A group for every window ``[n]``; windows of an object are in one.

    Example:
        >>> inner_groups(np.array(["a", "c", "b", "b"]), 2).tolist()
        [0, 0, 1, 1]
    """
    names = sorted(set(objects.tolist()))
    number = {name: place % min(most, len(names)) for place, name in enumerate(names)}
    return np.array([number[name] for name in objects.tolist()])
