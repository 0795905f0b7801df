"""What several folds found, as one result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tactslip_torch.judging import event_numbers, together
from tactslip_torch.report.metrics import merged_answers, merged_metrics, summed_metrics


def combined(folds: dict[str, dict[str, Any]], of_rivals: bool) -> dict[str, Any]:
    """One fold as it is; of several, bins and events are pooled, and the shared selection named.

    Rivals are judged on the same bins, so theirs are not summed: ``splits`` then has each role of
    each fold, such as ``"protocol/unseen"``.
    """
    found = {name: part.pop("recording_events") for name, part in folds.items()}
    if len(folds) == 1:
        return next(iter(folds.values()))
    parts = list(folds.values())
    events = [
        {f"{name}/{role}" if of_rivals else role: by_rule for role, by_rule in by_role.items()}
        for name, by_role in found.items()
    ]
    splits: dict[str, list[dict[str, Any]]] = {}
    for name, part in folds.items():
        before = f"{name}/" if of_rivals else ""
        for role, scores in part["splits"].items():
            splits.setdefault(before + role, []).append(scores)
    answers: dict[str, dict[str, Any]] = {}
    for name, part in folds.items():
        for role, found_of in part.get("answers", {}).items():
            answers.setdefault(f"{name}/{role}" if of_rivals else role, {})[name] = found_of
    shared = set.intersection(*(set(part["selected"]) for part in parts))
    return {
        "splits": {role: merged_metrics(scores) for role, scores in splits.items()},
        "baselines": merged_baselines(
            {name: part["baselines"] for name, part in folds.items()}, by_fold=of_rivals
        ),
        "events": event_numbers(together(events)),
        "answers": {role: merged_answers(of) for role, of in answers.items()},
        "selected": [name for name in parts[0]["selected"] if name in shared],
        "timing_s": _summed([part.pop("timing_s") for part in parts]),
        "worker_s": _summed([part.pop("worker_s") for part in parts]),
        "folds": folds,
    }


def merged_baselines(
    folds: Mapping[str, Mapping[str, Any]], *, by_fold: bool = False
) -> dict[str, dict[str, Any]]:
    """Scores of baselines on the bins of all folds by role, or by fold and role.

    One fold is returned as it is; of several, metadata (each fold's own) is left out.

    Args:
        folds: ``metrics["baselines"]`` of each fold.
        by_fold: whether folds have the same bins, which then are not summed.
    """
    if len(folds) == 1:
        return dict(next(iter(folds.values())))
    splits: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for fold, baselines in folds.items():
        for name, about in baselines.items():
            for role, scores in about["splits"].items():
                key = f"{fold}/{role}" if by_fold else role
                splits.setdefault(name, {}).setdefault(key, []).append(scores)
    return {
        name: {"splits": {key: summed_metrics(of) for key, of in by_key.items()}}
        for name, by_key in splits.items()
    }


def _summed(parts: list[dict[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            total[stage] = total.get(stage, 0.0) + seconds
    return total
