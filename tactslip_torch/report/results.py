"""What a training run or an evaluation reports: ``metrics.json``, its tables and its figures.

All functions read what ``metrics.json`` holds. Scores are printed in percent with two decimals,
``-`` where there is none; the paper's numbers stand beside where hand and scenes are its own. Every
table says SIMULATED in its first line where the data is, every figure in its title.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tactslip_torch.report import published, style
from tactslip_torch.runtime import write_json

PAPER_LINE = f"paper: {published.PAPER}; real hand, random split over bins"
_PAPER_SCENE_LINE = "of several scenes: materials and speeds are of the paper's scene alone"
_SCENE_LINE = f"of several scenes: objects and speeds are of the scene {style.UNNAMED_SCENE} alone"
_NO_SPEED = {"0": "no slide", "nan": "speed not known"}
BASELINES = {
    "best_pooled_number": "best pooled number",
    "logistic_regression": "logistic regression, same features",
    "logistic_regression_simple": "logistic regression on simple statistics",
    "random_forest_simple": "random forest on simple statistics",
}
"""What baselines (``tactslip_torch.training.baselines``) are called in tables."""
_OF_SIMPLE = (
    "try recipe.views=[simple], longer bins (labels.bin_ms) and recordings of more objects; where "
    "it stays ahead, a classifier on simple statistics is the better one for this hand"
)
_ADVICE = {
    "best_pooled_number": "try recipe.views=[pooled], few columns (recipe.num_features=20) and "
    "more recordings",
    "logistic_regression": "try recipe.views=[pooled], linear as well, and more recordings",
    "logistic_regression_simple": _OF_SIMPLE,
    "random_forest_simple": _OF_SIMPLE,
}
"""What to do where a baseline is ahead."""
FEWEST_SLIPS, FEWEST_HOURS = 30, 1
"""Slips and hours without slip below which a rate says little."""
_SCORES = {
    "accuracy": "accuracy %",
    "balanced_accuracy": "balanced %",
    "non_slip_recall": "non-slip %",
    "slip_recall": "slip %",
}
_OUTCOMES = {"found": style.GREEN, "early": style.ORANGE, "missed": "#999999"}
_Metrics = Mapping[str, Any]
"""The content of ``metrics.json``, or a part of it."""
_Row = dict[str, object]


def write_results(folder: Path, metrics: _Metrics, selected: Sequence[Mapping[str, str]]) -> None:
    """Write ``metrics.json`` and the figures of a run into a folder.

    Results on several kinds of scenes also get ``confound.png``, those with events ``events.png``,
    those that set an alarm ``alarm.png`` and ``reliability.png``.

    Args:
        folder: made if it is not there.
        metrics: JSON-able, with ``simulated`` and ``splits``.
        selected: one mapping per selected feature, as ``_selected_features_figure`` takes them.
    """
    write_json(folder / "metrics.json", metrics)
    _confusion_figure(metrics, folder / "confusion.png")
    if selected:
        path, simulated = folder / "selected_features.png", metrics["simulated"]
        _selected_features_figure(selected, path, simulated=simulated)
    alarm = metrics.get("alarm") or {}
    for is_there, draw, name in (
        (_scene_rows(metrics), _confound_figure, "confound"),
        (_drawn_events(metrics), _events_figure, "events"),
        (alarm, _alarm_figure, "alarm"),
        (alarm.get("reliability"), _reliability_figure, "reliability"),
    ):
        if is_there:
            draw(metrics, folder / f"{name}.png")


def print_results(metrics: _Metrics, selected: Sequence[Mapping[str, str]]) -> None:
    """Print the tables of a run."""
    texts = [_splits_table(metrics), *_not_valid_lines(metrics), *_comparison_lines(metrics)]
    texts += _trained_on_lines(metrics)
    texts.append(_materials_table(metrics))
    for key, tables in (
        ("events", (_events_table,)),
        ("alarm", (_alarm_table, _scenes_table, _reliability_table)),
    ):
        texts += [one(metrics) for one in tables if metrics.get(key)]
    if _scene_rows(metrics):
        texts.append(_confound_table(metrics))
    if selected:
        texts.append(_selected_table(selected))
    if metrics.get("validation"):
        texts.append(_validation_table(metrics))
    if metrics.get("solve"):
        texts.append(_solve_line(metrics["solve"]))
    if metrics.get("timing_s"):
        texts.append(_timing_table(metrics["timing_s"]))
    print("\n" + "\n\n".join(texts))


# Scores per bin ----------------------------------------------------------------------------------
def _percents(scores: Mapping[str, Any], titles: Mapping[str, str]) -> _Row:
    """Scores in percent, by what they are called."""
    return {title: style.percent(scores[key]) for key, title in titles.items()}


def _score_cells(scores: Mapping[str, Any]) -> _Row:
    return _percents(scores, _SCORES) | {"bins": scores.get("num_bins")}


def _not_valid_lines(metrics: _Metrics) -> list[str]:
    """One for each split that has bins without a valid decision."""
    return [
        f"{name}: {num} of {scores['num_bins']} bins have too few channels alive, so that their "
        "decision is not valid; they count as non-slip"
        for name, scores in metrics["splits"].items()
        if (num := scores.get("num_not_valid"))
    ]


def _splits_table(metrics: _Metrics) -> str:
    """Accuracy, balanced accuracy, both recalls and bins of each split; baselines and paper below.

    The paper's row is left out where hand or scenes are not its own.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[_Row] = []
    for name, scores in metrics["splits"].items():
        rows.append({"split": name} | _score_cells(scores))
        for baseline, result in metrics.get("baselines", {}).items():
            if name in result["splits"]:
                cells = _score_cells(result["splits"][name]) | {"bins": None}
                rows.append({"split": f"  {BASELINES.get(baseline, baseline)}"} | cells)
        if paper := _beside(metrics, name):
            rows.append({"split": "  paper"} | _score_cells(vars(paper)))
    source = [PAPER_LINE] if metrics.get("is_papers_hand", True) else []
    return style.marked(metrics["simulated"], style.table(rows), *source)


