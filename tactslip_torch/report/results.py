"""What a training run or an evaluation reports: ``metrics.json``, its tables and its figures.

All functions read what ``metrics.json`` holds. Scores are printed in percent with two decimals,
``-`` where there is none; the paper's numbers stand beside where hand and scenes are its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tactslip_torch.report import published
from tactslip_torch.report.metrics import CLASSES, covered_fractions
from tactslip_torch.report.style import (
    ALARM,
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALETTE,
    PURPLE,
    SMALL,
    TEXT,
    UPPER_LEFT_OUTSIDE,
    VERMILION,
    clean,
    colours_of,
    grouped,
    kind_colours,
    lanes,
    legend_below,
    marked,
    new_figure,
    percent,
    save,
    stack,
    table,
    text_rows,
    words,
)
from tactslip_torch.runtime import write_json

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
_CLASS_WORDS = {"non_slip": "non-slip", "slip": "slip"}
_OUTCOMES = {"found": GREEN, "early": ORANGE, "missed": "#999999"}
_Metrics = Mapping[str, Any]
"""The content of ``metrics.json``, or a part of it."""


def write_results(folder: Path, metrics: _Metrics, selected: Sequence[Mapping[str, str]]) -> None:
    """Write ``metrics.json`` and the figures of a run into a folder.

    Results on several kinds of scenes also get ``confound.png``, those with events ``events.png``,
    those of a detector that may abstain ``answers.png``, those that set an alarm ``alarm.png``
    and ``reliability.png``.

    Args:
        folder: made if it is not there.
        metrics: JSON-able, with ``simulated`` and ``splits``.
        selected: one mapping per selected feature, as ``selected_features_figure`` takes them.
    """
    write_json(folder / "metrics.json", metrics)
    simulated = metrics["simulated"]
    confusion_figure(metrics, folder / "confusion.png")
    if selected:
        selected_features_figure(selected, folder / "selected_features.png", simulated=simulated)
    if by_detector(metrics):
        confound_figure(metrics, folder / "confound.png")
    if _drawn_events(metrics):
        events_figure(metrics, folder / "events.png")
    if metrics.get("answers"):
        answers_figure(metrics, folder / "answers.png")
    if alarm := metrics.get("alarm"):
        alarm_figure(metrics, folder / "alarm.png")
        if by_role := alarm["reliability"]:
            reliability_figure(by_role, folder / "reliability.png", simulated=simulated)
    if rows := metrics.get("validation"):
        validation_figure(rows, folder / "validation.png", simulated=simulated)


def print_results(metrics: _Metrics, selected: Sequence[Mapping[str, str]]) -> None:
    """Print the tables of a run."""
    simulated = metrics["simulated"]
    texts = [splits_table(metrics), *_trained_on_lines(metrics), materials_table(metrics)]
    if metrics.get("events"):
        texts.append(events_table(metrics))
    if metrics.get("answers"):
        texts.append(answers_table(metrics))
    if alarm := metrics.get("alarm"):
        texts += [alarm_table(metrics), marked(simulated, table(scene_rows(metrics), num_left=2))]
        texts.append(reliability_table(alarm["reliability"], simulated=simulated))
    if by_detector(metrics):
        texts.append(confound_table(metrics))
    if selected:
        texts.append(selected_table(selected))
    if rows := metrics.get("validation"):
        nested = metrics.get("nested_validation")
        texts.append(validation_table(rows, simulated=simulated, nested=nested))
    texts += tuning_tables(metrics)
    if metrics.get("solve"):
        texts.append(solve_line(metrics["solve"]))
    if metrics.get("timing_s"):
        texts.append(timing_table(metrics["timing_s"]))
    print("\n" + "\n\n".join(texts))


# Scores per bin ----------------------------------------------------------------------------------
def splits_table(metrics: _Metrics) -> str:
    """Accuracy, balanced accuracy, both recalls and bins of each split; baselines and paper below.

    The paper's row is left out where hand or scenes are not its own. The first line says SIMULATED
    where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[list[object]] = [["split", *_SCORES.values(), "bins"]]
    for name, scores in metrics["splits"].items():
        rows.append([name, *_score_cells(scores), scores["num_bins"]])
        for baseline, result in metrics.get("baselines", {}).items():
            if name in result["splits"]:
                label = f"  {BASELINES.get(baseline, baseline)}"
                rows.append([label, *_score_cells(result["splits"][name]), None])
        if paper := published.beside(metrics, name):
            rows.append(["  paper", *_score_cells(vars(paper)), None])
    source = [PAPER_LINE] if metrics.get("is_papers_hand", True) else []
    return marked(metrics["simulated"], table(rows), *source)


