"""What the paper's data could not show: places beside onsets, strokes, ablations, leakage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.reproduction.results import (
    SCORES,
    Report,
    baseline_by_seed,
    baseline_percent,
    by_seed,
    labels_of,
    on_shared_seeds,
    percent,
    recall_beside_onset,
    roles_of,
    runs_of,
    text,
)
from benchmarks.tables import Table
from tactslip_torch.report.results import BASELINES

PLACES: Mapping[str, Sequence[str]] = {
    "-20 to -11": [str(place) for place in range(-20, -10)],
    "-10 to -4": [str(place) for place in range(-10, -3)],
    **{str(place): [str(place)] for place in range(-3, 3)},
    "3 to 9": [str(place) for place in range(3, 10)],
    "10 to 19": [str(place) for place in range(10, 20)],
    "20 and on": ["20+"],
}
"""Bins beside an onset by where they stand; 0 is the first that is labelled slip."""


def places_table(report: Report) -> Table:
    """Recall by the place of a bin beside its onset."""
    columns = [
        (name, role, f"{name}, {role}")
        for name in ("unseen4", "unseen4 robust")
        for role in ("test", "unseen")
        if role in roles_of(report, name)
    ]
    rows = []
    for words, places in PLACES.items():
        found = [recall_beside_onset(report, name, role, places) for name, role, _ in columns]
        if any(found):
            label = "non-slip" if words.startswith("-") else "slip"
            rows.append([f"{words} ({label})", *map(text, found)])
    note = "Recall, %: bins that were called what they are labelled. A bin is 50 ms."
    return Table(["bin beside its onset", *(column[2] for column in columns)], rows, note)


def strokes_table(report: Report) -> Table:
    """Scores by the speed of the stroke."""
    rows = []
    for name in ("unseen4", "unseen4 robust"):
        for role in ("test", "unseen"):
            for speed in labels_of(report, name, role, "per_speed"):
                group = ("per_speed", [speed])
                cells = [text(percent(report, name, role, score, group)) for score in SCORES]
                rows.append([f"{name}, {role}, {speed} mm/s", *cells])
    return Table(["stroke", *(f"{name}, %" for name in SCORES.values())], rows)


class Ablation(NamedTuple):
    """A detector that is denied something.

    Attributes:
        what: it has.
        experiment: as it is stored.
        is_baseline: whether the best pooled number with a threshold is meant.
    """

    what: str
    experiment: str
    is_baseline: bool = False


ABLATIONS = (
    Ablation("everything", "unseen4"),
    Ablation("PVDF films only", "PVDF only"),
    Ablation("means of the SGs only", "SG means only"),
    Ablation("the best single pooled number with a threshold", "unseen4", is_baseline=True),
    Ablation("everything, motors and jolts of the arm off", "motor_off"),
    Ablation("motors and jolts of the arm, the contact as good as silent", "motor_only"),
    Ablation("everything, labels permuted", "shuffled"),
)


def ablation_by_seed(report: Report, ablation: Ablation, role: str, score: str) -> dict[int, float]:
    """A score of an ablation in percent, with the seed of each number."""
    found = baseline_by_seed if ablation.is_baseline else by_seed
    return found(report, ablation.experiment, role, score)


def cost(report: Report, ablation: Ablation, role: str) -> list[float]:
    """Balanced points that an ablation scores more than everything, of the seeds both have."""
    score = "balanced_accuracy"
    own = ablation_by_seed(report, ablation, role, score)
    whole = by_seed(report, ABLATIONS[0].experiment, role, score)
    return [a - b for a, b in zip(*on_shared_seeds(own, whole), strict=True)]


def ablations_table(report: Report) -> Table:
    """What a detector scores with a part of the signals or of the scene, paper's recipe."""
    rows = []
    for ablation in ABLATIONS:
        runs = runs_of(report, ablation.experiment)
        if not runs:
            continue
        cells = []
        for role in ("test", "unseen"):
            cells += [
                text(list(ablation_by_seed(report, ablation, role, score).values()))
                for score in ("balanced_accuracy", "non_slip_recall", "slip_recall")
            ]
            is_whole = ablation is ABLATIONS[0]
            cells.append("-" if is_whole else text(cost(report, ablation, role), sign="+"))
        rows.append([ablation.what, *cells, str(len(runs)), _num_features(ablation, runs)])
    scores = ("balanced, %", "non-slip, %", "slip, %", "to everything, points")
    columns = [f"{role}: {score}" for role in ("test", "unseen") for score in scores]
    header = ["trained and judged with", *columns, "seeds", "features"]
    note = (
        "Split by cycle, whole slides, the paper's recipe. Points are balanced, those of "
        f"everything taken off at the same seeds{_fewer(report)}. Permuted labels must show 50 %."
    )
    return Table(header, rows, note)