def _comparison_lines(metrics: _Metrics) -> list[str]:
    """A line for each held-out split: which baseline is ahead of the detector, or that none is.

    One is ahead where the whole interval of its difference is above 0. Then the line says what to
    do; else it names the best baseline.

    Args:
        metrics: the content of ``metrics.json``.
    """
    lines = []
    for role, found in metrics.get("comparison", {}).items():
        known = found["baselines"]
        differences = {name: own["difference"] for name, own in known.items()}
        sure = {name: own for name, own in differences.items() if own["low"] is not None}
        ahead = [name for name, own in sure.items() if own["low"] > 0]
        best = max(ahead or known, key=lambda name: float(differences[name]["value"]))
        named, score = BASELINES[best], style.percent(known[best]["balanced_accuracy"], 1)
        own_score, between = style.percent(found["detector"], 1), "too few for an interval"
        if best in sure:
            what = _group_word(metrics, found["drawn"])
            low, high = (f"{100 * sure[best][end]:.1f}" for end in ("low", "high"))
            drawn = f"95 % interval over {found['num_drawn']} {what}s"
            between = f"difference {low} to {high} points, {drawn}"
        if ahead:
            lines.append(
                f"{named} is ahead of the detector on {role} recordings: {score} against "
                f"{own_score} % balanced ({between}); {_ADVICE[best]}"
            )
            continue
        is_behind = len(sure) == len(known) and all(own["high"] < 0 for own in sure.values())
        begin = "the detector is ahead of every baseline" if is_behind else "no baseline is ahead"
        line = (
            f"{begin} on {role} recordings: the detector has {own_score} % balanced, {named}, the "
            f"best of them, {score} ({between})"
        )
        if score != own_score and float(differences[best]["value"]) > 0:
            line += f"; it is higher, which so few do not make sure: {_ADVICE[best]}"
        lines.append(line)
    return ["\n".join(lines)] if lines else []


def _group_word(metrics: _Metrics, group: str) -> str:
    """What a group of recordings is called: a material of the paper's hand, else an object."""
    return "object" if group == "material" and not _is_papers_hand(metrics) else group


def _is_papers_hand(metrics: _Metrics) -> bool:
    return bool(metrics.get("is_papers_hand", True))


def _scene_name(metrics: _Metrics, scene: str) -> str:
    """A scene as it is shown; the paper's is the default where nothing names one."""
    is_default = scene == published.PAPER_SCENE and not _is_papers_hand(metrics)
    return style.UNNAMED_SCENE if is_default else scene


def _materials_table(metrics: _Metrics) -> str:
    """The same scores within each split for each material, speed and, of several, scene.

    Speeds are shown where some are known. Of another hand than the paper's, recordings that were
    trained on are left out. Of several scenes a line above says where materials and speeds are of
    the paper's alone (``bin_metrics``).

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[_Row] = []
    head, splits = [], dict(metrics["splits"])
    if len(splits) > 1 and not _is_papers_hand(metrics):
        splits.pop("train", None)
    for name, split in splits.items():
        groups = dict(split.get("per_material", {}))
        speeds = split.get("per_speed", {})
        for speed, scores in speeds.items() if set(speeds) - {"0", "nan"} else ():
            groups[_NO_SPEED.get(speed, f"{speed} mm/s")] = scores
        if len(scenes := split.get("per_scene", {})) > 1:
            if published.PAPER_SCENE in scenes:
                head = [_PAPER_SCENE_LINE if _is_papers_hand(metrics) else _SCENE_LINE]
            groups |= {f"scene {_scene_name(metrics, s)}": of for s, of in scenes.items()}
        rows += [{"split": name, "group": group} | _score_cells(of) for group, of in groups.items()]
    return style.marked(metrics["simulated"], *head, style.table(rows, num_left=2, merged=1))


def _trained_on_lines(metrics: _Metrics) -> list[str]:
    """Which materials, sessions and scenes were trained on, a line each fold that says so.

    Of a detector that was trained on all recordings: which numbers are of it and which are not.
    """
    if number := metrics.get("num_recordings"):
        folds = len(metrics.get("folds") or [metrics])
        held_out = " and ".join(role for role in metrics["splits"] if role != "train")
        return [
            f"{held_out}: {folds} folds, each of a detector trained without these recordings\n"
            f"detector.pt: trained on all {number} recordings; no number above was measured on it, "
            f"{held_out} shows what to expect of it"
        ]
    lines = []
    for name, fold in (metrics.get("folds") or {"": metrics}).items():
        if known := _trained_on(metrics, fold.get("trained_on", {})):
            listed = "; ".join(f"{what} {', '.join(names)}" for what, names in known.items())
            lines.append(f"{name} trained on {listed}".strip())
    return ["\n".join(lines)] if lines else []


def _trained_on(metrics: _Metrics, known: Mapping[str, Sequence[str]]) -> dict[str, Sequence[str]]:
    """What was trained on, in the user's words; without a session or scene that is the only one."""
    if _is_papers_hand(metrics):
        return dict(known)
    found = {"objects" if what == "materials" else what: names for what, names in known.items()}
    found["scenes"] = [_scene_name(metrics, scene) for scene in found.get("scenes", ())]
    return {what: names for what, names in found.items() if what == "objects" or len(names) > 1}


def _timing_table(timing_s: Mapping[str, float]) -> str:
    """Seconds of each stage and its fraction of the whole.

    Args:
        timing_s: seconds by stage. ``total`` is the whole if given, else their sum is.

    Example:
        >>> print(_timing_table({"features": 30.0, "solve": 10.0}))
        stage     seconds  of all %
        features    30.00     75.00
        solve       10.00     25.00
        total       40.00    100.00
    """
    stages = {name: float(value) for name, value in timing_s.items() if name != "total"}
    total = float(timing_s.get("total", sum(stages.values())))
    rows = []
    for name, seconds in (stages | {"total": total}).items():
        fraction = style.percent(seconds / total if total else None)
        rows.append({"stage": name, "seconds": f"{seconds:.2f}", "of all %": fraction})
    return style.table(rows)


def _solve_line(solve: Mapping[str, Any]) -> str:
    """How the machine was solved for, in a line: ``SolveReport.metadata`` in words."""
    line = (
        f"solved by {solve['method']}: {solve['rank']} of {solve['size']} unknowns, condition "
        f"{float(solve['condition']):.1e}, relative error of training scores up to "
        f"{float(solve['error']):.0e}"
    )
    return f"{line}, unless what is left out is null" if solve["rank"] < solve["size"] else line