def materials_table(metrics: _Metrics) -> str:
    """The same scores within each split for each material, stroke speed and, of several, scene.

    Where there are several scenes, a line above says that materials and speeds are of the paper's
    alone (``bin_metrics``).

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[list[object]] = [["split", "group", *_SCORES.values(), "bins"]]
    head = []
    for name, split in metrics["splits"].items():
        groups = dict(split.get("per_material", {}))
        for speed, scores in split.get("per_speed", {}).items():
            groups["no stroke" if speed == "0" else f"{speed} mm/s"] = scores
        if len(scenes := split.get("per_scene", {})) > 1:
            head = [PAPER_SCENE_LINE]
            groups |= {f"scene {scene}": scores for scene, scores in scenes.items()}
        for group, scores in groups.items():
            rows.append([name, group, *_score_cells(scores), scores["num_bins"]])
    return marked(metrics["simulated"], *head, table(rows, num_left=2, merged=1))


def _trained_on_lines(metrics: _Metrics) -> list[str]:
    """Which materials, sessions and scenes were trained on, a line each fold that says so."""
    lines = []
    for name, fold in (metrics.get("folds") or {"": metrics}).items():
        if known := fold.get("trained_on"):
            listed = "; ".join(f"{what} {', '.join(names)}" for what, names in known.items())
            lines.append(f"{name + ' ' if name else ''}trained on {listed}")
    return ["\n".join(lines)] if lines else []


def timing_table(timing_s: Mapping[str, float]) -> str:
    """Seconds of each stage and its fraction of the whole.

    Args:
        timing_s: seconds by stage. ``total`` is the whole if given, else their sum is.

    Example:
        >>> print(timing_table({"features": 30.0, "solve": 10.0}))
        stage     seconds  of all %
        features    30.00     75.00
        solve       10.00     25.00
        total       40.00    100.00
    """
    stages = {name: float(value) for name, value in timing_s.items() if name != "total"}
    total = float(timing_s.get("total", sum(stages.values())))
    rows = [["stage", "seconds", "of all %"]]
    for name, seconds in (stages | {"total": total}).items():
        rows.append([name, f"{seconds:.2f}", percent(seconds / total if total else None)])
    return table(rows)


def solve_line(solve: Mapping[str, Any]) -> str:
    """How the machine was solved for, in a line: ``SolveReport.facts`` in words."""
    line = (
        f"solved by {solve['method']}: {solve['rank']} of {solve['size']} unknowns, condition "
        f"{float(solve['condition']):.1e}, relative error of the weights about "
        f"{float(solve['error']):.0e}"
    )
    return f"{line}, unless what is left out is null" if solve.get("left_out") else line


def confusion_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write one confusion matrix per split: bins counted, and percent of each true class.

    The paper's recalls are the caption of a panel where it states them, of scenes of its own.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there is no split.
    """
    splits = metrics["splits"]
    if not splits:
        raise ValueError("metrics has no split to draw")
    num_columns = min(4, len(splits))
    num_rows = -(-len(splits) // num_columns)
    size = (max(4.6, 3.4 * num_columns), 3.8 * num_rows + 0.6)
    figure = new_figure(*size, "Contact status per bin", simulated=metrics["simulated"])
    panels = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    for axes, name in zip(panels, splits, strict=False):
        _confusion_panel(axes, name, metrics)
    for axes in panels[len(splits) :]:
        axes.set_axis_off()
    save(figure, path, dpi=180)


def _confusion_panel(axes: Axes, name: str, metrics: _Metrics) -> None:
    """One split's 2 x 2 cells, coloured by the percentage of their row."""
    scores = metrics["splits"][name]
    counts = np.asarray(scores["confusion"], dtype=float)
    fractions = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1.15)
    for row, column in np.ndindex(2, 2):
        style: dict[str, Any] = {"ha": "center", "va": "center"}
        style["color"] = "white" if fractions[row, column] > 0.6 else INK
        value = percent(fractions[row, column] if counts[row].sum() else None)
        axes.text(column, row - 0.06, f"{value} %", fontsize=13, **style)
        num_bins = grouped(float(counts[row, column]))
        axes.text(column, row + 0.16, f"{num_bins} bins", fontsize=9, **style)
    axes.set_xticks([0, 1], ["non-slip", "slip"], fontsize=10)
    axes.set_yticks([0, 1], ["non-slip", "slip"], fontsize=10, rotation=90, va="center")
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.axhline(0.5, color="white", linewidth=2)
    axes.axvline(0.5, color="white", linewidth=2)
    axes.set_ylabel("truth", fontsize=10, color=GREY)
    axes.set_title(name, fontsize=11, fontweight="bold", pad=21)
    axes.text(0.5, -0.545, _accuracies(scores), ha="center", fontsize=9)  # below the title
    paper = published.beside(metrics, name)
    lines = ["", ""]
    if paper and paper.non_slip_recall is not None:
        recalls = (percent(recall, 1) for recall in (paper.non_slip_recall, paper.slip_recall))
        lines = ["paper: non-slip {} %, slip {} %".format(*recalls), _accuracies(vars(paper))]
    elif paper:
        lines = [f"paper: accuracy {percent(paper.accuracy)} %", ""]
    axes.set_xlabel("\n".join(["prediction", *lines]), fontsize=9, color=GREY)


def _accuracies(scores: Mapping[str, Any]) -> str:
    values = (percent(scores[key]) for key in ("accuracy", "balanced_accuracy"))
    return "accuracy {} %, balanced {} %".format(*values)


def _score_cells(scores: Mapping[str, Any]) -> list[str]:
    return [percent(scores[key]) for key in _SCORES]


# Selected features -------------------------------------------------------------------------------
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
    rows: list[list[object]] = [["selected by", "", "ours", "paper"]]
    for key, of_paper in beside.items():
        shown = of_paper if is_papers else {}
        ours = Counter(feature[key] for feature in selected)
        counted = ours.most_common() + [(name, 0) for name in shown if name not in ours]
        rows += [[key, value, count, shown.get(value)] for value, count in counted]
    rows.append(["all", "", len(selected), published.NUM_SELECTED])
    if not is_papers:
        return table([row[:-1] for row in rows], num_left=2, merged=1)
    said = f"{published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
    return f"{table(rows, num_left=2, merged=1)}\npaper, in words: {said}"


_COMPONENTS = ("raw", "A1", "A2", "A3", "A4", "D1", "D2", "D3", "D4")
_DOMAIN_WORDS = {"time": "time domain", "freq": "frequency domain"}


def selected_features_figure(
    selected: Sequence[Mapping[str, str]], path: str | Path, *, simulated: bool
) -> None:
    """Write where the selected features come from: four panels, the paper's counts beside.

    By sensor kind, by signal component, by finger, and by descriptor. For components and
    descriptors the paper prints no counts, so words and the order of its ranking stand in.
    Features of another hand than the paper's stand alone. What the paper published is hatched.

    Args:
        selected: one mapping per feature with ``channel``, ``component``, ``domain``,
            ``descriptor``, ``kind`` and ``finger``; of a pooled one ``statistic``, which then
            stands in place of the finger.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the bins they were ranked on are.

    Raises:
        ValueError: if nothing is selected.
    """
    if not selected:
        raise ValueError("there is no selected feature to draw")
    title = f"Where the {len(selected)} selected features come from"
    figure = new_figure(12.0, 8.4, title, simulated=simulated)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.15, 1])
    kind, component, finger = (figure.add_subplot(grid[row, 0]) for row in range(3))
    descriptor = figure.add_subplot(grid[:, 1])
    is_papers = published.is_of_papers_hand(selected)
    known = ("SG", "PVDF") if is_papers else ()
    colours = kind_colours([*known, *sorted({feature["kind"] for feature in selected})])
    kinds = [feature["kind"] for feature in selected]

    of_paper = {name: {name: count} for name, count in published.SELECTED_BY_KIND.items()}
    pairs = list(zip(kinds, kinds, strict=True))
    _counts(kind, "(a) sensor kind", pairs, list(colours), colours, of_paper if is_papers else {})

    pairs = [(_DOMAIN_WORDS[feature["domain"]], feature["component"]) for feature in selected]
    of_domain = dict(zip(_DOMAIN_WORDS.values(), (PURPLE, GREEN), strict=True))
    _counts(component, "(b) signal component", pairs, list(_COMPONENTS), of_domain)
    if is_papers:
        said = f"paper: {published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
        component.set_xlabel(said, fontsize=9, color=GREY)

    is_pooled = any(feature.get("statistic") for feature in selected)
    pairs = [(f["kind"], f.get("statistic") or f["finger"]) for f in selected]
    by_finger = published.SELECTED_BY_FINGER if is_papers else {}
    title = "(c) statistic over channels" if is_pooled else "(c) finger"
    _counts(finger, title, pairs, list(by_finger.get("SG", ())), colours, by_finger)

    pairs = [(feature["kind"], feature["descriptor"]) for feature in selected]
    ranked = published.DESCRIPTORS_RANKED
    order = [*ranked, *published.DESCRIPTORS_NEVER]
    title = f"(d) descriptor{'  [rank in the paper]' if is_papers else ''}"
    names = _counts(descriptor, title, pairs, order, colours, is_horizontal=True)
    ranks = {name: f"  [{rank}]" for rank, name in enumerate(ranked, 1)} if is_papers else {}
    rest = "  [-]" if is_papers else ""
    lanes(descriptor, [words(name) + ranks.get(name, rest) for name in names])
    unit = "features; the paper never selects [-]" if is_papers else "features"
    descriptor.set_xlabel(unit, fontsize=9, color=GREY)
    save(figure, path, dpi=180)


