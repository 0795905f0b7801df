"""What scores are worth: balanced accuracy, the area under the curve, by object and by scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.real.windows import Array

CURVE_POINTS = 201


def balanced(scores: Array, is_slip: Array, weights: Array | None = None) -> float:
    """Mean of the shares of slip and of non-slip that are told right; at least 0 means slip.

    Args:
        scores: ``[N]``.
        is_slip: ``[N]``, bool, of both classes.
        weights: ``[N]``, how often each counts; once.
    """
    found, kept = recalls(scores, is_slip, weights)
    return (found + kept) / 2


def recalls(scores: Array, is_slip: Array, weights: Array | None = None) -> tuple[float, float]:
    """Sensitivity, the share of slip that is found, and specificity."""
    says, of = scores >= 0, np.ones(len(scores)) if weights is None else weights
    sensitivity = of[is_slip & says].sum() / of[is_slip].sum()
    specificity = of[~is_slip & ~says].sum() / of[~is_slip].sum()
    return float(sensitivity), float(specificity)


def auc(scores: Array, is_slip: Array, weights: Array | None = None) -> float:
    """Area under the ROC curve: how often a slip scores above a non-slip, equals count half.

    Example:
        >>> auc(np.array([0.1, 0.4, 0.4, 0.8]), np.array([False, False, True, True]))
        0.875
    """
    of = np.ones(len(scores)) if weights is None else weights
    place = np.unique(scores, return_inverse=True)[1]
    slip = np.bincount(place, of * is_slip)
    other = np.bincount(place, of * ~is_slip)
    below = np.cumsum(other) - other
    return float(slip @ (below + other / 2) / (slip.sum() * other.sum()))


def curve(scores: Array, is_slip: Array) -> tuple[list[float], list[float]]:
    """The ROC curve: false alarms, evenly from 0 to 1, and the share of slip found at each."""
    order = np.argsort(-scores, kind="stable")
    last = np.append(np.diff(scores[order]) != 0, True)  # equals enter together
    false = np.append(0.0, np.cumsum(~is_slip[order])[last] / (~is_slip).sum())
    found = np.append(0.0, np.cumsum(is_slip[order])[last] / is_slip.sum())
    grid = np.linspace(0.0, 1.0, CURVE_POINTS)
    # of several at one share of false alarms the highest; between two, the line
    rises = np.append(np.diff(false) > 0, True)
    return grid.tolist(), np.interp(grid, false[rises], found[rises]).round(6).tolist()


def judged(scores: Array, is_slip: Array, objects: Array, scenes: Array) -> dict[str, Any]:
    """All that tables say of the scores of a method, JSON-able.

    Args:
        scores: ``[N]``, each of a fold whose training had no window of that object.
        is_slip: ``[N]``, bool.
        objects: ``[N]``, text.
        scenes: ``[N]``, text.
    """
    by_object = {
        name: balanced(scores[objects == name], is_slip[objects == name])
        for name in sorted(set(objects.tolist()))
    }
    says, worst = scores >= 0, lowest(by_object)
    sensitivity, specificity = recalls(scores, is_slip)
    return {
        "balanced_accuracy": balanced(scores, is_slip),
        "auc": auc(scores, is_slip),
        "sensitivity": sensitivity,
        "specificity": specificity,
        "objects": by_object,
        "objects_mean": float(np.mean(list(by_object.values()))),
        "worst": {"object": worst, "balanced_accuracy": by_object[worst]},
        "scenes": {
            name: float((says == is_slip)[scenes == name].mean())
            for name in sorted(set(scenes.tolist()))
        },
        "curve": dict(zip(("false_alarms", "found"), curve(scores, is_slip), strict=True)),
    }


def lowest(values: Mapping[str, float]) -> str:
    """The name of the lowest value."""
    return min(values, key=values.__getitem__)