@style.styled
def _confusion_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write one confusion matrix per split: bins counted, and percent of each true class.

    The paper's recalls are the caption of a panel where it states them, of scenes of its own.

    Args:
        metrics: the content of ``metrics.json``, with at least one split.
        path: the PNG to write, replaced as a whole if it exists.
    """
    splits = metrics["splits"]
    num_columns = min(4, len(splits))
    num_rows = -(-len(splits) // num_columns)
    size = (max(4.6, 3.4 * num_columns), 3.8 * num_rows + 0.6)
    figure = style.new_figure(*size, "Contact status per bin", simulated=metrics["simulated"])
    panels = figure.subplots(num_rows, num_columns, squeeze=False).ravel()
    for axes, (name, scores) in zip(panels, splits.items(), strict=False):
        _confusion_panel(axes, name, scores, _beside(metrics, name))
    for axes in panels[len(splits) :]:
        axes.set_axis_off()
    style.save(figure, path, dpi=180)


def _confusion_panel(
    axes: Axes, name: str, scores: _Metrics, paper: published.PublishedSplit | None
) -> None:
    """One split's 2 x 2 cells, coloured by the percentage of their row."""
    counts = np.asarray(scores["confusion"])
    fractions = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(fractions, cmap="Blues", vmin=0, vmax=1.15)
    for row, column in np.ndindex(2, 2):
        look: dict[str, Any] = {"ha": "center", "va": "center"}
        look["color"] = "white" if fractions[row, column] > 0.6 else style.INK
        value = style.percent(fractions[row, column] if counts[row].any() else None)
        axes.text(column, row - 0.06, f"{value} %", fontsize=13, **look)
        axes.text(column, row + 0.16, f"{style.grouped(int(counts[row, column]))} bins", **look)
    names = ["non-slip", "slip"]
    axes.set_xticks([0, 1], names)
    axes.set_yticks([0, 1], names, rotation=90, va="center")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.axhline(0.5, color="white", linewidth=2)
    axes.axvline(0.5, color="white", linewidth=2)
    axes.set_ylabel("truth")
    axes.set_title(name, fontweight="bold", pad=21)

    def accuracies(of: Mapping[str, Any]) -> str:
        both = style.percent(of["accuracy"]), style.percent(of["balanced_accuracy"])
        return "accuracy {} %, balanced {} %".format(*both)

    axes.text(0.5, -0.545, accuracies(scores), ha="center")  # below the title
    lines = ["prediction", "", ""]
    if paper and paper.non_slip_recall is not None:
        recalls = (
            style.percent(recall, 1) for recall in (paper.non_slip_recall, paper.slip_recall)
        )
        lines[1:] = "paper: non-slip {} %, slip {} %".format(*recalls), accuracies(vars(paper))
    elif paper:
        lines[1] = f"paper: accuracy {style.percent(paper.accuracy)} %"
    axes.set_xlabel("\n".join(lines))


# Selected features -------------------------------------------------------------------------------
def _selected_table(selected: Sequence[Mapping[str, str]]) -> str:
    """How many selected features come from each kind, component, finger, domain, descriptor.

    The paper's counts stand beside where it prints them; for descriptors it gives only an order,
    so their column holds a rank such as ``#1``, and ``0`` for the two it never selects. Features
    of another hand than the paper's stand alone, without what all of them have in common.

    Args:
        selected: one mapping per feature with ``channel``, ``component``, ``domain``,
            ``descriptor``, ``kind`` and ``finger``.
    """
    is_papers = _is_of_papers_hand(selected)
    number = "ours" if is_papers else "features"
    gauges, films = published.SELECTED_BY_FINGER.values()
    by_finger = {finger: gauges[finger] + films[finger] for finger in films}
    ranks = {name: f"#{rank}" for rank, name in enumerate(published.DESCRIPTORS_RANKED, 1)}
    ranks |= dict.fromkeys(published.DESCRIPTORS_NEVER, "0")
    beside: dict[str, Mapping[str, object]] = {
        "kind": published.SELECTED_BY_KIND,
        "component": {"D1": 0},
        "finger": by_finger,
        "domain": {},
        "descriptor": ranks,
    }
    rows: list[_Row] = []
    for key, of_paper in beside.items():
        shown = of_paper if is_papers else {}
        counted = Counter(each[key] for each in selected)
        if len(counted) < 2 and not is_papers:
            continue
        for value in dict.fromkeys([*dict(counted.most_common()), *shown]):
            row = {"selected by": key, "": value, number: counted[value]}
            rows.append(row | ({"paper": shown.get(value)} if is_papers else {}))
    rows.append({"selected by": "all", "": "", number: len(selected)})
    if not is_papers:
        return style.table(rows, num_left=2, merged=1)
    rows[-1]["paper"] = published.NUM_SELECTED
    said = f"paper, in words: {published.COMPONENTS_IN_WORDS}; {published.DOMAINS_IN_WORDS}"
    return f"{style.table(rows, num_left=2, merged=1)}\n{said}"


_DOMAIN_WORDS = {"time": "time domain", "freq": "frequency domain"}


@style.styled
def _selected_features_figure(
    selected: Sequence[Mapping[str, str]], path: str | Path, *, simulated: bool
) -> None:
    """Write where the selected features come from: how many of each kind, component and so on.

    Panels are sensor kinds, signal components, fingers or statistics over channels, and
    descriptors; to the left, those with several bars.

    Args:
        selected: one mapping per feature, at least one, with ``channel``, ``component``,
            ``domain``, ``descriptor``, ``kind`` and ``finger``; of a pooled one ``statistic``,
            which then stands in place of the finger.
        path: the PNG to write, replaced as a whole if it exists.
        simulated: whether the bins they were ranked on are.
    """
    title = f"Where the {len(selected)} selected features come from"
    figure = style.new_figure(12.0, 8.4, title, simulated=simulated)
    kinds, components, descriptors, domains = (
        [feature[key] for feature in selected]
        for key in ("kind", "component", "descriptor", "domain")
    )
    is_pooled = any(feature.get("statistic") for feature in selected)
    apart = "of each channel" if is_pooled else None
    places = [feature.get("statistic") or apart or feature["finger"] for feature in selected]
    of_kind = _kind_colours(sorted(set(kinds)))
    of_domain = dict(zip(_DOMAIN_WORDS, (style.PURPLE, style.GREEN), strict=True))
    panels = {
        "sensor kind": (0.5, kinds, kinds, of_kind),
        "signal component": (1.1, components, domains, of_domain),
        "statistic over channels" if is_pooled else "finger": (1.0, places, kinds, of_kind),
    }
    left = [name for name, (_, values, *_) in panels.items() if len(set(values)) > 1]
    left = left or ["signal component"]
    heights = [panels[name][0] for name in left]
    grid = figure.add_gridspec(len(left), 2, width_ratios=[1.15, 1], height_ratios=heights)
    for row, name in enumerate(left):
        _, values, layers, colours = panels[name]
        axes = figure.add_subplot(grid[row, 0])
        _counts(axes, f"({'abc'[row]}) {name}", zip(layers, values, strict=True), colours)
        if name == "signal component":
            handles = [
                Patch(color=of_domain[d], label=_DOMAIN_WORDS[d]) for d in of_domain if d in domains
            ]
            look: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
            axes.legend(handles=handles, ncols=2, borderaxespad=0.3, handlelength=1.4, **look)
    title = f"({'abcd'[len(left)]}) descriptor"
    axes = figure.add_subplot(grid[:, 1])
    _counts(axes, title, zip(kinds, descriptors, strict=True), of_kind)
    handles = [Patch(color=colour, label=kind) for kind, colour in of_kind.items()]
    style.legend_below(figure, handles, 6)
    style.save(figure, path, dpi=180)