def _counts(
    axes: Axes,
    title: str,
    pairs: Sequence[tuple[str, str]],
    order: Sequence[str],
    colours: Mapping[str, str],
    of_paper: Mapping[str, Mapping[str, int]] | None = None,
    *,
    is_horizontal: bool = False,
) -> list[str]:
    """Counts of (layer, column) pairs as stacked bars, the paper's hatched beside; the columns."""
    columns = [*order, *sorted({column for _, column in pairs} - set(order))]
    layers = {layer: Counter(c for own, c in pairs if own == layer) for layer in colours}
    shift, width = (0.2, 0.36) if of_paper else (0.0, 0.6)
    draw, start = (axes.barh, "left") if is_horizontal else (axes.bar, "bottom")
    beside: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9, "color": GREY}
    beside |= {"va": "center"} if is_horizontal else {"ha": "center"}
    highest = 0
    for counts, way, is_paper in ((layers, -1, False), (of_paper or {}, 1, True)):
        at, totals = np.arange(len(columns)) + way * shift, np.zeros(len(columns), dtype=int)
        for layer, by_column in counts.items():
            lengths = np.array([by_column.get(column, 0) for column in columns])
            has = (lengths > 0) | (not is_paper)  # an empty hatched bar would still be outlined
            style: dict[str, Any] = {"color": colours[layer], "label": layer}
            if is_paper:
                style = {"facecolor": "white", "edgecolor": colours[layer], "hatch": "////"}
                style["label"] = f"{layer}, paper"
            style[start] = totals[has]
            draw(at[has], lengths[has], width, **style)
            totals += lengths
        for place, total in zip(at, totals, strict=True) if counts else ():
            end, away = ((total, place), (3, 0)) if is_horizontal else ((place, total), (0, 2))
            axes.annotate(f"{total}", end, away, **beside)
        highest = max(highest, int(totals.max()))
    clean(axes, "x" if is_horizontal else "y")
    axes.set_title(title, loc="left", fontsize=11)
    axis, limit = (axes.xaxis, axes.set_xlim) if is_horizontal else (axes.yaxis, axes.set_ylim)
    axis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    limit(0, 1.16 * highest)
    if not is_horizontal:
        axes.set_xticks(range(len(columns)), columns, fontsize=10)
        axes.set_ylabel("features", fontsize=9, color=GREY)
    place_of: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
    axes.legend(frameon=False, fontsize=9, ncols=4, borderaxespad=0.3, handlelength=1.4, **place_of)
    return columns


# Choice of the model -----------------------------------------------------------------------------
def validation_table(
    rows: Sequence[Mapping[str, Any]],
    *,
    simulated: bool,
    nested: Mapping[str, Any] | None = None,
) -> str:
    """The mean balanced accuracy of choices and of their worst group.

    Of a nested choice the best penalty of each structure, the chosen row, the worst group at its
    own best threshold, and below what the choice itself scores on groups that it did not see.

    Args:
        rows: of ``metrics["validation"]``.
        simulated: whether the data is.
        nested: of ``metrics["nested_validation"]``.
    """
    is_nested = any("use" in row for row in rows)
    chosen = _chosen(rows)
    best: dict[tuple[str, ...], Mapping[str, Any]] = {}
    for row in rows:
        if row["mean"] > best.get(_structure(row), {"mean": -1.0})["mean"]:
            best[_structure(row)] = row
    header = ["chosen", *(["features"] if is_nested else []), "K", "kernel", "C", "validation %"]
    cells = [[*header, "worst %", "group", *(["at its best threshold %"] if is_nested else [])]]
    for row in rows:
        if is_nested and row is not chosen and row is not best[_structure(row)]:
            continue
        scores = {group: s for group, s in row["balanced_accuracy"].items() if s is not None}
        worst = min(scores, key=lambda group: scores[group])
        cell = ["*" if row is chosen else "", *_structure(row), f"{row['penalty']:g}"]
        cell += [percent(row["mean"]), percent(scores[worst]), worst]
        cells.append([*cell, *([percent(row["worst"]["at_best_threshold"])] if is_nested else [])])
    lines = [table(cells)]
    if nested:
        by_group = ", ".join(f"{g} {percent(s)}" for g, s in nested["balanced_accuracy"].items())
        lines.append(
            "the choice itself, made without each group and evaluated on it: "
            f"{percent(nested['mean'])} % ({by_group})"
        )
    return marked(simulated, *lines)


def validation_figure(
    rows: Sequence[Mapping[str, Any]], path: str | Path, *, simulated: bool
) -> None:
    """Write the balanced accuracy on left-out groups over C, one line for each structure.

    Thin lines are the groups, of the chosen structure alone. Of a nested choice a colour is a kind
    of features, and a dash the rest.

    Args:
        rows: of ``metrics["validation"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    title = "Choice on training groups left out one at a time"
    figure = new_figure(8.4, 4.6, title, simulated=simulated)
    axes = figure.subplots()
    chosen = _chosen(rows)
    structures = list(dict.fromkeys(map(_structure, rows)))
    uses = colours_of(" ".join(structure[:-2]) for structure in structures)
    rests = list(dict.fromkeys(structure[-2:] for structure in structures))
    for place, structure in enumerate(structures):
        line = [row for row in rows if _structure(row) == structure]
        line.sort(key=lambda row: float(row["penalty"]))
        *use, size, kernel = structure
        colour, dash = PALETTE[place % len(PALETTE)], "-"
        if len(uses) > 1:
            dash = ("-", "--", ":", "-.")[rests.index(structure[-2:]) % 4]
            colour = uses[" ".join(use)]
        penalties = [row["penalty"] for row in line]
        label = ", ".join([*use, f"K = {size}", kernel])
        means = [100 * row["mean"] for row in line]
        axes.plot(penalties, means, marker="o", ls=dash, color=colour, label=label, lw=2)
        if structure == _structure(chosen):
            _draw_groups(axes, line, penalties, colour)
    axes.plot(chosen["penalty"], 100 * chosen["mean"], "*", color="black", ms=14, label="chosen")
    axes.set_xscale("log")
    axes.set_xlabel("C")
    axes.set_ylabel("balanced accuracy on the group left out, %")
    axes.legend(frameon=False, fontsize=SMALL, handlelength=3.5, **UPPER_LEFT_OUTSIDE)
    clean(axes)
    save(figure, path)


def _draw_groups(
    axes: Axes, rows: Sequence[Mapping[str, Any]], penalties: Sequence[float], colour: str
) -> None:
    """A thin line for each group; the best and the worst at the last penalty are named."""
    last = {}
    for group in rows[0]["balanced_accuracy"]:
        known = [row["balanced_accuracy"][group] for row in rows]
        scores = [float("nan") if score is None else 100 * score for score in known]
        axes.plot(penalties, scores, color=colour, lw=0.7, alpha=0.6)
        if known[-1] is not None:
            last[group] = scores[-1]
    for group in {min(last, key=last.__getitem__), max(last, key=last.__getitem__)}:
        axes.annotate(f"  {group}", (penalties[-1], last[group]), fontsize=SMALL, color=GREY)


def _chosen(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The row that was taken: the one that says so, else the first of the best mean."""
    taken = next((row for row in rows if row.get("chosen")), None)
    return taken or max(rows, key=lambda row: float(row["mean"]))


