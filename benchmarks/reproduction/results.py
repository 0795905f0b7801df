"""Scores out of stored runs: one number a seed, and their mean and spread."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from tactslip_torch.report.metrics import split_metrics, summed_metrics

Runs = Mapping[str, Sequence[Mapping[str, Any]]]
"""Of each experiment, one a seed, as ``runs.kept`` has them."""
SCORES = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "non_slip_recall": "non-slip recall",
    "slip_recall": "slip recall",
}
POOLED = "best_pooled_number"


def mean_sd(values: Sequence[float], digits: int = 2, sign: str = "") -> str:
    """``mean ± sd`` over seeds, the mean alone of one, or ``-`` of nothing.

    Example:
        >>> mean_sd([1.0, 2.0, 3.0])
        '2.00 ± 1.00'
    """
    if not values:
        return "-"
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{sign}.{digits}f}{spread}"


def runs_of(runs: Runs, experiment: str) -> list[Mapping[str, Any]]:
    """Of an experiment; ``"confound: protocol"`` is the fold ``protocol`` of ``confound``."""
    name, _, fold = experiment.partition(": ")
    found = runs.get(name, [])
    return [run["folds"][fold] | {"seed": run["seed"]} for run in found] if fold else list(found)


def roles_of(runs: Runs, experiment: str) -> list[str]:
    """Roles that an experiment evaluates."""
    return [role for run in runs_of(runs, experiment)[:1] for role in run.get("splits", {})]


def labels_of(runs: Runs, experiment: str, role: str, kind: str) -> list[str]:
    """Labels of the groups of a kind, such as speeds."""
    splits = [run["splits"].get(role, {}) for run in runs_of(runs, experiment)]
    return list(dict.fromkeys(label for split in splits for label in split.get(kind, {})))


def by_seed(
    runs: Runs,
    experiment: str,
    role: str,
    score: str,
    *,
    group: tuple[str, str] | None = None,
    baseline: str | None = None,
) -> dict[int, float]:
    """A score in percent by seed; seeds without any are left out.

    Args:
        runs: stored.
        experiment: its name.
        role: ``"train"``, ``"test"`` or ``"unseen"``.
        score: a key of ``SCORES``.
        group: such as ``("per_speed", "20")``: of these bins alone.
        baseline: of this in the place of the detector.
    """
    found = {}
    for run in runs_of(runs, experiment):
        judged = run if baseline is None else run.get("baselines", {}).get(baseline, {})
        split = judged.get("splits", {}).get(role)
        if split is None:
            continue
        if group is None:
            value = split_metrics(split["confusion"])[score]
        elif group[1] in split.get(group[0], {}):
            value = summed_metrics([{"confusion": split[group[0]][group[1]]}])[score]
        else:
            continue
        if value is not None:
            found[run["seed"]] = 100 * value
    return found


def percent(runs: Runs, experiment: str, role: str, score: str, **of: Any) -> list[float]:
    """As ``by_seed``, the numbers alone."""
    return list(by_seed(runs, experiment, role, score, **of).values())


def gains(after: Mapping[int, float], before: Mapping[int, float]) -> list[float]:
    """What each seed that both have gains.

    Example:
        >>> gains({0: 90.0, 1: 91.0}, {1: 80.0, 2: 70.0})
        [11.0]
    """
    return [value - before[seed] for seed, value in after.items() if seed in before]


def recall_beside_onset(
    runs: Runs, experiment: str, role: str, places: Sequence[str]
) -> list[float]:
    """Recall, in percent, of bins at these places beside their onsets; a number a seed."""
    found = []
    for run in runs_of(runs, experiment):
        counts = run["splits"].get(role, {}).get("per_position", {})
        own = [counts[place] for place in places if place in counts]
        if own:
            found.append(100 * sum(right for right, _ in own) / sum(num for _, num in own))
    return found