def _kind_colours(kinds: Iterable[str]) -> dict[str, str]:
    """A colour for each kind of channel: blue for PVDF, orange for SG, others what is left."""
    known = {"SG": style.ORANGE, "PVDF": style.BLUE}
    left = cycle(colour for colour in style.PALETTE if colour not in known.values())
    return {kind: known.get(kind) or next(left) for kind in dict.fromkeys(kinds)}


def _counts(
    axes: Axes, title: str, pairs: Iterable[tuple[str, str]], colours: Mapping[str, str]
) -> None:
    """Counts of (layer, name) pairs as stacked bars, a lane for each name, layers by colour."""
    counts = Counter(pairs)
    names = sorted({name for _, name in counts}, key=lambda name: (name != "raw", name))
    for lane, name in enumerate(names):
        widths = [counts[layer, name] for layer in colours]
        style.stack(axes, lane, widths, colours.values())
        axes.text(sum(widths), lane, f" {sum(widths)}", va="center", color=style.GREY)
    style.lanes(axes, list(map(style.words, names)))
    axes.set_title(title)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    axes.margins(x=0.1)


# Choice of the model -----------------------------------------------------------------------------
def _validation_table(metrics: _Metrics) -> str:
    """The mean balanced accuracy of choices and of their worst group.

    Of views the best penalty and the chosen one of each, its weight, and below what is decided
    without each group and evaluated on it.

    Args:
        metrics: the content of ``metrics.json``, with ``validation``.
    """
    choices = metrics["validation"]
    chosen = [row for row in choices if row.get("chosen")]
    chosen = chosen or [max(choices, key=lambda row: float(row["mean"]))]
    best: dict[tuple[Any, ...], Mapping[str, Any]] = {}
    for row in sorted(choices, key=lambda row: -row["mean"]):
        best.setdefault(_structure(row), row)
    rows: list[_Row] = []
    has_views = any("view" in row for row in choices)
    shown = [row for row in choices if row in chosen or row is best[_structure(row)]]
    for row in shown if has_views else choices:
        scores = {group: s for group, s in row["balanced_accuracy"].items() if s is not None}
        worst = min(scores, key=lambda group: scores[group], default=None)
        cells: _Row = {"chosen": "*" if row in chosen else ""}
        if has_views:
            cells |= {"view": row["view"], "weight": f"{row['weight']:.2f}"}
        cells |= {"columns": row["num_features"], "degree": row["kernel"]["degree"]}
        cells |= {"C": f"{row['penalty']:g}", "validation %": style.percent(row["mean"])}
        cells |= {"worst %": style.percent(worst and scores[worst]), "group": worst or "-"}
        rows.append(cells)
    lines = [style.table(rows)]
    if nested := metrics.get("nested_validation"):
        by_group = ", ".join(
            f"{g} {style.percent(s)}" for g, s in nested["balanced_accuracy"].items()
        )
        lines.append(
            "what is decided without each group, evaluated on it: "
            f"{style.percent(nested['mean'])} % ({by_group})"
        )
    return style.marked(metrics["simulated"], *lines)