def _structure(row: Mapping[str, Any]) -> tuple[str, ...]:
    """What a choice is but for its penalty: kind of features if there are several, K, kernel."""
    kernel = row["kernel"]
    said = f"rbf, gamma {kernel['gamma']:g}" if "gamma" in kernel else ""
    if kernel["kind"] == "polynomial":
        said = f"degree {kernel['degree']}, c {kernel['offset']:g}"
    return (*([row["use"]] if "use" in row else []), str(row["num_features"] or "all"), said)


HELD_NOTE = (
    "held-out: mean log loss (nats) and balanced accuracy of each training group under C, c "
    "and scales that were chosen without it; ranking, ranges, K and, by way of the other "
    "groups' descents, the number of steps have seen it. The detectors behind the other columns "
    "choose by all groups, the first on more bins"
)
WAYS = {
    "recipe": "grid, by balanced accuracy",
    "grid": "grid, by loss",
    "tuned": "tuned by gradient",
}


def held_mean(tuning: Mapping[str, Any], way: str, name: str = "loss") -> float:
    """Mean over held-out groups of what one way of choosing gets there."""
    return mean(float(group[way][name]) for group in tuning["held"])


def tuning_tables(metrics: _Metrics) -> list[str]:
    """A table for each fold that was tuned: loss and accuracy of groups the choice did not see.

    Behind them the accuracy of the detectors. Empty where nothing was tuned.

    Args:
        metrics: the content of ``metrics.json``.
    """
    texts = []
    for name, fold in {"": metrics, **metrics.get("folds", {})}.items():
        if not (tuning := fold.get("tuning")):
            continue
        splits = fold["splits"]
        roles = [role for role in splits if splits[role]["balanced_accuracy"] is not None]
        rows = [[f"tuning {name}".strip(), "held-out loss", "held-out %"]]
        rows[0] += [f"{role} %" for role in roles]
        for way, label in WAYS.items():
            detectors = splits if way == "tuned" else tuning["splits"][way]
            row = [label, f"{held_mean(tuning, way):.4f}"]
            row.append(percent(held_mean(tuning, way, "balanced_accuracy")))
            rows.append([*row, *(percent(detectors[r]["balanced_accuracy"]) for r in roles)])
        start = tuning["start"]
        steps = (
            f"{tuning['steps']} steps from C={start['penalty']:g}, c={start['offset']:g} to "
            f"C={tuning['penalty']:.3g}, c={tuning['offset']:.3g}; learned: "
            f"{', '.join(tuning['learned'])}; {tuning['bins']} bins; tuning took "
            f"{tuning['seconds']:.0f} s, the first fit with its grid {tuning['fit_s']:.0f} s"
        )
        texts.append(marked(metrics["simulated"], table(rows), HELD_NOTE, steps))
    return texts


def tuning_figure(tuning: Mapping[str, Any], path: str | Path, *, simulated: bool) -> None:
    """Write the descents of every held-out group, the one on all, and the learned scales.

    Args:
        tuning: ``metrics["tuning"]``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.
    """
    has_scales = "scales" in tuning["learned"]
    width = 12.5 if has_scales else 7.5
    figure = new_figure(width, 4.2, "Tuning through the fit", simulated=simulated)
    panels = figure.subplots(1, 1 + has_scales, squeeze=False)[0]
    _draw_descents(panels[0], tuning)
    if has_scales:
        _draw_scales(panels[1], tuning["scales"])
    save(figure, path)


def _draw_descents(axes: Axes, tuning: Mapping[str, Any]) -> None:
    """Losses over steps: of each held-out group, their mean, which decides, and of what learns."""
    losses = np.array([[row["held_loss"] for row in group["history"]] for group in tuning["held"]])
    for place, group in enumerate(tuning["held"]):
        colour, steps = PALETTE[place % len(PALETTE)], group["tuned"]["steps"]
        axes.plot(losses[place], color=colour, lw=1, label=group["held"])
        axes.plot(steps, losses[place, steps], "o", color=colour, markersize=4)
    axes.plot(losses.mean(axis=0), "k-", lw=2.5, label="their mean, which decides")
    learning = [row["loss"] for row in tuning["history"]]
    axes.plot(learning, "k--", lw=1.5, label="what is learned on")
    axes.axvline(tuning["steps"], color=GREY, lw=1)
    style: dict[str, Any] = {"va": "top", "fontsize": SMALL, "color": GREY}
    place_of = (tuning["steps"], 0.99)
    axes.annotate(" steps taken", place_of, xycoords=axes.get_xaxis_transform(), **style)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("steps")
    axes.set_ylabel("held-out log loss, nats")
    axes.set_title("groups held out; dots: steps chosen by the other groups", fontsize=10)
    axes.legend(frameon=False, fontsize=SMALL, **UPPER_LEFT_OUTSIDE)
    clean(axes)


def _draw_scales(axes: Axes, scales: Mapping[str, float]) -> None:
    """Learned scales, the largest first; the first and last few are named."""
    ordered = sorted(scales.items(), key=lambda item: -item[1])
    axes.bar(range(len(ordered)), [value for _, value in ordered], color=BLUE, width=0.8)
    axes.axhline(1, color=GREY, lw=1)
    for x, side, heading, named in (
        (0.02, "left", "largest", ordered[:3]),
        (0.98, "right", "smallest", ordered[-3:][::-1]),
    ):
        text = "\n".join([f"{heading}:", *(f"{value:.2f}  {name}" for name, value in named)])
        axes.text(x, 0.98, text, transform=axes.transAxes, va="top", ha=side, fontsize=7)
    axes.set_ylim(0, 1.5 * ordered[0][1])
    axes.set_xlabel("features, by scale")
    axes.set_ylabel("scale in the kernel")
    axes.set_title("learned scales: soft selection", fontsize=10)
    clean(axes, "y")


# Confounders: scenes that have motion without slip, or slip without motion ------------------------
class _SceneScores(NamedTuple):
    """Scores of one detector on one kind of scene; ``is_trained`` is None where nothing tells."""

    role: str
    scene: str
    detector: str
    is_trained: bool | None
    scores: Mapping[str, Any]


def by_detector(metrics: _Metrics) -> dict[str, Mapping[str, Any]]:
    """The splits of each fold, or of the one detector, if some held out are of several scenes.

    Empty otherwise, so that it also says whether there is anything to compare.

    Args:
        metrics: the content of ``metrics.json``.
    """
    folds = {name: fold["splits"] for name, fold in metrics.get("folds", {}).items()}
    detectors = folds or {"detector": metrics["splits"]}
    several = any(
        len(split.get("per_scene", {})) > 1
        for splits in detectors.values()
        for role, split in splits.items()
        if role != "train"
    )
    return detectors if several else {}


