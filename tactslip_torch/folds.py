"""What several folds found, as one result."""

from __future__ import annotations

from typing import Any

from tactslip_torch.judging import event_numbers, together
from tactslip_torch.report.answers import merged_answers
from tactslip_torch.report.scores import merged_metrics, summed_metrics


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
    singles: dict[str, list[dict[str, Any]]] = {}
    for name, part in folds.items():
        before = f"{name}/" if of_rivals else ""
        for role, scores in part["splits"].items():
            splits.setdefault(before + role, []).append(scores)
        for role, scores in part["baselines"]["best_single_feature"]["splits"].items():
            singles.setdefault(before + role, []).append(scores)
    answers: dict[str, dict[str, Any]] = {}
    for name, part in folds.items():
        for role, found_of in part.get("answers", {}).items():
            answers.setdefault(f"{name}/{role}" if of_rivals else role, {})[name] = found_of
    shared = set.intersection(*(set(part["selected"]) for part in parts))
    return {
        "splits": {role: merged_metrics(scores) for role, scores in splits.items()},
        "baselines": {
            "best_single_feature": {
                "feature": "each fold's own",
                "splits": {role: summed_metrics(scores) for role, scores in singles.items()},
            }
        },
        "events": event_numbers(together(events)),
        "answers": {role: merged_answers(of) for role, of in answers.items()},
        "selected": [name for name in parts[0]["selected"] if name in shared],
        "timing_s": _summed([part.pop("timing_s") for part in parts]),
        "worker_s": _summed([part.pop("worker_s") for part in parts]),
        "folds": folds,
    }


def _summed(parts: list[dict[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    for part in parts:
        for stage, seconds in part.items():
            total[stage] = total.get(stage, 0.0) + seconds
    return total