def _structure(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a choice is but for its penalty: view and weight, or degree and offset; columns."""
    return (*row["kernel"].values(), row["num_features"], row.get("view"), row.get("weight"))


# Confounders: scenes that have motion without slip, or slip without motion ------------------------
def _scene_rows(metrics: _Metrics) -> list[dict[str, Any]]:
    """Scores by role, then scene, then detector: the paper's scene first, then those trained on.

    Empty if all is of one kind of scene, or each detector was trained on all of them.
    ``is_trained`` is ``None`` where the results do not tell.
    """
    is_fit = "detector" not in metrics  # evaluate's training role is not what was trained on
    rows = []
    for name, fold in (metrics.get("folds") or {"detector": metrics}).items():
        held_out = dict(fold["splits"])
        trained = held_out.pop("train", {}).get("per_scene", {})
        for role, split in held_out.items():
            for scene, scores in split.get("per_scene", {}).items():
                row = {"role": role, "scene": scene, "detector": name, "scores": scores}
                rows.append(row | {"is_trained": scene in trained if is_fit else None})
    roles, scenes = (list(dict.fromkeys(row[key] for row in rows)) for key in ("role", "scene"))
    of_any = {row["scene"] for row in rows if row["is_trained"]}
    scenes.sort(key=lambda scene: (scene != "paper", scene not in of_any))
    rows.sort(key=lambda row: (roles.index(row["role"]), scenes.index(row["scene"])))
    return rows if len(scenes) > 1 and not all(row["is_trained"] for row in rows) else []


def _confound_table(metrics: _Metrics) -> str:
    """Bins, recalls and balanced accuracy of each detector on each kind of scene, held out.

    ``trained on it`` says whether other cycles of that scene were trained on, ``-`` where the
    results do not tell. A class without bins has the recall ``-``.

    Args:
        metrics: the content of ``metrics.json``.
    """
    rows: list[_Row] = []
    recalls = ("non_slip_recall", "slip_recall", "balanced_accuracy")
    for row in _scene_rows(metrics):
        scene = _scene_name(metrics, row["scene"])
        cells: _Row = {"evaluated on": row["role"], "scene": scene}
        cells |= {"detector": row["detector"], "trained on it": row["is_trained"]}
        cells |= {"bins": row["scores"]["num_bins"]}
        rows.append(cells | _percents(row["scores"], {key: _SCORES[key] for key in recalls}))
    return style.marked(metrics["simulated"], style.table(rows, num_left=4))


@style.styled
def _confound_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write false slips and slips found of each detector on each kind of scene, as a PNG.

    In the paper's protocol the hand slides whenever the arm moves, so a detector of motors scores
    well there; scenes in which one happens without the other tell them apart. Dots of a scene stand
    a little below each other, so that equal ones are seen.

    Args:
        metrics: the content of ``metrics.json``, with several kinds of scenes.
        path: the PNG to write, replaced as a whole if it exists.
    """
    rows = _scene_rows(metrics)
    roles, scenes = (list(dict.fromkeys(row[key] for row in rows)) for key in ("role", "scene"))
    colours = style.colours_of(row["detector"] for row in rows)
    height = 1.7 + len(roles) * (0.8 + 0.28 * len(scenes))
    is_papers = _is_papers_hand(metrics)
    names = {published.PAPER_SCENE: "paper's protocol" if is_papers else style.UNNAMED_SCENE}
    title = "Does it detect slip, or the motion of the arm?"
    title = title if is_papers else "Scores of each kind of scene"
    figure = style.new_figure(10.5, height, title, simulated=metrics["simulated"])
    panels = figure.subplots(len(roles), 2, sharex="col", sharey=True, squeeze=False)
    dot: dict[str, Any] = {"marker": "o", "ls": "", "ms": 7.5, "mew": 1.8}
    sides = {"non_slip_recall": "nothing but slip", "slip_recall": "no slip in this scene"}
    named = {"test": "test cycles of seen materials", "unseen": "unseen materials"}
    named = named if is_papers else {}
    for role, pair in zip(roles, panels, strict=True):
        for axes, (key, nothing) in zip(pair, sides.items(), strict=True):
            for lane, scene in enumerate(scenes):
                here = [row for row in rows if (row["role"], row["scene"]) == (role, scene)]
                own = [row for row in here if row["scores"][key] is not None]
                values = np.array([100 * row["scores"][key] for row in own])
                values = 100 - values if key == "non_slip_recall" else values
                heights = lane + _spread(len(own), 0.13)
                axes.plot(values, heights, color="#BBBBBB", lw=2, zorder=1)
                for row, value, at in zip(own, values, heights, strict=True):
                    colour = colours[row["detector"]]
                    fill = "white" if row["is_trained"] is False else colour
                    axes.plot(value, at, color=colour, mfc=fill, clip_on=False, zorder=2, **dot)
                if not own:
                    look: dict[str, Any] = {"color": style.GREY, "ha": "center", "va": "center"}
                    axes.text(0.5, lane, nothing, transform=axes.get_yaxis_transform(), **look)
            style.lanes(axes, [names.get(scene, style.words(scene)) for scene in scenes])
        pair[0].set_title(named.get(role, role))
    left, right = panels[-1]
    left.set_xlim(left=0)
    right.set_xlim(right=100)
    left.set_xlabel("false slips, % of non-slip bins: fewer is better")
    right.set_xlabel("slips found, % of slip bins: more is better")
    handles = [Line2D([], [], color=colours[name], label=name, **dot) for name in colours]
    if any(row["is_trained"] is False for row in rows):
        labels = {
            style.GREY: "trained on other recordings of that scene",
            "white": "scene not trained on",
        }
        for fill, label in labels.items():
            handles.append(Line2D([], [], color=style.GREY, mfc=fill, label=label, **dot))
    style.legend_below(figure, handles, 4)
    style.save(figure, path)


def _spread(number: int, width: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Heights beside the middle of a lane; of one, the middle."""
    return np.linspace(-width, width, number) if number > 1 else np.zeros(number)


# Stated probabilities ----------------------------------------------------------------------------
def _reliabilities(metrics: _Metrics) -> list[tuple[str, str, Mapping[str, Any]]]:
    """Role, material and scores of ``Reliability``; the material is empty for the whole role."""
    rows = []
    for role, scores in metrics["alarm"]["reliability"].items():
        rows.append((role, "", scores))
        rows += [(role, name, of) for name, of in scores.get("per_material", {}).items()]
    return rows


def _reliability_table(metrics: _Metrics) -> str:
    """Calibration error, Brier score and log loss of each role, and of each material in it.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    rows: list[_Row] = []
    for role, material, scores in _reliabilities(metrics):
        row: _Row = {"role": role, "material": material or "all"}
        row |= {"bins": f"{sum(scores['counts']):.0f}"}
        row |= _percents(scores, {"ece": "ECE %", "mce": "worst cell %"})
        row |= {"Brier": f"{scores['brier']:.4f}", "log loss": f"{scores['log_loss']:.4f}"}
        rows.append(row)
    return style.marked(metrics["simulated"], style.table(rows, num_left=2, merged=1))


@style.styled
def _reliability_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write the reliability curve of each role with its counts, and the error of each material.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    rows = _reliabilities(metrics)
    title = "Does a stated probability of slip come true?"
    height = max(5.2, 1.6 + 0.26 * len(rows))
    figure = style.new_figure(10.5, height, title, simulated=metrics["simulated"])
    grid = figure.add_gridspec(2, 2, height_ratios=(4, 1), width_ratios=(1.15, 1))
    curves = figure.add_subplot(grid[0, 0])
    counts = figure.add_subplot(grid[1, 0], sharex=curves)
    errors = figure.add_subplot(grid[:, 1])
    wholes = {role: scores for role, material, scores in rows if not material}
    colours = style.colours_of(wholes)
    curves.plot([0, 1], [0, 1], color=style.GREY, linewidth=1, linestyle="--", label="as stated")
    for aside, (role, scores) in zip(_spread(len(wholes), 0.005), wholes.items(), strict=True):
        number = style.grouped(sum(scores["counts"]))
        label = f"{role}: {number} bins, ECE {style.percent(scores['ece'])} %"
        look: dict[str, Any] = {"color": colours[role], "linewidth": 1.5, "markersize": 5}
        curves.plot(scores["probabilities"], scores["slip_shares"], "o-", label=label, **look)
        at = np.array(scores["probabilities"]) + aside
        counts.bar(at, scores["counts"], width=0.01, color=colours[role])
    curves.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), ylabel="fraction of bins that slip")
    curves.tick_params(labelbottom=False)
    curves.legend(loc="upper left")
    counts.set(xlabel="stated probability of slip, mean of a cell", ylabel="bins")
    for lane, (role, material, scores) in enumerate(rows):
        value = 100 * scores["ece"]
        errors.barh(lane, value, color=colours[role], alpha=0.45 if material else 1.0)
        errors.text(value, lane, f" {value:.2f}", va="center", color=style.GREY)
    style.lanes(errors, [material or f"{role}, all" for role, material, _ in rows])
    errors.margins(x=0.15)
    errors.set_xlim(left=0)
    errors.set_xlabel("expected calibration error, %")
    style.save(figure, path)