def _scene_scores(metrics: _Metrics) -> Iterator[_SceneScores]:
    """Scores by role, then scene, then detector: the paper's scene first, then those trained on."""
    detectors = by_detector(metrics)
    is_fit = "detector" not in metrics  # evaluate's training role is not what was trained on
    trained = {
        name: set(splits.get("train", {}).get("per_scene", {}))
        for name, splits in detectors.items()
    }
    of_any = set().union(*trained.values()) if is_fit else set()
    for role in dict.fromkeys(role for splits in detectors.values() for role in splits):
        if role == "train":
            continue
        having = {name: splits[role] for name, splits in detectors.items() if role in splits}
        scenes = dict.fromkeys(scene for split in having.values() for scene in split["per_scene"])
        for scene in sorted(scenes, key=lambda scene: (scene != "paper", scene not in of_any)):
            for name, split in having.items():
                if scene in split["per_scene"]:
                    is_trained = scene in trained[name] if is_fit else None
                    yield _SceneScores(role, scene, name, is_trained, split["per_scene"][scene])


def confound_table(metrics: _Metrics) -> str:
    """Bins, recalls and balanced accuracy of each detector on each kind of scene, held out.

    ``trained on it`` says whether other cycles of that scene were trained on, ``-`` where the
    results do not tell. A class without bins has the recall ``-``.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[list[object]] = [["evaluated on", "scene", "detector", "trained on it", "bins"]]
    rows[0] += ["non-slip %", "slip %", "balanced %"]
    for *about, scores in _scene_scores(metrics):
        keys = ("non_slip_recall", "slip_recall", "balanced_accuracy")
        rows.append([*about, scores["num_bins"], *(percent(scores[key]) for key in keys)])
    return marked(metrics["simulated"], table(rows, num_left=4))


def confound_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write false slips and slips found of each detector on each kind of scene, as a PNG.

    In the paper's protocol the hand slides whenever the arm moves, so a detector of motors scores
    well there; scenes in which one happens without the other tell them apart.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there are no several kinds of scenes.
    """
    scored = list(_scene_scores(metrics))
    if not scored:
        raise ValueError("metrics has no split with several kinds of scenes to draw")
    roles, scenes = (list(dict.fromkeys(column)) for column in list(zip(*scored, strict=True))[:2])
    colours = colours_of(one.detector for one in scored)
    height = 1.7 + len(roles) * (0.8 + 0.28 * len(scenes))
    title = "Does it detect slip, or the motion of the arm?"
    figure = new_figure(10.5, height, title, simulated=metrics["simulated"])
    panels = figure.subplots(len(roles), 2, sharex="col", sharey=True, squeeze=False)
    named = {"test": "test cycles of seen materials", "unseen": "unseen materials"}
    for (left, right), role in zip(panels, roles, strict=True):
        of_role = [one for one in scored if one.role == role]
        _draw_recalls(left, of_role, scenes, colours, "non_slip_recall")
        _draw_recalls(right, of_role, scenes, colours, "slip_recall")
        left.set_title(named.get(role, role), loc="left", fontsize=10.5)
    left.set_xlim(left=0)
    right.set_xlim(right=100)
    left.set_xlabel("false slips, % of non-slip bins: fewer is better", fontsize=TEXT)
    right.set_xlabel("slips found, % of slip bins: more is better", fontsize=TEXT)
    style: dict[str, Any] = {"marker": "o", "ls": "", "ms": 7.5, "mew": 1.8}
    handles = [Line2D([], [], color=colours[name], label=name, **style) for name in colours]
    if any(one.is_trained is False for one in scored):
        labels = {GREY: "trained on other cycles of that scene", "white": "scene not trained on"}
        for fill, label in labels.items():
            handles.append(Line2D([], [], color=GREY, mfc=fill, label=label, **style))
    legend_below(figure, handles, 4)
    save(figure, path)


def _draw_recalls(
    axes: Axes,
    scored: Sequence[_SceneScores],
    scenes: Sequence[str],
    colours: Mapping[str, str],
    key: str,
) -> None:
    """A lane per scene with a dot for each detector: recall of slip, or what non-slip's lacks.

    Dots of a scene stand a little below each other, so that equal ones are seen.
    """
    clean(axes)
    is_error = key == "non_slip_recall"
    for lane, scene in enumerate(scenes):
        own = [one for one in scored if one.scene == scene and one.scores[key] is not None]
        values = [100 * (1 - one.scores[key] if is_error else one.scores[key]) for one in own]
        if not own:
            text = "nothing but slip" if is_error else "no slip in this scene"
            style: dict[str, Any] = {"fontsize": 8.5, "color": GREY, "ha": "center", "va": "center"}
            style["bbox"] = {"fc": "white", "ec": "none", "pad": 2.0}
            axes.annotate(text, (0.5, lane), xycoords=axes.get_yaxis_transform(), **style)
        heights = lane + _spread(len(own), 0.13)
        axes.plot(values, heights, color="#BBBBBB", lw=2, zorder=1)
        for one, value, height in zip(own, values, heights, strict=True):
            colour = colours[one.detector]
            fill = "white" if one.is_trained is False else colour
            style = {"color": colour, "mfc": fill, "mew": 1.8, "ms": 7.5, "clip_on": False}
            axes.plot(value, height, "o", zorder=2, **style)
    lanes(axes, ["paper's protocol" if name == "paper" else words(name) for name in scenes])