def _fewer(report: Report) -> str:
    """Which ablations share fewer seeds with everything than it has, as an aside."""
    whole = by_seed(report, ABLATIONS[0].experiment, "test", "balanced_accuracy")
    by_num: dict[int, list[str]] = {}
    for ablation in ABLATIONS:
        own = ablation_by_seed(report, ablation, "test", "balanced_accuracy")
        shared = len(on_shared_seeds(own, whole)[0])
        if own and shared < len(whole):
            by_num.setdefault(shared, []).append(ablation.experiment)
    parts = [f"{num} of {len(whole)} for {', '.join(names)}" for num, names in by_num.items()]
    return f" ({'; '.join(parts)})" if parts else ""


def _num_features(ablation: Ablation, runs: Sequence[Mapping[str, object]]) -> str:
    if ablation.is_baseline:
        return "1"
    numbers = sorted({len(list(run["selected"])) for run in runs})  # type: ignore[call-overload]
    return " to ".join(map(str, dict.fromkeys([numbers[0], numbers[-1]])))


def baselines_table(report: Report) -> Table | None:
    """Detector and baselines on the same bins; ``None`` of results that have no baselines."""
    rows = []
    for name, runs in report["runs"].items():
        if not all("baselines" in run for run in runs):
            continue
        for role in roles_of(report, name):
            cells = [text(percent(report, name, role, "balanced_accuracy"))]
            cells += [
                text(baseline_percent(report, name, role, "balanced_accuracy", baseline))
                for baseline in BASELINES
            ]
            rows.append([f"{name}, {role}", *cells])
    header = ["balanced accuracy, %", "detector", *BASELINES.values()]
    note = "All are fitted on the same training recordings; baselines on a sample of their bins."
    return Table(header, rows, note) if rows else None


RECIPES = {"unseen4": "the paper's", "unseen4 robust": "`robust`, the default"}


def validation_table(report: Report) -> Table:
    """What recipes score on training materials left out, by which the default was chosen."""
    rows, by_recipe = [], []
    for name, words in RECIPES.items():
        values = {run["seed"]: run["validation"] for run in runs_of(report, name)}
        if values and None not in values.values():
            by_recipe.append(values)
            percents = [100 * value for value in values.values()]
            by_seed = ", ".join(f"{value:.2f}" for value in percents)
            rows.append([words, text(percents), by_seed])
    note = "Balanced accuracy of the best choice of K and C; no test and no unseen bin is in it."
    if len(by_recipe) == len(RECIPES):
        paper, robust = on_shared_seeds(*by_recipe)
        better = sum(ours > theirs for theirs, ours in zip(paper, robust, strict=True))
        note += f" `robust` is the better one for {better} of {len(paper)} seeds."
    return Table(["recipe", "left-out training materials, %", "by seed"], rows, note)


LAYOUTS = {
    "whole slides": ("random_bins", "unseen4"),
    "half a second on either side": ("half_second random_bins", "half_second"),
}
"""The experiment split at random over bins and the one split by cycle, by layout."""


def leak(report: Report, layout: str, score: str) -> list[float]:
    """Test score of the split at random less that by cycle, in points, a number a shared seed."""
    both = [by_seed(report, name, "test", score) for name in LAYOUTS[layout]]
    return [a - b for a, b in zip(*on_shared_seeds(*both), strict=True)]


def leak_table(report: Report) -> Table:
    """What a split at random over bins adds to the test score."""
    rows = []
    for layout, (at_random, by_cycle) in LAYOUTS.items():
        for score, name in SCORES.items():
            found = leak(report, layout, score)
            if found:
                both = on_shared_seeds(
                    *(by_seed(report, of, "test", score) for of in (at_random, by_cycle))
                )
                cells = [*map(text, both), text(found, sign="+"), str(len(found))]
                rows.append([f"{name}, {layout}", *cells])
    header = ["test bins", "at random over bins, %", "by cycle, %", "leak, points", "seeds"]
    note = "All of the seeds that both splits have. The leak is that of each, then mean and spread."
    return Table(header, rows, note)