# Events: slips found and false alarms ------------------------------------------------------------
_REFLEX_MS = (60.0, 90.0)
_LATENCY_PARTS = {
    "look_ahead": "look-ahead",
    "bin_fill": "bin fill",
    "decision": "decision",
    "delay": "all",
    "compute": "compute beside",
}


def _event_cells(numbers: Mapping[str, Any], digits: int = 1) -> _Row:
    """Slips, percent found, early and missed; delay in ms, from the first release, mm slid."""
    none = {"median": None, "p95": None}
    delay, first, slid = (numbers.get(n) or none for n in ("delay_ms", "delay_first_ms", "slid_mm"))
    return {
        "slips": numbers["num_onsets"],
        **{f"{outcome} %": _value(numbers[outcome], 1, 100) for outcome in _OUTCOMES},
        "delay ms": _value(delay["median"], digits),
        "p95 ms": _value(delay["p95"], digits),
        "from first release ms": _value(first["median"], digits),
        "mm slid": _value(slid["median"], 1),
    }


def _value(number: Mapping[str, float] | None, digits: int, scale: float = 1.0) -> str:
    """The value of a number with an interval, ``-`` where there is none."""
    return "-" if number is None else f"{scale * number['value']:.{digits}f}"


def _false_alarms(numbers: Mapping[str, Any]) -> str:
    """A rate with its interval, such as ``74.2 /min [70.1, 78.0]``."""
    unit, key = ("h", "per_hour") if numbers["quiet_hours"] >= 1 else ("min", "per_minute")
    return style.interval(numbers[f"false_alarms_{key}"], 1, f" /{unit}")


def _events_table(metrics: _Metrics) -> str:
    """One row for each role and rule; brackets hold intervals.

    ``delay`` is the median from the exact onset to the alarm, look-ahead within, ``mm slid`` the
    way slid meanwhile at most; ``slip-free`` is how long an alarm would have been false. Rates are
    by the hour where that is at least an hour, else by the minute. Columns in which nothing is
    known are left out, and a line says where slips or hours are too few. Where compute was
    measured, the parts of the mean delay follow in a second table.

    Args:
        metrics: the content of ``metrics.json``, with ``events``.
    """
    rows: list[_Row] = []
    delays: list[_Row] = []
    for role, by_rule in metrics["events"].items():
        for rule, numbers in by_rule.items():
            hours, latency = numbers["quiet_hours"], numbers["latency_ms"] or {}
            quiet = f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"
            row: _Row = {"events": role, "rule": style.words(rule), **_event_cells(numbers)}
            row |= {"false alarms": _false_alarms(numbers), "slip-free": quiet if hours else "-"}
            rows.append(row | {"alarms a slip": _value(numbers["alarms_per_slip"], 2)})
            delay: _Row = {"mean delay, ms": role, "rule": style.words(rule)}
            for name, title in _LATENCY_PARTS.items():
                ms = latency.get(name)
                delay[title] = None if ms is None else f"{ms:.1f}"
            delays.append(delay)
    found = [numbers for by_rule in metrics["events"].values() for numbers in by_rule.values()]
    is_any = any(numbers["num_onsets"] or numbers["quiet_hours"] for numbers in found)
    lines = [style.table(rows, num_left=2, merged=1, kept=2)] if is_any else []
    if is_any and not any(numbers["num_onsets"] for numbers in found):
        lines.append("no slip has a known onset: false alarms alone can be counted")
    lines += [
        f"{role}: {few}"
        for role, by_rule in metrics["events"].items()
        for few in [few_events(*list(by_rule.values())[:1])]
        if few and role != "train"
    ]
    if reasons := dict.fromkeys(of["reason"] for of in found if of.get("reason")):
        lines.append(f"no events: {'; '.join(reasons)}")
    if any(row["compute beside"] for row in delays):
        lines += ["", style.table(delays, num_left=2, merged=1)]
    return style.marked(metrics["simulated"], *lines)


def few_events(numbers: Mapping[str, Any]) -> str:
    """That slips or hours are too few for a rate; empty where they are enough or there are none.

    Args:
        numbers: of ``pooled_metrics``.
    """
    slips, hours = numbers["num_onsets"], numbers["quiet_hours"]
    quiet = f"{hours:.1f} h" if hours >= 0.1 else f"{60 * hours:.1f} min"
    counts, wanted = [f"{quiet} without slip"], [f"{FEWEST_HOURS} h"]
    if slips:
        counts.insert(0, f"{slips} slip{'s' * (slips != 1)}")
        wanted.insert(0, str(FEWEST_SLIPS))
    if not (slips or hours) or (hours >= FEWEST_HOURS and (not slips or slips >= FEWEST_SLIPS)):
        return ""
    are = "are" if slips else "is"
    return f"{' and '.join(counts)}: too few for a rate; {' and '.join(wanted)} {are} wanted"


def _drawn_events(metrics: _Metrics) -> dict[str, dict[str, Mapping[str, Any]]]:
    """By role, the rules in words that were evaluated on some slip whose onset is known."""
    drawn = {
        role: {style.words(rule): own for rule, own in by_rule.items() if own["num_onsets"]}
        for role, by_rule in metrics.get("events", {}).items()
    }
    return {role: by_rule for role, by_rule in drawn.items() if by_rule}


