"""Tables for the terminal: plain aligned text, the paper's numbers beside ours.

All of them read what ``metrics.json`` holds. Scores are printed in percent with two decimals,
``-`` where there is none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tactslip_torch.report import published

SIMULATED_LINE = "SIMULATED data: numbers of a simulated hand, not of the paper's"
PAPER_LINE = f"paper: {published.PAPER}; real hand, random split over bins"
PAPER_SCENE_LINE = "of several scenes: materials and speeds are of the paper's scene alone"

BASELINES = {
    "best_pooled_number": "best pooled number",
    "logistic_regression": "logistic regression, same features",
    "logistic_regression_simple": "logistic regression on mean, std, rms",
    "random_forest_simple": "random forest on mean, std, rms",
}
"""What baselines (``tactslip_torch.training.baselines``) are called in tables."""

_SCORES = {
    "accuracy": "accuracy %",
    "balanced_accuracy": "balanced %",
    "non_slip_recall": "non-slip %",
    "slip_recall": "slip %",
}


def splits_table(metrics: Mapping[str, Any]) -> str:
    """Accuracy, balanced accuracy, both recalls and bins of each split; baselines and paper below.

    The paper's row is left out where hand or scenes are not its own. The first line says SIMULATED
    where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows = []
    baselines = metrics.get("baselines", {})
    for name, scores in metrics["splits"].items():
        rows.append([name, *_score_cells(scores), str(scores["num_bins"])])
        for baseline, found in baselines.items():
            if name in found["splits"]:
                label = f"  {BASELINES.get(baseline, baseline)}"
                rows.append([label, *_score_cells(found["splits"][name]), "-"])
        if paper := published.beside(metrics, name):
            rows.append(["  paper", *_score_cells(vars(paper)), "-"])
    source = [PAPER_LINE] if metrics.get("is_papers_hand", True) else []
    return _titled(metrics, aligned(["split", *_SCORES.values(), "bins"], rows), *source)


def materials_table(metrics: Mapping[str, Any]) -> str:
    """The same scores within each split for each material, stroke speed and, of several, scene.

    Where there are several scenes, a line above says that materials and speeds are of the paper's
    alone (``bin_metrics``).

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows = []
    head = []
    for name, split in metrics["splits"].items():
        groups = dict(split.get("per_material", {}))
        for speed, of in split.get("per_speed", {}).items():
            groups["no stroke" if speed == "0" else f"{speed} mm/s"] = of
        if len(scenes := split.get("per_scene", {})) > 1:
            head = [PAPER_SCENE_LINE]
            groups |= {f"scene {scene}": of for scene, of in scenes.items()}
        for position, (group, scores) in enumerate(groups.items()):
            first = name if position == 0 else ""
            rows.append([first, group, *_score_cells(scores), str(scores["num_bins"])])
    header = ["split", "group", *_SCORES.values(), "bins"]
    return _titled(metrics, "\n".join([*head, aligned(header, rows, num_left=2)]))


def trained_on_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Which materials, sessions and scenes were trained on, a line each fold that says so."""
    folds = metrics.get("folds") or {"": metrics}
    lines = []
    for name, fold in folds.items():
        if known := fold.get("trained_on"):
            listed = "; ".join(f"{what} {', '.join(of)}" for what, of in known.items())
            lines.append(f"{name + ' ' if name else ''}trained on {listed}")
    return ["\n".join(lines)] if lines else []


def timing_table(timing_s: Mapping[str, float]) -> str:
    """Seconds of each stage and its share of the whole.

    Args:
        timing_s: seconds by stage. ``total`` is the whole if given, else their sum is.

    Example:
        >>> print(timing_table({"features": 30.0, "solve": 10.0}))
        stage     seconds  share %
        features    30.00    75.00
        solve       10.00    25.00
        total       40.00   100.00
    """
    stages = {name: float(value) for name, value in timing_s.items() if name != "total"}
    total = float(timing_s.get("total", sum(stages.values())))
    rows = [
        [name, f"{seconds:.2f}", _percent(seconds / total if total else None)]
        for name, seconds in [*stages.items(), ("total", total)]
    ]
    return aligned(["stage", "seconds", "share %"], rows)


def selected_table(selected: Sequence[Mapping[str, str]]) -> str:
    """How many selected features come from each kind, component, finger, domain, descriptor.

    The paper's counts stand beside where it prints them; for descriptors it gives only an order,
    so their column holds a rank such as ``#1``, and ``0`` for the two it never selects. Features
    of another hand than the paper's stand alone.

    Args:
        selected: one mapping per feature with ``channel``, ``component``, ``domain``,
            ``descriptor``, ``kind`` and ``finger``.
    """
    is_papers = published.is_of_papers_hand(selected)
    by_finger: Counter[str] = Counter()
    for counts in published.SELECTED_BY_FINGER.values():
        by_finger.update(counts)
    ranks = {name: f"#{rank}" for rank, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    ranks |= dict.fromkeys(published.DESCRIPTORS_NEVER, "0")
    beside: dict[str, Mapping[str, object]] = {
        "kind": published.SELECTED_BY_KIND,
        "component": {"D1": 0},
        "finger": by_finger,
        "domain": {},
        "descriptor": ranks,
    }
    if not is_papers:
        beside = {key: {} for key in beside}
    rows = []
    for key, of_paper in beside.items():
        ours = Counter(feature[key] for feature in selected)
        for position, (value, count) in enumerate(_most_common(ours, of_paper)):
            first = key if position == 0 else ""
            rows.append([first, value, str(count), str(of_paper.get(value, "-"))])
    rows.append(["all", "", str(len(selected)), str(published.NUM_SELECTED)])
    if not is_papers:
        return aligned(["selected by", "", "ours"], [row[:-1] for row in rows], num_left=2)
    table = aligned(["selected by", "", "ours", "paper"], rows, num_left=2)
    return (
        f"{table}\npaper, in words: {published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
    )


def _most_common(ours: Counter[str], of_paper: Iterable[str]) -> list[tuple[str, int]]:
    """Our counts, largest first, then what only the paper has, with 0."""
    return ours.most_common() + [(name, 0) for name in of_paper if name not in ours]


def _score_cells(scores: Mapping[str, Any]) -> list[str]:
    return [_percent(scores[key]) for key in _SCORES]


def _percent(fraction: float | None) -> str:
    return "-" if fraction is None else f"{100 * fraction:.2f}"


def _titled(metrics: Mapping[str, Any], table: str, *notes: str) -> str:
    """The table under the line that no simulated number may be printed without."""
    return "\n".join([*([SIMULATED_LINE] if metrics["simulated"] else []), table, *notes])


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], num_left: int = 1) -> str:
    """Columns padded to their widest cell: ``num_left`` flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for row in [header, *rows]:
        cells = [
            cell.ljust(width) if position < num_left else cell.rjust(width)
            for position, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def solve_line(solve: Mapping[str, Any]) -> str:
    """How the machine was solved for, in a line: ``SolveReport.facts`` in words."""
    line = (
        f"solved by {solve['method']}: {solve['rank']} of {solve['size']} unknowns, condition "
        f"{float(solve['condition']):.1e}, relative error of the weights about "
        f"{float(solve['error']):.0e}"
    )
    return f"{line}, unless what is left out is null" if solve.get("left_out") else line
