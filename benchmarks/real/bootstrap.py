"""How sure a difference is: recordings drawn anew within their class, the same for both methods."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks.real.scores import auc, balanced
from benchmarks.real.windows import Array

MEASURES = {"balanced_accuracy": balanced, "auc": auc}
COVERAGE = 0.95


def differences(
    scores: Mapping[str, Array],
    ours: str,
    is_slip: Array,
    recording: Array,
    draws: int,
    seed: int = 0,
) -> dict[str, dict[str, dict[str, float]]]:
    """Ours minus every other method, with a bootstrap interval by recording.

    Scores are held: what another draw of training recordings would change is not in it.

    Args:
        scores: ``[N]`` by method.
        ours: which of them.
        is_slip: ``[N]``, bool, one value within a recording.
        recording: ``[N]``, number of the recording of each window.
        draws: how many.
        seed: of them.

    Returns:
        By other method and measure: ``value``, ``low`` and ``high`` of the interval, and the
        ``share`` of draws in which ours is above.
    """
    generator = np.random.default_rng(seed)
    names, first = np.unique(recording, return_index=True)
    by_class = [names[is_slip[first] == value] for value in (False, True)]
    drawn: dict[str, list[dict[str, float]]] = {name: [] for name in scores}
    for _ in range(draws):
        taken = np.concatenate([generator.choice(of, len(of)) for of in by_class])
        weights = np.bincount(taken, minlength=names.max() + 1)[recording].astype(float)
        for name, of in scores.items():
            drawn[name].append({m: value(of, is_slip, weights) for m, value in MEASURES.items()})
    found: dict[str, dict[str, dict[str, float]]] = {}
    tails = [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2]
    for name in scores:
        if name == ours:
            continue
        found[name] = {}
        for measure, value in MEASURES.items():
            pairs = zip(drawn[ours], drawn[name], strict=True)
            gaps = np.array([a[measure] - b[measure] for a, b in pairs])
            low, high = np.quantile(gaps, tails).tolist()
            gap = value(scores[ours], is_slip) - value(scores[name], is_slip)
            found[name][measure] = {
                "value": gap,
                "low": low,
                "high": high,
                "share": float((gaps > 0).mean()),
            }
    return found


def in_words(found: Mapping[str, Any], scale: float = 100.0) -> str:
    """``+1.2 (0.3 to 2.1)``, in percent."""
    value, low, high = (scale * found[name] for name in ("value", "low", "high"))
    return f"{value:+.2f} ({low:+.2f} to {high:+.2f})"