@style.styled
def _events_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write slips found by time since the onset, and what became of all, as a PNG.

    A row for each role that has slips: to the left the fraction of slips that were found so many ms
    behind the onset, a line for each rule, of which the latest 5 % may leave the picture; to the
    right found, early and missed, with the false alarms.

    Args:
        metrics: the content of ``metrics.json``, with events of some slip.
        path: the PNG to write, replaced as a whole if it exists.
    """
    events = _drawn_events(metrics)
    rules = list(dict.fromkeys(rule for by_rule in events.values() for rule in by_rule))
    free = [colour for colour in style.PALETTE if colour not in _OUTCOMES.values()]
    styles: dict[str, dict[str, Any]] = {
        rule: {"color": free[place % len(free)], "ls": ("-", "--", ":")[place // len(free) % 3]}
        for place, rule in enumerate(rules)
    }
    heights = [1.3 + 0.3 * max(2, len(by_rule)) for by_rule in events.values()]
    title = "Which slips are found, how late, and how many alarms are false"
    figure = style.new_figure(11.0, 1.3 + sum(heights), title, simulated=metrics["simulated"])
    ratios = {"width_ratios": [1.25, 1.0], "height_ratios": heights}
    panels = figure.subplots(len(events), 2, sharex="col", squeeze=False, gridspec_kw=ratios)
    earliest, latest = 0.0, _REFLEX_MS[1]
    for (role, by_rule), (left, right) in zip(events.items(), panels, strict=True):
        left.axvspan(*_REFLEX_MS, color="#F0E6C8", zorder=0, lw=0)
        style.lanes(right, list(by_rule), least=2)
        for lane, (rule, numbers) in enumerate(by_rule.items()):
            if delay := numbers["delay_ms"]:
                found = 100 * numbers["found"]["value"]
                fractions = np.linspace(0, found, len(delay["quantiles"]))
                left.plot(delay["quantiles"], fractions, lw=2, zorder=3, **styles[rule])
                middle = (delay["median"]["value"], found / 2)
                left.plot(*middle, "o", color=styles[rule]["color"], ms=6, zorder=4)
                earliest = min(earliest, delay["quantiles"][0])
                latest = max(latest, delay["p95"]["value"])
            _draw_outcomes(right, lane, numbers)
            right.get_yticklabels()[lane].set_color(styles[rule]["color"])
        left.set(ylim=(0, 102), ylabel="slips found, %")
        left.set_title(role, fontweight="bold")
        right.set_xlim(0, 100)
    left.set_xlim(earliest, 1.5 * latest)
    left.set_xlabel("time since the exact onset, ms (look-ahead within)")
    right.set_xlabel("of all slips, %")
    handles: list[Any] = [Line2D([], [], lw=2, label=rule, **styles[rule]) for rule in rules]
    handles.append(Line2D([], [], color=style.GREY, marker="o", ls="", label="median"))
    handles.append(Patch(color="#F0E6C8", label="grip reflex of people, 60 to 90 ms"))
    handles += [Patch(color=colour, label=outcome) for outcome, colour in _OUTCOMES.items()]
    style.legend_below(figure, handles, 6)
    style.save(figure, path)


def _draw_outcomes(axes: Axes, lane: int, numbers: Mapping[str, Any]) -> None:
    """Found, early and missed of a rule in one bar, the false alarms behind it."""
    widths = [100 * (numbers[name] or {"value": 0.0})["value"] for name in _OUTCOMES]
    style.stack(axes, lane, widths, _OUTCOMES.values())
    look: dict[str, Any] = {"va": "center"}
    for width, end in zip(widths, np.cumsum(widths), strict=True):
        if width >= 7:
            axes.text(end - width / 2, lane, f"{width:.1f}", color="white", ha="center", **look)
    look |= {"xycoords": axes.get_yaxis_transform(), "annotation_clip": False}
    axes.annotate(f"false alarms {_false_alarms(numbers)}", (1.02, lane), **look)


# Alarm at a given false-alarm rate ---------------------------------------------------------------
_STREAMS = {"test": ("seen materials", style.BLUE), "unseen": ("unseen materials", style.VERMILION)}
_LEAST_RATE = 0.1  # an hour: where the figure's axis begins, and rates of 0 are drawn


def _rate_rows(metrics: _Metrics) -> list[_Row]:
    """The false-alarm rate that was reached: a row for each method on each stream.

    Rates are false alarms an hour on recordings without slip, in brackets their intervals: *as
    asked* where these hold the target, *more* or *fewer* where not. Slips are the protocol's.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    target = metrics["alarm"]["settings"]["target_per_hour"]
    rows: list[_Row] = []
    for role, (materials, _) in _STREAMS.items():
        quiet = _quiet_rates(metrics, role)
        for method, numbers in metrics["events"].get(f"{role} stream", {}).items():
            reached, against = "-", "-"
            if method in quiet:
                rate, hours = quiet[method]
                reached = f"{style.interval(rate, 2)} in {hours:.1f} h"
                against = "more" if rate["low"] > target else "as asked"
                against = "fewer" if rate["high"] < target else against
            row: _Row = {"materials": materials, "method": style.words(method)}
            row |= {"false alarms an hour without slip": reached, "against target": against}
            rows.append(row | _event_cells(numbers))
    return rows


def _quiet_rates(metrics: _Metrics, role: str) -> dict[str, tuple[Mapping[str, float], float]]:
    """By method, false alarms an hour on the scene without slip, and its hours."""
    scene = metrics["alarm"]["settings"]["metadata"]["slip_free"]
    rates = {}
    for method, numbers in metrics["events"].get(f"{role} stream", {}).items():
        quiet = numbers["per_scene"].get(scene)
        if quiet and quiet["false_alarms_per_hour"]:
            rates[method] = quiet["false_alarms_per_hour"], quiet["quiet_hours"]
    return rates


def _target_line(metrics: _Metrics) -> str:
    """The budget, and what calibration had of it."""
    alarm = metrics["alarm"]
    metadata = alarm["settings"]["metadata"]
    parts = []
    for row in metadata["budget"]:
        limit = f"{row['limit']:g} an hour"
        amount = f"{row['amount']:.1f} h"
        few = f"{row['alarms']} of {row['allowed']} allowed in {amount}"
        parts.append(f"{style.words(row['scene'])} {limit} ({few})")
    return (
        f"budget of false alarms, at {100 * metadata['confidence']:g} % confidence: "
        f"{', '.join(parts)}; {style.words(alarm['rule'])} is what the detector's file has"
    )


