"""Scores out of stored results: one number a seed, and their mean and spread."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from tactslip_torch.report.scores import split_metrics, summed_metrics

Report = Mapping[str, Any]
SCORES = {
    "accuracy": "accuracy",
    "balanced_accuracy": "balanced accuracy",
    "non_slip_recall": "non-slip recall",
    "slip_recall": "slip recall",
}


class MeanSd(NamedTuple):
    """Mean and standard deviation over seeds.

    Attributes:
        mean: of all.
        sd: the sample's; ``None`` of one number.
        num: how many.
    """

    mean: float
    sd: float | None
    num: int

    @classmethod
    def of(cls, values: Sequence[float]) -> MeanSd:
        """Of some numbers.

        Example:
            >>> MeanSd.of([1.0, 2.0, 3.0])
            MeanSd(mean=2.0, sd=1.0, num=3)
        """
        sd = statistics.stdev(values) if len(values) > 1 else None
        return cls(statistics.mean(values), sd, len(values))

    def text(self, digits: int = 2, sign: str = "") -> str:
        """``mean ± sd``; ``sign="+"`` writes the sign of the mean."""
        spread = "" if self.sd is None else f" ± {self.sd:.{digits}f}"
        return f"{self.mean:{sign}.{digits}f}{spread}"


def runs_of(report: Report, experiment: str) -> list[Mapping[str, Any]]:
    """Runs of an experiment by seed; none if it was not run.

    ``"confound: protocol"`` is the fold ``protocol`` of the experiment ``confound``.
    """
    name, _, fold = experiment.partition(": ")
    runs = report["runs"].get(name, [])
    return [run["folds"][fold] | {"seed": run["seed"]} for run in runs] if fold else list(runs)


def roles_of(report: Report, experiment: str) -> list[str]:
    """Roles that an experiment judges."""
    return [role for run in runs_of(report, experiment)[:1] for role in run.get("splits", {})]


def percent(
    report: Report,
    experiment: str,
    role: str,
    score: str,
    group: tuple[str, Iterable[str]] | None = None,
) -> list[float]:
    """A score in percent, a number a seed; those without any are left out.

    Args:
        report: as it is stored.
        experiment: its name.
        role: ``"train"``, ``"test"`` or ``"unseen"``.
        score: a key of ``SCORES``.
        group: such as ``("per_speed", ["20"])``: of these bins alone, together.
    """
    return list(by_seed(report, experiment, role, score, group).values())


def by_seed(
    report: Report,
    experiment: str,
    role: str,
    score: str,
    group: tuple[str, Iterable[str]] | None = None,
) -> dict[int, float]:
    """As ``percent``, with the seed of each number."""
    scores = {
        run["seed"]: _score(run["splits"].get(role), score, group)
        for run in runs_of(report, experiment)
    }
    return {seed: 100 * value for seed, value in scores.items() if value is not None}


POOLED_NUMBER = "best_pooled_number"


def baseline_percent(
    report: Report, experiment: str, role: str, score: str, baseline: str = POOLED_NUMBER
) -> list[float]:
    """As ``percent``, of a baseline (``tactslip_torch.training.baselines``)."""
    return list(baseline_by_seed(report, experiment, role, score, baseline).values())


def baseline_by_seed(
    report: Report, experiment: str, role: str, score: str, baseline: str = POOLED_NUMBER
) -> dict[int, float]:
    """As ``baseline_percent``, with the seed of each number."""
    scores = {
        run["seed"]: _score(_baseline(run, baseline).get(role), score, None)
        for run in runs_of(report, experiment)
    }
    return {seed: 100 * value for seed, value in scores.items() if value is not None}


def on_shared_seeds(*scores: Mapping[int, float]) -> list[list[float]]:
    """The numbers of each at the seeds that all of them have, in one order.

    Example:
        >>> on_shared_seeds({0: 90.0, 1: 91.0, 2: 92.0}, {2: 80.0, 0: 81.0})
        [[90.0, 92.0], [81.0, 80.0]]
    """
    shared = [seed for seed in scores[0] if all(seed in of for of in scores)]
    return [[of[seed] for seed in shared] for of in scores]


def seeds_text(num: int) -> str:
    """``1 seed``, ``2 seeds``."""
    return f"{num} seed{'s' if num != 1 else ''}"


def recall_beside_onset(
    report: Report, experiment: str, role: str, places: Sequence[str]
) -> list[float]:
    """Recall, in percent, of bins at these places beside their onsets; a number a seed."""
    found = []
    for run in runs_of(report, experiment):
        counts = run["splits"].get(role, {}).get("per_position", {})
        own = [counts[place] for place in places if place in counts]
        if own:
            found.append(100 * sum(right for right, _ in own) / sum(num for _, num in own))
    return found


def labels_of(report: Report, experiment: str, role: str, kind: str) -> list[str]:
    """Labels of the groups of a kind, as first met."""
    splits = [run["splits"].get(role, {}) for run in runs_of(report, experiment)]
    return list(dict.fromkeys(label for split in splits for label in split.get(kind, {})))


def text(values: Sequence[float], digits: int = 2, sign: str = "") -> str:
    """Mean and spread, or ``-`` of nothing."""
    return MeanSd.of(values).text(digits, sign) if values else "-"


def score_of(confusions: Sequence[Sequence[Sequence[int]]], score: str) -> float | None:
    """A score of the bins of several confusions together; ``None`` without any."""
    if not confusions:
        return None
    value: float | None = summed_metrics([{"confusion": of} for of in confusions])[score]
    return value


def _baseline(run: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Splits of a baseline; none in results of earlier code."""
    splits: Mapping[str, Any] = run.get("baselines", {}).get(name, {}).get("splits", {})
    return splits


def _score(
    split: Mapping[str, Any] | None, score: str, group: tuple[str, Iterable[str]] | None
) -> float | None:
    if split is None:
        return None
    if group is None:
        value: float | None = split_metrics(split["confusion"])[score]
        return value
    kind, labels = group
    own = split.get(kind, {})
    return score_of([own[label] for label in labels if label in own], score)
