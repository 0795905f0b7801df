"""Figures of ``benchmarks.reproduction``: every seed, and recall beside the onset."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.drawing import GREY, LIGHT, OURS, PEER, finish
from benchmarks.reproduction.confound import FOLDS, ROLES, SCENES, recalls, scenes_of
from benchmarks.reproduction.results import (
    MeanSd,
    Report,
    baseline_percent,
    percent,
    recall_beside_onset,
    roles_of,
)
from tactslip_torch.report import published

BESIDE = {("random_bins", "test"): "test", ("unseen4", "unseen"): "unseen"}
"""Where a published balanced accuracy is drawn, and which."""

COLORS = dict(zip(FOLDS, (PEER, OURS), strict=True))


def seeds_figure(report: Report, path: Path) -> None:
    """Balanced accuracy of every seed, by experiment and role, the paper's as a bar.

    Args:
        report: as it is stored.
        path: of the PNG.
    """
    names = [(name, role) for name in report["runs"] for role in roles_of(report, name)]
    drawing = Figure(figsize=(7.6, 0.3 * len(names) + 1.5), layout="constrained")
    axes = drawing.subplots()
    for place, (name, role) in enumerate(names):
        values = percent(report, name, role, "balanced_accuracy")
        pooled = baseline_percent(report, name, role, "balanced_accuracy")
        axes.plot(pooled, [place] * len(pooled), "|", color=PEER, ms=8)
        axes.plot(values, [place] * len(values), "o", color=OURS, alpha=0.7, ms=5)
        paper = published.SPLITS[BESIDE[name, role]] if (name, role) in BESIDE else None
        if paper and paper.balanced_accuracy:
            x = 100 * paper.balanced_accuracy
            axes.plot([x, x], [place - 0.4, place + 0.4], color="black", lw=2)
    axes.plot([], [], "o", color=OURS, alpha=0.7, ms=5, label="ours, a dot a seed")
    axes.plot([], [], "|", color=PEER, ms=8, label="best pooled number")
    axes.plot([], [], color="black", lw=2, label="paper, real hand")
    axes.set_yticks(range(len(names)), [f"{name}, {role}" for name, role in names], fontsize=8)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("balanced accuracy, %")
    axes.grid(axis="x", color=LIGHT)
    drawing.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    finish(drawing, report, "Bins told apart", path)


def places_figure(report: Report, path: Path) -> None:
    """Recall of bins by their place beside the onset, of both recipes, test and unseen.

    Args:
        report: as it is stored.
        path: of the PNG.
    """
    roles = [role for role in ("test", "unseen") if role in roles_of(report, "unseen4")]
    drawing = Figure(figsize=(8.4, 2.5 * len(roles) + 1.2), layout="constrained")
    panels = drawing.subplots(len(roles), 1, sharex=True, squeeze=False)[:, 0]
    for axes, role in zip(panels, roles, strict=True):
        for name, color, words in (
            ("unseen4", OURS, "paper's recipe"),
            ("unseen4 robust", PEER, "default recipe"),
        ):
            _recall_lines(axes, report, (name, role), color, words)
        axes.axvline(-0.5, color=GREY, ls="--", lw=1)
        axes.set_ylabel(f"recall, %, {role}")
        axes.grid(axis="y", color=LIGHT)
    panels[-1].set_xticks([*range(-20, 20, 5), 20], [*map(str, range(-20, 20, 5)), "20\nand on"])
    panels[-1].set_xlabel("bins of 50 ms beside the labelled onset: non-slip before 0, slip from 0")
    drawing.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False
    )
    about = "Recall beside the onset, mean and spread of seeds"
    finish(drawing, report, about, path)


def _recall_lines(axes: Axes, report: Report, of: tuple[str, str], color: str, words: str) -> None:
    for side, label in ((range(-20, 0), words), (range(21), None)):
        found = {
            place: recall_beside_onset(report, *of, [str(place) if place < 20 else "20+"])
            for place in side
        }
        spreads = {place: MeanSd.of(values) for place, values in found.items() if values}
        if not spreads:
            continue
        means = [spread.mean for spread in spreads.values()]
        sds = [spread.sd or 0.0 for spread in spreads.values()]
        axes.plot(list(spreads), means, "o-", color=color, ms=3.5, lw=1.2, label=label)
        low = [mean - sd for mean, sd in zip(means, sds, strict=True)]
        high = [min(mean + sd, 100) for mean, sd in zip(means, sds, strict=True)]
        axes.fill_between(list(spreads), low, high, color=color, alpha=0.15, lw=0)


def confound_figure(report: Report, path: Path) -> None:
    """Both detectors of the confound experiment, scene by scene.

    Args:
        report: as it is stored.
        path: of the PNG.
    """
    scenes = scenes_of(report)
    drawing = Figure(figsize=(9.2, 0.5 * len(scenes) + 1.6), layout="constrained")
    panels = drawing.subplots(1, len(ROLES), sharey=True, sharex=True)
    for axes, role in zip(panels, ROLES, strict=True):
        for shift, (fold, color) in zip((-0.14, 0.14), COLORS.items(), strict=True):
            for place, scene in enumerate(scenes):
                values = recalls(report, fold, role, scene)
                at = [place + shift] * len(values)
                axes.plot(values, at, "o", color=color, alpha=0.45, ms=4.5, mew=0)
                axes.plot(MeanSd.of(values).mean, place + shift, "|", color=color, ms=12, mew=2)
        title = "seen materials, test cycles" if role == "test" else "unseen materials"
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("mean recall of the classes there are, %")
        axes.grid(axis="x", color=LIGHT)
    for fold, color in COLORS.items():
        panels[0].plot([], [], "o", color=color, label=f"trained on {FOLDS[fold]}")
    names = [SCENES.get(scene, scene) for scene in scenes]
    panels[0].set_yticks(range(len(scenes)), names, fontsize=8)
    panels[0].set_ylim(len(scenes) - 0.4, -0.6)
    drawing.legend(loc="outside lower center", ncols=2, frameon=False)
    finish(drawing, report, "Slip or the arm: dots are seeds, bars their means", path)