def _spread(number: int, width: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Heights beside the middle of a lane; of one, the middle."""
    return np.linspace(-width, width, number) if number > 1 else np.zeros(number)


# Stated probabilities ----------------------------------------------------------------------------
def reliability_table(by_role: Mapping[str, Mapping[str, Any]], *, simulated: bool) -> str:
    """Calibration error, Brier score and log loss of each role, and of each material in it.

    Args:
        by_role: ``{role: {**Reliability.to_dict(), "per_material": {material: the same}}}``.
        simulated: whether the data is.
    """
    rows = [["role", "material", "bins", "ECE %", "worst cell %", "Brier", "log loss"]]
    for role, material, scores in _reliabilities(by_role):
        row = [role, material or "all", f"{sum(scores['counts']):.0f}"]
        row += [percent(scores["ece"]), percent(scores["mce"])]
        rows.append([*row, *(f"{scores[key]:.4f}" for key in ("brier", "log_loss"))])
    return marked(simulated, table(rows, num_left=2, merged=1))


def reliability_figure(
    by_role: Mapping[str, Mapping[str, Any]], path: str | Path, *, simulated: bool
) -> None:
    """Write the reliability curve of each role with its counts, and the error of each material.

    Args:
        by_role: as of ``reliability_table``.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the data is.

    Raises:
        ValueError: if there is no role.
    """
    if not by_role:
        raise ValueError("there is no role whose probabilities could be drawn")
    rows = list(_reliabilities(by_role))
    title = "Does a stated probability of slip come true?"
    figure = new_figure(10.5, max(5.2, 1.6 + 0.26 * len(rows)), title, simulated=simulated)
    grid = figure.add_gridspec(2, 2, height_ratios=(4, 1), width_ratios=(1.15, 1))
    curves = figure.add_subplot(grid[0, 0])
    counts = figure.add_subplot(grid[1, 0], sharex=curves)
    errors = figure.add_subplot(grid[:, 1])
    colours = colours_of(by_role)
    curves.plot([0, 1], [0, 1], color=GREY, linewidth=1, linestyle="--", label="as stated")
    for place, (role, scores) in enumerate(by_role.items()):
        num_bins, ece = grouped(sum(scores["counts"])), percent(scores["ece"])
        style: dict[str, Any] = {"color": colours[role], "linewidth": 1.5, "markersize": 5}
        style["label"] = f"{role}: {num_bins} bins, ECE {ece} %"
        curves.plot(scores["probabilities"], scores["slip_shares"], "o-", **style)
        at = np.array(scores["probabilities"]) + 0.01 * (place - (len(by_role) - 1) / 2)
        counts.bar(at, scores["counts"], width=0.01, color=colours[role])
    clean(curves)
    clean(counts, "y")
    clean(errors, "x")
    curves.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), ylabel="fraction of bins that slip")
    curves.tick_params(labelbottom=False)
    curves.legend(frameon=False, fontsize=9, loc="upper left")
    counts.set(xlabel="stated probability of slip, mean of a cell", ylabel="bins")
    for lane, (role, material, scores) in enumerate(rows):
        value = 100 * scores["ece"]
        errors.barh(lane, value, color=colours[role], alpha=0.45 if material else 1.0)
        errors.text(value, lane, f" {value:.2f}", va="center", fontsize=8, color=GREY)
    lanes(errors, [material or f"{role}, all" for role, material, _ in rows])
    errors.margins(x=0.15)
    errors.set_xlim(left=0)
    errors.set_xlabel("expected calibration error, %")
    save(figure, path)


def _reliabilities(
    by_role: Mapping[str, Mapping[str, Any]],
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Role, material and scores; the material is empty for the whole role."""
    for role, scores in by_role.items():
        yield role, "", scores
        for material, of_material in scores.get("per_material", {}).items():
            yield role, material, of_material


# Prediction sets ---------------------------------------------------------------------------------
def answers_table(metrics: _Metrics) -> str:
    """A row for each role: how often the detector abstains, how right the rest is, and coverage.

    ``covered`` is the mean over recordings of the fraction of bins that are not answered with the
    other class, ``reached`` the fraction of recordings that have what was asked in the mean. The
    first line says SIMULATED where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[list[object]] = [
        ["prediction sets", "abstains %", "of the others: right %", "balanced %"]
    ]
    for name in CLASSES[::-1]:
        rows[0] += [f"{_CLASS_WORDS[name]}: covered %", "reached %", "abstains %"]
    rows[0].append("recordings")
    for role, scores in metrics["answers"].items():
        row = [scores[key] for key in ("abstained", "decided_accuracy", "decided_balanced")]
        for name in CLASSES[::-1]:
            row += [scores[name][key] for key in ("coverage", "reached", "abstained")]
        rows.append([role, *map(percent, row), len(scores["recordings"])])
    asked = sorted({scores["coverage"] for scores in metrics["answers"].values()})
    note = (
        f"asked: {', '.join(f'{100 * coverage:g}' for coverage in asked)} % covered, of either "
        "class in the mean over recordings of materials that were trained on; nothing is "
        "guaranteed of others"
    )
    return marked(metrics["simulated"], table(rows), note)


def answers_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write the coverage of every recording, and what became of the bins of each role, as a PNG.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    answers: Mapping[str, Mapping[str, Any]] = metrics["answers"]
    rows = [(role, name) for role in answers for name in CLASSES[::-1]]
    title = "Prediction sets of a detector that may abstain: what they cover"
    figure = new_figure(11.0, 1.7 + 0.55 * len(rows), title, simulated=metrics["simulated"])
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": [1.25, 1.0]})
    outcomes = {"right": GREEN, "abstains": "#BBBBBB", "wrong": ALARM}
    for lane, (role, name) in enumerate(rows):
        scores, truth = answers[role], CLASSES.index(name)
        counts = torch.tensor(list(scores["recordings"].values())).view(-1, 2, 3)
        covered = 100 * covered_fractions(counts, truth).numpy()
        if len(covered):  # a dot for each recording, spread over the lane, and their mean
            heights = lane + _spread(len(covered), 0.28)
            left.plot(covered, heights, "o", color=(BLUE, ORANGE)[truth], ms=3, alpha=0.6, mew=0)
            left.plot([covered.mean()] * 2, [lane - 0.38, lane + 0.38], color=INK, lw=2)
        abstains, *rest = scores["counts"][truth]
        scale = 100 / max(abstains + sum(rest), 1)
        widths = [scale * count for count in (rest[truth], abstains, rest[1 - truth])]
        stack(right, lane, widths, outcomes.values())
    for coverage in {scores["coverage"] for scores in answers.values()}:
        left.axvline(100 * coverage, color=INK, ls="--", lw=1)
        place: dict[str, Any] = {"xycoords": left.get_xaxis_transform(), "ha": "right"}
        place |= {"xytext": (-4, 3), "textcoords": "offset points", "fontsize": SMALL}
        left.annotate("asked of the mean", (100 * coverage, 1), **place)
    clean(left, "x")
    clean(right, "x")
    lanes(left, [f"{role}, {_CLASS_WORDS[name]}" for role, name in rows])
    left.set_xlabel("covered of a recording's bins, %; bar: mean over recordings")
    right.set_xlabel("of the bins of a class, %")
    right.set_xlim(0, 100)
    handles = [Patch(color=colour, label=label) for label, colour in outcomes.items()]
    legend_below(figure, handles, 3)
    save(figure, path)


# Events: slips found and false alarms ------------------------------------------------------------
_REFLEX_MS = (60.0, 90.0)


def events_table(metrics: _Metrics) -> str:
    """One row for each role and rule; brackets hold intervals.

    ``delay`` is the median from the exact onset to the alarm, look-ahead within; ``slip-free`` is
    how long an alarm would have been false. Rates are by the hour where that is at least an hour,
    else by the minute. Where compute was measured, the parts of the mean delay follow in a second
    table. The first line says SIMULATED where the data is.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows = [["events", "rule", "slips", "found %", "early %", "missed %", "delay ms", "p95 ms"]]
    rows[0] += ["false alarms", "slip-free", "alarms a slip"]
    delays = [["mean delay, ms", "rule", "look-ahead", "bin fill", "decision", "all"]]
    delays[0].append("compute beside")
    reasons: dict[str, None] = {}
    for role, by_rule in metrics["events"].items():
        for rule, numbers in by_rule.items():
            hours = numbers["quiet_hours"]
            slip_free = f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"
            row = [role, words(rule), str(numbers["num_onsets"]), *_event_cells(numbers)]
            row += [_false_alarms(numbers), slip_free if hours else "-"]
            rows.append([*row, _value(numbers["alarms_per_slip"], 2)])
            parts = numbers["latency_ms"] or {}
            names = ("look_ahead", "bin_fill", "decision", "delay", "compute")
            known = (parts.get(name) for name in names)
            delays.append([*row[:2], *("-" if ms is None else f"{ms:.1f}" for ms in known)])
            if reason := numbers.get("reason"):
                reasons[reason] = None
    lines = [table(rows, num_left=2, merged=1)]
    if reasons:
        lines.append(f"no events: {'; '.join(reasons)}")
    if any(row[-1] != "-" for row in delays[1:]):
        lines += ["", table(delays, num_left=2, merged=1)]
    return marked(metrics["simulated"], *lines)


def _event_cells(numbers: Mapping[str, Any], digits: int = 1) -> list[str]:
    """Percent of slips found, early and missed, and two quantiles of the delay in ms."""
    cells = [_value(numbers[outcome], 1, 100) for outcome in _OUTCOMES]
    delay = numbers["delay_ms"] or {"median": None, "p95": None}
    return [*cells, _value(delay["median"], digits), _value(delay["p95"], digits)]


def _value(number: Mapping[str, float] | None, digits: int, scale: float = 1.0) -> str:
    """The value of a number with an interval, ``-`` where there is none."""
    return "-" if number is None else f"{scale * number['value']:.{digits}f}"


def _false_alarms(numbers: Mapping[str, Any]) -> str:
    """A rate with its interval, such as ``74.2 /min [70.1, 78.0]``."""
    unit, key = ("h", "per_hour") if numbers["quiet_hours"] >= 1 else ("min", "per_minute")
    rate = numbers[f"false_alarms_{key}"]
    if rate is None:
        return "-"
    return f"{rate['value']:.1f} /{unit} [{rate['low']:.1f}, {rate['high']:.1f}]"


def _drawn_events(metrics: _Metrics) -> dict[str, dict[str, Mapping[str, Any]]]:
    """By role, the rules in words that were evaluated on some recording."""
    drawn = {
        role: {words(rule): own for rule, own in by_rule.items() if own["num_recordings"]}
        for role, by_rule in metrics.get("events", {}).items()
    }
    return {role: by_rule for role, by_rule in drawn.items() if by_rule}


def events_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write slips found by time since the onset, and what became of all, as a PNG.

    A row for each role: to the left the fraction of slips that were found so many ms behind the
    onset, a line for each rule, of which the latest 5 % may leave the picture; to the right found,
    early and missed, with the false alarms.

    Args:
        metrics: the content of ``metrics.json``.
        path: the PNG to write, replaced as a whole if it exists.

    Raises:
        ValueError: if there is nothing to draw.
    """
    events = _drawn_events(metrics)
    if not events:
        raise ValueError("metrics has no events to draw")
    rules = dict.fromkeys(rule for by_rule in events.values() for rule in by_rule)
    free = [colour for colour in PALETTE if colour not in _OUTCOMES.values()]
    styles: dict[str, dict[str, Any]] = {}
    for place, rule in enumerate(rules):
        dash = ("-", "--", ":")[place // len(free) % 3]
        styles[rule] = {"color": free[place % len(free)], "ls": dash}
    heights = [1.3 + 0.3 * max(2, len(by_rule)) for by_rule in events.values()]
    title = "Which slips are found, how late, and how many alarms are false"
    figure = new_figure(11.0, 1.3 + sum(heights), title, simulated=metrics["simulated"])
    ratios = {"width_ratios": [1.25, 1.0], "height_ratios": heights}
    panels = figure.subplots(len(events), 2, sharex="col", squeeze=False, gridspec_kw=ratios)
    latest = _REFLEX_MS[1]
    for (role, by_rule), (left, right) in zip(events.items(), panels, strict=True):
        _draw_delays(left, by_rule, styles)
        _draw_outcomes(right, by_rule, styles)
        left.set_title(role, loc="left", fontsize=11, fontweight="bold")
        late = [own["delay_ms"]["p95"]["value"] for own in by_rule.values() if own["delay_ms"]]
        latest = max([latest, *late])
    left.set_xlim(0, 1.5 * latest)
    left.set_xlabel("time since the exact onset, ms (look-ahead within)", fontsize=TEXT)
    right.set_xlabel("of all slips, %", fontsize=TEXT)
    handles: list[Any] = [Line2D([], [], lw=2, label=rule, **styles[rule]) for rule in rules]
    handles.append(Line2D([], [], color=GREY, marker="o", ls="", label="median"))
    handles.append(Patch(color="#F0E6C8", label="grip reflex of people, 60 to 90 ms"))
    handles += [Patch(color=colour, label=outcome) for outcome, colour in _OUTCOMES.items()]
    legend_below(figure, handles, 6)
    save(figure, path)


def _draw_delays(
    axes: Axes, by_rule: Mapping[str, Mapping[str, Any]], styles: Mapping[str, Mapping[str, Any]]
) -> None:
    """The fraction of slips found by then, from the kept quantiles of the delays."""
    axes.axvspan(*_REFLEX_MS, color="#F0E6C8", zorder=0, lw=0)
    for rule, numbers in by_rule.items():
        if delay := numbers["delay_ms"]:
            found = 100 * numbers["found"]["value"]
            fractions = np.linspace(0, found, len(delay["quantiles"]))
            axes.plot(delay["quantiles"], fractions, lw=2, zorder=3, **styles[rule])
            middle = (delay["median"]["value"], found / 2)
            axes.plot(*middle, "o", color=styles[rule]["color"], ms=6, zorder=4)
    axes.set_ylim(0, 102)
    axes.set_ylabel("slips found, %", fontsize=TEXT)
    clean(axes)


def _draw_outcomes(
    axes: Axes, by_rule: Mapping[str, Mapping[str, Any]], styles: Mapping[str, Mapping[str, Any]]
) -> None:
    """Found, early and missed of each rule in one bar, the false alarms behind it."""
    clean(axes, "x")
    lanes(axes, list(by_rule), least=2)
    for lane, (rule, label) in enumerate(zip(by_rule, axes.get_yticklabels(), strict=True)):
        numbers = by_rule[rule]
        widths = [100 * (numbers[name] or {"value": 0.0})["value"] for name in _OUTCOMES]
        stack(axes, lane, widths, _OUTCOMES.values())
        style: dict[str, Any] = {"va": "center", "fontsize": 9}
        for width, end in zip(widths, np.cumsum(widths), strict=True):
            if width >= 7:
                middle = end - width / 2
                axes.text(middle, lane, f"{width:.1f}", color="white", ha="center", **style)
        style |= {"xycoords": axes.get_yaxis_transform(), "annotation_clip": False}
        axes.annotate(f"false alarms {_false_alarms(numbers)}", (1.02, lane), **style)
        label.set_color(styles[rule]["color"])
    axes.set_xlim(0, 100)


# Alarm at a given false-alarm rate ---------------------------------------------------------------
_STREAMS = {
    "test stream": ("seen materials", BLUE),
    "unseen stream": ("unseen materials", VERMILION),
}
_LEAST_RATE = 0.1  # an hour: where the figure's axis begins, and rates of 0 are drawn


def rate_rows(metrics: _Metrics) -> list[list[str]]:
    """The false-alarm rate that was reached: a header, and a row for each method on each stream.

    Rates are false alarms an hour on recordings without slip, in brackets their intervals: *as
    asked* where these hold the target, *more* or *fewer* where not. Slips are the protocol's.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    target = metrics["alarm"]["settings"]["target_per_hour"]
    rows: list[list[object]] = [
        ["materials", "method", "false alarms an hour without slip", "against target"]
    ]
    rows[0] += ["slips", "found %", "early %", "missed %", "delay ms", "p95 ms"]
    for role, (name, _) in _STREAMS.items():
        quiet = _quiet_rates(metrics, role)
        for method, numbers in metrics["events"].get(role, {}).items():
            reached, against = "-", "-"
            if method in quiet:
                rate, hours = quiet[method]
                ends = f"[{rate['low']:.2f}, {rate['high']:.2f}]"
                reached = f"{rate['value']:.2f} {ends} in {hours:.1f} h"
                against = "more" if rate["low"] > target else "as asked"
                against = "fewer" if rate["high"] < target else against
            cells = [name, words(method), reached, against, numbers["num_onsets"]]
            rows.append([*cells, *_event_cells(numbers)])
    return text_rows(rows, merged=1)


def _quiet_rates(metrics: _Metrics, role: str) -> dict[str, tuple[Mapping[str, float], float]]:
    """By method, false alarms an hour on the scene without slip, and its hours."""
    scene = metrics["alarm"]["settings"]["facts"]["slip_free"]
    rates = {}
    for method, numbers in metrics["events"].get(role, {}).items():
        quiet = numbers["per_scene"].get(scene)
        if quiet and quiet["false_alarms_per_hour"]:
            rates[method] = quiet["false_alarms_per_hour"], quiet["quiet_hours"]
    return rates


def target_line(metrics: _Metrics) -> str:
    """The rate that was asked for, on what the threshold was set, and what that gave there."""
    alarm = metrics["alarm"]
    settings, set_on = alarm["settings"], alarm["settings"]["facts"]["calibrated"]["rate"]
    return (
        f"asked for: {settings['target_per_hour']:g} false alarms an hour of "
        f"{settings['facts']['slip_free']}; {words(alarm['rule'])}, which the "
        f"detector's file has, was set on {set_on['hours']:.1f} h with {set_on['alarms']}"
    )


def alarm_table(metrics: _Metrics) -> str:
    """``target_line`` and ``rate_rows`` for the terminal.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    rows = table(rate_rows(metrics), num_left=2)
    return marked(metrics["simulated"], target_line(metrics), rows)


def scene_rows(metrics: _Metrics) -> list[list[str]]:
    """False alarms and slips found in confounding scenes, by the detector's own rule.

    Behind it the false alarms of the paper's rule and of the other methods. A header and a row for
    seen and unseen materials of every scene.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    alarm = metrics["alarm"]
    methods = alarm["methods"].items()
    beside = [name for name, method in methods if not method["calibrated"]]
    beside += [name for name, method in methods if method["scorer"] != "detector"]
    rows: list[list[object]] = [
        ["scene", "materials", "trained on", "quiet min", f"{words(alarm['rule'])} /h"]
    ]
    rows[0] += ["slips", "found %", "early %", "missed %", "delay ms"]
    rows[0] += [f"{name} /h" for name in beside]
    for scene, by_role in alarm["scenes"].items():
        for role in (role for role in by_role if role != "trained"):
            numbers = by_role[role][alarm["rule"]]
            row = [words(scene), {"test": "seen"}.get(role, role), bool(by_role["trained"])]
            row += [f"{60 * numbers['quiet_hours']:.0f}"]
            row += [_value(numbers["false_alarms_per_hour"], 1), numbers["num_onsets"]]
            row += _event_cells(numbers, digits=0)[:-1]
            row += [_value(by_role[role][name]["false_alarms_per_hour"], 1) for name in beside]
            rows.append(row)
    return text_rows(rows)


def alarm_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write the false-alarm rates that were reached, and those of every scene, as a PNG.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    alarm = metrics["alarm"]
    scenes, target = alarm["scenes"], alarm["settings"]["target_per_hour"]
    title = f"Asked for: {target:g} false alarms an hour (dashed)"
    height = 2.2 + 0.5 * max(len(alarm["methods"]), len(scenes))
    figure = new_figure(12.0, height, title, simulated=metrics["simulated"])
    left, right = figure.subplots(1, 2)
    quiet = {role: _quiet_rates(metrics, role) for role in _STREAMS}
    methods = [name for name in alarm["methods"] if any(name in rates for rates in quiet.values())]
    hours = []
    for place, (role, (name, colour)) in enumerate(_STREAMS.items()):
        rates = {method: rate for method, (rate, _) in quiet[role].items()}
        _draw_rates(left, methods, rates, 0.28 * place - 0.14, colour)
        left.plot([], [], "o-", color=colour, label=name)
        hours += [f"{spent:.1f} h of {name}" for _, spent in list(quiet[role].values())[-1:]]
        rates = {}
        for scene, by_role in scenes.items():
            if by_method := by_role.get(role.removesuffix(" stream")):
                rates[scene] = by_method[alarm["rule"]]["false_alarms_per_hour"]
        _draw_rates(right, list(scenes), rates, 0.28 * place - 0.14, colour)
    left.set_title(f"Without slip: {' and '.join(hours)}", fontsize=10, loc="left")
    trained = words(", ".join(scene for scene in scenes if scenes[scene]["trained"]))
    what = f" ({trained}: trained on)" if trained else ""
    right.set_title(f"Confounding scenes, by {words(alarm['rule'])}{what}", fontsize=10, loc="left")
    for axes in (left, right):
        axes.axvline(target, color=INK, linewidth=1, linestyle="--", zorder=1)
        axes.set_xscale("log")
        axes.set_xlim(left=0.8 * _LEAST_RATE)
        axes.set_xlabel("false alarms an hour, with interval (none: at the left edge)", fontsize=9)
        clean(axes, "x")
    left.legend(frameon=False, fontsize=9, loc="best")
    save(figure, path)


def _draw_rates(
    axes: Axes,
    names: Sequence[str],
    rates: Mapping[str, Mapping[str, float] | None],
    aside: float,
    colour: str,
) -> None:
    """A dot with its interval for every name that has a rate."""
    for lane, name in enumerate(names):
        if rate := rates.get(name):
            low, value, high = (max(rate[end], _LEAST_RATE) for end in ("low", "value", "high"))
            axes.plot([low, high], [lane + aside] * 2, color=colour, linewidth=1.6, zorder=2)
            axes.plot(value, lane + aside, "o", color=colour, markersize=6, zorder=3)
    lanes(axes, list(map(words, names)))