def _budget_rows(metrics: _Metrics) -> list[_Row]:
    """False alarms of each scene and method beside the budget, on recordings that set nothing.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    found: dict[tuple[str, str], _Row] = {}
    for row in metrics["alarm"]["budget"]:
        if row["role"] not in _STREAMS or not row["amount"]:
            continue
        head: _Row = {"scene": style.words(row["scene"])}
        head |= {"materials": {"test": "seen"}.get(row["role"], row["role"])}
        limit = "-" if row["limit"] is None else f"{row['limit']:g} /h"
        head |= {"budget": limit, "of": f"{row['amount']:.1f} h"}
        reached = style.interval({"value": row["rate"], **row}, 2)
        found.setdefault((row["scene"], row["role"]), head)[style.words(row["method"])] = reached
    return list(found.values())


def _alarm_table(metrics: _Metrics) -> str:
    """``_target_line``, ``_rate_rows`` and ``_budget_rows`` for the terminal."""
    rows = style.table(_rate_rows(metrics), num_left=2, merged=1)
    budget = style.table(_budget_rows(metrics), num_left=3)
    return style.marked(metrics["simulated"], _target_line(metrics), rows, budget)


def _confounder_rows(metrics: _Metrics) -> list[_Row]:
    """False alarms and slips found in confounding scenes, by the detector's own rule.

    Behind it the false alarms of the paper's rule and of the other methods. A row for seen and
    unseen materials of every scene.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
    """
    alarm = metrics["alarm"]
    methods = alarm["methods"].items()
    beside = [name for name, method in methods if not method["calibrated"]]
    beside += [name for name, method in methods if method["scorer"] != "detector"]
    rows: list[_Row] = []
    for scene, by_role in alarm["scenes"].items():
        for role in (role for role in by_role if role != "trained"):
            numbers = by_role[role][alarm["rule"]]
            row: _Row = {"scene": style.words(scene), "materials": {"test": "seen"}.get(role, role)}
            row |= {"trained on": bool(by_role["trained"])}
            row |= {"quiet min": f"{60 * numbers['quiet_hours']:.0f}"}
            rate = _value(numbers["false_alarms_per_hour"], 1)
            row |= {f"{style.words(alarm['rule'])} /h": rate} | _event_cells(numbers, digits=0)
            del row["p95 ms"], row["from first release ms"]
            for name in beside:
                row[f"{name} /h"] = _value(by_role[role][name]["false_alarms_per_hour"], 1)
            rows.append(row)
    return rows


def _scenes_table(metrics: _Metrics) -> str:
    """``_confounder_rows`` for the terminal."""
    return style.marked(metrics["simulated"], style.table(_confounder_rows(metrics), num_left=2))


@style.styled
def _alarm_figure(metrics: _Metrics, path: str | Path) -> None:
    """Write the false-alarm rates that were reached, and those of every scene, as a PNG.

    Args:
        metrics: the content of ``metrics.json``, with ``alarm``.
        path: the PNG to write, replaced as a whole if it exists.
    """
    alarm = metrics["alarm"]
    scenes, target = alarm["scenes"], alarm["settings"]["target_per_hour"]
    title = f"Without slip at most {target:g} false alarms an hour (dashed)"
    height = 2.2 + 0.5 * max(len(alarm["methods"]), len(scenes))
    figure = style.new_figure(12.0, height, title, simulated=metrics["simulated"])
    left, *others = figure.subplots(1, 2 if scenes else 1, squeeze=False)[0]
    quiet = {role: _quiet_rates(metrics, role) for role in _STREAMS}
    methods = [name for name in alarm["methods"] if any(name in rates for rates in quiet.values())]
    hours = []
    for aside, (role, (name, colour)) in zip((-0.14, 0.14), _STREAMS.items(), strict=True):
        _draw_rates(left, [quiet[role].get(each, (None,))[0] for each in methods], aside, colour)
        left.plot([], [], "o-", color=colour, label=name)
        hours += [f"{spent:.1f} h of {name}" for _, spent in list(quiet[role].values())[-1:]]
        own = [
            by_role[role][alarm["rule"]] if role in by_role else {} for by_role in scenes.values()
        ]
        for right in others:
            rates = [of.get("false_alarms_per_hour") for of in own]
            _draw_rates(right, rates, aside, colour)
    left.set_title(f"Without slip: {' and '.join(hours)}")
    left.axvline(target, color=style.INK, linewidth=1, linestyle="--", zorder=1)
    limits = {row["scene"]: row["limit"] for row in alarm["budget"] if row["limit"]}
    for right in others:
        title = f"Confounding scenes, by {style.words(alarm['rule'])} (bars: their budgets)"
        right.set_title(title)
        for lane, scene in enumerate(scenes):
            ends = lane - 0.35, lane + 0.35
            if scene in limits:
                right.vlines(limits[scene], *ends, color=style.INK, linewidth=1.6)
    for axes, names in zip([left, *others], [methods, scenes], strict=False):
        style.lanes(axes, list(map(style.words, names)))
        axes.set(
            xscale="log", xlabel="false alarms an hour, with interval (none: at the left edge)"
        )
        axes.set_xlim(left=0.8 * _LEAST_RATE)
    left.legend(loc="best")
    style.save(figure, path)


def _draw_rates(
    axes: Axes, rates: Sequence[Mapping[str, float] | None], aside: float, colour: str
) -> None:
    """A dot with its interval in the lane of every rate that there is."""
    for lane, rate in enumerate(rates):
        if rate:
            low, value, high = (max(rate[end], _LEAST_RATE) for end in ("low", "value", "high"))
            axes.plot([low, high], [lane + aside] * 2, color=colour, linewidth=1.6, zorder=2)
            axes.plot(value, lane + aside, "o", color=colour, markersize=6, zorder=3)


# Beside the paper -----


def _beside(metrics: Mapping[str, Any], split: str) -> published.PublishedSplit | None:
    """The paper's scores beside ours: none of a split it lacks, of another hand or other scenes.

    Args:
        metrics: the content of ``metrics.json``; without ``is_papers_hand`` they are of the
            paper's hand, and scores without ``per_scene`` of the paper's scene.
        split: name of the split.
    """
    scenes = set(metrics["splits"][split].get("per_scene", {}))
    is_papers = metrics.get("is_papers_hand", True) and scenes <= {published.PAPER_SCENE}
    return published.SPLITS.get(split) if is_papers else None


def _is_of_papers_hand(selected: Sequence[Mapping[str, str]]) -> bool:
    """Whether all these features are of kinds of channels and fingers that the paper's hand has.

    Args:
        selected: one mapping per feature with ``kind`` and ``finger``.
    """
    fingers = published.SELECTED_BY_FINGER
    return all(feature["finger"] in fingers.get(feature["kind"], {}) for feature in selected)
